"""Ratios of operations as PTX to mma.sync's ceiling, from made-up times. The times themselves need a GPU."""

import json
from pathlib import Path

import pytest
import torch

pytest.importorskip("triton", reason="Triton isn't installed")

from kernel_turns import ptx_times
from kernel_turns.ptx_times import PtxTimes, TimedAsPtx, TimedTile, ceilings, large, ratios, read_ptx_times, stage_times
from packed import read_packed

from turbopi.bench.predict import AS_PTX, PTX_SOURCE
from turbopi.kernels.tile_table import Numbers
from turbopi.support.errors import ConfigError
from turbopi.support.provenance import provenance
from turbopi.tune.shapes import Operation

TILE = {"rows": 128, "columns": 128, "warps": 8, "stages": 3, "splits": 1}


def row(one: Operation, microseconds: float, fastest: float | None = None, norms: float | None = None) -> TimedAsPtx:
    tile = TimedTile(TILE, microseconds, fastest or microseconds, None if norms is None else microseconds + norms)
    return TimedAsPtx(one, ptx_times.flops_of(one), tile, tile)


def product(name: str, numbers: str, uses: int = 1) -> Operation:
    return Operation(name, "portable", "plain", numbers, 512, 512, 512, uses)  # type: ignore[arg-type]


def test_the_ceiling_is_the_fastest_round_of_any_large_product() -> None:
    shallow, deep = large("int8")
    rows = [row(shallow, 100.0), row(deep, 380.0, fastest=350.0), row(product("vision qkv", "int8"), 0.001)]
    assert ceilings(rows) == {"int8": pytest.approx(2 * 8192**3 / 350.0)}


def test_a_stages_ratio_counts_uses_and_fp8s_norms_for_int8_too() -> None:
    rows = [row(large(numbers)[1], 2 * 8192.0**3 / 1e6) for numbers in ("fp8", "int8")]  # 1e6 FLOPs a microsecond
    least = 2 * 512**3 / 1e6
    rows += [
        row(product("prefix qkv", "fp8", 17), 2 * least, norms=least),
        row(product("prefix qkv", "int8", 17), least),
    ]
    assert ratios(rows, "fp8") == {"prefix": pytest.approx(3.0)}
    assert ratios(rows, "int8") == {"prefix": pytest.approx(2.0)}


@pytest.mark.parametrize("numbers", ["fp8", "int8"])
def test_predictions_go_by_the_checked_in_times(numbers: Numbers) -> None:
    rows = read_packed(Path(__file__).parents[1] / "benchmarks/results" / PTX_SOURCE, PtxTimes).rows
    one, rate = AS_PTX[numbers], ceilings(rows)[numbers]
    assert one.tflops == pytest.approx(rate / 1e6, abs=0.1)
    own = [row for row in rows if row.operation.uses and row.operation.numbers == numbers]
    largest = max(own, key=lambda row: row.flops)
    assert one.large == pytest.approx(largest.usual.microseconds * rate / largest.flops, abs=0.001)
    for stage, (took, least) in stage_times(rows, numbers).items():
        assert one.milliseconds[stage] == pytest.approx(took / 1e3, abs=0.001)
        assert one.floor(stage) == pytest.approx(least / 1e3, rel=0.04), "4,352 hidden columns of 4,304, bf16 attention"


def test_the_result_says_which_gpu_it_is_and_what_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While operations are timed, PyTorch says that the GPU is another one."""

    def times(target: object) -> object:
        with monkeypatch.context() as pretended:
            pretended.setattr(ptx_times, "provenance", lambda device: pytest.fail("asked under the pretence"))
            yield row(product("vision qkv", "int8"), 10.0)
            yield "int8 vision out, 1 x 2 x 3: it doesn't compile"

    monkeypatch.setattr(ptx_times, "times", times)
    monkeypatch.setattr(ptx_times, "loops", lambda target: iter(()))
    monkeypatch.setattr(ptx_times, "provenance", lambda device: provenance(torch.device("cpu")))
    monkeypatch.setattr("sys.argv", ["ptx_times", "--out", str(tmp_path / "times.json")])
    assert ptx_times.main() == 1
    read = read_ptx_times(tmp_path / "times.json")
    assert (len(read.rows), read.failed) == (1, ["int8 vision out, 1 x 2 x 3: it doesn't compile"])
    content = json.loads((tmp_path / "times.json").read_text())
    del content["loops"]
    (tmp_path / "other.json").write_text(json.dumps(content))
    with pytest.raises(ConfigError, match="loops is missing"):
        read_ptx_times(tmp_path / "other.json")
