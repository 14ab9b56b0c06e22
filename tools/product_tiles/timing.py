"""Each product in each tile that the GPU takes, as CUDA graphs, beside the library's."""

import statistics
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, replace
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from product_tiles.document import TimedProduct, TimedTile
from turbopi.kernels import plain
from turbopi.kernels.portable import activations
from turbopi.kernels.portable.gemm import tiles
from turbopi.kernels.portable.gemm.kernel import gpu, product
from turbopi.kernels.portable.quantize import quantize
from turbopi.quantization.fp8 import Matrix, ScaledMatrix, to_e4m3

DEVICE = torch.device("cuda", 0)
STREAMED = 120e6  # bytes of a weight's copies that take turns, so that none is found in the L2 cache, as in a call
ROUNDS = 5
INVERSE = 30.0


@dataclass(frozen=True)
class Product:
    """out_fp8: the product behind it takes E4M3."""

    name: str
    epilogue: tiles.Epilogue
    rows: int
    columns: int
    inner: int
    bias: bool = False
    in_fp8: bool = True
    out_fp8: bool = False


def products(vision: int, prefix: int, in_fp8: bool) -> list[Product]:
    """Of a call with that many rows; in bfloat16 GeGLU's alone."""
    geglu = Product("prefix gate, up", "geglu", prefix, 16384, 2048, in_fp8=in_fp8, out_fp8=in_fp8)
    if not in_fp8:
        return [geglu]
    return [
        geglu,
        Product("prefix down", "parts", prefix, 2048, 16384),
        Product("vision fc1", "gelu", vision, 4304, 1152, bias=True, out_fp8=True),
        Product("vision fc2", "parts", vision, 1152, 4304, bias=True),
        Product("vision qkv", "plain", vision, 3456, 1152, bias=True),
        Product("vision out", "parts", vision, 1152, 1152, bias=True),
        Product("prefix qkv", "plain", prefix, 2560, 2048),
        Product("prefix out", "parts", prefix, 2048, 2048),
    ]


class Operands:
    """Random inputs and copies of the weight."""

    def __init__(self, given: Product) -> None:
        gen = torch.Generator(DEVICE).manual_seed(1)

        def random(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=gen, device=DEVICE).to(torch.bfloat16)

        rows = given.columns * (2 if given.epilogue == "geglu" else 1)
        weight = random(rows, given.inner) / given.inner**0.5
        self.bias = random(given.columns) if given.bias else None
        x = random(given.rows, given.inner)
        copies = max(2, round(STREAMED / weight.numel() / (1 if given.in_fp8 else 2)))
        self.x, self.weights = x, list[Matrix]()
        if not given.in_fp8:
            self.weights += [weight.clone() for _ in range(copies)]
            return
        first = quantize(weight, 0.01)
        self.x = to_e4m3(x, first.inverse)
        self.weights += [replace(first, data=first.data.clone()) for _ in range(copies)]

    def sums(self, given: Product) -> Tensor:
        first = self.weights[0]
        sums = first.product(self.x, self.bias) if isinstance(first, ScaledMatrix) else self.x.float() @ first.float().T
        if given.epilogue == "gelu":
            return plain.gelu(sums)
        return plain.geglu(sums) if given.epilogue == "geglu" else sums


def timed(given: Product, workers: int) -> TimedProduct:
    """Every tile that this GPU takes; those that don't compile or run are named with the reason."""
    capability, sms = gpu(DEVICE)
    operands = Operands(given)
    inverse = INVERSE if given.out_fp8 else None
    found = tiles.candidates(capability, given.in_fp8, given.epilogue, given.inner)

    def run(tile: tiles.Tile, weight: Matrix) -> Tensor:
        return product(operands.x, weight, given.epilogue, operands.bias, inverse=inverse, tile=tile)

    failed = dict[str, str]()

    def compiled(tile: tiles.Tile) -> tiles.Tile | None:
        try:
            run(tile, operands.weights[0])
        except Exception as e:  # a tile that fails is a result
            failed[str(astuple(tile))] = str(e).strip().splitlines()[-1][:200]
            return None
        return tile

    with ThreadPoolExecutor(workers) as pool:  # compiling is mostly ptxas's work
        ready = [tile for tile in pool.map(compiled, found) if tile is not None]
    exact = operands.sums(given)
    rows = list[TimedTile]()
    for tile in ready:
        result = run(tile, operands.weights[0]).float()
        result = (result.sum(0) if result.dim() == 3 else result) / (inverse or 1.0)
        error = float((result - exact).norm() / exact.norm())
        taken = microseconds([partial(run, tile, weight) for weight in operands.weights])
        rows.append(TimedTile(astuple(tile), taken, None if given.out_fp8 else error))
    rows.sort(key=lambda row: row.microseconds)
    library = [call for weight in operands.weights if (call := by_library(given, operands, weight)) is not None]
    best = tiles.best_tile(capability, given.in_fp8, given.epilogue, given.rows, given.columns, given.inner, sms)
    return TimedProduct(
        *(given.name, given.epilogue, given.in_fp8, given.out_fp8, given.rows, given.columns, given.inner),
        microseconds(library) if library else None,
        astuple(best),
        rows,
        failed,
    )


def by_library(given: Product, operands: Operands, weight: Matrix) -> Callable[[], Tensor] | None:
    """The same by cuBLAS and, where its epilogue can't, a kernel of PyTorch or of ours behind it."""
    if not isinstance(weight, ScaledMatrix):
        return lambda: activations.geglu(F.linear(operands.x, weight))
    scale = torch.ones(given.rows, 1, device=DEVICE)
    fast = not tiles.promotes(gpu(DEVICE)[0], given.inner)

    def call() -> Tensor:
        result = torch._scaled_mm(
            operands.x,
            weight.data.t(),
            scale_a=scale,
            scale_b=weight.scale[None],
            bias=operands.bias,
            out_dtype=torch.bfloat16,
            use_fast_accum=fast,
        )
        if given.epilogue == "geglu":
            return activations.geglu(result, INVERSE if given.out_fp8 else None)
        return to_e4m3(plain.gelu(result), INVERSE) if given.epilogue == "gelu" else result

    try:
        call()
    except (RuntimeError, ValueError):
        return None  # no such product in this version, or on this GPU
    return call


def microseconds(calls: list[Callable[[], Tensor]]) -> float:
    """Of one call: the median of some replays of a graph that has all of them, twice."""
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        for _ in range(2):
            for call in calls:
                call()
    graph.replay()
    taken = list[float]()
    for _ in range(ROUNDS):
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]
        begin.record()
        for _ in range(3):
            graph.replay()
        end.record()
        torch.cuda.synchronize()
        taken.append(begin.elapsed_time(end) * 1000 / (3 * 2 * len(calls)))
    return statistics.median(taken)


def time_all(wanted: list[Product], seconds: float, workers: int) -> tuple[list[TimedProduct], list[str]]:
    """Until time is up: (timed, names of those that are left out)."""
    end, done = time.monotonic() + seconds, list[TimedProduct]()
    for i, one in enumerate(wanted):
        if time.monotonic() > end:
            return done, [f"{left.name}, {left.rows} rows" for left in wanted[i:]]
        done.append(timed(one, workers))
    return done, []
