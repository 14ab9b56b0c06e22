"""TensorRT on a real GPU: golden cases, both ways of building an engine, two observations in flight."""

import copy
import dataclasses
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import torch
from conftest import golden_cases, golden_folder, golden_model

from turbopi import backends
from turbopi.backends import tensorrt
from turbopi.backends.tensorrt.backend import TensorRTBackend
from turbopi.backends.tensorrt.calibrate import calibrate, unavailable
from turbopi.backends.tensorrt.engine import Engine, Input, Kernels, Specification, build
from turbopi.backends.tensorrt.fp8 import TensorRTFp8Backend
from turbopi.backends.tensorrt.ops import NetworkOps
from turbopi.models.pi0.denoise import time_embedding, time_grid
from turbopi.models.pi0.vision import normalize_images
from turbopi.support.errors import BackendError
from turbopi.verify.check_golden import check_case

if TYPE_CHECKING:
    from turbopi.backends.onnx.export import Export

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(tensorrt.missing() is not None, reason=f"{tensorrt.missing()}"),
]
CASES = ["a_three_cams", "b_third_masked", "e_horizon50", "p0_pi0_state"]


@pytest.fixture(autouse=True)
def engine_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """One cache for all tests of a run."""
    monkeypatch.setenv("TURBOPI_ENGINES", str(tmp_path_factory.getbasetemp() / "engines"))


def gpu() -> torch.device:
    return torch.device("cuda", torch.cuda.current_device())


def made(name: str, kind: str = "pi05") -> backends.Backend:
    checkpoint = golden_folder().checkpoint(kind)  # type: ignore[arg-type]
    config = checkpoint.config.planned_model
    return backends.create(
        name, config, lambda to, mode: checkpoint.load(to, mode).state, device=gpu(), precision="bf16"
    )


@pytest.mark.parametrize("name", ["tensorrt", "tensorrt_pipelined"])
@pytest.mark.parametrize("case", CASES)
def test_golden_cases_are_within_openpis_own_error(name: str, case: str) -> None:
    one = golden_cases()[case]
    comparisons = check_case(one, made(name, one.kind))
    assert [(c.tensor, c.relative_rms, c.bound) for c in comparisons if c.ok is False] == []
    assert any(c.ok for c in comparisons)


def test_actions_in_flight_are_those_of_one_at_a_time_bit_for_bit() -> None:
    one = golden_cases()["a_three_cams"]
    observation = one.observation.row(0)
    noises = [torch.randn(one.noise[:1].shape, generator=torch.Generator().manual_seed(i)) for i in range(12)]
    plain, pipelined = made("tensorrt"), made("tensorrt_pipelined")
    expected = [plain.sample(observation, noise, 10).actions for noise in noises]
    futures = [pipelined.submit(observation, noise, 10) for noise in noises]
    for future, actions in zip(futures, expected, strict=True):
        assert torch.equal(future.result(timeout=60).actions, actions)


@pytest.mark.parametrize("case", CASES)
def test_fp8_actions_point_the_same_way(
    case: str, monkeypatch: pytest.MonkeyPatch, record_property: Callable[[str, object], None]
) -> None:
    """Scales from ModelOpt where it is installed, else our own measurement of the same."""
    one = golden_cases()[case]
    alike = [golden_cases()[name] for name in CASES if golden_cases()[name].kind == one.kind]
    method = "modelopt" if unavailable("modelopt") is None else "max"
    model = copy.deepcopy(golden_model(one.kind))  # ModelOpt changes it
    calibration = calibrate(model, [other.observation.row(0) for other in alike], method=method)
    monkeypatch.setattr(TensorRTFp8Backend, "calibration", calibration)
    record_property("calibration", calibration.method)
    backend = made("tensorrt_fp8", one.kind)
    for steps in (run.num_steps for run in one.runs):
        ours = backend.sample(one.observation, one.noise, steps).actions
        exact = golden_model(one.kind).sample(one.observation, one.noise, steps)
        cosines = torch.nn.functional.cosine_similarity(ours.flatten(1), exact.flatten(1))
        record_property(f"steps {steps}", {"cosine": float(cosines.min()), "relative": error(ours, exact)})
        assert cosines.min() >= 0.999


@pytest.fixture(scope="module")
def exports(tmp_path_factory: pytest.TempPathFactory) -> Callable[[bool], "Export"]:
    """The golden model's export, float32 or with FP8; each is made once."""
    pytest.importorskip("onnxruntime")
    from turbopi.backends.onnx.export import export_onnx

    @cache
    def export(fp8: bool) -> "Export":
        model = golden_model("pi05")
        observed = [golden_cases()["a_three_cams"].observation.row(0)]
        folder = tmp_path_factory.mktemp("exports") / ("fp8" if fp8 else "f32")
        return export_onnx(model, folder, calibration=calibrate(model, observed) if fp8 else None)

    return export


GRAPH_CASES = [("vision", False), ("prompt", False), ("prefix", False), ("prefix", True), ("denoise_step", False)]


@pytest.mark.parametrize(("graph", "fp8"), GRAPH_CASES)
def test_an_exported_graph_is_an_engine(
    graph: str, fp8: bool, exports: Callable[[bool], "Export"], record_property: Callable[[str, object], None]
) -> None:
    """Float32 products are TF32 in TensorRT-RTX, hence the bound; FP8 is compared with ONNX Runtime's FP8."""
    from turbopi.backends.onnx.backend import Sessions
    from turbopi.backends.onnx.shapes import shapes_of
    from turbopi.backends.tensorrt.engine import build_onnx

    export = exports(fp8)
    inputs = graph_inputs(graph)
    shapes = shapes_of(export, graph, camera_images=3, prompt=21, prefix=789, horizon=10)
    assert shapes == {name: tuple(value.shape) for name, value in inputs.items()}
    exact = dict(zip(export.manifest["graphs"][graph]["outputs"], Sessions(export).run(graph, **inputs), strict=True))
    plan = build_onnx(tensorrt.library(), export.graph(graph), shapes)
    outputs = {name: torch.full(value.shape, torch.nan, device=gpu()) for name, value in exact.items()}
    on_gpu = {name: value.to(gpu()).contiguous() for name, value in inputs.items()}
    Engine(tensorrt.library(), graph, plan).run(**on_gpu, **outputs)
    torch.cuda.synchronize()
    for name, value in exact.items():
        found = error(outputs[name], value)
        record_property(name, found)
        assert found < (2e-2 if fp8 else 3e-3)


def graph_inputs(graph: str) -> dict[str, torch.Tensor]:
    """Of one observation with three cameras and 21 prompt tokens; the cache is the model's own."""
    model, observation = golden_model("pi05"), golden_cases()["a_three_cams"].observation.row(0)
    observation = dataclasses.replace(observation, token_mask=torch.arange(200)[None] < 21)
    embedded = model.embed(observation)
    mask = torch.ones(1, embedded.embs.shape[1], dtype=torch.bool)
    if graph == "vision":
        return {"images": normalize_images(observation.images[0])}
    if graph == "prompt":
        return {"tokens": observation.tokens[:, :21]}
    if graph == "prefix":
        return {"embs": embedded.embs, "positions": embedded.layout.computed_positions, "mask": mask}
    cache = model.keys_values(embedded)
    return {
        "x_t": torch.randn(1, 10, 32, generator=torch.Generator().manual_seed(0)),
        "time_emb": time_embedding(time_grid(10, model.config.time_grid)[:1], model.config.expert.width),
        "k": cache.k,
        "v": cache.v,
        "mask": mask,
        "positions": cache.lengths[:, None] + torch.arange(10),
    }


def error(ours: torch.Tensor, exact: torch.Tensor) -> float:
    return float((ours.cpu() - exact).norm() / exact.norm())


def square(width: int = 64) -> Specification:
    def write(ops: NetworkOps, inputs: Any) -> Any:
        return {"y": ops.gelu(ops.matmul(inputs["x"], inputs["x"], transpose_b=True))}

    return Specification("square", {"x": Input((width, width), "bf16")}, write)


def test_an_engine_that_is_cut_off_is_refused_with_the_librarys_words() -> None:
    library = tensorrt.library()
    plan = build(library, square())
    with pytest.raises(BackendError, match=r"can't load the engine square: .+"):
        Engine(library, "square", plan[: len(plan) // 2])


def test_compiled_kernels_are_found_by_the_next_start(tmp_path: Path) -> None:
    """And whatever is in their file, the engine runs."""
    library, file = tensorrt.library(), tmp_path / "kernels.bin"
    if not library.is_rtx:
        pytest.skip("TensorRT's engines hold their kernels")
    plan, x = build(library, square()), torch.randn(64, 64, device=gpu(), dtype=torch.bfloat16)

    def run() -> tuple[bool, torch.Tensor]:
        kernels, y = Kernels(library, file), torch.full((64, 64), torch.nan, device=gpu(), dtype=torch.bfloat16)
        engine = Engine(library, "square", plan, kernels=kernels)
        engine.run(x=x, y=y)
        torch.cuda.synchronize()
        del engine
        kernels.keep()
        return kernels.found, y

    (first_found, expected), (second_found, again) = run(), run()
    assert (first_found, second_found) == (False, True) and torch.equal(again, expected)
    file.write_bytes(file.read_bytes()[:-1])
    found, again = run()
    assert not found and torch.equal(again, expected)


def test_a_shape_that_misses_an_engine_is_an_error_that_names_both() -> None:
    one, backend = golden_cases()["a_three_cams"], made("tensorrt")
    assert isinstance(backend, TensorRTBackend)
    backend.sample(one.observation, one.noise, 1)
    part = next(iter(backend._engines._loaded.values()))
    with pytest.raises(BackendError, match=r"has tensors \[.*\], was given"):
        part.run(x=torch.zeros(3, 5, device=gpu()))
    call = next(iter(backend._calls.values()))
    vision, wrong = call.parts.vision, torch.zeros(3, 5, device=gpu(), dtype=torch.float16)
    assert vision is not None
    with pytest.raises(BackendError, match=r"was built for x torch\.float16 .*, not for torch\.float16 \[3, 5\]"):
        vision.run(x=wrong, hidden=call.hidden)
