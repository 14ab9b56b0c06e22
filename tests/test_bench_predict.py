"""Predictions for GPUs that aren't here: from published numbers, labelled, and near what was measured where it was."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from cli_helpers import refusal, turbopi
from doc_tables.measured import WRITTEN, stale_measured, write_measured
from msgspec.structs import replace
from packed import read_packed_benchmark

from turbopi.bench.document import Result
from turbopi.bench.gpus import find_gpu, published_gpus
from turbopi.bench.measured import measured_calls
from turbopi.bench.predict import (
    MMA_SYNC,
    MOST_TOKENS,
    PRECISIONS,
    REACHED,
    STAGES,
    predict,
    predicted_call,
    published_floors,
    refused,
    runs_on,
)
from turbopi.bench.work import Job, stage_work
from turbopi.config import ModelConfig, preset
from turbopi.support.errors import ConfigError

ROOT = Path(__file__).parents[1]
FULL = ModelConfig()
NEAR = 1.25  # a prediction by one job's measurement is that near to what other jobs took


def checked_in() -> list[tuple[str, str, Result]]:
    """(file, key of the GPU, result) of every checked-in measurement of full-size calls on a GPU of the table."""
    found = []
    files = [*(ROOT / "benchmarks/results").glob("*.json"), *(ROOT / "benchmarks/results").glob("*/results.json*")]
    for file in files:
        try:
            document = read_packed_benchmark(file)
        except ConfigError:
            continue  # another kind of result
        gpu = document.provenance.gpu
        keys = [key for key in ("h100", "h200") if gpu and key in (gpu.name or "").lower()]
        if keys and document.model in ("pi05_libero", "pi05_base"):
            found += [(file.name, keys[0], result) for result in document.results]
    return found


def test_predictions_are_near_all_that_was_measured_on_hopper() -> None:
    """Of 1 to 3 cameras, 48 and 200 tokens, 1 to 10 steps, both horizons, from the main job on an H200 alone."""
    h200 = [one for one in measured_calls() if one.gpu == "h200"]
    own = [one for one in h200 if one.kernels != "portable"]  # as in the files, but for the portable ones'
    by_main_job = {(one.backend, one.precision): one for one in own if one.job == Job()}
    judged = 0
    for file, key, result in checked_in():
        measured = by_main_job.get((result.backend, result.precision))
        if measured is None or "portable" in file or result.job.of_size or result.job.joined or result.job.batch > 1:
            continue
        call = predicted_call(find_gpu(key), FULL, result.job, measured)
        took = result.milliseconds["total"].p50
        assert call.low_ms / NEAR < took < call.high_ms * NEAR, (file, result.job, took, call)
        judged += 1
    assert judged > 100


def test_all_that_was_measured_on_an_h100_is_in_the_range_that_the_h200_predicts() -> None:
    measured = {(one.gpu, one.kernels, one.precision, one.job): one for one in measured_calls()}
    of_h100 = [one for one in measured.values() if one.gpu == "h100"]
    pairs = [(one, measured.get(("h200", one.kernels, one.precision, one.job))) for one in of_h100]
    for one, elsewhere in pairs:
        assert elsewhere is not None
        call = predicted_call(find_gpu("h100"), FULL, one.job, elsewhere)
        assert call.low_ms < one.milliseconds["total"].p50 < call.high_ms, (one, call)
    assert len(pairs) == 24


@pytest.mark.parametrize(
    ("precision", "low", "high"),
    [
        # delays and ratios by hand, as in docs/dev/performance.md; the host's part, vision, prefix, denoising
        ("bf16", 0.467 + 4.88 + 15.81 + 8.67, 0.467 + 6.49 + 19.90 + 11.64),
        ("fp8", 0.385 + 2.34 + 8.55 + 5.40, 0.385 + 4.17 + 13.57 + 7.96),
        ("int8", 0.419 + 1.65 + 5.20 + 5.59, 0.419 + 2.70 + 7.48 + 8.32),
    ],
)
def test_the_call_on_an_rtx_4090_follows_from_figures_that_anybody_can_check(
    precision: str, low: float, high: float
) -> None:
    (one,) = (one for one in predict(find_gpu("rtx4090"), FULL, Job()) if one.precision == precision)
    (call,) = (call for call in one.calls if call.backend == "fused")
    assert call.low_ms == pytest.approx(low, abs=0.02) and call.high_ms == pytest.approx(high, abs=0.02)


def test_the_shares_of_published_rates_are_those_that_were_measured() -> None:
    for key, file in (("h200", "2026-11-27_in_layers/batches.json.xz"), ("h100", "2026-11-24_portable_kernels.json")):
        floors = read_packed_benchmark(ROOT / f"benchmarks/results/{key}_{file}").floors["bf16"]
        gpu = find_gpu(key)
        assert floors.matmul_flops_per_second / (gpu.bf16_tflops * 1e12) == pytest.approx(REACHED["matmul"], abs=0.005)
        assert floors.copy_bytes_per_second / (gpu.gb_per_second * 1e9) == pytest.approx(REACHED["copy"], abs=0.02)


def test_predictions_are_narrow() -> None:
    """Half of a range over its middle; where delays are most of a call, as on a B200, it is wider."""
    for gpu in published_gpus().values():
        for one in predict(gpu, FULL, Job()):
            for call in one.calls:
                half = (call.high_ms - call.low_ms) / (call.high_ms + call.low_ms)
                bf16 = one.precision == "bf16" and gpu.key not in ("h100", "b200")
                assert half < (0.2 if bf16 else 0.3 if gpu.capability[0] in MMA_SYNC else 0.33), call


def test_no_measured_call_is_under_its_published_floor() -> None:
    for one in measured_calls():
        floors = published_floors(find_gpu(one.gpu), FULL, one.job, one.precision)
        for name in (*STAGES, "total"):
            assert one.milliseconds[name].p50 > floors[name]


def test_on_the_measured_gpu_and_job_the_prediction_is_the_measurement() -> None:
    for one in measured_calls():
        call = predicted_call(find_gpu(one.gpu), FULL, one.job, one)
        took = one.milliseconds["total"].p50
        assert call.low_ms == pytest.approx(took) and call.high_ms == pytest.approx(took)


def test_chunks_beyond_the_denoising_kernel_may_take_longer_in_proportion() -> None:
    pytest.importorskip("triton", reason="Triton isn't installed")
    from turbopi.kernels.portable.denoise import kernel as portable
    from turbopi.kernels.sm90.denoise import kernel as hopper

    assert MOST_TOKENS == {"hopper": hopper.MAX_SUFFIX, "portable": portable.MAX_SUFFIX}
    wanted = Job(horizon=50)
    (measured,) = (
        one
        for one in measured_calls()
        if (one.gpu, one.kernels, one.precision, one.job) == ("h200", "hopper", "bf16", wanted)
    )
    took = {name: times.p50 for name, times in measured.milliseconds.items()}
    longest, longer = (
        predicted_call(find_gpu("h200"), FULL, replace(wanted, horizon=horizon), measured) for horizon in (56, 100)
    )
    assert longest.high_ms == pytest.approx(took["total"], rel=0.01)
    assert longer.high_ms == pytest.approx(took["total"] + took["denoise"] * 44 / 56, rel=0.01)


def test_longer_chunks_than_were_measured_take_longer_as_in_other_precisions() -> None:
    """By a call of ten actions: with fifty denoising took 2.38 ms more in bf16, 2.07 in FP8, 2.26 in INT8."""
    kind = ("int8", "portable", 10)
    (measured,) = (one for one in measured_calls() if (one.precision, one.kernels, one.job.horizon) == kind)
    call = predicted_call(find_gpu("h200"), FULL, Job(horizon=50), measured)
    assert call.low_ms == pytest.approx(9.384 + 2.071, abs=0.03)
    assert call.high_ms == pytest.approx(9.384 + 2.375, abs=0.03)
    between = predicted_call(find_gpu("h200"), FULL, Job(horizon=30), measured)
    assert between.low_ms == pytest.approx(9.384, abs=0.03) and between.high_ms == pytest.approx(call.high_ms, abs=0.03)


def test_what_a_gpu_refuses_is_what_the_kernels_refuse() -> None:
    pytest.importorskip("triton", reason="Triton isn't installed")
    from turbopi.kernels.portable.gemm.tiles import fp8_refusal, int8_refusal

    for gpu in published_gpus().values():
        assert refused(gpu, "bf16") is None
        assert refused(gpu, "fp8") == fp8_refusal(gpu.capability)
        assert refused(gpu, "int8") == int8_refusal(gpu.capability)


def test_predictions_and_plans_need_no_triton() -> None:
    """As in an installation for CPUs."""
    code = (
        "import sys; sys.modules['triton'] = None\n"
        "from turbopi.bench.batch_table import published_table\n"
        "print(published_table('orin', 'int8', 10).predicted)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "True", done.stderr


def test_where_a_gpu_was_measured_itself_no_other_ones_calls_are_taken() -> None:
    for gpu in {one.gpu for one in measured_calls()}:
        own = {one.precision for one in measured_calls() if (one.gpu, one.kernels) == (gpu, "hopper")}
        for precision in (one for one in predict(find_gpu(gpu), FULL, Job()) if one.precision in own):
            assert {call.measured_on for call in precision.calls if call.kernels == "hopper"} <= {gpu}


@pytest.mark.parametrize("key", list(published_gpus()))
def test_a_floor_is_the_work_at_the_published_rates(key: str) -> None:
    gpu = find_gpu(key)
    predictions = predict(gpu, FULL, Job())
    assert [one.precision for one in predictions] == [name for name in PRECISIONS if gpu.rate(name) is not None]
    for one in predictions:
        rate = gpu.rate(one.precision)
        assert rate is not None
        for stage, work in stage_work(FULL, Job(), 2 if one.precision == "bf16" else 1).items():
            seconds = max(work.flops / rate, work.bytes / (gpu.gb_per_second * 1e9))
            assert one.floor_ms[stage] == pytest.approx(1e3 * seconds)
        assert one.floor_ms["total"] == pytest.approx(sum(one.floor_ms[stage] for stage in STAGES))
        for call in one.calls:
            assert one.floor_ms["total"] < call.low_ms <= call.high_ms


def test_published_numbers_are_consistent() -> None:
    for gpu in published_gpus().values():
        assert (gpu.fp8_tflops is not None) == (gpu.capability >= (8, 9)), gpu
        assert gpu.source and gpu.bf16_tflops < gpu.int8_tops
        if gpu.fp8_tflops is not None:
            assert gpu.fp8_tflops == pytest.approx(2 * gpu.bf16_tflops, rel=0.02)


def test_hoppers_kernels_are_predicted_on_hopper_alone() -> None:
    assert [key for key, gpu in published_gpus().items() if runs_on("hopper", gpu)] == ["h100", "h200", "h20"]
    for gpu in published_gpus().values():
        kinds = {call.kernels for one in predict(gpu, FULL, Job()) for call in one.calls}
        assert ("hopper" in kinds) == (gpu.compute_capability == "9.0")


def test_a_precision_is_predicted_where_a_gpu_takes_it_and_nowhere_else() -> None:
    taken: dict[str, dict[str, bool]] = {one.precision: {} for one in predict(find_gpu("h200"), FULL, Job())}
    for key, gpu in published_gpus().items():
        for one in predict(gpu, FULL, Job()):
            taken[one.precision][key] = bool(one.calls)
    assert all(taken["bf16"].values()) and all(taken["fp8"].values())
    assert {key for key, there in taken["int8"].items() if not there} == {"thor", "b200"}


def test_a_batch_that_nobody_measured_has_a_floor_and_no_call() -> None:
    largest = max(one.job.batch for one in measured_calls())
    one = predict(find_gpu("h200"), FULL, Job())[0]
    many = predict(find_gpu("h200"), FULL, replace(Job(), batch=2 * largest))[0]
    assert one.floor_ms["total"] < many.floor_ms["total"] < 2 * largest * one.floor_ms["total"]
    assert many.calls == []


def test_a_smaller_model_has_a_floor_and_no_call() -> None:
    for one in predict(find_gpu("h200"), preset("pi05_tiny").planned_model, Job()):
        assert one.calls == []


def test_a_gpu_is_found_by_its_name_in_the_table() -> None:
    for gpu in published_gpus().values():
        assert find_gpu(gpu.name) == find_gpu(gpu.key) == gpu


@pytest.mark.parametrize("typed", ["rtx4090", "RTX 4090", "GeForce RTX 4090", "nvidia geforce rtx-4090"])
def test_a_gpu_is_found_as_people_write_it(typed: str) -> None:
    assert find_gpu(typed).key == "rtx4090"


def test_an_unknown_gpu_is_refused_with_the_list() -> None:
    with pytest.raises(ConfigError, match=r"'rtx9090'.*; did you mean rtx5090\? Known are rtx3090, .*b200"):
        find_gpu("rtx9090")
    with pytest.raises(ConfigError, match=r"'5090'.*; did you mean rtx5090\?"):
        find_gpu("5090")
    with pytest.raises(ConfigError, match="known are rtx3090"):
        find_gpu("-")


def test_the_packages_measured_calls_are_those_of_the_result_files(tmp_path: Path) -> None:
    assert stale_measured(ROOT) == []
    named = json.loads((ROOT / "benchmarks/measured.json").read_text())["files"]
    assert {one.source for one in measured_calls()} == {one["file"] for one in named}
    for folder in ("benchmarks/results", WRITTEN.parent):
        (tmp_path / folder).mkdir(parents=True)
    assert write_measured(tmp_path) == [], "nothing to write from"
    (tmp_path / "benchmarks/measured.json").write_text(json.dumps({"files": []}))
    (tmp_path / WRITTEN).write_text("")
    assert len(stale_measured(tmp_path)) == 1
    assert write_measured(tmp_path) == [tmp_path / WRITTEN] and stale_measured(tmp_path) == []


# --- the command ------------------------------------------------------------------------------------------------------


def test_the_command_says_that_it_predicts_and_fits_80_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    result = turbopi("bench", "--predict", ",".join(published_gpus()), "--batch", "1,8")
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert sum(line.startswith("PREDICTIONS, ms: ") for line in lines) == 2
    assert max(len(line) for line in lines if line[:1] in "┃│┏┗┡└") <= 80
    assert "These are predictions: nothing was run for them, but for those with a star." in lines
    assert any("rtx4090 bf16" in line and "cuda_graph" in line for line in lines)
    assert any(line.startswith("cuda_graph, PyTorch's kernels, as on h200: ") for line in lines)
    assert "int8: refused on thor, b200, see docs/gpus.md" in lines and "int8 on rtx3090, rtx4060ti" in result.stdout
    assert any("h200 fp8" in line and "portable" in line for line in lines)
    starred = {line.split()[1] for line in lines if line.startswith("│") and "*" in line}
    assert starred == {"h100", "h200"} and "* this call was measured on that GPU" in lines
    for gpu in published_gpus().values():
        assert f"  {gpu.name}: {gpu.source}" in lines


def test_the_commands_document_holds_the_same_predictions() -> None:
    result = turbopi("bench", "--predict", "l40s,thor", "--steps", "5", "--horizons", "50", "--json")
    document = json.loads(result.stdout)
    job = Job(steps=5, horizon=50)
    expected = [one for key in ("l40s", "thor") for one in predict(find_gpu(key), FULL, job)]
    assert [one["floor_ms"] for one in document["predictions"]] == [one.floor_ms for one in expected]
    assert document["predictions"][0]["calls"][0]["high_ms"] == expected[0].calls[0].high_ms


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--predict", "gtx1080"], "no published numbers of a GPU 'gtx1080'"),
        (["--predict", ","], "--predict names no GPU"),
        (["--predict", "h100", "--ready", "--backends", "fused"], "leave out --backends, --ready"),
        (
            ["--predict", "h100", "--calls", "5", "--no-error", "--device", "cpu", "--seconds", "1"],
            "leave out --device, --calls, --seconds, --no-error",
        ),
        (["--predict", "h100", "--batch", "0"], "--batch has 0; expected whole numbers from 1 to 1024"),
    ],
)
def test_what_cannot_be_predicted_is_refused(arguments: list[str], said: str) -> None:
    assert said in refusal(turbopi("bench", *arguments))
