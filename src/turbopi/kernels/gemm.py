"""Matrix products in bfloat16 with float32 sums and a fused epilogue, for compute capability 9.0: see gemm.cu.

Twins: `engine.ops.linear`, `linear_gelu`, `linear_geglu`; EPILOGUE "partial" is `linear` before its sums are added up,
which the norms in `norms.py` do.
"""

import ctypes
import re
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.resources import files
from typing import Any, Literal

import torch
from torch import Tensor

from turbopi.kernels.nvrtc import Kernel, bindings, compile_cubin

Epilogue = Literal["plain", "bias", "gelu", "geglu", "partial"]
EPILOGUES: dict[Epilogue, int] = {"plain": 0, "bias": 1, "gelu": 2, "geglu": 3, "partial": 4}
SHARED_BYTES = 227 * 1024
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
        tensor_map(a.data_ptr(), m, k, tile.rows // tile.cluster_n),
        tensor_map(weight.data_ptr(), weight.shape[0], k, columns // tile.cluster_m),
        ctypes.c_void_p(out.data_ptr()),
        ctypes.c_void_p(bias.data_ptr() if bias is not None else None),
        *(ctypes.c_int(value) for value in (m, n, -(-k // DEPTH), m_groups, n_groups)),
    )
    clusters = min(m_groups * n_groups * tile.splits, kernel.max_clusters)
    kernel.launch_dependent(clusters * tile.cluster, arguments)
    return out


class DependentKernel(Kernel):
    """A kernel whose blocks may start before the kernel ahead of it ends (it waits for its results itself)."""

    def __init__(self, cubin: bytes, name: str, shared_bytes: int, threads: int, cluster: int) -> None:
        super().__init__(cubin, name, shared_bytes)
        d = self._driver
        dependent, clusters = d.CUlaunchAttribute(), d.CUlaunchAttribute()
        dependent.id = d.CUlaunchAttributeID.CU_LAUNCH_ATTRIBUTE_PROGRAMMATIC_STREAM_SERIALIZATION
        dependent.value.programmaticStreamSerializationAllowed = 1
        clusters.id = d.CUlaunchAttributeID.CU_LAUNCH_ATTRIBUTE_CLUSTER_DIMENSION
        clusters.value.clusterDim.x, clusters.value.clusterDim.y, clusters.value.clusterDim.z = cluster, 1, 1
        self._attributes = [dependent, clusters]
        self._threads = threads
        status, self.max_clusters = d.cuOccupancyMaxActiveClusters(self._function, self._config(cluster))
        assert int(status) == 0 and self.max_clusters > 0, f"no room for clusters of {cluster}: {status!r}"

    def launch_dependent(self, blocks: int, arguments: tuple[Any, ...]) -> None:
        """Launch on PyTorch's current stream; `arguments` are ctypes values."""
        pointers = (ctypes.c_void_p * len(arguments))(*(ctypes.addressof(value) for value in arguments))
        config = self._config(blocks)
        (status,) = self._driver.cuLaunchKernelEx(config, self._function, ctypes.addressof(pointers), 0)
        assert int(status) == 0, f"launch failed: {status!r}"

    def _config(self, blocks: int) -> Any:
        config = self._driver.CUlaunchConfig()
        config.gridDimX, config.gridDimY, config.gridDimZ = blocks, 1, 1
        config.blockDimX, config.blockDimY, config.blockDimZ = self._threads, 1, 1
        config.sharedMemBytes = self._shared
        config.hStream = torch.cuda.current_stream().cuda_stream
        config.attrs, config.numAttrs = self._attributes, len(self._attributes)
        return config


@cache
def _kernel(tile: Tile, epilogue: Epilogue, device: torch.device) -> DependentKernel:
    sizes = {
        "TP_WGS": tile.warpgroups,
        "TP_BN": tile.columns,
        "TP_STAGES": tile.stages,
        "TP_CM": tile.cluster_m,
        "TP_CN": tile.cluster_n,
        "TP_SPLITS": tile.splits,
        "TP_EPILOGUE": EPILOGUES[epilogue],
        **BF16,
    }
    with torch.cuda.device(device):
        cubin = compile_cubin(source(tile.columns), "sm_90a", sizes)
        threads = 128 * (tile.warpgroups + 1)
        return DependentKernel(cubin, "gemm", SHARED_BYTES, threads, tile.cluster)


def source(columns: int, fp8: bool = False) -> str:
    """gemm.cu with the instruction for tiles of that many columns: its operands can't be written generically."""
    assert columns % 8 == 0 and columns <= 256
    count = columns // 2
    registers = ", ".join(f"%{i}" for i in range(count))
    outputs = ", ".join(f'"+f"(d[{i}])' for i in range(count))
    form, transposed = ("k32.f32.e4m3.e4m3", "") if fp8 else ("k16.f32.bf16.bf16", ", 0, 0")
    instruction = (
        f"__device__ __forceinline__ void mma(float (&d)[{count}], u64 a, u64 b, int keep) {{\n"
        f'asm volatile("{{ .reg .pred p; setp.ne.b32 p, %{count + 2}, 0;\\n"\n'
        f'"wgmma.mma_async.sync.aligned.m64n{columns}{form} {{{registers}}}, %{count}, %{count + 1},"\n'
        f'" p, 1, 1{transposed}; }}" : {outputs} : "l"(a), "l"(b), "r"(keep)); }}'
    )
    text = (files("turbopi.kernels") / "gemm.cu").read_text()
    return re.sub(r"^TP_MMA.*$", lambda _: instruction, text, flags=re.MULTILINE)


class _TensorMap(ctypes.Structure):
    _fields_ = (("bytes", ctypes.c_char * 128),)


@lru_cache(maxsize=65536)
def tensor_map(address: int, rows: int, width: int, box_rows: int, fp8: bool = False) -> _TensorMap:
    """How TMA finds blocks of box_rows x 128 bytes of a bfloat16 or E4M3 matrix [rows, width], with zeros beyond it."""
    d = bindings("driver")
    size = 1 if fp8 else 2
    types = d.CUtensorMapDataType
    status, encoded = d.cuTensorMapEncodeTiled(
        types.CU_TENSOR_MAP_DATA_TYPE_UINT8 if fp8 else types.CU_TENSOR_MAP_DATA_TYPE_BFLOAT16,
        2,
        address,
        [d.cuuint64_t(width), d.cuuint64_t(rows)],
        [d.cuuint64_t(width * size)],
        [d.cuuint32_t(128 // size), d.cuuint32_t(box_rows)],
        [d.cuuint32_t(1), d.cuuint32_t(1)],
        d.CUtensorMapInterleave.CU_TENSOR_MAP_INTERLEAVE_NONE,
        d.CUtensorMapSwizzle.CU_TENSOR_MAP_SWIZZLE_128B,
        d.CUtensorMapL2promotion.CU_TENSOR_MAP_L2_PROMOTION_L2_256B,
        d.CUtensorMapFloatOOBfill.CU_TENSOR_MAP_FLOAT_OOB_FILL_NONE,
    )
    assert int(status) == 0, f"no tensor map for {rows} x {width} at {address:#x}: {status!r}"
    result = _TensorMap()
    ctypes.memmove(ctypes.addressof(result), encoded.getPtr(), 128)
    return result
