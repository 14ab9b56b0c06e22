"""What one barrier of the whole grid costs in a cooperative kernel: a floor where blocks wait for one another."""

import ctypes

import torch

from turbopi.kernels.nvrtc import Kernel, compile_for, native_arch
from turbopi.support.errors import BackendUnavailable

THREADS = 512
SOURCE = """
struct Args {
    unsigned* counter;
    int count;
};

extern "C" __global__ void __launch_bounds__(512) turbopi_barriers(const Args args) {
    for (int i = 1; i <= args.count; ++i) {
        __syncthreads();
        if (threadIdx.x == 0) {
            asm volatile("red.release.gpu.global.add.u32 [%0], 1;" ::"l"(args.counter) : "memory");
            unsigned arrived;
            do {
                asm volatile("ld.acquire.gpu.global.u32 %0, [%1];" : "=r"(arrived) : "l"(args.counter) : "memory");
            } while (arrived < i * gridDim.x);
        }
        __syncthreads();
    }
}
"""


class _Args(ctypes.Structure):
    _fields_ = (("counter", ctypes.c_void_p), ("count", ctypes.c_int))


def barrier_us(device: torch.device, barriers: int = 1000, repeats: int = 5) -> float | None:
    """Microseconds of one barrier over one block per multiprocessor; None where the kernel can't be compiled."""
    properties = torch.cuda.get_device_properties(device)
    try:
        code = compile_for(SOURCE, native_arch((properties.major, properties.minor)), {})
    except BackendUnavailable:
        return None
    counter = torch.zeros(1, dtype=torch.int32, device=device)
    with torch.cuda.device(device):
        kernel = Kernel(code, "turbopi_barriers", 0)

        def milliseconds(count: int) -> float:
            times = []
            for _ in range(repeats):
                start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]
                counter.zero_()
                start.record()
                kernel.launch_cooperative(properties.multi_processor_count, THREADS, _Args(counter.data_ptr(), count))
                end.record()
                end.synchronize()
                times.append(start.elapsed_time(end))
            return sorted(times)[repeats // 2]

        milliseconds(1)
        return (milliseconds(barriers + 1) - milliseconds(1)) / barriers * 1e3
