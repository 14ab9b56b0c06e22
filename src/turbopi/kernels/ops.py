"""The engine's operations on an NVIDIA GPU: its generation's own kernels where there are some, else those for all."""

import os
from collections.abc import Callable, Collection
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from turbopi.kernels.dependent_launch import capability
from turbopi.kernels.interface import Ops
from turbopi.kernels.plain import PLAIN
from turbopi.kernels.portable.nvfp4 import in_nvfp4
from turbopi.kernels.portable.ops import portable_ops
from turbopi.kernels.sm90.ops import hopper_ops, in_int8
from turbopi.kernels.tile_table import NO_TILES, Kernels, TileTable
from turbopi.support.errors import ConfigError

KERNELS_VARIABLE = "TURBOPI_KERNELS"


def _adding_parts(norm: Callable[..., Any]) -> Callable[..., Any]:
    def residual_norm(x: Tensor, y: Tensor | None, *given: Any, **named: Any) -> Any:
        return norm(x, y.float().sum(0).to(x.dtype) if y is not None and y.dim() == 3 else y, *given, **named)

    return residual_norm


# `PLAIN` among kernels, whose matmuls may leave parts for the norm behind them
BESIDE = replace(
    PLAIN,
    residual_rms_norm=_adding_parts(PLAIN.residual_rms_norm),
    residual_layer_norm=_adding_parts(PLAIN.residual_layer_norm),
)


def forced_portable() -> bool:
    """Whether TURBOPI_KERNELS=portable asks for the kernels for every GPU on Hopper, too.

    Unset or "auto": no. Raises ConfigError for another value.
    """
    value = os.environ.get(KERNELS_VARIABLE, "auto")
    if value not in ("auto", "portable"):
        raise ConfigError(f"{KERNELS_VARIABLE} is {value!r}; expected 'auto' (or unset) or 'portable'")
    return value == "portable"


def hopper_kernels(device: torch.device, without: Collection[str] = ()) -> bool:
    """Whether the kernels for compute capability 9.0 run on this device. `without` "sm90" no."""
    return capability(device) == (9, 0) and not (forced_portable() or "sm90" in without)


def fused_ops(
    device: torch.device, tiles: TileTable = NO_TILES, without: Collection[str] = (), precision: str = "bf16"
) -> Ops:
    """Activations are bfloat16; between a `ScaledMatrix` and the operation before it E4M3 (from compute capability 8.9)
    or int8. `tiles` were measured on this GPU. Raises ConfigError for a TURBOPI_KERNELS that is neither "auto" nor
    "portable".

    without  names of operations that failed their self-test on this GPU: PyTorch's take their place; "sm90": all of
             Hopper's
    """
    on_hopper = hopper_kernels(device, without)
    ops = ops_of("hopper" if on_hopper else "portable", device, tiles)
    if on_hopper and precision == "int8":
        ops = in_int8(ops)
    if precision == "nvfp4":
        ops = in_nvfp4(ops)
    instead: dict[str, Any] = {one.name: getattr(BESIDE, one.name) for one in fields(Ops) if one.name in without}
    if not instead:
        return ops
    return replace(ops, **instead, origin={**ops.origin, f"{', '.join(instead)}, excluded by a self-test": "PyTorch"})


def ops_of(kernels: Kernels, device: torch.device, tiles: TileTable) -> Ops:
    """`fused_ops` of these kernels, whichever the device usually takes."""
    if kernels == "portable":
        return portable_ops(tiles)
    ops = hopper_ops(device, tiles)
    return replace(
        ops, origin={**ops.origin, "FP8 products": "CUDA, with bias, GELU, GeGLU and rounding in the epilogue"}
    )
