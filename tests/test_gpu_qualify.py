"""A GPU that is said to be unknown qualifies itself, and survives every planted fault: tests/qualify_faults.py."""

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import qualify_faults
import torch

from turbopi import UnifiedPolicy
from turbopi.backends import qualification, qualifying
from turbopi.backends.qualification import DENOISE, Verdict
from turbopi.backends.qualifying import STAGES, qualify
from turbopi.checkpoint import Checkpoint
from turbopi.checkpoint.random_weights import random_checkpoint
from turbopi.config import PRESETS, PolicyConfig
from turbopi.kernels.grid_barrier import check_barrier
from turbopi.kernels.ops import hopper_kernels
from turbopi.models import RANDOM
from turbopi.qualify.stages import shallow

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU"),
    pytest.mark.filterwarnings("default"),  # Inductor warns of what it does
]
GPU = torch.device("cuda", 0)
TIMES_UP_NEVER = 600.0  # seconds: the tests' machine may compile for others at the same time
EXCLUDED = {"wrong_tile": "vision_attention", "hangs": DENOISE}  # by planted fault


def few_layers(base: PolicyConfig, **sizes: Any) -> Checkpoint:
    """Random weights of a model's sizes, but for the depth."""
    config = dataclasses.replace(base, model=shallow(base.model))
    return random_checkpoint(config.with_model(**sizes) if sizes else config)


@pytest.fixture
def unknown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> pytest.MonkeyPatch:
    monkeypatch.setenv(qualification.UNKNOWN_VARIABLE, "1")
    monkeypatch.setenv(qualifying.DOUBLE_VARIABLE, qualify_faults.__name__)
    paths = [str(Path(__file__).parent), str(Path(qualification.__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(qualifying, "SECONDS", TIMES_UP_NEVER)
    return monkeypatch


def verdict_of(policy: UnifiedPolicy) -> Verdict:
    verdict = qualification.verdict_of(GPU, policy.backend.precision, policy.config.model)
    assert verdict is not None
    print(verdict.summary, verdict.seconds, [(one.name, one.seconds, one.figures) for one in verdict.stages])
    return verdict


def is_right(policy: UnifiedPolicy, checkpoint: Checkpoint) -> bool:
    observation = policy.example_observation(3)
    exact = UnifiedPolicy(checkpoint, backend="pytorch", precision="f32").infer(observation, seed=1)["actions"]
    error = policy.infer(observation, seed=1)["actions"] - exact
    return bool(np.sqrt(np.square(error).mean() / np.square(exact).mean()) < 0.05)


@pytest.mark.parametrize(
    ("name", "kernels"),
    [("pi05_base", "portable"), ("smolvla_base", "auto")],
)
def test_on_a_sound_gpu_nothing_is_found_wrong(name: str, kernels: str, unknown: pytest.MonkeyPatch) -> None:
    unknown.setenv("TURBOPI_KERNELS", kernels)
    checkpoint = few_layers(RANDOM[name])
    policy = UnifiedPolicy(checkpoint)
    verdict = verdict_of(policy)
    assert (verdict.excluded, verdict.failed) == ({}, False) and verdict.reason.startswith("right; fused ")
    assert verdict.kernels == ("hopper" if hopper_kernels(GPU) else "portable")
    assert policy.metadata["backend"] == verdict.taken and is_right(policy, checkpoint)
    golden = [STAGES[3]] if name != "smolvla_base" else []  # no small SmolVLA ships
    assert [one.name for one in verdict.stages] == [*STAGES[:3], *golden, STAGES[4]]


@pytest.mark.parametrize("fault", list(qualify_faults.FAULTS))
def test_every_planted_fault_ends_in_a_policy_that_works(
    fault: str, unknown: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    unknown.setenv(qualify_faults.VARIABLE, fault)
    unknown.setenv("TURBOPI_KERNELS", "portable")
    checkpoint = few_layers(PRESETS["pi05_base"], vocab_size=1024, action_horizon=10)
    policy = UnifiedPolicy(checkpoint)
    verdict = verdict_of(policy)
    if fault in EXCLUDED:
        assert set(verdict.excluded) == {EXCLUDED[fault]} and verdict.taken is not None and not verdict.failed
        assert "attach the file that `turbopi doctor --qualify` wrote" in caplog.text
        if verdict.taken == "fused":
            assert policy.metadata["backend_details"]["excluded"] == verdict.excluded
    else:
        assert (verdict.taken, verdict.failed) == ("cuda_graph", False) and "memory isn't enough" in verdict.reason
    assert policy.metadata["backend"] == verdict.taken and is_right(policy, checkpoint)


def test_fp8_is_qualified_without_a_rival(unknown: pytest.MonkeyPatch) -> None:
    model = few_layers(PRESETS["pi05_base"], vocab_size=1024, action_horizon=10).config.model
    verdict = qualify(GPU, "fp8", model)
    print(verdict)
    assert (verdict.taken, verdict.failed, verdict.excluded) == ("fused", False, {}) and "fused" in verdict.milliseconds


def test_the_grids_barrier_holds_and_one_that_waits_in_vain_gives_up() -> None:
    assert check_barrier(GPU) is None
    assert "waited for the others in vain" in str(check_barrier(GPU, rounds=3, missing=1))
    assert check_barrier(GPU) is None, "the GPU goes on"
