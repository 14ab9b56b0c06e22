"""The shim, the engine cache, and the builder where TensorRT-RTX is installed (it builds without a GPU)."""

import dataclasses
import importlib.util
import json
import multiprocessing
import re
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from cli_helpers import refusal, turbopi
from conftest import golden_model
from file_helpers import no_room
from tensorrt_fakes import ENVIRONMENT

from turbopi.backends import tensorrt
from turbopi.backends.tensorrt.cache import CorruptEngine, EngineCache, StaleEngine
from turbopi.backends.tensorrt.engine import Input, Kernels, Specification, build
from turbopi.backends.tensorrt.networks import Fp8Scales
from turbopi.backends.tensorrt.ops import NetworkOps, Value
from turbopi.backends.tensorrt.parts import EngineShape, fingerprint
from turbopi.config import Kind
from turbopi.support.errors import BackendError, BackendUnavailable, OutputError
from turbopi.support.installation import install_command

needs_rtx = pytest.mark.skipif(importlib.util.find_spec("tensorrt_rtx") is None, reason="TensorRT-RTX isn't installed")


def specification(name: str = "part", width: int = 4, **about: object) -> Specification:
    def write(ops: NetworkOps, inputs: dict[str, Value]) -> dict[str, Value]:
        return {"y": ops.mul(inputs["x"], inputs["x"])}

    return Specification(name, {"x": Input((2, width), "f32")}, write, about)  # type: ignore[arg-type]


class Builder:
    """Counts what it builds."""

    def __init__(self, plan: bytes = b"plan") -> None:
        self.plan, self.built = plan, list[str]()

    def __call__(self, specification: Specification) -> bytes:
        self.built.append(specification.name)
        return self.plan


@pytest.fixture
def cache(tmp_path: Path) -> EngineCache:
    return EngineCache(tmp_path, ENVIRONMENT)


def test_an_engine_is_built_once(cache: EngineCache) -> None:
    builder = Builder()
    assert cache.get_or_build(specification(), builder) == (b"plan", "built")
    assert cache.get_or_build(specification(), builder) == (b"plan", "cached")
    assert builder.built == ["part"] and list(cache.names()) == ["part"]
    assert cache.get_or_build(specification(), builder, rebuild=True) == (b"plan", "built")


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"library_version": "2.0"}, "library_version '1.0' instead of '2.0'"),
        ({"library": "tensorrt"}, "library 'tensorrt_rtx' instead of 'tensorrt'"),
        ({"gpu": "Another"}, "gpu 'A GPU' instead of 'Another'"),
        ({"compute_capability": "12.0"}, "compute_capability '9.0' instead of '12.0'"),
        ({"turbopi": "0.2.0"}, "turbopi '0.1.0' instead of '0.2.0'"),
        ({"networks": "other"}, "networks 'code' instead of 'other'"),
    ],
)
def test_a_stale_engine_is_refused_with_the_reason_and_replaced(
    cache: EngineCache, changed: dict[str, str], said: str
) -> None:
    cache.get_or_build(specification(), Builder(b"old"))
    later = EngineCache(cache.root, dataclasses.replace(ENVIRONMENT, **changed))
    with pytest.raises(StaleEngine, match=said):
        later.get(specification())
    reported: list[str] = []
    assert later.get_or_build(specification(), Builder(b"new"), reported.append) == (b"new", "built")
    assert len(reported) == 1 and said in reported[0] and "building it again" in reported[0]
    assert later.get(specification()) == b"new"


def test_another_shape_or_calibration_is_stale(cache: EngineCache) -> None:
    cache.get_or_build(specification(scales=[1.0]), Builder())
    with pytest.raises(StaleEngine, match=r"inputs .*\[2, 4\].* instead of .*\[2, 8\]"):
        cache.get(specification(width=8, scales=[1.0]))
    with pytest.raises(StaleEngine, match=r"scales \[1\.0\] instead of \[2\.0\]"):
        cache.get(specification(scales=[2.0]))


def test_other_weights_share_nothing(cache: EngineCache) -> None:
    cache.get_or_build(specification(), Builder())
    other = EngineCache(cache.root, dataclasses.replace(ENVIRONMENT, weights="v" * 16))
    assert other.get(specification()) is None


def test_a_corrupt_engine_is_built_again(cache: EngineCache) -> None:
    cache.get_or_build(specification(), Builder())
    file = cache.file("part")
    file.write_bytes(file.read_bytes()[:-1] + b"N")
    with pytest.raises(CorruptEngine, match="isn't as it was written"):
        cache.get(specification())
    assert cache.get_or_build(specification(), Builder(), lambda line: None)[1] == "built"
    file.write_bytes(file.read_bytes()[:-2])
    with pytest.raises(CorruptEngine, match="an engine of 2 bytes instead of 4"):
        cache.get(specification())
    for damaged in (b"", b"{", b"[]\nplan", b'{"key": {}, "key": {}}\nplan', b'{"key": 1}\nplan'):
        file.write_bytes(damaged)
        with pytest.raises(CorruptEngine, match=r"part\.engine's first line"):
            cache.get(specification())


def test_a_build_that_fails_leaves_nothing_and_keeps_what_was_there(cache: EngineCache) -> None:
    def fail(specification: Specification) -> bytes:
        raise BackendError("out of workspace")

    with pytest.raises(BackendError, match="out of workspace"):
        cache.get_or_build(specification(), fail)
    assert not cache.folder.exists() or not list(cache.folder.iterdir())
    cache.get_or_build(specification(), Builder())
    with pytest.raises(BackendError, match="out of workspace"):
        cache.get_or_build(specification(), fail, rebuild=True)
    assert cache.get(specification()) == b"plan"


def test_a_full_disk_leaves_what_was_there(cache: EngineCache) -> None:
    with no_room(100), pytest.raises(OutputError, match=r"can't write .*part\.engine: File too large; make room"):
        cache.get_or_build(specification(), Builder(), keep=True)
    assert list(cache.folder.iterdir()) == []
    cache.get_or_build(specification(), Builder(), keep=True)
    with no_room(100), pytest.raises(OutputError):
        cache.get_or_build(specification(), Builder(b"other"), rebuild=True, keep=True)
    assert cache.get(specification()) == b"plan" and list(cache.folder.iterdir()) == [cache.file("part")]


def test_an_engine_that_cannot_be_stored_is_used_and_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    cache, reported = EngineCache(tmp_path / "file" / "engines", ENVIRONMENT), list[str]()
    assert cache.get_or_build(specification(), Builder(), reported.append) == (b"plan", "built")
    assert len(reported) == 2 and "isn't kept" in reported[1] and str(cache.folder) in reported[1], (
        "it can't be read either"
    )
    with pytest.raises(OutputError, match="can't make the folder"):
        cache.get_or_build(specification(), Builder(), keep=True)


def store(folder: Path, number: int, times: int) -> None:
    """What a process does that builds an engine over and over; each stores another plan."""
    cache = EngineCache(folder, ENVIRONMENT)
    for _ in range(times):
        cache.get_or_build(specification(), Builder(bytes([number]) * 50_000), rebuild=True)


@pytest.mark.slow
def test_an_engine_that_many_store_at_once_is_always_whole(cache: EngineCache) -> None:
    """Two processes and four threads store it, and it is read all the while: no store and no read fails."""
    store(cache.root, 255, 1)
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=spawn) as processes, ThreadPoolExecutor(4) as threads:
        stores = [processes.submit(store, cache.root, number, 25) for number in range(4)]
        stores += [threads.submit(store, cache.root, 100 + number, 25) for number in range(4)]
        reads = 0
        while not all(one.done() for one in stores):
            plan = cache.get(specification())
            assert plan is not None and len(set(plan)) == 1 and len(plan) == 50_000
            reads += 1
        for one in stores:
            one.result()
    assert reads and list(cache.folder.iterdir()) == [cache.file("part")]


def test_fingerprints_tell_weights_apart() -> None:
    state = {"a": torch.randn(3, 4), "b": torch.randn(5).bfloat16()}
    same = {name: tensor.clone() for name, tensor in reversed(state.items())}
    assert fingerprint(state) == fingerprint(same)
    swapped = {**state, "a": state["a"].flip(0)}
    nudged = {**state, "b": torch.nextafter(state["b"].float(), torch.tensor(9.0)).bfloat16() + 0.01}
    assert len({fingerprint(one) for one in (state, swapped, nudged)}) == 3


def test_a_shape_says_what_it_is() -> None:
    assert str(EngineShape(2, 48, 10)) == "2 cameras, up to 48 prompt tokens, H=10"


# -- the shim ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def nothing_imported() -> Iterator[None]:
    """As in a process that hasn't imported either library."""
    kept = {name: sys.modules.pop(name) for name in tensorrt.NAMES if name in sys.modules}
    tensorrt.library.cache_clear()
    yield
    for name in tensorrt.NAMES:
        sys.modules.pop(name, None)
    sys.modules.update(kept)
    tensorrt.library.cache_clear()


def test_no_library_is_an_error_with_the_command(monkeypatch: pytest.MonkeyPatch, nothing_imported: None) -> None:
    monkeypatch.setattr("turbopi.backends.tensorrt.importlib.util.find_spec", lambda name: None)
    said = f"neither tensorrt_rtx nor tensorrt is installed; {install_command('tensorrt')} (TensorRT-RTX"
    with pytest.raises(BackendUnavailable, match=re.escape(said)):
        tensorrt.library()


@pytest.mark.parametrize("installed", [("tensorrt_rtx", "tensorrt"), ("tensorrt",)])
def test_the_first_library_that_is_installed_is_taken(
    installed: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, nothing_imported: None
) -> None:
    for name in installed:
        (tmp_path / f"{name}.py").write_text("__version__ = '7.7'\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    found = importlib.util.find_spec
    monkeypatch.setattr(
        "turbopi.backends.tensorrt.importlib.util.find_spec", lambda name: found(name) if name in installed else None
    )
    library = tensorrt.library()
    assert (library.name, library.version, library.is_rtx) == (installed[0], "7.7", installed[0] == "tensorrt_rtx")


def test_a_library_that_cant_be_loaded_isnt_replaced_by_the_other(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, nothing_imported: None
) -> None:
    (tmp_path / "tensorrt_rtx.py").write_text("raise ImportError('libcudart.so.13: cannot open shared object file')\n")
    (tmp_path / "tensorrt.py").write_text("__version__ = '10.0'\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(BackendUnavailable, match=r"tensorrt_rtx is installed but can't be loaded \(libcudart"):
        tensorrt.library()


# -- the builder -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@needs_rtx
def test_an_engine_is_built_without_a_gpu() -> None:
    plan = build(tensorrt.library(), specification(), compute_capability="SM89")
    assert len(plan) > 1000


@pytest.mark.slow
@needs_rtx
@pytest.mark.parametrize("fp8", [False, True])
@pytest.mark.parametrize("kind", ["pi05", "pi0"])
def test_every_engine_of_a_model_is_built_without_a_gpu(kind: Kind, fp8: bool, tmp_path: Path) -> None:
    """FP8 from TensorRT-RTX 1.7 on: 1.4 asks the GPU for something."""
    if fp8 and tuple(map(int, tensorrt.library().version.split(".")[:2])) < (1, 7):
        pytest.skip("TensorRT-RTX before 1.7 builds FP8 on a GPU alone")
    from turbopi.backends.tensorrt.engines import ModelEngines
    from turbopi.engine.weights import pack

    model = golden_model(kind, "bf16")
    one_scale = Fp8Scales(*(torch.tensor(0.01) for _ in range(5)))
    engines = ModelEngines(
        model.config,
        pack(model.config, dict(model.state_dict())),
        EngineCache(tmp_path, ENVIRONMENT),
        build=lambda one: build(tensorrt.library(), one, compute_capability="SM89"),
        load=lambda one, plan: None,  # type: ignore[arg-type, return-value]
        scales=[one_scale] * (model.config.vlm.depth - 1) if fp8 else None,
    )
    shape, heard = EngineShape(2, 48, 10), list[str]()
    engines.prepare(shape, progress=heard.append)
    assert sorted(heard) == sorted(engines.cache.names())
    assert len(heard) == 2 + model.config.vlm.depth - 1
    assert engines.cached_shapes(2, 10) == [shape] and engines.cached_shapes(3, 10) == []


@pytest.mark.slow
@needs_rtx
def test_a_network_that_cant_be_built_says_why() -> None:
    def write(ops: NetworkOps, inputs: dict[str, Value]) -> dict[str, Value]:
        return {"y": ops.reshape(inputs["x"], (3, 5))}

    broken = Specification("broken", {"x": Input((2, 4), "f32")}, write)  # type: ignore[arg-type]
    with pytest.raises(BackendError, match=r"tensorrt_rtx .* can't build broken: .*"):
        build(tensorrt.library(), broken, compute_capability="SM89")


# -- the command -------------------------------------------------------------------------------------------------------


def test_build_refuses_before_it_loads(monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = ("--random-weights", "pi05_tiny")
    assert "unknown precision 'int4' for engines; choose one of bf16, fp8" in refusal(
        turbopi("build", *tiny, "--precision", "int4")
    )
    assert "--calibration is for --precision fp8" in refusal(turbopi("build", *tiny, "--calibration", "x"))
    monkeypatch.setattr("turbopi.backends.tensorrt.importlib.util.find_spec", lambda name: None)
    said = refusal(turbopi("build", *tiny, "--device", "cpu"))
    assert "can't build engines for tensorrt: neither tensorrt_rtx nor tensorrt is installed; " in said
    assert install_command("tensorrt") in said


def test_the_manifest_names_everything_an_engine_depends_on(cache: EngineCache) -> None:
    cache.get_or_build(specification(precision="f16"), Builder())
    about = json.loads(cache.file("part").read_bytes().split(b"\n")[0])
    assert about["key"].keys() == {f.name for f in dataclasses.fields(ENVIRONMENT)} | {"name", "inputs", "precision"}
    assert about["bytes"] == 4 and len(about["sha256"]) == 64


@pytest.mark.slow
@needs_rtx
def test_an_engine_that_doesnt_fit_its_workspace_is_refused(
    cache: EngineCache, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("turbopi.backends.tensorrt.engine.WORKSPACE", 1024)

    def write(ops: NetworkOps, inputs: dict[str, Value]) -> dict[str, Value]:
        return {"y": ops.matmul(inputs["x"], inputs["x"])}

    large = Specification("large", {"x": Input((512, 512), "bf16")}, write)  # type: ignore[arg-type]
    with pytest.raises(BackendError, match=r"can't build large: .*workspace.* if memory ran out, free some"):
        cache.get_or_build(large, lambda one: build(tensorrt.library(), one, compute_capability="SM89"))
    assert not list(cache.root.iterdir())


# -- compiled kernels --------------------------------------------------------------------------------------------------


class FakeRuntimeCache:
    """The library's: knows its own bytes, and gets one more kernel for each engine."""

    def __init__(self, refuses: bool) -> None:
        self.kernels, self._refuses = b"kernels", refuses

    def deserialize(self, content: bytes) -> bool:
        if not self._refuses:
            self.kernels = content
        return not self._refuses

    def serialize(self) -> bytes:
        return self.kernels


class FakeEngine:
    """Whose context compiles a kernel unless the cache has it."""

    def __init__(self, refuses: bool = False) -> None:
        self.cache = FakeRuntimeCache(refuses)
        self.compiled = 0

    def create_runtime_config(self) -> Any:
        return SimpleNamespace(create_runtime_cache=lambda: self.cache, set_runtime_cache=lambda cache: None)

    def create_execution_context(self, *config: Any) -> str:
        if config and b"mine" not in self.cache.kernels:
            self.cache.kernels += b" mine"
            self.compiled += 1
        return "context"


def started(file: Path, *, refuses: bool = False, name: str = "tensorrt_rtx") -> tuple[int, bool]:
    """How many kernels a process compiles, and whether it found some."""
    kernels, engine = Kernels(tensorrt.Library(name, "1.0", None), file), FakeEngine(refuses)
    assert kernels.context(engine, "runtime") == "context"
    kernels.keep()
    return engine.compiled, kernels.found


def test_the_next_start_finds_the_compiled_kernels(tmp_path: Path) -> None:
    file = tmp_path / "weights" / "kernels.bin"
    assert started(file) == (1, False)
    written = file.stat().st_mtime_ns
    assert started(file) == (0, True)
    assert file.stat().st_mtime_ns == written and list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize("harm", ["cut off", "another library's"])
def test_kernels_that_cant_be_used_are_compiled_again_and_replaced(
    harm: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "kernels.bin"
    started(file)
    if harm == "cut off":
        file.write_bytes(file.read_bytes()[:-1])
    assert started(file, refuses=harm != "cut off") == (1, False)
    assert "kernels are compiled again" in caplog.text
    assert started(file) == (0, True)


def test_a_cache_that_cant_be_written_costs_no_start(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("in the way")
    assert started(tmp_path / "file" / "kernels.bin") == (1, False)
    assert "compiled kernels aren't kept" in caplog.text


def test_tensorrt_itself_keeps_kernels_in_its_engines(tmp_path: Path) -> None:
    assert started(tmp_path / "kernels.bin", name="tensorrt") == (0, False)
    assert not (tmp_path / "kernels.bin").exists()
