"""Which tile a product is computed with: one that was measured, else one that fits the GPU and costs least by a model.

Nothing is tried out inside a call: `turbopi tune` measures.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

from turbopi.kernels.portable.shared_memory import BLOCK_SHARED, LEAST_SHARED
from turbopi.kernels.tile_table import LIBRARY, Numbers, TileTable

Epilogue = Literal["plain", "gelu", "geglu", "parts"]
Capability = tuple[int, int]

STEP_BYTES = 128  # of a row along the inner axis in one step: 128 E4M3 or int8, or 64 bfloat16
SPLITS = (1, 2, 3, 4)
UNPROMOTED = 2176  # longest sum of E4M3 products that stays in the tensor cores, as in sm90/gemm/fp8.py


@dataclass(frozen=True)
class Tile:
    """rows x columns of a result, of which "geglu" has half as many: each takes a gate's column and an up's.

    splits  parts of the inner axis, for "parts" alone
    """

    rows: int
    columns: int
    warps: int
    stages: int
    splits: int = 1

    def shared_bytes(self, capability: Capability) -> int:
        """With mma.sync Triton holds one stage in registers."""
        held = self.stages - 1 if by_mma_sync(capability) else self.stages
        return held * (self.rows + self.columns) * STEP_BYTES + BARRIERS

    def takes(self, capability: Capability, epilogue: Epilogue, promoted: bool) -> bool:
        """Whether it fits shared memory and registers."""
        if self.shared_bytes(capability) > BLOCK_SHARED.get(capability, LEAST_SHARED):
            return False
        if self.rows * self.columns // (32 * self.warps) <= WIDE:
            return True
        geglu = epilogue == "geglu"
        return not promoted and {9: True, 10: geglu, 11: geglu}.get(capability[0], not geglu)


TILES = (
    *(Tile(128, 256, 8, 4), Tile(128, 256, 8, 3), Tile(128, 128, 8, 4), Tile(128, 128, 8, 3)),
    *(Tile(64, 256, 8, 3), Tile(64, 128, 4, 4), Tile(64, 64, 4, 6), Tile(32, 64, 4, 6)),
)
BARRIERS = 128  # bytes beside the operands
WIDE = 64  # sums a thread: with more, those that are promoted spill, and so do mma.sync's GeGLU and tcgen05's others


def by_mma_sync(capability: Capability) -> bool:
    """Whether Triton multiplies by mma.sync here: 9.0 has wgmma, 10.x and 11.0 tcgen05."""
    return capability[0] not in (9, 10, 11)


def fp8_refusal(capability: Capability) -> str | None:
    """Why this GPU can't multiply E4M3 numbers; None if it can."""
    if capability >= (8, 9):
        return None
    return f"tensor cores multiply E4M3 from compute capability 8.9 on; this GPU has {capability[0]}.{capability[1]}"


def half_sums_refusal(capability: Capability) -> str | None:
    """Why float16 sums of E4M3 aren't for this GPU; None if they are."""
    if (why := fp8_refusal(capability)) is not None or capability[0] not in (10, 11):
        return why
    has = f"this GPU has {capability[0]}.{capability[1]}"
    return f"10.x and 11.0 sum in float32 at the same rate; {has}"


def int8_refusal(capability: Capability) -> str | None:
    """Why INT8 isn't for this GPU; None if it is. Of E4M3 and bfloat16 Triton makes tcgen05 on 10.x and 11.0."""
    if capability[0] not in (10, 11):
        return None
    has = f"this GPU has {capability[0]}.{capability[1]}"
    return f"on compute capability 10.x and 11.0 Triton multiplies INT8 by mma.sync, which nobody timed there; {has}"


def nvfp4_refusal(capability: Capability) -> str | None:
    """Why this GPU can't multiply NVFP4; None if it can."""
    if capability[0] in (10, 11, 12):
        return None
    has = f"this GPU has {capability[0]}.{capability[1]}"
    return f"tensor cores multiply NVFP4 on compute capability 10.x, 11.0 and 12.x; {has}"


def promotes(capability: Capability, inner: int) -> bool:
    """Whether sums over `inner` E4M3 products are added up in float32 after each step.

    Tensor cores of 8.9 and 9.0 keep some 14 bits of a running sum. Those of 10.x and 11.0 keep float32. 12.x is taken
    for an 8.9 until somebody measures it.
    """
    return inner > UNPROMOTED and capability >= (8, 9) and capability[0] not in (10, 11)


def candidates(
    capability: Capability, fp8: bool, epilogue: Epilogue, inner: int, half_sums: bool = False
) -> list[Tile]:
    """All tiles that this GPU takes. fp8: of numbers of eight bits, INT8 too, which takes E4M3's tiles."""
    promoted = half_sums or (fp8 and promotes(capability, inner))
    fitting = [tile for tile in TILES if tile.takes(capability, epilogue, promoted)]
    if epilogue != "parts":
        return fitting
    steps = -(-inner // (STEP_BYTES if fp8 else STEP_BYTES // 2))
    return [
        replace(tile, splits=splits)
        for tile in fitting
        for splits in SPLITS
        if splits == 1 or steps >= splits * 2 * tile.stages
    ]


# -- the model of a tile's cost: clock cycles, from published rates, not fitted ----------------------------------------

# Multiply-adds of bfloat16 a cycle and multiprocessor, with float32 sums; E4M3 has twice as many.
RATES = {(8, 0): 1024, (8, 6): 512, (8, 7): 512, (8, 9): 512, (9, 0): 2048, (10, 0): 4096, (10, 3): 4096, (11, 0): 4096}
DEFAULT_RATE = 512
LOADED = 48  # bytes a cycle and multiprocessor, from the L2 cache
STEP, FIXED, WRITING = 120, 2500, 0.1  # cycles of a step, of a tile besides its steps, of a result
ADDED = 0.1  # cycles that a part's number costs the norm behind, on one multiprocessor


def cost(tile: Tile, capability: Capability, fp8: bool, epilogue: Epilogue, m: int, n: int, k: int, sms: int) -> float:
    """Estimated clock cycles of a product [m, k] x [n, k]; of "geglu" n is the hidden width."""
    columns = tile.columns // 2 if epilogue == "geglu" else tile.columns
    tiles = -(-m // tile.rows) * -(-n // columns) * tile.splits
    depth = STEP_BYTES if fp8 else STEP_BYTES // 2
    rate = RATES.get(capability, DEFAULT_RATE) * (2 if fp8 else 1)
    multiplying = tile.rows * tile.columns * depth / rate
    loading = (tile.rows + tile.columns) * STEP_BYTES / LOADED
    steps = -(-k // depth) / tile.splits
    each = steps * (max(multiplying, loading) + STEP / min(2, _resident(tile, capability)))
    own = FIXED + tile.rows * columns * WRITING
    waves = -(-tiles // sms)
    adding = m * n * tile.splits * ADDED / sms if tile.splits > 1 else 0.0
    return waves * each + -(-waves // _resident(tile, capability)) * own + adding


def _resident(tile: Tile, capability: Capability) -> int:
    """How many blocks a multiprocessor holds, by its shared memory and 64 K registers."""
    registers = 32 * tile.warps * min(255, tile.rows * tile.columns // (32 * tile.warps) + 64)
    shared = BLOCK_SHARED.get(capability, LEAST_SHARED)
    return max(1, min(shared // tile.shared_bytes(capability), 65536 // registers))


@cache
def best_tile(
    capability: Capability, fp8: bool, epilogue: Epilogue, m: int, n: int, k: int, sms: int, half_sums: bool = False
) -> Tile:
    """The tile of least estimated cost."""
    m = -(-m // 64) * 64
    fitting = candidates(capability, fp8, epilogue, k, half_sums)
    return min(fitting, key=lambda tile: cost(tile, capability, fp8, epilogue, m, n, k, sms))


def tuned_tile(table: TileTable, numbers: Numbers, epilogue: Epilogue, m: int, n: int, k: int) -> Tile | None:
    """The measured tile; None if nobody measured one, or the library was faster."""
    knobs = table.find("portable", epilogue, numbers, m, n, k)
    return None if knobs is None or LIBRARY in knobs else Tile(**knobs)
