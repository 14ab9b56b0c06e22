"""TensorRT on a real GPU: golden cases, both ways of building an engine, two observations in flight."""

from pathlib import Path

import pytest
import torch
from conftest import golden_cases, golden_folder, golden_model

from turbopi import backends, tensorrt
from turbopi.backends.tensorrt import TensorRTBackend
from turbopi.backends.tensorrt_fp8 import TensorRTFp8Backend
from turbopi.errors import BackendError
from turbopi.judge.check_golden import check_case
from turbopi.observation import Observation
from turbopi.tensorrt.calibrate import calibrate

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
    config = checkpoint.config.model
    return backends.create(
        name, config, lambda to, mode: checkpoint.load(to, mode).state, device=gpu(), precision="bf16"
    )


def first(observation: Observation) -> Observation:
    return Observation(*(getattr(observation, name)[:1] for name in observation.__dataclass_fields__))


@pytest.mark.parametrize("name", ["tensorrt", "tensorrt_pipelined"])
@pytest.mark.parametrize("case", CASES)
def test_golden_cases_are_within_openpis_own_error(name: str, case: str) -> None:
    one = golden_cases()[case]
    comparisons = check_case(one, made(name, one.kind))
    assert [(c.tensor, c.relative_rms, c.bound) for c in comparisons if c.ok is False] == []
    assert any(c.ok for c in comparisons)


def test_actions_in_flight_are_those_of_one_at_a_time_bit_for_bit() -> None:
    one = golden_cases()["a_three_cams"]
    observation = first(one.observation)
    noises = [torch.randn(one.noise[:1].shape, generator=torch.Generator().manual_seed(i)) for i in range(12)]
    plain, pipelined = made("tensorrt"), made("tensorrt_pipelined")
    expected = [plain.sample(observation, noise, 10).actions for noise in noises]
    futures = [pipelined.submit(observation, noise, 10) for noise in noises]  # type: ignore[attr-defined]
    for future, actions in zip(futures, expected, strict=True):
        assert torch.equal(future.result(timeout=60).actions, actions)


@pytest.mark.parametrize("case", ["a_three_cams", "b_third_masked", "e_horizon50"])
def test_fp8_actions_point_the_same_way(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    one = golden_cases()[case]
    calibration = calibrate(golden_model("pi05"), [first(golden_cases()[name].observation) for name in CASES[:3]])
    monkeypatch.setattr(TensorRTFp8Backend, "calibration", calibration)
    ours = made("tensorrt_fp8").sample(one.observation, one.noise, 10).actions
    exact = golden_model("pi05").sample(one.observation, one.noise, 10)
    for row, truth in zip(ours, exact, strict=True):
        assert torch.nn.functional.cosine_similarity(row.flatten(), truth.flatten(), dim=0) >= 0.999


@pytest.mark.parametrize("fp8", [False, True])
def test_an_exported_prefix_is_an_engine(fp8: bool, tmp_path: Path) -> None:
    """Float32 products are TF32 in TensorRT-RTX, hence the bound; FP8 is compared with ONNX Runtime's FP8."""
    pytest.importorskip("onnxruntime")
    from turbopi.backends.onnx import OnnxBackend
    from turbopi.export.onnx import export_onnx
    from turbopi.tensorrt.engine import Engine, build_onnx
    from turbopi.tensorrt.onnx_shapes import shapes_of

    model, observation = golden_model("pi05"), first(golden_cases()["a_three_cams"].observation)
    embedded = model.embed(observation)
    length = embedded.embs.shape[1]
    calibration = calibrate(model, [observation]) if fp8 else None
    export = export_onnx(model, tmp_path / "export", calibration=calibration)
    expected = OnnxBackend.open(export.folder).prefix(observation)
    plan = build_onnx(tensorrt.library(), export.graph("prefix"), shapes_of(export, "prefix", prefix=length))
    inputs = {"embs": embedded.embs, "positions": embedded.layout.computed_positions}
    inputs["mask"] = torch.ones(1, length, dtype=torch.bool)
    outputs = {name: torch.full(expected.k.shape, torch.nan, device=gpu()) for name in ("k", "v")}
    on_gpu = {name: value.to(gpu()).contiguous() for name, value in inputs.items()}
    Engine(tensorrt.library(), "prefix", plan).run(**on_gpu, **outputs)
    torch.cuda.synchronize()
    for name in ("k", "v"):
        exact = getattr(expected, name)
        assert float((outputs[name].cpu() - exact).norm() / exact.norm()) < (2e-2 if fp8 else 3e-3)


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
