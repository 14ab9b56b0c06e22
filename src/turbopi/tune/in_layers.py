"""The action expert's operations of a batch, timed where they run: within its layers.

A denoising step of a batch is kernels of 2 to 9 microseconds, and each may start beside the end of the one before.
Which of them find room there decides more than what a tile takes alone: on an H200 the tiles that were fastest alone
made a step of sixteen observations slower than those of the cost model, docs/dev/log.md.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.engine import forward
from turbopi.kernels.interface import GemmaLayer, Ops
from turbopi.kernels.ops import ops_of
from turbopi.kernels.plain_batch import PLAIN_BATCH
from turbopi.kernels.portable.quantize import quantize
from turbopi.kernels.tile_table import Kernels, Knobs, TileTable
from turbopi.models import family_of
from turbopi.quantization.fp8 import Matrix
from turbopi.tune.gpu import GpuBench, prefixes_in_a_row, random
from turbopi.tune.race import Round
from turbopi.tune.shapes import Operation

INPUT_SCALE = 0.02
GATE = 0.1  # of the norms' random modulation: the residual stream stays of the same size through all layers
LEAST_MICROSECONDS = 5000.0  # of a round: what a tile gains is small beside all layers


@dataclass(frozen=True)
class LayersOf:
    """Whose layers: `tokens` of each suffix behind `prefix_rows` rows of each of `batch` observations."""

    kernels: Kernels
    fp8: bool
    batch: int
    tokens: int
    prefix_rows: int

    @classmethod
    def of(cls, one: Operation) -> "LayersOf":
        fp8 = one.numbers == "fp8" or one.out_fp8
        return cls(one.kernels, fp8, one.batch, one.rows // one.batch, one.prefix_rows)


class ExpertLayers:
    """All layers of the expert as a denoising step of a batch runs them, with random weights, keys and values."""

    def __init__(self, config: ModelConfig, of: LayersOf, device: torch.device) -> None:
        g, self._of, self._config, self._device = config.expert, of, config, device
        self._generator = torch.Generator(device).manual_seed(1)
        rows, prefix = of.batch * of.tokens, of.batch * of.prefix_rows
        heads = g.num_heads * g.head_dim
        norm = None if family_of(config).modulated else torch.ones(g.width, device=device)
        self._layers = [
            GemmaLayer(
                self._matrix(heads + 2 * g.head_dim, g.width),
                self._matrix(g.width, heads),
                self._matrix(2 * g.mlp_dim, g.width),
                self._matrix(g.width, g.mlp_dim),
                norm,
                norm,
            )
            for _ in range(g.depth)
        ]
        modulation = GATE * self._random(2 * g.depth + 1, 3, g.width).float()
        modulation[:, 0] += 1  # the norms' scales
        self._table = modulation if family_of(config).modulated else None
        self._tokens = self._random(rows, g.width)
        angles = 6 * self._random(rows, g.head_dim // 2).float()
        self._rope = angles.cos(), angles.sin()
        self._keys, self._values = (self._random(g.depth, prefix, g.head_dim) for _ in range(2))
        self._segments = prefixes_in_a_row(of.batch, of.prefix_rows, device)

    @property
    def depth(self) -> int:
        return len(self._layers)

    def run(self, ops: Ops) -> Tensor:
        """The residual stream [batch * tokens, D] in front of the last layer's `down`."""
        config, batched = self._config, ops.batch or PLAIN_BATCH

        def attend(i: int, qkv: Tensor, **input: float) -> Tensor:
            places = self._keys[i], self._values[i], *self._segments
            return batched.suffix_attention(
                qkv, *self._rope, *places, config.expert.num_heads, family_of(config).state_token, **input
            )

        return forward.expert_layers(config, self._layers, batched.expert(ops), self._tokens, self._table, attend)[0]

    def ops(self, tiles: TileTable) -> Ops:
        return ops_of(self._of.kernels, self._device, tiles)

    def _matrix(self, rows: int, columns: int) -> Matrix:
        weight = self._random(rows, columns) / columns**0.5
        return quantize(weight, INPUT_SCALE) if self._of.fp8 else weight

    def _random(self, *shape: int) -> Tensor:
        return random(shape, self._generator)


@dataclass(frozen=True)
class InLayers:
    """A `race.Bench` of one operation, whose tiles are compiled and checked alone and timed in `layers`.

    tiles  what the other operations run in
    """

    alone: GpuBench
    layers: ExpertLayers
    tiles: TileTable
    margin = 0.003  # of a layer's time; repeated, medians of rounds differ by a third of that

    @property
    def bound(self) -> float:
        return self.alone.bound

    def prepare(self, candidates: Sequence[Knobs]) -> Mapping[int, str]:
        return self.alone.prepare(candidates)

    def error(self, knobs: Knobs) -> float:
        return self.alone.error(knobs)

    def timer(self, knobs: Knobs) -> Round:
        """Microseconds of one layer."""
        ops = self.layers.ops(self.tiles.with_tile(self.alone.operation.key, knobs))
        self.layers.run(ops)  # compiles and loads the others
        return self.alone.captured(lambda: self.layers.run(ops), self.layers.depth, LEAST_MICROSECONDS)
