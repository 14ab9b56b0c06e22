"""The benchmark: its floors are counted right, its calls are fresh, its document is complete."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from turbopi.bench.floors import Floors
from turbopi.bench.measure import Latency, Observations, bench_policy, error_against
from turbopi.bench.run import stage_floors
from turbopi.bench.work import Job, Work, floor_ms, stage_work
from turbopi.checkpoint import random_checkpoint
from turbopi.cli import app
from turbopi.config import ModelConfig
from turbopi.errors import ConfigError
from turbopi.policy import UnifiedPolicy

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def policy() -> UnifiedPolicy:
    return bench_policy(random_checkpoint("pi05_tiny"), "pytorch", "f32", CPU, Job(steps=1))


def test_the_full_size_needs_the_published_work() -> None:
    """0.44 + 2.14 TFLOP and about 6.2 GB of expert weights for 2 cameras, 48 tokens, 10 steps."""
    work = stage_work(ModelConfig(), Job(), bytes_per_value=2)
    assert work["vision"].flops == pytest.approx(0.44e12, rel=0.01)
    assert work["prefix"].flops == pytest.approx(2.14e12, rel=0.01)
    assert work["denoise"].bytes == pytest.approx(6.2e9, rel=0.03)


def test_work_grows_with_the_job() -> None:
    base = stage_work(ModelConfig(), Job(), 2)
    assert stage_work(ModelConfig(), Job(cameras=3), 2)["vision"].flops == pytest.approx(1.5 * base["vision"].flops)
    assert stage_work(ModelConfig(), Job(steps=5), 2)["denoise"].bytes == pytest.approx(base["denoise"].bytes / 2)
    assert stage_work(ModelConfig(), Job(prompt_tokens=200), 2)["prefix"].flops > base["prefix"].flops
    assert stage_work(ModelConfig(), Job(), 4)["prefix"].bytes == 2 * base["prefix"].bytes


def test_the_floor_is_the_larger_of_arithmetic_and_memory() -> None:
    assert floor_ms(Work(flops=2e12, bytes=1e9), 1e15, 1e12) == pytest.approx(2.0)
    assert floor_ms(Work(flops=1e12, bytes=3e9), 1e15, 1e12) == pytest.approx(3.0)


def test_stage_floors_add_up(policy: UnifiedPolicy) -> None:
    floors = stage_floors(policy, Job(), Floors(1e10, 1e11, None))
    assert floors["total"] == pytest.approx(floors["vision"] + floors["prefix"] + floors["denoise"])


@pytest.mark.parametrize("tokens", [7, 48, 199])
def test_prompts_have_exactly_the_tokens_asked_for(policy: UnifiedPolicy, tokens: int) -> None:
    observations = Observations(policy, Job(prompt_tokens=tokens))
    for _ in range(3):
        assert policy.prepare(next(observations)).token_mask.sum() == tokens


def test_every_observation_is_new_and_has_the_cameras_asked_for(policy: UnifiedPolicy) -> None:
    observations = Observations(policy, Job(cameras=1))
    first, second = next(observations), next(observations)
    assert first["prompt"] != second["prompt"]
    assert not np.array_equal(first["images"]["base_0_rgb"], second["images"]["base_0_rgb"])
    assert policy.prepare(first).image_mask.tolist() == [True, False, False]


def test_an_impossible_number_of_cameras_is_refused(policy: UnifiedPolicy) -> None:
    with pytest.raises(ConfigError, match="1 to 3 cameras, not 4"):
        Observations(policy, Job(cameras=4))


def test_percentiles() -> None:
    latency = Latency.of([float(value) for value in range(1, 101)])
    assert latency.calls == 100
    assert latency.median == pytest.approx(50.5)
    assert latency.percentiles[99] == pytest.approx(99.01)


def test_the_oracle_has_no_error_against_itself(policy: UnifiedPolicy) -> None:
    assert error_against(policy, policy, Job(steps=1), observations=1)["max"] == 0
    rounded = bench_policy(random_checkpoint("pi05_tiny"), "pytorch", "bf16", CPU, Job(steps=1))
    assert 1e-4 < error_against(rounded, policy, Job(steps=1), observations=1)["relative_rms"] < 0.1


def test_the_command_writes_a_complete_document(tmp_path: Path) -> None:
    options = "--random-weights pi05_tiny --calls 2 --steps 1,2 --cameras 1 --device cpu --profile --json"
    result = CliRunner().invoke(app, ["bench", *options.split(), "--report", str(tmp_path)])
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["random_weights"] is True
    assert document["provenance"]["commit"]
    assert [one["job"]["steps"] for one in document["results"]] == [1, 2]
    for one in document["results"]:
        times = one["milliseconds"]
        assert one["calls"] == 2
        assert times["device"]["p50"] <= times["infer"]["p50"] <= times["total"]["p50"]
        assert one["times_floor"] == pytest.approx(times["total"]["p50"] / one["floor_ms"]["total"])
        assert 1e-4 < one["error_against_f32"]["relative_rms"] < 0.1
    assert document["profile"][0]["kernels"][0]["ms_per_call"] > 0
    assert json.loads((tmp_path / "results.json").read_text())["floors"] == document["floors"]
    assert (tmp_path / "stages.png").stat().st_size > 5000
    assert (tmp_path / "steps.png").stat().st_size > 5000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--steps", "1,many"], "--steps is '1,many'"),
        (["--horizons", "0"], "--horizons has 0"),
        (["--backends", "warp"], "unknown backend 'warp'"),
        (["--precisions", "fp7"], "unknown precision 'fp7'"),
    ],
)
def test_wrong_options_are_refused(arguments: list[str], message: str) -> None:
    result = CliRunner().invoke(app, ["bench", "--random-weights", "pi05_tiny", "--device", "cpu", *arguments])
    assert result.exit_code == 2
    assert message in result.output
