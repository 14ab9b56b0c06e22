"""Tables that fit the terminal: text wraps, numbers and headings are never cut."""

from collections.abc import Sequence

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

_WIDE = 10_000  # columns, to ask how wide a table would like to be


def fitted(table: Table, console: Console) -> list[Table]:
    """`table` if it fits, else without its edge, else in parts that each repeat the first column."""
    for column in table.columns:
        column.overflow = "fold"  # what has no blank to wrap at goes on in the next line
        column.no_wrap = column.justify == "right"
    if _narrowest(table, console) <= console.width:
        return [table]
    table.show_edge = table.pad_edge = False
    if _narrowest(table, console) <= console.width:
        return [table]
    parts: list[list[int]] = [[0]]
    for index in range(1, len(table.columns)):
        wider = [*parts[-1], index]
        if len(parts[-1]) > 1 and _narrowest(_part(table, wider), console) > console.width:
            parts.append([0, index])
        else:
            parts[-1] = wider
    found = [_part(table, part) for part in parts]
    for part in found[1:]:
        part.title = None
    return found


def _narrowest(table: Table, console: Console) -> int:
    """Columns that the table needs without a number, or a word of a text, being cut."""
    options = console.options.update(max_width=_WIDE, width=_WIDE)
    return Measurement.get(console, options, table).minimum


def _part(table: Table, columns: Sequence[int]) -> Table:
    """Some columns of a table, with all its rows."""
    part = Table(
        title=table.title,
        title_justify=table.title_justify,
        show_header=table.show_header,
        show_edge=table.show_edge,
        pad_edge=table.pad_edge,
    )
    for index in columns:
        column = table.columns[index]
        part.add_column(column.header, justify=column.justify, no_wrap=column.no_wrap, overflow=column.overflow)
    cells = zip(*(table.columns[index].cells for index in columns), strict=True)
    for row, values in zip(table.rows, cells, strict=True):
        part.add_row(*values, style=row.style, end_section=row.end_section)
    return part
