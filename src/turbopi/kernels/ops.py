"""The engine's operations on an NVIDIA GPU: its generation's own kernels where there are some, else those for all."""

import torch

from turbopi.kernels.dependent_launch import capability
from turbopi.kernels.interface import Ops
from turbopi.kernels.portable.ops import portable_ops
from turbopi.kernels.sm90.ops import hopper_ops


def fused_ops(device: torch.device) -> Ops:
    """Activations are bfloat16; with an `Fp8Matrix` (on Hopper only) E4M3 between it and the operation before it."""
    return hopper_ops(device) if capability(device) == (9, 0) else portable_ops()
