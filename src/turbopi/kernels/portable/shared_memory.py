"""How much shared memory a block may use, on each GPU: what tiles must fit into."""

from torch import Tensor

from turbopi.kernels.dependent_launch import capability

BLOCK_SHARED = {  # bytes, by compute capability (CUDA C++ programming guide, table of compute capabilities)
    **dict.fromkeys([(8, 0), (8, 7)], 163 * 1024),
    **dict.fromkeys([(8, 6), (8, 9), (12, 0), (12, 1)], 99 * 1024),
    **dict.fromkeys([(9, 0), (10, 0), (10, 3), (11, 0)], 227 * 1024),
}
LEAST_SHARED = min(BLOCK_SHARED.values())  # of GPUs that aren't known


def capability_of(x: Tensor) -> tuple[int, int]:
    """Of x's GPU; on a CPU, where Triton interprets, that of one with 227 KB."""
    return capability(x.device) if x.is_cuda else (9, 0)
