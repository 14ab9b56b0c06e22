"""LeRobot's own code beside Turbo-Pi's: small checkpoints made, saved, loaded and run by LeRobot here and now.

LeRobot pins a PyTorch of its own, so it runs in an environment of its own: the interpreter that TURBOPI_LEROBOT_PYTHON
names, or .venv-lerobot in the repository, which scripts/lerobot_env makes. Golden cases that are stored need none.
"""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from lerobot_golden import GOLDEN, GoldenCase
from smolvla_golden import relative

pytestmark = pytest.mark.slow

REPOSITORY = Path(__file__).parents[1]
PYTHON = Path(os.environ.get("TURBOPI_LEROBOT_PYTHON", REPOSITORY / ".venv-lerobot" / "bin" / "python")).absolute()
CASES = sorted(file.parent.name for file in GOLDEN.glob("*/case.json"))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stored cases that tools/lerobot_cases knows, made anew."""
    if not PYTHON.is_file():
        hint = f"LeRobot isn't installed at {PYTHON}; scripts/lerobot_env installs it (about 3 GB)"
        if os.environ.get("TURBOPI_REQUIRE_LEROBOT"):
            pytest.fail(hint)
        pytest.skip(hint)
    folder = tmp_path_factory.mktemp("lerobot")
    environment = {"PYTHONPATH": str(REPOSITORY / "tools"), "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    ran = subprocess.run(
        [PYTHON, "-m", "lerobot_cases", folder],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=800,
    )
    assert ran.returncode == 0, ran.stderr[-4000:]
    return folder


def test_turbopi_computes_what_lerobot_computes_now(made: Path, tmp_path: Path) -> None:
    cases = sorted(file.parent for file in made.glob("*/case.json"))
    assert len(cases) > 10
    wrong = {}
    for folder in cases:
        case = GoldenCase(folder)
        wrong[folder.name] = case.wrong(case.assemble(tmp_path / folder.name))
    assert {name: found for name, found in wrong.items() if found} == {}


def test_the_stored_cases_are_what_lerobot_computes_now(made: Path) -> None:
    """Nothing but LeRobot's own output is stored, and its version of today agrees with it."""
    common = [name for name in CASES if (made / name).is_dir()]
    assert common
    for name in common:
        stored, now = (np.load(folder / name / "expected.npz") for folder in (GOLDEN, made))
        assert stored.files == now.files
        described = [json.loads((folder / name / "case.json").read_text()) for folder in (GOLDEN, made)]
        rounded = described[0]["config"].get("dtype") == "bfloat16"  # otherwise on each kind of CPU
        for key in stored.files:  # of the rms; seen: 4e-7, and in bfloat16 9e-4
            assert relative(now[key], stored[key]) <= (5e-3 if rounded else 1e-5), f"{name}: {key}"
        assert described[0]["runs"] == described[1]["runs"]
