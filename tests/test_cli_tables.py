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
from rich.markup import escape
from rich.table import Table

from turbopi.cli.framework import Output, new_console
from turbopi.cli.tables import fitted, tell_apart
from turbopi.robots import create_robot

pytestmark = pytest.mark.usefixtures("two_layers", "unseen_plots")

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
    headings=st.lists(st.lists(WORDS, min_size=1, max_size=4), min_size=1, max_size=14),
    rows=st.lists(st.tuples(st.lists(WORDS, min_size=1, max_size=9), st.lists(NUMBERS, min_size=14, max_size=14))),
    interval=st.booleans(),
)
def test_every_number_and_heading_is_shown_whole(
    headings: list[list[str]], rows: list[tuple[list[str], list[str]]], interval: bool
) -> None:
    table = Table(title="a title", title_justify="left")
    table.add_column("what")
    for heading in headings:
        table.add_column(" ".join(heading), justify="right")
    rows = [(words, [f"{one} [{one}, 0]" if interval else one for one in numbers]) for words, numbers in rows]
    for words, numbers in rows:
        cells = [f"[green]{escape(number)}[/]" for number in numbers[: len(headings)]]
        table.add_row(" ".join(words), *cells)
    text = shown(table)
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text
    pieces = text.replace("│", " ").replace("┃", " ").split()
    for heading in headings:
        assert set(heading) <= set(pieces)
    for words, numbers in rows:
        assert set(words) <= set(pieces)
        assert all(number in text for number in numbers[: len(headings)])  # in one line, blanks and all


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


def test_rows_are_named_by_what_tells_them_apart() -> None:
    rows = [["a bf16", "2 cam", "", "H=10"], ["a f32", "2 cam", "B=2", "H=10"]]
    assert tell_apart(rows) == (["a bf16", "a f32, B=2"], "2 cam, H=10")
    assert tell_apart(rows[:1]) == (["a bf16"], "2 cam, H=10")
    assert tell_apart([["a", "x"], ["a", "x"]]) == (["a", "a"], "x") and tell_apart([]) == ([], "")


@pytest.mark.parametrize(("columns", "width"), [(None, 80), ("150", 150)])
def test_a_pipe_is_eighty_columns_wide_unless_told_otherwise(
    columns: str | None, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    if columns is not None:
        monkeypatch.setenv("COLUMNS", columns)
    assert new_console(stderr=False).width == width


TINY = ("--random-weights", "pi05_tiny")


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("infer", *TINY, "OBSERVATION", "--steps", "1"),
        ("inspect", "--random-weights", "pi05_libero"),
        ("verify", *TINY, "--backend", "pytorch", "--precision", "bf16", "--count", "1", "--noises", "1"),
        ("demo", "--episodes", "0", "--frames", "2", "--steps", "1"),
        ("bench", *TINY, "--calls", "1", "--no-error", "--steps", "1", "--device", "cpu"),
        ("calibrate", *TINY, "--out", "fp8.json", "--count", "2", "--steps", "1", "--device", "cpu"),
        ("study", "mask", "--small", *TINY, "--device", "cpu"),
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
    words = tuple("OBSERVATION.npz" if word == "OBSERVATION" else word for word in words)
    nothing_is_cut(*with_tables(monkeypatch, *words))


@pytest.mark.slow
def test_the_tables_of_eval_and_compare_are_whole_at_eighty_columns(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    small = ("--camera-px", 64, "--image-px", 64, "--max-steps", 3, "--steps", 1, "--videos", "none", "--device", "cpu")
    folders = (tmp_path / "one", tmp_path / "a-second-and-longer-name")
    for folder in folders:
        command = ("eval", "reacher", *TINY, *small, "--tasks", 0, "--trials", 2, "--out", folder)
        nothing_is_cut(*with_tables(monkeypatch, *command))
    nothing_is_cut(*with_tables(monkeypatch, "compare", *folders))


def with_tables(monkeypatch: pytest.MonkeyPatch, *words: object) -> tuple[str, list[Table]]:
    """A command's output, and the tables that it printed, as they were before they were fitted."""
    tables: list[Table] = []

    def kept(self: Output, table: Table) -> None:
        tables.append(table)
        whole(self, table)

    whole = Output.table
    with monkeypatch.context() as patched:
        patched.setattr(Output, "table", kept)
        result = turbopi(*words)
    assert result.exit_code == 0, result.output
    assert tables, result.output
    return result.stdout, tables


def nothing_is_cut(text: str, tables: list[Table]) -> None:
    """Every number stands in one line, and every word of a heading; no table is wider than 80 columns."""
    lines = [line for line in text.splitlines() if any(edge in line for edge in "│┃─━")]
    assert max(map(len, lines)) <= 80
    assert "…" not in "".join(lines)
    words = "\n".join(lines).replace("│", " ").replace("┃", " ").split()
    for column in (column for table in tables for column in table.columns):
        assert set(str(column.header).split()) <= set(words)
        if column.justify == "right":
            for cell in map(str, column.cells):
                assert any(cell in line for line in lines), cell
