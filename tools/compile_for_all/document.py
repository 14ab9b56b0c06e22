"""What `python -m compile_for_all --json` writes, and reads again."""

import json
from pathlib import Path

from msgspec import Struct, structs

from turbopi.errors import ConfigError
from turbopi.reading import plain_document, read_document


class Compiled(Struct, frozen=True, omit_defaults=True):
    """One kernel for one target. problem: why it isn't fit to run there; refused: why it isn't to run there."""

    kernel: str
    variant: str
    target: str
    registers: int = 0  # a thread
    spilled: int = 0  # bytes of a thread's stack
    shared: int = 0  # bytes a block
    problem: str | None = None
    refused: str | None = None


class CompiledForAll(Struct, frozen=True):
    """versions: of the compilers. rows: each kernel, variant and target once."""

    date: str
    versions: dict[str, str]
    rows: list[Compiled]


def read_compiled(file: Path) -> CompiledForAll:
    """Raises ConfigError for another file."""
    return read_document(file, CompiledForAll, ConfigError)


def replaced(before: CompiledForAll, now: CompiledForAll, targets: set[str], only: str) -> CompiledForAll:
    """`before` with the rows of `now` in place of its own of these targets and of kernels with `only` in their name.

    For a change of some kernels. Raises ConfigError where compilers have other versions.
    """
    both = before.versions.keys() & now.versions.keys()
    if not any("110" in target for target in targets):
        both -= {"ptxas of 11.0"}
    if other := [name for name in sorted(both) if before.versions[name] != now.versions[name]]:
        told = ", ".join(f"{name} {before.versions[name]}, here {now.versions[name]}" for name in other)
        raise ConfigError(f"the result is of other compilers: {told}. Make it anew with --json")
    order = {row.target: place for place, row in enumerate(reversed(before.rows))}
    kept = [row for row in before.rows if row.target not in targets or only not in row.kernel]
    rows = sorted([*kept, *now.rows], key=lambda row: -order.get(row.target, 0))
    return structs.replace(before, date=now.date, rows=rows)


def written(document: CompiledForAll) -> str:
    """JSON with a line for each row: there are thousands."""
    rows = ",\n".join(f"  {json.dumps(plain_document(row))}" for row in document.rows)
    empty = json.dumps(plain_document(structs.replace(document, rows=[])), indent=1)
    return empty.replace('"rows": []', f'"rows": [\n{rows}\n ]') + "\n"
