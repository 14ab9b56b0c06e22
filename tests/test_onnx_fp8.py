"""FP8 in the ONNX export: standard Q/DQ nodes, against PyTorch that rounds the same operands."""

import importlib.util
import json
from pathlib import Path

import onnx
import onnx_ir
import pytest
from cli_helpers import refusal, turbopi
from conftest import golden_cases, golden_folder, golden_model
from torch import Tensor, nn

from turbopi.backends.onnx import export as exporting
from turbopi.backends.onnx.backend import OnnxBackend
from turbopi.backends.onnx.export import export_onnx, open_export
from turbopi.backends.onnx.quantized import quantize_mlps
from turbopi.backends.tensorrt.calibrate import Calibration, calibrate
from turbopi.backends.tensorrt.networks import Fp8Scales
from turbopi.backends.tensorrt.ops import to_fp8
from turbopi.checkpoint.onnx_folder import GraphSource
from turbopi.models.pi0.layers import GeGLU
from turbopi.models.pi0.reference import Pi0Model
from turbopi.support.errors import ConfigError

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("two_layers")]

needs_rtx = pytest.mark.skipif(importlib.util.find_spec("tensorrt_rtx") is None, reason="TensorRT-RTX isn't installed")


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrate(golden_model("pi05"), [golden_cases()["a_three_cams"].observation])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, calibration: Calibration) -> Path:
    path = tmp_path_factory.mktemp("fp8") / "export"
    export_onnx(golden_model("pi05"), path, calibration=calibration)
    return path


class FakeQuantGeGLU(nn.Module):
    """The MLP with its operands rounded to E4M3, in float32."""

    def __init__(self, mlp: GeGLU, scales: Fp8Scales) -> None:
        super().__init__()
        self.gate_proj, self.up_proj, self.down_proj = mlp.gate_proj, mlp.up_proj, mlp.down_proj
        self.scales = scales

    def forward(self, x: Tensor) -> Tensor:
        s = self.scales
        x = rounded(x, s.input)
        hidden = nn.functional.gelu(x @ rounded(self.gate_proj.weight, s.gate).T, approximate="tanh")
        hidden = hidden * (x @ rounded(self.up_proj.weight, s.up).T)
        return rounded(hidden, s.hidden) @ rounded(self.down_proj.weight, s.down).T


def rounded(x: Tensor, scale: Tensor) -> Tensor:
    return to_fp8(x, scale).float() * scale


def emulated(calibration: Calibration) -> Pi0Model:
    checkpoint = golden_folder().checkpoint("pi05")
    model = Pi0Model.from_state(checkpoint.config.planned_model, checkpoint.load("cpu", "f32").state)
    for layer, scales in zip(model.vlm.layers, calibration.scales, strict=False):
        assert scales is not None
        layer.mlp = FakeQuantGeGLU(layer.mlp, scales)  # type: ignore[assignment]
    return model


def error(ours: Tensor, exact: Tensor) -> float:
    return float((ours - exact).norm() / exact.norm())


def test_the_graph_equals_pytorch_that_rounds_the_same_operands(folder: Path, calibration: Calibration) -> None:
    """Where float32 sums differ in the last bit, an operand may fall to the next E4M3 number: hence 1e-3, not 1e-5."""
    observation = golden_cases()["a_three_cams"].observation
    row = observation.row(0)
    ours, fake = OnnxBackend.open(folder).prefix(row), emulated(calibration).prefix(row)
    plain = golden_model("pi05").prefix(row)
    for name in ("k", "v"):
        there, here, exact = getattr(ours, name), getattr(fake, name), getattr(plain, name)
        assert error(there[:1], exact[:1]) < 1e-5  # before the first MLP
        assert error(there, here) < 1e-3
        assert error(there[1:], exact[1:]) > 10 * error(there[1:], here[1:])


def test_actions_stay_close_to_the_reference(folder: Path) -> None:
    case = golden_cases()["a_three_cams"]
    ours = OnnxBackend.open(folder).sample(case.observation, case.noise, 10).actions
    exact = golden_model("pi05").sample(case.observation, case.noise, 10)
    assert nn.functional.cosine_similarity(ours.flatten(), exact.flatten(), dim=0) > 0.999


def test_each_mlp_has_five_scales_and_its_weights_are_e4m3(folder: Path, calibration: Calibration) -> None:
    model = onnx.load(str(folder / "prefix.onnx"), load_external_data=False)
    onnx.checker.check_model(str(folder / "prefix.onnx"), full_check=True)
    kinds = [node.op_type for node in model.graph.node]
    layers = len(calibration.scales)
    assert kinds.count("QuantizeLinear") == 2 * layers and kinds.count("DequantizeLinear") == 5 * layers
    e4m3 = [one for one in model.graph.initializer if one.data_type == onnx.TensorProto.FLOAT8E4M3FN]
    assert sum(len(one.dims) == 2 for one in e4m3) == 3 * layers
    assert {node.domain for node in model.graph.node} == {""}
    for graph in ("vision", "denoise_step"):
        other = onnx.load(str(folder / f"{graph}.onnx"), load_external_data=False)
        assert "QuantizeLinear" not in {node.op_type for node in other.graph.node}


def test_the_folder_says_what_is_fp8_and_on_what_it_was_calibrated(folder: Path) -> None:
    manifest = open_export(folder).manifest
    source = GraphSource(open_export(folder))
    assert source.dtypes["vlm.layers.0.mlp.up_proj.weight"] == "F8_E4M3"
    assert source.dtypes["vlm.layers.0.self_attn.q_proj.weight"] == "F32"
    assert manifest["precision"] == "fp8 (E4M3) in the prefix's MLPs, f32 elsewhere"
    assert manifest["calibration"]["observations"] == 1


def test_scales_of_another_model_are_refused(folder: Path, calibration: Calibration) -> None:
    prefix = onnx_ir.load(folder / "prefix.onnx").graph
    with pytest.raises(ConfigError, match="the graph has 2 MLPs, but there are scales for 1"):
        quantize_mlps(prefix, calibration.scales[:1])


@needs_rtx
def test_the_files_build_engines(folder: Path) -> None:
    """The prefix, with FP8 in it, needs a GPU or TensorRT-RTX 1.7: 1.4 asks the GPU for something."""
    from turbopi.backends.onnx.shapes import shapes_of
    from turbopi.backends.tensorrt import library
    from turbopi.backends.tensorrt.engine import build_onnx

    export, version = open_export(folder), library().version
    with_fp8 = ("prefix",) if tuple(map(int, version.split(".")[:2])) >= (1, 7) else ()
    for graph in ("vision", "denoise_step", *with_fp8):
        shapes = shapes_of(export, graph, camera_images=2, prefix=560, horizon=10)
        assert len(build_onnx(library(), export.graph(graph), shapes, compute_capability="SM89")) > 1000


def test_the_command_exports_fp8_calibrated_on_the_pictures_that_come_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the graphs the prefix alone, which has FP8 in it: the others take most of the time."""
    all_graphs = exporting.graphs
    monkeypatch.setattr(exporting, "graphs", lambda model: [one for one in all_graphs(model) if one.name == "prefix"])
    result = turbopi(
        "export", "onnx", "--random-weights", "pi05_tiny", "--precision", "fp8", "--json", tmp_path / "new"
    )
    assert result.exit_code == 0, result.output
    about = json.loads(result.stdout)["calibration"]
    assert about["method"] == "max" and about["observations"] > 1
    assert about["source"] == "LIBERO images that come with Turbo-Pi"
    written = onnx.load(str(tmp_path / "new" / "prefix.onnx"), load_external_data=False)
    assert "QuantizeLinear" in {node.op_type for node in written.graph.node}


def test_the_command_refuses_a_precision_or_calibration_that_makes_no_sense() -> None:
    tiny = ("--random-weights", "pi05_tiny", "x")
    said = refusal(turbopi("export", "onnx", *tiny, "--precision", "int8"))
    assert "unknown precision 'int8' for an export; choose one of f32, fp8" in said
    assert "--calibration is for --precision fp8" in refusal(turbopi("export", "onnx", *tiny, "--calibration", "x"))
