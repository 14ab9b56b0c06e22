"""What comes with Turbo-Pi: images and statistics of LIBERO episodes, and two small trained policies."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from turbopi.checkpoint import Checkpoint, load_norm_stats
from turbopi.policy.policy import UnifiedPolicy
from turbopi.robots.base import Example
from turbopi.support.errors import TurboPiError
from turbopi.support.reading.images import read_image


@dataclass(frozen=True)
class Frame:
    """One moment of a LIBERO episode.

    base, wrist   uint8[256, 256, 3]  RGB, turned as the policy expects them
    state         float64[8]
    expert        float64[10, 7]      what the scripted expert did next, that the small policy learned from
    """

    prompt: str
    base: np.ndarray
    wrist: np.ndarray
    state: np.ndarray
    step: int | None = None
    expert: np.ndarray | None = None


DATA = Path(__file__).parents[1] / "data"
FRAMES = DATA / "libero"
# Checkpoints' folders, with packed weights (checkpoint/packed.py). MODEL_CARD.md in them says how they were trained
SMALL_POLICY = DATA / "small_policy"
CHASE_POLICY = DATA / "chase_policy"  # of the dynamic task, trained with simulated delays


def load_frames(folder: Path = FRAMES) -> list[Frame]:
    """The images that come with Turbo-Pi, or those of another folder of the same form (frames.json names them)."""
    try:
        listed = json.loads((folder / "frames.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise TurboPiError(f"{folder} has no frames.json: the installation lacks the demo's images") from None
    return [
        Frame(
            prompt=entry["prompt"],
            base=read_image(folder / entry["image"]),
            wrist=read_image(folder / entry["wrist_image"]),
            state=np.array(entry["state"], np.float64),
            step=entry.get("step"),
            expert=np.array(entry["expert"], np.float64) if "expert" in entry else None,
        )
        for entry in listed
    ]


def with_libero_stats(checkpoint: Checkpoint) -> Checkpoint:
    """Random weights for LIBERO with the statistics of real episodes, so that states and actions have its scale."""
    if checkpoint.format != "random" or checkpoint.config.robot != "libero":
        return checkpoint
    return replace(checkpoint, norm_stats=load_norm_stats(FRAMES / "norm_stats.json"))


def observations(policy: UnifiedPolicy, frames: Sequence[Frame]) -> list[dict[str, object]]:
    """The frames in the keys of the policy's robot.

    For another robot than LIBERO's they are its example observations, with these images in place of its cameras'.
    """
    if policy.metadata["robot"] == "libero":
        return [
            {
                "observation/image": frame.base,
                "observation/wrist_image": frame.wrist,
                "observation/state": frame.state,
                "prompt": frame.prompt,
            }
            for frame in frames
        ]
    return [_with_images(policy.example_observation(seed), frame) for seed, frame in enumerate(frames)]


def _with_images(observation: Mapping[str, object], frame: Frame) -> dict[str, object]:
    """`observation` with each of its images replaced: the first by the base camera's, the others by the wrist's."""
    camera_images = iter([frame.base])

    def replaced(key: str, value: object) -> object:
        if isinstance(value, Mapping):
            return {inner: replaced(inner, item) for inner, item in value.items()}
        if isinstance(value, np.ndarray) and value.ndim == 3:
            return _like(next(camera_images, frame.wrist), value)
        return frame.prompt if key in ("prompt", "task") else value

    return Example({key: replaced(key, value) for key, value in observation.items()})


def _like(camera_image: np.ndarray, other: np.ndarray) -> np.ndarray:
    """`image` in the layout and range of `other`: HWC or CHW, uint8 or float in [0, 1]."""
    if np.issubdtype(other.dtype, np.floating):
        camera_image = (camera_image / 255).astype(other.dtype)
    return np.ascontiguousarray(camera_image.transpose(2, 0, 1)) if other.shape[0] == 3 else camera_image
