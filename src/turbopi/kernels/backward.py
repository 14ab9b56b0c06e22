"""What a vector-Jacobian product through the action expert is made of, in plain PyTorch: the twins of `BackwardOps`.

`BetweenProducts` makes them of the library's products and what stands between these. Gradients that enter a product
have the activations' dtype; the residual stream's gradient is float32. Inside, everything is float32.

Shapes: T tokens, D width, F hidden width of an MLP, K head_dim, n query heads over one key/value head, R cache rows.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.kernels.interface import BackwardOps
from turbopi.kernels.plain import geglu, masked_softmax, matmul_f32, rope_split
from turbopi.models.pi0.layers import apply_rope, inverse_rms

_TANH = 0.7978845608028654  # sqrt(2 / pi), of GELU
_CUBIC = 0.044715


def rms_norm_vjp(
    d_normed: Tensor,
    x: Tensor,
    scale: Tensor,
    eps: float,
    d_x: Tensor | None,
    gate: Tensor | None,
    rows: Tensor | None = None,
) -> tuple[Tensor, Tensor | None]:
    """Back through `residual_rms_norm`: (d_x + the norm's part, float32; that times gate, in x's dtype).

    d_normed, x [T, D]; d_x float32[T, D], what reaches x by other ways; scale, gate float32[T, D] or [D]; the gate is
    that of the addition before the norm, rounded as there. None: left out. d_normed may be parts float32[parts, T, D].
    rows int32[T]: scale and gate are of a table [U, D], of which each token takes a row.
    """
    if rows is not None:
        scale, gate = scale[rows], None if gate is None else gate[rows]
    if d_normed.dim() == 3:
        d_normed = d_normed.sum(0)
    g, wide, r = d_normed.float() * scale, x.float(), inverse_rms(x, eps)
    through = r * (g - wide * (r * r * (wide * g).mean(-1, keepdim=True)))
    total = through if d_x is None else d_x + through
    return total, None if gate is None else (total * gate.to(x.dtype).float()).to(x.dtype)


def geglu_vjp(d_hidden: Tensor, gate_up: Tensor) -> Tensor:
    """Back through `plain.geglu`: [T, F] and the product [T, 2F] -> [T, 2F], gate columns before up columns."""
    gate, up = gate_up.float().chunk(2, dim=-1)
    d = d_hidden.float()
    tanh = torch.tanh(_TANH * (gate + _CUBIC * gate * gate * gate))
    half = 0.5 * (1 + tanh)
    slope = half + 0.5 * gate * (1 - tanh * tanh) * _TANH * (1 + 3 * _CUBIC * gate * gate)
    return torch.cat((d * up * slope, d * gate * half), dim=-1).to(gate_up.dtype)


def softmax_vjp(probabilities: Tensor, d_probabilities: Tensor, scale: float) -> Tensor:
    """Back through `plain.masked_softmax`: [rows, keys], the second float32 -> of the logits, in the first's dtype."""
    p = probabilities.float()
    along = p * d_probabilities
    return ((along - p * along.sum(-1, keepdim=True)) * scale).to(probabilities.dtype)


def rope_vjp(d_q: Tensor, d_k: Tensor, d_v: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Back through `plain.rope_split`: [T * n, K], [T, K], [T, K] -> [T, (n + 2) * K]. cos, sin float32[T, K/2]."""
    tokens, head_dim = d_k.shape
    q = apply_rope(d_q.view(tokens, -1, head_dim), cos[:, None], -sin[:, None])
    return torch.cat((q, apply_rope(d_k, cos, -sin)[:, None], d_v[:, None]), dim=1).view(tokens, -1)


def pull(
    x_t: Tensor, v_t: Tensor, times: Tensor, target: Tensor, weights: Tensor, out: Tensor, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """What is missing from the chunk that v_t points to, times weights float32[H, 1]: float32[H, A]; back to the final
    norm's result: [H, D] in this dtype.

    x_t, v_t, target float32[H, A]; times float32[H]; out: action_out_proj's matrix float32[A, D].
    """
    error = (target - (x_t - times[:, None] * v_t)) * weights
    return error, ((times[:, None] * error) @ out).to(dtype)


def move(
    d_tokens: Tensor, into: Tensor, x_t: Tensor, v_t: Tensor, error: Tensor, gain: Tensor, steps: Tensor, next_x: Tensor
) -> None:
    """v_t becomes the guided one, next_x what it moves x_t to: float32[H, A].

    d_tokens float32[H, D], what came back to the tokens of `pull`'s error; into: action_in_proj's matrix float32[D, A];
    gain, steps float32[H].
    """
    v_t -= gain[:, None] * (error - d_tokens @ into)
    torch.add(x_t, steps[:, None] * v_t, out=next_x)


@dataclass(frozen=True)
class BetweenProducts:
    """The operations around cuBLAS's products, by their twins' names. `softmax` is `plain.masked_softmax`'s."""

    softmax: Callable[..., Tensor]
    geglu: Callable[[Tensor], Tensor]
    rope_split: Callable[..., Tensor]
    rms_norm_vjp: Callable[..., tuple[Tensor, Tensor | None]]
    geglu_vjp: Callable[[Tensor, Tensor], Tensor]
    softmax_vjp: Callable[[Tensor, Tensor, float], Tensor]
    rope_vjp: Callable[..., Tensor]

    def ops(self, origin: str) -> BackwardOps:
        return BackwardOps(
            qkv=self.qkv,
            attention=self.attention,
            out=F.linear,
            gate_up=self.gate_up,
            down=F.linear,
            down_vjp=self.down_vjp,
            gate_up_vjp=torch.matmul,
            rms_norm_vjp=self.rms_norm_vjp,
            out_vjp=torch.matmul,
            attention_vjp=self.attention_vjp,
            qkv_vjp=self.qkv_vjp,
            kept_attention=self.kept_attention,
            pull=pull,
            move=move,
            origin=origin,
        )

    def qkv(self, x: Tensor, weight: Tensor, cos: Tensor, sin: Tensor, k_out: Tensor, v_out: Tensor) -> Tensor:
        """x [T, D] times weight [(n + 2) * K, D], split: turned queries [T * n, K], the others [T, K] written."""
        return self.rope_split(F.linear(x, weight), cos, sin, k_out, v_out)

    def attention(
        self,
        q: Tensor,
        k: Tensor,
        v: Tensor,
        length: Tensor,
        slots: int,
        heads: int,
        state_token: bool,
        hidden: Tensor | None = None,
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """`plain.attention` [T, n * K], and what is kept: queries and probabilities [T * n, R].

        hidden  bool[T, 1, R]: keys that a token doesn't see besides; these operations alone take it
        """
        scale, logits = q.shape[1] ** -0.5, matmul_f32(q, k.t())
        if hidden is not None:
            logits.view(-1, heads, len(k)).masked_fill_(hidden, -torch.inf)
        probabilities = self.softmax(logits, length, slots, heads, state_token, scale, v.dtype)
        return (probabilities @ v).view(-1, heads * q.shape[1]), (q, probabilities)

    def kept_attention(self, q: Tensor, k: Tensor, v: Tensor, *seen: Any) -> list[tuple[Tensor, Tensor]]:
        """Queries [L, T * n, K], k and v [L, R, K] -> what `attention` keeps, of each layer."""
        return [self.attention(*layer, *seen)[1] for layer in zip(q, k, v, strict=True)]

    def gate_up(self, x: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """x [T, D] times weight [2F, D], which is kept: [T, 2F]; and its GeGLU [T, F]."""
        product = F.linear(x, weight)
        return product, self.geglu(product)

    def down_vjp(self, d_y: Tensor, weight: Tensor, product: Tensor) -> Tensor:
        """d_y [T, D] back through weight [D, F] and GeGLU, to its product [T, 2F]."""
        return self.geglu_vjp(d_y @ weight, product)

    def attention_vjp(
        self,
        kept: tuple[Tensor, Tensor],
        d_attended: Tensor,
        k: Tensor,
        v: Tensor,
        length: Tensor,
        slots: int,
        heads: int,
        state_token: bool,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """d_attended [T, n * K] back to the queries [T * n, K] and the suffix's keys and values [T, K]."""
        q, probabilities = kept
        d_rows = d_attended.view(q.shape)
        d_logits = self.softmax_vjp(probabilities, matmul_f32(d_rows, v.t()), q.shape[1] ** -0.5)
        return d_logits @ k, d_logits[:, slots:].t() @ q, probabilities[:, slots:].t() @ d_rows

    def qkv_vjp(self, gradients: tuple[Tensor, Tensor, Tensor], cos: Tensor, sin: Tensor, weight: Tensor) -> Tensor:
        """`attention_vjp`'s gradients back through RoPE and weight [(n + 2) * K, D]: [T, D]."""
        return self.rope_vjp(*gradients, cos, sin) @ weight


PLAIN = BetweenProducts(masked_softmax, geglu, rope_split, rms_norm_vjp, geglu_vjp, softmax_vjp, rope_vjp)
PLAIN_BACKWARD = PLAIN.ops("PyTorch, between cuBLAS's products")
