"""Every file and message that is read, damaged in every way: it is read right, or refused in one line.

Each damage is seeded. What comes back from a damaged file must be what the good one gives, where the format can tell,
and sound where it can't (JSON, .npy: any number that still reads well is a number). TURBOPI_FUZZ=20 tries twenty times
as many; `python -m attack` in tools/ goes on for as long as it is let.
"""

import dataclasses
import hashlib
import json
import os
import random
import resource
import shutil
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from attack.mutators import damaged, json_texts
from checkpoint_helpers import GOLDEN, LIBERO, lerobot_copy, torch_copy, write_json
from lerobot_golden import GOLDEN as LEROBOT_GOLDEN
from lerobot_golden import GoldenCase
from PIL import Image

from turbopi.backends.onnx.export import GRAPHS, MANIFEST, open_export
from turbopi.backends.tensorrt.calibrate import Calibration
from turbopi.checkpoint import Checkpoint, open_checkpoint
from turbopi.cli.files import load_noise
from turbopi.config import LIMITS, preset
from turbopi.evaluate.reading import load_results
from turbopi.evaluate.results import Episode, PolicyDescription, Results
from turbopi.evaluate.visited import Visited
from turbopi.preprocess.normalize import Normalizer
from turbopi.preprocess.tokenizer import TINY_TOKENIZER, load_tokenizer
from turbopi.quantization.calibration_file import Quantization, SiteScale, shapes_of
from turbopi.quantization.sites import sites
from turbopi.realtime.wire import pack, unpack
from turbopi.recordings import RecordedCall, load_call, load_observation, save_call
from turbopi.robots.described import load_robot
from turbopi.sim import Task
from turbopi.support.errors import TurboPiError

FACTOR = float(os.environ.get("TURBOPI_FUZZ", "1"))
MAX_GROWTH = 700 * 2**20  # of memory, by a target with all of its damages
TINY = preset("pi05_tiny").planned_model


# -- what is read ------------------------------------------------------------------------------------------------------


def _observation() -> dict[str, Any]:
    pixels = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8)
    return {"observation/image": pixels, "observation/state": np.linspace(-1, 1, 8), "prompt": "pick up the block"}


def _checkpoint(folder: Path) -> Any:
    """The description of a checkpoint, after a look at whether a robot could be moved by it."""
    checkpoint = open_checkpoint(folder)
    _sound(checkpoint)
    stats = {name: str(dataclasses.asdict(stats)) for name, stats in _features(checkpoint)}
    return {"info": checkpoint.info(), "config": checkpoint.config, "stats": stats}


def _features(checkpoint: Checkpoint) -> Iterator[tuple[str, Any]]:
    for name in ("state", "actions"):
        stats = getattr(checkpoint.norm_stats, name)
        if stats is not None:
            yield name, stats


def _sound(checkpoint: Checkpoint) -> None:
    """Sizes within the limits, and no action mirrored or blown up by its statistics."""
    model = checkpoint.config.planned_model
    for name in ("action_horizon", "action_dim", "max_prompt_tokens"):
        assert 1 <= getattr(model, name) <= LIMITS[name]
    assert 1 <= checkpoint.config.num_denoising_steps <= LIMITS["num_denoising_steps"]
    for name, stats in _features(checkpoint):
        mode = getattr(checkpoint.config.normalization, name)
        scale = Normalizer(mode, stats, name)
        low, high = (scale.unnormalize(np.full((1, stats.dim), value)) for value in (-1.0, 1.0))
        assert np.isfinite(low).all() and (np.abs(high) < 1e10).all() and (low <= high).all(), name
        assert np.isfinite(scale.normalize(np.zeros(stats.dim))).all()


def _weights(folder: Path) -> Any:
    """As `_checkpoint`, and a hash of all weights."""
    described = _checkpoint(folder)
    state = open_checkpoint(folder).load("cpu", "f32").state
    return described, {name: hashlib.sha256(tensor.numpy().tobytes()).digest() for name, tensor in state.items()}


def _tokens(folder: Path) -> Any:
    tokenizer = load_tokenizer(folder / "tokenizer.model", vocab_size=TINY.vocab_size)
    return tokenizer.encode("Pick up the red block and put it into the basket")


def _arrays(value: Any) -> Any:
    """As plain values that compare."""
    if isinstance(value, dict):
        return {key: _arrays(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_arrays(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.dtype.str, value.shape, value.tobytes()
    return value


# -- good files --------------------------------------------------------------------------------------------------------


def _calibration(folder: Path) -> None:
    entries = {str(site): SiteScale(0.01, 4.0, 0.0, 0.03) for site in sites(TINY)[:3]}
    report = {"observations": {"source": "recordings", "count": 4, "calibration": {"a": "b"}}, "warnings": ["one"]}
    Quantization("f" * 64, shapes_of(TINY), entries, report).save(folder / "fp8.json")


def _results(folder: Path) -> None:
    results = Results(
        folder,
        {"simulator": "reacher", "suite": "reacher", "sim": {"seed": 7}, "replan": 5},
        PolicyDescription("tiny", {"precision": "bf16"}, {"backend_details": {}}),
        [Task(0, "reach", "reach the target", 3, 20)],
        {"simulator": {"name": "reacher"}},
        {"workers": 1},
    )
    results.planned = {(0, 0), (0, 1)}
    results.episodes[0, 0] = Episode(0, 0, "success", 12, 2**63, 1.5, [1.0, 2.0], [0.5], [1], None, "videos/a.mp4")
    results.save()


def _export(folder: Path) -> None:
    files = {f"{graph}.onnx": 4 for graph in GRAPHS}
    for name in files:
        (folder / name).write_bytes(b"onnx")
    end = {"x": {"dtype": "float32", "shape": [1, "prompt", "horizon + 1"]}}
    manifest = {
        "format_version": 1,
        "opset": 20,
        "sizes": dataclasses.asdict(TINY),
        "graphs": {name: {"inputs": end, "outputs": end} for name in GRAPHS},
        "weights_sha256": "f" * 64,
        "versions": {"torch": "2.8"},
        "files": files,
    }
    write_json(folder / MANIFEST, manifest)


def _robot(folder: Path) -> None:
    described = {
        "name": "arm",
        "cameras": {"image": "base_0_rgb"},
        "state": {"state": 8},
        "action_dim": 7,
        "delta_action_dims": [6, -1],
        "reset_pose": [0.0, 1.0],
        "default_prompt": "go",
    }
    write_json(folder / "robot.json", described)


def _by_hand(folder: Path) -> None:
    observation = _observation()
    Image.fromarray(observation["observation/image"]).save(folder / "a.png")
    np.save(folder / "a.npy", observation["observation/image"])
    described = {
        "observation/image": {"file": "a.png", "layout": "chw"},
        "observation/wrist_image": {"file": "a.npy"},
        "observation/state": [0.0, 0.5, 1],
        "prompt": "go",
    }
    write_json(folder / "observation.json", described)


def _shards(folder: Path) -> None:
    torch_copy(folder / "c")
    checkpoint = folder / "c"
    (checkpoint / "model.safetensors").rename(checkpoint / "model-00001-of-00001.safetensors")
    names = ["action_in_proj.weight", "action_in_proj.bias", "time_mlp_in.weight"]
    index = {"metadata": {"total_size": 1}, "weight_map": dict.fromkeys(names, "model-00001-of-00001.safetensors")}
    write_json(checkpoint / "model.safetensors.index.json", index)


def _settings(folder: Path) -> None:
    everything = {
        "name": "mine",
        "robot": "libero",
        "robot_options": {},
        "normalization": {"state": "quantile", "actions": "quantile"},
        "discrete_state_input": False,
        "action_horizon": 10,
        "max_prompt_tokens": 48,
        "asset_id": LIBERO,
        "default_prompt": "go",
        "image_resize": "openpi",
        "time_grid": "accumulated",
        "num_denoising_steps": 5,
    }
    torch_copy(folder / "c", **everything)


def _lerobot(folder: Path) -> None:
    lerobot_copy(folder / "c")
    write_json(folder / "c" / "turbopi.json", {"vision_heads": 4})


def _jax(folder: Path) -> None:
    shutil.copytree(GOLDEN / "pi05" / "jax", folder / "c")
    write_json(folder / "c" / "turbopi.json", {"preset": "pi05_libero"})


def _torch(folder: Path) -> None:
    torch_copy(folder / "c")


def _peft(folder: Path) -> None:
    GoldenCase(LEROBOT_GOLDEN / "peft").assemble(folder).rename(folder / "c")


def _file(name: str, content: Any) -> Callable[[Path], None]:
    return lambda folder: content(folder / name)


# -- the targets -------------------------------------------------------------------------------------------------------

Damages = Callable[[Path, random.Random, int], Iterator[tuple[str, bytes]]]


def _as_json(file: Path, draw: random.Random, count: int) -> Iterator[tuple[str, bytes]]:
    return json_texts(json.loads(file.read_text()), draw, count)


def _as_bytes(file: Path, draw: random.Random, count: int) -> Iterator[tuple[str, bytes]]:
    return damaged(file.read_bytes(), draw, count)


def _header(file: Path, draw: random.Random, count: int) -> Iterator[tuple[str, bytes]]:
    """Of safetensors: its header's bytes, and values of it as JSON with the length made right."""
    data = file.read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    yield from damaged(data, draw, count // 2, until=8 + length)
    header = json.loads(data[8 : 8 + length])
    few = {name: header[name] for name in sorted(header)[:3]}
    for how, text in json_texts(few, draw, count // 2):
        rest = json.dumps({name: value for name, value in header.items() if name not in few}).encode()
        whole = text[:-1] + b"," + rest[1:] if text.endswith(b"}") and len(text) > 2 else text
        yield how, struct.pack("<Q", len(whole)) + whole + data[8 + length :]
    for claimed in (0, 1, length - 1, length + 1, 2**32, 2**63, 2**64 - 1):
        yield f"a header of {claimed} bytes", struct.pack("<Q", claimed) + data[8:]


@dataclasses.dataclass(frozen=True)
class Target:
    """A file, who reads it, and how it is damaged.

    exact   the format can tell damage to what is read: what comes back must be what the good file gives
    """

    name: str
    make: Callable[[Path], Any]
    file: str
    read: Callable[[Path], Any]
    damages: Damages
    count: int
    exact: bool = False


def _in(name: str, read: Callable[[Path], Any]) -> Callable[[Path], Any]:
    return lambda folder: read(folder / name)


STATS = f"c/assets/{LIBERO}/norm_stats.json"
TARGETS = (
    Target("turbopi.json", _settings, "c/turbopi.json", _in("c", _checkpoint), _as_json, 150),
    Target("openpi's config.json", _torch, "c/config.json", _in("c", _checkpoint), _as_json, 60),
    Target("norm_stats.json", _torch, STATS, _in("c", _checkpoint), _as_json, 120),
    Target("shard index", _shards, "c/model.safetensors.index.json", _in("c", _checkpoint), _as_json, 60),
    Target("safetensors", _torch, "c/model.safetensors", _in("c", _checkpoint), _header, 80
    ),
    Target("LeRobot's config.json", _lerobot, "c/config.json", _in("c", _checkpoint), _as_json, 150),
    Target("preprocessor", _lerobot, "c/policy_preprocessor.json", _in("c", _checkpoint), _as_json, 150),
    Target("postprocessor", _lerobot, "c/policy_postprocessor.json", _in("c", _checkpoint), _as_json, 80),
    Target("LeRobot's statistics", _lerobot, "c/post.safetensors", _in("c", _checkpoint), _header, 60),
    Target("LeRobot's statistics, all", _lerobot, "c/post.safetensors", _in("c", _checkpoint), _as_bytes, 60),
    Target("adapter_config.json", _peft, "c/adapter_config.json", _in("c", _checkpoint), _as_json, 80),
    Target("Orbax, manifest", _jax, "c/params/manifest.ocdbt", _in("c", _checkpoint), _as_bytes, 40, exact=True),
    Target("Orbax, index", _jax, "c/params/d/63ff17d0a518236851309ba13881af66", _in("c", _weights), _as_bytes, 24,
           exact=True),
    Target("calibration", _calibration, "fp8.json", _in("fp8.json", Quantization.load), _as_json, 250),
    Target("calibration of engines", lambda f: _engines(f), "calibration.json", lambda f: _scales(f), _as_json, 120),
    Target("export", _export, MANIFEST, lambda f: open_export(f).config, _as_json, 200),
    Target("robot", _robot, "robot.json", _in("robot.json", load_robot), _as_json, 300),
    Target("results", _results, "results.json", lambda f: load_results(f).summary(), _as_json, 300),
    Target("tokenizer", _file("tokenizer.model", lambda f: shutil.copy(TINY_TOKENIZER, f)), "tokenizer.model", _tokens,
           _as_bytes, 120),
    Target("observation.json", _by_hand, "observation.json", lambda f: _arrays(load_observation(f)), _as_json, 200),
    Target("image", _by_hand, "a.png", lambda f: load_observation(f)["prompt"], _as_bytes, 150),
    Target("array", _by_hand, "a.npy", lambda f: load_observation(f)["prompt"], _as_bytes, 150),
    Target("observation.npz", lambda f: np.savez_compressed(f / "a.npz", **_observation()), "a.npz",
           lambda f: _arrays(load_observation(f / "a.npz")), _as_bytes, 400, exact=True),
    Target("noise", lambda f: np.save(f / "n.npy", np.ones((10, 32), np.float32)), "n.npy",
           lambda f: load_noise(f / "n.npy").shape, _as_bytes, 200),
    Target("noise in an npz", lambda f: np.savez(f / "n.npz", noise=np.ones((10, 32), np.float32)), "n.npz",
           lambda f: _arrays(load_noise(f / "n.npz")), _as_bytes, 300, exact=True),
    Target("recording",
           lambda f: save_call(f / "0.npz", RecordedCall(_observation(), {"actions": np.ones((2, 7))}, 1.0)), "0.npz",
           lambda f: _arrays(dataclasses.asdict(load_call(f / "0.npz"))), _as_bytes, 400, exact=True),
    Target("visited", lambda f: _visited(f), "visited.npz", lambda f: _arrays(Visited(f).entries),
           _as_bytes, 200, exact=True),
    Target("message", lambda f: (f / "m").write_bytes(pack(_observation())), "m",
           lambda f: _arrays(unpack((f / "m").read_bytes())), _as_bytes, 2000),
)  # fmt: skip


def _engines(folder: Path) -> None:
    layer = dict.fromkeys(("input", "hidden", "gate", "up", "down"), 0.5)
    write_json(
        folder / "calibration.json", {"method": "max", "observations": 4, "source": "here", "scales": [layer, None]}
    )


def _scales(folder: Path) -> Any:
    found = Calibration.find(folder)
    assert found is not None
    return [None if one is None else [float(one.input), float(one.down)] for one in found.scales]


def _visited(folder: Path) -> None:
    entry: dict[str, Any] = {
        "observation/state": np.ones(8),
        "seed": np.array(7, np.uint64),
        "actions": np.ones((2, 7)),
    }
    stored = {f"0|{name}": value for name, value in entry.items()}
    np.savez_compressed(folder / "visited.npz", seen=1, count=1, **stored)


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_whatever_is_damaged_is_read_right_or_refused_in_one_line(target: Target, tmp_path: Path) -> None:
    target.make(tmp_path)
    right = target.read(tmp_path)
    file = tmp_path / target.file
    content = file.read_bytes()
    draw = random.Random(target.name)
    before, faults, refused = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, [], 0
    for how, damaged_content in target.damages(file, draw, int(target.count * FACTOR)):
        file.write_bytes(damaged_content)
        try:
            found = target.read(tmp_path)
            if target.exact and found != right:
                faults.append(f"{how}: read as something else in silence")
        except TurboPiError as error:
            refused += 1
            message = str(error)
            if "\n" in message or not 10 < len(message) < 2000 or not message.isprintable():
                faults.append(f"{how}: {message[:300]!r}")
        except BaseException as error:
            faults.append(f"{how}: {type(error).__name__} {str(error)[:300]}")
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    assert not faults, f"{len(faults)}:\n" + "\n".join(faults[:40])
    assert refused
    assert grown < MAX_GROWTH
    file.write_bytes(content)
    assert target.read(tmp_path) == right
