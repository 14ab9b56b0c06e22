"""Hopper's products with their inputs, as the tuner measures them: as the vision tower and the prefix run them.

Whole products of many rows are added to the residual stream in place, and the norm behind finds them there.

Between two of the tower's products no kernel runs: one adds the residual stream, the next one takes the LayerNorm of
its input from the sums of each row. So they are measured in these forms, where they have them.
"""

from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.kernels import plain
from turbopi.kernels.portable.products import linear, linear_geglu, linear_gelu
from turbopi.kernels.sm90.gemm import candidates as hopper_candidates
from turbopi.kernels.sm90.gemm.bf16 import Copy, Folded, Sums, Tile, matmul
from turbopi.kernels.sm90.gemm.candidates import epilogue_with
from turbopi.kernels.sm90.gemm.fp8 import GATHERING_SMS, HEADROOM, FoldedFp8, matmul_fp8
from turbopi.kernels.sm90.gemm.products import (
    ADDING_ROWS,
    Chosen,
    Operation,
    as_input,
    chosen,
    chosen_fp8,
    chosen_geglu,
    from_knobs,
    parts_at_once,
    to_knobs,
)
from turbopi.kernels.sm90.norms import layer_norm
from turbopi.kernels.tile_table import NO_TILES, Knobs
from turbopi.quantization.fp8 import E4M3, Matrix, ScaledMatrix, to_e4m3
from turbopi.tune.gpu import poisoned, relative
from turbopi.tune.product_bench import EPS, ProductBench, activated
from turbopi.tune.shapes import Operation as Wanted

STREAM_PARTS = 16  # of the sums of the stream's rows: as many as the product before has tiles along its columns
COPY_SCALE = 20.0
INPUT_SCALE = 0.02


def resolved(one: Wanted, sms: int) -> Wanted:
    """As a call runs it: into the residual stream, and with the norm in front folded, where its sizes have that."""
    adds = one.rows >= ADDING_ROWS
    if one.kernels == "hopper" and one.name in ("prefix out", "prefix down"):
        return replace(one, adds=adds and one.batch > 1)  # one observation's embeddings stay
    if one.kernels != "hopper" or not one.name.startswith(("vision", "projector")):
        return one
    if one.operation == "residual":
        into_stream = sms >= GATHERING_SMS and usual_choice(one, sms) is not None
        return one if into_stream else replace(one, operation="partial", adds=adds)
    before = replace(one, operation="residual", columns=one.inner)  # as the tower's product that leaves the stream
    folded = one.norm_in_front == "layer" and sms >= GATHERING_SMS and usual_choice(before, sms) is not None
    return replace(one, normed=True, norm_in_front=None) if folded else one


def usual_choice(one: Wanted, sms: int) -> Chosen:
    operation: Operation = one.operation  # type: ignore[assignment]
    sizes = one.rows, one.columns, one.inner
    if one.numbers == "fp8":
        return chosen_fp8(NO_TILES, operation, *sizes, sms)
    return chosen_geglu(NO_TILES, *sizes, sms) if operation == "geglu" else chosen(NO_TILES, operation, *sizes)


def candidates(one: Wanted, sms: int) -> list[Knobs]:
    """The usual choice first."""
    operation: Operation = one.operation  # type: ignore[assignment]
    sizes, usual = (one.rows, one.columns, one.inner), usual_choice(one, sms)
    found = hopper_candidates.candidates(operation, one.numbers == "fp8", *sizes, sms, usual, one.adds)
    if one.normed:  # a norm is multiplied whole
        found = [cut for cut in found if not isinstance(cut, Tile) or (cut.splits == 1 and not cut.overlap)]
    return [to_knobs(cut) for cut in found]


class Product(ProductBench):
    """One of them, in bfloat16 or E4M3."""

    def __init__(self, operation: Wanted, device: torch.device) -> None:
        super().__init__(operation, device, INPUT_SCALE)
        one, first = operation, self.weights[0]
        if (norm := self.norm_behind) is not None:
            self.stream_sums = sums_of(norm.stream)
            self.for_copy = norm.scale.float() * COPY_SCALE, norm.shift.float() * COPY_SCALE
        if one.normed:
            self._fold_norm(first)
        else:
            self.exact, reference = self._products(self.x.float() if not self.fp8 else self.x, self.x, first)
            self.reference_error = relative(self.whole(reference), self.exact)

    def _fold_norm(self, first: Matrix) -> None:
        """The norm's weights, the sums of the rows that it is made of, and matrices that take it."""
        one, bias = self.operation, self.bias
        assert bias is not None, "the tower's products have biases"
        scale, shift = self.random(one.inner), self.random(one.inner)
        self.front = scale, shift
        normed = F.layer_norm(self.raw.float(), (one.inner,), scale.float(), shift.float(), EPS)
        if isinstance(first, ScaledMatrix):
            self._copied(first, scale, shift)
            wide = normed @ first.dequantized().T + bias.float()
            reference = first.product(to_e4m3(normed, first.inverse), bias)
        else:
            self.sums = sums_of(self.raw)
            made = Folded.fold(first, bias, scale, shift)
            self.folded: list[Folded] = [replace(made, data=made.data.clone()) for _ in range(self.copies)]
            wide = normed @ first.float().T + bias.float()
            reference = F.linear(normed.to(torch.bfloat16), first, bias).float()
        self.exact = activated(one.operation, wide)
        reference = plain.as_input(activated(one.operation, reference), torch.bfloat16, self.inverse)
        self.reference_error = relative(self.whole(reference), self.exact)

    def _copied(self, first: ScaledMatrix, scale: Tensor, shift: Tensor) -> None:
        """The copy of the stream in the units of another one's rows, as `bf16.Copy` says."""
        before = self.random(*self.raw.shape).float()
        mean = before.mean(1, keepdim=True)
        factor = (before.var(1, correction=0, keepdim=True) + EPS).rsqrt()
        units = (self.raw.float() - mean) * factor
        by = first.inverse / HEADROOM
        self.copy = to_e4m3(units * scale.float() + shift.float(), by)
        sums = sums_of(units)
        sums.parts[0, :, 1] += units.shape[1] * EPS * factor[:, 0].square()
        self.sums = sums
        self.folded_fp8 = [FoldedFp8.fold(one, scale, shift) for one in self.weights if isinstance(one, ScaledMatrix)]

    def _products(self, wide: Tensor, x: Tensor, weight: Matrix) -> tuple[Tensor, Tensor]:
        """(the exact result float32, the plain twin's)"""
        one = self.operation
        bias = None if self.bias is None else self.bias.float()
        sums = (
            weight.product(x, self.bias) if isinstance(weight, ScaledMatrix) else F.linear(wide, weight.float(), bias)
        )
        exact = activated(one.operation, sums)
        if one.operation == "residual":
            assert self.norm_behind is not None
            exact = exact + self.norm_behind.stream.float()
        return exact, plain.as_input(exact, torch.bfloat16, self.inverse) if self.fp8 else self.reference(x, weight)

    def reference(self, x: Tensor, weight: Matrix) -> Tensor:
        result = super().reference(x, weight)
        norm = self.norm_behind
        return result + norm.stream if self.operation.operation == "residual" and norm is not None else result

    def run(self, knobs: Knobs, copy: int, out: Tensor | None = None, x: Tensor | None = None) -> Tensor:
        cut, x = from_knobs(knobs), self.x if x is None else x
        if not isinstance(cut, Tile):
            return self._by_library(cut, copy, x)
        one, weight = self.operation, self.weights[copy]
        epilogue = epilogue_with(one.operation, cut, self.fp8, one.adds)
        if epilogue == "added" and out is None:
            assert self.norm_behind is not None
            out = self.norm_behind.stream
        if one.operation == "residual":
            return self._into_stream(cut, copy, out, x)
        ahead = self._ahead(copy)
        if one.normed and self.fp8:
            folded = self.folded_fp8[copy]
            return matmul_fp8(
                self.copy, folded, cut, epilogue, self.bias, out, self.inverse, sums=self.sums, ahead=ahead
            )
        if one.normed:
            given = self.folded[copy]
            result = matmul(self.raw, given, cut, epilogue, out=out, sums=self.sums, eps=EPS, ahead=ahead)
            return as_input(result, result.dtype, self.inverse)
        if isinstance(weight, ScaledMatrix):
            return matmul_fp8(x, weight, cut, epilogue, self.bias, out, self.inverse, ahead=ahead)
        result = matmul(x, weight, cut, epilogue, self.bias, out, ahead=ahead)
        return as_input(result, result.dtype, self.inverse)

    def _added(self, cut: Chosen) -> bool:
        one = self.operation
        return isinstance(cut, Tile) and epilogue_with(one.operation, cut, self.fp8, one.adds) == "added"

    def layer_norm(self, *given: Any) -> tuple[Tensor, Tensor]:
        return layer_norm.residual_layer_norm(*given)

    def _into_stream(self, tile: Tile, copy: int, out: Tensor | None, x: Tensor) -> Tensor:
        one, weight = self.operation, self.weights[copy]
        assert self.norm_behind is not None
        stream = self.norm_behind.stream
        sums = Sums.allocate(tile, one.rows, one.columns, self.device)
        ahead, bias = self._ahead(copy), self.bias
        if not isinstance(weight, ScaledMatrix):
            return matmul(x, weight, tile, "bias", bias, out, residual=stream, sums_out=sums, ahead=ahead)
        plain_sums = Sums.allocate(tile, one.rows, one.columns, self.device)
        room = torch.empty(one.rows, one.columns, dtype=E4M3, device=self.device)
        left = Copy(room, self.stream_sums, *self.for_copy, EPS, plain_sums)
        return matmul_fp8(x, weight, tile, "bias", bias, out, residual=stream, sums_out=sums, copy=left, ahead=ahead)

    def _by_library(self, parts: int | None, copy: int, x: Tensor) -> Tensor:
        one, weight, bias = self.operation, self.weights[copy], self.bias
        if one.normed:
            x = self.layer_norm(self.raw, None, *self.front, EPS)[1]
        if parts is not None:
            assert isinstance(weight, Tensor)
            return parts_at_once(x, weight, parts)
        if one.operation == "geglu":
            return linear_geglu(x, weight, self.inverse)
        if one.operation == "gelu":
            assert bias is not None
            return linear_gelu(x, weight, bias, self.inverse)
        return linear(x, weight, bias)

    def out_for(self, knobs: Knobs) -> Tensor | None:
        one, cut = self.operation, from_knobs(knobs)
        if self._added(cut):
            return torch.zeros(one.rows, one.columns, dtype=torch.bfloat16, device=self.device)
        if not isinstance(cut, Tile) or one.operation in ("partial", "parts") or (one.out_fp8 and not self.fp8):
            return None
        dtype = E4M3 if one.out_fp8 else torch.bfloat16
        return poisoned((one.rows, one.columns), dtype, self.device)

    def _ahead(self, copy: int) -> Tensor | None:
        """The next product's weight, which the tower's products fetch into the L2 cache."""
        if not self.operation.name.startswith("vision"):
            return None
        at = (copy + 1) % self.copies
        if self.operation.normed and not self.fp8:
            return self.folded[at].data
        weight = self.weights[at]
        return weight.data if isinstance(weight, ScaledMatrix) else weight


def sums_of(x: Tensor) -> Sums:
    """Each row's sum and sum of squares, by parts of its columns."""
    parts = x.float().tensor_split(STREAM_PARTS, 1)
    return Sums(torch.stack([torch.stack((part.sum(1), part.square().sum(1)), -1) for part in parts]).contiguous())
