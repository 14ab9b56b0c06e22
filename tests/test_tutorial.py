"""The tutorial's commands, as they stand in docs/tutorial.md, one after the other in an empty folder; with fewer calls
where the number of them is an option.
"""

import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
TUTORIAL = ROOT / "docs" / "tutorial.md"


def commands() -> list[str]:
    return re.findall(r"^```bash\n(.*?)^```$", TUTORIAL.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


@pytest.mark.timeout(3600)  # some ten commands
def test_the_tutorial_runs_from_its_first_line_to_its_last(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
    script = "set -euo pipefail\nset -m\n" + "\n".join(commands())
    # a port that no other test uses
    script = script.replace("8000", port).replace("--record recordings", f"--record recordings --port {port}")
    script = script.replace("kill %1\nwait", "kill %1\nwait || true")
    for said, fewer in (
        ("--count 2 ", "--count 1 --noises 1 "),
        ("--calls 10 --main-calls 10 ", "--calls 1 --main-calls 2 "),
    ):
        assert said in script
        script = script.replace(said, fewer)
    environment = os.environ | {
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        "PYTHONPATH": str(ROOT / "src"),
        "COLUMNS": "80",
    }
    ended = subprocess.run(
        ["bash", "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stdout[-3000:] + ended.stderr[-3000:]
    for left in ("actions.npz", "actions.png", "fp8.json", "bench-report/results.json"):
        assert (tmp_path / left).is_file(), f"the tutorial left no {left}"
    assert re.search(r"{[^}]*'fresh': [1-9]", ended.stdout), "the robot's loop got a chunk"
    assert "PASS" in ended.stdout
    assert not re.search(r"^Traceback", ended.stdout + ended.stderr, flags=re.MULTILINE)
    tables = [line for line in ended.stdout.splitlines() if "│" in line or "┃" in line]
    assert tables and not any("…" in line or len(line) > 80 for line in tables), "a table was cut at 80 columns"
