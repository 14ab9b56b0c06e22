"""What compiling at run time needs beside Python packages: a compiler, for C also Python's own headers, and a folder
that can be written.
"""

import atexit
import logging
import os
import shutil
import sysconfig
import tempfile
from pathlib import Path

PTXAS_VARIABLE, PTXAS_BLACKWELL_VARIABLE = "TRITON_PTXAS_PATH", "TRITON_PTXAS_BLACKWELL_PATH"  # below 10.0, from it on
TRITON_CACHE_VARIABLE, INDUCTOR_CACHE_VARIABLE = "TRITON_CACHE_DIR", "TORCHINDUCTOR_CACHE_DIR"
_INSTALL = "on Debian and Ubuntu: apt-get install g++ python3-dev"


logger = logging.getLogger(__name__)


def make_caches_writable() -> None:
    """Where Triton or Inductor couldn't write its cache, which would fail, a temporary folder takes its place, with a
    line of the log. Before the first kernel is compiled.
    """
    home = os.environ.get("TRITON_HOME") or os.path.expanduser("~")
    usual = {TRITON_CACHE_VARIABLE: os.path.join(home, ".triton", "cache"), INDUCTOR_CACHE_VARIABLE: None}
    for variable, default in usual.items():
        folder = os.environ.get(variable) or default
        if folder is None or _writable(Path(folder).absolute()):  # Inductor's own is a temporary one
            continue
        other = tempfile.mkdtemp(prefix="turbopi-")
        atexit.register(shutil.rmtree, other, ignore_errors=True)
        os.environ[variable] = other
        logger.warning(
            "%s can't be written, so kernels are compiled again at each start; %s names another folder",
            folder,
            variable,
        )


def _writable(folder: Path) -> bool:
    """Whether it can be written, or made."""
    while not os.path.lexists(folder) and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)


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
