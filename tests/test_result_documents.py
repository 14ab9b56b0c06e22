"""Result documents: each kind is one Struct; what is checked in reads through it and comes out as it was."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import gpu_evidence
import numpy as np
import pytest
import torch
from attack.results import AttackDocument
from kernel_turns.document import read_turns
from load_test.document import LoadDocument
from msgspec import Meta, Struct
from packed import content_of, read_packed_benchmark

from turbopi.bench.document import BenchDocument, read_benchmark
from turbopi.bench.plots import fingerprint
from turbopi.bench.report import report
from turbopi.calibrate.report import read_report
from turbopi.support.errors import CalibrationError, ConfigError
from turbopi.support.provenance import Provenance
from turbopi.support.reading import as_document, plain_document, read_document

RESULTS = Path(__file__).parents[1] / "benchmarks" / "results"


class Inner(Struct, frozen=True):
    count: Annotated[int, Meta(ge=1, le=8)]
    kind: Literal["one", "other"] = "one"
    pair: tuple[int, float] = (1, 2.0)
    share: Annotated[float, Meta(ge=0)] | None = None


class Outer(Struct, frozen=True):
    format: Literal[1]
    by_name: dict[str, Inner]
    rows: list[Inner]
    reported: Mapping[str, object]
    limit: int | float | None
    name: Annotated[str, Meta(pattern=r"\S")]


GOOD = {
    "format": 1,
    "by_name": {"a name": {"count": 1}},
    "rows": [{"count": 2, "kind": "other", "pair": [3, 4.5], "share": 0.5}],
    "reported": {"anything": [1, {"x": None}]},
    "limit": 3,
    "name": "a",
}


def test_a_document_comes_out_as_it_went_in() -> None:
    document = as_document(GOOD, Outer, "FILE")
    assert document.rows[0] == Inner(2, "other", (3, 4.5), 0.5)
    written = json.loads(json.dumps(plain_document(document)))
    assert written == {**GOOD, "by_name": {"a name": {"count": 1, "kind": "one", "pair": [1, 2.0], "share": None}}}
    assert isinstance(written["limit"], int)  # not 3.0


def test_numpys_numbers_and_paths_are_written_as_jsons() -> None:
    inner = Inner(np.int64(3), share=np.float64(0.5))
    assert json.dumps(plain_document(inner)) == '{"count": 3, "kind": "one", "pair": [1, 2.0], "share": 0.5}'
    outer = Outer(1, {}, [], {"file": Path("a/b"), "version": torch.__version__}, None, "a")
    assert plain_document(outer)["reported"] == {"file": "a/b", "version": str(torch.__version__)}
    with pytest.raises(TypeError, match="a document holds <object obj"):
        plain_document(Outer(1, {}, [], {"x": object()}, None, "a"))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": 2}, "format is 2; expected 1"),
        ({"format": None}, "format is None; expected 1"),
        ({"by_name": {"a name": {}}}, "by_name.'a name'.count is missing; expected a whole number from 1 to 8"),
        ({"by_name": {"b": {"count": True}}}, "by_name.b.count is True; expected a whole number from 1 to 8"),
        ({"by_name": []}, "by_name is []; expected an object"),
        ({"rows": {}}, "rows is {}; expected a list"),
        ({"rows": [{"count": 1}, 7]}, "rows[1] is 7; expected an object"),
        ({"rows": [{"count": 9}]}, "rows[0].count is 9; expected a whole number from 1 to 8"),
        ({"rows": [{"count": 1.5}]}, "rows[0].count is 1.5; expected a whole number from 1 to 8"),
        ({"rows": [{"count": 1, "kind": "neither"}]}, "rows[0].kind is 'neither'; expected one of one, other"),
        ({"rows": [{"count": 1, "kind": ["one"]}]}, "rows[0].kind is ['one']; expected one of one, other"),
        ({"rows": [{"count": 1, "pair": [1]}]}, "rows[0].pair is [1]; expected a list of 2"),
        ({"rows": [{"count": 1, "pair": [1, "x"]}]}, "rows[0].pair[1] is 'x'; expected a finite number"),
        ({"rows": [{"count": 1, "share": -1}]}, "rows[0].share is -1; expected a finite number from 0 or null"),
        ({"rows": [{"count": 1, "share": "x"}]}, "rows[0].share is 'x'; expected a finite number from 0 or null"),
        ({"reported": None}, "reported is None; expected an object"),
        ({"limit": "x"}, "limit is 'x'; expected a finite number or null"),
        ({"name": " "}, "name is ' '; expected a text that isn't blank"),
    ],
)
def test_a_wrong_value_is_named_with_its_way_and_what_was_expected(
    change: dict[str, object], said: str, tmp_path: Path
) -> None:
    file = tmp_path / "document.json"
    file.write_text(json.dumps(GOOD | change))
    with pytest.raises(ConfigError) as reported:
        read_document(file, Outer, ConfigError, hint="; make it again")
    assert str(reported.value) == f"{file}: {said}; make it again"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"limit": NaN}', "limit is nan, which no JSON has"),
        ('{"limit": 1e999}', "beyond float64"),
        (f'{{"limit": {"9" * 30}}}', "beyond 64 bits"),
        (f'{{"reported": {"[" * 70}{"]" * 70}}}', "more than 64 deep"),
        ('{"limit": 1, "limit": 2}', "the key 'limit' is given twice"),
        ("[]", "expected an object"),
    ],
)
def test_what_no_json_may_hold_is_refused_in_documents_too(text: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "document.json"
    file.write_text(text)
    with pytest.raises(ConfigError, match=f"^{file}.*{said}"):
        read_document(file, Outer, ConfigError)


# -- what is checked in ------------------------------------------------------------------------------------------------

EVERY = sorted(
    path.relative_to(RESULTS).as_posix() for end in ("json", "json.xz") for path in RESULTS.rglob(f"*.{end}")
)


def text_of(name: str) -> str:
    return content_of(RESULTS / name).decode()


def _provenance(content: object) -> list[dict[str, object]]:
    """Every `provenance` in a document that names a device: the tools' own."""
    if isinstance(content, list):
        return [one for item in content for one in _provenance(item)]
    if not isinstance(content, dict):
        return []
    own = content.get("provenance")
    inside = [one for item in content.values() for one in _provenance(item)]
    return [*([own] if isinstance(own, dict) and "device" in own else []), *inside]


def test_every_provenance_that_is_checked_in_reads_and_comes_out_as_it_was() -> None:
    found = {name: _provenance(json.loads(text_of(name))) for name in EVERY}
    assert sum(map(len, found.values())) > 70
    more = {"clocks_at_the_end", "command", "environment"}  # a benchmark's own
    for name, all_of_it in found.items():
        for one in all_of_it:
            written = plain_document(as_document(one, Provenance, name))
            assert json.dumps(written) == json.dumps({key: one[key] for key in one if key not in more}), name


# shortened by hand, before result files were checked in as the tools write them
SHORTENED = {
    "h200_2026-11-21_pi05_libero_tensorrt.json": r"results\[0\]\.milliseconds\.preprocess is .*; expected an object",
}
BENCHMARKS = [name for name in EVERY if '"floors"' in text_of(name)]


@pytest.mark.parametrize("name", [name for name in BENCHMARKS if name not in SHORTENED])
def test_a_checked_in_benchmark_reads_and_comes_out_as_it_was(name: str) -> None:
    content = json.loads(text_of(name))
    document = read_packed_benchmark(RESULTS / name)
    for job in (content["main_job"], *(result["job"] for result in content["results"])):
        if job.get("image_width") == 224:  # one file's version wrote the usual size, too
            del job["image_width"], job["image_height"]
        if job.get("join") == "none":  # and the first version with it that nothing is joined
            del job["join"]
    assert json.dumps(plain_document(document)) == json.dumps(content)
    assert document.main_results and document.model in report(document)


@pytest.mark.parametrize("name", SHORTENED)
def test_a_benchmark_that_lacks_what_the_tool_writes_is_refused_by_key(name: str) -> None:
    with pytest.raises(ConfigError, match=f"{name}: {SHORTENED[name]}"):
        read_benchmark(RESULTS / name)


def test_a_benchmark_reads_the_same_whichever_way_a_number_is_written() -> None:
    """Plots name their document by its values: 0 and 0.0 are one."""
    content = json.loads((RESULTS / "cpu_2026-11-21_small_policy_bench.json").read_text())
    first = as_document(content, BenchDocument, "FILE")
    content["results"][0]["load_seconds"] = 1
    content["results"][0]["milliseconds"]["total"]["p50"] = 141.0
    whole = as_document(content, BenchDocument, "FILE")
    content["results"][0]["milliseconds"]["total"]["p50"] = 141
    assert fingerprint(as_document(content, BenchDocument, "FILE")) == fingerprint(whole) != fingerprint(first)


CONTENTS = {name: json.loads(text_of(name)) for name in EVERY}
OF_TURNS = [name for name, of in CONTENTS.items() if isinstance(of, dict) and {"rows", "provenance"} <= of.keys()]


@pytest.mark.parametrize("name", [name for name in OF_TURNS if "mhz" in text_of(name)])
def test_checked_in_turns_of_kernels_read_and_come_out_as_they_were(name: str) -> None:
    document = read_turns(RESULTS / name)
    assert document.rows
    assert json.dumps(plain_document(document)) == json.dumps(json.loads(text_of(name)))


@pytest.mark.parametrize("name", [name for name in EVERY if '"turbopi-attack"' in text_of(name)[:99]])
def test_checked_in_attacks_read_and_come_out_as_they_were(name: str) -> None:
    document = as_document(json.loads(text_of(name)), AttackDocument, name)
    assert len(document.pieces) > 3
    assert json.dumps(plain_document(document)) == json.dumps(json.loads(text_of(name)))


def test_checked_in_load_tests_read_and_come_out_as_they_were() -> None:
    for name in EVERY:
        if '"turbopi-load"' in (text := text_of(name))[:99]:
            document = as_document(json.loads(text), LoadDocument, name)
            assert json.dumps(plain_document(document), indent=1) + "\n" == text


def test_the_checked_in_gpu_results_read_and_come_out_as_they_were() -> None:
    for file in gpu_evidence.result_files():
        content = json.loads(file.read_text())
        content["tests"].pop("parts_to_go", None)  # of the first versions, where a part to go is one of `to_go`
        assert json.dumps(plain_document(gpu_evidence.read_result(file))) == json.dumps(content)


@pytest.mark.parametrize("key", ["tests", "golden", "fingerprint", "machine_code"])
def test_a_gpu_result_that_lacks_something_is_refused_by_key(key: str, tmp_path: Path) -> None:
    content = json.loads(gpu_evidence.result_files()[-1].read_text())
    del content[key]
    file = tmp_path / "gpu_check.json"
    file.write_text(json.dumps(content))
    with pytest.raises(ConfigError, match=f"{file}: {key} is missing"):
        gpu_evidence.read_result(file)


def test_the_checked_in_calibrations_report_reads_and_comes_out_as_it_was() -> None:
    report = json.loads((RESULTS / "h200_2026-11-26_pi05_libero/calibrate.json").read_text())["report"]
    read = read_report(report)
    assert json.dumps(plain_document(read)) == json.dumps(report)
    assert list(read.held_out.errors()) == [name for name in report["held_out"] if name != "worst"]
    del report["held_out"]["fp8-mlp"]
    with pytest.raises(CalibrationError, match=r"report: held_out\.'?fp8-mlp'? is missing"):
        read_report(report)
