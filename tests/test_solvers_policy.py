"""Solvers and time grids as options: of a policy, a call, turbopi.json and the command line."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cli_helpers import refusal, turbopi
from policy_helpers import policy_on
from test_begin import Unrun

from turbopi import UnifiedPolicy
from turbopi.backends.pytorch import PyTorchBackend
from turbopi.checkpoint import open_checkpoint, random_checkpoint
from turbopi.checkpoint.convert import convert
from turbopi.evaluate.sources import LocalPolicy
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning, Guidance, TokenTimes, guidance_strength, guidance_weights
from turbopi.models.pi0.solvers import SOLVERS, Integration
from turbopi.realtime.running_chunk import RunningChunk
from turbopi.support.errors import ConfigError, ObservationError

pytestmark = pytest.mark.usefixtures("two_layers")

UNEVEN = (1.0, 0.7, 0.2, 0.0)


@pytest.fixture(scope="module")
def tiny() -> Any:
    return random_checkpoint("pi05_tiny")


def made(tiny: Any, **options: Any) -> UnifiedPolicy:
    return UnifiedPolicy(tiny, **{"backend": "pytorch", "precision": "f32", "device": "cpu"} | options)


@pytest.fixture(scope="module")
def policy(tiny: Any) -> UnifiedPolicy:
    return made(tiny)


def test_a_policys_solver_is_a_calls_and_the_backends(tiny: Any, policy: UnifiedPolicy) -> None:
    observation = policy.example_observation()
    own = made(tiny, num_denoising_steps=3, solver="exponential", time_grid="shifted_to_actions")
    reported = {"num_denoising_steps": 3, "solver": "exponential", "time_grid": "shifted_to_actions"}
    assert reported.items() <= own.metadata.items()
    requested: dict[str, Any] = {"num_steps": 3, "solver": "exponential", "time_grid": "shifted_to_actions"}
    expected = policy.infer(observation, seed=0, **requested)["actions"]
    np.testing.assert_array_equal(own.infer(observation, seed=0)["actions"], expected)
    (both, _) = own.infer_batch([observation, observation], seed=0)
    np.testing.assert_allclose(both["actions"], expected, rtol=0, atol=1e-4)
    euler = own.infer(observation, seed=0, solver="euler", time_grid="uniform")["actions"]
    np.testing.assert_array_equal(euler, policy.infer(observation, seed=0, num_steps=3)["actions"])
    assert np.abs(euler - expected).max() > 1e-3
    x_1 = torch.from_numpy(np.random.default_rng(0).standard_normal((1, 10, 32), dtype=np.float32))
    inputs = Observation.stack([own.prepare(observation)])
    sample = own.backend.sample(inputs, x_1, 3, **own.loop_arguments)
    np.testing.assert_array_equal(own.pipeline.after(sample.actions[0].numpy(), np.zeros(8))["actions"], expected)
    assert policy.loop_arguments == {}


@pytest.mark.slow
def test_eulers_uniform_steps_by_name_and_one_evaluation_of_any_solver_are_openpis_to_the_last_bit(
    policy: UnifiedPolicy,
) -> None:
    observation = policy.example_observation()
    plain = {n: policy.infer(observation, seed=0, num_steps=n)["actions"] for n in (1, 2, 10)}
    named = policy.infer(observation, seed=0, num_steps=10, solver="euler", time_grid="uniform")
    np.testing.assert_array_equal(named["actions"], plain[10])
    for solver in SOLVERS:
        one = policy.infer(observation, seed=0, num_steps=1, solver=solver, time_grid="shifted_to_noise")
        np.testing.assert_array_equal(one["actions"], plain[1])
    heun = policy.infer(observation, seed=0, num_steps=2, solver="heun")
    np.testing.assert_array_equal(heun["actions"], plain[2])


@pytest.mark.slow
def test_times_bring_their_number_of_steps(tiny: Any, policy: UnifiedPolicy) -> None:
    observation = policy.example_observation()
    own = made(tiny, solver="midpoint", time_grid=UNEVEN)
    assert own.metadata["num_denoising_steps"] == 6 and own.metadata["time_grid"] == pytest.approx(list(UNEVEN))
    expected = policy.infer(observation, seed=0, num_steps=6, solver="midpoint", time_grid=UNEVEN)["actions"]
    np.testing.assert_array_equal(own.infer(observation, seed=0)["actions"], expected)
    fewer = own.infer(observation, seed=0, num_steps=5)["actions"]  # the last interval is one Euler step
    assert np.abs(fewer - expected).max() > 0
    np.testing.assert_array_equal(
        own.infer(observation, seed=0, num_steps=2, solver="euler", time_grid="uniform")["actions"],
        policy.infer(observation, seed=0, num_steps=2)["actions"],
    )
    with pytest.raises(ObservationError, match=r"10 steps of solver 'midpoint' are 5 intervals.* has 3: give 6 steps"):
        own.infer(observation, num_steps=10)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"solver": "rk4"}, "the solver is 'rk4'; it should be one of euler"),
        ({"time_grid": "cosine"}, "the time grid is 'cosine'; it should be one of uniform, shifted_to_noise"),
        ({"time_grid": [1.0, 0.2, 0.5, 0.0]}, "fall strictly"),
        ({"time_grid": [0.6, 0.2, 0.0]}, "begins at 0.6; it should begin at 1"),
        ({"time_grid": [1.0]}, "2 to 1001 times"),
        ({"time_grid": UNEVEN, "num_denoising_steps": 5}, r"5 steps of solver 'euler' are 5 intervals.* has 3"),
    ],
)
def test_what_can_be_no_solver_or_grid_is_refused_before_weights_are_read(
    tiny: Any, options: Any, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        made(tiny, **options)


def test_a_backend_without_solvers_refuses_when_the_policy_is_made_or_called(
    tiny: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = made(tiny)
    monkeypatch.setattr(PyTorchBackend, "forms", ())
    message = "backend 'pytorch' takes Euler's steps on the uniform grid alone; take solver 'euler'"
    with pytest.raises(ObservationError, match=message):
        policy.infer(policy.example_observation(), solver="ab2")
    with pytest.raises(ConfigError, match=message):
        made(tiny, time_grid=UNEVEN)
    assert made(tiny, solver="ab2", num_denoising_steps=1).metadata["solver"] == "ab2"


def test_the_other_backends_have_no_solvers() -> None:
    from turbopi.backends.onnx.backend import OnnxBackend
    from turbopi.backends.pytorch_compile import PyTorchCompileBackend
    from turbopi.backends.tensorrt.backend import TensorRTBackend

    for backend in (OnnxBackend, PyTorchCompileBackend, TensorRTBackend):
        assert "solver" not in getattr(backend, "forms", ())


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["rtc", "rtc_identity"])
def test_chunks_join_by_eulers_steps_on_any_grid_and_other_solvers_refuse(
    tiny: Any, policy: UnifiedPolicy, mode: Any
) -> None:
    observation, left_over = policy.example_observation(), np.ones((8, 32), np.float32)
    previous = RunningChunk(left_over, delay=2, execution_horizon=3, mode=mode)
    own = made(tiny, time_grid=UNEVEN)
    found = own.infer(observation, seed=0, previous=previous)["actions"]
    times = TokenTimes.of(np.repeat(np.array(UNEVEN)[:, None], 10, axis=1))
    target = np.concatenate((left_over, np.zeros((2, 32), np.float32)))
    pull = Guidance(
        target,
        guidance_weights(10, 2, 3),
        guidance_strength(times.times, 5.0),
        "jacobian" if mode == "rtc" else "identity",
    )
    by_hand = policy.infer(observation, seed=0, conditioning=Conditioning(times, guidance=pull))
    np.testing.assert_array_equal(found, by_hand["actions"])
    ab2 = made(tiny, solver="ab2")
    assert ab2.metadata["real_time"]["modes"] == ["warm_start"] and own.metadata["real_time"]["modes"]
    with pytest.raises(ObservationError, match=r"a running chunk and solver 'ab2' were both given.*solver 'euler'"):
        ab2.infer(observation, previous=previous)
    ab2.infer(observation, previous=previous, solver="euler")


def test_a_conditioning_with_times_of_its_own_contradicts_a_solver(policy: UnifiedPolicy) -> None:
    observation = policy.example_observation()
    warm = Conditioning(integration=Integration("exponential", (0.6, 0.4, 0.2, 0.0)))
    started = policy.infer(observation, seed=0, conditioning=warm)["actions"]
    whole = policy.infer(observation, seed=0, num_steps=3, solver="exponential")["actions"]
    assert np.abs(started - whole).max() > 1e-3
    with pytest.raises(ObservationError, match=r"times of its own, and this call's solver and time grid say ab2"):
        policy.infer(observation, conditioning=warm, solver="ab2")


def test_a_solvers_loop_is_warmed_up(tiny: Any) -> None:
    policy = policy_on(Unrun, tiny, solver="exponential", num_denoising_steps=3)
    engine: Any = policy.backend
    policy.warmup(cameras=2, steps=[2, 3])
    assert {str(loop) for loop in engine._graphs.loops} == {
        "H=10, 2 steps, exponential, t = 1, 0.5, 0",
        "H=10, 3 steps, exponential, t = 1, 0.667, 0.333, 0",
    }


def test_turbopi_json_has_a_solver_and_its_grid(tmp_path: Path, tiny: Any) -> None:
    file = tmp_path / "mine.json"
    file.write_text(json.dumps({"solver": "ab2", "solver_grid": [1, 0.6, 0.2, 0]}))
    opened = random_checkpoint("pi05_tiny", 0, str(file))
    policy = made(opened)
    assert policy.metadata["solver"] == "ab2" and policy.metadata["num_denoising_steps"] == 3
    assert made(opened, solver="euler", time_grid="uniform", num_denoising_steps=4).loop_arguments == {}
    file.write_text(json.dumps({"solver": "midpoint", "solver_grid": [1, 0.5, 0], "num_denoising_steps": 3}))
    assert made(random_checkpoint("pi05_tiny", 0, str(file))).metadata["num_denoising_steps"] == 3
    folder = tmp_path / "converted"
    convert(opened, folder, precision="f32")
    assert open_checkpoint(folder).config.solver == "ab2"
    assert open_checkpoint(folder).config.solver_grid == pytest.approx((1, 0.6, 0.2, 0))
    for values, expected in (
        ({"solver": "rk4"}, "solver is 'rk4'; expected one of euler"),
        ({"solver_grid": [1, 2, 0]}, "solver_grid is .*; expected one of uniform"),
        ({"solver_grid": 3}, "solver_grid is 3; expected"),
    ):
        file.write_text(json.dumps(values))
        with pytest.raises(ConfigError, match=expected):
            random_checkpoint("pi05_tiny", 0, str(file))


# --- the command line -------------------------------------------------------------------------------------------------

TINY = ("--random-weights", "pi05_tiny", "--backend", "pytorch", "--precision", "f32", "--device", "cpu")


def test_infer_takes_a_solver_and_times(tmp_path: Path, policy: UnifiedPolicy) -> None:
    np.savez(tmp_path / "one.npz", **policy.example_observation())
    options = ("infer", *TINY, tmp_path / "one.npz", "-o", tmp_path / "out.npz", "--no-plot", "--no-warmup", "--json")
    result = turbopi(*options, "--seed", "0", "--solver", "ab2", "--time-grid", "1,0.7,0.2,0")
    assert result.exit_code == 0, result.output
    expected = policy.infer(policy.example_observation(), seed=0, solver="ab2", time_grid=UNEVEN)["actions"]
    np.testing.assert_allclose(np.load(tmp_path / "out.npz")["actions"], expected, rtol=0, atol=1e-5)
    assert "the solver is 'rk4'" in refusal(turbopi(*options, "--solver", "rk4"), whole=False)
    reported = refusal(turbopi(*options, "--time-grid", "1,half,0"), whole=False)
    assert "--time-grid" in reported and "isn't times with commas between them" in reported


@pytest.mark.slow
def test_verify_judges_a_solver_against_the_reference_with_the_same_one(tmp_path: Path) -> None:
    options = ("--random-weights", "pi05_tiny", "--backend", "pytorch", "--device", "cpu", "--count", "1")
    result = turbopi("verify", *options, "--noises", "1", "--steps", "3", "--solver", "exponential", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["policy"]["solver"] == "exponential" and "3 steps of exponential" in result.output


@pytest.mark.slow
def test_bench_measures_a_solver_and_says_so(tmp_path: Path) -> None:
    options = ("bench", "--random-weights", "pi05_tiny", "--backends", "pytorch", "--device", "cpu", "--calls", "2")
    more = ("--no-error", "--report", tmp_path, "--time-grid", "1,0.5,0")
    result = turbopi(*options, *more, "--solver", "midpoint")
    assert result.exit_code == 0, result.output
    document = json.loads((tmp_path / "results.json").read_text())
    assert document["solver"] == "midpoint" and document["main_job"]["steps"] == 4
    assert document["results"][0]["milliseconds"]["denoise"]["p50"] > 0
    assert "Solver midpoint." in (tmp_path / "report.md").read_text()
    assert "--join without --solver" in refusal(
        turbopi(*options, "--solver", "ab2", "--join", "held", "--json"), whole=False
    )


def test_an_evaluation_with_another_solver_is_another_policy(tiny: Any, policy: UnifiedPolicy) -> None:
    plain, other = LocalPolicy(policy), LocalPolicy(made(tiny, solver="ab2", num_denoising_steps=3))
    assert "solver" not in plain.identity and plain.label == "pytorch f32 10 steps"
    assert other.identity["solver"] == "ab2" and other.label == "pytorch f32 3 steps of ab2"
