"""Each example runs, with nothing for hardware; it says what it shows and how to run it."""

import ast
import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from test_serve_openpi_client import PYTHON as CLIENT

from turbopi import UnifiedPolicy
from turbopi.checkpoint import random_checkpoint
from turbopi.serve import running

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("two_layers")]

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
STAND_IN = ROOT / "tests" / "openpi_stand_in"


def run(name: str, *arguments: str, python: Path = Path(sys.executable), cwd: Path | None = None) -> str:
    """What an example prints. Another `python` is that of openpi's client, and has nothing of Turbo-Pi's."""
    ours = {"PYTHONPATH": os.pathsep.join((str(ROOT / "src"), str(STAND_IN))), "PYTHONWARNINGS": "error"}
    done = subprocess.run(
        [python, EXAMPLES / name, *arguments],
        env=os.environ | (ours if python == Path(sys.executable) else {"PYTHONPATH": ""}),
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def policy() -> UnifiedPolicy:
    return UnifiedPolicy(random_checkpoint("pi05_tiny"), device="cpu")


@pytest.mark.parametrize("example", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_every_example_says_how_to_run_it_and_is_run_here(example: Path) -> None:
    shown = ast.get_docstring(ast.parse(example.read_text(encoding="utf-8")))
    assert shown and f"python examples/{example.name}" in shown
    assert f'run("{example.name}"' in Path(__file__).read_text(encoding="utf-8")


@pytest.mark.parametrize("client", ["openpi's", "a stand-in"])
def test_the_loop_over_openpis_client_moves_an_arm(policy: UnifiedPolicy, client: str) -> None:
    if client == "openpi's" and not CLIENT.is_file():
        pytest.skip(f"openpi-client isn't installed at {CLIENT}")
    python = CLIENT if client == "openpi's" else Path(sys.executable)
    with running(policy) as server:
        shown = run("openpi_loop.py", "--port", str(server.port), "--steps", "8", "--age", "300", python=python)
    assert shown.startswith("connected to a policy for libero\n")
    assert sum(commands_in(shown).values()) == 8


def test_the_robot_loop_gives_an_arm_a_command_in_every_step(policy: UnifiedPolicy) -> None:
    with running(policy) as server:
        options = ("--hz", "2", "--steps", "8", "--age", "300")  # which of them are fresh depends on the CPU
        shown = run("robot_loop.py", "--port", str(server.port), *options)
    assert shown.startswith("warm after ")
    assert sum(commands_in(shown).values()) == 8


def test_the_so101_moves_by_its_own_keys() -> None:
    policy = UnifiedPolicy(random_checkpoint("pi05_tiny"), device="cpu", robot=str(EXAMPLES / "so101.json"))
    with running(policy) as server:
        shown = run("lerobot_so101.py", "--server", server.url, "--steps", "60", "--age", "300")
    assert sum(commands_in(shown).values()) == 60


def test_the_so101_says_why_it_got_no_actions(policy: UnifiedPolicy) -> None:
    """A server for another robot."""
    with running(policy) as server, pytest.raises(AssertionError, match=r"no 'observation/image'.*shoulder_pan\.pos"):
        run("lerobot_so101.py", "--server", server.url, "--steps", "1")


def commands_in(shown: str) -> dict[str, int]:
    found = re.search(r"commands ({[^}]*})", shown)
    assert found is not None, shown
    counted: dict[str, int] = ast.literal_eval(found[1])
    return counted


def test_a_server_that_is_not_warm_yet_is_waited_for(policy: UnifiedPolicy) -> None:
    """The examples start it in the background, and the robot at once."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])  # free when it is closed
    requested = {
        "openpi_loop.py": ("--host", "127.0.0.1", "--port", port),
        "robot_loop.py": ("--host", "127.0.0.1", "--port", port, "--steps", "2", "--age", "300"),
        "lerobot_so101.py": ("--server", f"ws://127.0.0.1:{port}"),
    }
    for name, where in requested.items():
        with pytest.raises(AssertionError, match=r"no server answers .*; start one with: turbopi serve") as failed:
            run(name, *where, "--patience", "0")
        assert "Traceback" not in str(failed.value)


def test_a_robot_of_ones_own_is_a_file_or_a_class() -> None:
    assert run("own_robot.py") == "my_arm.json: (10, 7)\nDegreeArm: (10, 7)\n"


def test_recordings_become_fp8(tmp_path: Path) -> None:
    shown = run("fp8_from_recordings.py", "--folder", "here", "--frames", "2", cwd=tmp_path)
    assert "PASS" in shown and "in FP8 answers with actions [16, 7]" in shown
    assert (tmp_path / "here" / "fp8.json").is_file()


def test_the_python_api_shows_what_a_call_can_be_asked_for() -> None:
    shown = run("python_api.py")
    assert "warm after" in shown and "a batch of 2 chunks" in shown and "refused: the observation has no" in shown


def test_the_model_server_of_vla_eval_says_that_no_policy_answers() -> None:
    """It runs in test_vla_eval.py."""
    pytest.importorskip("vla_eval", reason="pip install vla-eval, with its dependencies")
    with pytest.raises(AssertionError, match=r"vla_eval_server\.py: no policy server at ws://127\.0\.0\.1:9"):
        run("vla_eval_server.py", "--args.policy", "ws://127.0.0.1:9")
