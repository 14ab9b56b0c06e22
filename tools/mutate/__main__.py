"""Plant each fault of faults.py into a copy of the tree, run the tests that should find it, write the table.

The copy has the tree's tracked files as they are now; the tree itself is never touched. A row says which tests failed.
Tests of the GPU result's fingerprint don't count: any change fails them. Exits 1 if a fault stayed unseen. Examples:
    PYTHONPATH=src:tests:tools python -m mutate
    PYTHONPATH=src:tests:tools python -m mutate --only bucket --only RoPE
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from mutate.faults import FAULTS, Fault, place
from turbopi.support.files import write_whole

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "docs/dev/faults.md"
FOLDERS = ("src", "packages/turbopi-lab/src", "tests", "tools")  # of modules


@dataclass(frozen=True)
class Ran:
    """What a run of tests came to: how many there were, how many were skipped, the names of those that failed."""

    tests: int
    skipped: int
    failed: list[str]


def copy_tree(to: Path) -> None:
    """The tracked files, as they are in the working tree."""
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, names.split("\0")):
        if (ROOT / name).is_file():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, to / name)


def run_tests(tree: Path, tests: Iterable[str]) -> Ran:
    """Raises RuntimeError if pytest itself failed."""
    xml = tree / "mutate.xml"
    xml.unlink(missing_ok=True)
    folders = os.pathsep.join(str(tree / name) for name in FOLDERS)
    env = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, (folders, _others()))),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    options = ["-m", "not gpu and not slow", "-q", "-p", "no:cacheprovider", f"--junitxml={xml}"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *tests], cwd=tree, env=env, capture_output=True, text=True
    )
    if done.returncode not in (0, 1):
        raise RuntimeError(f"pytest ended with {done.returncode}\n{done.stdout[-3000:]}{done.stderr[-1000:]}")
    suite = next(ElementTree.parse(xml).getroot().iter("testsuite"))
    bad = [case for case in suite.iter("testcase") if {one.tag for one in case} & {"failure", "error"}]
    names = [f"{case.attrib['classname'].rpartition('.')[2]}::{case.attrib['name']}" for case in bad]
    return Ran(int(suite.attrib["tests"]), int(suite.attrib["skipped"]), names)


def _others() -> str:
    """What else is on the caller's PYTHONPATH."""
    here = {ROOT / name for name in FOLDERS}
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    return os.pathsep.join(path for path in given if path and Path(path).resolve() not in here)


def plant(fault: Fault, tree: Path) -> Ran:
    """Run the fault's tests with it in the tree's copy."""
    file = place(fault, tree / "src")
    before = file.read_text(encoding="utf-8")
    file.write_text(before.replace(fault.text, fault.planted), encoding="utf-8")
    try:
        return run_tests(tree, fault.tests)
    finally:
        file.write_text(before, encoding="utf-8")


def table(rows: list[tuple[Fault, Ran]], commit: str) -> str:
    caught = sum(bool(ran.failed) for _, ran in rows)
    lines = [
        "# Faults that a CPU finds",
        "",
        f"Written by `python -m mutate` (tools/mutate) of commit {commit}: {caught} of {len(rows)} planted faults were "
        "found by tests that need no GPU. Tests of the GPU result's fingerprint, which any change fails, don't count.",
        "",
        "| fault | what it would do | found by |",
        "|---|---|---|",
    ]
    for fault, ran in rows:
        names = sorted({name.partition("[")[0] for name in ran.failed})
        more = f" and {len(names) - 2} more" if len(names) > 2 else ""
        found = ", ".join(f"`{name}`" for name in names[:2]) + more if names else "**not found**"
        lines.append(f"| {fault.name} | {fault.fatal} | {found} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", default=[], metavar="TEXT", help="faults whose name has it")
    parser.add_argument("--out", type=Path, help="where the table goes (docs/dev/faults.md if all faults are planted)")
    options = parser.parse_args()
    faults = [one for one in FAULTS if not options.only or any(text in one.name for text in options.only)]
    commit = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        copy_tree(tree)
        clean = run_tests(tree, sorted({test for fault in faults for test in fault.tests}))
        if clean.failed:
            sys.exit(f"mutate: without a fault these fail: {', '.join(clean.failed)}")
        print(f"without a fault: {clean.tests - clean.skipped} tests pass, {clean.skipped} are skipped", flush=True)
        for fault in faults:
            ran = plant(fault, tree)
            print(
                f"{'found' if ran.failed else 'NOT FOUND'}: {fault.name} ({len(ran.failed)} of {ran.tests})", flush=True
            )
            rows.append((fault, ran))
    text, out = table(rows, commit.stdout.strip()), options.out or (None if options.only else TABLE)
    if out is None:
        print(text)
    else:
        write_whole(out, text)
    return 0 if all(ran.failed for _, ran in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
