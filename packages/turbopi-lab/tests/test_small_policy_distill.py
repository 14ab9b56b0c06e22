"""Distillation of a toy policy: what a student is taught, and that what comes out is an ordinary checkpoint."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from turbopi import UnifiedPolicy
from turbopi.checkpoint import open_checkpoint
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.reference import Pi0Model, Trace
from turbopi.policy.shipped import CHASE_POLICY
from turbopi_lab.small_policy import distill
from turbopi_lab.small_policy.distill import Settings, Student, Ways, teach
from turbopi_lab.small_policy.forward import suffix_velocity
from turbopi_lab.small_policy.start import trained_model

pytestmark = pytest.mark.slow


def settings(**changes: Any) -> Settings:
    return Settings(CHASE_POLICY, Path("nowhere"), **{"observations": 3, "noises": 2, "batch": 8} | changes)


@pytest.fixture(scope="module")
def teacher() -> Pi0Model:
    return trained_model(open_checkpoint(CHASE_POLICY).config.planned_model, CHASE_POLICY).requires_grad_(False)


@pytest.fixture(scope="module")
def ways(teacher: Pi0Model) -> Ways:
    torch.manual_seed(0)
    with torch.no_grad():
        return teach(teacher, settings(), of_post=False)


def test_ways_are_the_teachers_own_from_each_noise_to_its_actions(teacher: Pi0Model, ways: Ways) -> None:
    length = ways.k.shape[3]
    for m in range(2):
        cache = KVCache(ways.k, ways.v, None, torch.full((3,), length), torch.zeros(3, 32))
        trace: Trace = {}
        teacher.denoise(cache, ways.noise[:, m], 10, trace=trace)
        torch.testing.assert_close(ways.actions[:, m], trace["actions"], rtol=1e-5, atol=1e-5)
        for row in range(3):
            (at,) = torch.nonzero(torch.isclose(trace["times"], ways.t[row, m])).flatten().tolist()
            torch.testing.assert_close(ways.between[row, m], trace["x_t"][at, row], rtol=1e-5, atol=1e-5)
            assert 0 < at < 10


def test_a_suffixs_velocity_with_gradients_is_the_references(teacher: Pi0Model, ways: Ways) -> None:
    cache = KVCache(ways.k, ways.v, None, torch.full((3,), ways.k.shape[3]), torch.zeros(3, 32))
    trace: Trace = {}
    teacher.denoise(cache, ways.noise[:, 0], 1, trace=trace)
    found = suffix_velocity(teacher, ways.k, ways.v, ways.noise[:, 0], torch.ones(3))
    torch.testing.assert_close(found, trace["v_t"][0], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("recipe", ["consistency", "shuffled", "mean"])
def test_a_student_learns_its_recipes_targets(
    recipe: Any, teacher: Pi0Model, ways: Ways, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At noise x − v is compared with the pair's actions, another noise's, or the mean; on the way with the pair's."""
    requested: list[tuple[torch.Tensor, torch.Tensor]] = []

    def exact(model: Any, k: torch.Tensor, v: torch.Tensor, x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        requested.append((x, t))
        reached = torch.stack([_target(ways, recipe, one, float(time)) for one, time in zip(x, t, strict=True)])
        return ((x - reached) / t[:, None, None]).requires_grad_()

    monkeypatch.setattr(distill, "suffix_velocity", exact)
    student = Student(trained_model(teacher.config, CHASE_POLICY), settings(recipe=recipe))
    monkeypatch.setattr(student, "_learn", lambda loss, progress: None)
    torch.manual_seed(1)
    assert student.step(ways, 0.0) == pytest.approx(0, abs=1e-9)
    times = requested[0][1]
    assert (times[:4] == 1).all() and (times[4:] < 1).all()


def _target(ways: Ways, recipe: str, x: torch.Tensor, t: float) -> torch.Tensor:
    """What x should lead to, of two noises for each observation."""
    points = ways.noise if t == 1 else ways.between
    ((row, which),) = [
        (n, m) for n in range(3) for m in range(2) if torch.equal(points[n, m], x) and (t == 1 or ways.t[n, m] == t)
    ]
    if t < 1 or recipe == "consistency":
        return ways.actions[row, which]
    return ways.actions[row, 1 - which] if recipe == "shuffled" else ways.actions[row].mean(0)


def test_what_is_distilled_is_a_checkpoint_of_one_step_whose_expert_alone_has_changed(tmp_path: Path) -> None:
    distill.train(Settings(CHASE_POLICY, tmp_path, steps=2, observations=4, noises=2, batch=4))
    policy = UnifiedPolicy(tmp_path / "checkpoint", backend="pytorch", precision="f32", device="cpu")
    assert policy.metadata["num_denoising_steps"] == 1 and policy.metadata["real_time"]["trained_max_delay"] == 0
    actions = policy.infer(policy.example_observation(), seed=0)["actions"]
    assert np.isfinite(actions).all()
    before, after = (
        open_checkpoint(folder).load(torch.device("cpu"), "f32").state
        for folder in (CHASE_POLICY, tmp_path / "checkpoint")
    )
    changed = {name for name in before if not torch.equal(before[name].bfloat16(), after[name].bfloat16())}
    assert changed and all(name.startswith(("expert.", "action_", "time_mlp_")) for name in changed)


def test_an_unknown_recipe_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="--recipe is magic; choose of consistency, shuffled, mean"):
        distill.train(settings(recipe="magic"))
