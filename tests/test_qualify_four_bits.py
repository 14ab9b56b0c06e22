"""What qualifies a machine for NVFP4: its kernels beside their emulation, and planted faults."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from conftest import gpu_or_interpreter

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels.portable.gemm.tiles import nvfp4_refusal
from turbopi.qualify import four_bits
from turbopi.quantization.nvfp4 import Nvfp4Matrix, round_blocks

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
WITHOUT = DEVICE.type == "cuda" and nvfp4_refusal(torch.cuda.get_device_capability()) is not None
pytestmark = [*gpu_or_interpreter(), pytest.mark.skipif(WITHOUT, reason="this GPU hasn't the instruction")]


def test_the_kernels_are_right_beside_their_emulation(monkeypatch: pytest.MonkeyPatch) -> None:
    small = [("plain", 130, 144, 40), ("gelu", 20, 256, 136), ("geglu", 9, 128, 72)]
    monkeypatch.setattr(four_bits, "_CASES", four_bits._CASES if DEVICE.type == "cuda" else small)
    why, errors = four_bits.check_four_bits(DEVICE)
    assert why is None and len(errors) == len(four_bits._CASES) and max(errors.values()) < 1e-5


def swizzled(matrix: Nvfp4Matrix) -> Nvfp4Matrix:
    blocks = matrix.blocks.view(torch.uint8).clone()
    blocks[:, 0:2] = blocks[:, 0:2].flip(1)
    return Nvfp4Matrix(**{**vars(matrix), "blocks": blocks.view(torch.float8_e4m3fn)})


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        (lambda right, x, matrix, *given, **named: right(x, swizzled(matrix), *given, **named), "is off by"),
        (lambda right, *given, **named: right(*given, **named).bfloat16().float(), "at most 0.001 is right"),
        (lambda right, *given, **named: right(*given, **named).nan_to_num(), "doesn't stay in its row"),
    ],
)
def test_a_fault_is_found(fault: Callable[..., Any], says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    right = four_bits.product
    monkeypatch.setattr(four_bits, "product", lambda *given, **named: fault(right, *given, **named))
    monkeypatch.setattr(four_bits, "_CASES", [("gelu", 9, 256, 40)])
    why, _ = four_bits.check_four_bits(DEVICE)
    assert why is not None and says in why


def test_an_activation_that_is_rounded_otherwise_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(four_bits, "round_blocks", lambda x, *given: round_blocks(x * 1.01, *given))
    monkeypatch.setattr(four_bits, "_CASES", [("gelu", 9, 256, 40)])
    assert "aren't rounded" in str(four_bits.check_four_bits(DEVICE)[0])
