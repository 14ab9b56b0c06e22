"""One more token of a model that writes its actions as tokens, by kernels/portable/token.py: six launches a layer.

It computes `Writer.step` in the same buffers, with fewer roundings.
"""

from dataclasses import dataclass

import torch
import triton
from torch import Tensor, nn

from turbopi.config import ModelConfig, Pi0FastConfig
from turbopi.kernels.portable import token as kernels
from turbopi.kernels.portable.token import Int8Rows, Weight
from turbopi.models.pi0.decoding import Decoding, Writer
from turbopi.models.pi0.layers import rope_tables

ROWS = 1 << 14  # of a matrix that are rounded at a time, for which float32 has to have room


def refuses(config: Pi0FastConfig | ModelConfig) -> str | None:
    """Why a model of these sizes isn't for these kernels; None: it is."""
    text = config.vlm
    if text.num_kv_heads != 1:
        return f"{text.num_kv_heads} key/value heads; expected 1"
    if text.head_dim & (text.head_dim - 1):
        return f"heads of {text.head_dim} numbers; expected a power of 2"
    if text.width > 4096:
        return f"width {text.width}; expected at most 4096"
    return None


@dataclass(frozen=True)
class LayerWeights:
    """[out, in] each; `qkv`: the queries', keys' and values' rows."""

    qkv: Weight
    out: Weight
    gate: Weight
    up: Weight
    down: Weight


class JoinedWeights:
    """The matrices of a token. Each layer's projections to queries, keys and values are one matrix, of which the
    model's own become views.

    int8    beside the model's own, which read the prefix, in INT8: symmetric, with a scale for each row. Activations
            stay float32, so nothing has to be calibrated
    """

    @torch.no_grad()
    def __init__(self, model: Writer, *, int8: bool = False) -> None:
        self.layers: list[LayerWeights] = []
        for layer in model.vlm.layers:
            own = [getattr(layer.self_attn, f"{name}_proj") for name in "qkv"]
            joined = torch.cat([one.weight for one in own])
            for one, part in zip(own, torch.split(joined, [len(one.weight) for one in own]), strict=True):
                one.weight = nn.Parameter(part, requires_grad=False)
            mlp = layer.mlp
            others = (layer.self_attn.o_proj, mlp.gate_proj, mlp.up_proj, mlp.down_proj)
            matrices = [joined, *(one.weight.detach() for one in others)]
            self.layers.append(LayerWeights(*(_rounded(one) if int8 else one for one in matrices)))
        self.head: Weight = _rounded(model.head) if int8 else model.head


def _rounded(weight: Tensor) -> Int8Rows:
    parts = [Int8Rows.of(rows) for rows in torch.split(weight.detach(), ROWS)]
    return Int8Rows(torch.cat([one.words for one in parts]), torch.cat([one.scale for one in parts]))


class TokenStep:
    """Writes the next id of one observation: call it behind `model.read_prefix(decoding, …)`."""

    def __init__(self, model: Writer, joined: JoinedWeights, decoding: Decoding) -> None:
        config, text, device = model.config, model.config.vlm, decoding.ids.device
        self._model, self._joined, self._decoding = model, joined, decoding
        places = decoding.valid.shape[1]
        positions = torch.arange(places + 2, device=device)[None]
        cos, sin = rope_tables(positions, text.head_dim, config.rope_base)
        self._rope = cos[0, 0].contiguous(), sin[0, 0].contiguous()

        def numbers(*size: int) -> Tensor:
            return torch.zeros(size, device=device)

        heads, shares = text.num_heads, triton.cdiv(places, kernels.PLACES)
        self._row, self._hidden = numbers(text.width), numbers(text.mlp_dim)
        self._qkv, self._attended = numbers((heads + 2) * text.head_dim), numbers(heads * text.head_dim)
        self._shares = numbers(shares, heads, text.head_dim), numbers(shares, heads), numbers(shares, heads)
        self._best = numbers(triton.cdiv(config.vocab_size, kernels.LOGITS))
        self._where = torch.zeros_like(self._best, dtype=torch.int32)
        self._valid, self._ended = decoding.valid.view(torch.uint8), decoding.ended.view(torch.uint8)

    def __call__(self) -> None:
        of, vlm, row, eps = self._decoding, self._model.vlm, self._row, self._model.config.rms_norm_eps
        kernels.embed_id(of.chosen, vlm.embed_tokens.weight, row)
        for layer, own, keys, values in zip(vlm.layers, self._joined.layers, of.keys, of.values, strict=True):
            kernels.row_product(row, own.qkv, self._qkv, norm=layer.input_layernorm, eps=eps)
            places = keys, values, self._valid, of.place, of.position
            kernels.attend_places(self._qkv, self._rope, *places, self._shares)
            kernels.join_shares(self._shares, self._attended)
            kernels.row_product(self._attended, own.out, row, add=True)
            norm = layer.post_attention_layernorm
            kernels.row_product(row, own.gate, self._hidden, norm=norm, eps=eps, beside=own.up)
            kernels.row_product(self._hidden, own.down, row, add=True)
        kernels.row_product(row, self._joined.head, of.logits, norm=vlm.norm, eps=eps)
        for first, behind in self._model.never:
            of.logits[:, first:behind] = -torch.inf
        counters = of.chosen, of.ids, of.count, of.place, of.position
        kernels.choose(of.logits, self._best, self._where, *counters, of.ends, self._ended)
