"""The portable operations with their inputs, as the tuner measures them: products and attention in Triton."""

from abc import abstractmethod
from dataclasses import asdict

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.engine.packing import pack_rows
from turbopi.kernels import plain, plain_batch
from turbopi.kernels.interface import Segments
from turbopi.kernels.portable import activations, attention, batch
from turbopi.kernels.portable.attention_tiles import AttentionTile, usual_tile
from turbopi.kernels.portable.attention_tiles import candidates as attention_candidates
from turbopi.kernels.portable.gemm import tiles
from turbopi.kernels.portable.gemm.kernel import product
from turbopi.kernels.tile_table import LIBRARY, Knobs
from turbopi.quantization.fp8 import E4M3, ScaledMatrix
from turbopi.tune.gpu import INVERSE, GpuBench, poisoned, prefixes_in_a_row, relative
from turbopi.tune.product_bench import ProductBench, activated
from turbopi.tune.shapes import Operation

INPUT_SCALE = 0.01


def usual(one: Operation, capability: tuple[int, int], sms: int) -> Knobs:
    """What runs where nobody measured."""
    if one.operation.endswith("_attention"):
        return asdict(usual_tile(one.operation, capability))  # type: ignore[arg-type]
    if one.numbers == "bf16":
        return {LIBRARY: 1}
    epilogue: tiles.Epilogue = one.operation  # type: ignore[assignment]
    return asdict(tiles.best_tile(capability, True, epilogue, one.rows, one.columns, one.inner, sms))


def candidates(one: Operation, capability: tuple[int, int], sms: int) -> list[Knobs]:
    """All that this GPU takes, the usual one first."""
    first = usual(one, capability, sms)
    if one.operation.endswith("_attention"):
        known = attention_candidates(one.operation, capability, one.inner)  # type: ignore[arg-type]
        found: list[Knobs] = [asdict(tile) for tile in known]
    else:
        epilogue: tiles.Epilogue = one.operation  # type: ignore[assignment]
        fp8 = one.numbers == "fp8"
        found = [asdict(tile) for tile in tiles.candidates(capability, fp8, epilogue, one.inner)]
    return [first, *(knobs for knobs in found if knobs != first)]


def bench(one: Operation, device: torch.device) -> GpuBench:
    kinds: dict[str, type[GpuBench]] = {
        "vision_attention": VisionAttention,
        "prefix_attention": PrefixAttention,
        "packed_attention": PackedAttention,
        "suffix_attention": SuffixAttention,
    }
    return kinds.get(one.operation, Product)(one, device)


class Product(ProductBench):
    """In Triton, or by the library."""

    def __init__(self, operation: Operation, device: torch.device) -> None:
        super().__init__(operation, device, INPUT_SCALE)
        first, x = self.weights[0], self.x
        sums = first.product(x, self.bias) if isinstance(first, ScaledMatrix) else x.float() @ first.float().T
        self.exact = activated(operation.operation, sums)
        self.reference_error = relative(self.whole(self.reference(x, first)), self.exact)

    def run(self, knobs: Knobs, copy: int, out: Tensor | None = None, x: Tensor | None = None) -> Tensor:
        weight, x = self.weights[copy], self.x if x is None else x
        if LIBRARY in knobs:
            assert isinstance(weight, Tensor) and self.operation.operation == "geglu"
            return activations.geglu(F.linear(x, weight), self.inverse)
        epilogue: tiles.Epilogue = self.operation.operation  # type: ignore[assignment]
        return product(x, weight, epilogue, self.bias, out, self.inverse, tiles.Tile(**knobs))

    def out_for(self, knobs: Knobs) -> Tensor | None:
        if LIBRARY in knobs:
            return None
        shape = (self.operation.rows, self.operation.columns)
        split = () if knobs["splits"] == 1 else (knobs["splits"],)
        return poisoned((*split, *shape), E4M3 if self.operation.out_fp8 else self.weights[0].dtype, self.device)


class Attention(GpuBench):
    """Its inputs were just computed in a call, so they may lie in the L2 cache here, too."""

    copies = 1

    def __init__(self, operation: Operation, device: torch.device) -> None:
        super().__init__(operation, device)
        self.inverse = INVERSE if operation.out_fp8 else None
        self.heads, self.dim = operation.columns, operation.inner
        self._allocate(operation)
        exact = self._plain(torch.float32)
        self.exact = exact.float()
        reference = self._plain(torch.bfloat16)
        self.reference_error = relative(self.whole(plain.as_input(reference, torch.bfloat16, self.inverse)), self.exact)

    @abstractmethod
    def _allocate(self, one: Operation) -> None:
        """Make the inputs."""

    @abstractmethod
    def _plain(self, dtype: torch.dtype) -> Tensor:
        """The twin's result, computed in these numbers."""


class VisionAttention(Attention):
    def _allocate(self, one: Operation) -> None:
        self.qkv = self.random(one.rows, 3 * self.heads * self.dim)

    def _plain(self, dtype: torch.dtype) -> Tensor:
        return plain.vision_attention(self.qkv.to(dtype), self.operation.images, self.heads)

    def run(self, knobs: Knobs, copy: int, out: Tensor | None = None) -> Tensor:
        tile = AttentionTile(**knobs)
        return attention.vision_attention(self.qkv, self.operation.images, self.heads, self.inverse, tile=tile)


class PrefixAttention(Attention):
    def _allocate(self, one: Operation) -> None:
        self.q = self.random(one.rows * self.heads, self.dim)
        self.k, self.v = self.random(one.rows, self.dim), self.random(one.rows, self.dim)
        self.length = torch.tensor([one.rows], device=self.device)

    def _plain(self, dtype: torch.dtype) -> Tensor:
        q, k, v = (one.to(dtype) for one in (self.q, self.k, self.v))
        return plain.attention(q, k, v, self.length, len(k), self.heads)

    def run(self, knobs: Knobs, copy: int, out: Tensor | None = None) -> Tensor:
        rest = (self.length, self.heads, self.inverse)
        return attention.prefix_attention(self.q, self.k, self.v, *rest, tile=AttentionTile(**knobs))


class PackedAttention(PrefixAttention):
    """Of a batch's prefixes, all of one length."""

    def _allocate(self, one: Operation) -> None:
        super()._allocate(one)
        self.each = one.rows // one.batch
        prompts = [np.zeros(self.each, np.int64)] * one.batch
        packed = pack_rows(
            [0] * one.batch, prompts, batch=one.batch, rows=one.rows, per_image=1, heads=self.heads
        )  # rows are rows here: of images or prompts
        starts, lengths = (torch.from_numpy(row.copy()).to(self.device) for row in packed.segments)
        self.segments = Segments(starts, lengths, torch.from_numpy(packed.tiles).to(self.device))

    def _plain(self, dtype: torch.dtype) -> Tensor:
        each, length = self.each, torch.tensor([self.each], device=self.device)
        found = []
        for first in range(0, self.operation.rows - each + 1, each):
            own, queries = slice(first, first + each), slice(first * self.heads, (first + each) * self.heads)
            q, k, v = (one.to(dtype) for one in (self.q[queries], self.k[own], self.v[own]))
            found.append(plain.attention(q, k, v, length, each, self.heads))
        return torch.cat(found)

    def run(self, knobs: Knobs, copy: int, out: Tensor | None = None) -> Tensor:
        rest = (self.segments, self.heads, self.inverse)
        return batch.packed_attention(self.q, self.k, self.v, *rest, tile=AttentionTile(**knobs))


class SuffixAttention(Attention):
    def _allocate(self, one: Operation) -> None:
        prefix = one.batch * one.prefix_rows
        self.qkv = self.random(one.rows, (self.heads + 2) * self.dim)
        angles = 6 * self.random(one.rows, self.dim // 2).float()
        self.rope = angles.cos(), angles.sin()
        self.prefix = self.random(prefix, self.dim), self.random(prefix, self.dim)
        self.places = prefixes_in_a_row(one.batch, one.prefix_rows, self.device)

    def _plain(self, dtype: torch.dtype) -> Tensor:
        qkv, prefix_k, prefix_v = (one.to(dtype) for one in (self.qkv, *self.prefix))
        return plain_batch.suffix_attention(qkv, *self.rope, prefix_k, prefix_v, *self.places, self.heads)

    def run(self, knobs: Knobs, copy: int, out: Tensor | None = None) -> Tensor:
        given = (self.qkv, *self.rope, *self.prefix, *self.places, self.heads)
        return batch.suffix_attention(*given, inverse=self.inverse, tile=AttentionTile(**knobs))
