"""The programs that are timed: where each comes from, how it is installed, in which settings it runs.

A command's words may have {python} (of the program's own environment), {tool} (the Python that runs the tool), {src}
(its sources) and {arch} (the GPU's compute capability, "90").
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

DRIVERS = Path(__file__).parent / "drivers"
TOOLS = DRIVERS.parents[1]
Model = Literal["pi05", "smolvla", "pi0_fast"]
# What cameras send; of models that aren't here what the model reads
IMAGES: Mapping[str, Mapping[str, Any]] = {"smolvla": {"image_width": 640, "image_height": 480}}
_TORCH = "torch==2.11.0"  # ours on a GPU too; an owner's own where it pins one


@dataclass(frozen=True)
class Program:
    """One program. `settings`: of Pi0.5, as docs/performance.md's table knows them (tools/doc_tables/peers.py).

    git      repository and commit that are fetched to {src}
    install  commands, in order, after its environment is made; none: the environment that runs the tool
    tunes    it times candidates while it gets ready, so nothing else may run then
    also     other models that it runs -> what differs there
    """

    name: str
    driver: str  # a file of DRIVERS
    settings: tuple[str, ...]
    git: tuple[str, str] | None = None
    install: tuple[tuple[str, ...], ...] = ()
    python: str | None = None  # that its environment is made with; None: the one that runs the tool
    needs_checkpoint: bool = False
    tunes: bool = False
    start_s: float = 300.0  # to get ready: compiling and capturing are in it
    also: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def script(self) -> Path:
        return DRIVERS / self.driver

    def of(self, model: str) -> "Program | None":
        """The program as it runs that model; None if it doesn't."""
        return self if model == "pi05" else replace(self, **self.also[model]) if model in self.also else None

    def fetching(self, src: Path) -> list[list[str]]:
        """Commands that bring the sources."""
        if self.git is None:
            return []
        repository, commit = self.git
        return [["git", "clone", "--quiet", repository, str(src)], ["git", "-C", str(src), "checkout", "-q", commit]]


def _pip(*words: str) -> tuple[str, ...]:
    """The environments have no pip of their own: not every Python brings one for them."""
    return ("{tool}", "-m", "pip", "--python", "{python}", "install", "--quiet", *words)


_CUTLASS = "--branch=v4.4.2 https://github.com/NVIDIA/cutlass {src}/third_party/cutlass"
# Attention's variants that its wrapper never takes: most of the time that the build takes.
_UNUSED = " ".join(f"-DFLASHATTENTION_DISABLE_{name}" for name in ("DROPOUT", "ALIBI", "SOFTCAP", "LOCAL"))
_CMAKE = (
    "-DGPU_ARCH={arch}",
    "-DFLASHRT_SLIM_BUILD=ON",
    "-DFA2_ARCH_NATIVE_ONLY=ON",
    "-DFA2_HDIMS=96;256",
    "-DFA2_DTYPES=bf16",
    f"-DCMAKE_CUDA_FLAGS={_UNUSED}",
)
_TARGETS = ("flash_rt_kernels", "flash_rt_fa2")  # not its part for JAX
_ALSO_90 = 's/GPU_ARCH STREQUAL "89"/GPU_ARCH STREQUAL "89" OR GPU_ARCH STREQUAL "90"/'
# openpi changes files of transformers, as its README says; none but this environment's own.
_OVER_TRANSFORMERS = (
    "import shutil, sys, transformers; there = transformers.__path__[0]; assert there.startswith(sys.prefix), there; "
    "shutil.copytree(sys.argv[1], there, dirs_exist_ok=True)"
)

OURS = Program(
    "turbopi",
    "run_turbopi.py",
    ("bf16", "fp8"),
    also={"smolvla": {"settings": ("bf16",)}, "pi0_fast": {"settings": ("bf16", "int8-weights")}},
)
PROGRAMS = (
    OURS,
    Program(
        "flashrt",
        "run_flashrt.py",
        ("bf16", "fp8 nt_autotune=force", "fp8 nt_autotune=off"),
        git=("https://github.com/flashrt-project/FlashRT", "e33faa5838f2dceb2cb29d84db36cefb5d4c58ee"),
        install=(
            ("sh", "-c", f"test -d {{src}}/third_party/cutlass || git clone -q --depth=1 {_CUTLASS}"),
            _pip(_TORCH, "pybind11", "numpy", "pyyaml", "ml_dtypes", "safetensors", "cmake>=3.24"),
            # It names no Hopper: attention is built there as for the RTX 4090.
            ("sed", "-i", f"108{_ALSO_90};1130{_ALSO_90}", "{src}/CMakeLists.txt"),
            ("{python}", "-m", "cmake", "-S", "{src}", "-B", "{src}/build", "-DPython3_EXECUTABLE={python}", *_CMAKE),
            ("{python}", "-m", "cmake", "--build", "{src}/build", f"-j{os.cpu_count() or 1}", "--target", *_TARGETS),
        ),
        tunes=True,  # cuBLASLt's algorithms
    ),
    Program(
        "realtime-vla",
        "run_realtime_vla.py",
        ("triton",),
        git=("https://github.com/dexmal/realtime-vla-v2", "a36d02a7b241de1129af2048e749de58f95ead9c"),
        install=(_pip(_TORCH, "numpy", "transformers>=4.53"),),
    ),
    Program(
        "openpi-pytorch",
        "run_openpi.py",
        ("bf16 reduce-overhead", "bf16 eager"),
        git=("https://github.com/Physical-Intelligence/openpi", "15a9616a00943ada6c20a0f158e3adb39df2ccac"),
        install=(
            _pip(_TORCH, "transformers==4.53.2", "numpy"),
            ("{python}", "-c", _OVER_TRANSFORMERS, "{src}/src/openpi/models_pytorch/transformers_replace"),
        ),
        tunes=True,  # Inductor's tiles
    ),
    Program(
        "lerobot",
        "run_lerobot.py",
        ("bf16 eager",),
        install=(_pip("lerobot[pi]==0.6.1"),),
        python="python3.12",
        also={
            "smolvla": {"settings": ("bf16 eager", "bf16 compiled"), "tunes": True, "start_s": 600.0},
            "pi0_fast": {},  # its compile_model leaves decoding with a KV cache as it is
        },
    ),
    Program(
        "sglang",
        "run_served.py",
        ("bf16",),
        install=(_pip("sglang[diffusion]==0.5.23", "msgpack", "websockets"),),
        needs_checkpoint=True,
        start_s=600.0,
    ),
    Program(
        "vllm-omni",
        "run_served.py",
        ("bf16",),
        install=(_pip("vllm==0.30.0", "vllm-omni==0.30.0", "msgpack", "websockets"),),
        needs_checkpoint=True,
        start_s=600.0,
    ),
)
BY_NAME = {program.name: program for program in PROGRAMS}
