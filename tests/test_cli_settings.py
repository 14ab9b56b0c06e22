"""turbopi serve --settings: the file's values are the command's defaults, and nothing in it is ignored."""

from pathlib import Path
from typing import Any

import pytest
from cli_helpers import refusal, turbopi

from turbopi.cli import serve as command
from turbopi.serve import ServerOptions

SETTINGS = """
random-weights = "pi05_tiny"   # a comment
port = 0
max_batch = 4
deadline-ms = 200
page = false
host = "0.0.0.0"
allowed-hosts = "robot.lab"
"""


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the server is started with."""
    seen: dict[str, Any] = {}

    def run(policy: Any, wanted: ServerOptions, **rest: Any) -> None:
        seen["options"] = wanted

    monkeypatch.setattr("turbopi.serve.run", run)
    monkeypatch.setattr(command.ActingOptions, "make_policy", lambda self, *_, **__: seen.update(policy=self))
    return seen


def test_a_file_gives_options_and_the_command_line_wins(
    tmp_path: Path, served: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(SETTINGS)
    result = turbopi("serve", "--settings", file, "--deadline-ms", 50)
    assert result.exit_code == 0, result.output
    options: ServerOptions = served["options"]
    assert (options.port, options.max_batch, options.deadline_ms, options.page) == (0, 4, 50.0, False)
    assert (options.host, list(options.allowed_hosts)) == ("0.0.0.0", ["robot.lab"])
    assert served["policy"].random_weights == "pi05_tiny"
    file.write_text(SETTINGS + 'api-key = "of-the-file"\n')
    monkeypatch.setenv("TURBOPI_API_KEY", "of-the-environment")
    assert turbopi("serve", "--settings", file, "--deadline-ms", 50).exit_code == 0
    assert served["options"].api_key == "of-the-environment"


def test_what_is_printed_can_be_read_again(tmp_path: Path, served: dict[str, Any]) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(SETTINGS)
    first = turbopi("serve", "--settings", file, "--api-key", "secret", "--print-settings")
    assert first.exit_code == 0 and not served, "nothing starts"
    assert "secret" not in first.stdout and "# api-key is given and not printed" in first.stdout
    for line in ("port = 0", "max-batch = 4", "page = false", "# checkpoint =", "deadline-ms = 200.0"):
        assert line in first.stdout.splitlines()
    file.write_text(first.stdout)
    again = turbopi("serve", "--settings", file, "--print-settings")
    kept = [line for line in first.stdout.splitlines() if "api-key" not in line]
    assert kept == [line for line in again.stdout.splitlines() if "api-key" not in line]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("prot = 3", "prot is no option of `turbopi serve`; is it port?"),
        ("zzz = 3", "zzz is no option of `turbopi serve`; its keys are checkpoint, host, port, "),
        ('port = "8000"', "port is '8000'; expected a whole number"),
        ("port = 1.5", "port is 1.5; expected a whole number"),
        ("strict = 1", "strict is 1; expected true or false"),
        ("max-batch = true", "max-batch is True; expected a whole number"),
        ("deadline-ms = true", "deadline-ms is True; expected a number"),
        ("host = 3", "host is 3; expected text in quotes"),
        ("robot = ['a']", "robot is ['a']; expected text in quotes"),
        ("port = 70000", "port is 70000: "),
        ("max-batch = 4\nmax_batch = 5", "max-batch is given twice, once as max_batch"),
        ("[network]\nport = 3", "network is no option of `turbopi serve`"),
        ("port =", "is no TOML file: "),
        ("settings = 'other.toml'", "settings is no option of `turbopi serve`"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(text: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(text)
    reported = refusal(turbopi("serve", "--settings", file))
    assert reported.startswith(f"{file}") and said in reported


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    assert "nothing.toml" in refusal(turbopi("serve", "--settings", tmp_path / "nothing.toml"))
