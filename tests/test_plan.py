"""`turbopi plan`: its arithmetic keeps what it promises, held against the server's own scheduler in simulated time."""

import itertools
import json
import math
from dataclasses import replace as replaced
from pathlib import Path
from typing import Any

import pytest
from cli_helpers import refusal, turbopi
from doc_tables import fleet as fleet_table
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from packed import content_of
from test_serve_schedule import PAYING, SERIAL, request, simulate, table

from turbopi.bench import batch_table
from turbopi.bench.batch_table import published_table, slow, table_of_file
from turbopi.bench.document import Times
from turbopi.bench.gpus import find_gpu
from turbopi.bench.measured import measured_calls
from turbopi.bench.predict import predict
from turbopi.bench.work import Job
from turbopi.config import ModelConfig
from turbopi.serve.fleet.sizing import OVERHEAD_MS, RAY_MS, Fleet, Plan, batch_times, plan_fleet, worst_seconds
from turbopi.serve.options import ServerOptions
from turbopi.serve.scheduling.schedule import Schedule
from turbopi.support.errors import ConfigError

ROOT = Path(__file__).parents[1]
NO_BENCHMARK = ROOT / "benchmarks" / "results" / "h200_2026-11-26_small_policy" / "judged.json"
SETTINGS = settings(max_examples=60, deadline=None)  # how long an example takes says nothing
RESULT = ROOT / "benchmarks/results/h200_2026-11-26_pi05_libero/results.json.xz"


@st.composite
def batch_tables(draw: st.DrawFn) -> dict[int, float]:
    """T(B) of any engine: times grow with the batch, by anything from nothing to what single calls take."""
    seconds, alone = {}, draw(st.integers(1, 40)) / 1e3
    took = 0.0
    for size in (1, 2, 4, 8, 16)[: draw(st.integers(1, 5))]:
        took = alone if size == 1 else took + draw(st.floats(0.0, 1.2)) * alone * size / 2
        seconds[size] = took
    return seconds


@st.composite
def fleets(draw: st.DrawFn) -> Fleet:
    horizon = draw(st.integers(2, 60))
    steps = draw(st.integers(1, horizon))
    delay = draw(st.none() | st.integers(1, Fleet(1, 1, horizon, steps).most_delay))
    hz = draw(st.sampled_from([5.0, 10.0, 20.0, 33.3, 50.0]))
    overhead = draw(st.sampled_from([0.0, 1.0, 2.5]))
    return Fleet(draw(st.integers(1, 40)), hz, horizon, steps, delay, overhead)


def planned(fleet: Fleet, seconds: dict[int, float]) -> Plan | None:
    try:
        return plan_fleet(fleet, seconds)
    except ConfigError:
        return None


# --- the arithmetic ---------------------------------------------------------------------------------------------------


@SETTINGS
@given(fleets(), batch_tables())
def test_more_robots_never_need_fewer_gpus(fleet: Fleet, seconds: dict[int, float]) -> None:
    plans = [planned(replaced(fleet, robots=robots), seconds) for robots in range(1, 31)]
    if plans[0] is None:
        assert plans == [None] * 30, "what can't serve one robot can't serve more"
        return
    gpus = [one.gpus for one in plans if one is not None]
    assert len(gpus) == 30 and gpus == sorted(gpus) and gpus[0] == 1
    for robots, one in enumerate(plans, 1):
        assert one is not None
        assert (one.robots_per_gpu - 1) * one.gpus < robots <= one.robots_per_gpu * one.gpus


@SETTINGS
@given(fleets(), batch_tables())
def test_a_plan_is_within_what_was_asked(fleet: Fleet, seconds: dict[int, float]) -> None:
    plan = planned(fleet, seconds)
    if plan is None:
        assert seconds[1] > fleet.allowed(1)
        return
    assert 1 <= plan.delay_steps <= fleet.most_delay
    assert fleet.delay_steps is None or plan.delay_steps <= fleet.delay_steps
    assert plan.worst_seconds <= fleet.allowed(1) + 1e-6
    assert plan.delay_steps / fleet.hz >= plan.worst_seconds + fleet.overhead_ms / 1e3 - 1e-9
    assert 0 < plan.utilisation <= 1 + 1e-9
    assert plan.batch <= max(seconds)


@SETTINGS
@given(fleets(), batch_tables())
def test_one_gpu_less_would_not_do(fleet: Fleet, seconds: dict[int, float]) -> None:
    plan = planned(fleet, seconds)
    if plan is None or plan.gpus == 1:
        return
    with pytest.raises(ConfigError, match=f"can't do it: .*; --gpus {plan.gpus} would do"):
        plan_fleet(fleet, seconds, gpus=plan.gpus - 1)
    crowded = math.ceil(fleet.robots / (plan.gpus - 1))
    for largest in seconds:
        assert worst_seconds(batch_times(seconds, largest), crowded) > fleet.allowed(1) - 1e-6


@SETTINGS
@given(fleets(), batch_tables(), st.floats(0.2, 1.0))
def test_a_faster_gpu_never_needs_more_of_them(fleet: Fleet, seconds: dict[int, float], part: float) -> None:
    slower, faster = planned(fleet, seconds), planned(fleet, {size: part * took for size, took in seconds.items()})
    if slower is not None:
        assert faster is not None and faster.gpus <= slower.gpus


@SETTINGS
@given(batch_tables(), st.integers(1, 40))
def test_more_robots_wait_at_least_as_long(seconds: dict[int, float], robots: int) -> None:
    times = batch_times(seconds, max(seconds))
    assert worst_seconds(times, robots) <= worst_seconds(times, robots + 1) + 1e-12


def test_without_batches_the_last_of_n_waits_for_all() -> None:
    for robots in range(1, 20):
        assert worst_seconds(batch_times(SERIAL, 8), robots) == pytest.approx(robots * SERIAL[1])


def test_with_batches_robots_wait_for_the_turn_that_runs_and_their_own() -> None:
    times = batch_times(PAYING, 8)
    assert worst_seconds(times, 1) == pytest.approx(PAYING[1])
    assert 2 * PAYING[8] <= worst_seconds(times, 9) < 3 * PAYING[8]  # eight run, one and who comes then run next
    one, many = plan_fleet(Fleet(24, 20, 20), {1: PAYING[1]}), plan_fleet(Fleet(24, 20, 20), PAYING)
    assert many.worst_seconds < one.worst_seconds and many.utilisation < one.utilisation and many.batch > 1


def test_half_a_chunk_is_carried_out_between_two_requests_unless_said_otherwise() -> None:
    fleet = Fleet(1, 50, 50)
    assert (fleet.steps, fleet.most_delay) == (25, 25) and fleet.allowed(1) == pytest.approx(0.5)
    assert Fleet(1, 50, 50, 40).most_delay == 10
    assert Fleet(1, 50, 50, 40, 3, 10).allowed(1) == pytest.approx(0.05)
    assert Fleet(1, 50, 50, 50).most_delay == 50, "it stands still meanwhile"


def test_several_gpus_have_rays_overhead_too() -> None:
    seconds = published_table("h100", "bf16", 50).seconds
    for robots, gpus, delay in ((8, 1, 4), (8, 2, 3), (4, 1, 2)):  # as docs/fleet.md says
        fleet = Fleet(robots, 50, 50, None, None, OVERHEAD_MS, RAY_MS)
        assert plan_fleet(fleet, seconds, gpus=gpus).delay_steps == delay
    assert plan_fleet(Fleet(8, 50, 50, None, 2, OVERHEAD_MS, RAY_MS), seconds).gpus == 3


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((0, 50, 50), "a fleet has robots"),
        ((1, math.inf, 50), "a fleet has robots"),
        ((1, 50, 50, 51), "the execution horizon is 51; expected 1 to 50"),
        ((1, 50, 50, 40, 11), "expected 1 to 10: d ≤ s and, unless s = H, d ≤ H - s, with s = 40 and H = 50"),
    ],
)
def test_what_cannot_be_a_fleet_is_refused(arguments: tuple[Any, ...], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        Fleet(*arguments)


def test_a_gpu_that_is_too_slow_for_one_robot_is_told_with_the_numbers() -> None:
    with pytest.raises(
        ConfigError, match=r"takes 120.0 ms at most, with 2 ms of overhead that is 7 control steps at 50 Hz; 5"
    ):
        plan_fleet(Fleet(3, 50, 50, None, 5, 2.0), {1: 0.12})


# --- the promise, against the server's scheduler ----------------------------------------------------------------------


@SETTINGS
@given(fleets(), batch_tables(), st.data())
def test_the_promised_delay_holds_in_the_servers_scheduler(
    fleet: Fleet, seconds: dict[int, float], data: st.DataObject
) -> None:
    """Robots on one GPU ask every s steps, each from a moment of its own, and a turn takes T(B)."""
    plan = planned(fleet, seconds)
    if plan is None:
        return
    period, within = fleet.steps / fleet.hz, plan.delay_steps / fleet.hz - fleet.overhead_ms / 1e3
    phases = data.draw(
        st.lists(st.floats(0.0, 1.0), min_size=plan.robots_per_gpu, max_size=plan.robots_per_gpu), label="phases"
    )
    requested = [
        request((phase + round_) * period, within, source=robot)
        for robot, phase in enumerate(phases)
        for round_ in range(4)
    ]
    served = {size: took for size, took in seconds.items() if size <= plan.batch}
    history = simulate(Schedule(plan.queue_limit, table(served)), requested)
    assert not history.refused
    for one in requested:
        turn = history.turn_of(one)
        assert turn is not None and turn.ended <= one.deadline + 1e-6


def test_robots_that_ask_together_are_all_served() -> None:
    requested = [request(source=robot) for robot in range(20)]
    for limit, refused in ((ServerOptions.queue_limit, 3), (plan_fleet(Fleet(20, 50, 50), SERIAL).queue_limit, 0)):
        assert len(simulate(Schedule(limit, table(SERIAL)), requested).refused) == refused


@SETTINGS
@given(batch_tables(), st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20))
def test_robots_without_deadlines_wait_no_longer_either(seconds: dict[int, float], phases: list[float]) -> None:
    """As openpi's clients, which say nothing; but for the moment that the server waits for company."""
    robots = len(phases)
    worst = worst_seconds(batch_times(seconds, max(seconds)), robots)
    requested = [
        request(worst * (phase + round_), 1e3, source=robot)
        for robot, phase in enumerate(phases)
        for round_ in range(3)
    ]
    history = simulate(Schedule(10 * robots, table(seconds)), requested)
    for one in requested:
        turn = history.turn_of(one)
        assert turn is not None and turn.ended - one.arrived <= worst + history.idle + 1e-9


# --- T(B): measured, predicted, of a file -----------------------------------------------------------------------------


def test_measured_times_are_the_slow_calls_of_the_measurement() -> None:
    for call in measured_calls():
        if (call.backend, call.kernels, call.job.batch) == ("fused", "hopper", 1):
            found = published_table(call.gpu, call.precision, call.job.horizon)
            assert not found.predicted and found.job == call.job
            longer = published_table(call.gpu, call.precision, 50).seconds
            assert all(found.seconds[size] <= longer[size] for size in longer)
            if found.source == call.source and found.seconds[1] < longer[1]:
                assert found.seconds[1] == slow(call.milliseconds["total"]) > call.milliseconds["total"].p50 / 1e3
            assert found.seconds[1] <= slow(call.milliseconds["total"]), "of several measurements the soonest"


def test_a_gpus_fastest_kernels_count_and_no_others() -> None:
    """The H200 was measured with kernels for all GPUs, too."""
    assert {call.kernels for call in measured_calls() if call.backend == "fused"} == {"hopper", "portable"}
    for precision in ("bf16", "fp8"):
        seconds = published_table("h200", precision, 10).seconds
        assert seconds[1] < 0.008 and list(seconds) == [1, 2, 4, 8, 16]


def test_a_horizon_between_those_measured_counts_as_the_longer_one() -> None:
    assert published_table("h200", "bf16", 11).job.horizon == 50
    assert published_table("h200", "bf16", 5).job.horizon == 10


def test_beyond_what_was_measured_it_is_a_prediction_and_says_so() -> None:
    long = published_table("h200", "bf16", 100)
    assert long.predicted and long.job.horizon == 100
    other = published_table("rtx4090", "bf16", 10)
    assert other.predicted and other.backend == "fused" and other.seconds[1] > 0.02
    with pytest.raises(ConfigError, match=r"A100 80 GB SXM doesn't run fp8: .*; this GPU has 8\.0"):
        published_table("a100", "fp8", 10)
    assert published_table("orin", "int8", 10).predicted, "INT8 goes by an H200 with kernels for all GPUs"
    with pytest.raises(ConfigError, match="'fp7' is neither measured"):
        published_table("h200", "fp7", 10)


def test_without_any_measurement_there_is_no_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "turbopi.bench.predict.measured_calls",
        lambda: tuple(call for call in measured_calls() if call.precision != "int8"),
    )
    with pytest.raises(ConfigError, match="nothing that runs in int8 on A100 80 GB SXM was measured"):
        published_table("a100", "int8", 10)


def test_a_prediction_is_of_one_backends_kernels_alone() -> None:
    """On Hopper `fused` has two kinds: one's T(1) beside the other's T(2) would be no engine's."""
    for gpu in ("h100", "h200"):
        alone, two = (published_table(gpu, "bf16", 100).seconds[size] for size in (1, 2))
        portable = [
            call
            for one in predict(find_gpu(gpu), ModelConfig(), Job(horizon=100))
            for call in one.calls
            if (one.precision, call.kernels) == ("bf16", "portable")
        ]
        assert alone < min(call.high_ms for call in portable) / 1e3 and alone < two < 2 * alone


def test_measured_batches_are_taken_as_soon_as_there_are_some(monkeypatch: pytest.MonkeyPatch) -> None:
    """What exchanging data/measured_calls.json does."""
    known = [call for call in measured_calls() if call.job.batch == 1 and call.kernels == "hopper"]
    one = next(call for call in known if (call.backend, call.precision, call.job) == ("fused", "fp8", Job()))

    def slower(batch: int) -> Any:
        times = {name: Times(p50=v.p50 * batch**0.7, p95=v.p95 * batch**0.7) for name, v in one.milliseconds.items()}
        return replace(one, job=replace(one.job, batch=batch), milliseconds=times)

    calls = (*known, *map(slower, (2, 4, 8, 16)))
    monkeypatch.setattr(batch_table, "measured_calls", lambda: calls)
    found = published_table("h200", "fp8", 10)
    assert list(found.seconds) == [1, 2, 4, 8, 16]
    assert plan_fleet(Fleet(60, 20, 10), found.seconds).batch > 1
    assert published_table("h200", "fp8", 50).seconds.keys() == {1}, "other chunks have times of their own"


def test_the_times_of_a_benchmarks_file_are_taken(tmp_path: Path) -> None:
    document = json.loads(content_of(RESULT))
    main = [one for one in document["results"] if one["job"] == document["main_job"] and one["precision"] == "bf16"]
    for batch in (2, 4):
        again = json.loads(json.dumps(main[0]))
        again["job"]["batch"] = batch
        again["milliseconds"]["total"]["p99"] *= batch**0.5
        document["results"].append(again)
    file = tmp_path / "times.json"
    file.write_text(json.dumps(document))
    found = table_of_file(file, "bf16", 10)
    p99 = main[0]["milliseconds"]["total"]["p99"] / 1e3
    assert (found.gpu, found.backend, found.predicted) == ("NVIDIA H200", "fused", False)
    assert found.seconds == {1: p99, 2: pytest.approx(p99 * 2**0.5), 4: pytest.approx(p99 * 2)}
    with pytest.raises(ConfigError, match="no calls in int8; it has bf16, fp8"):
        table_of_file(file, "int8", 10)
    with pytest.raises(ConfigError, match="chunks of 80 actions weren't measured in bf16"):
        table_of_file(file, "bf16", 80)


# --- the command ------------------------------------------------------------------------------------------------------

ASK = ["plan", "--robots", "12", "--hz", "50", "--horizon", "50"]


def test_the_commands_document_is_the_plan() -> None:
    result = turbopi(*ASK, "--gpu", "h200", "--precision", "fp8", "--json")
    document = json.loads(result.stdout)
    times = published_table("h200", "fp8", 50)
    plan = plan_fleet(Fleet(12, 50, 50, overhead_ms=2.0), times.seconds)
    assert document["plan"]["gpus"] == plan.gpus and document["plan"]["delay_steps"] == plan.delay_steps
    assert document["predicted"] is False and document["times"]["source"] == times.source


@pytest.mark.parametrize("gpu", ["h100", "h200"])
@pytest.mark.parametrize("precision", ["bf16", "fp8"])
def test_a_table_names_the_files_of_all_its_times(gpu: str, precision: str) -> None:
    table = published_table(gpu, precision, 50)
    named = [call for call in measured_calls() if call.source in table.source.split(", ")]
    for batch, seconds in table.seconds.items():
        job = replace(table.job, batch=batch)
        of_it = [call for call in named if (call.gpu, call.precision, call.job) == (gpu, precision, job)]
        assert seconds in {slow(call.milliseconds["total"]) for call in of_it}, batch


def test_a_prediction_is_called_one() -> None:
    said = turbopi(*ASK, "--gpu", "rtx4090")
    assert said.exit_code == 0 and "PREDICTED, not measured there" in said.stdout
    assert json.loads(turbopi(*ASK, "--gpu", "rtx4090", "--json").stdout)["predicted"] is True
    assert "PREDICTED" not in turbopi(*ASK, "--gpu", "h200").stdout


def test_no_command_is_recommended_where_auto_would_not_run_it() -> None:
    for gpu in ("rtx4090", "orin", "thor", "h20"):
        shown = turbopi(*ASK, "--gpu", gpu).stdout
        assert "turbopi serve" not in shown
        assert "no command is recommended: fused was never run on a " in shown
    chosen = turbopi(*ASK, "--gpu", "rtx4090", "--precision", "fp8").stdout
    assert "turbopi serve CHECKPOINT --backend fused --precision fp8" in chosen, "auto takes it for FP8"


@pytest.mark.parametrize("precision", ["bf16", "fp8", "int8"])
def test_a_command_with_a_calibrated_precision_comes_behind_its_calibration(precision: str) -> None:
    shown = turbopi(*ASK, "--gpu", "h200", "--precision", precision).stdout.splitlines()
    commands = [line.partition("turbopi ")[2] for line in shown if line.startswith("run")]
    calibrate = f"calibrate CHECKPOINT --precision {precision} --observations RECORDING"
    serve = f"serve CHECKPOINT --backend fused --precision {precision} --max-batch "
    assert commands[:-1] == ([] if precision == "bf16" else [calibrate]) and commands[-1].startswith(serve)


def test_a_plan_without_times_of_batches_says_so() -> None:
    reported = (
        "Batches of such chunks weren't measured there. Measure them with `turbopi bench CHECKPOINT --backends fused "
        "--precisions int8 --horizons 10 --batch 1,2,4,8 --report DIR`, then give --times DIR/results.json"
    )
    ask = ["--hz", "20", "--horizon", "10", "--gpu", "h200", "--precision", "int8"]
    assert reported in turbopi("plan", "--robots", "12", *ask).stdout.splitlines()
    assert reported not in turbopi("plan", "--robots", "1", *ask).stdout
    for gpu in ("h100", "h200"):
        assert "weren't measured" not in turbopi(*ASK, "--gpu", gpu).stdout


@pytest.mark.parametrize(
    ("requested", "reported"),
    [
        ("--robots 17 --horizon 50 --execution-horizon 50", "Robots carry out whole chunks, and stand still"),
        ("--robots 8 --horizon 50 --gpus 4", "Without Ray, a server on each GPU: 1 control steps"),
        ("--robots 900 --horizon 50", "One server decodes some 1200 observations a second: take 2 servers"),
    ],
)
def test_the_command_to_serve_has_what_the_plan_needs_and_its_limits_are_told(requested: str, reported: str) -> None:
    from test_document_commands import check_parses

    lines = turbopi("plan", "--hz", "50", "--gpu", "h200", *requested.split()).stdout.splitlines()
    assert any(line.startswith(reported) for line in lines)
    (run,) = (line for line in lines if line.startswith("run "))
    assert all(len(line) <= 110 for line in lines if line != run)
    words = run.split()[2:]
    check_parses(words, "turbopi plan")
    (_, gpus, _, _, most, *_) = next(line for line in lines if line.startswith("GPUs")).split()
    given = dict(itertools.pairwise(words))
    assert given.get("--replicas", "1") == gpus.rstrip(",") and ("--ray" in words) == (gpus != "1,")
    assert int(given.get("--queue-limit", 16)) == max(16, int(most))
    assert int(given.get("--max-clients", 256)) == max(256, int(requested.split()[1]))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "give --gpu GPU, or --times FILE"),
        (["--gpu", "h200", "--times", "x"], "--gpu h200 and --times x each name"),
        (["--times", "no/such/file.json"], "no/such/file.json"),
        (["--times", str(NO_BENCHMARK)], "judged.json holds no benchmark; expected the results.json of `turbopi bench"),
        (["--gpu", "orin"], "this GPU can't do it for a single robot"),
    ],
)
def test_what_cannot_be_planned_is_refused(arguments: list[str], said: str) -> None:
    more = ["--delay-steps", "5"] if "orin" in arguments else []
    assert said in refusal(turbopi(*ASK, *arguments, *more))


@pytest.mark.parametrize(("gpu", "precision"), fleet_table.GPUS)
def test_the_documents_table_is_what_the_command_prints(gpu: str, precision: str) -> None:
    text = (ROOT / "docs" / "fleet.md").read_text()
    column = fleet_table.GPUS.index((gpu, precision))
    for robots, (hz, horizon) in [(8, fleet_table.CONTROL[0]), (64, fleet_table.CONTROL[1])]:
        (row,) = (line for line in text.splitlines() if line.startswith(f"| {robots}, {hz:g} Hz, H = {horizon} |"))
        cell = row.split("|")[2 + column].strip()
        requested = ["--robots", robots, "--hz", hz, "--horizon", horizon, "--gpu", gpu, "--precision", precision]
        said = turbopi("plan", *requested)
        if cell == "no":
            assert "can't do it for a single robot" in refusal(said)
        else:
            (gpus,) = (line.split()[1].rstrip(",") for line in said.stdout.splitlines() if line.startswith("GPUs"))
            (delay,) = (line.split()[1] for line in said.stdout.splitlines() if line.startswith("delay"))
            assert cell == f"{gpus} ({delay})"
