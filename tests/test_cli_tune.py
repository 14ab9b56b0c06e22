"""`turbopi tune`: on a GPU that isn't there, with operations whose times are made up."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from cli_helpers import refusal, text_of, turbopi
from tile_helpers import ADA, tile_document, tuned_tile

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi import backends
from turbopi.backends import tuned_tiles
from turbopi.backends.tuned_tiles import Machine, find_tiles, read_tile_file, write_tile_file
from turbopi.kernels.tile_table import LIBRARY, Knobs, TileTable
from turbopi.support.errors import DeviceLost
from turbopi.tune import gpu, plan
from turbopi.tune.race import Round
from turbopi.tune.shapes import Operation

HOPPER = Machine("NVIDIA H200", (9, 0), 132, "580.95.05", "3.6.0")
STEADY = [100.0, 101.0] * 20


class FakeBench:
    """Fewer rows of a tile are faster; the library takes 100 us. Results of products' tiles of 32 rows are wrong."""

    bound = margin = 0.01

    def __init__(self, one: Operation) -> None:
        self.one = one

    def prepare(self, candidates: Sequence[Knobs]) -> Mapping[int, str]:
        return {}

    def error(self, knobs: Knobs) -> float:
        return 0.5 if knobs.get("rows") == 32 and "columns" in knobs else 0.001

    def timer(self, knobs: Knobs) -> Round:
        rows = 64 * knobs["warpgroups"] if "warpgroups" in knobs else knobs.get("rows", 100)
        return lambda: float(100 if LIBRARY in knobs else rows)


class FakeGpu:
    def __init__(self, monkeypatch: pytest.MonkeyPatch, cache: Path) -> None:
        self.machine, self.measured = ADA, list[Operation]()
        self.make: Callable[[Operation], Any] = FakeBench
        self.steady = STEADY
        self.cache = cache
        monkeypatch.setattr(backends, "resolve_device", lambda device: torch.device("cuda", 0))
        monkeypatch.setattr(backends, "availability", lambda name, device: None)
        monkeypatch.setattr(Machine, "of", classmethod(lambda cls, device: self.machine))
        monkeypatch.setattr(tuned_tiles, "cache_folder", lambda: cache)
        monkeypatch.setattr(gpu, "steadiness", lambda device: self.steady)
        monkeypatch.setattr(plan, "bench_maker", lambda config, device: self.bench)
        monkeypatch.setenv("COLUMNS", "80")

    def bench(self, one: Operation, tiles: TileTable) -> Any:
        self.measured.append(one)
        return self.make(one)

    @property
    def file(self) -> Path:
        return tuned_tiles.own_file(self.machine.gpu, self.cache)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeGpu:
    return FakeGpu(monkeypatch, tmp_path / "cache")


USUAL = ("--prompt-tokens", "48")


def test_it_measures_and_keeps_what_an_engine_then_takes(fake: FakeGpu) -> None:
    result = turbopi("tune", *USUAL)
    assert result.exit_code == 0, result.output
    document = read_tile_file(fake.file)
    assert (document.gpu, document.driver, document.compute_capability) == (ADA.gpu, ADA.driver, "8.9")
    assert len(document.tiles) == len(fake.measured) > 8
    found = find_tiles(ADA, cache=fake.cache)
    assert found.table.tiles == {one.key: one.tile for one in document.tiles} and "measured here" in found.about
    fastest = [one for one in document.tiles if one.operation in ("plain", "gelu") and one.numbers == "fp8"]
    assert fastest and all(one.tile["rows"] == 64 for one in fastest), "32 rows have a wrong result"
    assert all(one.microseconds <= one.usual_microseconds for one in document.tiles)


def test_the_table_fits_80_columns_and_says_what_a_call_gains(fake: FakeGpu) -> None:
    result = turbopi("tune", *USUAL)
    table = [line for line in result.stdout.splitlines() if "│" in line or "━" in line]
    assert len(table) > 10 and all(len(line) <= 80 for line in table)
    said = text_of(result.stdout)
    assert "2 cameras, 48 tokens, fp8, portable kernels: " in said and "ms gained (predicted)" in said
    assert f"kept for backend fused: {fake.file}" in said
    assert "a tile was refused: its error is 0.5; at most 0.01 is right" in said
    assert "prefix gate, up, fp8, 560 x 16384 x 2048: " in said, "a log has a line for each, as there is no bar"


def test_json_is_one_document_with_every_time(fake: FakeGpu) -> None:
    result = turbopi("tune", *USUAL, "--json", "--precision", "bf16")
    document = json.loads(result.stdout)
    assert document["machine"]["gpu"] == ADA.gpu and document["file"] == str(fake.file)
    assert {one["operation"] for one in document["measured"]} == {"vision_attention", "prefix_attention", "geglu"}
    assert all(one["best"]["microseconds"] <= one["usual"]["microseconds"] for one in document["measured"])


def test_a_dry_run_measures_and_writes_nothing(fake: FakeGpu) -> None:
    result = turbopi("tune", "--dry-run", "--json", "--batch", "1,4")
    planned = json.loads(result.stdout)["planned"]
    assert result.exit_code == 0 and len(planned) > 20 and all(len(one["tiles"]) > 1 for one in planned)
    assert not fake.measured and not fake.file.exists()


def test_hopper_gets_its_own_products_unless_portable_ones_are_asked_for(
    fake: FakeGpu, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake.machine = HOPPER

    def kernels(*arguments: str) -> set[str]:
        result = turbopi("tune", "--dry-run", "--json", *USUAL, *arguments)
        return {one["kernels"] for one in json.loads(result.stdout)["planned"]}

    assert kernels() == kernels("--kernels", "hopper") == {"hopper"}
    assert kernels("--kernels", "portable") == {"portable"} and kernels("--kernels", "all") == {"hopper", "portable"}
    assert kernels("--batch", "4") == {"hopper"}
    monkeypatch.setenv("TURBOPI_KERNELS", "portable")
    assert kernels() == {"portable"}


def test_what_an_earlier_run_found_is_kept_beside_the_new_and_need_not_be_measured_again(fake: FakeGpu) -> None:
    turbopi("tune", *USUAL, "--precision", "bf16")
    first = len(fake.measured)
    turbopi("tune", *USUAL, "--precision", "bf16", "--only-missing")
    assert len(fake.measured) == first
    result = turbopi("tune", *USUAL, "--only-missing")
    assert result.exit_code == 0 and len(read_tile_file(fake.file).tiles) == len(fake.measured) > first
    assert {one.numbers for one in fake.measured[first:]} == {"fp8"}
    assert "bf16, portable kernels" in result.stdout and "aren't measured yet" not in result.stdout


def test_tiles_of_another_driver_are_not_kept(fake: FakeGpu) -> None:
    write_tile_file(tile_document(ADA, tuned_tile(), driver="570.1"), fake.file)
    turbopi("tune", *USUAL, "--precision", "bf16", "--only-missing")
    assert {one.numbers for one in read_tile_file(fake.file).tiles} == {"bf16"}


def test_time_that_is_up_and_a_gpu_that_fails_lose_nothing(fake: FakeGpu) -> None:
    result = turbopi("tune", *USUAL, "--seconds", "0")
    assert result.exit_code == 2 and "time was up" in result.stdout and not fake.measured

    def make(one: Operation) -> FakeBench:
        if len(fake.measured) > 3:
            raise DeviceLost("the GPU cuda:0 failed: an illegal memory access")
        return FakeBench(one)

    fake.make = make
    result = turbopi("tune", *USUAL)
    assert result.exit_code == 4 and "an illegal memory access" in result.stderr
    assert len(read_tile_file(fake.file).tiles) == 3


def test_out_writes_elsewhere(fake: FakeGpu, tmp_path: Path) -> None:
    file = tmp_path / "shipped" / "rtx4090.json"
    assert turbopi("tune", *USUAL, "--precision", "bf16", "--out", file).exit_code == 0
    assert len(read_tile_file(file).tiles) == 3 and not fake.file.exists()
    assert [one.name for one in file.parent.iterdir()] == [file.name]
    measured = len(fake.measured)
    fake.machine = replace(ADA, driver="590.1")  # what ships holds for any driver
    turbopi("tune", *USUAL, "--only-missing", "--out", file)
    assert len(read_tile_file(file).tiles) == len(fake.measured) > measured


def test_a_shipped_tile_is_what_the_new_one_is_compared_with(
    fake: FakeGpu, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    turbopi("tune", *USUAL, "--precision", "fp8", "--out", tmp_path / "shipped" / "a.json")
    monkeypatch.setattr(tuned_tiles, "SHIPPED", tmp_path / "shipped")
    result = turbopi("tune", *USUAL, "--precision", "fp8", "--json")
    for one in json.loads(result.stdout)["measured"]:
        assert one["best"]["tile"] == one["usual"]["tile"], "what ships is the fastest already"


# ---- errors


def test_without_a_gpu_it_says_so() -> None:
    if torch.cuda.is_available():
        pytest.skip("there is one")
    said = refusal(turbopi("tune"))
    needs = "tiles are measured, and for --dry-run listed, on an NVIDIA GPU"
    assert said == f"{needs}, and there is none here; `turbopi doctor` says why"


def test_a_gpu_that_fused_cannot_use_comes_with_its_reason(fake: FakeGpu, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends, "availability", lambda name, device: "Triton isn't installed; `pip install triton`")
    assert refusal(turbopi("tune")).endswith("can't run here: Triton isn't installed; `pip install triton`")


def test_a_busy_gpu_is_refused_unless_noise_is_accepted(fake: FakeGpu) -> None:
    fake.steady = [100.0, 250.0] * 20
    said = refusal(turbopi("tune", *USUAL, "--json"), whole=False)
    assert "the GPU is busy: one and the same copy takes 100 to 250 us" in said and "nvidia-smi" in said
    assert not fake.measured
    assert turbopi("tune", *USUAL, "--noisy").exit_code == 0


def test_a_cache_that_cannot_be_written_is_an_error_before_anything_is_measured(fake: FakeGpu) -> None:
    fake.cache.write_text("a file where the folder should be")
    said = refusal(turbopi("tune"))
    assert "can't write" in said and str(fake.cache) in said and "--out FILE" in said and not fake.measured


def test_an_out_that_is_a_folder_is_an_error_before_anything_is_measured(fake: FakeGpu, tmp_path: Path) -> None:
    assert refusal(turbopi("tune", *USUAL, "--out", tmp_path)) == f"{tmp_path} is a folder; give a file's name"
    assert not fake.measured


def test_what_lies_beside_the_file_stays(fake: FakeGpu, tmp_path: Path) -> None:
    beside = tmp_path / "a.json.probe"
    beside.write_text("mine")
    assert turbopi("tune", *USUAL, "--precision", "bf16", "--out", tmp_path / "a.json").exit_code == 0
    assert beside.read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--kernels", "ada"], "--kernels is 'ada'; expected one of auto, portable, hopper, all"),
        (["--kernels", "hopper"], "--kernels hopper is for compute capability 9.0; this GPU has 8.9: leave it out"),
        (["--precision", "fp16"], "--precision has 'fp16'; tiles are measured for bf16 and fp8"),
        (["--batch", "3"], "--batch is '3'; expected some of 1, 2, 4, 8, 16, with commas between them"),
        (["--cameras", "two"], "--cameras is 'two'; expected some of 1, 2, 3, 4, with commas between them"),
        (["--prompt-tokens", "0"], "--prompt-tokens is '0'; expected whole numbers from 1, with commas between them"),
        (["--prompt-tokens", "201"], "--prompt-tokens is 201; this model takes up to 200"),
    ],
)
def test_what_is_asked_wrongly_is_named(fake: FakeGpu, arguments: list[str], said: str) -> None:
    assert refusal(turbopi("tune", *arguments)) == said


def test_fp8_is_refused_where_the_gpu_has_none(fake: FakeGpu) -> None:
    fake.machine = Machine("NVIDIA A100", (8, 0), 108, "580.95.05", "3.6.0")
    assert "from compute capability 8.9 on; this GPU has 8.0" in refusal(turbopi("tune", "--precision", "fp8"))
    planned = json.loads(turbopi("tune", "--dry-run", "--json", *USUAL).stdout)["planned"]
    assert {one["numbers"] for one in planned} == {"bf16"}


def test_help_has_examples_and_every_choice() -> None:
    said = text_of(turbopi("tune", "--help").stdout)
    assert "turbopi tune --dry-run" in said and "TURBOPI_TUNED=off" in said
    assert all(option in said for option in ("--precision", "--batch", "--kernels", "--seconds", "--out", "--noisy"))
    assert "Measure which tiles are the fastest on this GPU" in text_of(turbopi("--help").stdout)
