"""NVFP4's kernels beside their emulation, on numbers that show scales in another order, or ignored, or a NaN lost.

No operation takes their place: what is wrong here refuses the precision.
"""

from dataclasses import replace

import torch

from turbopi.kernels import plain
from turbopi.kernels.portable.nvfp4 import Epilogue, product, round_activation
from turbopi.quantization.nvfp4 import Nvfp4Matrix, block_scales, pack, round_blocks, whole
from turbopi.support.text import significant

OPERATIONS = ("linear", "residual_linear", "linear_gelu", "linear_geglu")
SUMS_BOUND = 1e-3  # relative rms: of sums in float32 in any order it is some 1e-6, of bfloat16's 2e-3
# epilogue, tokens, in, out: whole tiles and parts of them, steps of 128 and of 256 numbers
_CASES: tuple[tuple[Epilogue, int, int, int], ...] = (
    ("plain", 130, 1152, 384),
    ("plain", 256, 4304, 200),
    ("gelu", 77, 2048, 136),
    ("geglu", 130, 2048, 192),
)
_SCALE = 0.002  # of the activations' tensor: the largest block's scale saturates


def check_four_bits(device: torch.device) -> tuple[str | None, dict[str, float]]:
    """(what isn't right, in words; None: all is; the relative rms error by case)."""
    errors: dict[str, float] = {}
    for epilogue, tokens, inner, out in _CASES:
        name = f"{epilogue} [{tokens}, {inner}] x {out}"
        generator = torch.Generator().manual_seed(tokens)
        rows = 2 * out if epilogue == "geglu" else out
        sizes = [
            torch.exp2(2 * torch.randn(1, inner // 16, generator=generator)).repeat_interleave(16, 1) for _ in "xw"
        ]
        x = (torch.randn(tokens, inner, generator=generator) * sizes[0]).bfloat16().to(device)
        weight = (torch.randn(rows, inner, generator=generator) * sizes[1] / inner).bfloat16().to(device)
        bias = None if epilogue == "geglu" else torch.randn(out, generator=generator).to(device)
        x[3, 17] = torch.nan
        matrix = replace(Nvfp4Matrix.of(weight, _SCALE), dtype=torch.float32)
        codes, blocks = round_activation(x, _SCALE)
        exact = block_scales(x, _SCALE)
        same = torch.equal(blocks.view(torch.uint8)[:, : inner // 16], exact.view(torch.uint8))
        if not same or not torch.equal(codes[:, : inner // 2], pack(round_blocks(x, _SCALE, exact))):
            return f"activations of {name} aren't rounded as NVFP4 is", errors
        assert codes.shape[1] == whole(inner) // 2
        expected = matrix.product(x, bias)
        expected = {"plain": lambda y: y, "gelu": plain.gelu, "geglu": plain.geglu}[epilogue](expected)
        found = product(x, matrix, epilogue, bias)
        if not torch.equal(found.isnan(), expected.isnan()):
            return f"a NaN of {name} doesn't stay in its row, and nowhere else", errors
        found, expected = found.nan_to_num(), expected.nan_to_num()
        errors[name] = float((found - expected).norm() / expected.norm())
        if not errors[name] <= SUMS_BOUND:
            return f"{name} is off by {significant(errors[name])}; at most {SUMS_BOUND} is right", errors
    return None, errors
