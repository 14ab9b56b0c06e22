"""The documentation site: what goes into it, and that its folder is enough. The strict build: scripts/site."""

import importlib.util
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest
from chromium import PROGRAM, chromium
from doc_site import measurements
from doc_site.__main__ import command_line, fetched, main
from doc_site.reference import reference
from doc_site.staging import stage

import turbopi

ROOT = Path(__file__).parents[1]
WRITTEN = {"docs/cli_reference.md", "docs/api_reference.md", measurements.DOCUMENT}


def test_the_navigation_has_every_document() -> None:
    _, _, navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")
    named = re.findall(r"[\w/.-]+\.md", navigation)
    documents = {path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert len(named) == len(set(named)) and set(named) >= documents
    assert [name for name in named if not (ROOT / name).is_file() and name not in WRITTEN] == []


# --- the pages that are written anew ----------------------------------------------------------------------------------


def test_every_promised_name_is_in_the_reference() -> None:
    text = reference()
    promised = re.findall(r"^\| `(turbopi[\w.]*)` \| (.*) \|$", (ROOT / "docs" / "api.md").read_text(), re.MULTILINE)
    assert len(promised) == 7
    names = {name for _, listed in promised for name in re.findall(r"`(\w+)`", listed)} | set(turbopi.__all__)
    assert {"RealTimeExecutor", "RealTimeClient", "WAYS", "pack", "running"} <= names
    for name in names - {"__version__", "errors", "infer", "previous"}:
        assert f"## {name}\n" in text or f"- **`{name}`**: " in text, f"{name} isn't in the reference"
    assert "infer(\n    obs: Mapping[str, Any]," in text, "a signature"
    assert "- `total_ms`: " in text, "what infer returns"
    assert "[docs/real_time.md](real_time.md)" in text


def test_the_reference_of_the_command_line_has_every_command_but_old_names() -> None:
    text = command_line()
    assert re.findall(r"^## `turbopi (\w+)`", text, re.MULTILINE)[:3] == ["demo", "infer", "serve"]
    assert "* `--backend NAME`" in text and "\n    turbopi demo --real-time\n" in text
    assert "turbopi backends" not in text and "[cyan]" not in text and "&#x27;" not in text


def test_every_measured_call_links_to_its_raw_file() -> None:
    rows = [line for line in measurements.measurements(ROOT).splitlines() if line.startswith("| ")][1:]
    assert len(rows) > 200 and any("FlashRT" in row for row in rows)
    links = {re.fullmatch(r".*\| \[[^]]*\]\(\.\./(\S+)\) \|", row) for row in rows}
    assert None not in links and all((ROOT / found[1]).is_file() for found in links if found)
    portable = [row for row in rows if "portable" in row.split("|")[-2]]
    assert portable and all("portable kernels" in row.split("|")[3] for row in portable)


# --- the folder that the site is built of -----------------------------------------------------------------------------


def test_what_a_page_links_to_comes_along(tmp_path: Path) -> None:
    root, staged = tmp_path / "clone", tmp_path / "staged"
    (root / "docs").mkdir(parents=True)
    (root / "results" / "run").mkdir(parents=True)
    (root / "results" / "run" / "raw.json").write_text("{}")
    (root / "results" / "unlinked.json").write_text("{}")
    (root / "README.md").write_text("[a run](results/run), [ours](docs/written.md#part), [theirs](https://example.org)")
    (staged / "docs").mkdir(parents=True)
    (staged / "docs" / "old.md").write_text("of the last time")
    stage(root, staged, {"docs/written.md": "# Written\n"})
    files = {path.relative_to(staged).as_posix() for path in staged.rglob("*") if path.is_file()}
    assert files == {"README.md", "docs/written.md", "results/run/index.md", "results/run/raw.json"}
    assert "(results/run/index.md), [ours](docs/written.md#part)" in (staged / "README.md").read_text()
    assert "- [raw.json](raw.json)" in (staged / "results" / "run" / "index.md").read_text()


def test_a_link_to_nothing_is_refused(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("[it](docs/it.md)")
    with pytest.raises(FileNotFoundError, match=r"README\.md links to docs/it\.md"):
        stage(tmp_path, tmp_path / "staged", {})


def test_a_page_that_fetches_from_elsewhere_is_found(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(
        '<a href="https://b.org">b</a><link rel="canonical" href="https://c.org/"><img src=d>'
    )
    assert fetched(tmp_path) == []
    (tmp_path / "a.html").write_text('<script async src="https://cdn.org/x.js"></script>')
    assert fetched(tmp_path) == ['a.html fetches <script async src="https://cdn.org/x.js">']


# --- the site itself --------------------------------------------------------------------------------------------------


needs_mkdocs = pytest.mark.skipif(importlib.util.find_spec("material") is None, reason="needs scripts/setup docs")


@pytest.mark.slow
@needs_mkdocs
def test_a_dead_link_fails_the_build(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("NO_MKDOCS_2_WARNING", "1")
    monkeypatch.setattr("doc_site.__main__.reference", lambda: "# Python\n\n[Your GPU](gpus.md#nowhere)\n")
    assert main(["--out", str(tmp_path)]) == 1
    assert "does not contain an anchor '#nowhere'" in capfd.readouterr().err


@pytest.mark.slow
@needs_mkdocs
@pytest.mark.skipif(PROGRAM is None, reason="needs Chromium: apt-get install chromium")
def test_the_search_and_the_filter_work_from_disk(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "doc_site", "--out", str(tmp_path / "site")]
    subprocess.run(command, env={"PYTHONPATH": ":".join(sys.path), "NO_MKDOCS_2_WARNING": "1"}, check=True)
    with chromium(tmp_path) as page:
        page.open((tmp_path / "site" / "index.html").as_uri())
        page.until("document.readyState == 'complete'")
        search = """
            document.querySelector("[data-md-toggle=search]").click()
            const query = document.querySelector("[data-md-component=search-query]")
            query.value = "hold_on"
            query.dispatchEvent(new KeyboardEvent("keyup", {bubbles: true}))
        """
        page.value(f"(() => {{{inspect.cleandoc(search)}}})()")
        page.until("document.querySelector('.md-search-result__item')")
        page.open((tmp_path / "site" / "docs" / "measurements.html").as_uri())
        page.until("document.querySelectorAll('#measurements select').length == 6")
        shown = "[...document.querySelectorAll('#measurements tbody tr')].filter((row) => row.checkVisibility()).length"
        every = page.value(shown)
        choose = "menu.selectedIndex = 1; menu.dispatchEvent(new Event('change'))"
        page.value(f"(() => {{const menu = document.querySelector('#measurements select'); {choose}}})()")
        assert 0 < page.value(shown) < every
        assert page.console == []
        assert [url for url in page.requested if not url.startswith(("file:", "data:"))] == []
