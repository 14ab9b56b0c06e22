"""Result files that are packed: large ones end in .xz, and are read and written as they would be without it."""

import json
import lzma
from pathlib import Path
from typing import TypeVar

from msgspec import Struct

from turbopi.bench.document import BenchDocument, as_benchmark, read_benchmark
from turbopi.support.errors import ConfigError
from turbopi.support.reading import as_document, read_document

T = TypeVar("T", bound=Struct)


def content_of(file: Path) -> bytes:
    packed = file.read_bytes()
    return lzma.decompress(packed) if file.suffix == ".xz" else packed


def write_content(file: Path, content: bytes) -> None:
    file.write_bytes(lzma.compress(content, preset=9 | lzma.PRESET_EXTREME) if file.suffix == ".xz" else content)


def read_packed(file: Path, kind: type[T]) -> T:
    """Raises ConfigError, a ValueError, for a file of another kind."""
    if file.suffix != ".xz":
        return read_document(file, kind, ConfigError)
    return as_document(json.loads(content_of(file)), kind, str(file))


def read_packed_benchmark(file: Path) -> BenchDocument:
    """Raises ConfigError as `read_benchmark`."""
    return as_benchmark(json.loads(content_of(file)), file) if file.suffix == ".xz" else read_benchmark(file)
