"""Matrix products in bfloat16 with float32 sums and a fused epilogue, for compute capability 9.0: see gemm.cu.

Twins: `engine.ops.linear`, `linear_gelu`, `linear_geglu`; EPILOGUE "partial" is `linear` before its sums are added up,
which the norms in `norms.py` do.
"""

import ctypes
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import torch
from torch import Tensor

from turbopi.kernels import hopper
from turbopi.kernels.hopper import SHARED_BYTES, DependentKernel
from turbopi.kernels.nvrtc import compile_cubin

Epilogue = Literal["plain", "bias", "gelu", "geglu", "partial"]
EPILOGUES: dict[Epilogue, int] = {"plain": 0, "bias": 1, "gelu": 2, "geglu": 3, "partial": 4}
DEPTH = 64  # of a step along the inner axis
BF16 = {"TP_FP8": 0, "TP_OUT_FP8": 0, "TP_PROMOTE": 0}  # gemm_fp8.py has the others


@dataclass(frozen=True)
class Tile:
    """How a product is cut: 64 * warpgroups rows by `columns` a CTA, the inner axis into `splits`."""

    warpgroups: int
    columns: int  # of the product; for GeGLU half of them gate, half up
    cluster_m: int = 1  # CTAs that share rows of the weight
    cluster_n: int = 1  # CTAs that share rows of a
    splits: int = 1

    @property
    def rows(self) -> int:
        return 64 * self.warpgroups

    @property
    def cluster(self) -> int:
        return self.cluster_m * self.cluster_n

    @property
    def stages(self) -> int:
        """As many as fit, beside 1 KB of alignment and the barriers."""
        return min(16, (SHARED_BYTES - 2048) // ((self.rows + self.columns) * DEPTH * 2))


def matmul(
    a: Tensor, weight: Tensor, tile: Tile, epilogue: Epilogue, bias: Tensor | None = None, out: Tensor | None = None
) -> Tensor:
    """a [M, K] @ weightᵀ with the epilogue -> bfloat16[M, N]; "partial" -> float32[splits, M, N].

    weight [N, K], for "geglu" [2N, K]. All bfloat16 and contiguous, K and N multiples of 8.
    """
    m, k = a.shape
    n = weight.shape[0] // 2 if epilogue == "geglu" else weight.shape[0]
    assert a.dtype == weight.dtype == torch.bfloat16 and a.is_contiguous() and weight.is_contiguous()
    assert k % 8 == 0 and n % 8 == 0 and weight.shape[1] == k, f"{a.shape} @ {weight.shape}"
    parts = tile.cluster_m * (2 if epilogue == "geglu" else 1)
    assert tile.columns % (8 * parts) == 0 and tile.rows % (8 * tile.cluster_n) == 0, "a share is whole groups of 8"
    assert tile.splits == 1 or epilogue == "partial", "only partial sums can be split"
    if out is None:
        partial = epilogue == "partial"
        shape, dtype = ((tile.splits, m, n), torch.float32) if partial else ((m, n), torch.bfloat16)
        out = torch.empty(shape, dtype=dtype, device=a.device)
    assert out.is_contiguous()
    columns = tile.columns // 2 if epilogue == "geglu" else tile.columns
    m_groups, n_groups = -(-m // (tile.rows * tile.cluster_m)), -(-n // (columns * tile.cluster_n))
    kernel = _kernel(tile, epilogue, a.device)
    arguments = (
        matrix_map(a.data_ptr(), m, k, tile.rows // tile.cluster_n),
        matrix_map(weight.data_ptr(), weight.shape[0], k, columns // tile.cluster_m),
        ctypes.c_void_p(out.data_ptr()),
        ctypes.c_void_p(bias.data_ptr() if bias is not None else None),
        *(ctypes.c_int(value) for value in (m, n, -(-k // DEPTH), m_groups, n_groups)),
    )
    clusters = min(m_groups * n_groups * tile.splits, kernel.max_clusters)
    kernel.launch_dependent(clusters * tile.cluster, arguments)
    return out


def constants(tile: Tile, epilogue: Epilogue) -> dict[str, int]:
    """What gemm.cu is compiled with."""
    return {
        "TP_WGS": tile.warpgroups,
        "TP_BN": tile.columns,
        "TP_STAGES": tile.stages,
        "TP_CM": tile.cluster_m,
        "TP_CN": tile.cluster_n,
        "TP_SPLITS": tile.splits,
        "TP_EPILOGUE": EPILOGUES[epilogue],
        **BF16,
    }


@cache
def _kernel(tile: Tile, epilogue: Epilogue, device: torch.device) -> DependentKernel:
    with torch.cuda.device(device):
        cubin = compile_cubin(source(tile.columns), "sm_90a", constants(tile, epilogue))
        threads = 128 * (tile.warpgroups + 1)
        return DependentKernel(cubin, "gemm", SHARED_BYTES, threads, tile.cluster)


def source(columns: int, fp8: bool = False) -> str:
    """gemm.cu with the instruction for tiles of that many columns."""
    return hopper.source("gemm.cu", hopper.wgmma("mma", columns, fp8=fp8))


def matrix_map(address: int, rows: int, width: int, box_rows: int, fp8: bool = False) -> Any:
    """TMA's map of blocks of box_rows x 128 bytes of a bfloat16 or E4M3 matrix [rows, width]."""
    return hopper.tensor_map(address, (width, rows), (width,), (128 if fp8 else 64, box_rows), fp8)
