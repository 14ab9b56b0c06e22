"""Faults for the process that qualifies a GPU, which imports this module (`qualifying.DOUBLE_VARIABLE`).

TURBOPI_PLANTED names the one that is planted.
"""

import dataclasses
import os
from collections.abc import Callable
from typing import Any

import torch

from turbopi.kernels import ops as ops_module
from turbopi.kernels.portable.denoise import kernel
from turbopi.qualify import run
from turbopi.qualify import stages as stages_module

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


def hangs() -> None:
    """The denoising kernel waits for a block that isn't there, for hours."""

    def sizes(*given: Any, **named: Any) -> dict[str, int]:
        right = usual(*given, **named)
        return {**right, "TP_BLOCKS": right["TP_BLOCKS"] + 1, "TP_LOOKS": 0}

    usual, denoise.kernel_sizes = denoise.kernel_sizes, sizes


def out_of_memory() -> None:
    torch.cuda.set_per_process_memory_fraction(0.001)


FAULTS: dict[str, Callable[[], None]] = {one.__name__: one for one in (wrong_tile, hangs, out_of_memory)}

if planted := os.environ.get(VARIABLE):
    run.golden = lambda subject: None  # the other stages find it
    FAULTS[planted]()
