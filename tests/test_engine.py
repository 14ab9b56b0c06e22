"""The engine's static forward pass equals the reference on the CPU: every golden case, odd prompts, 0 to 3 cameras."""

import dataclasses
import importlib.util
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import golden_cases, golden_model
from torch import Tensor

from turbopi import backends
from turbopi.backends.cuda_graph import CudaGraphBackend
from turbopi.config import Kind
from turbopi.engine.call import Cache, CallShape, Images, StaticCall
from turbopi.engine.compiled import compiled
from turbopi.engine.loops import EulerLoop
from turbopi.engine.runner import HostRow
from turbopi.engine.weights import modulation, pack
from turbopi.engine.without_compiler import OPS, Denoiser
from turbopi.kernels.interface import Ops
from turbopi.kernels.plain import PLAIN, geglu, geglu_by_sigmoid, gelu, gelu_by_sigmoid
from turbopi.models.observation import Observation
from turbopi.models.pi0.reference import FloatPrecision

FIELDS = ("images", "image_mask", "tokens", "token_mask", "state")
CPU = torch.device("cpu")
CASES = ["a_three_cams", "b_third_masked", "e_horizon50", "p0_pi0_state"]


def static_call(kind: Kind, shape: CallShape, precision: FloatPrecision = "f32", ops: Ops = PLAIN) -> StaticCall:
    model = golden_model(kind, precision)
    weights = pack(model.config, dict(model.state_dict()))
    cache = Cache.allocate(
        model.config, shape.prefix_slots(model.config) + 64, CPU, weights.embed_tokens.dtype, ops is OPS
    )
    camera_images = Images(model.config, weights, ops, shape.cameras, shape.float_images, shape.prompt_slots)
    table = modulation(model.config, weights.conditioning, shape.loop.steps)
    call = StaticCall(model.config, weights, ops, shape, camera_images, cache, table)
    if ops is OPS and table is not None:
        call.denoiser = dataclasses.replace(
            Denoiser.prepare(model.config, weights, table), slots=shape.prefix_slots(model.config)
        )
    return call


def send(images: Images, given: list[np.ndarray]) -> None:
    """All of a call's, at once."""
    for upload in images.uploads(given, None, False):
        upload()


def answer(call: StaticCall, observation: Observation, noise: Tensor, row: int = 0) -> Tensor:
    send(call.images, list(observation.images[row][observation.image_mask[row]].numpy()))
    call.write_inputs(
        noise[row].numpy(),
        observation.state[row].numpy(),
        observation.tokens[row][observation.token_mask[row]].numpy(),
    )
    call.run()
    return call.actions.clone()


def shape_of(observation: Observation, noise: Tensor, steps: int, row: int = 0) -> CallShape:
    tokens = int(observation.token_mask[row].sum())
    slots = max(16, -(-tokens // 16) * 16)
    floats = observation.images.dtype == torch.float32
    return CallShape(int(observation.image_mask[row].sum()), slots, EulerLoop(steps, noise.shape[1]), floats)


def made_up(kind: Kind, cameras: int, tokens: int, seed: int = 0) -> tuple[Observation, Tensor]:
    config = golden_model(kind).config
    g = torch.Generator().manual_seed(seed)
    width = config.max_prompt_tokens
    size = config.vision.image_size
    observation = Observation(
        images=torch.randint(0, 256, (1, 3, size, size, 3), generator=g, dtype=torch.uint8),
        image_mask=(torch.arange(3) < cameras)[None],
        tokens=torch.randint(1, config.vocab_size, (1, width), generator=g),
        token_mask=(torch.arange(width) < tokens)[None],
        state=torch.randn(1, config.action_dim, generator=g),
    )
    return observation, torch.randn(1, 7, config.action_dim, generator=g)


@pytest.mark.parametrize("ops", [PLAIN, OPS], ids=["plain", "without_compiler"])
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("steps", [1, 3, 10])
def test_equals_the_reference_on_golden_cases(case: str, steps: int, ops: Ops) -> None:
    one = golden_cases()[case]
    for row in range(one.observation.batch_size):
        call = static_call(one.kind, shape_of(one.observation, one.noise, steps, row), ops=ops)
        expected = golden_model(one.kind).sample(one.observation, one.noise, steps)[row]
        torch.testing.assert_close(answer(call, one.observation, one.noise, row), expected, atol=5e-6, rtol=1e-5)


@pytest.mark.parametrize("kind", ["pi05", "pi0"])
@pytest.mark.parametrize(("cameras", "tokens"), [(0, 5), (1, 16), (2, 1), (2, 47), (3, 33)])
def test_equals_the_reference_for_odd_prompts_and_cameras(kind: Kind, cameras: int, tokens: int) -> None:
    observation, noise = made_up(kind, cameras, tokens)
    call = static_call(kind, shape_of(observation, noise, 2))
    other, _ = made_up(kind, 3, tokens)  # a second row with cameras: the reference can't run without any
    both = Observation(*(torch.cat((getattr(observation, f), getattr(other, f))) for f in FIELDS))
    expected = golden_model(kind).sample(both, noise.repeat(2, 1, 1), 2)[0]
    torch.testing.assert_close(answer(call, observation, noise), expected, atol=5e-6, rtol=1e-5)


def test_a_longer_prompt_leaves_nothing_behind_for_a_shorter_one() -> None:
    long, noise = made_up("pi05", 1, 32)
    short, _ = made_up("pi05", 1, 19, seed=1)
    call = static_call("pi05", shape_of(long, noise, 2))
    answer(call, long, noise)
    expected = golden_model("pi05").sample(short, noise, 2)[0]
    torch.testing.assert_close(answer(call, short, noise), expected, atol=5e-6, rtol=1e-5)


@pytest.mark.parametrize("ops", [PLAIN, OPS], ids=["plain", "without_compiler"])
def test_bfloat16_is_as_close_to_float32_as_the_reference_is(ops: Ops) -> None:
    one = golden_cases()["b_third_masked"]
    exact = golden_model("pi05").sample(one.observation, one.noise, 10)[0]
    reference = golden_model("pi05", "bf16").sample(one.observation, one.noise, 10)[0]
    call = static_call("pi05", shape_of(one.observation, one.noise, 10), "bf16", ops)

    def error(actions: Tensor) -> float:
        return float((actions - exact).square().mean().sqrt())

    assert 0 < error(answer(call, one.observation, one.noise)) <= 1.25 * error(reference)


def test_the_host_buffer_holds_valid_pictures_and_tokens_only() -> None:
    observation, noise = made_up("pi05", 2, 5)
    call = static_call("pi05", shape_of(observation, noise, 1))
    call.host.tokens.fill_(7)
    answer(call, observation, noise)
    np.testing.assert_array_equal(call.host.tokens.numpy()[:5], observation.tokens[0, :5].numpy())
    assert not call.host.tokens[5:].any()
    assert call.host.length.item() == 2 * call.config.vision.num_tokens + 5


@pytest.mark.parametrize("ops", [PLAIN, OPS], ids=["plain", "without_compiler"])
@pytest.mark.parametrize("horizon", [6, 7, 16])
def test_rows_between_prefix_and_suffix_are_seen_by_nobody(horizon: int, ops: Ops) -> None:
    observation, _ = made_up("pi05", 1, 19)
    noise = torch.randn(1, horizon, 32, generator=torch.Generator().manual_seed(horizon))
    call = static_call("pi05", shape_of(observation, noise, 2), ops=ops)
    assert call.cache_k.shape[1] % 16 == 0
    for poison in (torch.nan, torch.inf):
        call.cache_k[:, -horizon - 3 :], call.cache_v[:, -horizon - 3 :] = poison, poison
        expected = golden_model("pi05").sample(observation, noise, 2)[0]
        torch.testing.assert_close(answer(call, observation, noise), expected, atol=5e-6, rtol=1e-5)


@pytest.mark.parametrize("kind", ["pi05", "pi0"])
def test_packing_brings_each_tensor_to_its_device_and_leaves_none_behind(kind: Kind) -> None:
    """The checkpoint on the host, all but the expert elsewhere: "meta" stands for a GPU."""
    model, elsewhere, host = golden_model(kind), torch.device("meta"), torch.device("cpu")
    state, seen = dict(model.state_dict()), []

    def make(place: str, matrix: Tensor) -> Tensor:
        seen.append((place, matrix.device.type))
        return matrix

    weights = pack(model.config, state, make, device=elsewhere, expert_device=host)
    assert not state and {device for _, device in seen} == {"meta"}
    layers = [*weights.vision, *weights.vlm]
    tensors = [one for layer in layers for field in vars(layer).values() for one in _tensors(field)]
    tensors += [weights.patch, weights.position, weights.embed_tokens, *weights.projector, *weights.small.values()]
    assert {one.device.type for one in tensors} == {"meta"}
    expert = [one for layer in weights.expert for field in vars(layer).values() for one in _tensors(field)]
    assert {one.device.type for one in (*expert, *weights.conditioning.values())} == {"cpu"}
    same = pack(model.config, dict(model.state_dict())).expert
    for moved, kept in zip(weights.expert, same, strict=True):
        assert all(torch.equal(getattr(moved, name), getattr(kept, name)) for name in ("qkv", "out", "gate_up", "down"))


def _tensors(field: Any) -> list[Tensor]:
    return [] if field is None else [field] if isinstance(field, Tensor) else [one for one in field if one is not None]


def test_every_valid_picture_must_be_given() -> None:
    observation, noise = made_up("pi05", 2, 5)
    call = static_call("pi05", shape_of(observation, noise, 1))
    with pytest.raises(ValueError, match="shorter"):
        send(call.images, list(observation.images[0, :1].numpy()))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_gelu_by_sigmoid_is_gelu(dtype: torch.dtype) -> None:
    x = torch.linspace(-40, 40, 40_000).to(dtype).view(2, -1)
    atol, rtol = (1e-6, 1e-6) if dtype == torch.float32 else (1e-5, 2**-7)
    torch.testing.assert_close(gelu_by_sigmoid(x), gelu(x), atol=atol, rtol=rtol)
    torch.testing.assert_close(geglu_by_sigmoid(x), geglu(x), atol=atol, rtol=rtol)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # the compiler's own
@pytest.mark.skipif(
    backends.availability("pytorch_compile", CPU) is not None, reason="torch.compile needs a C++ compiler"
)
def test_compiled_operations_equal_the_reference_and_compile_little_for_other_buckets() -> None:
    """Both stacks' widths are known to the compiler: a second width must not make them unknown."""
    ops = compiled()
    for cameras, tokens in ((1, 5), (2, 20), (1, 40)):
        observation, noise = made_up("pi05", cameras, tokens)
        call = static_call("pi05", shape_of(observation, noise, 2), ops=ops)
        expected = golden_model("pi05").sample(observation, noise, 2)[0]
        with torch.compiler.set_stance("fail_on_recompile" if tokens == 40 else "default"):
            torch.testing.assert_close(answer(call, observation, noise), expected, atol=5e-6, rtol=1e-5)


def test_operations_are_not_called_compiled_where_nothing_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    with torch._dynamo.config.patch(disable=True):
        assert compiled() is OPS
    assert compiled() is not OPS
    on_gpu: Any = SimpleNamespace(device=torch.device("cuda"))
    with monkeypatch.context() as without_triton:
        without_triton.setattr(importlib.util, "find_spec", lambda name: None)
        assert CudaGraphBackend._make_ops(on_gpu) is OPS
    monkeypatch.setenv("TORCHDYNAMO_DISABLE", "1")
    assert compiled() is OPS and "Inductor" not in OPS.origin.values()


def test_a_row_on_the_host_has_valid_cameras_and_tokens_only() -> None:
    observation, _ = made_up("pi05", 2, 5)
    mask = torch.tensor([[True, False, True]])
    row = HostRow.of(dataclasses.replace(observation, image_mask=mask), 0)
    assert len(row.images) == 2
    np.testing.assert_array_equal(row.images[1], observation.images[0, 2].numpy())
    np.testing.assert_array_equal(row.tokens, observation.tokens[0, :5].numpy())
    np.testing.assert_array_equal(row.state, observation.state[0].numpy())
