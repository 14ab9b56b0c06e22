"""The action expert's weights in the order in which the portable denoising kernel reads them: see sizes.cu.

Shapes: N steps, L layers, D width, F feed-forward width, n query heads of K columns.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

from turbopi.config import GemmaConfig, ModelConfig
from turbopi.kernels.interface import GemmaLayer
from turbopi.kernels.portable.quantize import round_channels
from turbopi.models import family_of
from turbopi.quantization import sites
from turbopi.quantization.formats import FP8, Format
from turbopi.quantization.fp8 import E4M3, Directions
from turbopi.support.errors import BackendError

TILE = 8  # output channels
CHUNK_BYTES = 64  # of a channel: the part of the reduction of which a lane has 16 bytes
WeightNumbers = Literal["bf16", "fp8", "int8"]
KINDS = sites.KINDS["expert"]  # a layer's matrices, in the order in which they are read


class Expert(Protocol):
    """What the kernel asks about a model: `ModelConfig` of Pi0.5, or another family's sizes."""

    @property
    def expert(self) -> GemmaConfig: ...
    @property
    def action_dim(self) -> int: ...
    @property
    def rms_norm_eps(self) -> float: ...
    @property
    def rope_base(self) -> float: ...


@dataclass(frozen=True)
class Form:
    """What an expert does otherwise than Pi0.5's, for which the defaults stand.

    modulated   each step has norms' weights of its own; else the time is mixed into the tokens, by an MLP
    self_every  so many-th layers attend to prefix and suffix, the others to the prefix alone, through keys and values
                of their own and with tokens counted from 0; 0: all others
    causal      a token of the suffix doesn't see those behind it
    silu        SwiGLU, not GeGLU
    """

    modulated: bool = True
    self_every: int = 1
    causal: bool = False
    silu: bool = False

    def is_self(self, layer: int) -> bool:
        return self.self_every > 0 and layer % self.self_every == 0


PI05 = Form()


def refusal(config: ModelConfig) -> str | None:
    """Why the kernel can't run this model of Pi0's kind, or None if it can."""
    g = config.expert
    if not family_of(config).modulated or family_of(config).state_token:
        return f"it covers Pi0.5, this model is {config.kind}"
    if g.num_kv_heads != 1:
        return f"it needs one key/value head, this model has {g.num_kv_heads}"
    return refusal_of_sizes(g)


def refusal_of_sizes(g: GemmaConfig) -> str | None:
    if g.width % 16 or g.mlp_dim % 16:
        return f"widths must be multiples of 16: width {g.width}, mlp_dim {g.mlp_dim}"
    if g.head_dim % 16 or g.head_dim > 256:
        return f"head_dim must be a multiple of 16 up to 256, it is {g.head_dim}"
    return None


def matrix_shapes(g: GemmaConfig) -> list[tuple[int, int]]:
    """(rows, columns) of a layer's qkv, out, gate|up and down."""
    heads = g.num_heads * g.head_dim
    return [
        (heads + 2 * g.num_kv_heads * g.head_dim, g.width),
        (g.width, heads),
        (2 * g.mlp_dim, g.width),
        (g.width, g.mlp_dim),
    ]


def qkv_rows(g: GemmaConfig) -> Tensor:
    """int64[rows]: which row of q|k|v each channel is. Of queries and keys RoPE's partners are neighbours."""
    half = g.head_dim // 2
    paired = torch.arange(g.head_dim).view(2, half).T.flatten()
    turned = g.num_heads + g.num_kv_heads
    heads = [head * g.head_dim + paired for head in range(turned)]
    return torch.cat([*heads, turned * g.head_dim + torch.arange(g.num_kv_heads * g.head_dim)])


def gate_up_rows(g: GemmaConfig) -> Tensor:
    """int64[rows]: which row of gate|up each channel is: a unit's gate, then its up."""
    return torch.arange(2 * g.mlp_dim).view(2, g.mlp_dim).T.flatten()


def int8_columns() -> Tensor:
    """int64[64]: which column of a chunk each place has. A lane has 16 bytes: of both halves of the chunk those columns
    that it has of bfloat16, four by four in the order 0, 2, 1, 3.
    """
    places = torch.arange(CHUNK_BYTES).view(2, 4, 2, 2, 2)  # half, lane, word, pair, which of the pair
    return places.permute(1, 0, 2, 4, 3).flatten()


def tiles(matrix: Tensor) -> Tensor:
    """[rows, columns] -> flat [tile][chunk][8 rows][columns of a chunk], zeros beyond the columns."""
    rows, columns = matrix.shape
    chunk = CHUNK_BYTES // matrix.element_size()
    chunks = -(-columns // chunk)
    padded = matrix.new_zeros(rows, chunks * chunk)
    padded[:, :columns] = matrix
    of_chunks = padded.view(rows // TILE, TILE, chunks, chunk)
    if matrix.dtype == torch.int8:
        of_chunks = of_chunks[..., int8_columns().to(matrix.device)]
    return of_chunks.transpose(1, 2).flatten()


@dataclass(frozen=True)
class PackedExpert:
    """The expert's matrices in the kernel's order. One serves kernels of any number of steps, tokens and blocks."""

    config: Expert
    weights: Tensor  # bfloat16, e4m3 or int8[L, elements]: of a layer qkv, out, gate|up, down
    scales: (
        Tensor  # float32[L, rows of qkv, out, gate|up, down] of weights of eight bits, in the matrices' order; [L, 0]
    )
    inputs: Tensor  # float32[L, 4] of the activations that meet E4M3 weights, 1 of int8's; [L, 0] of others
    form: Form = PI05

    @classmethod
    def pack(
        cls,
        config: Expert,
        layers: Iterable[GemmaLayer],
        inputs: Mapping[str, float] | None = None,
        directions: Mapping[str, Directions] | None = None,
        format: Format = FP8,
        device: torch.device | None = None,
        form: Form = PI05,
    ) -> "PackedExpert":
        """`inputs`: the activations' scales by site (1 for INT8, which leaves them in bfloat16), and weights become
        numbers of the format with a scale for each output channel, rounded for `directions` by site. The layers come
        to the `device`, if one is named, one at a time.

        Raises BackendError for sizes that the kernel doesn't cover.
        """
        reason = refusal(config) if isinstance(config, ModelConfig) else refusal_of_sizes(config.expert)
        if reason is not None:
            raise BackendError(f"the portable denoising kernel can't run this model: {reason}")
        scales, of_inputs = [], []
        depth, orders, weights = config.expert.depth, list(_orders(config.expert)), torch.empty(0)
        for i, layer in zip(range(depth), layers, strict=True):
            if i == 0:
                device = device or layer.qkv.device
                orders = [None if order is None else order.to(device) for order in orders]
            parts = [matrix.to(device) for matrix in (layer.qkv, layer.out, layer.gate_up, layer.down)]
            places = [f"expert.{i}.{kind}" for kind in KINDS]
            if inputs is not None:
                common = [(directions or {}).get(place) for place in places]
                made = [round_channels(m, d, format) for m, d in zip(parts, common, strict=True)]
                parts = [m.data if m.numbers == torch.int8 else m.data.view(torch.uint8) for m in made]
                scales.append(torch.cat([matrix.scale for matrix in made]))
                of_inputs.append([inputs[place] for place in places])
            else:
                parts = [part.to(torch.bfloat16) for part in parts]
            ordered = [m if order is None else m[order] for m, order in zip(parts, orders, strict=True)]
            flat = torch.cat([tiles(m) for m in ordered])
            weights = flat.new_empty(depth, len(flat)) if i == 0 else weights
            weights[i] = flat
        none = torch.empty(depth, 0, device=weights.device)
        return cls(
            config,
            weights if inputs is None else weights.view(format.dtype),
            torch.stack(scales) if scales else none,
            torch.tensor(of_inputs, dtype=torch.float32, device=weights.device) if of_inputs else none,
            form,
        )

    @property
    def numbers(self) -> WeightNumbers:
        return {torch.bfloat16: "bf16", E4M3: "fp8", torch.int8: "int8"}[self.weights.dtype]  # type: ignore[return-value]

    @property
    def scaled(self) -> bool:
        """Whether weights have eight bits, and each output channel a scale."""
        return self.numbers != "bf16"

    def row_scales(self, layer: int) -> tuple[Tensor, ...]:
        """float32 of the output channels of a layer's qkv, out, gate|up and down, where `scaled`."""
        return torch.split(self.scales[layer], [rows for rows, _ in matrix_shapes(self.config.expert)])

    def matrices(self, layer: int) -> tuple[Tensor, ...]:
        """A layer's qkv, out, gate|up and down as they were before packing; where `scaled` what they stand for, in
        float32.
        """
        g, found, at = self.config.expert, [], 0
        chunk = CHUNK_BYTES // self.weights.element_size()
        flat = self.weights[layer].float() if self.scaled else self.weights[layer]
        for k, ((rows, columns), order) in enumerate(zip(matrix_shapes(g), _orders(g), strict=True)):
            size = rows * -(-columns // chunk) * chunk
            part = flat[at : at + size].view(rows // TILE, -1, TILE, chunk)
            if self.numbers == "int8":
                stored, part = part, torch.empty_like(part)
                part[..., int8_columns().to(part.device)] = stored
            ordered = part.transpose(1, 2).reshape(rows, -1)[:, :columns]
            matrix = torch.empty_like(ordered)
            matrix[torch.arange(rows) if order is None else order] = ordered
            found.append(matrix * self.row_scales(layer)[k][:, None] if self.scaled else matrix)
            at += size
        return tuple(found)


def _orders(g: GemmaConfig) -> tuple[Tensor | None, ...]:
    return qkv_rows(g), None, gate_up_rows(g), None


@dataclass(frozen=True)
class Tables:
    """What the kernel needs beside the weights. Scales of eight bits are in it, so that the kernel applies few."""

    modulation: Tensor  # float32[N, 2L + 1, 3, D]; N is 1 where a step has none of its own
    shifted: Tensor  # float32[N, L, channels of qkv, gate|up]: what the norms' shifts add to the products behind them
    row_scales: Tensor  # float32[L, channels of qkv, gate|up]; [L, 0] of bfloat16
    attended_times: Tensor  # float32[L]: 1 / scale of attention's outputs; empty of bfloat16

    @classmethod
    def make(cls, packed: PackedExpert, table: Tensor) -> "Tables":
        """table float32[N, 2L + 1, 3, D], see `engine.weights.modulation`"""
        g = packed.config.expert
        qkv_order, gate_up_order = qkv_rows(g).to(table.device), gate_up_rows(g).to(table.device)
        modulation, shifted, rows = table.clone() if packed.scaled else table, [], []
        for i in range(g.depth):
            qkv, _, gate_up, _ = packed.matrices(i)
            products = [table[:, 2 * i + j, 1].double() @ m.double().T for j, m in enumerate((qkv, gate_up))]
            if packed.scaled:
                of_qkv, of_out, of_gate_up, of_down = packed.row_scales(i)
                stream, attended, stream_2, hidden = packed.inputs[i]
                modulation[:, 2 * i, 0] /= stream
                modulation[:, 2 * i, 2] *= of_out * attended
                modulation[:, 2 * i + 1, 0] /= stream_2
                modulation[:, 2 * i + 1, 2] *= of_down * hidden
                after = torch.ones_like(of_gate_up)  # hidden units are linear in up's rows
                after[g.mlp_dim :] /= hidden
                products[1] = products[1] * after
                rows.append(torch.cat(((of_qkv * stream)[qkv_order], (of_gate_up * stream_2 * after)[gate_up_order])))
            shifted.append(torch.cat((products[0][:, qkv_order], products[1][:, gate_up_order]), dim=1).float())
        row_scales = torch.stack(rows) if rows else packed.inputs
        times = 1 / packed.inputs[:, 1] if packed.scaled else packed.inputs[:, 0:0]
        return cls(modulation, torch.stack(shifted, dim=1).contiguous(), row_scales.contiguous(), times.contiguous())
