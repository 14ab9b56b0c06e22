"""What warm-up covers, that a strict policy refuses the rest, and a horizon for one call: on a CPU, without graphs."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from conftest import golden_model
from policy_helpers import policy_on
from test_begin import CPU, Unrun, on_cpu
from test_engine import made_up

from turbopi import UnifiedPolicy, backends
from turbopi.backends import pytorch_compile
from turbopi.backends.pytorch_compile import PyTorchCompileBackend
from turbopi.checkpoint import random_checkpoint
from turbopi.config import CAMERAS, LIMITS
from turbopi.engine.runner import HostRow
from turbopi.models.observation import Observation, with_cameras
from turbopi.robots import ROBOTS, LeRobot, Robot, create_robot
from turbopi.robots.described import Described
from turbopi.support.errors import BackendError, BackendUnavailable, ConfigError, ObservationError

pytestmark = pytest.mark.usefixtures("two_layers")

H = 10


def captures(policy: UnifiedPolicy) -> set[Any]:
    """The graphs that there are."""
    return set(policy.backend._graphs.entries)  # type: ignore[attr-defined]


def made(*, strict: bool = False, robot: str = "plain", cls: Any = Unrun) -> UnifiedPolicy:
    """A policy whose backend captures: `plain` sends one camera, two or three."""
    return policy_on(cls, random_checkpoint("pi05_tiny"), num_denoising_steps=2, robot=robot, strict=strict)


def seen_by(cameras: int, policy: UnifiedPolicy, prompt: str = "pick") -> dict[str, Any]:
    example = policy.example_observation()
    return {**example, "images": {name: example["images"][name] for name in CAMERAS[:cameras]}, "prompt": prompt}


@pytest.fixture(scope="module")
def reference() -> UnifiedPolicy:
    return UnifiedPolicy(
        random_checkpoint("pi05_tiny"), backend="pytorch", device="cpu", precision="f32", robot="plain"
    )


def test_nothing_is_captured_behind_warmup_whichever_cameras_the_robot_sends() -> None:
    policy = made()
    policy.warmup()
    before = captures(policy)
    assert before
    for cameras in (1, 2, 3):
        for prompt in ("pick", "pick up the black bowl " * 5):
            policy.infer(seen_by(cameras, policy, prompt), seed=0)
    assert captures(policy) == before


def test_warmup_covers_all_pairs_of_what_it_is_given() -> None:
    policy = made()
    policy.warmup(cameras=[1, 2], horizons=(6, 8), steps=range(1, 3))
    before = captures(policy)
    for cameras in (1, 2):
        for horizon in (6, 8):
            for steps in (1, 2):
                policy.infer(seen_by(cameras, policy), seed=0, horizon=horizon, num_steps=steps)
    assert captures(policy) == before
    policy.infer(seen_by(3, policy), seed=0)
    assert captures(policy) > before


def test_earlier_warmups_stay() -> None:
    policy = made(strict=True)
    for cameras in (1, 3):
        policy.warmup(cameras=cameras)
    for cameras in (1, 3):
        policy.infer(seen_by(cameras, policy), seed=0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"cameras": 0}, "the number of cameras is 0"),
        ({"cameras": [1, 2.5]}, "the number of cameras is 2.5"),
        ({"cameras": "two"}, "the number of cameras is 'two'"),
        ({"cameras": [[1]]}, r"the number of cameras is \[1\]"),
        ({"cameras": []}, "cameras is an empty list"),
        ({"horizons": 0}, "the action horizon is 0"),
        ({"horizons": 10**18}, "the action horizon is 1000000000000000000; .* from 1 to 1000"),
        ({"steps": True}, "the number of denoising steps is True"),
        ({"steps": range(1, 10)}, "9 pairs of steps and horizon, 45 steps together; backends keep graphs of 8 pairs"),
        ({"steps": [1000, 500]}, "2 pairs of steps and horizon, 1500 steps together; .* 1024 steps"),
    ],
)
def test_a_warmup_that_cant_be_is_refused_before_anything_is_captured(wrong: dict[str, Any], message: str) -> None:
    policy = made()
    with pytest.raises(ConfigError, match=message):
        policy.warmup(**wrong)
    assert not captures(policy)


def test_more_cameras_than_the_backend_takes_are_refused_if_asked_for_and_else_left_out() -> None:
    policy = made()
    with pytest.raises(ObservationError, match="up to 4 cameras, this observation has 5"):
        policy.warmup(cameras=5)
    inputs = policy.prepare(policy.example_observation())
    backend: Any = policy.backend
    backend.warmup(Observation.stack([with_cameras(inputs, 5)]), 2, required=False)
    assert not captures(policy)


# -- strict ------------------------------------------------------------------------------------------------------------


def test_a_strict_policy_refuses_what_warmup_didnt_cover_and_says_what_to_do() -> None:
    policy = made(strict=True)
    with pytest.raises(ObservationError, match=r"Warm is: nothing yet\. Call policy\.warmup\(cameras=2\)"):
        policy.infer(seen_by(2, policy), seed=0)
    policy.warmup(cameras=2)
    before = captures(policy)
    policy.infer(seen_by(2, policy), seed=0)
    with pytest.raises(ObservationError, match=r"needs 3 cameras, .* Warm is: 2 cameras\. .*warmup\(cameras=3\)"):
        policy.infer(seen_by(3, policy), seed=0)
    reported = r"needs 2 cameras, H=10, 5 steps, .*'cuda_graph'.* Warm is: 2 cameras, H=10, 2 steps\."
    with pytest.raises(ObservationError, match=reported + r".*warmup\(cameras=2, horizons=10, steps=5\)"):
        policy.infer(seen_by(2, policy), seed=0, num_steps=5)
    with pytest.raises(ObservationError, match=r"needs 2 cameras, H=6, 2 steps"):
        policy.infer(seen_by(2, policy), seed=0, horizon=6)
    with pytest.raises(ObservationError, match=r"needs 3 cameras"):
        policy.infer_batch([seen_by(2, policy), seen_by(3, policy)])
    assert captures(policy) == before
    expected = policy.infer(seen_by(2, policy), seed=0)["actions"]
    policy.warmup(cameras=2, horizons=10, steps=5)
    policy.infer(seen_by(2, policy), seed=0, num_steps=5)
    np.testing.assert_array_equal(policy.infer(seen_by(2, policy), seed=0)["actions"], expected)


def test_strict_is_an_option_of_the_policy_and_in_its_metadata() -> None:
    policy = UnifiedPolicy(random_checkpoint("pi05_tiny"), device="cpu", strict=True)
    assert policy.backend.strict and policy.metadata["strict"] is True
    policy.infer(policy.example_observation(), seed=0, num_steps=1)  # the eager reference prepares nothing
    assert UnifiedPolicy(random_checkpoint("pi05_tiny"), device="cpu").metadata["strict"] is False


def test_a_strict_compiler_compiles_nothing_in_a_call(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "compile", lambda function, **options: function)
    policy = made(strict=True, cls=PyTorchCompileBackend)
    with pytest.raises(
        ObservationError, match=r"needs 2 cameras, H=10, .* Warm is: nothing yet.*cameras=2, horizons=10"
    ):
        policy.infer(seen_by(2, policy), seed=0)
    policy.warmup(cameras=[1, 2])
    policy.infer(seen_by(2, policy), seed=0, num_steps=1)  # steps compile nothing
    with pytest.raises(ObservationError, match=r"needs 3 cameras, H=10, .* Warm is: 1 cameras, H=10; 2 cameras, H=10"):
        policy.infer(seen_by(3, policy), seed=0)
    with pytest.raises(ObservationError, match=r"needs batch 2, 2 cameras, H=10.* one by one"):
        policy.infer_batch([seen_by(2, policy)] * 2)
    assert policy.metadata["backend_details"]["compiled_for"] == ["1 cameras, H=10", "2 cameras, H=10"]


def test_a_stage_never_runs_without_being_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """PyTorch by itself runs a function as it is once it has been compiled for 8 shapes, and behind a graph break."""
    came: list[Any] = []
    compile = torch.compile

    def note(graph: Any, inputs: Any, options: dict[str, Any]) -> Any:
        assert options == {"comprehensive_padding": False}
        came.append(graph)
        return graph.forward

    def stage(x: torch.Tensor) -> torch.Tensor:
        return x + 1

    def broken(x: torch.Tensor) -> torch.Tensor:
        torch._dynamo.graph_break()
        return x + 1

    monkeypatch.setattr(torch, "compile", lambda function, **options: compile(function, backend=note, **options))
    monkeypatch.setattr(pytorch_compile, "MOST_VARIANTS", 12)
    call = pytorch_compile.compiled(stage, dynamic=False)
    for size in range(2, 14):
        assert call(torch.zeros(size)).shape == (size,) and len(came) == size - 1
    call(torch.zeros(5))
    assert len(came) == 12
    with pytest.raises(BackendError, match="has compiled stage for 12 batch sizes"):
        call(torch.zeros(14))
    with pytest.raises(torch._dynamo.exc.Unsupported):
        pytorch_compile.compiled(broken)(torch.zeros(2))


def test_pixels_of_another_kind_are_another_shape() -> None:
    cameras, tokens = torch.ones(1, 2, dtype=torch.bool), torch.ones(1, 4, dtype=torch.int64)
    images = torch.zeros(1, 2, 8, 8, 3, dtype=torch.uint8)
    observation = Observation(images, cameras, tokens, tokens.bool(), torch.zeros(1, 32))
    floats = dataclasses.replace(observation, images=images.float())
    warm, other = (pytorch_compile.Compiled.of(one, H) for one in (observation, floats))
    assert warm != other and (str(warm), str(other)) == ("2 cameras, H=10", "2 cameras of float32 pixels, H=10")


@pytest.mark.parametrize("variable", ["TORCH_COMPILE_DISABLE", "TORCHDYNAMO_DISABLE"])
def test_a_compiler_that_is_switched_off_is_unavailable(variable: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(variable, "1")
    assert "unset TORCH_COMPILE_DISABLE and TORCHDYNAMO_DISABLE" in str(PyTorchCompileBackend.unavailable(CPU))
    monkeypatch.delenv(variable)
    with torch._dynamo.config.patch(disable=True), pytest.raises(BackendUnavailable, match="switched off"):
        made(cls=PyTorchCompileBackend)


# -- a horizon for one call --------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("horizon", [1, 6, 16])
def test_a_call_may_have_a_horizon_of_its_own(horizon: int, reference: UnifiedPolicy) -> None:
    policy, obs = made(), seen_by(2, reference)
    result = policy.infer(obs, seed=3, horizon=horizon)["actions"]
    assert result.shape == (horizon, 32)
    noise = np.random.default_rng(3).standard_normal((horizon, 32), dtype=np.float32)
    expected = reference.infer(obs, noise=noise, num_steps=2, horizon=horizon)["actions"]
    np.testing.assert_allclose(result, expected, rtol=0, atol=2e-5)
    both = policy.infer_batch([obs, obs], seed=3, horizon=horizon)
    np.testing.assert_allclose(both[0]["actions"], result, rtol=0, atol=2e-5)
    np.testing.assert_array_equal(
        policy.submit(obs, seed=3, horizon=horizon, serially=True).result()["actions"], result
    )
    assert policy.infer(obs, seed=3)["actions"].shape == (H, 32)


@pytest.mark.parametrize("horizon", [0, -1, 2.5, True, "10", 1001, 10**18])
def test_a_wrong_horizon_is_refused(reference: UnifiedPolicy, horizon: Any) -> None:
    with pytest.raises(ObservationError, match=r"the action horizon is .*whole number from 1 to 1000"):
        reference.infer(reference.example_observation(), horizon=horizon)


def test_noise_must_have_the_calls_horizon(reference: UnifiedPolicy) -> None:
    with pytest.raises(ObservationError, match=r"noise has shape \[10, 32\], but this policy needs \[6, 32\]"):
        reference.infer(reference.example_observation(), noise=np.zeros((H, 32), np.float32), horizon=6)


def test_every_horizon_fits_with_every_prompt_and_number_of_cameras() -> None:
    backend, most = on_cpu(cls=Unrun), LIMITS["action_horizon"]
    shape = (backend.config.action_dim,)
    for cameras, tokens in ((0, 1), (3, backend.config.max_prompt_tokens)):
        row = HostRow.of(made_up("pi05", cameras, tokens)[0], 0)
        for horizon in (130, most):
            sample = backend.begin(row.images).finish(row.tokens, row.state, np.zeros((horizon, *shape), np.float32), 1)
            assert sample.actions.shape == (1, horizon, *shape)
        with pytest.raises(ObservationError, match=f"the action horizon is {most + 1}; .* from 1 to {most}"):
            backend.begin(row.images).finish(row.tokens, row.state, np.zeros((most + 1, *shape), np.float32), 1)


def test_a_backend_with_engines_for_one_horizon_refuses_another(
    reference: UnifiedPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert {name for name in backends.BACKENDS if not backends.class_of(name).any_horizon} == {
        name for name in backends.BACKENDS if name.startswith("tensorrt")
    }
    monkeypatch.setattr(type(reference.backend), "any_horizon", False)
    reported = "backend 'pytorch' has engines for the config's action horizon of 10, not for 6"
    with pytest.raises(ObservationError, match=reported):
        reference.infer(reference.example_observation(), horizon=6)
    with pytest.raises(ConfigError, match=reported):
        reference.warmup(horizons=[10, 6])
    assert reference.infer(reference.example_observation(), horizon=10, num_steps=1)["actions"].shape == (10, 32)


# -- what robots send --------------------------------------------------------------------------------------------------


def built_in() -> list[Robot]:
    keys = [f"observation.images.{name}" for name in ("top", "left", "right")]
    cameras = {"front": "base_0_rgb", "wrist": "left_wrist_0_rgb"}
    named = [create_robot(name) for name in ROBOTS if name != "lerobot"]
    return [*named, LeRobot(keys, 6, 6), Described("arm", cameras, {"joints": 6}, 6)]


@pytest.mark.parametrize("robot", built_in(), ids=lambda robot: robot.name)
def test_robots_say_how_many_cameras_they_may_send(robot: Robot) -> None:
    """Exactly those with which an observation is accepted: its cameras are left out one after the other."""
    observation, accepted = robot.example(np.random.default_rng(0)), set[int]()
    flat = [key for key, value in observation.items() if getattr(value, "ndim", 0) == 3]
    for left_out in range(4):
        less = dict(observation)
        if flat:
            for key in flat[::-1][:left_out]:
                del less[key]
        else:
            less["images"] = dict(list(observation["images"].items())[: max(0, 3 - left_out)])
        try:
            accepted.add(sum(robot.inputs(less).image_mask.values()))
        except ObservationError:
            continue
    assert robot.camera_counts is not None and set(robot.camera_counts) == accepted


def test_made_up_cameras_are_the_first_ones() -> None:
    libero = made(robot="libero")
    policy_inputs = libero.prepare(libero.example_observation())
    assert policy_inputs.image_mask.tolist() == [True, True, False]
    for count in (1, 2, 3, 4):
        inputs = with_cameras(policy_inputs, count)
        assert inputs.image_mask.sum() == count and inputs.image_mask[:count].all()
        assert len(HostRow.of(Observation.stack([inputs]), 0).images) == count
        np.testing.assert_array_equal(inputs.images[:2], policy_inputs.images[:2])


def test_a_robot_that_doesnt_say_has_as_many_cameras_as_its_example() -> None:
    policy = made()
    policy._pipeline.robot = dataclasses.replace(policy._pipeline.robot)  # type: ignore[type-var]
    object.__setattr__(policy._pipeline.robot, "camera_counts", None)
    policy.warmup()
    assert {key.images for key in captures(policy)} == {3}


def test_backends_warm_up_by_themselves_for_one_observation() -> None:
    """As tools that hold a backend and no policy do."""
    backend = on_cpu(cls=Unrun)
    observation, noise = made_up("pi05", 2, 5)
    backend.warmup(observation, 2)
    before = set(backend._graphs.entries)
    backend.sample(observation, torch.randn(1, golden_model("pi05").config.action_horizon, noise.shape[2]), 2)
    assert set(backend._graphs.entries) == before
