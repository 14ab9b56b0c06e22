"""Tables that fit the terminal: text wraps at blanks, numbers and the words of headings are never cut.

Rich cuts a column that may not wrap, and wraps numbers such as "92.0 % [87.4, 95.0]" in one that may. So the widths are
settled here.
"""

from collections.abc import Sequence

from rich.cells import cell_len
from rich.console import Console
from rich.table import Column, Table

COMFORTABLE = 24  # columns that a text gets, if it needs them, before a table is cut into parts
_LONGEST_WORD = 40  # characters; what is longer, such as a path, goes on in the next line


def tell_apart(rows: Sequence[Sequence[str]]) -> tuple[list[str], str]:
    """(a name for each row, what all have in common), of rows' parts: as many for each, "" for what one hasn't.

    The first part is always in the name.
    """
    differ = [number == 0 or len(set(parts)) > 1 for number, parts in enumerate(zip(*rows, strict=True))]
    names = [", ".join(part for part, own in zip(row, differ, strict=True) if own and part) for row in rows]
    shared = [part for part, own in zip(rows[0], differ, strict=True) if not own and part] if rows else []
    return names, ", ".join(shared)


def fitted(table: Table, console: Console) -> list[Table]:
    """`table` if it fits, else without its edge, else in parts that each repeat the first column."""
    for column in table.columns:
        column.overflow = "fold"
    if _settled(table, console):
        return [table]
    table.show_edge = table.pad_edge = False
    if _settled(table, console):
        return [table]
    found = [_part(table, indices) for indices in _parts(table, console)]
    for part in found:
        _settled(part, console)
    for part in found[1:]:
        part.title = None
    for part in found[:-1]:
        part.caption = None
    return found


def _parts(table: Table, console: Console) -> list[list[int]]:
    """Which columns go together: as many as fit with texts in comfort, the first one in each."""
    parts: list[list[int]] = [[0]]
    for index in range(1, len(table.columns)):
        wider = [*parts[-1], index]
        part = _part(table, wider)
        fits = sum(_comfortable(column, console) for column in part.columns) <= _room(part, console)
        if len(parts[-1]) > 1 and not fits:
            parts.append([0, index])
        else:
            parts[-1] = wider
    return parts


def _settled(table: Table, console: Console) -> bool:
    """Give every column its width, if the least ones fit: what is left goes to texts, then to headings of numbers."""
    room = _room(table, console)
    widths = [_least(column, console) for column in table.columns]
    wanted = [max(least, _widest(column, console)) for least, column in zip(widths, table.columns, strict=True)]
    if sum(widths) > room:
        return False
    while sum(widths) < room and widths != wanted:
        wanting = [i for i in range(len(widths)) if widths[i] < wanted[i]]
        narrow = min(wanting, key=lambda i: (table.columns[i].justify == "right", widths[i]))
        widths[narrow] += 1
    for column, width in zip(table.columns, widths, strict=True):
        column.width = width
    return True


def _room(table: Table, console: Console) -> int:
    """Columns of the terminal that the table's contents may take, beside its lines and blanks."""
    count = len(table.columns)
    return console.width - (3 * count + 1 if table.show_edge else 3 * (count - 1))


def _least(column: Column, console: Console) -> int:
    """The width under which a number, or a word that isn't very long, would be cut."""
    words = _lines(column, console, words=True)
    least = max([0, *(min(width, _LONGEST_WORD) for width in words)])
    return max(least, _widest(column, console, heading=False)) if column.justify == "right" else least


def _comfortable(column: Column, console: Console) -> int:
    return max(_least(column, console), min(_widest(column, console), COMFORTABLE))


def _widest(column: Column, console: Console, *, heading: bool = True) -> int:
    return max([0, *_lines(column, console, heading=heading)])


def _lines(column: Column, console: Console, *, words: bool = False, heading: bool = True) -> list[int]:
    """The widths of a column's lines, or of their words."""
    cells = [*([column.header] if heading else []), *column.cells]
    texts = [console.render_str(cell).plain if isinstance(cell, str) else str(cell) for cell in cells]
    lines = [line for text in texts for line in text.split("\n")]
    return [cell_len(piece) for line in lines for piece in (line.split() if words else [line])]


def _part(table: Table, columns: Sequence[int]) -> Table:
    """Some columns of a table, with all its rows."""
    part = Table(
        title=table.title,
        title_justify=table.title_justify,
        caption=table.caption,
        show_header=table.show_header,
        show_edge=table.show_edge,
        pad_edge=table.pad_edge,
    )
    for index in columns:
        column = table.columns[index]
        part.add_column(column.header, justify=column.justify, overflow=column.overflow, style=column.style)
    cells = zip(*(table.columns[index].cells for index in columns), strict=True)
    for row, values in zip(table.rows, cells, strict=True):
        part.add_row(*values, style=row.style, end_section=row.end_section)
    return part
