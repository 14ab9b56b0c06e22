"""Bytes that a thread may spill to local memory, by kernel and target: what the checked-in result has.

A spill is a problem unless it is named here. Nobody may raise a number without a reason; a test lowers it with the
result. All of them are written and read a few times a phase or a tile, not in the loops that multiply.
"""

ALLOWED: dict[str, dict[int, int]] = {
    # Timed on an H200 as it is: docs/dev/log.md
    "sm90: denoising": {90: 64},
    # Once a tile, around the pieces of its epilogue. The tuner measured it faster than tiles that don't spill
    "sm90: vision's qkv in batches": {90: 16},
    # Before the loop that multiplies, and behind it: two blocks shall fit a multiprocessor
    "sm90: way back": {90: 16},
    # Sums of whole numbers become float32 in other registers
    "sm90: prefix's GeGLU, int8": {90: 192},
    # What lives across a phase: the first weights and keys, asked for before the barrier, and addresses. 8.7 and 11.0
    # have so few multiprocessors that a product takes several passes, with their addresses. A barrier's looks, which
    # its watchdog counts, are a register more: some targets spill more than without it, others less. 1 / rms of seven
    # tokens at once is 8 to 24 bytes of 8.7 and 11.0; ranges of tokens by 16 warps, on 132 multiprocessors and more,
    # are up to 104, and took 9 to 31 % less on an H200 than 8 warps without
    "denoise.kernel": {80: 8, 86: 24, 87: 176, 90: 104, 100: 80, 103: 80, 110: 304, 120: 48, 121: 24},
    # Of heads of 64 columns, SmolVLA's, tiles that only a measurement chooses
    "attention.vision": {80: 16, 86: 16, 87: 16, 89: 16, 100: 8, 103: 8},
    # Into INT8, tiles that only a measurement chooses
    "attention.prefix": {90: 16},
    "batch.packed": {90: 8},
    # As `denoise.kernel`, in the 128 registers that 16 warps leave. In attention a warp holds 16 keys and their values:
    # 8 to 16 bytes more at 8.0, 8.9 and 11.0, less elsewhere. From 9.0 on, layers across are one phase. INT8's up to
    # 8.9 and at 12.1; half as many weights on their way spill 120 fewer at 8.7 and 80 more at 12.1
    "SmolVLA's denoise.kernel": {
        80: 64,
        86: 56,
        87: 320,
        89: 80,
        90: 32,
        100: 16,
        103: 16,
        110: 168,
        120: 32,
        121: 208,
    },
    # Behind more than 16 tokens: RoPE of 32 of the suffix's keys, once a block. More than 8 bytes are of a tile of 64
    # rows, which only a measurement chooses
    "batch.suffix": {80: 16, 87: 8, 90: 8, 100: 8, 103: 8, 110: 8},
    # Of 11.0 GeGLU's largest tile, in its epilogue: by the model of the cost the next one takes a fifth longer. Of 12.x
    # a tile that only a measurement chooses
    "gemm.kernel.product": {110: 200, 120: 8, 121: 8},
    # A variant, of the first tiles that were written, timed on an H200 as it is
    "vjp.products.parts": {100: 8, 103: 8, 120: 8, 121: 8},
}


def allowed(kernel: str, number: int) -> int:
    """Bytes for a kernel, by the start of its name, on a target (89)."""
    return max((targets.get(number, 0) for name, targets in ALLOWED.items() if kernel.startswith(name)), default=0)
