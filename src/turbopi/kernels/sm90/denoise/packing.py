"""The action expert's weights in the order in which the denoising kernel reads them: see sizes.cu.

Shapes: N steps, L layers, D width, F feed-forward width, n query heads of K columns.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.kernels.interface import GemmaLayer
from turbopi.kernels.portable.denoise.packing import KINDS as KINDS
from turbopi.kernels.portable.denoise.packing import matrix_shapes
from turbopi.kernels.portable.quantize import round_channels
from turbopi.models import family_of
from turbopi.quantization.fp8 import E4M3, Directions
from turbopi.support.errors import BackendError

BLOCK = 16  # rows of a tile, columns of a block
WARPS = 16  # that multiply
RANKS = 8  # CTAs of a cluster

Precision = Literal["bf16", "fp8"]


def refusal(config: ModelConfig) -> str | None:
    """Why the kernel can't run this model, or None if it can."""
    g = config.expert
    if not family_of(config).modulated or family_of(config).state_token:
        return f"it covers Pi0.5, this model is {config.kind}"
    if g.num_kv_heads != 1:
        return f"it needs one key/value head, this model has {g.num_kv_heads}"
    if g.num_heads % 2:
        return f"it needs an even number of heads, this model has {g.num_heads}"
    if g.width % BLOCK or g.mlp_dim % BLOCK:
        return f"widths must be multiples of {BLOCK}: width {g.width}, mlp_dim {g.mlp_dim}"
    if g.head_dim % BLOCK or g.head_dim > 256:
        return f"head_dim must be a multiple of {BLOCK} up to 256, it is {g.head_dim}"
    if config.action_dim % 4 or config.action_dim > WARPS * 32:
        return f"action_dim must be a multiple of 4 up to {WARPS * 32}, it is {config.action_dim}"
    return None


def share(count: int, parts: int, index: int) -> range:
    """Which of `count` things part `index` of `parts` has."""
    return range(count * index // parts, count * (index + 1) // parts)


def most(count: int, parts: int) -> int:
    return -(-count // parts)


@dataclass(frozen=True)
class Arrangement:
    """Who does what: see sizes.cu."""

    config: ModelConfig

    @property
    def clusters(self) -> int:
        """One a query head."""
        return self.config.expert.num_heads

    @property
    def blocks(self) -> int:
        return self.clusters * RANKS

    @property
    def max_tiles(self) -> tuple[int, int, int, int]:
        """A CTA's tiles at most: queries, keys and values, gate|up, and of a product back into the stream."""
        g = self.config.expert
        hidden = most(g.mlp_dim // BLOCK, self.clusters)
        kv = most(g.head_dim // 8, g.num_heads * RANKS)
        return most(g.head_dim // BLOCK, RANKS), kv, most(2 * hidden, RANKS), most(g.width // BLOCK, RANKS)

    def query_rows(self, cluster: int, rank: int) -> Tensor:
        """int64[tiles, 16] rows of q|k|v: of a tile 8 columns of the head's first half, then RoPE's partners."""
        head_dim = self.config.expert.head_dim
        tiles = torch.tensor(share(head_dim // BLOCK, RANKS, rank), dtype=torch.int64)
        return cluster * head_dim + _rope_rows(tiles, head_dim)

    def key_value_rows(self, cluster: int, rank: int) -> Tensor:
        """int64[tiles, 16] rows of q|k|v: keys in RoPE's pairs, values as they are."""
        g = self.config.expert
        mine = torch.tensor(share(g.head_dim // 8, g.num_heads * RANKS, cluster * RANKS + rank), dtype=torch.int64)
        keys, values = mine[mine < g.head_dim // BLOCK], mine[mine >= g.head_dim // BLOCK] - g.head_dim // BLOCK
        value_rows = (g.num_heads + 1) * g.head_dim + values[:, None] * BLOCK + torch.arange(BLOCK)
        return torch.cat((g.num_heads * g.head_dim + _rope_rows(keys, g.head_dim), value_rows))

    def hidden(self, cluster: int) -> range:
        units = share(self.config.expert.mlp_dim // BLOCK, self.clusters, cluster)
        return range(units.start * BLOCK, units.stop * BLOCK)

    def gate_up_rows(self, cluster: int, rank: int) -> Tensor:
        """int64[tiles, 16] rows of gate|up: of a tile 8 units' gate, then their up."""
        hidden = self.hidden(cluster)
        tiles = torch.tensor(share(len(hidden) // 8, RANKS, rank), dtype=torch.int64)
        units = hidden.start + tiles[:, None] * 8 + torch.arange(8)
        return torch.cat((units, units + self.config.expert.mlp_dim), dim=1)

    def stream_rows(self, rank: int) -> Tensor:
        """int64[tiles, 16] columns of the stream: of a tile the even ones, then the odd ones."""
        tiles = torch.tensor(share(self.config.expert.width // BLOCK, RANKS, rank), dtype=torch.int64)
        return tiles[:, None] * BLOCK + torch.cat((torch.arange(0, BLOCK, 2), torch.arange(1, BLOCK, 2)))

    def out_columns(self, cluster: int) -> Tensor:
        """int64[K] columns of a head's attention in the order in which they are kept: i and i + 8 in turn."""
        head_dim = self.config.expert.head_dim
        pairs = torch.stack((torch.arange(8), torch.arange(8) + 8), dim=1).flatten()
        return cluster * head_dim + (torch.arange(0, head_dim, BLOCK)[:, None] + pairs).flatten()


def _rope_rows(tiles: Tensor, head_dim: int) -> Tensor:
    first = tiles[:, None] * 8 + torch.arange(8)
    return torch.cat((first, first + head_dim // 2), dim=1)


def fragments(tiles: Tensor, max_tiles: int, padding: int, weights: Precision = "bf16") -> Tensor:
    """[tiles, 16, columns] -> flat, in the order in which a CTA reads it; filled up with `padding`."""
    count, _, columns = tiles.shape
    per = 8 if weights == "bf16" else 16  # numbers in 16 bytes, two of which are a fragment's columns
    blocks, size = most(columns, 2 * per), BLOCK * 2 * per
    tiles = torch.cat((tiles, tiles.new_full((count, BLOCK, blocks * 2 * per - columns), padding)), dim=2)
    # the tensor cores' core matrices: [rows g, or g + 8][16 bytes of columns][8 rows][16 bytes]
    ordered = tiles.view(count, 2, 8, blocks, 2, per).permute(0, 3, 1, 4, 2, 5).reshape(count, blocks, size)
    out = []
    for first in range(0, count, 8):
        # groups of 8 tiles, whose reduction has two parts, else four; in rounds of four
        rounds = 4 * (2 if max_tiles - first > 4 else 4)
        here = ordered[first : first + 8]
        padded = tiles.new_full((most(blocks, rounds) * rounds, len(here), size), padding)
        padded[:blocks] = here.transpose(0, 1)
        out.append(padded.flatten())
    return torch.cat(out) if out else tiles.new_empty(0)


@dataclass(frozen=True)
class PackedExpert:
    """The expert's matrices in the kernel's order. One serves kernels of any number of steps and suffix tokens."""

    arrangement: Arrangement
    weights: Tensor  # bfloat16 or e4m3[L, elements]: of a layer each CTA's qkv, out, gate|up, down
    index: Tensor  # int32[elements], on the host: which element of qkv, out, gate|up, down, 0 each is
    starts: Tensor  # int64[CTAs + 1]: where a CTA's begin in a layer, bytes, and the layer's end
    scales: Tensor  # float32[L, rows of qkv, out, gate|up, down] of E4M3 weights; [L, 0] of others
    inputs: Tensor  # float32[L, 4] of the activations that meet E4M3 weights, out's a power of two; [L, 0] of others

    @classmethod
    def pack(
        cls,
        config: ModelConfig,
        layers: list[GemmaLayer],
        inputs: Mapping[str, float] | None = None,
        directions: Mapping[str, Directions] | None = None,
        device: torch.device | None = None,
    ) -> "PackedExpert":
        """`inputs`: the activations' scales by site, and weights become E4M3 with a scale for each output channel,
        rounded for `directions` by site. The layers come to the `device`, if one is named, one at a time.

        Raises BackendError for sizes that the kernel doesn't cover.
        """
        reason = refusal(config)
        if reason is not None:
            raise BackendError(f"the denoising kernel can't run this model: {reason}")
        arrangement = Arrangement(config)
        streams = _streams(arrangement, "bf16" if inputs is None else "fp8")
        device, size = device or layers[0].qkv.device, 2 if inputs is None else 1
        index = torch.cat(streams).to(device)
        starts = np.cumsum([0, *(size * len(stream) for stream in streams)])
        packed, scales = torch.empty(len(layers), len(index) * size, dtype=torch.uint8, device=device), []
        for i, (row, layer) in enumerate(zip(packed, layers, strict=True)):
            parts = [matrix.to(device) for matrix in (layer.qkv, layer.out, layer.gate_up, layer.down)]
            if inputs is not None:
                common = [(directions or {}).get(f"expert.{i}.{kind}") for kind in KINDS]
                made = [round_channels(m, d) for m, d in zip(parts, common, strict=True)]
                bits = [matrix.data.view(torch.uint8) for matrix in made]
                scales.append(torch.cat([matrix.scale for matrix in made]))
            else:
                bits = [part.to(torch.bfloat16).contiguous().view(torch.int16) for part in parts]
                scales.append(torch.empty(0, device=device))
            flat = torch.cat([*(part.flatten() for part in bits), bits[0].new_zeros(1)])
            torch.index_select(flat, 0, index, out=row.view(flat.dtype))
        typed = packed.view(torch.bfloat16 if inputs is None else E4M3)
        given = [[] if inputs is None else [inputs[f"expert.{i}.{kind}"] for kind in KINDS] for i in range(len(layers))]
        of_inputs = torch.tensor(given, dtype=torch.float32, device=device)
        if inputs is not None:  # exact, as the kernel applies it to values in bfloat16
            of_inputs[:, 1] = torch.exp2(torch.log2(of_inputs[:, 1]).ceil())
        return cls(arrangement, typed, index.cpu(), torch.from_numpy(starts).to(device), torch.stack(scales), of_inputs)

    @property
    def layer_bytes(self) -> int:
        return self.weights.stride(0) * self.weights.element_size()

    @property
    def fp8(self) -> bool:
        return self.weights.dtype == E4M3

    def row_scales(self, layer: int) -> tuple[Tensor, ...]:
        """float32 of the output channels of a layer's qkv, out, gate|up and down; E4M3 weights alone have them."""
        return torch.split(self.scales[layer], [rows for rows, _ in matrix_shapes(self.arrangement.config.expert)])

    def matrices(self, layer: int) -> tuple[Tensor, ...]:
        """A layer's qkv, out, gate|up and down as they were before packing; of E4M3 weights what they stand for, in
        float32.
        """
        shapes = matrix_shapes(self.arrangement.config.expert)
        sizes = [rows * columns for rows, columns in shapes]
        values = self.weights[layer].float() if self.fp8 else self.weights[layer]
        flat = values.new_zeros(sum(sizes) + 1)
        flat[self.index.to(flat.device)] = values
        parts = [part.view(shape) for part, shape in zip(torch.split(flat[:-1], sizes), shapes, strict=True)]
        if self.fp8:
            parts = [part * scale[:, None] for part, scale in zip(parts, self.row_scales(layer), strict=True)]
        return tuple(parts)


def _streams(a: Arrangement, weights: Precision) -> list[Tensor]:
    """int32 of each CTA: the elements of qkv, out, gate|up, down in the order in which it reads them."""
    shapes = matrix_shapes(a.config.expert)
    offsets = np.cumsum([0, *(rows * columns for rows, columns in shapes)]).tolist()
    padding = offsets[-1]
    qkv, out, gate_up, down = (
        torch.arange(start, start + rows * columns, dtype=torch.int32).view(rows, columns)
        for start, (rows, columns) in zip(offsets[:-1], shapes, strict=True)
    )
    queries, keys_values, gates, slice_tiles = a.max_tiles
    streams = []
    for cluster in range(a.clusters):
        hidden = a.hidden(cluster)
        for rank in range(RANKS):
            rows = a.stream_rows(rank)
            qkv_rows = torch.cat((a.query_rows(cluster, rank), a.key_value_rows(cluster, rank)))
            products = [
                fragments(qkv[qkv_rows], queries + keys_values, padding, weights),
                fragments(out[rows][:, :, a.out_columns(cluster)], slice_tiles, padding, weights),
                fragments(gate_up[a.gate_up_rows(cluster, rank)], gates, padding, weights),
                fragments(down[rows][:, :, hidden.start : hidden.stop], slice_tiles, padding, weights),
            ]
            streams.append(torch.cat(products))
    return streams


def _row_index(a: Arrangement) -> Tensor:
    """int64[CTAs, tiles, 16]: which row of qkv, then of gate|up, a CTA's rows are; those it lacks are beyond both."""
    queries, keys_values, gates, _ = a.max_tiles
    num_qkv = matrix_shapes(a.config.expert)[0][0]
    index = torch.full((a.blocks, queries + keys_values + gates, BLOCK), num_qkv + 2 * a.config.expert.mlp_dim)
    for cta in range(a.blocks):
        cluster, rank = divmod(cta, RANKS)
        first = 0
        for rows, room in (
            (a.query_rows(cluster, rank), queries),
            (a.key_value_rows(cluster, rank), keys_values),
            (a.gate_up_rows(cluster, rank) + num_qkv, gates),
        ):
            index[cta, first : first + len(rows)] = rows
            first += room
    return index


@dataclass(frozen=True)
class Tables:
    """What the kernel needs beside the weights. Scales of E4M3 numbers are in it, so that the kernel applies none."""

    modulation: Tensor  # float32[N, 2L + 1, 3, D]
    shifted: Tensor  # float32[N, L, CTAs, tiles, 16]: what the norms' shifts add to the products behind them
    row_scales: Tensor  # float32[L, CTAs, tiles, 16] of the rows of qkv and gate|up; [L, 0] of bfloat16
    values_times: Tensor  # float32[L, 1]; [L, 0] of bfloat16

    @classmethod
    def make(cls, packed: PackedExpert, table: Tensor) -> "Tables":
        """table float32[N, 2L + 1, 3, D], see `engine.weights.modulation`"""
        index, depth = _row_index(packed.arrangement).to(table.device), packed.arrangement.config.expert.depth
        modulation, shifted, rows, inputs = table.clone() if packed.fp8 else table, [], [], packed.inputs
        for i in range(depth):
            qkv, _, gate_up, _ = packed.matrices(i)
            products = [table[:, 2 * i + j, 1].double() @ m.double().T for j, m in enumerate((qkv, gate_up))]
            if packed.fp8:
                of_qkv, of_out, of_gate_up, of_down = packed.row_scales(i)
                stream, attended, stream_2, hidden = inputs[i]
                modulation[:, 2 * i, 0] /= stream
                modulation[:, 2 * i, 2] *= of_out * attended
                modulation[:, 2 * i + 1, 0] /= stream_2
                modulation[:, 2 * i + 1, 2] *= of_down * hidden
                # attention's outputs are means of values, hidden units are linear in up's rows
                after_qkv, after_gate_up = torch.ones_like(of_qkv), torch.ones_like(of_gate_up)
                after_qkv[-packed.arrangement.config.expert.head_dim :] /= attended
                after_gate_up[len(after_gate_up) // 2 :] /= hidden
                products = [products[0] * after_qkv, products[1] * after_gate_up]
                scales = of_qkv * stream * after_qkv, of_gate_up * stream_2 * after_gate_up
                rows.append(torch.cat((*scales, of_qkv.new_zeros(1)))[index])
            shifted.append(torch.cat((*products, products[0].new_zeros(len(table), 1)), dim=1).float()[:, index])
        row_scales = torch.stack(rows) if rows else inputs
        return cls(modulation, torch.stack(shifted, dim=1).contiguous(), row_scales.contiguous(), 1 / inputs[:, 1:2])
