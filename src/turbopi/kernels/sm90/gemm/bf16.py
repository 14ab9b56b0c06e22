"""Matrix products in bfloat16 with float32 sums and a fused epilogue, for compute capability 9.0: see kernel.cu.

Twins: `linear`, `linear_gelu`, `linear_geglu` of `kernels.plain`; "partial" and "parts" are `linear` before its sums
are added up, which the norms in `norms.py` do.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from turbopi.kernels.ahead import MadeOnce
from turbopi.kernels.arguments import TENSOR_MAP, Parameter, Parameters
from turbopi.kernels.nvrtc import compile_cubin
from turbopi.kernels.sm90 import instructions
from turbopi.kernels.sm90.instructions import SHARED_BYTES, DependentKernel

Epilogue = Literal["plain", "bias", "gelu", "geglu", "partial", "parts", "added"]
EPILOGUES: dict[Epilogue, int] = {"plain": 0, "bias": 1, "gelu": 2, "geglu": 3, "partial": 4, "parts": 5, "added": 6}
SPLIT = ("partial", "parts")
DEPTH = 64  # of a step along the inner axis
STEP_BYTES = 128  # the same, in either precision
HALF_SHARED_BYTES = 113 * 1024  # of one of two CTAs on a multiprocessor
BF16 = {"TP_FP8": 0, "TP_OUT_FP8": 0, "TP_PROMOTE": 0, "TP_INT8": 0, "TP_MARKS": 0}  # fp8.py has the others


@dataclass(frozen=True)
class Tile:
    """How a product is cut: 64 * warpgroups rows by `columns` a CTA, the inner axis into `splits`."""

    warpgroups: int
    columns: int  # of the product; for GeGLU half of them gate, half up
    cluster_m: int = 1  # CTAs that share rows of the weight
    cluster_n: int = 1  # CTAs that share rows of a
    splits: int = 1
    overlap: bool = False  # what follows a tile's sums goes on during the next one's products
    ring: int = 16  # most steps on their way: of more, the first come late
    gather: bool = False  # the splits' sums are added up in a cluster; else the epilogue is "partial" or "parts"

    @property
    def rows(self) -> int:
        return 64 * self.warpgroups

    @property
    def cluster(self) -> int:
        return self.cluster_m * self.cluster_n * (self.splits if self.gather else 1)

    def takes(self, epilogue: Epilogue, steps: int) -> bool:
        """Whether there are steps for the pieces in which an overlapped epilogue goes on between them."""
        if not self.overlap:
            return True
        if epilogue == "geglu":
            return steps > -(-self.columns // 64) * 2
        return epilogue in ("plain", "bias", "gelu", "added") and steps > -(-self.columns // 32)

    def stages(self, *, factors: int, lines: bool = False) -> int:
        """As many as fit beside 1 KB of alignment, barriers, pairs of `factors` a column and warpgroup, and sums.

        With `lines` also beside the rows of 128 bytes in which "parts" leave.
        """
        taken = self.apart(factors=factors) * self._received + self.rows * STEP_BYTES * lines
        return min(self.ring, (self._room(factors) - taken) // self._stage_bytes)

    def apart(self, *, factors: int) -> bool:
        """Whether there is room beside the stages for what a part of the inner axis gets of the others' sums."""
        return self.gather and self._room(factors) - self._received >= 6 * self._stage_bytes

    def shared_bytes(self, *, factors: int, lines: bool) -> int:
        """Of a CTA; arguments as of `stages`."""
        beside = SHARED_BYTES - self._room(factors) + self.rows * STEP_BYTES * lines
        apart = self.apart(factors=factors) * self._received
        return beside + apart + self.stages(factors=factors, lines=lines) * self._stage_bytes

    @property
    def leaves_room(self) -> bool:
        """Whether half of a multiprocessor's registers are enough: then the next kernel's CTAs may start beside."""
        return self.warpgroups == 1 and self.columns <= 128 and not self.overlap

    def halved(self, *, factors: int, lines: bool) -> "Tile":
        """With a ring so short that two CTAs fit a multiprocessor."""
        least = (
            self.shared_bytes(factors=factors, lines=lines)
            - self.stages(factors=factors, lines=lines) * self._stage_bytes
        )
        return replace(self, ring=min(self.ring, max(1, (HALF_SHARED_BYTES - least) // self._stage_bytes)))

    @property
    def _stage_bytes(self) -> int:
        return (self.rows + self.columns) * STEP_BYTES

    @property
    def _received(self) -> int:  # see base.cu
        return (self.splits - 1) * -(-self.columns // 16 // self.splits) * 32 * 128 * self.warpgroups

    def _room(self, factors: int) -> int:
        return SHARED_BYTES - 2048 - 8 * self.warpgroups * self.columns * factors


@dataclass(frozen=True)
class Sums:
    """Of a matrix [M, N]: each row's sum and sum of squares, by the tile that made it. float32[parts, M, 2]"""

    parts: Tensor

    @classmethod
    def allocate(cls, tile: Tile, m: int, n: int, device: torch.device) -> "Sums":
        count = -(-n // tile.columns) * (tile.splits if tile.gather else 1)
        return cls(torch.empty(count, m, 2, device=device))

    @property
    def count(self) -> int:
        return self.parts.shape[0]


@dataclass(frozen=True)
class Copy:
    """An E4M3 copy of the result x: round((x - mean) / deviation * scale + shift).

    Mean and deviation are those of the *residual*'s rows. `sums_out` are then of (x - mean) / deviation, and what the
    norm adds to the variance of x is in the squares; `plain` are of x.
    """

    out: Tensor  # e4m3[M, N]
    sums: Sums  # of the residual
    scale: Tensor  # float32[N]  of the LayerNorm behind, over the scale of the copy
    shift: Tensor  # float32[N]  the same
    eps: float
    plain: Sums  # written, as out is


@dataclass(frozen=True)
class Folded:
    """A matrix [N, K] that takes LayerNorm of its input: the norm's scale is in it, its shift in the offset."""

    data: Tensor  # bfloat16[N, K]
    sums: Tensor  # float32[N]  of each row of data
    offset: Tensor  # float32[N]  with the bias

    @classmethod
    def fold(cls, weight: Tensor, bias: Tensor, scale: Tensor, shift: Tensor) -> "Folded":
        """A matrix and its bias behind a LayerNorm of that scale and shift; rounded once more, from float32.

        Where the norm rounds its result instead, the error is the same: measured 0.9 of it, whatever the rows' mean.
        """
        wide = weight.float()
        data = (wide * scale.float()).to(weight.dtype)
        return cls(data, data.float().sum(1), wide @ shift.float() + bias.float())


def matmul(
    a: Tensor,
    weight: Tensor | Folded,
    tile: Tile,
    epilogue: Epilogue,
    bias: Tensor | None = None,
    out: Tensor | None = None,
    *,
    residual: Tensor | None = None,
    sums_out: Sums | None = None,
    sums: Sums | None = None,
    eps: float = 0.0,
    copy: Copy | None = None,
    ahead: Tensor | None = None,
) -> Tensor:
    """a [M, K] @ weightᵀ with the epilogue -> bfloat16[M, N]; "partial" -> float32, "parts" -> bfloat16[splits, M, N].
    "added" rounds a whole product, with its bias or none, and adds it to what is in `out`.

    weight [N, K], for "geglu" [2N, K]. All bfloat16 and contiguous, K and N multiples of 8. With "bias" alone,
    `residual` [M, N] is added, the sums of the result's rows go into `sums_out`, and a `copy` may leave, too. With a
    `Folded` weight, whose bias is in it, a's LayerNorm is multiplied, made of the `sums` of a's rows. `ahead` is
    fetched into L2 in the end.
    """
    folded, weight = (weight, weight.data) if isinstance(weight, Folded) else (None, weight)
    assert (folded is None) == (sums is None) and (folded is None or (bias is None and epilogue in ("bias", "gelu")))
    assert not tile.gather or folded is None, "sums are gathered after that"
    m, k = a.shape
    n = weight.shape[0] // 2 if epilogue == "geglu" else weight.shape[0]
    assert a.dtype == weight.dtype == torch.bfloat16 and a.is_contiguous() and weight.is_contiguous()
    assert k % 8 == 0 and n % 8 == 0 and weight.shape[1] == k, f"{a.shape} @ {weight.shape}"
    columns, groups = layout(tile, epilogue, m, n, -(-k // DEPTH), residual, sums_out)
    tile = fitted(tile, groups, -(-k // DEPTH), a.device)
    assert out is not None or epilogue != "added"
    if out is None:
        shape = (tile.splits, m, n) if epilogue in SPLIT else (m, n)
        out = torch.empty(shape, dtype=torch.float32 if epilogue == "partial" else torch.bfloat16, device=a.device)
    assert out.is_contiguous()
    assert copy is None or (residual is not None and sums is None)
    kernel = _kernel(
        tile, epilogue, residual is not None, 0 if sums is None else sums.count, copied_parts(copy, m, n), a.device
    )
    given = {
        "map_a": matrix_map(a.data_ptr(), m, k, tile.rows // tile.cluster_n),
        "map_w": matrix_map(weight.data_ptr(), weight.shape[0], k, columns // tile.cluster_m),
        **product_arguments(out, bias, residual, sums_out),
        **({} if folded is None else norm_arguments(sums, k, eps, folded.sums, folded.offset)),
        **copy_arguments(copy, n),
        **size_arguments(m, n, -(-k // DEPTH), groups),
    }
    launch(kernel, tile, groups, given, ahead)
    return out


def layout(
    tile: Tile, epilogue: Epilogue, m: int, n: int, steps: int, residual: Tensor | None, sums_out: Sums | None
) -> tuple[int, tuple[int, int]]:
    """(columns of the result in a tile, how many clusters' tiles it takes along M and along N)"""
    assert residual is None or (epilogue == "bias" and residual.is_contiguous() and sums_out is not None)
    assert residual is None or not tile.overlap, "the stream is added behind the sums"
    assert tile.splits <= steps and tile.takes(epilogue, steps), f"{steps} steps are too few for {tile}"
    assert not tile.gather or epilogue not in ("geglu", "added"), "sums are gathered after that"
    parts = tile.cluster_m * (2 if epilogue == "geglu" else 1)
    assert tile.columns % (8 * parts) == 0 and tile.rows % (8 * tile.cluster_n) == 0, "a share is whole groups of 8"
    assert (tile.splits == 1 or epilogue in SPLIT) != tile.gather, "only partial sums stay split"
    columns = tile.columns // 2 if epilogue == "geglu" else tile.columns
    return columns, (-(-m // (tile.rows * tile.cluster_m)), -(-n // (columns * tile.cluster_n)))


def fitted(tile: Tile, groups: tuple[int, int], steps: int, device: torch.device) -> Tile:
    """What leaves room, with a ring of no more steps than a CTA has, if it has but one tile: the rest of shared memory
    is the next kernel's.
    """
    units = groups[0] * groups[1] * tile.cluster_m * tile.cluster_n * tile.splits
    if tile.gather or not tile.leaves_room or units > instructions.multiprocessors(device):
        return tile
    return replace(tile, ring=min(tile.ring, -(-steps // tile.splits)))


def launch(
    kernel: DependentKernel, tile: Tile, groups: tuple[int, int], given: dict[str, Any], ahead: Tensor | None
) -> None:
    """`given` has all parameters but the last two. `ahead` is the matrix that is to be in L2 for the next product; each
    block fetches a share of it.
    """
    assert groups[0] * groups[1] * tile.splits < 1 << 20, "kernel.cu divides no larger numbers"
    blocks = clusters(tile, groups[0] * groups[1], kernel.max_clusters) * tile.cluster
    share = 0 if ahead is None else ahead.numel() * ahead.element_size() // blocks // 16 * 16
    place = ahead.data_ptr() if ahead is not None and share else None
    kernel.launch_dependent(blocks, given | {"ahead": place, "ahead_bytes": share})


def parameters(*, fp8: bool, residual: bool, normed: bool, copied: bool, marks: bool = False) -> Parameters:
    """What kernel.cu's kernel takes in these forms."""
    rows = (
        Parameter("const float2*", "sums_in", "[parts][M]: the sum and the sum of squares of a row"),
        Parameter("float", "inverse_width"),
        Parameter("float", "eps"),
    )
    return Parameters(
        (
            Parameter(TENSOR_MAP, "map_a"),
            Parameter(TENSOR_MAP, "map_w"),
            Parameter("void*", "out"),
            Parameter("const u32*", "bias"),
            *((Parameter("const float*", "scale"), Parameter("float", "inverse")) if fp8 else ()),
            *((Parameter("const u32*", "residual"), Parameter("float2*", "sums_out")) if residual else ()),
            *(rows if normed or copied else ()),
            *((Parameter("const float*", "sums_of_w"), Parameter("const float*", "offset")) if normed else ()),
            *((Parameter("const float2*", "norm_scale"), Parameter("const float2*", "norm_shift")) if copied else ()),
            *((Parameter("unsigned char*", "copy"), Parameter("float2*", "plain_sums")) if copied else ()),
            *((Parameter("u16*", "marked"), Parameter("int", "mark_pitch")) if marks else ()),
            *(Parameter("int", name) for name in ("M", "N", "k_blocks", "m_groups", "n_groups")),
            Parameter("const char*", "ahead"),
            Parameter("u32", "ahead_bytes"),
        )
    )


def product_arguments(
    out: Tensor, bias: Tensor | None, residual: Tensor | None, sums_out: Sums | None
) -> dict[str, Any]:
    given: dict[str, Any] = {"out": out.data_ptr(), "bias": None if bias is None else bias.data_ptr()}
    if residual is not None and sums_out is not None:
        given |= {"residual": residual.data_ptr(), "sums_out": sums_out.parts.data_ptr()}
    return given


def size_arguments(m: int, n: int, k_blocks: int, groups: tuple[int, int]) -> dict[str, int]:
    """Rows and columns of the result, steps along the inner axis, groups of tiles along M and N."""
    return {"M": m, "N": n, "k_blocks": k_blocks, "m_groups": groups[0], "n_groups": groups[1]}


def norm_arguments(sums: Sums | None, width: int, eps: float, of_weight: Tensor, offset: Tensor) -> dict[str, Any]:
    assert sums is not None
    return _row_arguments(sums, width, eps) | {"sums_of_w": of_weight.data_ptr(), "offset": offset.data_ptr()}


def copied_parts(copy: Copy | None, m: int, n: int) -> int:
    """TP_COPY of kernel.cu."""
    if copy is None:
        return 0
    assert (
        copy.out.is_contiguous() and copy.out.shape == (m, n) and copy.scale.dtype == copy.shift.dtype == torch.float32
    )
    return copy.sums.count


def copy_arguments(copy: Copy | None, width: int) -> dict[str, Any]:
    if copy is None:
        return {}
    return _row_arguments(copy.sums, width, copy.eps) | {
        "norm_scale": copy.scale.data_ptr(),
        "norm_shift": copy.shift.data_ptr(),
        "copy": copy.out.data_ptr(),
        "plain_sums": copy.plain.parts.data_ptr(),
    }


def _row_arguments(sums: Sums, width: int, eps: float) -> dict[str, Any]:
    return {"sums_in": sums.parts.data_ptr(), "inverse_width": 1 / width, "eps": eps}


def clusters(tile: Tile, groups: int, at_once: int) -> int:
    """How many clusters work on so many groups of tiles."""
    assert not tile.gather or groups <= at_once, f"{tile} leaves no room for a second tile, there are {groups}"
    return min(groups * (1 if tile.gather else tile.splits), at_once)


def constants(
    tile: Tile, epilogue: Epilogue, residual: bool = False, normed: int = 0, copied: int = 0
) -> dict[str, int]:
    """What kernel.cu is compiled with."""
    factors = normed > 0 or (tile.overlap and epilogue in ("bias", "gelu", "added"))  # biases lie in shared memory then
    return tile_constants(tile, epilogue, residual, factors=factors) | {
        "TP_NORMED": normed,
        "TP_COPY": copied,
        **BF16,
    }


def tile_constants(
    tile: Tile, epilogue: Epilogue, residual: bool, *, factors: int, promoted: bool = False
) -> dict[str, int]:
    """Of these, what doesn't depend on the precision; for `factors` see `Tile.stages`."""
    lines = leaves_in_lines(tile, epilogue)
    return {
        "TP_WGS": tile.warpgroups,
        "TP_BN": tile.columns,
        "TP_STAGES": tile.stages(factors=factors, lines=lines),
        "TP_SHARED_BYTES": tile.shared_bytes(factors=factors, lines=lines),
        "TP_LEAVES_ROOM": int(tile.leaves_room and not (residual and promoted)),
        "TP_CM": tile.cluster_m,
        "TP_CN": tile.cluster_n,
        "TP_SPLITS": tile.splits,
        "TP_GATHER": int(tile.gather),
        "TP_OVERLAP": int(tile.overlap),
        "TP_APART": int(tile.apart(factors=factors)),
        "TP_EPILOGUE": EPILOGUES[epilogue],
        "TP_RESIDUAL": int(residual),
    }


def leaves_in_lines(tile: Tile, epilogue: Epilogue) -> bool:
    """Whether results take the way through shared memory."""
    return epilogue == "parts" or (epilogue == "added" and not tile.overlap)


@MadeOnce
def _kernel(
    tile: Tile, epilogue: Epilogue, residual: bool, normed: int, copied: int, device: torch.device
) -> DependentKernel:
    takes = parameters(fp8=False, residual=residual, normed=normed > 0, copied=copied > 0)
    return build(takes, constants(tile, epilogue, residual, normed, copied), tile, device)


def build(takes: Parameters, sizes: dict[str, int], tile: Tile, device: torch.device) -> DependentKernel:
    with torch.cuda.device(device):
        cubin = compile_cubin(
            source(tile.columns, takes, fp8=bool(sizes["TP_FP8"]), whole=bool(sizes["TP_INT8"])), "sm_90a", sizes
        )
        threads, shared = 128 * (tile.warpgroups + 1), sizes["TP_SHARED_BYTES"]
        return DependentKernel(cubin, "gemm", takes, shared_bytes=shared, threads=threads, cluster=tile.cluster)


def source(columns: int, takes: Parameters, *, fp8: bool, whole: bool = False) -> str:
    """base.cu, overlap.cu and kernel.cu with the instruction for tiles of that many columns. whole: of int8."""
    mma = instructions.wgmma("mma", columns, numbers="s8" if whole else "e4m3" if fp8 else "bf16")
    generated = f"{mma}\n#define GEMM_PARAMETERS {takes.declarations}\n"
    return instructions.source("gemm/base.cu", "gemm/overlap.cu", "gemm/kernel.cu", generated=generated)


def matrix_map(address: int, rows: int, width: int, box_rows: int, fp8: bool = False) -> Any:
    """TMA's map of blocks of box_rows x 128 bytes of a bfloat16 or E4M3 matrix [rows, width]."""
    return instructions.tensor_map(address, (width, rows), (width,), (128 if fp8 else 64, box_rows), fp8)
