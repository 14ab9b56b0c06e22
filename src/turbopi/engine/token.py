"""One more token of a model that writes its actions as tokens, by kernels/portable/token.py: six launches a layer.

It computes `Pi0FastModel.step` in the same buffers, with fewer roundings.
"""

import math

import torch
import triton
from torch import Tensor, nn

from turbopi.config import Pi0FastConfig
from turbopi.kernels.dependent_launch import dependent_launch
from turbopi.kernels.portable import token as kernels
from turbopi.models.pi0.layers import rope_tables
from turbopi.models.pi0_fast.reference import Decoding, Pi0FastModel

PLACES = 32  # of keys and values, a program's
LOGITS = 2048  # among which a program finds the best
ROWS, BLOCK = 4, 2048  # of a weight, a program's at a time: 16 KB in flight are the fastest, whatever the weight's size


def refuses(config: Pi0FastConfig) -> str | None:
    """Why a model of these sizes isn't for these kernels; None: it is."""
    text = config.vlm
    if text.num_kv_heads != 1:
        return f"{text.num_kv_heads} key/value heads; expected 1"
    if text.head_dim & (text.head_dim - 1):
        return f"heads of {text.head_dim} numbers; expected a power of 2"
    if text.width > 4096:
        return f"width {text.width}; expected at most 4096"
    return None


class JoinedWeights:
    """Each layer's projections to queries, keys and values in one matrix, of which the model's own become views."""

    @torch.no_grad()
    def __init__(self, model: Pi0FastModel) -> None:
        self.of_layers: list[Tensor] = []
        for layer in model.vlm.layers:
            own = [getattr(layer.self_attn, f"{name}_proj") for name in "qkv"]
            joined = torch.cat([one.weight for one in own])
            for one, part in zip(own, torch.split(joined, [len(one.weight) for one in own]), strict=True):
                one.weight = nn.Parameter(part, requires_grad=False)
            self.of_layers.append(joined)


class TokenStep:
    """Writes the next id of one observation: call it behind `model.begin(observation, decoding)`."""

    def __init__(self, model: Pi0FastModel, joined: JoinedWeights, decoding: Decoding) -> None:
        config, text, device = model.config, model.config.vlm, model.device
        self._model, self._joined, self._decoding, self._text = model, joined, decoding, text
        self._eps, self._half = config.rms_norm_eps, text.head_dim // 2
        places = decoding.valid.shape[1]
        positions = torch.arange(places + 2, device=device)[None]
        self._cos, self._sin = (
            one[0, 0].contiguous() for one in rope_tables(positions, text.head_dim, config.rope_base)
        )
        self._shares, self._best_shares = triton.cdiv(places, PLACES), triton.cdiv(config.vocab_size, LOGITS)

        def numbers(*size: int) -> Tensor:
            return torch.zeros(size, device=device)

        self._row, self._attended = numbers(text.width), numbers(text.num_heads * text.head_dim)
        self._qkv, self._hidden = numbers((text.num_heads + 2) * text.head_dim), numbers(text.mlp_dim)
        self._partial = numbers(self._shares, text.num_heads, text.head_dim)
        self._most, self._total = numbers(self._shares, text.num_heads), numbers(self._shares, text.num_heads)
        self._best = numbers(self._best_shares)
        self._where = torch.zeros(self._best_shares, dtype=torch.int32, device=device)
        self._valid, self._ended = decoding.valid.view(torch.uint8), decoding.ended.view(torch.uint8)

    def __call__(self) -> None:
        of, text, launch = self._decoding, self._text, dependent_launch(self._row)
        table, blocks = self._model.vlm.embed_tokens.weight, triton.next_power_of_2
        kernels.embed_id[(1,)](
            of.chosen, table, self._row, text.width, math.sqrt(text.width), BLOCK=blocks(text.width), **launch
        )
        layers = zip(self._model.vlm.layers, self._joined.of_layers, of.keys, of.values, strict=True)
        for layer, joined, keys, values in layers:
            self._product(self._row, joined, self._qkv, norm=layer.input_layernorm)
            kernels.attend_places[self._shares, text.num_heads](
                self._qkv, self._cos, self._sin, keys, values, self._valid, of.place, of.position,
                self._partial, self._most, self._total, text.head_dim**-0.5,
                HEADS=text.num_heads, HALF=self._half, PLACES=PLACES, **launch,
            )  # fmt: skip
            kernels.join_shares[(text.num_heads,)](
                self._partial, self._most, self._total, self._attended, self._shares,
                HEADS=text.num_heads, WIDTH=text.head_dim, SHARES=blocks(self._shares), num_warps=8, **launch,
            )  # fmt: skip
            self._product(self._attended, layer.self_attn.o_proj.weight, self._row, add=True)
            norm, gated = layer.post_attention_layernorm, layer.mlp
            self._product(self._row, gated.gate_proj.weight, self._hidden, norm=norm, beside=gated.up_proj.weight)
            self._product(self._hidden, gated.down_proj.weight, self._row, add=True)
        self._product(self._row, table, of.logits, norm=self._model.vlm.norm)
        kernels.best_of_share[(self._best_shares,)](
            of.logits, self._best, self._where, of.logits.shape[1], BLOCK=LOGITS, **launch
        )
        kernels.choose[(1,)](
            self._best, self._where, of.chosen, of.ids, of.count, of.place, of.position, of.ends, self._ended,
            self._best_shares, len(of.ends),
            SHARES=blocks(self._best_shares), ENDS=blocks(max(1, len(of.ends))), **launch,
        )  # fmt: skip

    def _product(
        self,
        row: Tensor,
        weight: Tensor,
        out: Tensor,
        *,
        norm: nn.Module | None = None,
        beside: Tensor | None = None,
        add: bool = False,
    ) -> None:
        rows, width = weight.shape
        whole, other = triton.next_power_of_2(width), weight if beside is None else beside
        kernels.row_product[(triton.cdiv(rows, ROWS),)](
            row, row if norm is None else norm.get_parameter("weight"), weight, other, out, rows, width, self._eps,
            NORM=norm is not None, GATED=beside is not None, ADD=add,
            ROWS=ROWS, BLOCK=whole if norm is not None else min(BLOCK, whole), num_warps=4, **dependent_launch(row),
        )  # fmt: skip
