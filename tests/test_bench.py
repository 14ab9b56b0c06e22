"""The benchmark: its floors are counted right, its calls are fresh, its document is complete."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from file_helpers import no_room
from msgspec import to_builtins
from msgspec.structs import asdict, replace
from typer.testing import CliRunner

from turbopi.bench import machine_limits, profile
from turbopi.bench import run as running
from turbopi.bench.document import BenchDocument, Kernel, Memory, Result, Times, read_benchmark
from turbopi.bench.machine_limits import Floors
from turbopi.bench.measure import (
    FEWEST,
    Latency,
    Observations,
    answers,
    bench_policy,
    error_against,
    for_job,
    measure_calls,
)
from turbopi.bench.ready import Start, empty_caches, measure_ready
from turbopi.bench.report import floors_line, report
from turbopi.bench.run import BenchPlan, stage_floors
from turbopi.bench.summary import linear_models
from turbopi.bench.work import JOINS, Job, Work, floor_ms, stage_work
from turbopi.checkpoint import random_checkpoint
from turbopi.cli import app
from turbopi.cli.options import own_precision
from turbopi.config import ModelConfig
from turbopi.kernels import grid_barrier as barrier
from turbopi.kernels.nvrtc import bindings, compile_cubin
from turbopi.policy.policy import UnifiedPolicy
from turbopi.support.errors import BackendError, BackendUnavailable, ConfigError, OutputError
from turbopi.support.reading import as_document

pytestmark = pytest.mark.usefixtures("two_layers", "unseen_plots")

CPU = torch.device("cpu")
CHECKED_IN = Path(__file__).parents[1] / "benchmarks/results/cpu_2026-11-21_small_policy_bench.json"


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
    assert floor_ms(Work(flops=2 * 10**12, bytes=10**9), 1e15, 1e12) == pytest.approx(2.0)
    assert floor_ms(Work(flops=10**12, bytes=3 * 10**9), 1e15, 1e12) == pytest.approx(3.0)


def test_stage_floors_add_up(policy: UnifiedPolicy) -> None:
    floors = stage_floors(policy, Job(), Floors(1e10, 1e11, None))
    assert floors["total"] == pytest.approx(floors["vision"] + floors["prefix"] + floors["denoise"])


@pytest.mark.parametrize("tokens", [7, 48, 199])
def test_prompts_have_exactly_the_tokens_asked_for(policy: UnifiedPolicy, tokens: int) -> None:
    observations = Observations(policy, Job(prompt_tokens=tokens))
    for _ in range(3):
        assert policy.prepare(next(observations)).token_mask.sum() == tokens


@pytest.mark.slow
def test_jobs_that_join_a_running_chunk_are_measured_and_judged(policy: UnifiedPolicy) -> None:
    plain, *joined = (Job(steps=2, join=join) for join in JOINS)
    alone = answers(policy, plain, observations=1)
    for job in joined:
        assert not np.array_equal(answers(policy, job, observations=1), alone)
        assert measure_calls(policy, job, 1)["total"].calls == 1 and JOINS[job.join] in str(job)
    plan = BenchPlan(["pytorch"], ["f32"], joins=list(JOINS))
    assert [job.join for job in plan.jobs()] == list(JOINS) and all(plan.judges(job) for job in plan.jobs())
    assert "join" not in to_builtins(Job())


def test_every_observation_is_new_and_has_the_cameras_asked_for(policy: UnifiedPolicy) -> None:
    observations = Observations(policy, Job(cameras=1))
    first, second = next(observations), next(observations)
    assert first["prompt"] != second["prompt"]
    assert not np.array_equal(first["images"]["base_0_rgb"], second["images"]["base_0_rgb"])
    assert policy.prepare(first).image_mask.tolist() == [True, False, False]


def test_pictures_have_the_size_asked_for(policy: UnifiedPolicy) -> None:
    observations = Observations(policy, Job(cameras=2, image_width=64, image_height=48))
    assert {camera_image.shape for camera_image in next(observations)["images"].values()} == {(48, 64, 3)}
    plan = BenchPlan(["pytorch"], ["f32"], image_sizes=[(64, 48), (224, 224)], steps=[1, 2])
    assert [str(job) for job in plan.jobs()] == [
        f"2 cameras{of}, 48 tokens, H=10, {steps} steps" for of in (" of 64x48", "") for steps in (1, 2)
    ]
    assert plan.main == Job(steps=2)


def test_an_impossible_number_of_cameras_is_refused(policy: UnifiedPolicy) -> None:
    with pytest.raises(ConfigError, match="1 to 3 cameras, not 4"):
        Observations(policy, Job(cameras=4))


def test_a_prompt_longer_than_the_model_reads_is_refused(policy: UnifiedPolicy) -> None:
    with pytest.raises(ConfigError, match="reads 1 to 200 prompt tokens; a job can't have 201: give --prompt-tokens"):
        Observations(policy, Job(prompt_tokens=201))


def test_percentiles() -> None:
    latency = Latency.of([float(value) for value in range(1, 101)])
    assert latency.calls == 100
    assert latency.median == pytest.approx(50.5)
    assert latency.percentiles[99] == pytest.approx(99.01)


@pytest.mark.slow
def test_a_measurement_ends_early_but_has_its_fewest_calls(policy: UnifiedPolicy) -> None:
    job, done = Job(cameras=1, prompt_tokens=3, steps=1), []
    latency = measure_calls(policy, job, 1000, seconds=0.0, advance=lambda: done.append(1))
    assert latency["total"].calls == FEWEST
    assert len(done) == FEWEST + 3


def test_another_horizon_shares_the_backend(policy: UnifiedPolicy) -> None:
    other = for_job(policy, Job(horizon=7))
    assert other.backend is policy.backend
    assert answers(other, Job(cameras=1, horizon=7, steps=1), observations=1).shape[:2] == (1, 7)
    assert answers(policy, Job(cameras=1, steps=1), observations=1).shape[:2] == (1, 10)


def test_the_oracle_has_no_error_against_itself(policy: UnifiedPolicy) -> None:
    exact = answers(policy, Job(steps=1), observations=1)
    assert error_against(answers(policy, Job(steps=1), observations=1), exact).max == 0
    rounded = bench_policy(random_checkpoint("pi05_tiny"), "pytorch", "bf16", CPU, Job(steps=1))
    error = error_against(answers(rounded, Job(steps=1), observations=1), exact)
    assert 1e-4 < error.relative_rms < 0.1


TABLE = BenchPlan(["fused"], ["bf16"], (1, 2, 3), (48, 200), (10, 50), (1, 2, 3, 5, 10), beside=["pytorch"])


def test_the_table_has_sixty_jobs_and_the_others_run_the_main_one() -> None:
    assert TABLE.main == Job()
    assert [(name, len(jobs)) for _, name, jobs in TABLE.policies()] == [("fused", 60), ("pytorch", 1)]
    assert TABLE.total_calls == 61 * 103
    assert sum(map(TABLE.judges, TABLE.jobs())) == 10  # five numbers of steps, two horizons


def test_many_calls_are_for_the_main_job_of_the_main_backends() -> None:
    plan = BenchPlan(["fused"], ["bf16"], steps=(1, 10), beside=["pytorch"], calls=5, main_calls=50)
    assert plan.calls_of("fused", plan.main) == 50
    assert plan.calls_of("pytorch", plan.main) == plan.calls_of("fused", Job(steps=1)) == 5


def test_the_main_job_is_the_usual_one_or_the_nearest() -> None:
    assert BenchPlan(["x"], ["bf16"], (1, 3), (7, 48), (5,), (1, 3)).main == Job(1, 48, 5, 3)


def test_a_backend_is_left_out_only_in_one_of_several_precisions() -> None:
    both = BenchPlan(["pytorch"], ["bf16", "f32"], beside=["onnx"])
    assert [(precision, name) for precision, name, _ in both.policies()] == [
        ("bf16", "pytorch"),
        ("f32", "pytorch"),
        ("f32", "onnx"),
    ]
    checkpoint = random_checkpoint("pi05_tiny")
    both.check(CPU, checkpoint)
    with pytest.raises(ConfigError, match="onnx"):
        BenchPlan(["onnx"], ["bf16"]).check(CPU, checkpoint)


def test_the_line_over_steps_is_found() -> None:
    results = [
        Result(
            backend="x",
            precision="bf16",
            job=Job(steps=steps),
            calls=1,
            load_seconds=0.0,
            first_call_seconds=0.0,
            milliseconds={"total": Times(p50=5 + 0.25 * steps, p95=9.0)},
            floor_ms={},
            times_floor=1.0,
            memory=Memory(),
        )
        for steps in (1, 3, 10)
    ]
    (line,) = linear_models(results)
    assert (line.a_ms, line.b_ms) == pytest.approx((5, 0.25))
    assert line.worst_ms == pytest.approx(0, abs=1e-9)
    assert linear_models(results[:1]) == []


def test_kernels_that_wait_for_each_other_are_counted_once() -> None:
    """The second one was launched early and waited until 10: it added 5 of its 12 microseconds."""
    ran = profile.in_turn([("a", 0.0, 10.0), ("b", 3.0, 15.0), ("c", 20.0, 21.0), ("inside", 4.0, 9.0)])
    assert {one.name: one.busy_us for one in ran} == {"inside": 5.0, "a": 1.0, "b": 5.0, "c": 1.0}


def test_stages_are_counted_back_from_the_end_of_a_call() -> None:
    assert profile.stage_edges([1.0, 2.0, 0.5], 10_000.0) == [6500.0, 7500.0, 9500.0, 10_000.0]


def test_kernels_belong_to_the_stage_in_which_they_ran() -> None:
    ran = [profile.Ran(name, start, 1.0) for name, start in (("v", 0.0), ("p", 10.0), ("d", 20.0), ("after", 99.0))]
    parts = profile.split(ran, [0.0, 9.0, 19.0, 30.0])
    assert [[one.name for one in part] for part in parts] == [["v"], ["p"], ["d", "after"]]
    top = profile.top([profile.Ran("x", 0, 300.0), profile.Ran("x", 1, 100.0), profile.Ran("y", 2, 100.0)], 2, 1)
    assert (top.busy_ms, top.launches) == (0.25, 1.5)
    assert top.kernels == [Kernel("x", ms_per_call=0.2, launches_per_call=1.0, share=0.8)]


def has_nvrtc() -> bool:
    try:
        bindings("nvrtc").nvrtcVersion()
    except (BackendUnavailable, RuntimeError):
        return False
    return True


@pytest.mark.skipif(not has_nvrtc(), reason="no NVRTC here")
@pytest.mark.parametrize("arch", ["sm_80", "sm_90"])
def test_the_barrier_kernel_compiles(arch: str, tmp_path: Path) -> None:
    assert b"turbopi_barriers" in compile_cubin(barrier.SOURCE, arch, {}, folder=tmp_path)


@pytest.mark.slow
def test_ready_is_measured_in_a_process_of_its_own() -> None:
    start = Start(None, "pi05_tiny", 0, None, "pytorch", "bf16", "cpu", 1, None)
    with empty_caches():
        measured = measure_ready(start)
    for one in (measured.cold, measured.cached):
        assert one.ready == pytest.approx(one.imports + one.load + one.warmup, abs=0.02)
        assert one.imports > 0


@pytest.mark.slow
def test_a_start_that_fails_says_why() -> None:
    start = Start(None, "pi05_tiny", 0, None, "warp", "bf16", "cpu", 1, None)
    with pytest.raises(BackendError, match="unknown backend 'warp'"):
        measure_ready(start)


def test_anothers_results_arent_replaced_and_what_cant_be_written_is_told_first(tmp_path: Path) -> None:
    (tmp_path / "results.json").write_text('{"format": 1, "episodes": []}')
    for folder, why in (
        (tmp_path, "results.json is there and isn't a benchmark's results, so it isn't replaced"),
        (tmp_path / "results.json" / "below", "is a file"),
    ):
        result = CliRunner().invoke(app, ["bench", "--random-weights", "pi05_tiny", "--report", str(folder)])
        assert result.exit_code == 2 and why in " ".join(result.stderr.split())
    assert (tmp_path / "results.json").read_text() == '{"format": 1, "episodes": []}'


def test_a_full_disk_keeps_the_earlier_benchmark(tmp_path: Path) -> None:
    from turbopi.cli.bench import _write_results

    document = read_benchmark(CHECKED_IN)
    file = _write_results(replace(document, results=[]), tmp_path)
    before = file.read_text()
    with no_room(10), pytest.raises(OutputError, match=rf"can't write {file}: File too large"):
        _write_results(document, tmp_path)
    assert file.read_text() == before and list(tmp_path.iterdir()) == [file]


def floors_of(monkeypatch: pytest.MonkeyPatch, bytes_per_second: float, flops_per_second: float) -> None:
    """Floors that don't depend on what else runs here."""
    monkeypatch.setattr(running, "measure_floors", lambda *_: Floors(bytes_per_second, flops_per_second))


@pytest.mark.parametrize(
    ("bytes_per_second", "flops_per_second", "line"),
    [
        (4.25e12, 1.404e15, "copy 4.25 TB/s, matmul 1404 TFLOP/s"),
        (1.5e10, 8.4e10, "copy 15.0 GB/s, matmul 84.0 GFLOP/s"),
        (4e9, 3e8, "copy 4.00 GB/s, matmul 0.300 GFLOP/s"),
    ],
)
def test_floors_are_shown_with_three_digits(bytes_per_second: float, flops_per_second: float, line: str) -> None:
    assert floors_line("bf16", Floors(bytes_per_second, flops_per_second)) == f"floors, bf16: {line}"


def test_on_a_cpu_the_matrix_rate_is_of_weights_as_the_model_keeps_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """[outputs, inputs]: the other layout is twenty times slower in bfloat16 on CPUs without its instructions."""
    requested: list[tuple[torch.Size, bool]] = []
    linear = torch.nn.functional.linear

    def seen(x: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        requested.append((weight.shape, weight.is_contiguous()))
        return linear(x, weight)

    monkeypatch.setattr(torch.nn.functional, "linear", seen)
    monkeypatch.setattr(machine_limits, "median_seconds", lambda run, device: 0.5 if run() is not None else 0.0)
    assert machine_limits._matmul_rate(CPU, torch.bfloat16, 16) == 2 * 16**3 / 0.5
    assert requested == [((16, 16), True)]


@pytest.mark.slow
def test_points_above_the_roofline_are_warned_about(
    tmp_path: Path, drawn: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stage faster than its floor says that the floor is wrong; the rates here are those of a very busy machine."""
    floors_of(monkeypatch, 1e7, 1e8)
    words = ("bench", "--random-weights", "pi05_tiny", "--calls", "1", "--steps", "1", "--no-error", "--device", "cpu")
    result = CliRunner().invoke(app, [*words, "--report", str(tmp_path)])
    assert result.exit_code == 0, result.output
    document = json.loads((tmp_path / "results.json").read_text())
    (warning,) = document["warnings"]
    (one,) = document["results"]
    assert "pytorch bf16, 2 cameras, 48 tokens, H=10, 1 steps is faster than its floor in vision " in warning
    assert f"prefix {one['milliseconds']['prefix']['p50']:,.2f} ms (floor {one['floor_ms']['prefix']:,.2f})" in warning
    assert "run again when it is idle" in warning
    assert f"WARNING: {warning}" in result.stdout
    assert "copy 0.0100 GB/s, matmul 0.100 GFLOP/s" in result.stdout, "no number is cut to 0.000"
    assert f"**Warning:** {warning}" in (tmp_path / "report.md").read_text()
    roofline = drawn[1].axes[0]
    circled = [line.get_xydata()[0].tolist() for line in roofline.get_lines() if line.get_markersize() == 16]
    points = [line.get_xydata()[0].tolist() for line in roofline.get_lines() if line.get_markersize() == 8]
    assert circled and all(point in points for point in circled)
    roof = min(1e7 * circled[0][0], 1e8) / 1e12
    assert circled[0][1] > roof
    assert "above the roof" in roofline.get_legend().get_texts()[-1].get_text()


@pytest.mark.slow
def test_a_robots_own_observations_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    floors_of(monkeypatch, 1e15, 1e18)
    seen: list[dict[str, Any]] = []
    infer = UnifiedPolicy.infer

    def kept(self: UnifiedPolicy, obs: Any, **options: Any) -> Any:
        seen.append(dict(obs))
        return infer(self, obs, **options)

    monkeypatch.setattr(UnifiedPolicy, "infer", kept)
    words = ["bench", "--random-weights", "pi05_tiny", "--robot", "libero", "--device", "cpu"]
    result = CliRunner().invoke(app, [*words, "--calls", "1", "--steps", "1", "--no-error", "--json"])
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["robot"] == "libero"
    height, width = seen[0]["observation/image"].shape[:2]
    expected = {"cameras": 2, "horizon": 10, "steps": 1, "image_width": width, "image_height": height, "join": "none"}
    expected |= {"batch": 1, "writes_tokens": False}
    assert "writes_tokens" not in document["main_job"]
    job = asdict(as_document(document["main_job"], Job, "stdout"))
    assert {**job, "prompt_tokens": 0} == {**expected, "prompt_tokens": 0}
    assert document["main_job"]["prompt_tokens"] > 20
    assert all("observation/wrist_image" in observation for observation in seen)
    assert len({observation["observation/state"].tobytes() for observation in seen}) == len(seen)
    clash = CliRunner().invoke(app, [*words, "--cameras", "1", "--table"])
    assert clash.exit_code == 2
    assert "--robot brings its own cameras and prompt: leave out --cameras, --table, or --robot" in clash.stderr


@pytest.mark.parametrize(
    ("names", "taken"),
    [(["onnx"], "f32"), (["onnx", "pytorch"], "bf16"), (["auto"], "bf16"), (["emulated_fp8"], "fp8"), ([], "bf16")],
)
def test_without_precisions_the_backends_own_is_measured(names: list[str], taken: str) -> None:
    assert own_precision(names) == taken


@pytest.mark.slow
def test_the_command_writes_a_complete_document(
    tmp_path: Path, drawn: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    floors_of(monkeypatch, 1e15, 1e18)
    options = "--random-weights pi05_tiny --calls 2 --main-calls 3 --steps 1,2 --cameras 1 --horizons 7,10 --device cpu"
    more = ["--beside", "pytorch", "--profile", "--json", "--report", str(tmp_path)]
    result = CliRunner().invoke(app, ["bench", *options.split(), *more])
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["random_weights"] is True
    assert document["provenance"]["commit"]
    assert "warnings" not in document and "robot" not in document
    assert [(one["job"]["horizon"], one["job"]["steps"]) for one in document["results"]] == [
        (7, 1),
        (7, 2),
        (10, 1),
        (10, 2),
    ]
    for one in document["results"]:
        times = one["milliseconds"]
        assert one["calls"] == (3 if one["job"] == document["main_job"] else 2)
        assert times["device"]["p50"] <= times["infer"]["p50"] <= times["total"]["p50"]
        assert one["times_floor"] == pytest.approx(times["total"]["p50"] / one["floor_ms"]["total"])
        assert 1e-4 < one["error_against_f32"]["relative_rms"] < 0.1
    stages = document["profile"][0]["stages"]
    assert set(stages) == {"vision", "prefix", "denoise"}
    assert all(stage["kernels"][0]["ms_per_call"] > 0 for stage in stages.values())
    assert [line["horizon"] for line in document["linear"]] == [7, 10]
    assert json.loads((tmp_path / "results.json").read_text())["floors"] == document["floors"]
    for plot in ("stages.png", "steps.png", "roofline.png"):
        assert (tmp_path / plot).read_bytes().startswith(b"\x89PNG")
    stages_plot, roofline, steps_plot = (figure.axes[0] for figure in drawn)
    main = next(one for one in document["results"] if one["job"] == document["main_job"])
    bars = [bar.get_width() for bar in stages_plot.patches]
    of_call = [main["milliseconds"][stage]["p50"] for stage in ("vision", "prefix", "denoise")]
    assert bars == pytest.approx(of_call + [main["floor_ms"][stage] for stage in ("vision", "prefix", "denoise")])
    points = [line.get_xydata()[0] for line in roofline.get_lines() if len(line.get_xydata()) == 1]
    expected = [
        (work["flops"] / work["bytes"], work["flops"] / main["milliseconds"][stage]["p50"] / 1e9)
        for stage, work in ((stage, main["work"][stage]) for stage in ("vision", "prefix", "denoise"))
    ]
    np.testing.assert_allclose(points, expected)
    medians = [[one["milliseconds"]["total"]["p50"] for one in document["results"][i : i + 2]] for i in (0, 2)]
    measured = [container.lines[0].get_xydata().tolist() for container in steps_plot.containers]
    assert measured == [[[1, pytest.approx(a)], [2, pytest.approx(b)]] for a, b in medians]
    page = (tmp_path / "report.md").read_text()
    assert page == report(as_document(document, BenchDocument, "stdout"))
    assert f"{document['results'][3]['milliseconds']['total']['p50']:.2f}" in page
    document["results"][-1]["backend_details"]["denoising_clock_mhz"] = {"H=10, 2 steps": 1795}
    reported = report(as_document(document, BenchDocument, "stdout"))
    assert "1795 (H=10, 2 steps). nvidia-smi said nothing." in reported


@pytest.mark.slow
def test_a_run_that_is_ended_has_kept_what_it_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[Any] = []

    def measure_twice(*args: Any, **options: Any) -> Any:
        if len(measured) == 2:
            raise KeyboardInterrupt
        measured.append(measure_calls(*args, **options))
        return measured[-1]

    monkeypatch.setattr("turbopi.bench.run.measure_calls", measure_twice)
    options = "--random-weights pi05_tiny --device cpu --cameras 1 --steps 1,2,3 --calls 3 --report"
    CliRunner().invoke(app, ["bench", *options.split(), str(tmp_path)])
    document = json.loads((tmp_path / "results.json").read_text())
    assert document["unfinished"] is True and [one["job"]["steps"] for one in document["results"]] == [1, 2]
    assert os.listdir(tmp_path) == ["results.json"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--steps", "1,many"], "--steps is '1,many'"),
        (["--horizons", "0"], "--horizons has 0"),
        (["--backends", "warp"], "unknown backend 'warp'"),
        (["--precisions", "fp7"], "unknown precision 'fp7'"),
        (["--precisions", ""], "name a backend and a precision"),
        (["--backends", ","], "name a backend and a precision"),
        (["--precisions", "bf16,fp8"], "fp8 needs an NVIDIA GPU of compute capability 8.9 or newer"),
        (["--backends", "pytorch", "--precisions", "bf16,fp8"], "none of pytorch runs in fp8"),
        (["--quantization", "x.json"], "a calibration was given, but none of the precisions"),
        (["--report", __file__], "is a file"),
    ],
)
def test_wrong_options_are_refused(arguments: list[str], message: str) -> None:
    result = CliRunner().invoke(app, ["bench", "--random-weights", "pi05_tiny", "--device", "cpu", *arguments])
    assert result.exit_code == 2
    assert message in result.output


@pytest.mark.slow
def test_a_backend_that_breaks_is_named_and_costs_no_other_result(monkeypatch: pytest.MonkeyPatch) -> None:
    from turbopi.bench import run as bench_run

    whole = bench_run._policy

    def without_bf16(checkpoint: Any, plan: Any, backend: str, precision: Any, device: Any) -> UnifiedPolicy:
        if precision == "bf16":
            raise BackendError("the workspace is too small")
        return whole(checkpoint, plan, backend, precision, device)

    monkeypatch.setattr(bench_run, "_policy", without_bf16)
    command = "bench --random-weights pi05_tiny --device cpu --calls 2 --steps 1 --no-error --json --precisions"
    result = CliRunner().invoke(app, [*command.split(), "bf16,f32"])
    assert result.exit_code == 1
    document = json.loads(result.stdout)
    assert document["failed"] == [
        {"backend": "pytorch", "precision": "bf16", "error": "the workspace is too small"},
    ]
    assert [one["precision"] for one in document["results"]] == ["f32"]
    result = CliRunner().invoke(app, [*command.split(), "bf16"])
    assert result.exit_code == 2
    assert "the workspace is too small" in result.output


def test_a_batch_is_one_call_with_observations_of_its_own(
    policy: UnifiedPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested: list[list[str]] = []
    forms: list[list[str]] = []
    together = policy.infer_batch

    def noted(observations: list[dict[str, Any]], **more: Any) -> list[dict[str, Any]]:
        requested.append([one["prompt"] for one in observations])
        forms.append([one.form for one in more["conditioning"] or []])
        return together(observations, **more)

    monkeypatch.setattr(policy, "infer_batch", noted)
    latency = measure_calls(policy, Job(cameras=1, prompt_tokens=3, steps=1, batch=3), 2)
    assert latency["total"].calls == 2 and len(requested) == 5
    assert all(len(prompts) == len(set(prompts)) == 3 for prompts in requested) and not any(forms)
    measure_calls(policy, Job(cameras=1, prompt_tokens=3, steps=1, batch=2, join="held"), 1)
    assert forms[-1] == ["tokens", "tokens"], "each joins a chunk"


def test_a_batch_reads_the_weights_once() -> None:
    one, four = (stage_work(ModelConfig(), Job(batch=batch), 2) for batch in (1, 4))
    for stage in one:
        assert four[stage].flops == 4 * one[stage].flops
        assert one[stage].bytes <= four[stage].bytes < 1.2 * one[stage].bytes
    assert str(Job(batch=4)) == "2 cameras, 48 tokens, H=10, B=4, 10 steps"
    assert "batch" not in to_builtins(Job()) and to_builtins(Job(batch=4))["batch"] == 4


def test_batches_are_planned() -> None:
    plan = BenchPlan(["pytorch"], ["f32"], batches=[2, 1, 4])
    assert [job.batch for job in plan.jobs()] == [2, 1, 4] and plan.main == Job()
    assert [plan.judges(job) for job in plan.jobs()] == [False, True, False]
    joined = BenchPlan(["pytorch"], ["f32"], batches=[2, 4], joins=["none", "held"])
    assert [(job.batch, job.join) for job in joined.jobs()] == [(2, "none"), (4, "none"), (2, "held"), (4, "held")]
    joined.check(CPU, random_checkpoint("pi05_tiny"))
