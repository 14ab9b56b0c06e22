"""A folder whose weights stay in eight bits: the bits of a policy that rounds by itself, and what is refused of it."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from cli_helpers import refusal, turbopi
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from test_engine import answer, made_up, shape_of
from test_engine_weight_placement import FULL_BYTES, LIMIT, SMALL, numbers_of, peak_bytes
from torch import Tensor

from turbopi import UnifiedPolicy
from turbopi.backends.fused import FusedBackend
from turbopi.checkpoint import Checkpoint, open_checkpoint, write_random
from turbopi.checkpoint.calibration import for_policy
from turbopi.checkpoint.quantized_folder import MANIFEST, TENSORS, QuantizedOnly, sealed
from turbopi.cli.capabilities import check_server
from turbopi.cli.options import PolicyOptions
from turbopi.config import PolicyConfig
from turbopi.engine.call import Cache, Images, StaticCall
from turbopi.engine.quantized_writer import write_quantized
from turbopi.engine.weight_placement import WeightPlacement
from turbopi.engine.weights import Weights, modulation
from turbopi.kernels.plain import PLAIN
from turbopi.quantization.calibration_file import Quantization, SiteScale, shapes_of
from turbopi.quantization.directions import directions
from turbopi.quantization.formats import Numbers
from turbopi.quantization.plan import KEPT_TIERS, Tier
from turbopi.quantization.sites import sites
from turbopi.serve.options import ServerOptions
from turbopi.support.errors import BackendUnavailable, CalibrationError, CheckpointError, ConfigError

CPU = torch.device("cpu")


def calibration(checkpoint: Checkpoint, numbers: Numbers = "fp8", kept: str = "prefix.0.out") -> Quantization:
    """Made-up scales, some sites with directions, one kept in bfloat16."""
    config, entries = checkpoint.config.planned_model, {}
    for number, site in enumerate(sites(config)):
        rows = torch.randn(20, site.width, generator=torch.Generator().manual_seed(number))
        common = directions(rows) if number % 3 == 0 else None
        reason = "its error" if str(site) == kept else None
        entries[str(site)] = SiteScale(0.01 + number / 1000, 4.0, 0.0, 0.03, reason, common)
    error = {"relative_rms": 0.01, "delta_cosine": 0.999}
    report: Any = {"observations": {"source": "recordings"}, "warnings": [], "target": 0.9975}
    report["held_out"] = {"fp8": error, "fp8-f16sums": error}
    return Quantization(checkpoint.fingerprint(), shapes_of(config), entries, report, numbers)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint with both calibrations beside it, and a folder of each precision."""
    root = tmp_path_factory.mktemp("quantized")
    assert turbopi("convert", "--random-weights", "pi05_tiny", root / "own").exit_code == 0
    for numbers in ("fp8", "int8"):
        calibration(open_checkpoint(root / "own"), numbers).save(root / "own" / f"turbopi_{numbers}.json")
    for tier in KEPT_TIERS:
        made = turbopi("convert", root / "own", root / tier, "--precision", tier, "--device", "cpu", "--json")
        assert made.exit_code == 0, made.output
        assert json.loads(made.stdout)["precision"] == tier
    return root


def backend_of(folder: Path, tier: Tier) -> FusedBackend:
    """`fused` with a checkpoint's weights, on a CPU, which can't run it."""
    checkpoint = open_checkpoint(folder)
    backend = FusedBackend.__new__(FusedBackend)
    backend.config, backend.device, backend.precision = checkpoint.config.planned_model, CPU, tier
    backend._quantization = for_policy(None, tier, checkpoint)
    assert backend._quantization is not None
    backend._plan, backend._kernels = backend._quantization.plan(backend.config, tier), {}
    backend._weights = backend._pack(lambda room, precision: checkpoint.load(room, precision).state)
    return backend


def same_bits(ours: Any, theirs: Any) -> int:
    """That all their numbers are equal to the last bit; how many tensors are in eight bits."""
    mine, others = ([one for one in numbers_of(some) if one.numel()] for some in (ours, theirs))
    pairs = list(zip(mine, others, strict=True))
    for one, other in pairs:
        assert one.dtype == other.dtype and one.shape == other.shape
        assert torch.equal(one.contiguous().view(torch.uint8), other.contiguous().view(torch.uint8))
    return sum(one.element_size() == 1 for one, _ in pairs)


def actions(weights: Weights, config: Any) -> Tensor:
    """Of the engine's plain operations."""
    observation, noise = made_up("pi05", 2, 5)
    shape = shape_of(observation, noise[:, : config.action_horizon, : config.action_dim], 2)
    cache = Cache.allocate(config, shape.prefix_slots(config) + 64, CPU, torch.bfloat16)
    images = Images(config, weights, PLAIN, shape.cameras, shape.float_images, shape.prompt_slots)
    table = modulation(config, weights.conditioning, 2)
    call = StaticCall(config, weights, PLAIN, shape, images, cache, table)
    return answer(call, observation, noise)


@pytest.mark.parametrize("tier", KEPT_TIERS)
def test_the_weights_are_to_the_last_bit_those_of_the_checkpoint_and_its_calibration(tiny: Path, tier: Tier) -> None:
    own, kept = backend_of(tiny / "own", tier), backend_of(tiny / tier, tier)
    assert own._plan is not None and not own._kept_expert
    rounded = [place for place in own._plan.rounded if not place.startswith("expert.")]
    assert same_bits(kept._weights, own._weights) == len(rounded) > 4
    assert bool(kept._kept_expert) == (tier != "fp8-mlp")
    for matrix in kept._kept_expert.values():  # copied: a file that is overwritten ends a process that has it mapped
        assert matrix.data.untyped_storage().nbytes() == matrix.data.numel()
    for hopper in (True, False) if tier != "int8" else (False,):
        own._on_hopper = kept._on_hopper = hopper
        packed, expected = (one._packed(one._weights.expert) for one in (kept, own))
        assert packed.weights.element_size() == (2 if tier == "fp8-mlp" else 1)
        same_bits(packed, expected)
    if tier == "fp8":
        assert same_bits(kept._in_fp8(kept._weights.expert), own._in_fp8(own._weights.expert)) > 4
    assert torch.equal(actions(kept._weights, kept.config), actions(own._weights, own.config))


def test_the_folder_is_half_as_large_and_says_what_it_is(tiny: Path) -> None:
    info = json.loads(turbopi("inspect", tiny / "int8", "--hash", "--json").stdout)
    assert info["sha256"] == open_checkpoint(tiny / "own").fingerprint() and info["format"] == "quantized"
    assert (
        "I8" in info["stored_dtypes"] and info["random_weights"] and "weights in int8, rounded on CPU" in info["notes"]
    )
    with safe_open(tiny / "fp8" / TENSORS, "pt") as file:
        assert "prefix.0.gate_up.codes" in file.keys() and "vlm.layers.0.mlp.up_proj.weight" not in file.keys()  # noqa: SIM118
    assert turbopi("inspect", tiny / "fp8").exit_code == 0


REFUSED: dict[str, Callable[[Path, Path], tuple[object, ...]]] = {
    "another precision": lambda kept, new: ("bench", kept, "--precisions", "bf16", "--backends", "pytorch"),
    "another backend": lambda kept, new: ("bench", kept, "--backends", "emulated_fp8"),
    "the float32 reference": lambda kept, new: ("verify", kept, "--precision", "fp8", "--backend", "emulated_fp8"),
    "calibrating again": lambda kept, new: ("calibrate", kept, "--out", new, "--count", 2),
    "conversion": lambda kept, new: ("convert", kept, new),
    "the same conversion": lambda kept, new: ("convert", kept, new, "--precision", "fp8", "--device", "cpu"),
    "an export": lambda kept, new: ("export", "onnx", kept, new),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_such_a_folder_cannot_do_is_refused_by_name(tiny: Path, tmp_path: Path, what: str) -> None:
    result = turbopi(*REFUSED[what](tiny / "fp8", tmp_path / "new"))
    assert result.exit_code == 2, result.output
    assert "keeps its weights in fp8, which backend 'fused' alone runs" in result.stderr.replace(
        "--backend fused", "backend 'fused'"
    )
    assert "take the checkpoint that it was made from" in result.stderr and not (tmp_path / "new").exists()


def test_the_policy_takes_the_folders_precision_unless_another_is_given(tiny: Path) -> None:
    only = "can't run on cpu: int8 needs an NVIDIA GPU of compute capability 8.x, 9.0 or 12.x. "
    with pytest.raises(BackendUnavailable, match=f"{only}.* keeps its weights in int8 alone: .*made from$"):
        UnifiedPolicy(tiny / "int8", device="cpu")
    with pytest.raises(QuantizedOnly, match="keeps its weights in int8"):
        UnifiedPolicy(tiny / "int8", device="cpu", backend="cuda_graph")
    with pytest.raises(QuantizedOnly, match="keeps its weights in int8"):
        UnifiedPolicy(tiny / "int8", device="cpu", precision="f32")


@pytest.mark.parametrize("command", ["serve --port 0", "bench", "eval chase", "verify"])
def test_every_command_says_that_the_folder_has_one_precision(tiny: Path, command: str) -> None:
    refused = turbopi(*command.split(), tiny / "int8", "--device", "cpu")
    assert refused.exit_code == 2 and "keeps its weights in int8" in refused.stderr
    assert "take the checkpoint that it was made from" in refused.stderr


def test_a_fleet_elsewhere_may_run_what_this_machine_cannot(tiny: Path) -> None:
    options = PolicyOptions(backend="pytorch", precision="bf16", device="cpu")
    server = ServerOptions(execution="rtc", control_hz=50.0)
    check_server(server, options, open_checkpoint(tiny / "fp8"), here=False)


def test_doctor_speaks_of_the_precision_that_the_folder_keeps(tiny: Path) -> None:
    document = json.loads(turbopi("doctor", "--checkpoint", tiny / "fp8", "--device", "cpu", "--json").stdout)
    rows = {row["name"]: row for row in document["checks"]}
    assert document["precision"] == "fp8" and document["auto"] == "fused" and not document["auto_runs"]
    able = {one["name"]: one["reason"] for one in document["backends"]}
    assert "fp8, which backend 'fused' alone runs" in able["pytorch"] and "NVIDIA GPU" in able["fused"]
    assert rows["memory"]["found"].endswith("this checkpoint takes 9 MB in fp8")
    assert rows["precision"]["level"] == "FAIL" and "fp8 needs an NVIDIA GPU" in rows["precision"]["found"]
    given = turbopi("doctor", "--checkpoint", tiny / "fp8", "--device", "cpu", "--precision", "bf16", "--json")
    assert json.loads(given.stdout)["precision"] == "bf16"


def test_another_calibration_is_refused(tiny: Path, tmp_path: Path) -> None:
    other = calibration(open_checkpoint(tiny / "own"), kept="vision.0.qkv")
    with pytest.raises(ConfigError, match="was made with the calibration that lies in it"):
        for_policy(other, "fp8", open_checkpoint(tiny / "fp8"))
    with pytest.raises(ConfigError, match="of other parts: leave it out"):
        for_policy(calibration(open_checkpoint(tiny / "own")).only(["vision"]), "fp8", open_checkpoint(tiny / "fp8"))
    folder = Path(shutil.copytree(tiny / "fp8", tmp_path / "copy"))
    other.save(folder / "turbopi_fp8.json")
    with pytest.raises(CheckpointError, match=r"isn't the calibration that .* was made with"):
        open_checkpoint(folder)


def test_what_is_not_as_it_was_written_is_refused(tiny: Path, tmp_path: Path) -> None:
    manifest = json.loads((tiny / "fp8" / MANIFEST).read_text())
    for change, says in (
        ({"version": 2}, "has version 2 of turbopi-quantized-weights, this Turbo-Pi reads version 1: convert"),
        ({"format": "other"}, "format is 'other'; expected one of turbopi-quantized-weights"),
        ({"precision": "bf16"}, "precision is 'bf16'"),
        ({"precision": "int8"}, "calibration_file is 'turbopi_fp8.json'; expected one of|expected turbopi_int8.json"),
        ({"bytes": 5}, "bytes instead of 5. Copy the whole folder, or convert the checkpoint anew"),
        ({"weights_sha256": "0" * 64}, "was made for other weights"),
        ({"sizes": {**manifest["sizes"], "vlm": 3}}, "sizes aren't those of a model"),
    ):
        folder = Path(shutil.copytree(tiny / "fp8", tmp_path / "copy", dirs_exist_ok=True))
        (folder / MANIFEST).write_text(json.dumps(sealed(manifest | change)))
        with pytest.raises((CheckpointError, CalibrationError), match=says):
            open_checkpoint(folder)
    (folder / MANIFEST).write_text(json.dumps(manifest | {"sizes": {**manifest["sizes"], "rope_base": 100.0}}))
    with pytest.raises(CheckpointError, match=r"was changed since it was written\. Copy the whole"):
        open_checkpoint(folder)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("prefix.0.qkv.scale", None, "prefix.0.qkv.scale is missing, expected"),
        ("prefix.0.qkv.codes", torch.zeros(3, 3), "expected \\('F8_E4M3'"),
        ("more", torch.zeros(2), "more is .* expected nothing of that name"),
    ],
)
def test_other_tensors_are_refused(tiny: Path, tmp_path: Path, name: str, value: Tensor | None, says: str) -> None:
    with pytest.raises(CheckpointError, match=says):
        open_checkpoint(changed(tiny / "fp8", tmp_path, {name: value}))


@pytest.mark.parametrize(
    ("name", "says"), [("prefix.0.qkv.scale", "isn't all positive, finite"), ("projector.weight", "NaN or infinite")]
)
def test_damaged_numbers_are_refused_when_they_are_loaded(tiny: Path, tmp_path: Path, name: str, says: str) -> None:
    damaged = load_file(tiny / "fp8" / TENSORS)[name]
    damaged[0] = torch.nan
    changed(tiny / "fp8", tmp_path, {name: damaged})
    with pytest.raises(CheckpointError, match=says):
        backend_of(tmp_path / "fp8", "fp8")


def test_numbers_that_look_right_are_found_by_their_hash(tiny: Path, tmp_path: Path) -> None:
    assert turbopi("inspect", tiny / "fp8", "--hash").exit_code == 0
    folder = Path(shutil.copytree(tiny / "fp8", tmp_path / "copy"))
    content = bytearray((folder / TENSORS).read_bytes())
    content[-1] ^= 1
    (folder / TENSORS).write_bytes(content)
    result = turbopi("inspect", folder, "--hash")
    assert result.exit_code != 0 and "quantized.safetensors is damaged" in result.stderr


def changed(folder: Path, to: Path, tensors: dict[str, Tensor | None]) -> Path:
    """A copy with other tensors, whose manifest agrees."""
    copy = Path(shutil.copytree(folder, to / folder.name))
    all_of_them: dict[str, Tensor | None] = {**load_file(copy / TENSORS), **tensors}
    save_file({name: one for name, one in all_of_them.items() if one is not None}, copy / TENSORS)
    manifest = sealed(json.loads((copy / MANIFEST).read_text()) | {"bytes": (copy / TENSORS).stat().st_size})
    (copy / MANIFEST).write_text(json.dumps(manifest))
    return copy


def test_a_folder_is_written_whole_or_not_at_all(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object) -> None:
        raise OSError("no room")

    monkeypatch.setattr("turbopi.checkpoint.tensor_file.TensorFile.write", fail)
    result = turbopi("convert", tiny / "own", tmp_path / "new", "--precision", "fp8", "--device", "cpu")
    assert result.exit_code != 0 and not list(tmp_path.iterdir())


def test_writing_and_loading_hold_a_few_matrices(tmp_path: Path) -> None:
    """Of a model in full Pi0.5's proportions."""
    own = write_random(PolicyConfig("small", SMALL, "plain"), tmp_path / "own")
    checkpoint, folder = open_checkpoint(own), tmp_path / "fp8"
    made = calibration(checkpoint, kept="none")
    made = replace(made, sites={name: replace(site, directions=None) for name, site in made.sites.items()})
    file = own / "model.safetensors"
    scale = file.stat().st_size / FULL_BYTES
    written = peak_bytes(lambda: write_quantized(checkpoint, folder, made, "fp8", CPU), file)
    assert written / scale < LIMIT
    kept = open_checkpoint(folder)
    room = WeightPlacement(SMALL, CPU, lambda name: True, lambda place, matrix: matrix, precision="fp8")
    loaded = peak_bytes(lambda: kept.load(room, "bf16"), folder / TENSORS)
    of_the_device = [one.nbytes for one in room.made.values() if isinstance(one, Tensor)]  # vision, 72 wide
    assert (loaded - sum(of_the_device) - 2 * SMALL.vocab_size * SMALL.vlm.width) / scale < LIMIT


def test_conversions_that_cannot_be_are_refused_before_any_work(tiny: Path, tmp_path: Path) -> None:
    new = tmp_path / "new"
    assert "--device only applies to --precision" in refusal(turbopi("convert", tiny / "own", new, "--device", "cpu"))
    for preset, says in {
        "smolvla_base": "policy, and this is for Pi0 and Pi0.5 alone",
        "pi05_tiny": "needs a calibration: run `turbopi calibrate --precision int8`",
    }.items():
        result = turbopi("convert", "--random-weights", preset, new, "--precision", "int8")
        assert result.exit_code == 2 and says in result.stderr and not new.exists()


def test_the_commands_options_become_the_folders(tiny: Path) -> None:
    from turbopi.cli.options import PolicyOptions

    options = PolicyOptions().for_checkpoint(open_checkpoint(tiny / "fp8-mlp"))
    assert options.policy_arguments()["precision"] == "fp8-mlp"
    given = replace(PolicyOptions(), precision="fp8")
    assert given.for_checkpoint(open_checkpoint(tiny / "fp8-mlp")) == given
