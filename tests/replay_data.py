"""The frames that ship with Turbo-Pi as a dataset: an episode each, of the ten actions that its expert took."""

from pathlib import Path

import numpy as np
from lerobot_datasets import Recorded, write_dataset

from turbopi.policy.shipped import load_frames

BASE, WRIST, STATE, ACTION = "observation.images.image", "observation.images.wrist_image", "observation.state", "action"

EVERY = 10  # steps of an episode: its first alone has the observation of its images


def recorded_frames(swap: bool = False, degrees: bool = False) -> list[Recorded]:
    """Episodes of ten steps; only the first one's observation is a real one, so they are replayed with `--every 10`."""
    factor = 180 / np.pi if degrees else 1.0
    found = []
    for frame in load_frames():
        assert frame.expert is not None
        steps = len(frame.expert)
        base, wrist = (frame.wrist, frame.base) if swap else (frame.base, frame.wrist)
        images = {BASE: np.stack([base] * steps), WRIST: np.stack([wrist] * steps)}
        numbers = {STATE: np.stack([frame.state] * steps) * factor, ACTION: frame.expert * factor}
        found.append(Recorded(frame.prompt, images, numbers))
    return found


def write_frames(folder: Path, version: str = "v3.0", swap: bool = False, degrees: bool = False) -> Path:
    """A LeRobotDataset of them."""
    return write_dataset(folder, recorded_frames(swap, degrees), version=version)


def write_npz(folder: Path, swap: bool = False, degrees: bool = False) -> Path:
    """The same as .npz episodes, which need no other package."""
    folder.mkdir()
    for number, one in enumerate(recorded_frames(swap, degrees)):
        arrays = {
            "observation/image": one.images[BASE],
            "observation/wrist_image": one.images[WRIST],
            "observation/state": one.numbers[STATE],
            "actions": one.numbers[ACTION],
        }
        np.savez(folder / f"episode_{number}.npz", prompt=np.array(one.task), **arrays)  # type: ignore[arg-type]
    return folder
