"""Result files by the names that documents give them."""

from collections.abc import Sequence
from pathlib import Path

RESULTS = Path("benchmarks") / "results"


def result_files(root: Path, names: Sequence[str]) -> list[str]:
    """Names below RESULTS. One with a * stands for every file that it matches, by name: none, one or more."""
    found = []
    for name in names:
        matching = sorted((root / RESULTS).glob(name)) if "*" in name else [root / RESULTS / name]
        found += [file.relative_to(root / RESULTS).as_posix() for file in matching]
    return found
