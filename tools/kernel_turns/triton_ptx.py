"""Triton's products and attention as they are compiled for older GPUs, run as PTX on this one: right, in every tile?

Inputs, tiles and bounds are those of `turbopi tune`, which compares every result with float32. INT8's products, which
it doesn't measure, are here.
"""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import torch
import triton
from compile_for_all.compiling import portable_modules
from compile_for_all.launches import on
from compile_for_all.targets import MULTIPROCESSORS, Target
from torch import Tensor
from triton.backends.compiler import GPUTarget
from triton.runtime.jit import JITFunction

from kernel_turns.problems import FULL, GPU
from turbopi.kernels.portable.gemm import tiles
from turbopi.kernels.portable.gemm.kernel import product
from turbopi.kernels.portable.quantize import quantize
from turbopi.kernels.tile_table import LIBRARY, Knobs
from turbopi.quantization.formats import INT8
from turbopi.quantization.int8 import INT8_MAX, to_int8
from turbopi.tune import portable
from turbopi.tune.gpu import INVERSE, GpuBench, cold_copies, poisoned, relative
from turbopi.tune.product_bench import activated, copied
from turbopi.tune.race import wrong
from turbopi.tune.shapes import Call, Operation, Precision, operations

ONE, TWO = Call(2, 48), Call(2, 48, batch=2)
INPUT_SCALE = 4 / INT8_MAX  # of normal numbers


def as_ptx(backend: Any, stages: dict[str, Any], *rest: Any) -> None:
    """Triton's hook into its stages: in place of machine code the PTX, which the driver takes as well."""
    stages["cubin"] = lambda ptx, metadata: ptx.encode() + b"\0"


@contextmanager
def compiled_as(target: Target) -> Iterator[None]:
    """The product takes this GPU for an older one, and Triton compiles for that."""

    def forget() -> None:
        for module in portable_modules():
            for one in vars(module).values():
                if isinstance(one, JITFunction):
                    one.device_caches.clear()

    driver, older = triton.runtime.driver.active, GPUTarget("cuda", target.number, 32)
    with (
        tempfile.TemporaryDirectory() as folder,
        patch.dict(os.environ, {"TRITON_CACHE_DIR": folder}),
        patch.object(type(driver), "get_current_target", lambda self: older),
        patch.object(triton.knobs.runtime, "add_stages_inspection_hook", as_ptx),
        on(target),
    ):
        forget()
        yield
    forget()


class Int8Product(GpuBench):
    """x @ weightᵀ of int8 with its epilogue, whose sums are exact."""

    def __init__(self, operation: Operation, device: torch.device) -> None:
        super().__init__(operation, device)
        one, kind = operation, operation.operation
        rows = one.columns * (2 if kind == "geglu" else 1)
        self.weight = quantize(self.random(rows, one.inner) / one.inner**0.5, INPUT_SCALE, format=INT8)
        self.copies = cold_copies(rows * one.inner, device)
        self.weights = [self.weight, *(copied(self.weight) for _ in range(self.copies - 1))]
        self.bias = self.random(one.columns) if one.bias else None
        self.inverse = INVERSE if one.out_fp8 else None
        self.x = to_int8(self.random(one.rows, one.inner), self.weight.inverse)
        exact = activated(kind, self.weight.product(self.x, self.bias))
        self.exact = exact.clamp(-INT8_MAX / INVERSE, INT8_MAX / INVERSE) if one.out_fp8 else exact
        rounded = to_int8(exact, INVERSE) if one.out_fp8 else exact.to(torch.bfloat16)
        self.reference_error = relative(self.whole(rounded), self.exact)

    def run(self, knobs: Knobs, copy: int, out: Tensor | None = None) -> Tensor:
        epilogue: tiles.Epilogue = self.operation.operation  # type: ignore[assignment]
        tile = tiles.Tile(**knobs)
        return product(self.x, self.weights[copy], epilogue, self.bias, out, self.inverse, tile, torch.int8)

    def out_for(self, knobs: Knobs) -> Tensor | None:
        split = () if knobs["splits"] == 1 else (knobs["splits"],)
        shape = (*split, self.operation.rows, self.operation.columns)
        if self.operation.out_fp8:  # int8 has no NaN: what is left out is far off
            return torch.full(shape, -128, dtype=torch.int8, device=self.device)
        return poisoned(shape, torch.bfloat16, self.device)


def found_operations(target: Target) -> list[Operation]:
    """Of one observation; attention of two as well. In bfloat16 and in all eight bits that this GPU takes."""

    def found(precision: Precision) -> list[Operation]:
        two = operations(FULL, TWO, precision, "portable")
        return operations(FULL, ONE, precision, "portable") + [one for one in two if "_attention" in one.operation]

    fp8 = found("fp8")
    int8 = [replace(one, numbers="int8") for one in fp8 if one.numbers == "fp8"]  # of attention there is no bench
    refusals = ((fp8, tiles.fp8_refusal), (int8, tiles.int8_refusal))
    taken = [one for found_in, refusal in refusals if refusal(target.capability) is None for one in found_in]
    return list({(one.key, one.out_fp8): one for one in found("bf16") + taken}.values())


def tiles_of(one: Operation, target: Target) -> list[Knobs]:
    """Every tile that the GPU takes, and not the library."""
    requested = replace(one, numbers="fp8") if one.numbers == "int8" else one
    found = portable.candidates(requested, target.capability, MULTIPROCESSORS[target.capability])
    return [knobs for knobs in found if LIBRARY not in knobs]


def results(target: Target) -> Iterator[tuple[Operation, Knobs, float | None, float, str | None]]:
    """Each operation in each tile: relative rms error to float32 (None: it doesn't run), what that may be, and what is
    wrong with it.
    """
    with compiled_as(target), torch.no_grad():
        for one in found_operations(target):
            bench = Int8Product(one, GPU) if one.numbers == "int8" else portable.bench(one, GPU)
            candidates = tiles_of(one, target)
            refused = bench.prepare(candidates)
            for place, knobs in enumerate(candidates):
                if place in refused:
                    yield one, knobs, None, bench.bound, refused[place]
                else:
                    error = bench.error(knobs)
                    yield one, knobs, error, bench.bound, wrong(error, bench.bound)
