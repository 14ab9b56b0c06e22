"""What compiling at run time needs beside Python packages: a compiler, and for C also Python's own headers."""

import shutil
import sysconfig
from pathlib import Path

PTXAS_VARIABLE, PTXAS_BLACKWELL_VARIABLE = "TRITON_PTXAS_PATH", "TRITON_PTXAS_BLACKWELL_PATH"  # below 10.0, from it on
_INSTALL = "on Debian and Ubuntu: apt-get install g++ python3-dev"


def missing_for_c() -> str | None:
    """Why no C extension can be built, which Triton does for its launcher; None if one can."""
    if shutil.which("gcc") is None and shutil.which("clang") is None:
        return f"no C compiler ({_INSTALL})"
    return _missing_headers()


def missing_for_cpp() -> str | None:
    """Why torch.compile can't build its code for a CPU; None if it can."""
    if shutil.which("g++") is None and shutil.which("clang++") is None:
        return f"no C++ compiler ({_INSTALL})"
    return _missing_headers()


def _missing_headers() -> str | None:
    header = Path(sysconfig.get_paths()["include"]) / "Python.h"
    return None if header.is_file() else f"no {header}, Python's headers ({_INSTALL})"


def cuda_13_ptxas() -> Path:
    """Where the wheel nvidia-cuda-nvcc puts CUDA 13's ptxas, whether it is installed or not."""
    return Path(sysconfig.get_paths()["purelib"]) / "nvidia" / "cu13" / "bin" / "ptxas"
