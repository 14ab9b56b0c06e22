"""TensorRT, through whichever library is installed: NVIDIA's `tensorrt_rtx` (from PyPI whole) or `tensorrt`.

Both have the same Python interface for what is used here. `library()` is the one place that knows their names.
"""

import importlib
import importlib.util
from dataclasses import dataclass
from functools import cache
from typing import Any

from turbopi.support.errors import BackendUnavailable
from turbopi.support.installation import install_command

NAMES = ("tensorrt_rtx", "tensorrt")  # in order of preference: the first one is what our results were measured with


@dataclass(frozen=True)
class Library:
    """An imported TensorRT."""

    name: str  # "tensorrt_rtx" or "tensorrt"
    version: str
    module: Any

    @property
    def is_rtx(self) -> bool:
        """TensorRT-RTX compiles kernels when an engine is loaded, and builds engines without a GPU."""
        return self.name == "tensorrt_rtx"


def missing() -> str | None:
    """None if one of the libraries is installed, else what to do. Imports nothing."""
    if any(importlib.util.find_spec(name) is not None for name in NAMES):
        return None
    return f"neither {' nor '.join(NAMES)} is installed; {_install()}"


def _install() -> str:
    return (
        f"{install_command('tensorrt')} (TensorRT-RTX for desktop and workstation GPUs), "
        "or on Jetson and data-centre GPUs `pip install tensorrt`"
    )


@cache
def library() -> Library:
    """The TensorRT that is installed, TensorRT-RTX first. Raises BackendUnavailable naming what to install.

    A library that is installed but can't be loaded is an error too: the other one isn't taken in its place.
    """
    reason = missing()
    if reason is not None:
        raise BackendUnavailable(reason)
    name = next(name for name in NAMES if importlib.util.find_spec(name) is not None)
    try:
        module = importlib.import_module(name)
    except (ImportError, OSError) as error:
        raise BackendUnavailable(f"{name} is installed but can't be loaded ({error}); {_install()}") from error
    return Library(name, str(module.__version__), module)
