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


def written(document: CompiledForAll) -> str:
    """JSON with a line for each row: there are thousands."""
    rows = ",\n".join(f"  {json.dumps(plain_document(row))}" for row in document.rows)
    empty = json.dumps(plain_document(structs.replace(document, rows=[])), indent=1)
    return empty.replace('"rows": []', f'"rows": [\n{rows}\n ]') + "\n"
