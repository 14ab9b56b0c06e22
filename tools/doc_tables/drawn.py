"""Plots of benchmark results, and of which document each was drawn."""

import io
from collections.abc import Iterable
from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo

from turbopi.bench.document import BenchDocument, read_benchmark
from turbopi.bench.plots import DRAWN_OF, fingerprint, write_plots

PLOTS = ("stages.png", "roofline.png", "steps.png")
COLOURS = 128  # of a checked-in plot: a third of the bytes, and the same to the eye


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
    return compacted(written)


def compacted(files: Iterable[Path]) -> list[Path]:
    """Rewrite every PNG of `files` with a palette of its own, with its texts; returns all of them."""
    files = list(files)
    for file in files:
        if file.suffix != ".png":
            continue
        texts, stream = PngInfo(), io.BytesIO()
        with Image.open(file) as image:
            for name, text in image.info.items():
                if isinstance(text, str):
                    texts.add_text(name, text)
            rgba = image.convert("RGBA")
        if rgba.getextrema()[3] == (255, 255):
            plot = rgba.convert("RGB").quantize(COLOURS, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        else:
            plot = rgba.quantize(COLOURS, Image.Quantize.FASTOCTREE)
        plot.save(stream, "png", optimize=True, pnginfo=texts)
        file.write_bytes(stream.getvalue())
    return files


def stale_plots(root: Path) -> list[str]:
    """One line for each plot that is missing, or was drawn of another document than the one beside it."""
    found = []
    for folder, document in _benchmarks(root):
        for name in PLOTS:
            path, place = folder / name, (folder / name).relative_to(root).as_posix()
            if not path.is_file():
                found.append(f"{place}: there is no such plot; run scripts/tables")
                continue
            with Image.open(path) as camera_image:
                drawn_of = camera_image.info.get(DRAWN_OF)
            if drawn_of != fingerprint(document):
                found.append(f"{place}: drawn of another results.json than the one beside it; run scripts/tables")
    return found
