"""The studies' arithmetic: engines as twins find the rounding that was put in, and nothing where none was."""

import json
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from cli_helpers import refusal, turbopi
from conftest import golden_cases, golden_model
from tensorrt_fakes import Reference

from turbopi import UnifiedPolicy
from turbopi.checkpoint import random_checkpoint
from turbopi.models.observation import Observation
from turbopi.support.reading import plain_document, read_document
from turbopi_lab.studies.actions import actions_study
from turbopi_lab.studies.mask import mask_study
from turbopi_lab.studies.precision import attention_study
from turbopi_lab.studies.report import Report
from turbopi_lab.studies.throughput import throughput_study

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("two_layers", "unseen_plots")]


def one() -> tuple[Observation, torch.Tensor]:
    case = golden_cases()["b_third_masked"]
    return case.observation.row(0), case.noise[:1]


def finite(value: float | None) -> float:
    assert value is not None
    return value


def test_each_style_shows_its_own_rounding() -> None:
    results = attention_study(golden_model("pi05"), *one(), 3, Reference)
    errors = {(r.attention, r.precision): r for r in results}
    assert len(errors) == 6
    for attention in ("fused", "written out"):
        f16, bf16, f32 = (finite(errors[attention, dtype].layers[-1].k_relative) for dtype in ("f16", "bf16", "f32"))
        assert f32 < 5e-6 < f16 < bf16 < 5e-2
        assert finite(errors[attention, "f32"].actions.relative) < 1e-5
        assert len(errors[attention, "f32"].layers) == golden_model("pi05").config.vlm.depth


def test_a_mask_that_is_missing_shows_and_one_that_is_there_doesnt() -> None:
    results = {(r.cache, r.steps): r for r in mask_study(golden_model("pi05"), *one(), (1, 10))}
    for steps in (1, 10):
        assert results["compacted", steps].relative == 0
        assert finite(results["padded, masked", steps].relative) < 1e-5
        assert finite(results["padded, not masked", steps].relative) > 1e-2
    assert results["padded, masked", 1].slots > results["compacted", 1].slots


def test_the_actions_study_finds_the_error_that_was_put_in() -> None:
    checkpoint = random_checkpoint("pi05_tiny")
    exact, judged = (UnifiedPolicy(checkpoint, backend="pytorch", precision=p, device="cpu") for p in ("f32", "bf16"))
    observations = {"some": [exact.example_observation(seed) for seed in range(2)]}
    (same,) = actions_study(exact, exact, observations, 2)
    approx = pytest.approx
    assert plain_document(same) == {
        "backend": "pytorch",
        "observations": "some",
        "count": 2,
        "worst_cosine": approx(1),
        "worst_relative": 0,
    }
    (found,) = actions_study(exact, judged, observations, 2)
    assert 1e-4 < finite(found.worst_relative) < 0.05 and 0.999 < finite(found.worst_cosine) < 1


class InFlight:
    """A policy's `infer` and `submit` whose answers depend on the seed, and on `wrong`."""

    def __init__(self, name: str, wrong: float = 0.0) -> None:
        self.backend, self.wrong = SimpleNamespace(name=name), wrong

    def infer(self, obs: float, *, seed: int) -> dict[str, Any]:
        return {"actions": np.array([obs + seed]), "policy_timing": {"total_ms": 2.0, "infer_ms": 1.0}}

    def submit(self, obs: float, *, seed: int) -> "Future[dict[str, Any]]":
        done: Future[dict[str, Any]] = Future()
        done.set_result({**self.infer(obs + self.wrong, seed=seed)})
        return done


@pytest.mark.parametrize(("wrong", "equal"), [(0.0, True), (1e-12, False)])
def test_throughput_compares_every_answer_bit_for_bit(wrong: float, equal: bool) -> None:
    pair: Any = InFlight("tensorrt"), InFlight("tensorrt_pipelined", wrong)
    result = throughput_study(pair[0], pair[1], [1.0, 2.0, 3.0], 7)
    assert result.actions_equal_bit_for_bit is equal
    assert result.one_at_a_time.keys() == {"tensorrt", "tensorrt_pipelined"}
    assert result.in_flight["total_ms"] == 2.0 and result.in_flight["per_second"] > 0


def test_the_command_writes_what_it_measured(tmp_path: Path) -> None:
    tiny = ("--random-weights", "pi05_tiny", "--device", "cpu")
    result = turbopi("study", "mask", "--small", *tiny, "--out", tmp_path, "--json")
    assert result.exit_code == 0, result.output
    (document,) = json.loads(result.stdout).values()
    file = tmp_path / "mask" / "report.json"
    assert json.loads(file.read_text()) == document == plain_document(read_document(file, Report))
    assert [row["steps"] for row in document["data"]["mask"]] == [1, 10] * 3 and document["data"]["random_weights"]
    assert (tmp_path / "mask" / "mask.png").is_file() and (tmp_path / "mask" / "report.md").is_file()


def test_the_command_refuses_what_it_cant_study(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "unknown study 'speed'; choose of steps, " in refusal(turbopi("study", "speed"))
    assert "no weights: give a checkpoint's folder" in refusal(turbopi("study", "mask"))
    assert "--policy is 'two_ways'; expected NAME=FOLDER" in refusal(turbopi("study", "steps", "--policy", "two_ways"))
    monkeypatch.setattr("turbopi.backends.tensorrt.importlib.util.find_spec", lambda name: None)
    said = refusal(turbopi("study", "precision", "--random-weights", "pi05_tiny", "--device", "cpu"))
    assert "the precision study needs TensorRT: neither tensorrt_rtx nor tensorrt is installed" in said
