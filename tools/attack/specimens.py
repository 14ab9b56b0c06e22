"""Good files of every format that Turbo-Pi reads, small, to be damaged; and who reads each of them.

A reader runs in a fork (zygote.py). It prints the digest of all that it read; what it refuses is told as the command
line tells it, with exit code 2.
"""

import hashlib
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from attack.judging import digest

TESTS = Path(__file__).parents[2] / "tests"


@dataclass(frozen=True)
class Specimen:
    """`make` writes it below a folder that doesn't exist yet; `read` is a function of this file, given that folder."""

    name: str
    make: Callable[[Path], object]
    read: str


def _helpers() -> Any:
    """The tests' makers of checkpoints, which hold the golden weights of every format."""
    if str(TESTS) not in sys.path:
        sys.path.append(str(TESTS))
    import checkpoint_helpers

    return checkpoint_helpers


def observation() -> dict[str, Any]:
    """One of LIBERO's, as a robot sends it."""
    from turbopi.policy.shipped import load_frames

    frame = load_frames()[0]
    return {
        "observation/image": frame.base,
        "observation/wrist_image": frame.wrist,
        "observation/state": frame.state,
        "prompt": frame.prompt,
    }


def write_observation(file: Path) -> None:
    """An .npz of an observation, its keys as names."""
    np.savez(file, **observation())


def _openpi_torch(folder: Path) -> None:
    _helpers().torch_copy(folder)


def _openpi_jax(folder: Path) -> None:
    shutil.copytree(_helpers().GOLDEN / "pi05" / "jax", folder)


def _lerobot(folder: Path) -> None:
    _helpers().lerobot_copy(folder)
    (folder / "turbopi.json").write_text('{"vision_heads": 4}')


def _npz(folder: Path) -> None:
    folder.mkdir()
    write_observation(folder / "observation.npz")


def _by_hand(folder: Path) -> None:
    from PIL import Image

    folder.mkdir()
    seen = observation()
    Image.fromarray(seen["observation/image"]).save(folder / "table.png")
    np.save(folder / "wrist.npy", seen["observation/wrist_image"])
    state = [round(float(number), 4) for number in seen["observation/state"]]
    content = {
        "observation/image": {"file": "table.png"},
        "observation/wrist_image": {"file": "wrist.npy"},
        "observation/state": state,
        "prompt": seen["prompt"],
    }
    (folder / "observation.json").write_text(json.dumps(content))


def _recording(folder: Path) -> None:
    from turbopi.recordings import Recorder

    recorder = Recorder(folder, {"policy": "fake"})
    for number in range(2):
        actions = np.full((10, 7), number / 3)
        recorder.put(observation(), {"actions": actions, "server_timing": {"infer_ms": 1.5}}, size=1000)
    recorder.close()


def _calibration(folder: Path) -> None:
    folder.mkdir()
    _turbopi("calibrate", "--random-weights", "pi05_tiny", "--count", "2", "--steps", "1", "-o", folder / "fp8.json")


def _result(folder: Path) -> None:
    options = ("--trials", 1, "--tasks", "0", "--max-steps", 10, "--workers", 1, "--steps", 1, "--videos", "none")
    _turbopi("eval", "reacher", "--random-weights", "pi05_tiny", *options, "--out", folder)


def _noise(folder: Path) -> None:
    folder.mkdir()
    np.save(folder / "noise.npy", np.random.default_rng(0).standard_normal((10, 32), np.float32))


def _robot(folder: Path) -> None:
    folder.mkdir()
    described = {
        "name": "arm",
        "cameras": {"observation/image": "base_0_rgb"},
        "state": {"observation/state": 8},
        "action_dim": 7,
    }
    (folder / "robot.json").write_text(json.dumps(described))


def _turbopi(*arguments: object) -> None:
    from attack.server import environment

    command = [sys.executable, "-m", "turbopi", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment(), check=False)
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(command)}: {done.stderr[-1000:]}")


SPECIMENS = (
    Specimen("openpi, PyTorch", _openpi_torch, "read_checkpoint"),
    Specimen("openpi, JAX", _openpi_jax, "read_checkpoint_pi05"),
    Specimen("LeRobot", _lerobot, "read_checkpoint"),
    Specimen("observation, .npz", _npz, "read_observation_npz"),
    Specimen("observation, by hand", _by_hand, "read_observation"),
    Specimen("recording", _recording, "read_recording"),
    Specimen("calibration", _calibration, "read_calibration"),
    Specimen("result", _result, "read_result"),
    Specimen("noise", _noise, "read_noise"),
    Specimen("robot", _robot, "read_robot"),
)


# --- readers, each in a fork ------------------------------------------------------------------------------------------


def read_checkpoint(folder: str, config: str | None = None) -> None:
    """Everything of a checkpoint: settings, statistics, weights in float32."""

    def read() -> Any:
        import torch

        from turbopi.checkpoint import open_checkpoint

        checkpoint = open_checkpoint(folder, config or "auto")
        loaded = checkpoint.load(torch.device("cpu"), "f32")
        weights = {name: _bits(tensor) for name, tensor in sorted(loaded.state.items())}
        return {"config": repr(checkpoint.config), "statistics": repr(checkpoint.norm_stats), "weights": weights}

    _reported(read)


def read_checkpoint_pi05(folder: str) -> None:
    read_checkpoint(folder, "pi05_libero")


def _bits(tensor: Any) -> str:
    import torch

    return hashlib.sha256(tensor.detach().contiguous().view(torch.uint8).numpy().tobytes()).hexdigest()


def read_observation_npz(folder: str) -> None:
    read_observation(f"{folder}/observation.npz")


def read_observation(path: str) -> None:
    """The file, and what LIBERO's robot takes of it: any keys and values are an observation of some robot."""
    from turbopi.recordings import load_observation
    from turbopi.robots import create_robot

    def read() -> Any:
        observation = load_observation(path)
        create_robot("libero").inputs(observation)
        return observation

    _reported(read)


def read_recording(folder: str) -> None:
    from turbopi.recordings import iter_recording

    _reported(lambda: [[observation, actions] for observation, actions in iter_recording(folder)])


def read_calibration(folder: str) -> None:
    from turbopi.quantization.calibration_file import Quantization

    _reported(lambda: repr(Quantization.load(f"{folder}/fp8.json")))


def read_result(folder: str) -> None:
    from turbopi.evaluate.reading import load_results

    def read() -> Any:
        results = load_results(Path(folder))
        about = (results.protocol, results.policy, results.tasks, results.episodes, results.planned)
        return repr(about)

    _reported(read)


def read_noise(folder: str) -> None:
    from turbopi.cli.files import load_noise

    _reported(lambda: load_noise(Path(folder) / "noise.npy"))


def read_robot(folder: str) -> None:
    from turbopi.robots.described import load_robot

    _reported(lambda: repr(vars(load_robot(f"{folder}/robot.json"))))


def _reported(read: Callable[[], Any]) -> None:
    from turbopi.cli.framework import with_errors_reported

    with_errors_reported(lambda: print(digest(read()).hex()), debug=False)
