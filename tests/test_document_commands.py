"""The commands in the documents for users: each parses, and those that need neither checkpoint nor GPU run."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
import typer
from cli_helpers import turbopi

from turbopi.cli import app

pytestmark = pytest.mark.usefixtures("two_layers", "unseen_plots", "unread_settings")

ROOT = Path(__file__).parents[1]
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
DOCUMENTS = (ROOT / "README.md", ROOT / "SECURITY.md", *FORMS, *sorted((ROOT / "docs").glob("*.md")))
GROUP = typer.main.get_command(app)
_BLOCK = re.compile(r"^```[a-z]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_INLINE = re.compile(r"`turbopi ([^`]+)`")


@pytest.fixture
def unread_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    """The documents' `--settings robot.toml` isn't here."""
    monkeypatch.setattr("turbopi.cli.settings._use", lambda *_: None)


def commands(document: Path) -> Iterator[list[str]]:
    """The words of every `turbopi …` in a document's code blocks, without comments, pipes and ampersands."""
    for block in _BLOCK.findall(document.read_text(encoding="utf-8")):
        for line in block.replace("\\\n", " ").splitlines():
            name, *words = shlex.split(line, comments=True) if line.strip().startswith("turbopi ") else [""]
            if name:
                yield [word for word in words if word != "&"]


def mentioned(document: Path) -> Iterator[list[str]]:
    """The words of every `turbopi …` in a document's text; … and options without values may be among them."""
    text = _BLOCK.sub("", document.read_text(encoding="utf-8"))
    for found in _INLINE.findall(text):
        yield found.split()


def command_of(words: list[str]) -> click.Command:
    context = click.Context(GROUP)  # type: ignore[arg-type]
    assert GROUP.get_command(context, words[0]) is not None, f"there is no `turbopi {words[0]}`"  # type: ignore[attr-defined]
    command: click.Command = GROUP.resolve_command(context, words[:1])[1]  # type: ignore[attr-defined]
    return command


def check_parses(words: list[str], where: str) -> None:
    try:
        command_of(words).make_context(words[0], words[1:])
    except click.ClickException as error:
        pytest.fail(f"{where}: turbopi {shlex.join(words)}: {error.format_message()}")


def all_of(kind: str) -> list[tuple[str, str]]:
    read = commands if kind == "blocks" else mentioned
    return [(path.relative_to(ROOT).as_posix(), shlex.join(words)) for path in DOCUMENTS for words in read(path)]


def examples() -> list[tuple[str, str]]:
    """(command, line) of the examples at the end of every --help."""
    context = click.Context(GROUP)  # type: ignore[arg-type]
    names: list[str] = GROUP.list_commands(context)  # type: ignore[attr-defined]
    found = [(name, re.findall(r"\[cyan\]turbopi (.*?)\[/\]", command_of([name]).epilog or "")) for name in names]
    assert all(lines for _, lines in found)
    return [(f"turbopi {name} --help", line) for name, lines in found for line in lines]


@pytest.mark.parametrize(("document", "line"), all_of("blocks") + examples())
def test_every_command_in_code_blocks_and_help_parses(document: str, line: str) -> None:
    check_parses(shlex.split(line), document)


@pytest.mark.parametrize(("document", "line"), sorted(set(all_of("text"))))
def test_every_command_in_the_text_exists_with_its_options(document: str, line: str) -> None:
    words = shlex.split(line)
    if words[0] == "…" or words[0].startswith("--"):
        return
    options = {name for one in command_of(words).params for name in (*one.opts, *one.secondary_opts)}
    unknown = [word for word in words[1:] if word.startswith("--") and word not in options | {"--help"}]
    assert not unknown, f"{document}: `turbopi {line}`"


def needs_nothing(words: list[str]) -> bool:
    """Whether a command runs anywhere in a minute: no checkpoint, no GPU, no second program."""
    reckons = "--predict" in words[:-1] or (words[0] == "plan" and "--gpu" in words)
    return words == ["doctor"] or "pi05_tiny" in words or reckons


@pytest.mark.slow
def test_commands_that_need_no_checkpoint_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tutorial's run in tests/test_tutorial.py."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    lines = {line for kind in ("blocks", "text") for name, line in all_of(kind) if name != "docs/tutorial.md"}
    runnable = [words for words in map(shlex.split, sorted(lines)) if needs_nothing(words)]
    assert any(words[0] == "eval" for words in runnable) and any(words[0] == "doctor" for words in runnable)
    assert any("--predict" in words for words in runnable) and any(words[0] == "plan" for words in runnable)
    for words in runnable:
        result = turbopi(*words)
        assert result.exit_code == 0, f"turbopi {shlex.join(words)}: {result.output}"
        assert "Traceback" not in result.output
