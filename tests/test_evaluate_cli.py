"""`turbopi eval` and `turbopi compare`, as they are typed."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from evaluate_fakes import SeekingPolicy
from typer.testing import CliRunner, Result

from turbopi import serve
from turbopi.cli import app
from turbopi.cli.options import PolicyOptions
from turbopi.evaluate.sources import LocalPolicy
from turbopi.recordings import load_call, recorded_files
from turbopi.sim import libero
from turbopi.support.errors import ConfigError
from turbopi.support.installation import install_command

pytestmark = pytest.mark.usefixtures("two_layers", "unseen_plots")

QUICK = "--random-weights pi05_tiny --precision f32 --steps 1 --camera-px 64 --image-px 64 --videos none"


def turbopi(command: str, *more: Any) -> Result:
    return CliRunner().invoke(app, [*command.split(), *map(str, more)])


def refused(command: str, *more: Any) -> str:
    """What is said; the exit code must be that of bad input."""
    result = turbopi(command, *more)
    assert result.exit_code == 2, result.output
    return " ".join(result.stderr.split())


@pytest.fixture
def seeking(monkeypatch: pytest.MonkeyPatch) -> None:
    """The policy that the options describe is made, but for the model, which would take its time."""
    monkeypatch.setattr(PolicyOptions, "make_policy", lambda *_: SeekingPolicy())


@pytest.mark.usefixtures("seeking")
def test_eval_writes_its_folder_and_continues_it(tmp_path: Path) -> None:
    out = tmp_path / "run"
    command = f"eval reacher {QUICK} --tasks 0,2 --max-steps 6 --out {out} --json"
    first = turbopi(command, "--trials", 1)
    assert first.exit_code == 0, first.output
    reported = json.loads(first.stdout)
    assert (reported["episodes"], reported["success"]["trials"], reported["crashes"]) == (2, 2, 0)
    assert "RANDOM WEIGHTS" in first.stderr and "task 2, initial state 0: failure after 6 steps" in first.stderr
    assert {path.name for path in out.iterdir()} >= {"results.json", "report.html", "success.png", "latency.png"}
    second = turbopi(command, "--trials", 2)
    assert "2 of them are finished already; 2 to go" in second.stderr
    assert json.loads(second.stdout)["episodes"] == 4
    episodes = json.loads((out / "results.json").read_text())["episodes"]
    assert [(e["task"], e["initial_state"], len(e["call_ms"])) for e in episodes] == [
        (0, 0, 2),
        (0, 1, 2),
        (2, 0, 2),
        (2, 1, 2),
    ]


@pytest.mark.usefixtures("seeking")
def test_what_the_policy_sees_is_recorded(tmp_path: Path) -> None:
    command = f"eval reacher {QUICK} --tasks 0 --trials 2 --max-steps 6 --out {tmp_path / 'run'}"
    result = turbopi(command, "--record", tmp_path / "seen")
    assert result.exit_code == 0, result.output
    assert "recorded 4 observations in" in result.output
    calls = [load_call(file) for file in recorded_files(tmp_path / "seen")]
    assert [(c.result["episode"]["initial_state"], c.result["episode"]["step"]) for c in calls] == [
        (0, 0),
        (0, 5),
        (1, 0),
        (1, 5),
    ]
    assert calls[0].result["actions"].shape == (10, 7)
    assert calls[0].observation["observation/image"].shape == (64, 64, 3)
    turbopi(command, "--record", tmp_path / "again")
    assert not (tmp_path / "again").exists()  # nothing was left to run


@pytest.mark.usefixtures("seeking")
def test_a_run_that_cannot_be_warmed_up_leaves_no_recording(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def refuse(*_: object) -> None:
        raise ConfigError("takes more than the GPU's memory")

    monkeypatch.setattr(LocalPolicy, "warm_up", refuse)
    command = f"eval reacher {QUICK} --tasks 0 --trials 1 --out {tmp_path / 'run'} --record {tmp_path / 'seen'}"
    assert "takes more than the GPU's memory" in refused(command)
    assert not (tmp_path / "seen").exists()


def test_a_server_is_evaluated(tmp_path: Path) -> None:
    with serve.running(SeekingPolicy()) as server:
        result = turbopi(f"eval reacher --port {server.port} --tasks 1 --trials 1 --videos none --out {tmp_path}")
    assert result.exit_code == 0, result.output
    assert "task 1, initial state 0: success" in result.stdout and "100.0 % [20.7, 100.0]" in result.stdout


@pytest.mark.slow
def test_a_foreign_label_is_printed_as_it_is(tmp_path: Path) -> None:
    """And isn't taken for the terminal's markup, which would end the command after the run."""
    policy = SeekingPolicy()
    policy.metadata["backend"] = "[/red]"
    with serve.running(policy) as server:
        for name in "ab":
            command = f"eval reacher --port {server.port} --tasks 1 --trials 1 --videos none --max-steps 5"
            result = turbopi(command, "--out", tmp_path / name)
            assert result.exit_code == 0, result.output
            assert "[/red]" in result.stdout
    result = turbopi("compare", tmp_path / "a", tmp_path / "b", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    assert "[/red]" in result.stdout


@pytest.mark.slow
@pytest.mark.usefixtures("seeking")
def test_crashes_give_exit_code_1(tmp_path: Path) -> None:
    command = f"eval evaluate_fakes:TroubledSimulator {QUICK} --tasks 0 --initial-states 0,3 --max-steps 5"
    result = turbopi(command, "--out", tmp_path)
    assert result.exit_code == 1, result.output
    assert "the physics exploded" in result.stdout and "1 episodes crashed and count as nothing" in result.stdout


@pytest.mark.usefixtures("seeking")
def test_a_simulator_in_the_current_folder_is_found_by_the_installed_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whose path begins with its own folder, not with the current one."""
    (tmp_path / "my_module.py").write_text(
        "from turbopi.sim.reacher import ReacherSimulator\n\n\nclass Sim(ReacherSimulator):\n    pass\n"
    )
    monkeypatch.chdir(tmp_path)
    here = [path for path in sys.path if path not in ("", str(tmp_path))]
    monkeypatch.setattr(sys, "path", here)
    result = turbopi(f"eval my_module:Sim {QUICK} --tasks 0 --trials 1 --max-steps 5 --out out")
    monkeypatch.delitem(sys.modules, "my_module", raising=False)
    assert result.exit_code == 0, result.output
    assert "task 0, initial state 0: failure after 5 steps" in result.stdout


@pytest.mark.slow
def test_compare_runs_each_way_with_the_same_noise(tmp_path: Path) -> None:
    command = f"compare pytorch:f32:1 pytorch:bf16:1 --simulator reacher {QUICK} --tasks 0 --trials 1 --max-steps 5"
    result = turbopi(command, "--out", tmp_path, "--json")
    assert result.exit_code == 0, result.output
    first, second = json.loads(result.stdout)["runs"]
    assert first["action_error"] == {"rms": 0.0, "max": 0.0, "observations": 1}  # it is the reference
    assert 1e-4 < second["action_error"]["rms"] < 0.3
    assert second["paired_with_first"]["pairs"] == 1
    assert {path.name for path in tmp_path.iterdir()} == {
        "pytorch-f32-1steps",
        "pytorch-bf16-1steps",
        "compare.json",
        "compare.png",
        "compare.html",
    }
    folders = (tmp_path / "pytorch-bf16-1steps", tmp_path / "pytorch-f32-1steps")
    again = turbopi("compare", *folders)
    assert again.exit_code == 0, again.output
    assert "0.0 % [0.0, 79.3]" in again.stdout


@pytest.mark.parametrize(
    ("command", "why"),
    [
        ("eval metaworld --random-weights pi05_tiny", "unknown simulator 'metaworld'; choose one of libero, reacher"),
        ("eval reacher", "no weights: give a checkpoint's folder"),
        ("eval tests reacher", "tests is a folder, but the simulator comes first: turbopi eval SIMULATOR CHECKPOINT"),
        (f"eval reacher {QUICK} --wait-steps 1001", "--wait-steps 1001 should be from 0 to 1000"),
        (f"eval reacher {QUICK} --control nothing", "the control is 'nothing'; choose one of prompt, pictures"),
        ("eval reacher --random-weights pi05_tiny --port 8000", "give no weights beside them"),
        (f"eval reacher {QUICK} --suite spatial", "unknown suite 'spatial' of reacher; choose one of reacher_colors"),
        (f"eval reacher {QUICK} --tasks 7", "reacher_colors has no task 7; its tasks are 0: reach the red dot"),
        (f"eval reacher {QUICK} --tasks a", "--tasks is 'a'; expected whole numbers and ranges"),
        (f"eval reacher {QUICK} --trials 51", "51 trials of task 0 aren't possible: from 1 to 50 are"),
        (f"eval reacher {QUICK} --seeding never", "--seeding never isn't one; choose episode or task"),
        (f"eval reacher {QUICK} --replan 11", "chunks have 10 actions, so it can't act 11 steps"),
        (f"eval reacher {QUICK} --replan 0", "--replan 0 should be at least 1"),
        (f"eval reacher {QUICK} --image-px 100000", "--image-px 100000 should be 4096 at most"),
        ("eval reacher --port 9 --trials 1", "no policy server at ws://127.0.0.1:9"),
        ("eval reacher --port 9 --steps 1 --precision f32", "the server decides about --precision, --steps: start it"),
        ("compare nothere nothere2", "'nothere' is neither the folder of an evaluation nor a way to run"),
        (f"compare {QUICK} pytorch:f32 pytorch:bf16:2000", "the number of denoising steps is 2000"),
        ("compare a", "compare needs two runs or more, but got 1: a"),
        (f"compare {QUICK} pytorch:f32 warp:f32", "'warp:f32' is neither the folder of an evaluation nor a way to run"),
        (f"compare {QUICK} pytorch:f32:1 pytorch", "the same way to run is named twice"),
        (f"compare {QUICK} pytorch:f32 emulated_fp8:bf16", "backend 'emulated_fp8' doesn't run in 'bf16': only fp8"),
        (f"compare {QUICK} pytorch:f32 emulated_fp8:fp8", "precision 'fp8' needs a calibration"),
        (f"compare {QUICK} pytorch:f32 pytorch:bf16 --quantization x.json", "none of these is"),
    ],
)
@pytest.mark.usefixtures("seeking")
def test_bad_input_is_refused_with_the_way_out(command: str, why: str, tmp_path: Path) -> None:
    assert why in refused(command, "--out", tmp_path / "never")
    assert not (tmp_path / "never").exists()


@pytest.mark.parametrize(
    ("file", "command"),
    [
        ("delays.json", f"eval reacher {QUICK} --tasks 0 --trials 1 --execution sync,async"),
        ("compare.json", f"compare pytorch:f32 pytorch:bf16 --simulator reacher {QUICK} --tasks 0 --trials 1"),
    ],
)
@pytest.mark.usefixtures("seeking")
def test_anothers_file_is_not_replaced(file: str, command: str, tmp_path: Path) -> None:
    (tmp_path / file).write_text('{"floors": {}}')
    reported = refused(command, "--out", tmp_path)
    assert f"{file} is there and isn't a" in reported and "so it isn't replaced" in reported
    assert [path.name for path in tmp_path.iterdir()] == [file]


@pytest.mark.slow
@pytest.mark.usefixtures("seeking")
def test_ways_beside_an_earlier_run_leave_its_pages_as_they_are(tmp_path: Path) -> None:
    """Unless --out is given, one way and several have the same folder."""
    command = f"eval reacher {QUICK} --tasks 0 --trials 1 --max-steps 6 --out {tmp_path}"
    assert turbopi(command).exit_code == 0
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert turbopi(command, "--execution", "sync,async").exit_code == 0
    assert {path: path.read_bytes() for path in before} == before
    assert (tmp_path / "delays.png").exists()


def test_a_policy_for_another_robot_is_refused(tmp_path: Path) -> None:
    reported = refused(f"eval reacher {QUICK} --robot plain", "--out", tmp_path / "never")
    assert "the policy doesn't take the observations of reacher" in reported
    assert "use one for the robot libero, such as config pi05_libero" in reported


def test_without_the_simulator_its_install_command_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(libero.importlib.util, "find_spec", lambda name: None)
    assert install_command("libero") in refused(f"eval libero {QUICK}")


@pytest.mark.usefixtures("seeking")
def test_missing_video_libraries_are_told_before_anything_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("turbopi.evaluate.video.importlib.util.find_spec", lambda name: None)
    command = f"eval reacher {QUICK} --videos all --trials 1"
    assert "pip install 'imageio[ffmpeg]', or give --videos none" in refused(command, "--out", tmp_path)
    assert not list(tmp_path.iterdir())
