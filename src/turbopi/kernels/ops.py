"""The engine's operations on an NVIDIA GPU: its generation's own kernels where there are some, else those for all."""

import os
from dataclasses import replace

import torch

from turbopi.kernels.dependent_launch import capability
from turbopi.kernels.interface import Ops
from turbopi.kernels.portable.ops import portable_ops
from turbopi.kernels.sm90.ops import hopper_ops
from turbopi.kernels.tile_table import NO_TILES, Kernels, TileTable
from turbopi.support.errors import ConfigError

KERNELS_VARIABLE = "TURBOPI_KERNELS"


def forced_portable() -> bool:
    """Whether TURBOPI_KERNELS=portable asks for the kernels for every GPU on Hopper, too.

    Unset or "auto": no. Raises ConfigError for another value.
    """
    value = os.environ.get(KERNELS_VARIABLE, "auto")
    if value not in ("auto", "portable"):
        raise ConfigError(f"{KERNELS_VARIABLE} is {value!r}; expected 'auto' (or unset) or 'portable'")
    return value == "portable"


def hopper_kernels(device: torch.device) -> bool:
    """Whether the kernels for compute capability 9.0 run on this device."""
    return capability(device) == (9, 0) and not forced_portable()


def fused_ops(device: torch.device, tiles: TileTable = NO_TILES) -> Ops:
    """Activations are bfloat16; between a `ScaledMatrix` and the operation before it E4M3 (from compute capability 8.9)
    or int8. `tiles` were measured on this GPU. Raises ConfigError for a TURBOPI_KERNELS that is neither "auto" nor
    "portable".
    """
    return ops_of("hopper" if hopper_kernels(device) else "portable", device, tiles)


def ops_of(kernels: Kernels, device: torch.device, tiles: TileTable) -> Ops:
    """`fused_ops` of these kernels, whichever the device usually takes."""
    if kernels == "portable":
        return portable_ops(tiles)
    ops = hopper_ops(device, tiles)
    return replace(
        ops, origin={**ops.origin, "FP8 products": "CUDA, with bias, GELU, GeGLU and rounding in the epilogue"}
    )
