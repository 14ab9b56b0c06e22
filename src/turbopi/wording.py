"""How numbers are written for people, in one way everywhere."""

import math
from collections.abc import Mapping


def significant(value: float | None) -> str:
    """An error with three significant digits: 0.0425, 4.61e-05. None, NaN and infinity are "not finite".

    A fixed number of decimals would show a small error as 0.0000.
    """
    if value is None or not math.isfinite(value):
        return "not finite"
    return "0" if value == 0 else f"{value:#.3g}".removesuffix(".")


def cosine(value: float | None) -> str:
    """With six decimals, as those near 1 are of interest. None is "not finite"."""
    return "not finite" if value is None else f"{value:.6f}"


def data_size(count: float) -> str:
    """Bytes in the unit that fits, of 1000 each: "7.233 GB", "11.35 MB", "91.4 kB", "850 bytes"."""
    for unit, size, digits in (("GB", 1e9, 3), ("MB", 1e6, 2), ("kB", 1e3, 1)):
        if count >= 1000 and round(count / size, digits) >= 1:
            return f"{count / size:.{digits}f} {unit}"
    return f"{count:.0f} bytes"


def denoising(about: Mapping[str, object]) -> str:
    """ "10 steps" of a policy's metadata, and its solver and time grid where they aren't openpi's."""
    said = f"{about.get('num_denoising_steps')} steps"
    solver, grid = about.get("solver", "euler"), about.get("time_grid", "uniform")
    if solver != "euler":
        said += f" of {solver}"
    if isinstance(grid, list | tuple):
        return f"{said}, times {', '.join(f'{t:.3g}' for t in grid)}"
    return said if grid == "uniform" else f"{said}, grid {str(grid).replace('_', ' ')}"
