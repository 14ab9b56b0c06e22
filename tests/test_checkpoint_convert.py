"""Converting: openpi's PyTorch layout, tensor by tensor, complete or not at all."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from checkpoint_helpers import GOLDEN, LIBERO, lerobot_copy, torch_copy, write_json
from file_helpers import no_room
from safetensors import safe_open
from safetensors.torch import load_file

from turbopi.checkpoint import convert, open_checkpoint, random_checkpoint, write_random
from turbopi.checkpoint.norm_stats import load_norm_stats
from turbopi.config import PRESETS, VisionConfig
from turbopi.support.errors import CheckpointError, ConfigError, OutputError

UNUSED = "paligemma_with_expert.gemma_expert.lm_head.weight"  # read by nothing, and zeros in what is written here


def sha256(tensor: torch.Tensor) -> str:
    return hashlib.sha256(tensor.contiguous().view(-1).view(torch.uint8).numpy().data).hexdigest()


def metadata(file: Path) -> dict[str, str]:
    with safe_open(file, "pt") as handle:
        return handle.metadata()


def assert_openpis_own(file: Path, kind: str) -> None:
    """Every tensor of openpi's file by its hash, except the unused head, which is only there."""
    expected = json.loads((GOLDEN / kind / "torch" / "tensors.json").read_text())
    written = load_file(file)
    assert written.keys() == expected["tensors"].keys()
    assert metadata(file) == expected["metadata"]
    dtypes = {torch.float32: "F32", torch.bfloat16: "BF16"}
    for name, tensor in written.items():
        theirs = expected["tensors"][name]
        assert (list(tensor.shape), dtypes[tensor.dtype]) == (theirs["shape"], theirs["dtype"])
        assert name == UNUSED or sha256(tensor)[:16] == theirs["sha256"], name
    assert not written[UNUSED].any()


def test_pi0_from_jax_is_openpis_own_conversion_bit_for_bit(tmp_path: Path) -> None:
    out = convert(GOLDEN / "pi0" / "jax", tmp_path / "out", precision="f32", config="pi0_aloha")
    assert_openpis_own(out / "model.safetensors", "pi0")


def test_pi05_from_jax_is_openpis_bfloat16_file(tmp_path: Path) -> None:
    out = convert(GOLDEN / "pi05" / "jax", tmp_path / "out", precision="bf16", config="pi05_libero")
    assert_openpis_own(out / "model.safetensors", "pi05")
    assert_openpis_own(GOLDEN / "pi05" / "torch" / "model.safetensors", "pi05")  # what the other tests read
    theirs = json.loads((GOLDEN / "pi05" / "torch" / "config.json").read_text())
    ours = json.loads((out / "config.json").read_text())
    variants = {"paligemma_variant": "custom", "action_expert_variant": "custom"}  # the golden sizes have no name
    assert ours == theirs | variants


@pytest.mark.parametrize("precision", ["f32", "bf16"])
def test_a_converted_checkpoint_opens_as_what_it_was(tmp_path: Path, precision: Any) -> None:
    source = open_checkpoint(GOLDEN / "pi05" / "jax", "pi05_libero")
    again = open_checkpoint(convert(source, tmp_path / "out", precision=precision))
    assert again.config == source.config
    assert again.fingerprint() == source.fingerprint()  # these weights are exact in bfloat16
    assert again.info()["stored_dtypes"] == [{"f32": "F32", "bf16": "BF16"}[precision]]
    stats = load_norm_stats(GOLDEN / "pi05" / "jax" / "assets" / LIBERO / "norm_stats.json")
    assert again.norm_stats.actions is not None
    assert stats.actions is not None
    assert np.array_equal(again.norm_stats.actions.q99, stats.actions.q99)  # type: ignore[arg-type]
    assert again.asset_id == LIBERO


def test_bf16_is_rounded_to_nearest_even(tmp_path: Path) -> None:
    source = open_checkpoint(GOLDEN / "pi0" / "jax", "pi0_aloha")
    converted = open_checkpoint(convert(source, tmp_path / "out", precision="bf16")).load("cpu", "f32").state
    for name, tensor in source.load("cpu", "f32").state.items():
        assert torch.equal(converted[name], tensor.bfloat16().float()), name


@pytest.mark.parametrize("mode", ["QUANTILES", "QUANTILE10", "MEAN_STD", "MIN_MAX"])
def test_a_lerobot_checkpoint_keeps_its_way_of_normalising(
    tmp_path: Path, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("turbopi.checkpoint.sizes._STANDARD_VISION", VisionConfig(width=64, num_heads=4))
    source = open_checkpoint(lerobot_copy(tmp_path / "c", mode))
    again = open_checkpoint(convert(source, tmp_path / "out", precision="bf16"))
    assert again.format == "openpi_torch"
    assert again.config == replace(source.config, asset_id="lerobot")
    assert again.config.normalization.state.startswith("lerobot_")
    assert again.fingerprint() == source.fingerprint()
    for feature in ("state", "actions"):
        ours, theirs = getattr(again.norm_stats, feature), getattr(source.norm_stats, feature)
        assert ours.available == theirs.available == ("mean", "std", "q01", "q99", "min", "max", "q10", "q90")
        assert all(np.array_equal(getattr(ours, name), getattr(theirs, name)) for name in ours.available)


def test_a_robots_file_and_the_tokenizer_come_along(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "c", preset="pi05_base", robot="arm.json")
    write_json(folder / "arm.json", {"arm": 1})
    (folder / "assets" / "paligemma_tokenizer.model").write_bytes(b"pieces")
    again = open_checkpoint(convert(folder, tmp_path / "out", precision="f32"))
    assert again.config.robot == str(tmp_path / "out" / "arm.json")
    assert json.loads(Path(again.config.robot).read_text()) == {"arm": 1}
    assert again.tokenizer_candidates == (tmp_path / "out" / "assets" / "paligemma_tokenizer.model",)


def test_an_existing_folder_is_only_used_if_empty(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "precious").write_text("data")
    (tmp_path / "file").touch()
    for taken in ("full", "file"):
        with pytest.raises(CheckpointError, match="exists and isn't an empty folder"):
            write_random(tiny(), tmp_path / taken)
    assert (tmp_path / "full" / "precious").read_text() == "data"
    (tmp_path / "empty").mkdir()
    assert (write_random(tiny(), tmp_path / "empty") / "model.safetensors").exists()


def test_a_failure_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = open_checkpoint(GOLDEN / "pi05" / "jax", "pi05_libero")
    pieces = source.source.pieces

    def failing(device: torch.device) -> Any:
        for index, piece in enumerate(pieces(device)):
            if index == 20:
                raise OSError("disk on fire")
            yield piece

    monkeypatch.setattr(source.source, "pieces", failing)
    with pytest.raises(OSError, match="disk on fire"):
        convert(source, tmp_path / "below" / "out", precision="bf16")
    assert list((tmp_path / "below").iterdir()) == []


@pytest.mark.parametrize("room", [0, 5000])
def test_a_full_disk_leaves_nothing_behind_and_is_named(room: int, tmp_path: Path) -> None:
    target, checkpoint = tmp_path / "out", open_checkpoint(GOLDEN / "pi05" / "jax", "pi05_libero")
    with no_room(room), pytest.raises(OutputError, match=f"can't write {target}: File too large; make room"):
        convert(checkpoint, target, precision="bf16")
    assert list(tmp_path.iterdir()) == []


def test_a_config_that_turbopi_json_cannot_hold_is_refused(tmp_path: Path) -> None:
    odd = PRESETS["pi05_libero"].with_model(rope_base=500.0)
    with pytest.raises(ConfigError, match=r"no place for config\.model\.rope_base, so this config can't be converted"):
        convert(GOLDEN / "pi05" / "jax", tmp_path / "out", precision="bf16", config=odd)
    assert not (tmp_path / "out").exists()


def test_an_unknown_precision_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="precision is 'fp8'; expected one of bf16, f32"):
        convert(GOLDEN / "pi05" / "jax", tmp_path / "out", precision="fp8", config="pi05_libero")  # type: ignore[arg-type]


def tiny() -> Any:
    config = PRESETS["pi05_tiny"]
    return config.with_model(vocab_size=64, vision=replace(config.planned_model.vision, depth=1))


def test_random_weights_can_be_written_to_disk(tmp_path: Path) -> None:
    out = write_random(tiny(), tmp_path / "out", precision="f32", seed=3)
    again = open_checkpoint(out)
    assert again.config == tiny()
    state = again.load("cpu", "f32").state
    made = random_checkpoint(tiny(), 3).load("cpu", "f32").state
    assert made.keys() == state.keys()
    assert all(torch.equal(made[name], state[name]) for name in made)
