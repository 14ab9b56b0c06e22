"""The twins, in plain PyTorch, of what a batch has beside `kernels.plain`: rows of several observations together.

Shapes: B observations, R packed prefix rows, T suffix tokens of each, n query heads, K head_dim, D width.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.kernels.interface import BatchOps, Segments, StepEnd
from turbopi.kernels.plain import as_input, matmul_f32, residual_rms_norm, rope_split
from turbopi.quantization.fp8 import E4M3


def embed_rows(source: Tensor, images: Tensor, table: Tensor, out: Tensor) -> None:
    """Prefix rows into `out` [R, D]: of source int64[R] >= 0 that row of `images`, of others that of `table` [vocab,
    D] for the token -1 - source, times √D and rounded to its dtype.
    """
    prompt = table[(-1 - source).clamp(min=0)]
    prompt = (prompt.float() * table.shape[1] ** 0.5).to(out.dtype)
    seen = images[source.clamp(min=0)] if len(images) else prompt
    out.copy_(torch.where((source >= 0)[:, None], seen, prompt))


def packed_attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    segments: Segments,
    heads: int,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
) -> Tensor:
    """Each row of q [R * n, K] over the keys of its own segment: k, v [R, K], finite -> [R, n * K]."""
    rows, dim = k.shape
    whose = _whose(segments.starts, rows)
    visible = whose[:, None] == whose
    queries = q.view(rows, heads, dim).transpose(0, 1)
    attended = F.scaled_dot_product_attention(queries, k.expand(heads, -1, -1), v.expand(heads, -1, -1), visible)
    return as_input(attended.transpose(0, 1).reshape(rows, heads * dim), q.dtype, inverse, numbers, v)


def suffix_attention(
    qkv: Tensor,
    cos: Tensor,
    sin: Tensor,
    prefix_k: Tensor,
    prefix_v: Tensor,
    starts: Tensor,
    lengths: Tensor,
    heads: int,
    state_token: bool = False,
    inverse: float | None = None,
) -> Tensor:
    """Each observation's T tokens over its prefix and each other: q|k|v [B * T, (n + 2) * K] -> [B * T, n * K].

    cos, sin float32[B * T, K/2]: RoPE, which the suffix's queries and keys haven't had.

    prefix_k, prefix_v [rows, K]; those of observation b begin at starts[b], int32[B + 1], and are lengths[b] many. With
    `state_token` the first token of an observation sees no other one of them (Pi0).
    """
    (count, width), dim = qkv.shape, prefix_k.shape[1]
    assert width == (heads + 2) * dim, f"{heads} heads of {dim} columns, a key and a value aren't {width} columns"
    k, v = qkv.new_empty(count, dim), qkv.new_empty(count, dim)
    q = rope_split(qkv, cos, sin, k, v)
    visible = visible_to_suffix(starts, lengths, len(prefix_k), count, state_token).repeat_interleave(heads, 0)
    keys, values = torch.cat((prefix_k, k)), torch.cat((prefix_v, v))
    # what a row doesn't see counts with 0, but 0 * NaN is NaN: of another observation, or of rows nobody has written
    damaged = ~values.isfinite().all(1)
    logits = (matmul_f32(q, keys.t()) * dim**-0.5).masked_fill(~visible, -torch.inf)
    attended = logits.softmax(-1).to(v.dtype) @ values.masked_fill(damaged[:, None], 0)
    attended = attended.masked_fill((visible & damaged).any(1)[:, None], torch.nan)
    return as_input(attended.view(count, heads * dim), q.dtype, inverse)


def end_step(
    x: Tensor,
    y: Tensor,
    gate: Tensor | None,
    end: StepEnd,
    x_t: Tensor,
    x_next: Tensor,
    v_t: Tensor,
) -> Tensor:
    """From the expert's residual stream x + y * gate, [B * T, D], to the next step's tokens [B * T, D].

    y may come as parts, as to norms. x_t float32[B * T, A]; x_next and v_t, the same, are written. x isn't needed after
    it and may be overwritten.
    """
    _, normed = residual_rms_norm(x, y, gate, end.scale, end.shift, end.eps)
    v_t.copy_(F.linear(normed.float(), *end.out))
    x_next.copy_(x_t + end.step * v_t)
    return F.linear(x_next, *end.into).to(x.dtype)


def visible_to_suffix(starts: Tensor, lengths: Tensor, rows: int, count: int, state_token: bool) -> Tensor:
    """bool[B * T, rows + B * T]: which prefix rows, and which tokens behind them, each of `count` tokens attends to."""
    batch, device = len(starts) - 1, starts.device
    row, token = torch.arange(rows, device=device), count // batch
    own = torch.arange(count, device=device) // token
    starts, lengths = starts[own, None], lengths[own, None]
    to_prefix = (row >= starts) & (row < starts + lengths)
    to_suffix = own[:, None] == own
    if state_token:
        place = torch.arange(count, device=device) % token
        to_suffix = to_suffix & ((place[:, None] > 0) | (place == 0))
    return torch.cat((to_prefix, to_suffix), 1)


def _whose(starts: Tensor, rows: int) -> Tensor:
    """int64[R]: of each row the last segment that begins at it or before; empty ones have none."""
    return torch.searchsorted(starts, torch.arange(rows, device=starts.device, dtype=starts.dtype), right=True)


PLAIN_BATCH = BatchOps(
    embed_rows=embed_rows,
    packed_attention=packed_attention,
    suffix_attention=suffix_attention,
    end_step=end_step,
    expert=lambda ops: ops,
    origin="PyTorch; attention over the rows of all observations, masked",
)
