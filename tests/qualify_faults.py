"""Faults for the process that qualifies a GPU, which imports this module (`qualifying.DOUBLE_VARIABLE`).

TURBOPI_PLANTED names the one that is planted.
"""

import dataclasses
import itertools
import os
from collections.abc import Callable
from functools import partial
from typing import Any

import torch

from turbopi.kernels import ops as ops_module
from turbopi.kernels.portable.denoise import kernel
from turbopi.qualify import run
from turbopi.qualify import stages as stages_module
from turbopi.support.errors import BackendError

VARIABLE = "TURBOPI_PLANTED"
ops: Any = ops_module
denoise: Any = kernel
stages: Any = stages_module


def wrong_tile() -> None:
    """The last 64 rows of vision's attention stay what they were."""

    def with_fault(*given: Any) -> Any:
        right = made(*given)

        def attention(*args: Any, **named: Any) -> Any:
            result = right.vision_attention(*args, **named)
            result[-64:] = 0
            return result

        return dataclasses.replace(right, vision_attention=attention)

    made, ops.ops_of = ops.ops_of, with_fault


def barrier() -> None:
    """The test of the grid's barrier waits for a block that isn't there."""
    stages.check_barrier = partial(stages.check_barrier, missing=1)


def _stuck(looks: int) -> None:
    """The denoising kernel waits for a block that isn't there."""

    def sizes(*given: Any, **named: Any) -> dict[str, int]:
        right = usual(*given, **named)
        return {**right, "TP_BLOCKS": right["TP_BLOCKS"] + 1, "TP_LOOKS": looks}

    usual, denoise.kernel_sizes = denoise.kernel_sizes, sizes


def gives_up() -> None:
    """… for about a second, and then traps."""
    _stuck(1 << 20)


def hangs() -> None:
    """… for hours."""
    _stuck(0)


def does_not_compile() -> None:
    def fails(*given: Any, **named: Any) -> bytes:
        raise BackendError("a kernel doesn't compile with -arch=sm_89")

    denoise.compiled = fails


def out_of_memory() -> None:
    torch.cuda.set_per_process_memory_fraction(0.001)


def room_for_one() -> None:
    """The memory isn't enough for a second policy of full size, as long as the first one is there."""
    made, tries = stages.bench_policy, itertools.count()

    def second_fails(*given: Any, **named: Any) -> Any:
        if next(tries) == 1:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return made(*given, **named)

    stages.bench_policy = second_fails


def slow_clock() -> None:
    """Every third turn takes three times as long."""
    right, turn = stages.measure_calls, itertools.count()

    def slow(*given: Any) -> dict[str, Any]:
        factor = 3.0 if next(turn) % 3 == 0 else 1.0
        found = right(*given)
        times = {number: factor * value for number, value in found["total"].percentiles.items()}
        return {**found, "total": dataclasses.replace(found["total"], percentiles=times)}

    stages.measure_calls = slow


FAULTS: dict[str, Callable[[], None]] = {
    one.__name__: one
    for one in (wrong_tile, barrier, gives_up, hangs, does_not_compile, out_of_memory, room_for_one, slow_clock)
}

if planted := os.environ.get(VARIABLE):
    run.golden = lambda subject: None  # the other stages find it
    FAULTS[planted]()
