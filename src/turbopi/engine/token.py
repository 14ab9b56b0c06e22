"""One more token of a model that writes its actions as tokens, by kernels/portable/token.py: six launches a layer.

It computes `Writer.step` in the same buffers, with fewer roundings.
"""

import torch
import triton
from torch import Tensor, nn

from turbopi.config import ModelConfig, Pi0FastConfig
from turbopi.kernels.portable import token as kernels
from turbopi.models.pi0.decoding import Decoding, Writer
from turbopi.models.pi0.layers import rope_tables


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


class JoinedWeights:
    """Each layer's projections to queries, keys and values in one matrix, of which the model's own become views."""

    @torch.no_grad()
    def __init__(self, model: Writer) -> None:
        self.of_layers: list[Tensor] = []
        for layer in model.vlm.layers:
            own = [getattr(layer.self_attn, f"{name}_proj") for name in "qkv"]
            joined = torch.cat([one.weight for one in own])
            for one, part in zip(own, torch.split(joined, [len(one.weight) for one in own]), strict=True):
                one.weight = nn.Parameter(part, requires_grad=False)
            self.of_layers.append(joined)


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
        for layer, qkv, keys, values in zip(vlm.layers, self._joined.of_layers, of.keys, of.values, strict=True):
            kernels.row_product(row, qkv, self._qkv, norm=layer.input_layernorm, eps=eps)
            places = keys, values, self._valid, of.place, of.position
            kernels.attend_places(self._qkv, self._rope, *places, self._shares)
            kernels.join_shares(self._shares, self._attended)
            kernels.row_product(self._attended, layer.self_attn.o_proj.weight, row, add=True)
            norm, gated = layer.post_attention_layernorm, layer.mlp
            up = gated.up_proj.weight
            kernels.row_product(row, gated.gate_proj.weight, self._hidden, norm=norm, eps=eps, beside=up)
            kernels.row_product(self._hidden, gated.down_proj.weight, row, add=True)
        kernels.row_product(row, self._model.head, of.logits, norm=vlm.norm, eps=eps)
        for first, behind in self._model.never:
            of.logits[:, first:behind] = -torch.inf
        counters = of.chosen, of.ids, of.count, of.place, of.position
        kernels.choose(of.logits, self._best, self._where, *counters, of.ends, self._ended)
