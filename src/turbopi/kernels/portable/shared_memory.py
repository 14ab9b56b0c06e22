"""How much shared memory a block may use, on each GPU: what tiles must fit into."""

from torch import Tensor

from turbopi.kernels.dependent_launch import capability

BLOCK_SHARED = {  # bytes, by compute capability (CUDA C++ programming guide, table of compute capabilities)
    **dict.fromkeys([(8, 0), (8, 7)], 163 * 1024),
    **dict.fromkeys([(8, 6), (8, 9), (12, 0), (12, 1)], 99 * 1024),
    **dict.fromkeys([(9, 0), (10, 0), (10, 3), (11, 0)], 227 * 1024),
}
LEAST_SHARED = min(BLOCK_SHARED.values())  # of GPUs that aren't known


def roomy(x: Tensor) -> bool:
    """Whether blocks on x's GPU have 227 KB. On a CPU: yes."""
    return not x.is_cuda or BLOCK_SHARED.get(capability(x.device), LEAST_SHARED) >= 227 * 1024
