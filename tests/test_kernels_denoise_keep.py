"""What the denoising kernel keeps of a step for a way back: where it goes, on a CPU thread by thread; what it is, on a
GPU against the operations.
"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from conftest import on_hopper
from emulator import emulate
from kernel_turns.problems import GPU, Problem, by_token, plain, problem, relative
from torch import Tensor

from turbopi.engine.backward import Expert
from turbopi.engine.forward import suffix_tokens
from turbopi.kernels.arguments import Parameter, Parameters
from turbopi.kernels.backward import PLAIN_BACKWARD
from turbopi.kernels.interface import KeptStep
from turbopi.kernels.plain import PLAIN
from turbopi.kernels.sm90 import instructions
from turbopi.kernels.sm90.denoise import kernel as denoise
from turbopi.kernels.sm90.denoise.packing import KINDS, RANKS, Arrangement, PackedExpert
from turbopi.models.pi0.layers import rope_tables

CPU = torch.device("cpu")
ENTRY = emulate.MACHINE.with_name("denoise_kept.cu")
TAKES = Parameters(
    (
        *(Parameter("const int*", "ctas"), Parameter("const int*", "rows")),
        *(Parameter("unsigned short*", name) for name in ("kept_x", "kept_q", "kept_gate_up")),
        *(Parameter("unsigned char*", name) for name in ("own_k", "own_v")),
        *(Parameter("long long", "layer_stride"), Parameter("float*", "kv")),
    )
)


def numbers(rows: int, tokens: int, layers: int) -> Tensor:
    """bfloat16[layers, tokens, rows]: the entry's `number_of`."""
    row, token, layer = (torch.arange(size) for size in (rows, tokens, layers))
    return ((row * 13 + token[:, None] * 7 + layer[:, None, None] * 5) % 251).bfloat16()


def rows_of_tiles(a: Arrangement, queries: int, keys_values: int, gates: int) -> Tensor:
    """int32[CTAs, tiles, 16]"""
    rows = torch.zeros(a.blocks, queries + keys_values + gates, 16, dtype=torch.int32)
    for cta in range(a.blocks):
        at = divmod(cta, RANKS)
        own = torch.cat((a.query_rows(*at), a.key_value_rows(*at)))
        rows[cta, : len(own)] = own
        own = a.gate_up_rows(*at)
        rows[cta, queries + keys_values : queries + keys_values + len(own)] = own
    return rows


@pytest.mark.slow
@pytest.mark.skipif(emulate.COMPILER is None, reason="no g++ here")
@pytest.mark.parametrize(
    ("name", "suffix"), [("golden", 10), ("golden", 50), ("odd", 16), ("odd", 33), ("uneven", 7), ("wide", 20)]
)
def test_everything_that_is_kept_goes_to_its_place_once(
    name: str, suffix: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(instructions, "wgmma", emulate.wgmma)
    monkeypatch.setattr(denoise, "PARTS", denoise.PARTS[: denoise.PARTS.index("{form}/project") + 1])
    p = problem(name, 1, suffix, 3, 0, CPU)
    a, g = Arrangement(p.config), p.config.expert
    sizes = denoise.kernel_sizes(a, cache_rows=48, suffix=suffix, shared_bytes=232448, by_token=True, keep=True)
    source = denoise.source(suffix, False, by_token=True, keep=True) + ENTRY.read_text()
    library = emulate.compiled(source, "kept", TAKES, sizes, tmp_path, in_part=True)
    queries, keys_values, gates, _ = a.max_tiles
    cache = torch.full((2, g.depth, 5 + suffix, g.head_dim), torch.nan, dtype=torch.bfloat16)
    given = {
        "ctas": torch.arange(a.blocks, dtype=torch.int32),
        "rows": rows_of_tiles(a, queries, keys_values, gates),
        "kept_x": torch.full((2 * g.depth + 1, suffix, g.width), torch.nan, dtype=torch.bfloat16),
        "kept_q": torch.full((g.depth, suffix, g.num_heads * g.head_dim), torch.nan, dtype=torch.bfloat16),
        "kept_gate_up": torch.full((g.depth, suffix, 2 * g.mlp_dim), torch.nan, dtype=torch.bfloat16),
        "own_k": cache[0, :, 5:],
        "own_v": cache[1, :, 5:],
        "kv": torch.zeros(suffix, 2 * g.head_dim),
    }
    addresses: dict[str, Any] = {key: tensor.data_ptr() for key, tensor in given.items()}
    emulated = emulate.EmulatedKernel(library, TAKES, denoise.THREADS, 1, 1, suffix)
    emulated.launch_dependent(a.blocks, addresses | {"layer_stride": cache.stride(1) * 2})
    heads = g.num_heads * g.head_dim
    qkv = numbers(heads + 2 * g.head_dim, suffix, g.depth)
    assert torch.equal(given["kept_x"], numbers(g.width, suffix, 2 * g.depth + 1))
    assert torch.equal(given["kept_q"], qkv[..., :heads])
    assert torch.equal(given["kept_gate_up"], numbers(2 * g.mlp_dim, suffix, g.depth))
    assert torch.equal(cache[0, :, 5:], qkv[..., heads : heads + g.head_dim])
    assert torch.equal(cache[1, :, 5:], qkv[..., heads + g.head_dim :])
    assert cache[:, :, :5].isnan().all(), "rows of the prefix"


# ---- on a GPU


def operations(p: Problem, step: int, x_t: Tensor, dtype: torch.dtype) -> tuple[Expert, KeptStep]:
    """The same of one step by plain operations, in this dtype; the expert's cache has the suffix's keys and values."""
    assert p.tokens is not None
    layers = [replace(one, **{kind: getattr(one, kind).to(dtype) for kind in KINDS}) for one in p.layers]
    suffix, rows = len(p.noise), p.cache_k.shape[1]
    k, v = (torch.nn.functional.pad(one.nan_to_num(), (0, 0, 0, suffix)).to(dtype) for one in (p.cache_k, p.cache_v))
    cos, sin = (
        one[0, 0].to(GPU)
        for one in rope_tables(p.length + torch.arange(suffix)[None], p.config.expert.head_dim, p.config.rope_base)
    )
    weights: Any = SimpleNamespace(expert=layers, expert_norm=None, small=p.small)
    table = p.table[p.tokens.rows[step].long()].permute(1, 2, 0, 3).contiguous()
    length = torch.tensor([p.length], device=GPU)
    expert = Expert(p.config, weights, PLAIN, PLAIN_BACKWARD, table, length, k, v, (cos, sin))
    assert expert.cache_k.shape[1] == rows + suffix
    _, kept, last = expert.forward(suffix_tokens(p.config, p.small, x_t, x_t, x_t).to(dtype))
    stream = torch.stack([*(x for one in kept for x in (one.x, one.middle)), last])
    q, gate_up = torch.stack([one.attention[0] for one in kept]), torch.stack([one.gate_up for one in kept])
    return expert, KeptStep(stream, q, gate_up)


@on_hopper
@pytest.mark.parametrize(
    ("name", "steps", "suffix", "length"),
    [
        *(("golden", 2, 10, 37), ("golden", 2, 50, 1100), ("odd", 2, 16, 101), ("uneven", 2, 33, 256)),
        *(("shallow", 2, 10, 560), ("shallow", 2, 24, 560), ("shallow", 2, 50, 560), ("shallow", 1, 56, 1000)),
        *(("full", 2, 10, 560), ("full", 2, 50, 560)),
    ],
)
@pytest.mark.parametrize("way", ["same", "distinct"])
def test_what_is_kept_is_as_exact_as_what_ordinary_operations_keep(
    name: str, steps: int, suffix: int, length: int, way: str
) -> None:
    p = by_token(problem(name, steps, suffix, length, steps * 1000 + suffix, GPU), way, suffix)
    assert p.tokens is not None
    kernel = denoise.DenoiseKernel(
        *(p.config, PackedExpert.pack(p.config, p.layers), p.small, p.table),
        cache_rows=p.cache_k.shape[1],
        suffix=suffix,
        device=GPU,
        num_steps=1,
        by_token=True,
        keep=True,
    )
    reference_x, _ = plain(p, torch.float32)
    k, v = (torch.nn.functional.pad(one, (0, 0, 0, suffix), value=torch.nan) for one in (p.cache_k, p.cache_v))
    for step in range(steps):  # of states that no guidance has moved
        x_t, v_t = reference_x[step].contiguous(), torch.full_like(p.noise, torch.nan)
        found = kernel.launch_step(step, x_t, k, v, torch.tensor([p.length], device=GPU), v_t, p.tokens)
        exact_expert, exact = operations(p, step, x_t, torch.float32)
        usual_expert, usual = operations(p, step, x_t, torch.bfloat16)
        pairs = {
            "k": (k[:, -suffix:], usual_expert.cache_k[:, -suffix:], exact_expert.cache_k[:, -suffix:]),
            "v": (v[:, -suffix:], usual_expert.cache_v[:, -suffix:], exact_expert.cache_v[:, -suffix:]),
        } | {key: tuple(getattr(one, key) for one in (found, usual, exact)) for key in ("stream", "q", "gate_up")}
        assert v_t.isfinite().all()
        for key, (ours, theirs, right) in pairs.items():
            for layer in range(len(ours)):
                error, bound = relative(ours[layer], right[layer]), relative(theirs[layer], right[layer])
                assert error <= 1.2 * bound + 0.004, f"{key} of layer {layer}: {error:.4f}, ordinary {bound:.4f}"
