"""Time the portable denoising kernel on this GPU: ten steps, behind a prefix of 560 rows, for several launch choices.

    export PYTHONPATH=src:tools
    python -m kernel_turns.portable --out times.json
    python -m kernel_turns.portable --tokens 10 --precisions bf16 --traced --out trace.json

A row has the choice, the median of a CUDA graph's replays, bytes of weights a second, which share of it the weights
alone would take at the speed at which this GPU copies memory, and the actions' error against float32. With --traced
also cycles of each kind of phase, a mean over blocks: at work, and at the barrier behind it.
"""

import argparse
import json
import statistics
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kernel_turns.problems import GPU, Problem, input_scales, int8_inputs, ordinary_bf16, plain, problem, relative
from turbopi.kernels.portable.denoise.kernel import (
    PHASES,
    Choices,
    PortableDenoiser,
    choices,
    multiprocessors,
    unavailable,
)
from turbopi.kernels.portable.denoise.packing import PackedExpert
from turbopi.quantization.formats import INT8

STEPS, CACHE_ROWS, SEED = 10, 976, 1


def variants(tokens: int) -> list[Choices]:
    """The shipped choice first, then changes of it."""
    usual = choices(tokens, blocks=multiprocessors(GPU))
    changes: list[dict[str, Any]] = [
        {},
        {"ahead": not usual.ahead},
        {"weights": usual.weights // 2},
        {"weights": usual.weights * 2},
        {"activations": usual.activations // 2},
        {"warps": 24 - usual.warps},
        {"warps": 24 - usual.warps, "weights": usual.weights * 2},
        {"warps": 24 - usual.warps, "sums": usual.sums // 2},
        {"sums": usual.sums // 2},
    ]
    return [replace(usual, **change) for change in changes]


def copied_bytes_a_second() -> float:
    source = torch.empty(1 << 30, dtype=torch.uint8, device=GPU)
    target = torch.empty_like(source)
    target.copy_(source)
    return 2 * source.numel() / (statistics.median(_times(lambda: target.copy_(source), 10)) / 1e3)


def _times(call: Any, repeats: int) -> list[float]:
    """Milliseconds of each."""
    found = []
    for _ in range(repeats):
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]
        begin.record()
        call()
        end.record()
        end.synchronize()
        found.append(begin.elapsed_time(end))
    return found


def launched(kernel: PortableDenoiser, p: Problem) -> tuple[Tensor, Any]:
    """x_t of a first launch, and a call that repeats it."""
    x_t = torch.full((STEPS + 1, *p.noise.shape), torch.nan, device=GPU)
    v_t, length = torch.full((STEPS, *p.noise.shape), torch.nan, device=GPU), torch.tensor([p.length], device=GPU)

    def call() -> None:
        kernel.launch(p.noise, p.cache_k, p.cache_v, length, x_t, v_t)

    call()
    torch.cuda.synchronize()
    return x_t, call


def timed(kernel: PortableDenoiser, p: Problem, replays: int) -> tuple[Tensor, list[float]]:
    x_t, call = launched(kernel, p)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        call()
    _times(graph.replay, 10)
    return x_t, sorted(_times(graph.replay, replays))


def traced(kernel: PortableDenoiser, p: Problem, launches: int = 5) -> dict[str, list[float]]:
    """Cycles of a launch in all its phases of a kind, a mean over blocks: at work, and at the barrier."""
    _, call = launched(kernel, p)
    before = kernel.trace()
    for _ in range(launches):
        call()
    torch.cuda.synchronize()
    cycles = ((kernel.trace() - before) & 0xFFFFFFFF).double().mean(0) / launches
    return {phase: [round(value) for value in of] for phase, of in zip(PHASES, cycles.tolist(), strict=True)}


def packed_in(p: Problem, precision: str) -> PackedExpert:
    if precision == "int8":
        return PackedExpert.pack(p.config, p.layers, int8_inputs(p), format=INT8)
    return PackedExpert.pack(p.config, p.layers, input_scales(p) if precision == "fp8" else None)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m kernel_turns.portable",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--tokens", default="10,50")
    parser.add_argument("--precisions", default="bf16,fp8", help="also int8")
    parser.add_argument("--length", type=int, default=560, help="valid prefix tokens")
    parser.add_argument("--replays", type=int, default=100)
    parser.add_argument("--shipped", action="store_true", help="only the shipped choice")
    parser.add_argument("--traced", action="store_true", help="also cycles of each kind of phase")
    parser.add_argument("--out", type=Path, required=True, help="write JSON here")
    arguments = parser.parse_args()
    if (reason := unavailable(GPU)) is not None:
        parser.error(reason)
    speed, rows = copied_bytes_a_second(), []
    for tokens in map(int, arguments.tokens.split(",")):
        p = problem("full", STEPS, tokens, arguments.length, SEED, GPU)
        reference, ordinary = plain(p, torch.float32)[0][-1], ordinary_bf16(p)
        for precision in arguments.precisions.split(","):
            packed = packed_in(p, precision)
            size = packed.weights.numel() * packed.weights.element_size() * STEPS
            for choice in variants(tokens)[: 1 if arguments.shipped else None]:
                make = partial(
                    PortableDenoiser,
                    *(p.config, packed, p.small, p.table),
                    cache_rows=CACHE_ROWS,
                    suffix=tokens,
                    device=GPU,
                    choice=choice,
                )
                row: dict[str, Any] = {"tokens": tokens, "precision": precision, "length": p.length}
                row |= {"choice": asdict(choice)}
                try:
                    x_t, times = timed(make(), p, arguments.replays)
                    seconds = statistics.median(times) / 1e3
                    row |= {
                        "ms": seconds * 1e3,
                        "p5_ms": times[len(times) // 20],
                        "p95_ms": times[-1 - len(times) // 20],
                        "bytes_a_second": size / seconds,
                        "floor_ms": size / speed * 1e3,
                        "share_of_floor": size / speed / seconds,
                        "error": relative(x_t[-1], reference),
                        "error_of_ordinary_bf16": relative(ordinary, reference),
                    }
                    if arguments.traced:
                        row["cycles"] = traced(make(traced=True), p)
                except Exception as e:  # a choice that doesn't compile says so in its row
                    row["failed"] = str(e)[-500:]
                print({key: value for key, value in row.items() if key != "cycles"}, flush=True)
                rows.append(row)
    name = torch.cuda.get_device_name(GPU)
    arguments.out.write_text(json.dumps({"gpu": name, "copied_bytes_a_second": speed, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
