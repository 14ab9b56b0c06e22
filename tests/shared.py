"""What the tests of Turbo-Pi and of turbopi-lab share: the golden folder and models built from it, fixtures."""

import atexit
import json
import os
import sys
import tempfile

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch: spinning threads slow a busy machine
os.environ.setdefault("OMP_NUM_THREADS", "1")  # of threads that tests start, too: sums are added in one order

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from distributions import install
from matplotlib.figure import Figure
from PIL import Image

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # read when a kernel's module is imported, by whichever test comes first
    os.environ["TORCHINDUCTOR_COMPILE_THREADS"] = "1"  # no processes that import PyTorch once more, to compile
    torch.set_num_threads(1)  # scripts/test runs two processes on two cores

from turbopi.config import PRESETS, PiKind
from turbopi.models.pi0.reference import FloatPrecision, Pi0Model
from turbopi.verify.golden import Case, GoldenFolder

ROOT = Path(__file__).parents[1]
GOLDEN = ROOT / "tests" / "golden"
LAB = tempfile.TemporaryDirectory()  # turbopi-lab's entry points as this tree has them, whatever is installed
install(Path(LAB.name), (ROOT / "packages/turbopi-lab/pyproject.toml").read_text(encoding="utf-8"))
sys.path.insert(0, LAB.name)
atexit.register(LAB.cleanup)
SIX_LAYERS = PRESETS["pi05_tiny"].planned_model
TWO_LAYERS = PRESETS["pi05_tiny"].with_model(
    vision=replace(SIX_LAYERS.vision, depth=2, image_size=56),  # 16 tokens a camera, of 256
    **{part: replace(getattr(SIX_LAYERS, part), depth=2) for part in ("vlm", "expert")},
)


def on_hopper(test: Callable[..., None]) -> Callable[..., None]:
    """A GPU test of kernels that are written for compute capability 9.0."""
    other = torch.cuda.is_available() and torch.cuda.get_device_capability() != (9, 0)
    return pytest.mark.gpu(pytest.mark.skipif(other, reason="needs compute capability 9.0")(test))


def gpu_or_interpreter() -> list[pytest.MarkDecorator]:
    """Of a file of Triton kernels and their twins: one claim, two ways to check it. Scripts that pick `-m gpu` on a GPU
    find these tests there; the interpreter is NumPy, which warns of infinities and turns arrays of one element into
    numbers.
    """
    if torch.cuda.is_available():
        return [pytest.mark.gpu]
    return [pytest.mark.filterwarnings(f"ignore::{warning}") for warning in ("RuntimeWarning", "DeprecationWarning")]


def packed_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a packed archive by name: one run of bytes, in which equal arrays lie once, and where each is."""
    with np.load(path) as file:
        index, data = json.loads(file["index"].tobytes()), file["data"].tobytes()
    places = ((name, np.dtype(kind), shape, at) for name, (kind, shape, at) in index.items())
    return {name: np.frombuffer(data, kind, int(np.prod(shape)), at).reshape(shape) for name, kind, shape, at in places}


@lru_cache
def golden_folder() -> GoldenFolder:
    return GoldenFolder(GOLDEN)


@lru_cache
def golden_cases() -> dict[str, Case]:
    return {case.name: case for case in golden_folder().cases()}


@lru_cache
def golden_model(kind: PiKind, precision: FloatPrecision = "f32") -> Pi0Model:
    checkpoint = golden_folder().checkpoint(kind)
    return Pi0Model.from_state(checkpoint.config.planned_model, checkpoint.load(torch.device("cpu"), precision).state)


@pytest.fixture
def two_threads() -> Iterator[None]:
    """With one thread PyTorch sums in another order: its bilinear kernel is chosen by their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def _own_fingerprints(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the user's cache remembers of weights stays out of tests."""
    folder = tmp_path_factory.getbasetemp() / "cache"
    monkeypatch.setattr("turbopi.checkpoint.known_hashes.cache_folder", lambda: folder)


@pytest.fixture(scope="session")
def cubins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where CUDA kernels are kept, so that each is compiled once, for all of a run's processes."""
    base = tmp_path_factory.getbasetemp()
    return (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cubins"


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that were saved, in order: what they show can be compared with what they are to show."""
    figures: list[Figure] = []
    save = Figure.savefig

    def keeping(self: Figure, *args: Any, **options: Any) -> None:
        figures.append(self)
        save(self, *args, **options)

    monkeypatch.setattr(Figure, "savefig", keeping)
    return figures


@pytest.fixture(scope="module")
def two_layers() -> Iterator[None]:
    """`pi05_tiny` has two layers of its six, and images of 56 × 56, in this process: a tenth of the work."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setitem(PRESETS, "pi05_tiny", TWO_LAYERS)
        yield


@pytest.fixture(scope="module")
def unseen_plots() -> Iterator[None]:
    """Plots become PNGs of one pixel, where no test looks at them: drawing takes longer than all else of small runs."""
    save = Figure.savefig

    def dot(self: Figure, file: Any, *more: Any, **options: Any) -> None:
        if options.get("format") == "png":
            Image.new("L", (1, 1)).save(file, "png")
        else:
            save(self, file, *more, **options)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Figure, "savefig", dot)
        yield


@pytest.fixture(scope="session")
def golden() -> Path:
    return GOLDEN
