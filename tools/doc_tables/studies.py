"""Reports of studies below benchmarks/results/: their Markdown and plots, and the documents' tables of them."""

from collections.abc import Iterator
from pathlib import Path

from packed import read_packed, write_content

from doc_tables.drawn import compacted
from turbopi_lab.studies import report
from turbopi_lab.studies.report import Report, table_lines


def read_report(file: Path) -> Report:
    """Raises ConfigError, a ValueError, for a file of another kind. A large one may be packed (.xz)."""
    return read_packed(file, Report)


def _reports(root: Path) -> Iterator[tuple[Path, Report]]:
    for file in sorted((root / "benchmarks" / "results").glob(f"*/*/{report.JSON}*")):
        yield file, read_report(file)


def _written(file: Path, document: Report) -> Iterator[Path]:
    for path in report.write(document, file.parent):
        if path.name == report.JSON and file.suffix == ".xz":
            write_content(file, path.read_bytes())
            path.unlink()
        else:
            yield path


def stale_reports(root: Path) -> list[str]:
    """One line for each report whose Markdown isn't what its JSON says, or whose plots are missing."""
    found = []
    for file, document in _reports(root):
        folder = file.parent
        text = folder / report.MARKDOWN
        if not text.is_file() or text.read_text(encoding="utf-8") != report.markdown(document):
            found.append(f"{text.relative_to(root)} isn't what {report.JSON} beside it says; run scripts/tables")
        plots = (folder / f"{plot.name}.png" for plot in document.plots)
        found += [f"{plot.relative_to(root)} is missing; run scripts/tables" for plot in plots if not plot.is_file()]
    return found


def write_reports(root: Path) -> list[Path]:
    """Write Markdown and plots of every report that needs them anew."""
    if not stale_reports(root):
        return []
    return compacted(path for file, document in _reports(root) for path in _written(file, document))


# --- tables -----------------------------------------------------------------------------------------------------------


def study(document: Report) -> list[str]:
    """Whether the result can be believed: how many controls passed, and those that failed."""
    failed = [f"- **Failed:** {one.claim} {one.evidence}".rstrip() for one in document.controls if not one.held]
    count = len(document.controls)
    return [f"*Controls:* {count - len(failed)} of {count} passed.", *(["", *failed] if failed else [])]


def few_steps(document: Report) -> list[str]:
    """Success by the number of Euler steps, and from a warm start."""
    cells = document.data["successes"]
    assert isinstance(cells, list)
    rows: list[list[report.Cell]] = []
    for policy in dict.fromkeys(cell["policy"] for cell in cells):
        for count in (1, 2, 3, 10):
            own = [cell for cell in cells if (cell["policy"], cell["evaluations"]) == (policy, count)]
            euler = [cell for cell in own if (cell["solver"], cell["grid"]) == ("euler", "uniform")]
            (cold,) = [cell for cell in euler if not cell["warm"]]
            (warm,) = [cell for cell in own if cell["warm"] and cell["solver"] == "euler"]
            rows.append([policy, count, f"{_percent(cold)} {_interval(cold)}", _percent(warm)])
    return table_lines(report.Grid("", ["policy", "Euler steps", "solved, % [95 %]", "from a warm start"], rows))


def _percent(cell: dict[str, dict[str, float]]) -> str:
    return f"{100 * cell['rate']['rate']:.1f}"


def _interval(cell: dict[str, dict[str, list[float]]]) -> str:
    low, high = cell["rate"]["wilson95"]
    return f"[{100 * low:.1f}, {100 * high:.1f}]"
