"""Numbers between pinned memory of the host and the device, by a kernel: of few numbers that is sooner than a copy.

A kernel follows the one before it closely; the copy engine has to be waited for, before and behind. Twin:
`kernels.plain.transfer`.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import dependent_launch, launch_dependents, wait_for_producer

BLOCK = 1024  # words of a program: each of its 128 threads asks for 32 bytes at once


@triton.jit
def _transfer_kernel(source, to, count, BLOCK: tl.constexpr, PDL: tl.constexpr):
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    tl.store(to + at, tl.load(source + at, at < count), at < count)


def transfer(source: Tensor, to: Tensor) -> None:
    """`to` becomes `source`: of the same dtype and shape, both contiguous, whole words of 4 bytes.

    One is on the device; the other may be pinned memory of the host, which the kernel then reads or writes over the
    bus. What it writes there can be read when its stream has been waited for.
    """
    assert source.dtype == to.dtype and source.shape == to.shape, (source.dtype, to.dtype, source.shape, to.shape)
    assert source.is_contiguous() and to.is_contiguous(), "words are copied as they lie in memory"
    words, into = (one.view(-1).view(torch.int32) for one in (source, to))
    launch = dependent_launch(to if to.is_cuda else source)
    _transfer_kernel[(triton.cdiv(len(words), BLOCK),)](words, into, len(words), BLOCK=BLOCK, num_warps=4, **launch)
