"""The marked places in documents, and what belongs there."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from doc_tables.results import RESULTS, result_files
from doc_tables.tables import TABLES, Table

_BLOCK = re.compile(r"<!-- table: (?P<what>[^\n]*?) -->\n(?P<text>.*?)<!-- end of table -->", re.DOTALL)


class TableError(ValueError):
    """A marked place that names no table or no file."""


def documents(root: Path) -> list[Path]:
    """Every document of the project."""
    return sorted([*root.glob("*.md"), *root.glob("docs/**/*.md"), *root.glob("benchmarks/**/*.md")])


def filled(text: str, root: Path, folder: Path) -> str:
    """A document's text with its tables written anew, each with links to its result files. Raises TableError.

    folder  where the document is: links are relative to it
    """

    def written(found: re.Match[str]) -> str:
        name, *names = found["what"].split()
        files = result_files(root, names)
        if name not in TABLES:
            raise TableError(f"no table is named {name!r}: there are {', '.join(sorted(TABLES))}")
        table = TABLES[name]
        lines = table.lines(*(_load(root / RESULTS / file, table) for file in files))
        links = (f"[{file}]({os.path.relpath(root / RESULTS / file, folder)})" for file in files)
        lines = [*lines, "", f"Raw: {', '.join(links)}"] if files else lines
        return f"<!-- table: {found['what']} -->\n" + "".join(f"{line}\n" for line in lines) + "<!-- end of table -->"

    if text.count("<!-- table:") != len(_BLOCK.findall(text)):
        raise TableError('a line "<!-- table: … -->" has no "<!-- end of table -->" behind it')
    return _BLOCK.sub(written, text)


def _load(file: Path, table: Table) -> Any:
    if not file.is_file():
        raise TableError(f"there is no result file {file.name} in {file.parent}")
    try:
        return table.read(file)
    except ValueError as error:
        raise TableError(str(error)) from error


def _wanted(root: Path) -> Iterator[tuple[Path, str, str]]:
    """(document, its text, what it should be) of every document with tables."""
    for document in documents(root):
        text = document.read_text(encoding="utf-8")
        if "<!-- table:" in text:
            try:
                yield document, text, filled(text, root, document.parent)
            except TableError as error:
                raise TableError(f"{document.relative_to(root)}: {error}") from None


def fill(root: Path) -> list[Path]:
    """Write every table anew; returns the documents that changed."""
    changed = []
    for document, text, wanted in _wanted(root):
        if text != wanted:
            document.write_text(wanted, encoding="utf-8")
            changed.append(document)
    return changed


def differences(root: Path) -> list[str]:
    """One line for each line of a document that isn't what the result files say."""
    found = []
    for document, text, wanted in _wanted(root):
        if text == wanted:
            continue
        pairs = zip(text.splitlines(), wanted.splitlines(), strict=False)
        first = next((pair for pair in pairs if pair[0] != pair[1]), ("(the end)", "(the end)"))
        found.append(f"{document.relative_to(root)}: {first[0]!r} should be {first[1]!r}; run scripts/tables")
    return found
