"""Random denoising problems and what the denoising kernels' results are compared with."""

import dataclasses
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.config import GemmaConfig, ModelConfig, preset
from turbopi.kernels import nvrtc
from turbopi.kernels.interface import GemmaLayer, TokenInputs
from turbopi.kernels.portable.denoise.kernel import PortableDenoiser
from turbopi.kernels.portable.denoise.packing import PackedExpert
from turbopi.kernels.sm90.denoise.packing import KINDS
from turbopi.kernels.sm90.denoise.plain import Operand, denoise_plain, guided
from turbopi.models.pi0.denoise import euler_step
from turbopi.models.pi0.layers import apply_rope, rms_normalize, rope_tables
from turbopi.quantization.fp8 import E4M3_MAX
from turbopi.support.errors import BackendError

FULL = preset("pi05_libero").planned_model
BF16 = torch.bfloat16
GPU = torch.device("cuda", 0)


def sized(width: int, mlp_dim: int, depth: int, head_dim: int, heads: int = 8) -> ModelConfig:
    expert = GemmaConfig(width=width, mlp_dim=mlp_dim, depth=depth, head_dim=head_dim, num_heads=heads)
    vlm = dataclasses.replace(FULL.vlm, depth=depth, head_dim=head_dim, num_heads=heads)
    return dataclasses.replace(FULL, expert=expert, vlm=vlm)


CONFIGS = {
    "golden": sized(32, 64, 3, 16),
    "tiny": sized(128, 256, 6, 32),
    "odd": sized(160, 224, 2, 48, 4),
    "uneven": sized(160, 224, 2, 48, 10),  # ten clusters divide nothing
    "wide": sized(1280, 224, 1, 256, 2),  # more than 8 tiles back into the stream, more than 3 of q|k|v
    "crowd": sized(64, 128, 1, 16, 32),  # more clusters than a GPU holds
    "shallow": sized(1024, 4096, 3, 256),
    "full": FULL,
}


@lru_cache
def has_nvrtc() -> bool:
    try:
        nvrtc.bindings("nvrtc").nvrtcVersion()
    except (BackendError, RuntimeError):  # no package, or no library behind it
        return False
    return True


@dataclasses.dataclass
class Problem:
    """Random weights, modulation and inputs; the cache is NaN beyond the valid length. tokens: see `by_token`."""

    config: ModelConfig
    layers: list[GemmaLayer]
    small: dict[str, Tensor]
    table: Tensor
    noise: Tensor
    cache_k: Tensor
    cache_v: Tensor
    length: int
    tokens: TokenInputs | None = None


def modulation(g: GemmaConfig, rows: int, gen: torch.Generator) -> Tensor:
    """A random table of norms: float32[rows, 2L + 1, 3, D]."""
    table = torch.randn(rows, 2 * g.depth + 1, 3, g.width, generator=gen, device=gen.device) * 0.3
    table[:, :, 0] += 1
    table[:, :, 2] *= 2
    return table


def problem(
    name: str, steps: int, suffix: int, length: int, seed: int, device: torch.device, *, outliers: bool = False
) -> Problem:
    config = CONFIGS[name]
    g, gen = config.expert, torch.Generator(device).manual_seed(seed)
    heads = g.num_heads * g.head_dim

    def random(*shape: int, std: float = 1.0, dtype: torch.dtype = torch.float32) -> Tensor:
        return (torch.randn(*shape, generator=gen, device=device) * std).to(dtype)

    layers = [
        GemmaLayer(
            qkv=random(heads + 2 * g.head_dim, g.width, std=g.width**-0.5, dtype=BF16),
            out=random(g.width, heads, std=heads**-0.5, dtype=BF16),
            gate_up=random(2 * g.mlp_dim, g.width, std=g.width**-0.5, dtype=BF16),
            down=random(g.width, g.mlp_dim, std=1.5 * g.mlp_dim**-0.5, dtype=BF16),
            norm1=None,
            norm2=None,
        )
        for _ in range(g.depth)
    ]
    if outliers:  # one residual column and one input far above the rest, as in trained models
        for layer in layers:
            layer.down[3] *= 30
            layer.qkv[:, 5] *= 4
    small = {
        "action_in_proj.weight": random(g.width, config.action_dim, std=config.action_dim**-0.5),
        "action_in_proj.bias": random(g.width, std=0.1),
        "action_out_proj.weight": random(config.action_dim, g.width, std=g.width**-0.5),
        "action_out_proj.bias": random(config.action_dim, std=0.1),
    }
    table = modulation(g, steps, gen)
    cache = [random(g.depth, length + 7, g.head_dim, dtype=BF16) for _ in "kv"]
    for part in cache:
        part[:, length:] = torch.nan
    noise = random(suffix, config.action_dim)
    return Problem(config, layers, small, table, noise, cache[0], cache[1], length)


WAYS = ("same", "held", "guided", "distinct")


def by_token(p: Problem, way: str, seed: int = 0) -> Problem:
    """The same for the form in which every token has its own time and step, with random numbers for what is new.

    way  "same": the times that they all had; "held": the first quarter, and at least one, stays as it is; "guided": the
        same times, with guidance; "distinct": each token and step has a row of the table, a step and a gain of its own

    Raises ValueError for another way.
    """
    if way not in WAYS:
        raise ValueError(f"{way!r}: expected one of {', '.join(WAYS)}")
    steps, (tokens, actions), device = len(p.table), p.noise.shape, p.noise.device
    gen = torch.Generator(device).manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=gen, device=device)

    def each_token(by_step: Tensor) -> Tensor:
        return by_step[:, None].repeat(1, tokens)

    table, rows = p.table, each_token(torch.arange(steps, dtype=torch.int32, device=device))
    times = each_token(1 - torch.arange(steps, device=device) / steps)
    lengths = torch.full(rows.shape, -1.0 / steps, device=device)
    target, gain = torch.zeros(tokens, actions, device=device), torch.zeros(rows.shape, device=device)
    if way == "held":
        held = max(tokens // 4, 1)
        table = torch.cat((table, modulation(p.config.expert, 1, gen)))
        rows[:, :held], times[:, :held], lengths[:, :held] = steps, 0, 0
    elif way == "distinct":
        table = modulation(p.config.expert, steps * tokens, gen)
        rows = torch.randperm(steps * tokens, generator=gen, device=device).int().view(steps, tokens)
        times, lengths = uniform(steps, tokens), uniform(steps, tokens) * (-2.0 / steps)
    if way in ("guided", "distinct"):
        target, gain = uniform(tokens, actions) * 2 - 1, uniform(steps, tokens) * 2
    return dataclasses.replace(p, table=table, tokens=TokenInputs(rows, lengths, times, target, gain))


def plain(p: Problem, dtype: torch.dtype, operand: Operand = lambda x, layer, product: x) -> tuple[Tensor, Tensor]:
    noise = p.noise.to(dtype)
    cache = p.cache_k, p.cache_v, p.length
    return denoise_plain(p.config, p.layers, p.small, p.table, noise, *cache, operand, p.tokens)


def input_scales(p: Problem) -> dict[str, float]:
    """What calibration would find for the kernel's E4M3 activations, with room for twice as much."""
    largest: dict[str, float] = {}

    def watch(x: Tensor, layer: int, product: int) -> Tensor:
        site = f"expert.{layer}.{KINDS[product]}"
        largest[site] = max(largest.get(site, 0.0), float(x.abs().max()))
        return x

    plain(p, torch.float32, watch)
    return {site: 2 * value / E4M3_MAX for site, value in largest.items()}


def int8_inputs(p: Problem) -> dict[str, float]:
    """In place of `input_scales` where weights alone are rounded."""
    return {f"expert.{i}.{kind}": 1.0 for i in range(p.config.expert.depth) for kind in KINDS}


def standing_for(packed: PackedExpert, p: Problem) -> list[GemmaLayer]:
    """The problem's layers with the weights that the packed ones stand for, in float32."""
    return [
        dataclasses.replace(layer, **dict(zip(KINDS, packed.matrices(i), strict=True)))
        for i, layer in enumerate(p.layers)
    ]


def portable_outputs(
    p: Problem, packed: PackedExpert, *, blocks: int | None = None, arch: str | None = None
) -> tuple[Tensor, Tensor]:
    """x_t and v_t of the portable kernel, poisoned before. blocks, arch: see `PortableDenoiser`."""
    steps, chunk, rows = p.table.shape[0], p.noise.shape, p.cache_k.shape[1]
    x_t = torch.full((steps + 1, *chunk), torch.nan, device=GPU)
    v_t = torch.full((steps, *chunk), torch.nan, device=GPU)
    kernel = PortableDenoiser(
        *(p.config, packed, p.small, p.table),
        cache_rows=rows,
        suffix=chunk[0],
        device=GPU,
        blocks=blocks,
        arch=arch,
    )
    for _ in range(2):  # scratch memory of the first launch changes nothing
        kernel.launch(p.noise, p.cache_k, p.cache_v, torch.tensor([p.length], device=GPU), x_t, v_t)
    torch.cuda.synchronize()
    return x_t, v_t


def ordinary_bf16(p: Problem) -> Tensor:
    """The same with PyTorch's bfloat16 operations, as the reference rounds: what the kernel's error is measured by."""
    g, suffix, x_t = p.config.expert, p.noise.shape[0], p.noise
    positions = p.length + torch.arange(suffix, device=x_t.device)
    cos, sin = (t[0, 0][:, None] for t in rope_tables(positions[None], g.head_dim, p.config.rope_base))

    def normed(x: Tensor, modulation: Tensor) -> tuple[Tensor, Tensor]:
        y = rms_normalize(x, p.config.rms_norm_eps) * modulation[0] + modulation[1]
        return y.to(BF16), modulation[2].to(BF16)

    def affine(name: str, x: Tensor) -> Tensor:
        return F.linear(x, p.small[f"{name}.weight"], p.small[f"{name}.bias"])

    by_step = p.table[:, :, :, None] if p.tokens is None else p.table[p.tokens.rows.long()].movedim(1, 3)
    for step, modulation in enumerate(by_step):
        x = affine("action_in_proj", x_t).to(BF16)
        for i, layer in enumerate(p.layers):
            y, gate = normed(x, modulation[2 * i])
            parts = F.linear(y, layer.qkv).view(suffix, -1, g.head_dim)
            rotated = apply_rope(parts[:, :-1], cos, sin)
            keys = torch.cat((p.cache_k[i, : p.length], rotated[:, -1]))
            values = torch.cat((p.cache_v[i, : p.length], parts[:, -1]))
            q = rotated[:, :-1].reshape(-1, g.head_dim)
            attended = ((q @ keys.T).float() * g.head_dim**-0.5).softmax(-1).to(BF16) @ values
            x = x + F.linear(attended.view(suffix, -1), layer.out) * gate
            y, gate = normed(x, modulation[2 * i + 1])
            up_gate, up = F.linear(y, layer.gate_up).chunk(2, dim=-1)
            x = x + F.linear(F.gelu(up_gate, approximate="tanh") * up, layer.down) * gate
        v_t = affine("action_out_proj", normed(x, modulation[2 * g.depth])[0].float())
        if p.tokens is None:
            x_t = euler_step(x_t, v_t, len(p.table))
        else:
            x_t = x_t + p.tokens.steps[step, :, None] * guided(x_t, v_t, p.tokens, step)
    return x_t


def relative(x: Tensor, reference: Tensor) -> float:
    return float((x.double() - reference.double()).norm() / reference.double().norm())
