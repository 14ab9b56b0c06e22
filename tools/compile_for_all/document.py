"""What `python -m compile_for_all --json` writes, and reads again."""

import json
from pathlib import Path

from msgspec import Struct, structs
from packed import read_packed, write_content

from turbopi.support.errors import ConfigError
from turbopi.support.reading import plain_document


class Compiled(Struct, frozen=True):
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
    """versions: of the compilers."""

    date: str
    versions: dict[str, str]
    rows: list[Compiled]


class _Kernel(Struct, frozen=True, omit_defaults=True):
    """found: targets by "registers spilled shared", one twice where the variant's name doesn't tell two apart."""

    kernel: str
    variant: str
    found: dict[str, str]
    problem: dict[str, str] = {}
    refused: dict[str, str] = {}


class _File(Struct, frozen=True):
    """As it lies on the disk: a kernel's and variant's names once, not for each target."""

    date: str
    versions: dict[str, str]
    kernels: list[_Kernel]


def read_compiled(file: Path) -> CompiledForAll:
    """Raises ConfigError, a ValueError, for another file. One that ends in .xz is packed."""
    document = read_packed(file, _File)
    rows = []
    for one in document.kernels:
        for used, targets in one.found.items():
            registers, spilled, shared = map(int, used.split())
            for target in targets.split():
                said = one.problem.get(target), one.refused.get(target)
                rows.append(Compiled(one.kernel, one.variant, target, registers, spilled, shared, *said))
    return CompiledForAll(document.date, document.versions, rows)


def replaced(before: CompiledForAll, now: CompiledForAll, targets: set[str], only: str) -> CompiledForAll:
    """`before` with the rows of `now` in place of its own of these targets and of kernels with `only` in their name.

    For a change of some kernels. Raises ConfigError where compilers have other versions.
    """
    both = before.versions.keys() & now.versions.keys()
    if not any("110" in target for target in targets):
        both -= {"ptxas of 11.0"}
    if other := [name for name in sorted(both) if before.versions[name] != now.versions[name]]:
        reported = ", ".join(f"{name} {before.versions[name]}, here {now.versions[name]}" for name in other)
        raise ConfigError(f"the result is of other compilers: {reported}. Make it anew with --json")
    order = {row.target: place for place, row in enumerate(reversed(before.rows))}
    kept = [row for row in before.rows if row.target not in targets or only not in row.kernel]
    rows = sorted([*kept, *now.rows], key=lambda row: -order.get(row.target, 0))
    return structs.replace(before, date=now.date, rows=rows)


def written(document: CompiledForAll) -> str:
    """JSON with a line for each kernel and variant: there are hundreds."""
    kernels: dict[tuple[str, str], _Kernel] = {}
    for row in document.rows:
        one = kernels.setdefault((row.kernel, row.variant), _Kernel(row.kernel, row.variant, {}, {}, {}))
        used = f"{row.registers} {row.spilled} {row.shared}"
        one.found[used] = f"{one.found.get(used, '')} {row.target}".strip()
        for said, why in ((one.problem, row.problem), (one.refused, row.refused)):
            if why is not None:
                said[row.target] = why
    lines = ",\n".join(f"  {json.dumps(plain_document(one))}" for one in kernels.values())
    empty = json.dumps(plain_document(_File(document.date, document.versions, [])), indent=1)
    return empty.replace('"kernels": []', f'"kernels": [\n{lines}\n ]') + "\n"


def write_compiled(file: Path, result: CompiledForAll) -> None:
    """As `read_compiled` reads it."""
    write_content(file, written(result).encode())
