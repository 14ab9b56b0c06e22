"""Time variants of the denoising kernel in turns: one after the other, again and again, on one problem.

Machines, and hours on one machine, differ by more than most changes do, so a change is timed beside what it changes.
"""

import statistics
from typing import Any

import torch
from torch import Tensor

from kernel_turns.document import TimedVariant
from kernel_turns.problems import GPU, Problem, by_token, input_scales, plain, problem, relative
from kernel_turns.variants import Variant
from turbopi.backends import resolve_device
from turbopi.kernels.sm90.denoise.kernel import MARKS, unavailable
from turbopi.kernels.sm90.denoise.packing import RANKS, PackedExpert
from turbopi.support.errors import BackendUnavailable

STEPS, CACHE_ROWS, SEED = 10, 976, 1


class Job:
    """The full-size expert with random weights: `tokens` suffix tokens behind a prefix of `length`, NaN behind that.

    Raises ValueError for another precision or length, or without a GPU, BackendUnavailable for one that isn't Hopper.
    """

    def __init__(self, tokens: int, precision: str, length: int) -> None:
        if precision not in ("bf16", "fp8") or not 1 <= length <= CACHE_ROWS:
            raise ValueError(f"{precision!r}, {length}: expected bf16 or fp8, 1 to {CACHE_ROWS} prefix tokens")
        if (reason := unavailable(resolve_device(GPU))) is not None:
            raise BackendUnavailable(reason)
        p = problem("full", STEPS, tokens, length, SEED, GPU)
        self.problem = p
        self.packed = PackedExpert.pack(p.config, p.layers, input_scales(p) if precision == "fp8" else None)
        self.tokens, self.precision, self.length = tokens, precision, torch.tensor([length], device=GPU)

    def of(self, variant: Variant) -> Problem:
        """What this variant is given."""
        return self.problem if variant.way is None else by_token(self.problem, variant.way, SEED)

    def kernel(self, variant: Variant, p: Problem, trace: int | None = None) -> Any:
        return variant.kernel(
            *(p.config, self.packed, p.small, p.table),
            cache_rows=CACHE_ROWS,
            suffix=self.tokens,
            device=GPU,
            trace=trace,
            **({} if p.tokens is None else {"num_steps": STEPS, "by_token": True}),
        )

    def outputs(self) -> tuple[Tensor, Tensor]:
        shape = self.problem.noise.shape
        return (
            torch.full((STEPS + 1, *shape), torch.nan, device=GPU),
            torch.full((STEPS, *shape), torch.nan, device=GPU),
        )

    def launch(self, kernel: Any, p: Problem, x_t: Tensor, v_t: Tensor) -> None:
        by_token = () if p.tokens is None else (p.tokens,)
        kernel.launch(p.noise, p.cache_k, p.cache_v, self.length, x_t, v_t, *by_token)


def time_in_turns(job: Job, variants: list[Variant], rounds: int, calls: int = 12) -> list[TimedVariant]:
    """Every variant's CUDA graph in every round, `calls` times."""
    runs = []
    for variant in variants:
        p, (x_t, v_t) = job.of(variant), job.outputs()
        kernel = job.kernel(variant, p)
        job.launch(kernel, p, x_t, v_t)
        torch.cuda.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            job.launch(kernel, p, x_t, v_t)
        runs.append((variant, kernel, graph, x_t, p, v_t))  # problem and outputs stay: graphs read and write there
    times: list[list[float]] = [[] for _ in runs]
    for _ in range(rounds):
        for (_, _, graph, *_), taken in zip(runs, times, strict=True):
            for _ in range(2):
                graph.replay()
            begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]
            begin.record()
            for _ in range(calls):
                graph.replay()
            end.record()
            torch.cuda.synchronize()
            taken.append(begin.elapsed_time(end) / calls)
    first = runs[0][3]
    return [
        TimedVariant(
            job.tokens,
            job.precision,
            job.problem.length,
            variant.spec,
            statistics.median(taken),
            min(taken),
            relative(x_t[-1], plain(p, torch.float32)[0][-1]),
            torch.equal(x_t, first),
            kernel.clock_mhz() or 0.0,
        )
        for (variant, kernel, _, x_t, p, _), taken in zip(runs, times, strict=True)
    ]


def marks_by_rank(job: Job, variant: Variant, warp: int = 0) -> Tensor:
    """A warp's cycles of a layer between marks, the mean over steps, layers and clusters: float64[RANKS, MARKS]."""
    p, (x_t, v_t) = job.of(variant), job.outputs()
    kernel = job.kernel(variant, p, warp)
    job.launch(kernel, p, x_t, v_t)
    torch.cuda.synchronize()
    layers = STEPS * job.problem.config.expert.depth
    cycles = kernel._tensors["trace"][:, 1 : 1 + len(MARKS)].double().cpu() / layers
    return cycles.view(-1, RANKS, cycles.shape[1]).mean(0)
