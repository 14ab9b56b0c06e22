"""The twin of every operation, in plain PyTorch: what kernels are held against.

`PLAIN` defines what an operation computes; kernels of our own must equal it. Reductions and nonlinear functions are
float32 inside; results have the activations' dtype.

Where the product behind an operation is a `ScaledMatrix`, the operation gets that input's `inverse` scale and its
`numbers`, E4M3 or int8, and its result is of these, rounded once from float32. `stream`: the residual stream, whose
rows int8's damage is marked in (`quantization.int8`); norms mark their own result, the prefix's attention `v`.

Shapes: D, W widths, F hidden width of an MLP, K head_dim, n query heads over one key/value head.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.kernels.interface import PILLOW_BITS, Ops, Taps
from turbopi.models.pi0.layers import apply_rope, rms_normalize
from turbopi.models.pi0.vision import normalize_images
from turbopi.quantization.fp8 import E4M3, Matrix, to_e4m3
from turbopi.quantization.int8 import mark_damage, to_int8


def transfer(source: Tensor, to: Tensor) -> None:
    """`to` becomes `source`, of the same shape and dtype. One may be pinned memory of the host; nothing waits."""
    to.copy_(source, non_blocking=True)


def resize_image(image: Tensor, out: Tensor, rows: Taps, columns: Taps, top: int, left: int, low: float) -> None:
    """Image uint8[h, w, 3] into `out` [S, S, 3], from row `top` and column `left` on; around it is padding.

    out uint8     as Pillow: sums of whole numbers across, rounded to 8 bits, then down; padding 0
    out float32   as LeRobot, in [-1, 1]: two neighbours across, then down, of numbers in [0, 1], each pair with one
                  fused multiply-add, as PyTorch does it on a CPU. What is below `low` becomes it, and so does padding
    """
    out.fill_(0 if out.dtype == torch.uint8 else 2 * low - 1)
    place = out[top : top + len(rows.first), left : left + len(columns.first)]
    if out.dtype == torch.uint8:
        across = _pillow_sum(image.transpose(0, 1), columns).transpose(0, 1)
        place.copy_(_pillow_sum(across, rows))
    else:
        across = _linear_sum((image.float() / 255).transpose(0, 1), columns).transpose(0, 1)
        place.copy_(_linear_sum(across, rows).clamp(low, 1) * 2 - 1)


def _tapped(x: Tensor, taps: Taps) -> Tensor:
    """Numbers x [m, ...] that make the result's: [n, taps, ...]."""
    places = taps.first[:, None] + torch.arange(taps.weights.shape[1], device=x.device)
    return x[places.clamp(max=len(x) - 1).long()]


def _pillow_sum(x: Tensor, taps: Taps) -> Tensor:
    products = _tapped(x, taps).int() * taps.weights[..., None, None]
    return ((products.sum(1) + (1 << PILLOW_BITS - 1)) >> PILLOW_BITS).clamp(0, 255).byte()


def _linear_sum(x: Tensor, taps: Taps) -> Tensor:
    first, second = _tapped(x, taps).unbind(1)
    weights = taps.weights[..., None, None]
    return (first.double() * weights[:, 0].double() + (second * weights[:, 1]).double()).float()


def patch_rows(images: Tensor, patch: int) -> Tensor:
    """Images (uint8|float32)[V, S, S, 3] -> their patches in [-1, 1], float32[V * tokens, 3 * patch * patch]."""
    n, side = images.shape[0], images.shape[1] // patch
    rows = normalize_images(images).reshape(n, side, patch, side, patch, 3).permute(0, 1, 3, 5, 2, 4)
    return rows.reshape(n * side * side, -1)


def embed_patches(images: Tensor, weight: Tensor, position: Tensor, dtype: torch.dtype) -> Tensor:
    """Images (uint8|float32)[V, S, S, 3] -> [V * tokens, W] in `dtype`, computed in float32.

    weight float32[W, 3 * patch * patch]; position float32[tokens, W] has the bias in it.
    """
    rows = patch_rows(images, round((weight.shape[1] / 3) ** 0.5))
    return (F.linear(rows, weight).view(-1, *position.shape) + position).flatten(0, 1).to(dtype)


def embed_prompt(tokens: Tensor, table: Tensor, out: Tensor) -> None:
    """Rows of `table` [vocab, D] times √D, rounded to its dtype, into `out` [P, D]. tokens int64[P]."""
    out.copy_(F.embedding(tokens, table) * table.shape[1] ** 0.5)


def residual_rms_norm(
    x: Tensor,
    y: Tensor | None,
    gate: Tensor | None,
    scale: Tensor,
    shift: Tensor | None,
    eps: float,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
) -> tuple[Tensor, Tensor]:
    """(x + y * gate, its RMSNorm * scale + shift). x, y [tokens, D].

    gate, scale, shift are float32[D], or by token all [tokens, D]; None: left out. The gate is rounded to x's dtype
    first, as in the reference.
    """
    if y is not None:
        x = x + (y if gate is None else y * gate.to(x.dtype))
    normed = rms_normalize(x, eps) * scale
    normed = normed if shift is None else normed + shift
    return x, as_input(normed, x.dtype, inverse, numbers, x)


def residual_layer_norm(
    x: Tensor,
    y: Tensor | None,
    weight: Tensor,
    bias: Tensor,
    eps: float,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
) -> tuple[Tensor, Tensor]:
    """(x + y, its LayerNorm). x, y [tokens, W]."""
    if y is not None:
        x = x + y
    if inverse is not None:
        normed = F.layer_norm(x.float(), (x.shape[-1],), weight.float(), bias.float(), eps)
        return x, as_input(normed, x.dtype, inverse, numbers, x)
    return x, F.layer_norm(x, (x.shape[-1],), weight, bias, eps)


def linear(x: Tensor, weight: Matrix, bias: Tensor | None = None, out: Tensor | None = None) -> Tensor:
    """x @ weightᵀ + bias, into `out` if it is given."""
    result = F.linear(x, weight, bias) if isinstance(weight, Tensor) else weight.product(x, bias).to(weight.dtype)
    return result if out is None else out.copy_(result)


def linear_gelu(
    x: Tensor,
    weight: Matrix,
    bias: Tensor,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    stream: Tensor | None = None,
) -> Tensor:
    """gelu(x @ weightᵀ + bias). A rounded matrix's product isn't rounded before."""
    if isinstance(weight, Tensor):
        return as_input(gelu(F.linear(x, weight, bias)), x.dtype, inverse, numbers, stream)
    return as_input(gelu(weight.product(x, bias)), weight.dtype, inverse, numbers, stream)


def linear_geglu(
    x: Tensor,
    gate_up: Matrix,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    stream: Tensor | None = None,
) -> Tensor:
    """[tokens, D] times [2F, D], gate rows before up rows -> gelu(gate) * up [tokens, F]."""
    if isinstance(gate_up, Tensor):
        return as_input(geglu(F.linear(x, gate_up)), x.dtype, inverse, numbers, stream)
    return as_input(geglu(gate_up.product(x)), gate_up.dtype, inverse, numbers, stream)


def as_input(
    x: Tensor,
    dtype: torch.dtype,
    inverse: float | None,
    numbers: torch.dtype = E4M3,
    stream: Tensor | None = None,
) -> Tensor:
    """x for the product behind it: E4M3 or int8 if it asks for that. int8's damage is marked in `stream`."""
    if inverse is None:
        return x.to(dtype)
    if numbers != torch.int8:
        return to_e4m3(x, inverse)
    if stream is not None:
        mark_damage(x, stream)
    return to_int8(x, inverse)


def gelu(x: Tensor) -> Tensor:
    return F.gelu(x, approximate="tanh")


def geglu(gate_up: Tensor) -> Tensor:
    """[tokens, 2F], gate columns before up columns -> [tokens, F]"""
    gate, up = gate_up.chunk(2, dim=-1)
    return F.gelu(gate, approximate="tanh") * up


def gelu_by_sigmoid(x: Tensor) -> Tensor:
    """`gelu`, as (1 + tanh u) / 2 = sigmoid(2 u): one exponential, where a compiled tanh also takes a polynomial."""
    y = x.float()
    return (y * torch.sigmoid(1.5957691216057308 * y * (1 + 0.044715 * y * y))).to(x.dtype)  # 2 * sqrt(2 / pi)


def geglu_by_sigmoid(gate_up: Tensor) -> Tensor:
    """`geglu`, with `gelu_by_sigmoid`."""
    gate, up = gate_up.chunk(2, dim=-1)
    return gelu_by_sigmoid(gate) * up


def rope_split(qkv: Tensor, cos: Tensor, sin: Tensor, k_out: Tensor, v_out: Tensor) -> Tensor:
    """Split [tokens, (n + 2) * K]; write rotated keys and values [tokens, K]; return rotated queries [tokens * n, K].

    cos, sin float32[tokens, K/2].
    """
    head_dim = k_out.shape[-1]
    parts = qkv.view(qkv.shape[0], -1, head_dim)
    k_out.copy_(apply_rope(parts[:, -2], cos, sin))  # apart from the queries: Inductor would write both, then copy
    v_out.copy_(parts[:, -1])
    return apply_rope(parts[:, :-2], cos[:, None], sin[:, None]).reshape(-1, head_dim)


def vision_attention(
    qkv: Tensor,
    images: int,
    heads: int,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    stream: Tensor | None = None,
) -> Tensor:
    """Self-attention inside each image: [V * tokens, 3W], q before k before v, heads inside -> [V * tokens, W]."""
    rows, width = qkv.shape[0], qkv.shape[1] // 3
    q, k, v = qkv.view(images, -1, 3, heads, width // heads).permute(2, 0, 3, 1, 4)
    attended = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(rows, width)
    return as_input(attended, qkv.dtype, inverse, numbers, stream)


def masked_softmax(
    logits: Tensor, length: Tensor, slots: int, heads: int, state_token: bool, scale: float, dtype: torch.dtype
) -> Tensor:
    """softmax(logits * scale) over the visible keys, in `dtype`; see `attention`. logits float32[tokens * n, keys]"""
    key = torch.arange(logits.shape[1], device=logits.device)
    visible = (key < length) | (key >= slots)
    if state_token:
        row = torch.arange(logits.shape[0], device=logits.device)[:, None]
        visible = visible & ((row >= heads) | (key <= slots))
    return (logits * scale).masked_fill(~visible, -torch.inf).softmax(-1).to(dtype)


def attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    length: Tensor,
    slots: int,
    heads: int,
    state_token: bool = False,
    *,
    softmax: Callable[..., Tensor] = masked_softmax,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
) -> Tensor:
    """softmax(q kᵀ / √K) v over keys [0, length) and [slots, …): q [tokens * n, K] -> [tokens, n * K].

    k, v [keys, K], finite; length int64[1] on the device: padding of the prefix begins there, `slots` is where it ends
    and the suffix's keys begin. With `state_token` the first query token doesn't see keys beyond `slots` (Pi0).
    All query heads read the same keys, so they are rows of one product.
    """
    logits = matmul_f32(q, k.t())
    probabilities = softmax(logits, length, slots, heads, state_token, q.shape[1] ** -0.5, v.dtype)
    return as_input((probabilities @ v).view(-1, heads * q.shape[1]), q.dtype, inverse, numbers, v)


def matmul_f32(a: Tensor, b: Tensor) -> Tensor:
    """a @ b with the float32 accumulators kept, which CUDA's library does for bfloat16 inputs."""
    if a.dtype == torch.float32:
        return a @ b
    if a.device.type == "cuda":
        return torch.mm(a, b, out_dtype=torch.float32)
    return a.float() @ b.float()


PLAIN = Ops(
    transfer=transfer,
    embed_patches=embed_patches,
    embed_prompt=embed_prompt,
    residual_rms_norm=residual_rms_norm,
    residual_layer_norm=residual_layer_norm,
    linear=linear,
    residual_linear=linear,
    linear_gelu=linear_gelu,
    linear_geglu=linear_geglu,
    rope_split=rope_split,
    vision_attention=vision_attention,
    attention=attention,
    origin={"matrix products": "cuBLAS", "vision attention": "scaled_dot_product_attention", "all else": "PyTorch"},
)
