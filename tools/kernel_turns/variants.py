"""Variants of the denoising kernel: sources of their own, compile-time constants of their own."""

import importlib.util
import lzma
import shutil
import subprocess
import tempfile
import weakref
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

from kernel_turns.problems import WAYS
from turbopi.kernels.sm90.denoise import kernel as denoise

KERNELS = Path("src/turbopi/kernels/sm90")


class Variant:
    """What `SPEC` says: "here", a folder as kernels/sm90 is, or a patch of this tree (.patch, or .patch.xz); behind
    it +NAME=VALUE for constants, as in "rows.patch+TP_ROUND_FRAGMENTS=4", and @WAY for the form by token on a problem
    of that way (`problems.by_token`), as in "here@held".

    Raises ValueError for a place that doesn't exist, a constant without a whole number, a patch that doesn't fit, a
    way that there isn't.
    """

    def __init__(self, spec: str) -> None:
        self.spec = spec
        kernel, _, way = spec.partition("@")
        if "@" in spec and way not in WAYS:
            raise ValueError(f"@{way}: expected @ and one of {', '.join(WAYS)}")
        self.way = way or None
        place, *constants = kernel.split("+")
        self.constants = dict(_constant(text) for text in constants)
        self.module = _load(self._folder(place))
        self._sizes = self.module.kernel_sizes

    def _folder(self, place: str) -> Path:
        if place == "here":
            return denoise.FOLDER.resolve()
        path = Path(place)
        if path.is_dir() and (path / "denoise/kernel.py").is_file():
            return path
        if path.is_file() and ".patch" in path.suffixes:
            folder = Path(tempfile.mkdtemp())
            weakref.finalize(self, shutil.rmtree, folder)  # it lives as long as the variant
            return _patched(path, folder)
        raise ValueError(f"{place!r}: expected 'here', a folder with denoise/kernel.py, or a .patch or .patch.xz file")

    def sizes(self, *args: Any, trace: int | None = None, **options: Any) -> dict[str, int]:
        """`kernel_sizes` with the variant's constants; `trace`: a warp whose cycles between marks are kept."""
        traced = {} if trace is None else {"TP_TRACED_WARP": trace + 1}
        return {**self._sizes(*args, **options), **self.constants, **traced}

    def kernel(self, *args: Any, trace: int | None = None, **options: Any) -> denoise.DenoiseKernel:
        self.module.kernel_sizes = partial(self.sizes, trace=trace)  # type: ignore[attr-defined]
        kernel: denoise.DenoiseKernel = self.module.DenoiseKernel(*args, **options)
        return kernel


def _constant(text: str) -> tuple[str, int]:
    name, _, value = text.partition("=")
    if not name.isidentifier() or not value.lstrip("-").isdigit():
        raise ValueError(f"+{text}: expected +NAME=VALUE with a whole number, such as +TP_ROUND_FRAGMENTS=4")
    return name, int(value)


def _patched(patch: Path, to: Path) -> Path:
    """A copy of the tree's kernels with a patch that was made in the repository's root."""
    text = lzma.decompress(patch.read_bytes()) if patch.suffix == ".xz" else patch.read_bytes()
    shutil.copytree(denoise.FOLDER, to / KERNELS, ignore=shutil.ignore_patterns("__pycache__"))
    done = subprocess.run(["git", "apply", "-"], cwd=to, input=text, capture_output=True, check=False)
    if done.returncode:
        raise ValueError(f"{patch} doesn't fit these kernels: {done.stderr.decode().strip()}")
    return to / KERNELS


def _load(folder: Path) -> ModuleType:
    """denoise/kernel.py of a folder, beside the tree's own."""
    spec = importlib.util.spec_from_file_location("kernel_turns_denoise", folder.resolve() / "denoise/kernel.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if getattr(module, "FOLDER", None) != folder.resolve():
        raise ValueError(f"{folder}/denoise/kernel.py would read this tree's sources: they must come from its FOLDER")
    return module
