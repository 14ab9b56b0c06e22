"""What `python -m compile_for_all --json` writes, and reads again."""

import json
from pathlib import Path

from msgspec import Struct

from turbopi.errors import ConfigError
from turbopi.reading import plain_document, read_document


class Compiled(Struct, frozen=True, array_like=True):
    """One kernel for one target. problem: why it isn't fit to run there; refused: why it isn't to run there.

    In the file it is a list of these, as `CompiledForAll.columns` says: there are thousands.
    """

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
    columns: tuple[str, ...] = Compiled.__struct_fields__


def read_compiled(file: Path) -> CompiledForAll:
    """Raises ConfigError for another file."""
    return read_document(file, CompiledForAll, ConfigError)


def written(document: CompiledForAll) -> str:
    """JSON with a line for each row."""
    plain = plain_document(document)
    rows = ",\n".join(f"  {json.dumps(row)}" for row in plain.pop("rows"))
    head = json.dumps(plain, indent=1).removesuffix("\n}")
    return f'{head},\n "rows": [\n{rows}\n ]\n}}\n'
