"""Write the documents' tables and plots and the package's table of measured calls from the result files below
benchmarks/results/, or check that they agree.

    scripts/tables           fill them in
    scripts/tables --check   change nothing; exit code 1 and a list if one differs

A table stands between two lines of a document, which name what it shows and of which files:

    <!-- table: main_job h200_2026-11-26_pi05_libero/results.json.xz -->
    <!-- end of table -->

`tables.py` has one function for each name; behind each table stand links to its files. The plots are those that
`turbopi bench --report` draws: every folder below benchmarks/results/ with a benchmark's results.json has them, and
each names the document it was drawn of. README's plot of others' latency beside ours is drawn of the outputs that
peers.py names. The measured calls that predictions and fleet plans go by are those of the result files that
benchmarks/measured.json names. Reports of studies have their Markdown and plots beside their report.json.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from doc_tables.blocks import differences, fill
from doc_tables.drawn import draw, stale_plots
from doc_tables.measured import stale_measured, write_measured
from doc_tables.peers import draw_peers, stale_peers
from doc_tables.studies import stale_reports, write_reports

ROOT = Path(__file__).parents[2]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="scripts/tables", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="change nothing; exit code 1 if a table or plot differs")
    given = parser.parse_args(arguments)
    if given.check:
        found = stale_measured(ROOT) + differences(ROOT) + stale_plots(ROOT)
        found += stale_peers(ROOT) + stale_reports(ROOT)
        for line in found:
            print(line, file=sys.stderr)
        return 1 if found else 0
    for changed in (*write_measured(ROOT), *fill(ROOT), *draw(ROOT), *draw_peers(ROOT), *write_reports(ROOT)):
        print(f"wrote {changed.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
