"""How numbers and names are written for people, in one way everywhere."""

import math
from collections.abc import Iterable, Mapping
from difflib import get_close_matches


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


def counted(number: int, what: str) -> str:
    """A number and what it counts: "1 step", "10 steps"."""
    return f"{number:,} {what}" if number == 1 else f"{number:,} {what}s"


def kind_of(value: object) -> str:
    """The name of a value's type with its article, for sentences: "an int", "a list", "None"."""
    name = type(value).__name__
    return "None" if value is None else f"{'an' if name[0] in 'aeioAEIO' or name == 'ndarray' else 'a'} {name}"


def did_you_mean(typed: str, known: Iterable[str]) -> str:
    """A question with the known names that were probably meant: "did you mean a or b?"; "" if there are none.

    Those that contain what was typed, unless there are more than three; else the one that is spelt most alike.
    """
    names = list(known)
    meant = [name for name in names if typed and typed in name]
    if not 1 <= len(meant) <= 3:
        meant = get_close_matches(typed, names, n=1)
    return f"did you mean {' or '.join(meant)}?" if meant else ""


def names_known(typed: str, reported: str, known: Iterable[str]) -> str:
    """What there is instead of a name that isn't known: "presets are a, b", behind what was probably meant.

    reported  begins it: "presets are"
    """
    names = list(known)
    meant = did_you_mean(typed, names)
    return f"{f'{meant} {reported.capitalize()}' if meant else reported} {', '.join(names)}"


def denoising(about: Mapping[str, object]) -> str:
    """ "10 steps" of a policy's metadata, and its solver and time grid where they aren't openpi's."""
    if "max_decoding_steps" in about:
        return f"at most {about['max_decoding_steps']} tokens"
    said = "1 step" if (steps := about.get("num_denoising_steps")) == 1 else f"{steps} steps"
    solver, grid = about.get("solver", "euler"), about.get("time_grid", "uniform")
    if solver != "euler":
        said += f" of {solver}"
    if isinstance(grid, list | tuple):
        return f"{said}, times {', '.join(f'{t:.3g}' for t in grid)}"
    return said if grid == "uniform" else f"{said}, grid {str(grid).replace('_', ' ')}"
