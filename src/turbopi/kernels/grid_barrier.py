"""A barrier of the whole grid in a cooperative kernel: what it costs, a floor where blocks wait for one another, and
whether it holds on a GPU.
"""

import ctypes

import torch

from turbopi.kernels.nvrtc import Kernel, compile_for, native_arch
from turbopi.support.errors import BackendUnavailable

THREADS = 512
LOOKS = 1 << 20  # at the counter, before a block gives up: about a second, and a barrier takes microseconds
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

struct Checked {
    unsigned *counter, *slots, *found;  // found: values that weren't there, blocks that gave up
    int rounds, blocks, looks;
};

__device__ bool opened(const Checked& args, unsigned arrivals) {
    bool gave_up = false;
    __syncthreads();
    if (threadIdx.x == 0) {
        asm volatile("red.release.gpu.global.add.u32 [%0], 1;" ::"l"(args.counter) : "memory");
        unsigned arrived;
        int looks = 0;
        do {
            asm volatile("ld.acquire.gpu.global.u32 %0, [%1];" : "=r"(arrived) : "l"(args.counter) : "memory");
            gave_up = ++looks == args.looks;
        } while (arrived < arrivals && !gave_up);
    }
    return !__syncthreads_or(gave_up);
}

// In each round a block writes its slot, and reads another's behind the barrier.
extern "C" __global__ void __launch_bounds__(512) turbopi_check_barriers(const Checked args) {
    unsigned arrivals = 0;
    for (int i = 1; i <= args.rounds; ++i) {
        if (threadIdx.x == blockDim.x - 1) args.slots[blockIdx.x] = i;
        bool open = opened(args, arrivals += args.blocks);
        if (open && threadIdx.x == 0) {
            unsigned seen = __ldcg(args.slots + (blockIdx.x + i) % gridDim.x);
            if (seen != i) atomicAdd(args.found, 1);
        }
        open = open && opened(args, arrivals += args.blocks);
        if (!open) {
            if (threadIdx.x == 0) atomicAdd(args.found + 1, 1);
            return;
        }
    }
}
"""


class _Args(ctypes.Structure):
    _fields_ = (("counter", ctypes.c_void_p), ("count", ctypes.c_int))


class _Checked(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("counter", "slots", "found")),
        *((name, ctypes.c_int) for name in ("rounds", "blocks", "looks")),
    )


def check_barrier(device: torch.device, rounds: int = 1000, *, missing: int = 0) -> str | None:
    """Why the barrier doesn't hold over one block per multiprocessor; None: in all rounds every block saw what another
    had written before. It gives up after seconds.

    missing  how many more blocks are waited for than there are: a planted fault

    Raises BackendUnavailable where the kernel can't be compiled.
    """
    properties = torch.cuda.get_device_properties(device)
    blocks = properties.multi_processor_count
    code = compile_for(SOURCE, native_arch((properties.major, properties.minor)), {})
    counter, slots, found = (torch.zeros(size, dtype=torch.int32, device=device) for size in (1, blocks, 2))
    places = counter.data_ptr(), slots.data_ptr(), found.data_ptr()
    with torch.cuda.device(device):
        kernel = Kernel(code, "turbopi_check_barriers", 0)
        kernel.launch_cooperative(blocks, THREADS, _Checked(*places, rounds, blocks + missing, LOOKS))
        wrong, gave_up = found.tolist()
    if gave_up:
        return f"{gave_up} of {blocks} blocks waited for the others in vain"
    return f"{wrong} of {rounds * blocks} values weren't seen behind the barrier" if wrong else None


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
