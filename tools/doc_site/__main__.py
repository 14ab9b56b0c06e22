"""Builds the documentation site: `scripts/site`.

Its pages are the documents of the clone, and three that are written anew: the command line (by typer), the Python
interface (from docstrings), every measured call (from benchmarks/results). A dead link, a page that the navigation
lacks, a file that a page would fetch from elsewhere, or any warning fails.
"""

import argparse
import html
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from typer.core import TyperGroup
from typer.main import get_command

from doc_site import measurements
from doc_site.reference import reference
from doc_site.staging import stage
from turbopi.cli import app

ROOT = Path(__file__).parents[2]
_FETCHES = re.compile(r"""<(?:script|link|img|iframe|source)\b[^>]*(?:src|href)=["']?(?:https?:)?//[^>]*>""")
SOURCES, SITE = ROOT / "build" / "site_sources", ROOT / "build" / "site"


def command_line() -> str:
    """The page of all commands, as typer writes it of their declarations."""
    command = [sys.executable, "-m", "typer", "turbopi.cli", "utils", "docs", "--name", "turbopi"]
    text = html.unescape(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    first, *sections = re.split(r"^(?=## )", text, flags=re.MULTILINE)
    first = first.replace("# `turbopi`", "# Command line").partition("**Commands**")[0]  # a table of contents is there
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    old_names = tuple(f"## `turbopi {name}`" for name, one in group.commands.items() if one.hidden)
    text = "".join([first, *(one for one in sections if not one.startswith(old_names))])
    text = re.sub(r"\[cyan\](.*?)\[/\]", r"    \1", text)  # examples: code
    return re.sub(r"\[bold\](.*?)\[/\]", r"**\1**", text)


def fetched(site: Path) -> list[str]:
    """A line for each file that a page would fetch from elsewhere."""
    return [
        f"{page.relative_to(site)} fetches {found[0]}"
        for page in sorted(site.rglob("*.html"))
        for found in _FETCHES.finditer(page.read_text(encoding="utf-8"))
        if "canonical" not in found[0]
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="scripts/site", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=SITE, help="the site's folder, made anew (build/site)")
    given = parser.parse_args(arguments)
    written = {
        "docs/cli_reference.md": command_line(),
        "docs/api_reference.md": reference(),
        measurements.DOCUMENT: measurements.measurements(ROOT),
    }
    stage(ROOT, SOURCES, written)
    shutil.copy(Path(__file__).parent / "iframe-worker.js", SOURCES)
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(given.out.resolve())]
    failed = subprocess.run(build, cwd=ROOT, check=False).returncode != 0
    found = [] if failed else fetched(given.out)
    for line in found:
        print(line, file=sys.stderr)
    if not failed and not found:
        print(f"scripts/site: open {given.out / 'index.html'}")
    return 1 if failed or found else 0


if __name__ == "__main__":
    sys.exit(main())
