"""docs/gpus.md says of each GPU what the backends, the checked-in results and the predictions say."""

import json
import lzma
import re
from functools import lru_cache
from pathlib import Path

import pytest
import torch
from compile_for_all.document import Compiled, CompiledForAll, write_compiled
from doc_tables import gpus as tables
from tile_helpers import verdict

from turbopi import backends
from turbopi.backends import qualification
from turbopi.bench.gpus import find_gpu, published_gpus
from turbopi.bench.measured import measured_calls
from turbopi.bench.predict import predict
from turbopi.bench.work import Job
from turbopi.config import ModelConfig
from turbopi.support.errors import BackendUnavailable
from turbopi.support.reading import plain_document

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "gpus.md").read_text(encoding="utf-8")
GPUS_REQUESTED = ("rtx4090", "rtx5090", "l40s", "a100", "orin", "thor", "h100", "h200")  # issues and users name them


@lru_cache
def table() -> list[str]:
    return tables.gpus()


def cells(lines: list[str], name: str) -> dict[str, str]:
    """A row of a table, by its heads."""
    heads = [head.strip() for head in lines[0].split("|")[1:-1]]
    (row,) = (line for line in lines[2:] if line.startswith(f"| {name} |"))
    return dict(zip(heads, (cell.strip() for cell in row.split("|")[1:-1]), strict=True))


@pytest.mark.parametrize("key", list(published_gpus()))
def test_the_backend_in_the_table_is_the_one_that_auto_takes(key: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The registry is asked by another way than the table's own."""
    gpu = find_gpu(key)
    row = cells(table(), gpu.name)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device=None: gpu.capability)
    named = [name for name in qualification.KNOWN if re.search(rf"\b{gpu.key}\b", name.lower())]
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device=None: (*named, gpu.name)[0])
    monkeypatch.setattr(qualification, "kept", lambda device, precision, model: None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *rest: object())
    monkeypatch.setattr("shutil.which", lambda name, *rest: f"/usr/bin/{name}")
    monkeypatch.setattr("turbopi.support.toolchain._missing_headers", lambda: None)
    device = torch.device("cuda", 0)
    for precision in tables.TIERS:
        chosen = backends.choose(device, precision)[0]
        if row[precision] == "no":
            with pytest.raises(BackendUnavailable) as refused:
                backends.check(chosen, device, precision)
            reasons = [line for line in tables.gpu_refusals() if line.startswith(f"| {precision}: refused |")]
            said = str(refused.value).replace(f"this GPU has {gpu.compute_capability}", "this GPU has …")
            assert any(line.rstrip(" |").split("| ")[-1] in said for line in reasons)
        else:
            backends.check(chosen, device, precision)
            assert row[precision] == f"`{chosen}`" + tables.QUALIFIED * (not named)


def test_every_gpu_asked_for_has_its_rows() -> None:
    for key in GPUS_REQUESTED:
        assert TEXT.count(f"\n| {find_gpu(key).name} |") == 2, "what was done, and what it may take"


def test_only_what_a_checked_in_result_names_was_run() -> None:
    checked = [json.loads(file.read_text()) for file in tables.RESULTS.glob(tables.TESTED)]
    names = " ".join(one["provenance"]["gpu"]["name"].lower() for one in checked if one["ok"])
    measured = {call.gpu for call in measured_calls()}
    for gpu in published_gpus().values():
        said = cells(table(), gpu.name)["run"]
        tested = gpu.key in names.split()
        assert ("GPU tests" in said) == tested
        assert ("speed" in said) == (gpu.key in measured)


def test_a_failed_check_is_no_run(tmp_path: Path) -> None:
    file = next(tables.RESULTS.glob(tables.TESTED))
    (tmp_path / file.name).write_text(json.dumps(json.loads(file.read_text()) | {"ok": False}))
    assert "GPU tests" not in cells(tables.gpus(tmp_path), "H200 SXM")["run"]


def test_compiled_kernels_are_counted_by_target(tmp_path: Path) -> None:
    rows = [
        Compiled("a", "1", "sm_89"),
        Compiled("b", "1", "sm_89", problem="spills 400 bytes"),
        Compiled("c", "1", "sm_89", refused="Hopper's own"),
        Compiled("a", "1", "sm_120a"),
    ]
    write_compiled(tmp_path / tables.COMPILED, CompiledForAll("2026-11-27", {}, rows))
    found = tables.gpus(tmp_path)
    assert cells(found, "GeForce RTX 4090")["kernels compiled"] == "1 of 2"
    assert cells(found, "GeForce RTX 5090")["kernels compiled"] == "1"
    assert cells(found, "A100 80 GB SXM")["kernels compiled"] == "no"


def test_cases_run_as_ptx_count_for_their_gpu_and_newer_ones(tmp_path: Path) -> None:
    head = "run as PTX on Hopper"
    assert {cells(tables.gpus(tmp_path), gpu.name)[head] for gpu in published_gpus().values()} == {"not run yet"}
    rows = [{"target": "compute_80"}, {"target": "compute_80"}, {"target": "compute_89"}]
    (tmp_path / "h200_2026-11-26_ptx.json.xz").write_bytes(lzma.compress(json.dumps({"rows": rows}).encode()))
    (tmp_path / "h100_2026-11-25_ptx.json").write_text(json.dumps({"rows": rows * 2}))  # an older one
    found = tables.gpus(tmp_path)
    for name, count in (("A100 80 GB SXM", "2"), ("Jetson AGX Orin 64 GB", "2"), ("GeForce RTX 4090", "3")):
        assert cells(found, name)[head] == count
    rows[2]["problem"] = "differs"
    (tmp_path / "h100_2026-11-27_ptx.json").write_text(json.dumps({"rows": rows}))
    assert cells(tables.gpus(tmp_path), "Jetson AGX Thor (T5000)")[head] == "2 of 3"


def test_a_users_report_is_a_line(tmp_path: Path) -> None:
    assert tables.gpu_reports(tmp_path) == ["No report is here yet."]
    (tmp_path / "qualified").mkdir()
    raced = {"fused": {"total": 24.123}, "cuda_graph": {"total": 31.0}}
    reports = [
        verdict(milliseconds=raced, excluded={"batch": "its error is 1"}),
        verdict(precision="fp8", taken=None, failed=True, reason="its self-test failed: a | b"),
    ]
    for number, one in enumerate(reports):
        (tmp_path / "qualified" / f"{number}.json").write_text(json.dumps(plain_document(one)))
    about = "| NVIDIA GeForce RTX 4090 | 580.95.05 | pi05 |"
    assert tables.gpu_reports(tmp_path)[2:] == [
        f"{about} bf16 | 24.12 | 31.00 | fused | batch | 0.2.0 |",
        f"{about} fp8 |  |  | nothing | its self-test failed: a / b | 0.2.0 |",
    ]


def test_predictions_are_of_the_backend_that_runs_there() -> None:
    assert "are **predictions**" in TEXT
    rows, measured = tables.gpu_predictions(), {call.gpu for call in measured_calls()}
    for gpu in published_gpus().values():
        row, taken = cells(rows, gpu.name), tables.runs(gpu)
        by_precision = {one.precision: one for one in predict(gpu, ModelConfig(), Job())}
        assert row["bf16 floor"] == f"{by_precision['bf16'].floor_ms['total']:.1f}"
        assert bool(row["FP8 floor"]) == ("fp8" in by_precision)
        assert ("measured" in row["bf16 `fused`"]) == (gpu.key in measured)
        assert ("measured" in row["bf16 `cuda_graph`"]) == (gpu.key == "h200")
        for precision in ("fp8", "int8"):
            assert bool(row[f"{precision.upper()} `fused`"]) == (taken[precision] != "no")


def test_what_it_takes_of_memory_is_what_was_measured() -> None:
    """Of one observation and openpi's usual chunk of ten actions, on an H200."""
    taken: dict[tuple[str, ...], int | None] = {
        (call.backend, call.precision, call.kernels): call.device_bytes
        for call in measured_calls()
        if call.gpu == "h200" and call.job == Job()
    }
    said = {
        ("fused", "bf16", "hopper"): "7.8 GB of an H200 in bf16 with `fused`",
        ("cuda_graph", "bf16", "pytorch"): "6.8 with `cuda_graph`",
        ("fused", "fp8", "hopper"): "4.5 GB in FP8",
    }
    for kind, text in said.items():
        assert text in TEXT and text.startswith(f"{(taken[kind] or 0) / 1e9:.1f} ")
