"""Which OpenGL MuJoCo draws with: EGL on a GPU, OSMesa in software. Chosen once, and said."""

import ctypes.util
import os
import sys
from collections.abc import Mapping
from pathlib import Path

from turbopi.sim.base import SimulatorUnavailable

INSTALL_OSMESA = "apt-get install -y libosmesa6"
_RENDERERS = {"egl": "EGL", "osmesa": "OSMesa"}  # MUJOCO_GL -> its library
_GPU_DEVICES = ("/dev/nvidia0", "/dev/dri/renderD128")


def choose_renderer(environ: Mapping[str, str] = os.environ) -> str:
    """MUJOCO_GL's value if it is set, else egl beside a GPU and osmesa without, if their libraries are there.

    Raises SimulatorUnavailable with the install command if none is.
    """
    requested = environ.get("MUJOCO_GL", "").lower().strip()
    if requested:
        if requested not in _RENDERERS:
            raise SimulatorUnavailable(f"MUJOCO_GL is {requested!r}; LIBERO is drawn off screen with egl or osmesa")
        if not _has_library(requested):
            raise SimulatorUnavailable(
                f"MUJOCO_GL={requested}, but lib{_RENDERERS[requested]} isn't installed; on Debian or Ubuntu: "
                f"{_install(requested)}"
            )
        return requested
    if sys.platform != "linux":
        raise SimulatorUnavailable(
            f"LIBERO's images are drawn on Linux only, with EGL or OSMesa; this is {sys.platform}"
        )
    preferred = ("egl", "osmesa") if any(Path(device).exists() for device in _GPU_DEVICES) else ("osmesa", "egl")
    for name in preferred:
        if _has_library(name):
            return name
    raise SimulatorUnavailable(
        f"no OpenGL library to draw with: neither libEGL nor libOSMesa is installed. "
        f"On Debian and Ubuntu: {INSTALL_OSMESA} (software), or a GPU's driver with EGL"
    )


def _has_library(renderer: str) -> bool:
    return ctypes.util.find_library(_RENDERERS[renderer]) is not None


def _install(renderer: str) -> str:
    return INSTALL_OSMESA if renderer == "osmesa" else "apt-get install -y libegl1"
