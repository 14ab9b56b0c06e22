"""Plots of benchmark results, and of which document each was drawn."""

from pathlib import Path

from PIL import Image

from turbopi.bench.document import BenchDocument, read_benchmark
from turbopi.bench.plots import DRAWN_OF, fingerprint, write_plots

PLOTS = ("stages.png", "roofline.png", "steps.png")


def _benchmarks(root: Path) -> list[tuple[Path, BenchDocument]]:
    """Folder and document of every benchmark report."""
    files = sorted((root / "benchmarks" / "results").glob("*/results.json"))
    return [(file.parent, read_benchmark(file)) for file in files]


def draw(root: Path) -> list[Path]:
    """Draw the plots that weren't drawn of their folder's document."""
    stale = {line.split(":", 1)[0] for line in stale_plots(root)}
    written = []
    for folder, document in _benchmarks(root):
        if any((folder / name).relative_to(root).as_posix() in stale for name in PLOTS):
            written += write_plots(document, folder)
    return written


def stale_plots(root: Path) -> list[str]:
    """One line for each plot that is missing, or was drawn of another document than the one beside it."""
    found = []
    for folder, document in _benchmarks(root):
        for name in PLOTS:
            path, place = folder / name, (folder / name).relative_to(root).as_posix()
            if not path.is_file():
                found.append(f"{place}: there is no such plot; run scripts/tables")
                continue
            with Image.open(path) as picture:
                drawn_of = picture.info.get(DRAWN_OF)
            if drawn_of != fingerprint(document):
                found.append(f"{place}: drawn of another results.json than the one beside it; run scripts/tables")
    return found
