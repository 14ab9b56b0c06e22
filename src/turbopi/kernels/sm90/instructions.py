"""What the CUDA kernels for compute capability 9.0 share on the host: their launch, TMA's maps, wgmma's instructions.

Their sources begin with instructions.cu.
"""

import ctypes
from collections.abc import Mapping
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import torch

from turbopi.kernels.arguments import Parameters
from turbopi.kernels.nvrtc import Kernel, bindings, checked
from turbopi.support.errors import BackendUnavailable

SHARED_BYTES = 227 * 1024


class DependentKernel(Kernel):
    """A kernel whose blocks may start before the kernel ahead of it ends (it waits for its results itself)."""

    def __init__(
        self, cubin: bytes, name: str, parameters: Parameters, *, shared_bytes: int, threads: int, cluster: int
    ) -> None:
        super().__init__(cubin, name, shared_bytes)
        self._parameters = parameters
        d = self._driver
        dependent, clusters = d.CUlaunchAttribute(), d.CUlaunchAttribute()
        dependent.id = d.CUlaunchAttributeID.CU_LAUNCH_ATTRIBUTE_PROGRAMMATIC_STREAM_SERIALIZATION
        dependent.value.programmaticStreamSerializationAllowed = 1
        clusters.id = d.CUlaunchAttributeID.CU_LAUNCH_ATTRIBUTE_CLUSTER_DIMENSION
        clusters.value.clusterDim.x, clusters.value.clusterDim.y, clusters.value.clusterDim.z = cluster, 1, 1
        self._attributes = [dependent, clusters]
        self._threads = threads
        self.max_clusters = self.max_active_clusters(cluster, threads)
        if self.max_clusters == 0:
            raise BackendUnavailable(
                f"kernel {name!r} needs a cluster of {cluster} blocks of {threads} threads with {shared_bytes} bytes "
                "of shared memory each, and the GPU has no room for one; does MPS or MIG limit this process?"
            )

    def launch_dependent(self, blocks: int, given: Mapping[str, Any]) -> None:
        """Launch on PyTorch's current stream; `given` has each parameter's value by its name."""
        arguments = self._parameters.values(given)
        pointers = (ctypes.c_void_p * len(arguments))(*(ctypes.addressof(value) for value in arguments))
        config = self._config(blocks)
        launched = self._driver.cuLaunchKernelEx(config, self._function, ctypes.addressof(pointers), 0)
        checked("cuLaunchKernelEx", launched)

    def _config(self, blocks: int) -> Any:
        config = self._driver.CUlaunchConfig()
        config.gridDimX, config.gridDimY, config.gridDimZ = blocks, 1, 1
        config.blockDimX, config.blockDimY, config.blockDimZ = self._threads, 1, 1
        config.sharedMemBytes = self._shared
        config.hStream = torch.cuda.current_stream().cuda_stream
        config.attrs, config.numAttrs = self._attributes, len(self._attributes)
        return config


@lru_cache
def multiprocessors(device: torch.device) -> int:
    return torch.cuda.get_device_properties(device).multi_processor_count


def source(*names: str, generated: str, folder: Path | None = None) -> str:
    """A kernel's source: instructions.cu, what is `generated` (instructions, parameters), and those files."""
    here = folder or files("turbopi.kernels.sm90")
    return "\n".join(
        ((here / "instructions.cu").read_text(), generated, *((here / name).read_text() for name in names))
    )


Numbers = Literal["bf16", "e4m3", "s8"]


WHOLE_COLUMNS = (8, 24, *range(16, 257, 16))  # that products of whole numbers may have


def wgmma(
    name: str, columns: int, *, numbers: Numbers = "bf16", from_registers: bool = False, across: bool = False
) -> str:
    """A function `name(float (&sums)[columns / 2], a, u64 b, int keep)`: sums (kept or not) += a @ b, asynchronously.

    Sums of s8 are int. a is 64 rows of 32 bytes, a descriptor or, `from_registers`, four u32; b `columns` rows of as
    much, or `across` 16 rows of so many numbers of 16 bits. Its operands can't be written generically.
    """
    assert columns % 8 == 0 and columns <= 256 and (numbers != "s8" or columns in WHOLE_COLUMNS)
    count = columns // 2
    registers = ", ".join(f"%{i}" for i in range(count))
    whole = numbers == "s8"
    kind = "int" if whole else "float"
    outputs = ", ".join(f'"+{"r" if whole else "f"}"(sums[{i}])' for i in range(count))
    if from_registers:
        parameters = "u32 a0, u32 a1, u32 a2, u32 a3"
        inputs = ", ".join(f'"r"(a{i})' for i in range(4))
        a = "{" + ", ".join(f"%{count + i}" for i in range(4)) + "}"
    else:
        parameters, inputs, a = "u64 a", '"l"(a)', f"%{count}"
    b = count + (4 if from_registers else 1)
    form = f"k{16 if numbers == 'bf16' else 32}.{'s32' if whole else 'f32'}.{numbers}.{numbers}"
    transposed = ("" if from_registers else ", 0") + f", {int(across)}" if numbers == "bf16" else ""
    signs = "" if whole else ", 1, 1"
    return (
        f"__device__ __forceinline__ void {name}({kind} (&sums)[{count}], {parameters}, u64 b, int keep) {{\n"
        f'asm volatile("{{ .reg .pred p; setp.ne.b32 p, %{b + 1}, 0;\\n"\n'
        f'"wgmma.mma_async.sync.aligned.m64n{columns}{form} {{{registers}}}, {a}, %{b},"\n'
        f'" p{signs}{transposed}; }}" : {outputs} : {inputs}, "l"(b), "r"(keep)); }}'
    )


class _TensorMap(ctypes.Structure):
    _fields_ = (("bytes", ctypes.c_char * 128),)


@lru_cache(maxsize=65536)
def tensor_map(
    address: int, sizes: tuple[int, ...], strides: tuple[int, ...], box: tuple[int, ...], fp8: bool = False
) -> _TensorMap:
    """How TMA finds boxes, 128 bytes wide, of a bfloat16 or E4M3 array, with zeros beyond it.

    Sizes and box from the innermost axis on, strides in numbers from the second axis on.
    """
    d = bindings("driver")
    size = 1 if fp8 else 2
    assert box[0] * size == 128, f"a box is 128 bytes wide, not {box[0] * size}"
    types = d.CUtensorMapDataType
    encoded = d.cuTensorMapEncodeTiled(
        types.CU_TENSOR_MAP_DATA_TYPE_UINT8 if fp8 else types.CU_TENSOR_MAP_DATA_TYPE_BFLOAT16,
        len(sizes),
        address,
        [d.cuuint64_t(value) for value in sizes],
        [d.cuuint64_t(value * size) for value in strides],
        [d.cuuint32_t(value) for value in box],
        [d.cuuint32_t(1)] * len(sizes),
        d.CUtensorMapInterleave.CU_TENSOR_MAP_INTERLEAVE_NONE,
        d.CUtensorMapSwizzle.CU_TENSOR_MAP_SWIZZLE_128B,
        d.CUtensorMapL2promotion.CU_TENSOR_MAP_L2_PROMOTION_L2_256B,
        d.CUtensorMapFloatOOBfill.CU_TENSOR_MAP_FLOAT_OOB_FILL_NONE,
    )
    made = checked(f"cuTensorMapEncodeTiled for {sizes} at {address:#x}", encoded)
    result = _TensorMap()
    ctypes.memmove(ctypes.addressof(result), made.getPtr(), 128)
    return result
