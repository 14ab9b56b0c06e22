"""The engine with FP8 matrices equals the emulated reference, and a calibration decides which matrices those are."""

import dataclasses
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any, NoReturn, cast

import pytest
import torch
from conftest import golden_cases, golden_folder, golden_model
from test_begin import Unrun, on_cpu
from test_engine import answer, made_up, shape_of
from torch import Tensor

from turbopi.backends.expert_store import ExpertStore, User
from turbopi.backends.fused import FusedBackend
from turbopi.calibrate.statistics import collect
from turbopi.engine import forward
from turbopi.engine import weights as engine_weights
from turbopi.engine.call import Cache, CallShape, Images, StaticCall
from turbopi.engine.emulate import RoundedWeights, rounded
from turbopi.engine.graph_cache import GraphCache
from turbopi.engine.loops import ConditionedLoop, EulerLoop, Loop
from turbopi.engine.weight_placement import AnyMatrix, rows_of_parts
from turbopi.engine.weights import Weights, modulation, pack
from turbopi.kernels.interface import GemmaLayer
from turbopi.kernels.plain import PLAIN
from turbopi.kernels.portable.quantize import quantize, rounded_matrix
from turbopi.models.observation import Observation
from turbopi.quantization.calibration_file import Quantization, SiteScale, shapes_of
from turbopi.quantization.formats import FORMATS, FP8, OF_EIGHT_BITS, Format
from turbopi.quantization.fp8 import ScaledMatrix
from turbopi.quantization.nvfp4 import Nvfp4Matrix
from turbopi.quantization.plan import Tier
from turbopi.quantization.sites import Site, sites
from turbopi.support.errors import BackendUnavailable
from turbopi.verify.check_golden import golden_calibration

CPU, META = torch.device("cpu"), torch.device("meta")
STEPS = 2


def scales_of(observation: Observation, noise: Tensor, format: Format = FP8) -> dict[Site, float]:
    model = golden_model("pi05")
    every = [site for site in sites(model.config) if site.part != "expert"]
    histograms = collect(model, every, [(observation, noise)], STEPS, format=format)
    return {site: histograms[str(site)].scale("max") for site in every}


def engine_actions(
    scales: dict[str, float], observation: Observation, noise: Tensor, format: Format = FP8
) -> tuple[Tensor, int]:
    """Actions of the engine's plain operations in float32, and how many matrices were rounded."""
    model = golden_model("pi05")
    made = []

    def make(place: str, matrix: Tensor) -> AnyMatrix:
        if place not in scales:
            return matrix
        made.append(place)
        return rounded_matrix(matrix, scales[place], None, format, rows_of_parts(model.config, place))

    weights = pack(model.config, dict(model.state_dict()), make)
    shape = shape_of(observation, noise, STEPS)
    cache = Cache.allocate(model.config, shape.prefix_slots(model.config) + 64, CPU, torch.float32)
    table = modulation(model.config, weights.conditioning, STEPS)
    camera_images = Images(model.config, weights, PLAIN, shape.cameras, shape.float_images, shape.prompt_slots)
    call = StaticCall(model.config, weights, PLAIN, shape, camera_images, cache, table)
    return answer(call, observation, noise), len(made)


def relative(ours: Tensor, exact: Tensor) -> float:
    return float((ours - exact).norm() / exact.norm())


@pytest.mark.parametrize("format", FORMATS.values(), ids=FORMATS)
def test_the_engine_equals_the_emulated_reference(format: Format) -> None:
    case = golden_cases()["b_third_masked"]
    scales = scales_of(case.observation, case.noise, format)
    model = golden_model("pi05")
    exact = model.sample(case.observation, case.noise, STEPS)[0]
    with rounded(model, scales, RoundedWeights(format=format)):
        emulated = model.sample(case.observation, case.noise, STEPS)[0]
    by_name = {str(site): scale for site, scale in scales.items()}
    ours, count = engine_actions(by_name, case.observation, case.noise, format)
    assert count == len(scales) == 2 * 4 + 2 * 4 + 1
    # rounded numbers near an edge may fall either way where float32 sums differ in their last bit
    assert relative(ours, emulated) < 0.25 * relative(emulated, exact)
    least, most = {"fp8": (0.01, 0.2), "int8": (0.002, 0.2), "nvfp4": (0.1, 0.4)}[format.name]
    assert least < relative(emulated, exact) < most


def damages(weights: Weights) -> dict[str, Tensor]:
    """Of each kind of thing that a NaN or an infinity may be in, one number."""

    def scale(matrix: Any, row: int = 3) -> Tensor:
        if isinstance(matrix, Nvfp4Matrix):
            return matrix.blocks[row, :1]
        return matrix.scale[row:][:1] if isinstance(matrix, ScaledMatrix) else matrix[row, :1]

    vision, prefix, expert = weights.vision[0], weights.vlm[0], weights.expert[1]
    found = {
        "patches": weights.patch[5, :1],
        "position": weights.position[7, :1],
        "projector": weights.projector[1][:1],
    }
    for kind in ("qkv", "out", "fc1", "fc2"):
        matrix, bias = getattr(vision, kind)
        found |= {f"vision's {kind}": scale(matrix), f"the bias of vision's {kind}": bias[:1]}
    found |= {"vision's first norm": vision.norm1[0][:1], "vision's second norm": vision.norm2[1][:1]}
    found |= {f"the prefix's {kind}": scale(getattr(prefix, kind)) for kind in ("qkv", "out", "gate_up", "down")}
    assert prefix.norm1 is not None and prefix.norm2 is not None
    found |= {"the prefix's first norm": prefix.norm1[:1], "the prefix's second norm": prefix.norm2[:1]}
    last = weights.vlm[-1]
    assert last.norm1 is not None
    found |= {"the last layer's norm": last.norm1[:1], "the last layer's values": scale(last.qkv, -1)}
    found |= {f"the expert's {kind}": scale(getattr(expert, kind)) for kind in ("qkv", "out", "gate_up", "down")}
    return found


@pytest.mark.slow
@pytest.mark.parametrize("numbers", [*FORMATS, "f32"])
def test_damage_anywhere_reaches_the_actions_and_goes_with_it(numbers: str) -> None:
    model, (observation, noise) = golden_model("pi05"), made_up("pi05", 1, 5)
    scales: Mapping[str, float] = {}
    if numbers != "f32":
        format = FORMATS[numbers]  # type: ignore[index]
        measured = {str(site): scale for site, scale in scales_of(observation, noise, format).items()}
        entries = {str(site): SiteScale(measured.get(str(site), 1.0), 1.0, 0.0, 0.0) for site in sites(model.config)}
        calibration = Quantization("0" * 64, shapes_of(model.config), entries, {}, format.name)
        scales = {k: v for k, v in calibration.plan(model.config, numbers).scales.items() if k in measured}

    def make(place: str, matrix: Tensor) -> AnyMatrix:
        return rounded_matrix(matrix, scales[place], format=format) if place in scales else matrix

    class Rounded(Unrun):
        def _pack(self, load: Any) -> Weights:
            return pack(self.config, {name: one.clone() for name, one in load(CPU, "f32").items()}, make)

    engine = on_cpu("pi05", Rounded)
    right, hidden = engine.sample(observation, noise, 1).actions, []
    for place, number in damages(engine._weights).items():
        for damage in (
            (torch.nan, torch.inf) if numbers not in ("fp8", "nvfp4") else (torch.nan,)
        ):  # infinities saturate
            before = number.clone()
            number.fill_(damage)
            if bool(engine.sample(observation, noise, 1).actions.isfinite().all()):
                hidden.append((place, damage))
            number.copy_(before)
    assert not hidden
    assert torch.equal(engine.sample(observation, noise, 1).actions, right)


def test_a_part_in_fp8_beside_one_in_full() -> None:
    """fc2 alone, gate_up alone: the operation before them rounds, the one behind reads what isn't E4M3."""
    case = golden_cases()["b_third_masked"]
    scales = {site: s for site, s in scales_of(case.observation, case.noise).items() if site.kind in ("fc2", "gate_up")}
    model = golden_model("pi05")
    with rounded(model, scales):
        emulated = model.sample(case.observation, case.noise, STEPS)[0]
    ours, _ = engine_actions({str(site): scale for site, scale in scales.items()}, case.observation, case.noise)
    exact = model.sample(case.observation, case.noise, STEPS)[0]
    assert relative(ours, emulated) < 0.25 * relative(emulated, exact)


@pytest.mark.parametrize("format", OF_EIGHT_BITS.values(), ids=OF_EIGHT_BITS)
def test_hidden_columns_of_vision_fill_whole_lines_of_memory(format: Format, monkeypatch: pytest.MonkeyPatch) -> None:
    """The zeros behind them change no number, and matrices that aren't rounded have none."""
    whole, narrow = pack_with_hidden(112, ("fc1", "fc2"), format), pack_with_hidden(112, ("fc2",), format)
    monkeypatch.setattr(engine_weights, "in_whole_lines", lambda *both: both)
    as_it_was = pack_with_hidden(112, ("fc1", "fc2"), format)
    for layer, before in zip(whole.vision, as_it_was.vision, strict=True):
        (fc1, bias), (fc2, last_bias) = layer.fc1, layer.fc2
        assert fc1.shape == (128, 64) and fc2.shape == (64, 128) and bias.shape == (128,)
        assert before.fc1[0].shape == (112, 64) and torch.equal(last_bias, before.fc2[1])
        assert torch.equal(cast(ScaledMatrix, fc1).dequantized()[112:], torch.zeros(16, 64))
    for weights in (narrow, as_it_was):
        assert all(layer.fc2[0].shape == (64, 112) for layer in weights.vision)
    assert relative(vision_of(whole), vision_of(as_it_was)) < 1e-3  # a sum's last bit may round a number another way


def pack_with_hidden(hidden: int, rounded_kinds: tuple[str, ...], format: Format) -> Weights:
    """The golden model's, its vision cut to so many hidden columns, of which these matrices are rounded."""
    model = golden_model("pi05")
    config = dataclasses.replace(model.config, vision=dataclasses.replace(model.config.vision, mlp_dim=hidden))
    state = dict(model.state_dict())
    for name in state:
        if name.endswith("fc2.weight"):
            state[name] = state[name][:, :hidden].contiguous()
        elif ".fc1." in name:
            state[name] = state[name][:hidden]

    def make(place: str, matrix: Tensor) -> AnyMatrix:
        chosen = place.startswith("vision") and place.endswith(rounded_kinds)
        return quantize(matrix, 0.02, format=format) if chosen else matrix

    return pack(config, state, make)


def vision_of(weights: Weights) -> Tensor:
    """Tokens [256, D] of a made-up image."""
    config = golden_model("pi05").config
    generator = torch.Generator().manual_seed(0)
    camera_image = torch.randint(0, 256, (1, 224, 224, 3), generator=generator, dtype=torch.uint8)
    out = torch.empty(config.vision.num_tokens, config.vlm.width)
    forward.vision_tokens(config, weights, PLAIN, [lambda: camera_image], out)
    return out


def test_nothing_rounded_changes_nothing() -> None:
    case = golden_cases()["b_third_masked"]
    model = golden_model("pi05")
    before = model.sample(case.observation, case.noise, STEPS)
    with rounded(model, {}):
        assert torch.equal(model.sample(case.observation, case.noise, STEPS), before)
    with rounded(model, scales_of(case.observation, case.noise)):
        assert not torch.equal(model.sample(case.observation, case.noise, STEPS), before)
    assert torch.equal(model.sample(case.observation, case.noise, STEPS), before)


def fused(device: torch.device, quantization: Quantization | None, precision: Tier = "fp8") -> FusedBackend:
    """A backend that has its weights and has run nothing."""
    backend = FusedBackend.__new__(FusedBackend)
    backend.config, backend.device = golden_model("pi05").config, device
    backend._quantization = quantization
    backend._plan = None if quantization is None else quantization.plan(backend.config, precision)
    state = {name: tensor.clone() for name, tensor in golden_model("pi05").state_dict().items()}
    backend._weights = pack(backend.config, state, backend._quantized)
    backend._expert = ExpertStore(backend._weights.expert, device, {"packed": backend._packed, "fp8": backend._in_fp8})
    backend._kernels, backend._ops = {}, PLAIN
    backend._graphs = GraphCache(backend._forget)
    return backend


def whole_calibration() -> Quantization:
    """The golden model's, which keeps nothing in bfloat16."""
    calibration = golden_calibration(golden_folder(), "pi05", CPU)
    every = {name: dataclasses.replace(site, kept=None) for name, site in calibration.sites.items()}
    return dataclasses.replace(calibration, sites=every)


def places(layers: Sequence[GemmaLayer[Any]]) -> set[str]:
    return {x.device.type for layer in layers for x in vars(layer).values() if x is not None}


PLAIN_LOOP, BY_TOKEN = EulerLoop(2, 5), ConditionedLoop(2, 5, (1.0, 0.5, 0.0))
JACOBIAN = ConditionedLoop(2, 5, (1.0, 0.5, 0.0), True)


def batch_weights(backend: FusedBackend, loop: Loop) -> Weights:
    weights = backend._batch_denoises_by(loop, 4, 64)
    assert isinstance(weights, Weights)
    return weights


@pytest.mark.parametrize("tier", ["fp8", "fp8-f16sums"])
def test_batches_denoise_in_fp8_with_matrices_of_their_own_which_go_with_the_last_of_them(tier: Tier) -> None:
    backend = fused(CPU, whole_calibration(), tier)
    matrix = backend._weights.vision[0].fc2[0]
    assert isinstance(matrix, ScaledMatrix) and matrix.half_sums == (tier == "fp8-f16sums")
    expert = batch_weights(backend, PLAIN_LOOP).expert
    assert backend._plan is not None and not backend._expert.users["layers"]
    for i, (ours, bf16) in enumerate(zip(expert, backend._weights.expert, strict=True)):
        for kind in ("qkv", "out", "gate_up", "down"):
            made, was, scale = getattr(ours, kind), getattr(bf16, kind), backend._plan.scales[f"expert.{i}.{kind}"]
            assert isinstance(made, ScaledMatrix) and made.inverse == 1 / scale and not made.half_sums
            assert float((made.dequantized() - was).norm() / was.norm()) < 0.05
    assert batch_weights(backend, BY_TOKEN).expert is expert
    assert backend.describe()["fp8"]["plan"]["expert of batches"] == "fp8"
    backend._expert.release(lambda user: True)
    assert not backend._expert._built and "expert of batches" not in backend.describe()["fp8"]["plan"]


def test_batches_guided_by_the_jacobian_read_the_experts_bfloat16_copy_beside_fp8() -> None:
    backend = fused(META, whole_calibration())
    assert batch_weights(backend, JACOBIAN).expert is backend._weights.expert
    assert places(backend._weights.expert) == {"meta"}
    plan = backend.describe()["fp8"]["plan"]
    assert "guided by the Jacobian" in str(plan.keys()) and "expert of batches" not in plan


def test_with_int8_weights_batches_denoise_in_bf16_and_metadata_tells_it() -> None:
    """The kernel's weights alone are int8; of operations there is no such product."""
    config = golden_model("pi05").config
    every = {str(site): SiteScale(1.0, 4.0, 0.0, 0.01) for site in sites(config)}
    report = {"observations": {"source": "recordings"}, "warnings": []}
    backend = fused(CPU, Quantization("0" * 64, shapes_of(config), every, report, "int8"), "int8")
    *before, last = (layer.qkv for layer in backend._weights.vlm)
    assert {matrix.numbers for matrix in before} == {torch.int8} and isinstance(last, Tensor)  # type: ignore[union-attr]
    reported = backend.describe()["int8"]["plan"]
    assert (
        reported["expert"] == reported["expert.down"] == reported["prefix.out"] == "int8"
        and "expert of batches" not in reported
    )
    assert reported["prefix.qkv"]["int8"] == "layers 0, 1" and "bf16: INT8 has no NaN" in " ".join(
        reported["prefix.qkv"]
    )
    assert batch_weights(backend, PLAIN_LOOP).expert is backend._weights.expert
    assert backend.describe()["int8"]["plan"]["expert of batches"] == "bf16, as operations denoise"
    backend._on_hopper = False
    packed = backend._expert.use("packed", User("single", PLAIN_LOOP, 64))
    assert packed.numbers == "int8" and bool((packed.inputs == 1).all())


@pytest.mark.slow
def test_metadata_tells_which_calls_operations_denoise_and_what_the_expert_is_in() -> None:
    backend = fused(CPU, whole_calibration())
    refused: dict[User, Any] = {
        User("single", EulerLoop(steps, 60), rows): "too many" for steps, rows in ((5, 968), (10, 968), (10, 1224))
    }
    backend._kernels = dict(refused)
    reported = backend.describe()
    assert reported["denoising"] == {"operations, as too many": ["H=60, 5 steps", "H=60, 10 steps"]}
    plan = reported["fp8"]["plan"]
    assert plan["prefix.down"] == "fp8"
    assert plan["expert.qkv"] == plan["expert"] == "bf16, as operations denoise"
    clock: list[float | None] = [None]
    kernel = SimpleNamespace(clock_mhz=lambda: clock[0], why_it_trapped=lambda: None)
    made = {User("single", EulerLoop(10, 10), 968): kernel}
    backend._kernels = refused | made
    assert "denoising_clock_mhz" not in backend.describe()  # it hasn't run
    clock[0] = 1795.4
    assert backend.describe()["denoising_clock_mhz"] == {"H=10, 10 steps": 1795}
    plan = backend.describe()["fp8"]["plan"]
    assert plan["expert.qkv"] == "fp8"
    assert plan["expert"] == "fp8 in the denoising kernel; bf16 where operations denoise"
    backend._kernels = made
    assert backend.describe()["fp8"]["plan"]["expert"] == "fp8"


def test_a_kernel_that_is_refused_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    backend, tried = fused(CPU, None), []

    def refuse(user: User, table: Tensor | None) -> NoReturn:
        tried.append(user.loop)
        raise BackendUnavailable("it holds 3 clusters")

    monkeypatch.setattr(backend, "_denoising_kernel", refuse)
    assert all(backend._make_denoiser(CallShape(2, slots, EulerLoop(5, 10)), None) is None for slots in (16, 32, 48))
    assert tried == [EulerLoop(5, 10)]
    assert [(user.loop, why) for user, why in backend._refused().items()] == [(EulerLoop(5, 10), "it holds 3 clusters")]


def test_what_nothing_reads_of_the_last_prefix_layer_is_not_kept() -> None:
    state = {name: tensor.clone() for name, tensor in golden_model("pi05").state_dict().items()}
    weights = pack(golden_model("pi05").config, state)
    *others, last = weights.vlm
    assert (last.out.shape[0], last.gate_up.shape[0], last.down.shape[0]) == (0, 0, 0)
    assert last.qkv.shape == others[0].qkv.shape
    assert all(layer.down.shape[0] and layer.out.shape[0] and layer.gate_up.shape[0] for layer in others)
