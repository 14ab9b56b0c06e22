"""ONNX: the exported graphs compute the reference, the folder is checked, and bad input is refused by name."""

import dataclasses
import importlib.util
import json
import os
import re
import shutil
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cli_helpers import refusal, turbopi
from conftest import golden_cases, golden_folder, golden_model
from torch import Tensor
from typer.testing import Result

from turbopi import backends
from turbopi.backends.onnx import cache as kept
from turbopi.backends.onnx import export as exporting
from turbopi.backends.onnx.backend import OnnxBackend, Sessions
from turbopi.backends.onnx.export import MANIFEST, Export, export_onnx, open_export
from turbopi.backends.onnx.graphs import graphs
from turbopi.checkpoint import open_checkpoint
from turbopi.cli.compare import parse_variant
from turbopi.cli.evaluate import EvalOptions
from turbopi.cli.options import PolicyOptions
from turbopi.config import PiKind
from turbopi.policy.policy import UnifiedPolicy
from turbopi.support.errors import BackendUnavailable, CheckpointError, ConfigError, ObservationError, OutputError
from turbopi.support.installation import install_command
from turbopi.verify.check_golden import check_case

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("two_layers")]

for library in ("onnx", "onnxscript", "onnxruntime"):
    pytest.importorskip(library)

CPU = torch.device("cpu")


@pytest.fixture(scope="module", autouse=True)
def exports(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What the backend keeps is kept for these tests alone."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv(kept.FOLDER_VARIABLE, str(tmp_path_factory.mktemp("exports")))
        yield


KINDS: tuple[PiKind, ...] = ("pi05", "pi0")


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> dict[PiKind, Path]:
    """The golden weights' exports, of Pi0.5 by the backend and of Pi0 from Python; `tiny` has one by the command."""
    pi0 = export_onnx(golden_model("pi0"), tmp_path_factory.mktemp("pi0") / "exported")
    return {"pi05": Path(golden_backend().describe()["export"]), "pi0": pi0.folder}


@pytest.fixture
def folder(exported: dict[PiKind, Path], tmp_path: Path) -> Path:
    """A copy of an export, to be damaged."""
    return Path(shutil.copytree(exported["pi05"], tmp_path / "copy"))


@lru_cache
def opened(folder: Path) -> OnnxBackend:
    return OnnxBackend.open(folder)


def fresh_inputs(kind: PiKind, graph: str, length: int, horizon: int) -> dict[str, Tensor]:
    """Random inputs of a graph, for `length` images, prompt or prefix tokens."""
    config = golden_model(kind).config
    random = torch.Generator().manual_seed(1000 * length + horizon)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=random)

    if graph == "vision":
        return {"images": torch.rand(length, 224, 224, 3, generator=random) * 2 - 1}
    if graph == "prompt":
        return {"tokens": torch.randint(config.vocab_size, (1, length), generator=random)}
    mask = torch.rand(1, length, generator=random) < 0.8
    mask[0, 0] = True
    positions = mask.cumsum(1) - 1
    if graph == "prefix":
        return {"embs": normal(1, length, config.vlm.width), "positions": positions, "mask": mask}
    vlm = config.vlm
    cache = (vlm.depth, 1, vlm.num_kv_heads, length, vlm.head_dim)
    state = {"state": normal(1, config.action_dim)} if kind == "pi0" else {}
    return {
        "x_t": normal(1, horizon, config.action_dim),
        "time_emb": normal(1, config.expert.width),
        "k": normal(*cache),
        "v": normal(*cache),
        "mask": mask,
        "positions": mask.sum(1, keepdim=True) + torch.arange(horizon + len(state)),
        **state,
    }


def reference(kind: PiKind, graph: str, inputs: dict[str, Tensor]) -> list[Tensor]:
    """What the reference's own functions make of a graph's inputs."""
    from turbopi.models.pi0.denoise import suffix_mask, suffix_rope
    from turbopi.models.pi0.kv_cache import KVCache
    from turbopi.models.pi0.prefix import embed_prompt

    model = golden_model(kind)
    if graph == "vision":
        return [model.embed_images(inputs["images"][:, None])[0]]
    if graph == "prompt":
        return [embed_prompt(model.vlm, inputs["tokens"])]
    if graph == "prefix":
        return list(model.encode_prefix(inputs["embs"], inputs["positions"], inputs["mask"][:, None, None, :]))
    state = inputs.get("state", torch.zeros(1, model.config.action_dim))
    cache = KVCache(inputs["k"], inputs["v"], inputs["mask"], inputs["mask"].sum(1), state)
    count = inputs["positions"].shape[1]
    rope = suffix_rope(cache, count, model.config.expert.head_dim, model.config.rope_base)
    mask = suffix_mask(cache, count, kind == "pi0")
    time = model.time_condition(inputs["time_emb"]) if kind == "pi05" else inputs["time_emb"]
    return [model.velocity(inputs["x_t"], state, time, cache.k, cache.v, rope, mask)[1]]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("graph", "length", "horizon"),
    [
        ("vision", 1, 0),
        ("vision", 3, 0),
        ("prompt", 1, 0),
        ("prompt", 48, 0),
        ("prefix", 1, 0),
        ("prefix", 23, 0),
        ("prefix", 968, 0),
        ("denoise_step", 1, 1),
        ("denoise_step", 23, 50),
        ("denoise_step", 968, 10),
    ],
)
def test_every_graph_computes_the_reference(
    exported: dict[PiKind, Path], kind: PiKind, graph: str, length: int, horizon: int
) -> None:
    inputs = fresh_inputs(kind, graph, length, horizon)
    outputs, expected = opened(exported[kind])._sessions.run(graph, **inputs), reference(kind, graph, inputs)
    assert len(outputs) == len(expected)
    for ours, theirs in zip(outputs, expected, strict=True):
        assert ours.shape == theirs.shape
        assert (ours - theirs).norm() <= 1e-5 * theirs.norm()


@pytest.mark.parametrize("name", sorted(golden_cases()))
def test_exported_folders_equal_openpi(exported: dict[PiKind, Path], name: str) -> None:
    case = golden_cases()[name]
    comparisons = check_case(case, opened(exported[case.kind]))
    everything = {"prefix_embs", "kv_k", "kv_v", "v_t", "x_t", "actions"}
    recorded = {tensor for run in case.runs for golden in run.variants.values() for tensor in golden}
    assert everything & recorded <= {c.tensor for c in comparisons}
    assert not [c for c in comparisons if not c.ok]


def golden_backend() -> backends.Backend:
    """The backend around the golden Pi0.5's weights."""
    checkpoint = golden_folder().checkpoint("pi05")
    return backends.create(
        "onnx",
        checkpoint.config.planned_model,
        lambda to, mode: checkpoint.load(to, mode).state,
        device=CPU,
        precision="f32",
    )


def test_the_backend_exports_the_weights_it_is_given(exported: dict[PiKind, Path]) -> None:
    """Its actions are openpi's: see above."""
    case, backend = golden_cases()["b_third_masked"], golden_backend()
    sample = backend.sample(case.observation, case.noise, 3)
    assert torch.equal(sample.actions, opened(exported["pi05"]).sample(case.observation, case.noise, 3).actions)
    assert list(sample.stage_ms) == ["vision", "prefix", "denoise"]
    about = backend.describe()
    assert about["export"] == str(exported["pi05"]) and about["runtime"].startswith("ONNX Runtime ")
    assert about["weights_sha256"] == golden_folder().checkpoint("pi05").fingerprint()


def test_an_export_is_kept_for_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exported: dict[PiKind, Path], caplog: pytest.LogCaptureFixture
) -> None:
    """And used for what it was made of alone; what isn't whole is made anew. Here exporting is copying one."""
    made: list[Path] = []

    def copied(model: Any, place: Path, *, weights: str) -> Export:
        made.append(place)
        return open_export(shutil.copytree(exported["pi05"], place))

    monkeypatch.setattr(kept, "export_onnx", copied)
    monkeypatch.setenv(kept.FOLDER_VARIABLE, str(tmp_path / "exports"))
    golden_backend()
    golden_backend()
    (place,) = made
    assert [place] == list((tmp_path / "exports").iterdir())
    (place / "vision.onnx").write_bytes(b"")
    with caplog.at_level("WARNING"):
        golden_backend()
    assert made == [place, place] and "a kept ONNX export is made anew: " in caplog.text
    monkeypatch.setattr(kept, "library_versions", lambda: {"torch": "another"})
    golden_backend()
    assert len(made) == 3 and made[2] != place


def test_another_model_has_another_export() -> None:
    """Of other weights, and of other sizes."""
    model = golden_model("pi05")
    weights = exporting.weights_sha256(model.state_dict())
    keys = {kept._key(model, weights), kept._key(model, "0" * 64), kept._key(golden_model("pi0"), weights)}
    assert len(keys) == 3


def test_a_folder_that_keeps_nothing_is_named_with_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv(kept.FOLDER_VARIABLE, str(tmp_path / "file"))
    with pytest.raises(OutputError, match="TURBOPI_EXPORTS names another folder for ONNX exports"):
        golden_backend()


def test_the_exports_that_were_used_last_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exported: dict[PiKind, Path]
) -> None:
    """And what isn't an export stays."""
    place, model = tmp_path / "exports", golden_model("pi05")
    monkeypatch.setenv(kept.FOLDER_VARIABLE, str(place))
    monkeypatch.setattr(kept, "export_onnx", lambda model, to, **_: open_export(shutil.copytree(exported["pi05"], to)))
    others = {place / "mine", place / ("0" * 32)}
    for folder in others:
        folder.mkdir(parents=True)

    def used(version: int) -> Path:
        monkeypatch.setattr(kept, "library_versions", lambda: {"torch": str(version)})
        return kept.cached_export(model).folder

    made = []
    for version in range(kept.KEPT):
        made.append(used(version))
        os.utime(made[-1], (version + 1, version + 1))
    assert used(0) == made[0]
    newest = used(kept.KEPT)  # one too many: the second wasn't used for longest
    assert {*place.iterdir()} == {*made, newest, *others} - {made[1]}


def test_halves_of_a_batch_with_unlike_rows_equal_the_whole_and_the_reference(exported: dict[PiKind, Path]) -> None:
    case, backend = golden_cases()["b_third_masked"], opened(exported["pi05"])
    one = case.observation
    other = dataclasses.replace(one, image_mask=torch.tensor([[True, False, False]]), images=one.images.flip(1))
    names = [field.name for field in dataclasses.fields(one)]
    both = dataclasses.replace(one, **{name: torch.cat([getattr(o, name)[:1] for o in (one, other)]) for name in names})
    noise = torch.randn(2, *case.noise.shape[1:], generator=torch.Generator().manual_seed(1))
    whole = backend.sample(both, noise, 4).actions
    cache = backend.prefix(both)
    assert cache.mask is not None and cache.mask.sum(1).tolist() == cache.lengths.tolist()
    torch.testing.assert_close(backend.denoise(cache, noise, 4), whole, rtol=0, atol=1e-5)
    torch.testing.assert_close(golden_model("pi05").sample(both, noise, 4), whole, rtol=0, atol=1e-5)


def test_pictures_as_bytes_are_the_same_as_floats(exported: dict[PiKind, Path]) -> None:
    case, backend = golden_cases()["a_three_cams"], opened(exported["pi05"])
    pixels = torch.randint(256, case.observation.images.shape, dtype=torch.uint8)
    as_bytes = dataclasses.replace(case.observation, images=pixels)
    as_floats = dataclasses.replace(case.observation, images=pixels.float() / 255 * 2 - 1)
    actions = [backend.sample(seen, case.noise, 1).actions for seen in (as_bytes, as_floats)]
    assert torch.equal(*actions)


def test_an_observation_of_nothing_is_refused(exported: dict[PiKind, Path]) -> None:
    case = golden_cases()["a_three_cams"]
    masks = {name: torch.zeros_like(getattr(case.observation, name)) for name in ("image_mask", "token_mask")}
    with pytest.raises(ObservationError, match="nothing to attend to"):
        opened(exported["pi05"]).prefix(dataclasses.replace(case.observation, **masks))


# -- the folder as a checkpoint ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """`turbopi export onnx` of a converted checkpoint with a robot of its own; an observation lies beside it."""
    root = tmp_path_factory.mktemp("tiny")
    arm = {"name": "my_arm", "cameras": {"front": "base_0_rgb"}, "state": {"joints": 8}, "action_dim": 7}
    (root / "my_arm.json").write_text(json.dumps(arm))
    converting = ("convert", "--random-weights", "pi05_tiny", root / "checkpoint", "--robot", root / "my_arm.json")
    for words in (converting, ("export", "onnx", root / "checkpoint", root / "exported", "--json")):
        result = turbopi(*words)
        assert result.exit_code == 0, result.output
    random = np.random.default_rng(0)
    camera_image = random.integers(0, 256, (100, 120, 3), dtype=np.uint8)
    np.savez(root / "seen.npz", front=camera_image, joints=random.normal(size=8), prompt="fold the towel")
    (root / "my_arm.json").unlink()  # the export has its own
    return result


@pytest.fixture(scope="module")
def tiny(command: Result) -> Path:
    """The folder of `command`'s checkpoint, export and observation."""
    return Path(json.loads(command.stdout)["folder"]).parent


def test_an_export_is_a_checkpoint_of_its_own(tiny: Path, tmp_path: Path) -> None:
    """Robot, statistics, tokenizer and horizon come along; the actions are the checkpoint's."""
    own = Path(shutil.copytree(tiny / "exported", tmp_path / "elsewhere"))
    assert turbopi("inspect", own).exit_code == 0
    chunks = []
    for words in ((own,), (tiny / "checkpoint", "--precision", "f32", "--device", "cpu")):
        out = tmp_path / "actions.npz"
        result = turbopi("infer", words[0], tiny / "seen.npz", *words[1:], "--seed", 1, "--out", out, "--no-plot")
        assert result.exit_code == 0, result.output
        if words[0] == own:
            assert "backend: onnx (auto: the folder holds ONNX graphs)" in result.stdout
            assert "stays for the next start" not in result.stdout
        with np.load(out) as loaded:
            chunks.append(loaded["actions"])
    assert chunks[0].shape == (10, 7)
    np.testing.assert_allclose(chunks[0], chunks[1], atol=1e-4)


def test_an_export_is_measured_and_told_by_its_hash(tiny: Path) -> None:
    bench = turbopi("bench", tiny / "exported", "--calls", 1, "--steps", 1, "--json")
    assert bench.exit_code == 0, bench.output
    (measured,) = json.loads(bench.stdout)["results"]
    assert (measured["backend"], measured["precision"]) == ("onnx", "f32") and measured["load_seconds"] > 0
    assert "no error against the float32 reference" in bench.stderr
    reported = turbopi("inspect", tiny / "exported", "--hash", "--json")
    assert json.loads(reported.stdout)["sha256"] == open_checkpoint(tiny / "checkpoint").fingerprint()


def test_the_policy_opens_an_export_and_a_server_tells_about_it(tiny: Path) -> None:
    policy = UnifiedPolicy(tiny / "exported", backend="onnx", precision="f32", device="cpu")
    assert policy.metadata["checkpoint_format"] == "onnx" and policy.metadata["robot"] == "my_arm"
    assert policy.infer(policy.example_observation(), seed=0, num_steps=1)["actions"].shape == (10, 7)


@pytest.mark.parametrize(
    "words",
    [
        ("infer", "SEEN", "--backend", "pytorch", "--device", "cpu"),
        ("convert", "NEW"),
        ("export", "onnx", "NEW"),
    ],
    ids=lambda words: words[0],
)
def test_what_needs_the_weights_names_the_backend_that_does_not(
    tiny: Path, tmp_path: Path, words: tuple[str, ...]
) -> None:
    places = {"SEEN": str(tiny / "seen.npz"), "NEW": str(tmp_path / "new")}
    command, others = words[0], [places.get(word, word) for word in words[1:]]
    at = 1 if command == "export" else 0
    result = turbopi(command, *others[:at], tiny / "exported", *others[at:])
    assert result.exit_code == 2, result.output
    assert "holds ONNX graphs, which only backend 'onnx' runs" in result.stderr
    assert "--backend onnx" in result.stderr and "the checkpoint that it was exported from" in result.stderr
    assert not (tmp_path / "new").exists()


def test_an_export_without_its_description_says_what_is_missing(tiny: Path, tmp_path: Path) -> None:
    own = Path(shutil.copytree(tiny / "exported", tmp_path / "own"))
    (own / "turbopi.json").unlink()
    assert "has no turbopi.json" in refusal(turbopi("infer", own, tiny / "seen.npz"))
    (own / "turbopi.json").write_text((tiny / "exported" / "turbopi.json").read_text())
    shutil.rmtree(own / "assets")
    assert "norm stats are missing" in refusal(turbopi("infer", own, tiny / "seen.npz"))


# -- the folder --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_the_folder_says_what_it_holds(exported: dict[PiKind, Path], kind: PiKind) -> None:
    names = {f"{graph}.onnx{data}" for graph in exporting.GRAPHS for data in ("", ".data")}
    assert {file.name for file in exported[kind].iterdir()} == names | {MANIFEST}
    export, model = open_export(exported[kind]), golden_model(kind)
    assert export.config == model.config
    manifest: dict[str, Any] = dict(export.manifest)
    assert (manifest["kind"], manifest["precision"], manifest["opset"]) == (kind, "f32", 20)
    assert manifest["weights_sha256"] == golden_folder().checkpoint(kind).fingerprint()
    assert manifest["versions"].keys() == {"turbopi", "torch", "onnx", "onnxscript"}
    step = manifest["graphs"]["denoise_step"]
    assert step["inputs"]["x_t"] == {"dtype": "float32", "shape": [1, "horizon", model.config.action_dim]}
    assert step["inputs"]["k"]["shape"][3] == "prefix"
    assert ("state" in step["inputs"]) == (kind == "pi0")


def test_every_weight_is_outside_the_graph_and_no_path_is_in_it(exported: dict[PiKind, Path]) -> None:
    import onnx

    for graph in exporting.GRAPHS:
        file = exported["pi05"] / f"{graph}.onnx"
        model = onnx.load(str(file), load_external_data=False)
        large = [w for w in model.graph.initializer if torch.Size(w.dims).numel() > 64]
        assert large and all(w.data_location == onnx.TensorProto.EXTERNAL for w in large)
        assert str(Path(exporting.__file__).parent.parent).encode() not in file.read_bytes()
    onnx.checker.check_model(str(file), full_check=True)


def test_fp8_and_fused_attention_are_not_in_the_graphs(exported: dict[PiKind, Path]) -> None:
    import onnx

    model = onnx.load(str(exported["pi05"] / "prefix.onnx"), load_external_data=False)
    kinds = {node.op_type for node in model.graph.node}
    assert {"MatMul", "Softmax"} <= kinds
    assert not kinds & {"Attention", "QuantizeLinear", "DequantizeLinear"}
    assert {node.domain for node in model.graph.node} == {""}  # standard operators alone


def test_a_folder_that_holds_something_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep me")
    with pytest.raises(CheckpointError, match="exists and isn't an empty folder; give a new one"):
        export_onnx(golden_model("pi05"), tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["mine.txt"]


def test_an_export_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(state: Any) -> str:
        raise OSError("no space left")

    one = [graph for graph in graphs(golden_model("pi05")) if graph.name == "prompt"]
    monkeypatch.setattr(exporting, "graphs", lambda model: one)
    monkeypatch.setattr(exporting, "weights_sha256", fail)
    with pytest.raises(OSError, match="no space left"):
        export_onnx(golden_model("pi05"), tmp_path / "new")
    assert not list(tmp_path.iterdir())


def test_a_model_in_bf16_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"takes a float32 model on the CPU, not torch\.bfloat16 on cpu"):
        export_onnx(golden_model("pi05", "bf16"), tmp_path / "new")


def test_a_foreign_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=f"has no {MANIFEST}: it isn't a folder that `turbopi export onnx` wrote"):
        OnnxBackend.open(tmp_path)


def test_another_format_version_is_refused(folder: Path) -> None:
    manifest = json.loads((folder / MANIFEST).read_text())
    (folder / MANIFEST).write_text(json.dumps({**manifest, "format_version": 99}))
    with pytest.raises(CheckpointError, match="format version 99, not 1; export again"):
        OnnxBackend.open(folder)


@pytest.mark.parametrize("text", ["{", "[]", "{}"])
def test_a_broken_description_is_refused(folder: Path, text: str) -> None:
    (folder / MANIFEST).write_text(text)
    with pytest.raises(CheckpointError, match=rf"{MANIFEST}.*(isn't JSON|expected).*; export again"):
        OnnxBackend.open(folder)


def test_unknown_sizes_are_refused(folder: Path) -> None:
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["sizes"]["wings"] = 2
    (folder / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(CheckpointError, match=r"its sizes aren't those of a model .*wings"):
        OnnxBackend.open(folder)


def test_a_cut_or_missing_file_is_refused(folder: Path) -> None:
    data = folder / "prefix.onnx.data"
    size = data.stat().st_size
    data.write_bytes(data.read_bytes()[:-4])
    with pytest.raises(CheckpointError, match=rf"prefix\.onnx\.data has {size - 4} bytes instead of {size}; copy"):
        OnnxBackend.open(folder)
    data.unlink()
    with pytest.raises(CheckpointError, match=r"prefix\.onnx\.data is missing; copy the whole folder or export again"):
        OnnxBackend.open(folder)


def test_a_graph_that_is_none_is_refused_by_its_name(folder: Path) -> None:
    file = folder / "vision.onnx"
    file.write_bytes(b"\xff" * file.stat().st_size)
    with pytest.raises(CheckpointError, match=r"vision\.onnx: ONNX Runtime can't load it"):
        Sessions(open_export(folder))


# -- what must be installed, and the command ---------------------------------------------------------------------------


def without(monkeypatch: pytest.MonkeyPatch, *absent: str) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *more: None if name in absent else find(name, *more))


@pytest.mark.parametrize("library", ["onnx", "onnxscript", "onnxruntime"])
def test_a_missing_library_is_named_with_what_to_install(monkeypatch: pytest.MonkeyPatch, library: str) -> None:
    assert backends.availability("onnx", CPU) is None
    without(monkeypatch, library)
    with pytest.raises(BackendUnavailable, match=re.escape(f"{library} isn't installed; {install_command('onnx')}")):
        backends.check("onnx", CPU, "f32")


def test_the_command_line_takes_the_precision_that_the_backend_has(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """bf16 is the default of every backend that has it. The same random weights are exported already: copied here."""
    copied = lambda model, to, **_: open_export(shutil.copytree(tiny / "exported", to))  # noqa: E731
    monkeypatch.setattr(kept, "export_onnx", copied)
    for requested, taken in ((None, "f32"), ("f32", "f32"), ("bf16", "bf16")):
        assert PolicyOptions(backend="onnx", precision=requested).policy_arguments()["precision"] == taken
    for backend in ("auto", "pytorch", "fused", "nothing"):
        assert PolicyOptions(backend=backend).policy_arguments()["precision"] == "bf16"
    assert parse_variant("onnx", EvalOptions()) == ("onnx", "f32", None)
    words = ("--random-weights", "pi05_tiny", "--backend", "onnx", "--steps", 1, "--device", "cpu")
    result = turbopi("demo", *words, "--frames", 1, "--report", tmp_path)
    assert "precision: f32, as onnx doesn't run in bf16" in result.stdout, result.output
    assert f"its ONNX export stays for the next start: {kept.default_folder()}" in result.stdout
    refused = turbopi("demo", *words, "--frames", 1, "--report", tmp_path, "--precision", "bf16")
    assert refused.exit_code == 2 and "backend 'onnx' doesn't run in 'bf16': only f32" in refused.stderr


def test_other_devices_and_precisions_are_refused() -> None:
    with pytest.raises(BackendUnavailable, match="it runs ONNX Runtime's CPU provider; use device 'cpu'"):
        backends.check("onnx", torch.device("cuda", 0), "f32")
    with pytest.raises(ConfigError, match="backend 'onnx' doesn't run in 'bf16': only f32"):
        backends.check("onnx", CPU, "bf16")


def test_the_command_says_what_it_wrote(command: Result) -> None:
    document = json.loads(command.stdout)
    folder = document["folder"]
    assert [line for line in command.stderr.splitlines() if line.startswith("exporting")] == [
        f"exporting {graph}" for graph in exporting.GRAPHS
    ]
    assert f"openpi_torch -> {folder}: " in command.stderr
    assert document["bytes"] == sum(document["files"].values())
    assert document["seconds"] > 0
    assert open_export(folder).manifest.items() <= document.items()


def test_random_weights_are_exported_with_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exporting, "graphs", lambda model: [one for one in graphs(model) if one.name == "prompt"])
    result = turbopi("export", "onnx", "--random-weights", "pi05_tiny", tmp_path / "tiny")
    assert result.exit_code == 0, result.output
    assert "RANDOM WEIGHTS (pi05_tiny, seed 0)" in result.stdout
    beside = {"turbopi.json", "tokenizer.model", "assets"}
    names = {"prompt.onnx", "prompt.onnx.data", MANIFEST}
    assert {file.name for file in (tmp_path / "tiny").iterdir()} == names | beside
    assert json.loads((tmp_path / "tiny" / MANIFEST).read_text())["random_weights"] == "seed 0"


def test_the_command_refuses_before_it_loads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    random = ("--random-weights", "pi05_tiny")
    assert "unknown format 'tflite'; choose one of onnx" in refusal(turbopi("export", "tflite", *random, "x"))
    assert "export onnx takes two paths, the checkpoint and the new folder" in refusal(turbopi("export", "onnx", "a"))
    (tmp_path / "mine.txt").write_text("keep me")
    assert "isn't an empty folder" in refusal(turbopi("export", "onnx", *random, tmp_path))
    without(monkeypatch, "onnxscript")
    said = refusal(turbopi("export", "onnx", *random, tmp_path / "x"))
    assert said == f"can't export to ONNX: onnxscript isn't installed; {install_command('onnx')}"
    assert not (tmp_path / "x").exists()
