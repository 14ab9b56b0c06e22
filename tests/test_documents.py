"""What the documents say: their tables and plots are the result files', their links lead somewhere."""

import ast
import json
import re
import shutil
from pathlib import Path

import pytest
import torch
from doc_tables import blocks, drawn, peers, studies
from doc_tables.__main__ import main
from doc_tables.results import RESULTS
from doc_tables.tables import TABLES, headline, whole_calls
from msgspec import to_builtins
from packed import content_of, read_packed_benchmark

from turbopi.bench.work import Job
from turbopi.support.provenance import provenance

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "benchmarks" / "results" / "h200_2026-11-26_pi05_libero" / "results.json.xz"
_LINK = re.compile(r"\]\(([^()\s]+(?:\([^()\s]*\)[^()\s]*)*)\)")


def test_every_table_and_plot_is_what_the_result_files_say(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--check"]) == 0, capsys.readouterr().err


def test_every_table_stands_in_a_document() -> None:
    used = {
        found["what"].split()[0]
        for document in blocks.documents(ROOT)
        for found in blocks._BLOCK.finditer(document.read_text(encoding="utf-8"))
    }
    assert used == set(TABLES)


@pytest.mark.parametrize("document", blocks.documents(ROOT), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_to_files_and_headings(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for link in _LINK.findall(text):
        if re.match(r"[a-z]+:", link):
            continue  # the web's links aren't followed: tests need no network
        path, _, anchor = link.partition("#")
        target = (document.parent / path).resolve() if path else document
        assert target.exists(), f"{link} leads nowhere"
        if anchor:
            assert anchor in headings(target), f"{link}: {target.name} has no such heading"


_CODE = re.compile(r"`([a-z0-9_/]+\.py):([A-Za-z_.]+)`")
_DEFINITIONS = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def test_the_code_that_the_request_page_names_exists() -> None:
    """docs/dev/request.md names functions as `path.py:Class.function`, below src/turbopi/."""
    named = _CODE.findall((ROOT / "docs/dev/request.md").read_text(encoding="utf-8"))
    assert len(named) > 20
    for path, name in named:
        body = ast.parse((ROOT / "src/turbopi" / path).read_text(encoding="utf-8")).body
        for part in name.split("."):
            found = [one for one in body if isinstance(one, _DEFINITIONS) and one.name == part]
            assert found, f"{path} has no {name}"
            body = found[0].body


_WITHOUT_A_FILE = re.compile(
    r"\bno result files?\b|\bno files? (was|were) kept|\b(files?|outputs?) (wasn't|weren't|was not|were not) kept"
)


@pytest.mark.parametrize("document", blocks.documents(ROOT), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_no_figure_is_said_to_have_no_result_file(document: Path) -> None:
    """A figure without a file is left out, or measured again."""
    found = _WITHOUT_A_FILE.search(" ".join(document.read_text(encoding="utf-8").split()))
    assert found is None, f"{found[0]!r}: expected a result file below benchmarks/results, or no figure"


def test_documents_for_users_stay_short() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(readme.splitlines()) <= 120
    pages = [*(ROOT / "docs").rglob("*.md"), ROOT / "CONTRIBUTING.md"]
    words = {page: len(page.read_text(encoding="utf-8").split()) for page in pages}
    users = len(readme.split()) + sum(count for page, count in words.items() if page.parent == ROOT / "docs")
    # 29,500 of Pi0 and Pi0.5; replay, notes on calls, ROS 2 and SmolVLA; HTTP, other benchmarks, a GPU's own test;
    # text, guidance, one step, traces
    assert users <= 32_000
    assert len(readme.split()) + sum(words.values()) <= 55_000


def test_the_glossary_has_each_word_once_in_order() -> None:
    text = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    words = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| ")][1:]
    assert len(words) >= 50 and words == sorted(set(words), key=str.lower)


def headings(document: Path) -> set[str]:
    """The anchors that GitHub makes of a document's headings."""
    text = re.sub(r"```.*?```", "", document.read_text(encoding="utf-8"), flags=re.DOTALL)
    titles = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


# --- the tool itself --------------------------------------------------------------------------------------------------


def project(folder: Path, table: str) -> Path:
    """A project with one document and one result file."""
    results = folder / "benchmarks" / "results" / "a"
    results.mkdir(parents=True)
    (results / "results.json").write_bytes(content_of(RESULT))
    (folder / "README.md").write_text(f"before\n<!-- table: {table} -->\n<!-- end of table -->\nbehind\n")
    return folder


def test_a_figure_that_was_changed_by_hand_is_found(tmp_path: Path) -> None:
    root = project(tmp_path, "headline a/results.json")
    assert blocks.fill(root) == [root / "README.md"]
    assert blocks.differences(root) == [] and blocks.fill(root) == []
    text = (root / "README.md").read_text()
    assert text.startswith("before\n") and text.endswith("behind\n")
    assert "\n\nRaw: [a/results.json](benchmarks/results/a/results.json)\n" in text
    number = re.search(r"\d+\.\d", text)
    assert number is not None
    (root / "README.md").write_text(text.replace(number[0], "0.1"))
    (found,) = blocks.differences(root)
    assert "README.md" in found and "0.1" in found and "scripts/tables" in found


@pytest.mark.parametrize(
    ("table", "said"),
    [("nonsense a/results.json", "no table is named 'nonsense'"), ("headline b.json", "no result file b.json")],
)
def test_a_place_that_names_nothing_is_refused(tmp_path: Path, table: str, said: str) -> None:
    with pytest.raises(blocks.TableError, match=said):
        blocks.fill(project(tmp_path, table))


def test_a_report_of_a_study_that_was_changed_by_hand_is_found_and_written_anew(tmp_path: Path) -> None:
    folder = tmp_path / "benchmarks" / "results" / "some" / "mask"
    folder.mkdir(parents=True)
    for file in (RESULT.parents[1] / "cpu_2026-11-26_studies" / "mask").iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    assert studies.stale_reports(tmp_path) == [] == studies.write_reports(tmp_path)
    text = folder / "report.md"
    text.write_text(text.read_text().replace("held", "nearly held"))
    (folder / "mask.png").unlink()
    assert len(studies.stale_reports(tmp_path)) == 2
    assert text in studies.write_reports(tmp_path) and studies.stale_reports(tmp_path) == []


def test_a_table_without_an_end_is_refused(tmp_path: Path) -> None:
    root = project(tmp_path, "headline a/results.json")
    (root / "README.md").write_text("<!-- table: headline a/results.json -->\n")
    with pytest.raises(blocks.TableError, match="end of table"):
        blocks.fill(root)


def test_plots_of_another_document_are_drawn_anew(tmp_path: Path) -> None:
    root = project(tmp_path, "headline a/results.json")
    assert len(drawn.stale_plots(root)) == 3
    assert {path.name for path in drawn.draw(root)} == set(drawn.PLOTS)
    assert drawn.stale_plots(root) == []
    file = root / "benchmarks" / "results" / "a" / "results.json"
    document = json.loads(file.read_text())
    document["results"][0]["milliseconds"]["total"]["p50"] += 1
    file.write_text(json.dumps(document))
    assert len(drawn.stale_plots(root)) == 3


def test_the_plot_beside_others_is_of_the_table() -> None:
    page = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    assert f"<!-- table: peers {' '.join(peers.RUNS)} -->" in page
    assert peers.PLOT.as_posix() in (ROOT / "README.md").read_text(encoding="utf-8")
    drawn = peers.bars(ROOT)
    undated = [re.sub(r" \(\d{4}-\d\d-\d\d\)", "", name) for name, _ in drawn]
    assert undated == [*peers.DRAWN[:-1], "openpi, PyTorch compiled (on the GPU alone)"]
    for name, ms in drawn:
        (row,) = re.findall(rf"^\| {re.escape(name.replace(' (on the GPU alone)', ''))} \|.*$", page, re.MULTILINE)
        assert f"| {ms:.2f} |" in row
    assert (ROOT / peers.PLOT).stat().st_size < 20_000


def test_the_plot_beside_others_is_drawn_anew_for_other_figures(tmp_path: Path) -> None:
    assert peers.stale_peers(tmp_path) == []  # nothing to draw
    (tmp_path / "docs").mkdir()
    folder = (tmp_path / RESULTS / peers.RUNS[0]).parent
    shutil.copytree(ROOT / RESULTS / folder.name, folder)
    assert len(peers.stale_peers(tmp_path)) == 1
    assert peers.draw_peers(tmp_path) == [tmp_path / peers.PLOT]
    assert peers.stale_peers(tmp_path) == [] == peers.draw_peers(tmp_path)
    file = folder / "flashrt_openpi.jsonl"
    file.write_text(file.read_text().replace("15.019", "15.029"))
    assert len(peers.stale_peers(tmp_path)) == 1


def test_a_new_run_beside_others_is_in_the_table_once_it_lies_there(tmp_path: Path) -> None:
    for folder in (ROOT / RESULTS).glob("h200_*_peers"):
        shutil.copytree(folder, tmp_path / RESULTS / folder.name)
    page = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    (before,) = re.findall(r"<!-- table: peers .*?<!-- end of table -->", page, re.DOTALL)
    assert blocks.filled(before, tmp_path, tmp_path / "docs") == before
    timed = {"program": "flashrt", "setting": "bf16", "part": "whole call", "job": to_builtins(Job()), "calls": 3}
    timed |= {"p50_ms": 17.5, "p95_ms": 18.0, "rounds_ms": [17.5], "setup_s": 1.0, "actions": [10, 32]}
    run = {"kind": "turbopi-peers", "provenance": to_builtins(provenance(torch.device("cpu"))), "clocks": []}
    run |= {"command": [], "small": False, "timed": [timed | {"versions": {}, "note": ""}], "not_measured": []}
    new = tmp_path / RESULTS / "h200_2026-12-01_peers" / "peers.json"
    new.parent.mkdir()
    new.write_text(json.dumps(run))
    after = blocks.filled(before, tmp_path, tmp_path / "docs")
    assert "| FlashRT, bf16 | 17.50 |  |  |  |" in after and "| FlashRT, FP8 (2026-11-29) | 16.01 |" in after
    assert "(../benchmarks/results/h200_2026-12-01_peers/peers.json)" in after
    assert ("FlashRT, bf16", 17.5) in peers.bars(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.txt", "realtime-vla triton views=3 lang=48 H=10 steps=10: 22.71 ms\n", "has no job of 2 cameras"),
        ("a.jsonl", '{"peer": "x", "setting": "y", "job": "z", "p50_ms": -1}\n', "line 1: p50_ms is -1"),
        ("a.csv", "", "a peer's run is"),
    ],
)
def test_an_output_of_another_job_or_kind_is_refused(name: str, text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=said):
        peers.read_run(tmp_path / name)


def test_tables_hold_the_numbers_of_their_job() -> None:
    document = read_packed_benchmark(RESULT)
    (measured,) = [result for result in document.main_results if (result.backend, result.precision) == ("fused", "fp8")]
    median = measured.milliseconds["total"].p50
    assert f"**{median:.1f} ms**" in headline(document)[2]
    (row,) = [line for line in whole_calls(document)[-6:] if line.startswith("| 2, 48 |")]
    assert f"/ {median:.2f} |" in row
