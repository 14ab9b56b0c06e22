"""What this machine can do, measured on the spot: memory bandwidth, matrix rate, the cost of a launch and a barrier."""

import time
from collections.abc import Callable

import torch
from msgspec import Struct

from turbopi.kernels.grid_barrier import barrier_us

_DTYPES = {
    "bf16": torch.bfloat16,
    "f32": torch.float32,
    "int8-weights": torch.bfloat16,
    "fp8": torch.float8_e4m3fn,
    "fp8-mlp": torch.float8_e4m3fn,
    "fp8-f16sums": torch.float8_e4m3fn,
    "int8": torch.int8,
    "nvfp4": torch.float8_e4m3fn,  # half of its own rate or less: PyTorch has no product in it for every such GPU
}


class Floors(Struct, frozen=True):
    """Ceilings of one device in one precision."""

    copy_bytes_per_second: float  # a large device copy, read and written bytes both counted
    matmul_flops_per_second: float
    launch_us: float | None = None  # one dependent tiny kernel inside a CUDA graph; None on a CPU
    barrier_us: float | None = None  # one grid-wide barrier inside a cooperative kernel; None on a CPU


PATIENCE = 3.0  # seconds of one measurement on a CPU


def measure_floors(device: torch.device, precision: str) -> Floors:
    """Medians over a few repetitions, on random data. Takes about a second.

    On a GPU a small product comes first: cuBLAS keeps the workspace that its first one allocates, and in a part of a
    large freed piece it would keep all of that reserved (2 GiB, which then count as a policy's).
    """
    if device.type == "cuda":
        _matmul_rate(device, _DTYPES[precision], 64)
        copied, rate = _copy_rate(device, 1 << 31), _matmul_rate(device, _DTYPES[precision], 8192)
        return Floors(copied, rate, _launch_us(device), barrier_us(device))
    return Floors(_copy_rate(device, 1 << 28), _matmul_rate(device, _DTYPES[precision], 1024))


def median_seconds(run: Callable[[], object], device: torch.device, repeats: int = 10) -> float:
    """Median time of `run`, on the device's own clock, after three warm-up runs.

    On a CPU it stops after PATIENCE seconds, warm-up or not: some take long, such as a bfloat16 product where the CPU
    has no such instructions.
    """
    times: list[float] = []
    end_of_patience = time.perf_counter() + PATIENCE
    for i in range(repeats + 3):
        if device.type == "cuda":
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]
            start.record()
            run()
            end.record()
            end.synchronize()
            seconds = start.elapsed_time(end) / 1e3
        else:
            begin = time.perf_counter()
            run()
            seconds = time.perf_counter() - begin
        late = device.type != "cuda" and time.perf_counter() > end_of_patience
        if i >= 3 or late:
            times.append(seconds)
        if late:
            break
    return sorted(times)[len(times) // 2]


def _copy_rate(device: torch.device, size: int) -> float:
    source = torch.randint(0, 127, (size,), dtype=torch.int8, device=device)
    target = torch.empty_like(source)
    return 2 * size / median_seconds(lambda: target.copy_(source), device)


def _matmul_rate(device: torch.device, dtype: torch.dtype, n: int) -> float:
    """On a CPU with `b` as nn.Linear's weights lie: PyTorch 2.13 takes twenty times as long for a bfloat16 product of
    the other layout where the CPU has no such instructions (0.92 and 20 GFLOP/s were seen), which would be no ceiling.
    """
    a, b = (torch.randn(n, n, device=device).to(dtype) for _ in range(2))

    def product() -> torch.Tensor:
        if dtype == torch.int8:
            return torch._int_mm(a, b.t())
        if dtype != torch.float8_e4m3fn:
            return a @ b if device.type == "cuda" else torch.nn.functional.linear(a, b)
        one = torch.ones((), device=device)
        return torch._scaled_mm(a, b.t(), one, one, out_dtype=torch.bfloat16, use_fast_accum=True)

    return 2 * n**3 / median_seconds(product, device)


def _launch_us(device: torch.device, kernels: int = 1000) -> float:
    x = torch.zeros(1, device=device)
    graph = torch.cuda.CUDAGraph()
    x.add_(1)
    torch.cuda.synchronize(device)
    with torch.cuda.graph(graph):
        for _ in range(kernels):
            x.add_(1)
    return median_seconds(graph.replay, device) / kernels * 1e6
