"""Tables fit the terminal: at 80 columns nothing is cut."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_helpers import turbopi
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from rich.table import Table

from turbopi.cli.tables import fitted
from turbopi.robots import create_robot

WORDS = st.text("abcdefghij", min_size=1, max_size=12)
NUMBERS = st.floats(-1e5, 1e5).map(lambda number: f"{number:+.4f}")


def shown(table: Table, width: int = 80) -> str:
    console = Console(file=io.StringIO(), width=width)
    for part in fitted(table, console):
        console.print(part)
    file = console.file
    assert isinstance(file, io.StringIO)
    return file.getvalue()


@settings(max_examples=60, deadline=None)
@given(
    headings=st.lists(WORDS, min_size=1, max_size=14),
    rows=st.lists(st.tuples(st.lists(WORDS, min_size=1, max_size=9), st.lists(NUMBERS, min_size=14, max_size=14))),
)
def test_every_number_and_heading_is_shown_whole(headings: list[str], rows: list[tuple[list[str], list[str]]]) -> None:
    table = Table(title="a title", title_justify="left")
    table.add_column("what")
    for heading in headings:
        table.add_column(heading, justify="right")
    for words, numbers in rows:
        table.add_row(" ".join(words), *numbers[: len(headings)])
    text = shown(table)
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text
    pieces = text.replace("│", " ").replace("┃", " ").split()
    for heading in headings:
        assert heading in pieces
    for words, numbers in rows:
        assert set(numbers[: len(headings)]) | set(words) <= set(pieces)


def test_a_table_that_fits_stays_as_it_is() -> None:
    table = Table("a", "b", title="t")
    table.add_row("1", "2")
    assert shown(table) == shown(table, 200)
    assert shown(table).count("a") == 1


def test_a_wide_table_comes_in_parts_with_its_sections_and_styles() -> None:
    table = Table(title="t", title_justify="left")
    table.add_column("row")
    for index in range(12):
        table.add_column(f"column{index}", justify="right")
    table.add_row("first", *(f"{index}.25" for index in range(12)), style="bold")
    table.add_section()
    table.add_row("second", *(f"{index}.75" for index in range(12)))
    console = Console(file=io.StringIO(), width=60)
    parts = fitted(table, console)
    assert len(parts) > 1
    assert [part.title for part in parts] == ["t"] + [None] * (len(parts) - 1)
    assert all(part.columns[0].header == "row" for part in parts)
    assert all(part.rows[0].style == "bold" and part.rows[0].end_section for part in parts)
    assert sum(len(part.columns) - 1 for part in parts) == 12


@pytest.mark.parametrize(
    "words",
    [
        ("infer", "--random-weights", "pi05_tiny", "OBSERVATION", "--steps", "1"),
        ("inspect", "--random-weights", "pi05_libero"),
        ("backends", "--device", "cpu"),
        ("verify", "--random-weights", "pi05_tiny", "--backend", "pytorch", "--precision", "bf16", "--count", "1"),
    ],
    ids=lambda words: words[0],
)
def test_commands_cut_nothing_at_eighty_columns(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)
    example = create_robot("libero").example(np.random.default_rng(0))
    arrays: dict[str, Any] = {key: np.asarray(value) for key, value in example.items()}
    np.savez(tmp_path / "OBSERVATION.npz", **arrays)
    result = turbopi(*("OBSERVATION.npz" if word == "OBSERVATION" else word for word in words))
    tables = [line for line in result.stdout.splitlines() if any(edge in line for edge in "│┃─━")]
    assert tables, result.output
    assert max(map(len, tables)) <= 80
    assert not any("…" in line for line in tables)
