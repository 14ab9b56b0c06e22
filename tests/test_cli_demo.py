"""`turbopi demo`: the main job end to end, and a check that can fail."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cli_helpers import refusal, turbopi
from PIL import Image

from turbopi.backends.base import Sample
from turbopi.backends.pytorch import PyTorchBackend, reference_model
from turbopi.checkpoint import random_checkpoint
from turbopi.models.observation import Observation
from turbopi.policy import shipped
from turbopi.policy.policy import UnifiedPolicy
from turbopi.sim import SimulatorUnavailable
from turbopi.sim.libero import LiberoSimulator
from turbopi.support.action_groups import action_groups
from turbopi.support.errors import BackendError, TurboPiError
from turbopi.verify import control, demo

pytestmark = pytest.mark.usefixtures("two_layers")


def tiny_oracle(preset: str = "pi05_tiny") -> UnifiedPolicy:
    return UnifiedPolicy(random_checkpoint(preset), backend="pytorch", precision="f32", num_denoising_steps=2)


def test_the_frames_are_real_pictures_with_states_and_prompts() -> None:
    frames = shipped.load_frames()
    assert len(frames) >= 3
    for frame in frames:
        for camera_image in (frame.base, frame.wrist):
            assert camera_image.shape == (256, 256, 3)
            assert camera_image.dtype == np.uint8
            assert camera_image.std() > 10
        assert frame.state.shape == (8,)
        assert frame.prompt
    assert len({frame.base.tobytes() for frame in frames}) == len(frames)


def test_missing_pictures_are_said_to_be_missing(tmp_path: Path) -> None:
    with pytest.raises(TurboPiError, match=r"has no frames.json: the installation lacks the demo's images"):
        shipped.load_frames(tmp_path)


@pytest.mark.slow
def test_without_a_checkpoint_the_demo_runs_the_small_policy_and_is_near_the_expert(tmp_path: Path) -> None:
    result = turbopi("demo", "--frames", 2, "--report", tmp_path / "report", "--seed", 3, "--episodes", 0)
    assert result.exit_code == 0, result.output
    out = result.stdout
    assert "RANDOM" not in out
    assert "against what the expert did next" in out
    assert "pi05_tiny for libero, bf16 on cpu (CPU), 10 steps" in out
    assert "backend: pytorch (auto: on a CPU" in out
    for heading in ("preprocess", "vision", "prefix", "denoise", "postprocess", "model", "total"):
        assert heading in out
    for frame in shipped.load_frames()[:2]:
        assert frame.prompt.split()[-1] in out
    assert "frame 0: the next 16 actions, 7 numbers each" in out
    assert "The bound is 10 times the control" in out
    assert "OK: pytorch bf16 is within" in out
    assert "\x1b" not in out

    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert report["ok"] is True
    assert report["random_weights"] is False
    assert report["episodes"] is None
    assert report["seed"] == 3
    assert len(report["frames"]) == 2
    check = report["check"]
    assert check["bound"] == pytest.approx(10 * check["control_rms"])
    assert check["rms_of_all"] == pytest.approx(np.sqrt(np.mean(np.square(check["rms"]))))
    assert 0 < check["rms_of_all"] <= check["bound"]
    with np.load(tmp_path / "report" / "actions.npz") as actions:
        assert actions["actions"].shape == actions["oracle_actions"].shape == (2, 16, 7)
        assert actions["actions"].dtype == np.float64
        np.testing.assert_allclose(actions["actions"][1], report["frames"][1]["actions"])
        assert not np.array_equal(actions["actions"], actions["oracle_actions"])
    with Image.open(tmp_path / "report" / "demo.png") as camera_image:
        assert camera_image.width > 1200
        assert np.asarray(camera_image.convert("L")).std() > 20


@pytest.mark.slow
def test_random_weights_are_said_to_be_random_and_held_to_the_closer_bound(tmp_path: Path) -> None:
    result = turbopi("demo", "--random-weights", "pi05_tiny", "--frames", 1, "--steps", 2, "--report", tmp_path)
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("RANDOM WEIGHTS (pi05_tiny, seed 0): the actions mean nothing.\n")
    assert "The bound is 5 times the control" in result.stdout
    assert "expert" not in result.stdout


@pytest.mark.slow
def test_episodes_that_are_asked_for_without_a_simulator_are_refused(tmp_path: Path, monkeypatch: Any) -> None:
    def missing(self: LiberoSimulator) -> list[str]:
        raise SimulatorUnavailable("LIBERO isn't installed here")

    monkeypatch.setattr(LiberoSimulator, "check", missing)
    result = turbopi("demo", "--frames", 1, "--report", tmp_path, "--episodes", 1)
    assert refusal(result) == "LIBERO isn't installed here", "before a policy is made"
    reported = turbopi("demo", "--frames", 1, "--steps", 1, "--report", tmp_path)
    assert reported.exit_code == 0, reported.output
    assert "The policy didn't act in the simulator: LIBERO isn't installed here" in " ".join(reported.stdout.split())


def swapped_cameras(
    self: PyTorchBackend, observation: Observation, noise: torch.Tensor, num_steps: int, **options: Any
) -> Sample:
    """A fault of the fast path alone: the oracle, in f32, is spared."""
    if self.precision == "bf16":
        observation = replace(observation, images=observation.images[:, [1, 0, 2]])
    return RIGHT_SAMPLE(self, observation, noise, num_steps)


RIGHT_SAMPLE = PyTorchBackend.sample


@pytest.mark.slow
def test_a_backend_that_swaps_cameras_fails_with_code_1(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(PyTorchBackend, "sample", swapped_cameras)
    result = turbopi("demo", "--frames", 1, "--steps", 2, "--report", tmp_path, "--json", "--episodes", 0)
    assert result.exit_code == 1, result.output
    assert "FAIL: pytorch bf16 is" in result.stderr
    assert "from the reference, beyond its bound" in result.stderr
    document = json.loads(result.stdout)
    assert document["ok"] is False
    assert document["check"]["rms_of_all"] > 2 * document["check"]["bound"]
    assert json.loads((tmp_path / "report.json").read_text()) == document


def test_a_report_folder_that_cannot_be_made_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    result = turbopi("demo", "--report", tmp_path / "file", "--frames", 1)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == f"error: can't write into {tmp_path / 'file'}: {tmp_path / 'file'} is a file\n"


@pytest.mark.parametrize(("options", "name"), [((), "report.json"), (("--real-time",), "real_time.json")])
def test_another_commands_results_are_not_replaced(options: tuple[str, ...], name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text('{"study": "mask"}')
    said = refusal(turbopi("demo", *options, "--report", tmp_path))
    assert said.startswith(f"{tmp_path / name} is there and isn't a report of `turbopi demo")
    assert (tmp_path / name).read_text() == '{"study": "mask"}'


@pytest.mark.parametrize("preset", ["pi05_tiny", "pi05_droid", "pi05_aloha", "pi05_base"])
def test_the_pictures_reach_every_robots_cameras(preset: str) -> None:
    frame = shipped.load_frames()[0]
    checkpoint = random_checkpoint("pi05_tiny")
    robot = random_checkpoint(preset).config.robot
    policy = UnifiedPolicy(checkpoint, backend="pytorch", robot=robot) if robot == "libero" else _for_robot(robot)
    (observation,) = shipped.observations(policy, [frame])
    inputs, _ = policy._pipeline.before(observation)
    size = (policy.config.planned_model.vision.image_size,) * 2
    expected = np.asarray(Image.fromarray(frame.base).resize(size, Image.Resampling.BILINEAR))
    np.testing.assert_array_equal(inputs.images[0], expected)
    assert inputs.image_mask[:2].all()
    assert not np.array_equal(inputs.images[0], inputs.images[1])


def _for_robot(robot: str) -> UnifiedPolicy:
    """A tiny policy for another robot than LIBERO's."""
    tiny = random_checkpoint("pi05_tiny").config
    return UnifiedPolicy(random_checkpoint(replace(tiny, robot=robot)), backend="pytorch")


@pytest.mark.slow
def test_the_check_passes_the_oracle_itself_and_refuses_anything_else() -> None:
    oracle = tiny_oracle()
    observed = shipped.observations(oracle, shipped.load_frames()[:1])
    exact = [result["actions"] for result in demo.run_frames(oracle, observed, 0, lambda: None)]

    def judged(actions: np.ndarray, precision: Any = "bf16") -> demo.OracleCheck:
        return demo.check([actions], oracle, observed, precision=precision, seed=0)

    same = judged(exact[0])
    assert same.ok
    assert same.all_frames.rms == 0
    assert 1e-4 < same.control < 2e-2
    units = demo.action_units(oracle, observed[0])
    assert not judged(exact[0] + 1.1 * same.bound * units).ok
    assert judged(exact[0] + 0.9 * same.bound * units).ok
    assert not judged(np.full_like(exact[0], np.nan)).ok
    last_dimension = exact[0].copy()
    last_dimension[:, 6] += 3 * same.bound * units[6]  # alone, and small beside the others' units
    assert not judged(last_dimension).ok
    assert judged(exact[0], "f32").bound < 1e-5
    with pytest.raises(BackendError, match=r"the backend's chunk has shape \[9, 7\], the oracle's \[10, 7\]"):
        judged(exact[0][:9])


def test_where_neither_the_backend_nor_other_weights_change_the_actions_nothing_is_judged() -> None:
    """As zeros do, which stand in for an answer of tokens that can't be read."""
    nothing, some = demo.Difference(0.0, 0.0), demo.Difference(1e-9, 1e-9)
    for differences, ok in (([nothing], None), ([nothing, some], False)):
        check = demo.OracleCheck(differences, 0.0, 10.0, np.zeros((len(differences), 2, 7)))
        assert check.ok is ok and check.as_json()["ok"] is ok


@pytest.mark.slow
def test_a_fault_in_one_of_several_frames_fails_the_check() -> None:
    """Faults make 73 times the control and more: seven times the bound, in one of six frames nearly three times."""
    oracle = tiny_oracle()
    observed = shipped.observations(oracle, shipped.load_frames()[:6])
    exact = [result["actions"] for result in demo.run_frames(oracle, observed, 0, lambda: None)]
    bound = demo.check(exact, oracle, observed, precision="bf16", seed=0).bound
    wrong = [exact[0] + 7.3 * bound * demo.action_units(oracle, observed[0]), *exact[1:]]
    judged = demo.check(wrong, oracle, observed, precision="bf16", seed=0)
    assert not judged.ok and judged.all_frames.rms == pytest.approx(7.3 * bound / np.sqrt(6), rel=1e-3)


@pytest.mark.slow
def test_an_error_is_the_same_however_many_frames_are_shown() -> None:
    oracle = tiny_oracle()
    observed = shipped.observations(oracle, shipped.load_frames()[:2])
    off = [result["actions"] * 1.01 for result in demo.run_frames(oracle, observed, 0, lambda: None)]
    one, two = (demo.check(off[:n], oracle, observed[:n], precision="bf16", seed=0) for n in (1, 2))
    assert one.differences[0].rms == pytest.approx(two.differences[0].rms, rel=1e-4)
    # a whole unit is half of what the statistics span, by which LIBERO's actions are normalised
    stats = oracle.pipeline.action_scale
    step = stats.unnormalize(np.ones((1, 32), np.float32)) - stats.unnormalize(np.zeros((1, 32), np.float32))
    np.testing.assert_allclose(demo.action_units(oracle, observed[0]), np.abs(step[0, :7]), rtol=1e-6)


def test_jitter_moves_what_bfloat16_would_round_and_is_undone() -> None:
    model = reference_model(tiny_oracle().backend)
    before = {name: parameter.clone() for name, parameter in model.named_parameters()}
    with control.jittered(model, 1):
        moved = {name for name, parameter in model.named_parameters() if not torch.equal(parameter, before[name])}
        weight = model.vlm.layers[0].mlp.up_proj.weight
        ratio = weight / before["vlm.layers.0.mlp.up_proj.weight"] - 1
        assert 2**-9.1 < ratio.abs().max() <= 2**-9 * (1 + 1e-4)
    assert "vlm.layers.0.mlp.up_proj.weight" in moved
    assert "action_in_proj.weight" not in moved
    for name, parameter in model.named_parameters():
        torch.testing.assert_close(parameter.detach(), before[name], rtol=1e-6, atol=0)


def test_random_libero_weights_get_the_statistics_of_real_episodes() -> None:
    random = random_checkpoint("pi05_tiny")
    real = shipped.with_libero_stats(random).norm_stats.state
    assert real is not None
    assert real.q01 is not None
    assert real.q99 is not None
    states = np.stack([frame.state for frame in shipped.load_frames()])
    margin = 0.25 * (real.q99 - real.q01)
    assert ((real.q01 - margin <= states) & (states <= real.q99 + margin)).mean() > 0.9
    droid = replace(random, config=replace(random.config, robot="droid"))
    assert shipped.with_libero_stats(droid) is droid


@pytest.mark.parametrize(("robot", "dims"), [("libero", 7), ("droid", 8), ("aloha", 14), ("aloha", 7), ("mine", 19)])
def test_every_action_dimension_is_drawn_once_with_a_unit(robot: str, dims: int) -> None:
    groups = action_groups(robot, dims)
    assert sorted(index for group in groups for index in group.names) == list(range(dims))
    assert all(group.unit and group.title and len(group.names) <= 8 for group in groups)
    assert (groups[0].unit == "the robot's units") == ((robot, dims) in [("aloha", 7), ("mine", 19)])


def test_the_real_time_demo_counts_what_it_played_and_says_it(tmp_path: Path) -> None:
    result = turbopi("demo", "--real-time", "--episodes", 2, "--report", tmp_path, "--json")
    assert result.exit_code == 0, result.output
    reported = json.loads((tmp_path / "real_time.json").read_text())
    assert [(way["execution"], way["delay"]) for way in reported["ways"]] == [
        ("async", 0),
        ("async", 4),
        ("rtc_trained", 4),
    ]
    for way in reported["ways"]:
        assert way["success"]["trials"] == 2 == len(way["outcomes"])
        assert way["success"]["successes"] == way["outcomes"].count("s")
        assert f"{way['success']['successes']} of 2 " in result.stderr
    assert reported["delay_costs"]["pairs"] == reported["joining_gains"]["pairs"] == 2
    assert (tmp_path / "real_time.png").exists() and (tmp_path / "commands.png").exists()
    (order,) = re.findall(r"^By successes: (.*)\.$", result.stderr, re.MULTILINE)
    counts = [int(count) for count in re.findall(r"\((\d+)\)", order)]
    assert counts == sorted((way["success"]["successes"] for way in reported["ways"]), reverse=True)
    assert "2 episodes don't tell whether there is a difference" in result.stderr
    assert "next, with your own: turbopi inspect CHECKPOINT" in result.stderr


def test_episodes_of_libero_are_few(tmp_path: Path) -> None:
    result = turbopi("demo", "--episodes", 21, "--report", tmp_path)
    assert result.exit_code == 2 and "plays 20 at most" in " ".join(result.stderr.split())


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (("--episodes", "0"), "--real-time plays episodes, and --episodes is 0"),
        (("--frames", "2"), "--frames is for images of LIBERO"),
    ],
)
def test_the_real_time_demo_refuses_what_it_would_ignore(options: tuple[str, str], why: str, tmp_path: Path) -> None:
    assert why in refusal(turbopi("demo", "--real-time", *options, "--report", tmp_path))
