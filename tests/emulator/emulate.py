"""Our kernels' CUDA C++, compiled by g++ for machine.h's cluster and launched in the GPU's place.

Only what the sources of gemm and attention and the denoising kernel's products need is there: an instruction that
machine.h doesn't know is an error when it is translated, or where only a part of a source is to run, when it does.
Slow (a product of 64 x 16 x 64 takes milliseconds) and not exact to the tensor cores' order of summation.
"""

import atexit
import ctypes
import hashlib
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
import torch

from turbopi.kernels.arguments import TENSOR_MAP, Parameters
from turbopi.kernels.sm90 import instructions

COMPILER = shutil.which("g++")
MACHINE = Path(__file__).with_name("machine.h")
OPTIONS = ("-O1", "-std=c++17", "-w", "-fPIC")

# What is in an asm statement's text -> the function of machine.h that does it; the first that fits.
INSTRUCTIONS = (
    *(("mbarrier.init", "mbarrier_init"), ("mbarrier.arrive.expect_tx", "mbarrier_expect")),
    *(("mbarrier.arrive.shared::cluster", "mbarrier_arrive_remote"), ("mbarrier.arrive", "mbarrier_arrive")),
    *(("mbarrier.try_wait.parity", "mbarrier_wait"), ("mbarrier.test_wait.parity", "mbarrier_test")),
    *(("mapa.", "mapa"), ("bar.sync", "bar_sync")),
    *(("cluster.arrive.relaxed;\\nbarrier.cluster.wait", "cluster_sync"), ("cluster.arrive.relaxed", "cluster_arrive")),
    *(("cluster.arrive", "cluster_exchange"), ("cluster.wait", "cluster_wait")),
    *(("st.async", "st_async"), ("rcp.approx", "rcp"), ("tanh.approx", "tanh")),
    *(("wgmma.commit_group", "wgmma_commit"), ("wgmma.wait_group", "wgmma_wait")),
    ("lop3.b32 %0, %1, %2, %3, 0xEA", "and_or"),
    *(("fma.rn.bf16x2", "fma_bf16x2"), ("cvt.rn.f16x2.e4m3x2", "cvt_e4m3_halves"), ("cvt.rn.bf16x2", "cvt_bf16x2")),
    *(("cvt.rni.sat.s8", "cvt_s8"), ("cvt.rn.f32.s32", "cvt_float")),
    *(("cvt.rn.satfinite.e4m3x2", "cvt_e4m3x2"), ("m8n8.x4.shared.b16", "ldmatrix")),
    *(("m16n8k16.row.col.f32.bf16", "mma_bf16"), ("m16n8k16.row.col.f32.f16", "mma_half")),
    *(("m16n8k32.row.col.f32.e4m3", "mma_e4m3"), ("red.release.gpu.global.add.u32", "add_released")),
    *(("ld.acquire.gpu.global.u32", "load_acquired"), ("ld.global.nc.L1::no_allocate", "load_once")),
    *(("st.relaxed.gpu.global.u32", "put"), ("cp.async.cg.shared.global", "copy_16")),
    ("m8n8.x4.trans.shared.b16", "ldmatrix_transposed"),
    *(("cp.async.bulk.tensor.2d", "copy_2d"), ("complete_tx::bytes.L2::cache_hint", "copy_bytes")),
    *(("cp.async.bulk.tensor.3d", "copy_3d"), ("ex2.approx", "ex2"), ("st.shared.v4.u32", "store_four")),
    ("st.shared.u32", "store_one"),
    *(("red.global.add.noftz.v4.bf16x2", "add_bf16"), ("red.global.add.noftz.v2.bf16x2", "add_bf16")),
    ("red.global.add.noftz.bf16x2", "add_bf16"),
)
# No effect on what is computed here: kernels run one by one, registers are plenty, and copies are seen at once.
IGNORED = ("griddepcontrol", "setmaxnreg", "prefetch", "createpolicy", "fence")


def translated(source: str, in_part: bool = False) -> str:
    """The source with each asm statement as a call, and shared memory that the machine has.

    in_part: only some of the source is to run, so an instruction that machine.h doesn't know is an error when it does.
    """
    parts, end = [], 0
    for start, statement, stop in _statements(source):
        parts += [source[end:start], _call(statement, in_part)]
        end = stop
    text = "".join((*parts, source[end:]))
    shared = r"extern __shared__ (?:__align__\(\d+\) )?(\w+) (\w+)\[\];"
    return re.sub(shared, r"\1* const \2 = (\1*)machine::shared();", text)


def _statements(source: str) -> Iterator[tuple[int, str, int]]:
    """(begin, what is in the parentheses, end) of each asm statement."""
    for found in re.finditer(r"\basm\b(?: volatile)?\s*\(", source):
        depth, at, quoted = 1, found.end(), False
        while depth:
            if source[at] == '"' and source[at - 1] != "\\":
                quoted = not quoted
            elif not quoted:
                depth += {"(": 1, ")": -1}.get(source[at], 0)
            at += 1
        yield found.start(), source[found.end() : at - 1], at


def _call(statement: str, in_part: bool) -> str:
    strings = re.match(r'(?:\s*"(?:[^"\\]|\\.)*")*', statement)
    assert strings is not None
    text = "".join(re.findall(r'"((?:[^"\\]|\\.)*)"', strings[0]))
    operands = _operands(statement[strings.end() :])
    if not text or any(word in text for word in IGNORED):
        return "ptx_nothing()"
    name = next((name for word, name in INSTRUCTIONS if word in text), None)
    if name is None and in_part:
        return f'ptx_unknown("{text}")'
    if name is None:
        raise NotImplementedError(f"machine.h has no instruction for: {text}")
    if name == "bar_sync" and len(operands) == 1:
        operands.append(text.split(",")[1].strip(" ;"))
    return f"ptx_{name}({', '.join(operands)})"


def _operands(text: str) -> list[str]:
    """The expressions behind constraints, in order: "=r"(over) : "r"(bar) -> over, bar"""
    found, at = [], 0
    while (begin := re.compile(r'"[^"]*"\s*\(').search(text, at)) is not None:
        depth, at = 1, begin.end()
        while depth:
            depth += {"(": 1, ")": -1}.get(text[at], 0)
            at += 1
        found.append(text[begin.end() : at - 1])
    return found


def wgmma(name: str, columns: int, *, numbers: str = "bf16", from_registers: bool = False, across: bool = False) -> str:
    """In place of `instructions.wgmma`."""
    forms = ", ".join(str(form).lower() for form in (numbers == "e4m3", across))
    takes, a = ("u32 a0, u32 a1, u32 a2, u32 a3", "{a0, a1, a2, a3}") if from_registers else ("u64 a", "a")
    return (
        f"inline void {name}(float (&sums)[{columns // 2}], {takes}, u64 b, int keep) "
        f"{{ machine::product<{columns}, {forms}>(sums, {a}, b, keep); }}"
    )


class Map(ctypes.Structure):
    """machine.h's `Map`, in the 128 bytes of a tensor map."""

    _fields_ = (
        *(("address", ctypes.c_uint64), ("axes", ctypes.c_uint32), ("number_bytes", ctypes.c_uint32)),
        *(("sizes", ctypes.c_uint64 * 3), ("strides", ctypes.c_uint64 * 2), ("box", ctypes.c_uint32 * 3)),
        ("rest", ctypes.c_char * 60),
    )


def tensor_map(
    address: int, sizes: tuple[int, ...], strides: tuple[int, ...], box: tuple[int, ...], fp8: bool = False
) -> Map:
    """In place of `instructions.tensor_map`."""
    made = Map(address=address, axes=len(sizes), number_bytes=1 if fp8 else 2)
    for values, given in ((made.sizes, sizes), (made.strides, (one * made.number_bytes for one in strides))):
        for i, value in enumerate(given):
            values[i] = value
    for i, value in enumerate(box):
        made.box[i] = value
    return made


@lru_cache
def _header() -> Path:
    """machine.h beside its precompiled form, made once a process: to parse it takes longer than most kernels."""
    folder = Path(tempfile.mkdtemp(prefix="machine-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    header = Path(shutil.copy(MACHINE, folder))
    command = [COMPILER or "g++", *OPTIONS, "-x", "c++-header", str(header), "-o", f"{header}.gch"]
    subprocess.run(command, capture_output=True)  # where it can't be made the header is parsed again
    return header


def compiled(
    source: str, name: str, takes: Parameters, defines: dict[str, int], folder: Path, in_part: bool = False
) -> Path:
    """A library with the kernel. in_part: see `translated`. Raises RuntimeError with the compiler's words."""
    kinds = ["TensorMap" if one.type == TENSOR_MAP else one.type for one in takes.all]
    call = ", ".join(f"machine::given<{kind}>(values[{i}])" for i, kind in enumerate(kinds))
    text = f"""#include "{MACHINE.name}"
{translated(source, in_part)}
extern "C" const char* run(int blocks, int threads, int cluster, int shared, int seed, void** values) {{
    static std::string why;
    try {{
        machine::grid.x = blocks, machine::cta_threads = threads, machine::ranks = cluster;
        machine::shared_bytes = shared;
        machine::random.seed(seed), machine::eager = seed % 2, machine::uneven = seed >= 4;
        machine::moved = 0;
        machine::kernel = [&] {{ {name}({call}); }};
        for (int first = 0; first < blocks; first += cluster) machine::run_cluster(first);
        return nullptr;
    }} catch (const std::exception& error) {{
        why = error.what();
        return why.c_str();
    }}
}}
"""
    options = [f"-D{key}={value}" for key, value in sorted(defines.items())]
    key = hashlib.sha256("\0".join((text, MACHINE.read_text(), *options)).encode()).hexdigest()[:16]
    file, library = folder / f"{key}.cpp", folder / f"{key}.so"
    if not library.exists():
        file.write_text(text)
        command = [COMPILER or "g++", *OPTIONS, "-shared", f"-I{_header().parent}", *options]
        done = subprocess.run([*command, "-o", library, file], capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"g++ doesn't compile {name}:\n{done.stderr[:4000]}")
    return library


@dataclass
class EmulatedKernel:
    """In place of `DependentKernel`."""

    library: Path
    takes: Parameters
    threads: int
    cluster: int
    max_clusters: int
    seed: int
    shared_bytes: int = instructions.SHARED_BYTES

    def launch_dependent(self, blocks: int, given: dict[str, Any]) -> None:
        """Raises RuntimeError where the kernel would hang."""
        values = self.takes.values(given)
        pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
        run = ctypes.CDLL(str(self.library)).run
        run.restype = ctypes.c_char_p
        if (why := run(blocks, self.threads, self.cluster, self.shared_bytes, self.seed, pointers)) is not None:
            raise RuntimeError(why.decode())


class Machine:
    """Launches of modules that make kernels, or keep them in a cache `_kernel`, go to machine.h."""

    def __init__(
        self,
        modules: Sequence[Any],
        folder: Path,
        patch: pytest.MonkeyPatch,
        at_once: Callable[[dict[str, int]], int] = lambda defines: 2,
    ) -> None:
        """folder: for compiled kernels. at_once: how many clusters there is room for, by a kernel's constants."""
        self._modules, self._seed = modules, 0
        defined: dict[str, dict[str, int]] = {}

        def compile_cubin(source: str, arch: str, defines: dict[str, int]) -> bytes:
            defined[source] = defines
            return source.encode()

        def kernel(cubin: bytes, name: str, takes: Parameters, *, shared_bytes: int, threads: int, cluster: int) -> Any:
            defines = defined[cubin.decode()]
            library = compiled(cubin.decode(), name, takes, defines, folder)
            return EmulatedKernel(library, takes, threads, cluster, at_once(defines), self._seed, shared_bytes)

        for module in (one for one in modules if hasattr(one, "compile_cubin")):
            patch.setattr(module, "compile_cubin", compile_cubin)
            patch.setattr(module, "DependentKernel", kernel)
        patch.setattr(instructions, "wgmma", wgmma)
        patch.setattr(instructions, "tensor_map", tensor_map)
        patch.setattr(instructions, "multiprocessors", lambda device: 2)
        patch.setattr(torch.cuda, "device", lambda device: nullcontext())

    def __call__(self, seed: int) -> None:
        """From now on it takes turns in the order of that seed."""
        self._seed = seed
        for cached in (one for module in self._modules for one in vars(module).values() if hasattr(one, "cache_clear")):
            cached.cache_clear()
