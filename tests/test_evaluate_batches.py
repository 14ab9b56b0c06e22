"""Requests of several workers run together, those that join a running chunk, too, and warm-up prepares just these."""

import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from cli_helpers import turbopi
from evaluate_fakes import HORIZON, SeekingPolicy
from test_begin import OnCpu, Ran
from test_running_chunk import trained_policy

from turbopi import UnifiedPolicy
from turbopi.cli.options import PolicyOptions
from turbopi.evaluate.results import Results
from turbopi.evaluate.sources import LocalPolicy
from turbopi.realtime.running_chunk import JoinMode, RunningChunk
from turbopi.support.errors import ActionError

pytestmark = pytest.mark.usefixtures("two_layers", "unseen_plots")

H = 10
QUICK = "--random-weights pi05_tiny --precision f32 --steps 1 --camera-px 64 --image-px 64 --videos none --max-steps 3"


def chunk(rows: int, mode: JoinMode, delay: int = 1, seed: int = 0) -> RunningChunk:
    left_over = np.random.default_rng(seed).standard_normal((rows, 32)).astype(np.float32)
    return RunningChunk(left_over, delay, mode=mode)


def joins(previous: RunningChunk | None) -> dict[str, Any]:
    return {"previous": previous, "model_actions": True}


# -- the policy's side -------------------------------------------------------------------------------------------------


class Rows:
    """Answers with the observation's number and the seed; keeps what each call was told. `bad` ones spoil a batch."""

    def __init__(self, *bad: int) -> None:
        self.metadata: dict[str, Any] = {}
        self.bad = bad
        self.calls: list[tuple[list[int], dict[str, Any]]] = []

    def infer_batch(self, observations: Any, *, seed: Any, **reported: Any) -> list[dict[str, Any]]:
        numbers = [one["number"] for one in observations]
        self.calls.append((numbers, reported))
        if set(numbers) & set(self.bad):
            raise ActionError(f"nan among {numbers}")
        results = [{"actions": np.full((H, 7), float(n))} for n in numbers]
        for result, each, wanted in zip(results, seed, reported.get("model_actions", [False] * len(seed)), strict=True):
            if wanted:
                result["model_actions"] = np.full((H, 32), float(each), np.float32)
        return results


def ask(policy: Rows, arguments: Sequence[dict[str, Any]] | None, count: int = 3) -> list[Any]:
    observations = [{"number": n} for n in range(count)]
    return LocalPolicy(policy).infer(observations, list(range(100, 100 + count)), arguments)


def test_requests_that_join_are_one_batch_and_each_gets_its_own_answer() -> None:
    policy, one = Rows(), chunk(5, "rtc")
    answers = ask(policy, [joins(one), {}, joins(None)])
    assert policy.calls == [([0, 1, 2], {"previous": [one, None, None], "model_actions": [True, False, True]})]
    assert [answer.actions[0, 0] for answer in answers] == [0, 1, 2]
    assert [float(answer.for_next["model_actions"][0, 0]) for answer in answers if answer.for_next] == [100, 102]
    assert not answers[1].for_next


@pytest.mark.parametrize("arguments", [None, [{}, {}, {}]])
def test_requests_without_a_running_chunk_tell_the_policy_nothing_of_one(arguments: Any) -> None:
    policy = Rows()
    answers = ask(policy, arguments)
    assert policy.calls == [([0, 1, 2], {})]
    assert not any(answer.for_next for answer in answers)


@pytest.mark.parametrize("joining", [False, True])
def test_one_row_that_is_not_finite_does_not_cost_the_others(joining: bool) -> None:
    policy, chunks = Rows(1), [chunk(5, "rtc"), chunk(6, "rtc"), None]
    answers = ask(policy, [joins(one) for one in chunks] if joining else None)
    assert [numbers for numbers, _ in policy.calls] == [[0, 1, 2], [0], [1], [2]]
    for one, (_, reported) in zip(chunks, policy.calls[1:], strict=True):
        assert reported == ({"previous": [one], "model_actions": [True]} if joining else {})
    assert [answer.problem for answer in answers] == [None, "nan among [1]", None]
    assert [answer.actions[0, 0] for answer in answers if answer.problem is None] == [0, 2]
    assert [bool(answer.for_next) for answer in answers] == [joining, False, joining]


class Untimed(Ran):
    """Calls of one observation have stages without a GPU, batches have none."""

    def stage_ms(self) -> dict[str, float]:
        return {}


class Uncaptured(OnCpu):
    """`OnCpu` whose warm-up runs nothing."""

    def _capture(self, run: Any, after: Any, like: Any = None) -> Any:
        return Untimed(run, after, self.reported.append, at_once=False)


@pytest.fixture(scope="module", params=[None, Uncaptured], ids=["pytorch", "engine"])
def policy(request: pytest.FixtureRequest) -> UnifiedPolicy:
    return trained_policy(request.param)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["rtc", "rtc_identity", "rtc_trained"])
def test_a_request_alone_is_bit_for_bit_what_infer_gives(policy: UnifiedPolicy, mode: JoinMode) -> None:
    observation, previous = policy.example_observation(), chunk(7, mode)
    (answer,) = LocalPolicy(policy).infer([observation], [5], [joins(previous)])
    expected = policy.infer(observation, seed=5, **joins(previous))
    assert np.array_equal(answer.actions, expected["actions"])
    assert np.array_equal(answer.for_next["model_actions"], expected["model_actions"])


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["rtc", "rtc_identity", "rtc_trained"])
def test_rows_of_a_batch_have_their_own_chunk_and_seed(policy: UnifiedPolicy, mode: JoinMode) -> None:
    observations = [policy.example_observation(seed) for seed in range(3)]
    reported = [joins(chunk(7, mode)), joins(None), joins(chunk(8, mode, seed=1))]
    answers = LocalPolicy(policy).infer(observations, [5, 9, 2], reported)
    for observation, seed, more, answer in zip(observations, (5, 9, 2), reported, answers, strict=True):
        expected = policy.infer(observation, seed=seed, **more)
        np.testing.assert_allclose(answer.actions, expected["actions"], atol=1e-4)
        np.testing.assert_allclose(answer.for_next["model_actions"], expected["model_actions"], atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [None, "rtc", "rtc_identity", "rtc_trained"])
def test_after_warm_up_no_batch_of_the_run_captures_anything(mode: JoinMode | None) -> None:
    policy = trained_policy(Uncaptured)
    source, lines = LocalPolicy(policy), list[str]()
    source.warm_up(3, mode, lines.append)
    captured = policy.backend.describe()
    for count in (2, 3):  # which are computed as 2 and as 4
        observations = [policy.example_observation(seed) for seed in range(count)]
        for chunks in (0, 1, count):  # rows that join
            reported = [joins(chunk(7, mode, seed=row) if mode and row < chunks else None) for row in range(count)]
            source.infer(observations, list(range(count)), reported)
    after = policy.backend.describe()
    assert after["batches"] == captured["batches"] != []
    assert after["graphs"]["kept"] == captured["graphs"]["kept"]
    assert len(lines) == 2 and lines[0].startswith("Warming up batches of up to 3") and lines[1].endswith(" s")


def test_too_little_memory_for_the_batches_is_told_with_what_to_do() -> None:
    class Large(Batching):
        def warmup(self, **arguments: Any) -> float:
            raise torch.OutOfMemoryError("tried to allocate 9 GiB")

    with pytest.raises(Exception, match=r"batches of up to 4, mode rtc takes more .*9 GiB. Give a smaller --max-batch"):
        LocalPolicy(Large()).warm_up(4, "rtc", print)
    with pytest.raises(torch.OutOfMemoryError):
        LocalPolicy(Large()).warm_up(1, "rtc", print)


# -- the command -------------------------------------------------------------------------------------------------------


class Batching(SeekingPolicy):
    """Runs observations together, as `fused` does; `warmups` are the arguments of each."""

    runs_batches = True

    def __init__(self) -> None:
        super().__init__(horizon=HORIZON)
        self.metadata["real_time"] = {"modes": ["rtc", "rtc_identity", "rtc_trained"]}
        self.warmups: list[dict[str, Any]] = []

    def warmup(self, **arguments: Any) -> float:
        self.warmups.append(arguments)
        return 1.5

    def infer_batch(self, observations: Any, seed: Any, **reported: Any) -> list[dict[str, Any]]:
        model_actions = {"model_actions": np.zeros((HORIZON, 32), np.float32)} if reported else {}
        return [result | model_actions for result in super().infer_batch(observations, seed)]


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[Batching]:
    """The policies that commands make."""
    policies: list[Batching] = []

    def make(*_: Any, **__: Any) -> Batching:
        policies.append(Batching())
        return policies[-1]

    monkeypatch.setattr(PolicyOptions, "make_policy", make)
    offered = SimpleNamespace(real_time=Batching().metadata["real_time"])  # not the checkpoint's
    monkeypatch.setattr("turbopi.cli.evaluate.capabilities_of", lambda *_: offered)
    return policies


@pytest.fixture
def most(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Requests that may wait together in each evaluation, which isn't run."""
    found: list[int] = []

    def evaluate(results: Results, *_: Any, num_workers: int, max_batch: int, **__: Any) -> Results:
        found.append(min(num_workers, max_batch))
        return results

    monkeypatch.setattr("turbopi.evaluate.run.evaluate", evaluate)
    monkeypatch.setattr("turbopi.evaluate.run.default_workers", lambda: 3)
    return found


@pytest.mark.parametrize(
    ("options", "arguments"),
    [
        ("--workers 4", {"batches": [2, 3, 4]}),
        ("", {"batches": [2, 3]}),
        ("--workers 4 --max-batch 2", {"batches": [2]}),
        ("--workers 2 --max-batch 4", {"batches": [2]}),
        ("--workers 4 --max-batch 1", None),
        ("--workers 1", None),
        ("--workers 4 --trials 2", {"batches": [2]}),
        ("--workers 4 --trials 1", None),
        ("--real-time", None),
        ("--real-time --max-batch 4", None),
        ("--workers 4 --execution async --delay-steps 2", {"batches": [2, 3, 4]}),
        ("--workers 4 --execution rtc --delay-steps 2", {"batches": [2, 3, 4], "real_time": "rtc"}),
        ("--workers 4 --execution rtc_trained --max-batch 1", {"real_time": "rtc_trained"}),
        ("--execution rtc_identity --real-time", {"real_time": "rtc_identity"}),
        ("--workers 4 --control prompt --tasks 0,1", {"batches": [2, 3, 4]}),
        ("--workers 4 --seeding task --tasks 0,1", {"batches": [2]}),  # an episode of each task at a time
        ("--workers 4 --seeding task", None),
    ],
)
def test_warm_up_prepares_what_the_run_may_ask_for(
    options: str, arguments: dict[str, Any] | None, made: list[Batching], most: list[int], tmp_path: Path
) -> None:
    given = f"eval reacher {QUICK} {options} --out {tmp_path / 'run'}"
    given += "" if "--tasks" in options else " --tasks 0"
    given += "" if "--trials" in options else " --trials 6"
    result = turbopi(*given.split())
    assert "Traceback" not in result.output and len(most) == 1, result.output
    (policy,) = made
    assert policy.warmups == [{}, *([] if arguments is None else [arguments])]  # single observations come first
    assert max((arguments or {}).get("batches", [1])) == most[0], "warm-up and run agree"
    assert ("warm-up: 1.50 s" in result.output) == (arguments is not None)


@pytest.mark.usefixtures("most")
def test_each_way_is_warmed_up_before_it_runs(made: list[Batching], tmp_path: Path) -> None:
    ways = "--execution async,rtc --delay-steps 2 --workers 2 --tasks 0 --trials 2"
    turbopi(*f"eval reacher {QUICK} {ways} --out {tmp_path / 'run'}".split())
    assert made[0].warmups == [{}, {"batches": [2]}, {"batches": [2], "real_time": "rtc"}]


def test_only_what_is_left_to_run_is_warmed_up(made: list[Batching], tmp_path: Path) -> None:
    command = f"eval reacher {QUICK} --tasks 0 --workers 2 --execution rtc --out {tmp_path / 'run'} --json"
    for trials, expected in ((2, [{"batches": [2], "real_time": "rtc"}]), (2, []), (3, [{"real_time": "rtc"}])):
        result = turbopi(*command.split(), "--trials", trials)
        assert json.loads(result.stdout)["episodes"] == trials, result.output
        assert made[-1].warmups == [{}, *expected]


@pytest.mark.usefixtures("most")
def test_a_policy_that_runs_its_observations_one_by_one_has_no_batches_to_warm_up(
    made: list[Batching], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(Batching, "runs_batches", False)
    options = "--workers 4 --execution rtc --tasks 0 --trials 4"
    result = turbopi(*f"eval reacher {QUICK} {options} --out {tmp_path / 'run'}".split())
    assert made[0].warmups == [{}] and "arming up" not in result.output


@pytest.mark.parametrize(("options", "expected"), [("", []), ("--max-batch 2", [{"batches": [2]}])])
def test_compare_runs_one_at_a_time_unless_told(
    options: str, expected: list[Any], made: list[Batching], most: list[int], tmp_path: Path
) -> None:
    command = f"compare pytorch:f32:1 pytorch:bf16:1 --simulator reacher {QUICK} --tasks 0 --trials 4 --workers 4"
    turbopi(*command.split(), *options.split(), "--out", tmp_path)
    first, second, *_ = made
    assert first.warmups == second.warmups == [{}, *expected]
    assert most == [len(expected) + 1] * 2
