"""The networks that become engines compute the model: their PyTorch twin against the reference, on any CPU."""

import pytest
import torch
import torch.nn.functional as F
from conftest import golden_cases, golden_model
from torch import Tensor

from turbopi.backends.tensorrt import networks
from turbopi.backends.tensorrt.ops import FP8_MAX, TorchOps, to_fp8
from turbopi.config import Kind
from turbopi.engine.weights import Weights, modulation, pack
from turbopi.kernels.plain import embed_patches
from turbopi.models.pi0.denoise import time_embedding, time_grid
from turbopi.models.pi0.layers import rope_tables
from turbopi.models.pi0.vision import normalize_images

OPS = TorchOps()


def packed(kind: Kind = "pi05") -> Weights:
    model = golden_model(kind)
    return pack(model.config, dict(model.state_dict()))


def error(ours: Tensor, exact: Tensor) -> float:
    return float((ours - exact).norm() / exact.norm())


def camera_images(count: int, seed: int = 0) -> Tensor:
    return torch.randint(0, 256, (count, 224, 224, 3), generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)


@pytest.mark.parametrize("cameras", [1, 3])
def test_vision_equals_the_reference(cameras: int) -> None:
    model, images = golden_model("pi05"), camera_images(cameras)
    weights = packed()
    x = embed_patches(images, weights.patch, weights.position, torch.float32)
    ours = networks.vision(OPS, model.config, weights, x, cameras, "f32")
    assert error(ours, model.vision(normalize_images(images)).flatten(0, 1)) < 2e-6


def test_half_precision_vision_stays_near_the_reference() -> None:
    model, images = golden_model("pi05"), camera_images(2)
    weights = packed()
    x = embed_patches(images, weights.patch, weights.position, torch.float16)
    ours = networks.vision(OPS, model.config, weights, x, 2, "f16")
    assert ours.dtype == torch.float16
    assert 1e-5 < error(ours.float(), model.vision(normalize_images(images)).flatten(0, 1)) < 2e-3


def test_feed_forward_equals_the_reference() -> None:
    model, x = golden_model("pi05"), torch.randn(23, golden_model("pi05").config.vlm.width)
    for ours, layer in zip(packed().vlm[:-1], model.vlm.layers[:-1], strict=True):  # of the last one nothing reads it
        assert error(networks.feed_forward(OPS, ours, x, "f32"), layer.mlp(x)) < 2e-6


def fp8_scales(layer: "networks.GemmaLayer", x: Tensor) -> networks.Fp8Scales:
    gate, up = networks.matrix(layer.gate_up).chunk(2)
    hidden = F.gelu(x @ gate.T, approximate="tanh") * (x @ up.T)
    amax = [one.abs().amax() / FP8_MAX for one in (x, hidden, gate, up, networks.matrix(layer.down))]
    return networks.Fp8Scales(*amax)


def test_fp8_feed_forward_rounds_its_operands_to_e4m3() -> None:
    layer, x = packed().vlm[0], torch.randn(23, golden_model("pi05").config.vlm.width)
    exact = networks.feed_forward(OPS, layer, x, "f32")
    ours = networks.feed_forward(OPS, layer, x, "f32", fp8_scales(layer, x))
    assert 5e-3 < error(ours, exact) < 8e-2


def test_fp8_scales_of_another_layer_give_another_answer() -> None:
    layers, x = packed().vlm, torch.randn(23, golden_model("pi05").config.vlm.width)
    own = networks.feed_forward(OPS, layers[0], x, "f32", fp8_scales(layers[0], x))
    small = fp8_scales(layers[0], x * 0.1)  # as if calibrated on something ten times quieter
    clipped = networks.feed_forward(OPS, layers[0], x, "f32", small)
    exact = networks.feed_forward(OPS, layers[0], x, "f32")
    assert error(clipped, exact) > 3 * error(own, exact)


def test_values_beyond_e4m3_saturate() -> None:
    assert to_fp8(torch.tensor([1e6, -1e6, 1.0]), torch.tensor(1.0)).float().tolist() == [448.0, -448.0, 1.0]


@pytest.mark.parametrize("kind", ["pi05", "pi0"])
@pytest.mark.parametrize("hidden_rows", [0, 9])
def test_denoise_step_equals_the_reference(kind: Kind, hidden_rows: int) -> None:
    """With cache rows behind the prefix that are masked, as in the static cache."""
    model, case = golden_model(kind), golden_cases()["a_three_cams" if kind == "pi05" else "p0_pi0_state"]
    config, weights, steps = model.config, packed(kind), 3
    row = torch.zeros(1, dtype=torch.long)
    observation = type(case.observation)(
        *(getattr(case.observation, f)[row] for f in ("images", "image_mask", "tokens", "token_mask", "state"))
    )
    cache = model.prefix(observation)
    x_t = case.noise[:1]
    trace: dict[str, Tensor] = {}
    model.denoise(cache, x_t, steps, trace=trace)
    table = modulation(config, weights.conditioning, steps)
    length, horizon = cache.k.shape[3], x_t.shape[1]
    suffix = horizon + (kind == "pi0")
    cos, sin = rope_tables(length + torch.arange(suffix)[None], config.vlm.head_dim, config.rope_base)
    pad = (0, 0, 0, hidden_rows)
    mask = (torch.arange(length + hidden_rows + suffix) < length) | (
        torch.arange(length + hidden_rows + suffix) >= length + hidden_rows
    )
    mask = mask[None]
    if kind == "pi0":
        mask = mask.repeat(suffix * config.expert.num_heads, 1)
        mask[: config.expert.num_heads, -horizon:] = False
    inputs = {
        "cos": cos[0, 0],
        "sin": sin[0, 0],
        "k": F.pad(cache.k[:, 0, 0], pad, value=7.0),
        "v": F.pad(cache.v[:, 0, 0], pad, value=7.0),
        "mask": torch.where(mask, 0.0, networks.HIDDEN),
    }
    times = time_embedding(time_grid(steps), config.expert.width)
    for step in range(steps):
        inputs["tokens"] = model.embed_suffix(trace["x_t"][step], observation.state, times[step][None])[0]
        if table is not None:
            inputs["modulation"] = table[step]
        ours = networks.denoise_step(OPS, config, weights, inputs)
        assert error(ours[-horizon:], trace["suffix_out"][step][0]) < 3e-6


@pytest.mark.parametrize("fused", [True, False])
def test_prefix_layer_equals_the_reference(fused: bool) -> None:
    model = golden_model("pi05")
    config, weights = model.config, packed()
    x = torch.randn(37, config.vlm.width)
    cos, sin = rope_tables(torch.arange(37)[None], config.vlm.head_dim, config.rope_base)
    layer, reference = weights.vlm[1], model.vlm.layers[1]
    normed, _ = reference.input_layernorm(x[None])
    k, v = reference.keys_values(normed, (cos, sin))
    expected = reference.feed_forward(x[None] + reference.attend(normed, (cos, sin), k, v, None))[0]
    gate, up = networks.matrix(layer.gate_up).chunk(2)
    assert layer.norm1 is not None and layer.norm2 is not None
    inputs = {"x": x, "cos": cos[0, 0], "sin": sin[0, 0], "norm1": layer.norm1[None], "norm2": layer.norm2[None]}
    matrices = {"qkv": layer.qkv, "out": layer.out, "down": layer.down}
    inputs |= {"gate": gate, "up": up, **{name: networks.matrix(one) for name, one in matrices.items()}}
    ours = networks.prefix_layer(OPS, config, networks.LayerStyle(fused, "f32"), inputs)
    for name, exact in (("x_next", expected), ("k", k[0, 0]), ("v", v[0, 0])):
        assert error(ours[name], exact) < 2e-6
