"""The container files say what holds: what they copy is there, what they run parses, and the port is the server's."""

import json
import re
import subprocess
from pathlib import Path

import pytest
from test_document_commands import check_parses

from turbopi.serve.options import ServerOptions

ROOT = Path(__file__).parents[1]
FILES = (ROOT / "Dockerfile", *sorted((ROOT / "docker").glob("Dockerfile.*")))
COMPOSE = ROOT / "compose.yaml"


def instructions(file: Path, name: str) -> list[str]:
    """What follows each `NAME …` of a Dockerfile, continued lines joined."""
    text = file.read_text(encoding="utf-8").replace("\\\n", " ")
    return re.findall(rf"^\s*{name} (.*)$", text, re.MULTILINE)


def compose_command() -> list[str]:
    """The service's command, with its variables' defaults."""
    block = re.search(r"^    command:\n((?:      - .*\n)+)", COMPOSE.read_text(encoding="utf-8"), re.MULTILINE)
    assert block is not None
    words = re.findall(r"^      - (\S+)", block.group(1), re.MULTILINE)
    return [re.sub(r"\$\{\w+:-(\w+)\}", r"\1", word) for word in words]


@pytest.mark.parametrize("file", FILES, ids=lambda path: path.name)
def test_what_an_image_runs_is_a_command_of_turbopi(file: Path) -> None:
    (command,) = instructions(file, "CMD")[-1:]
    check_parses(json.loads(command), file.name)


def test_what_the_service_runs_is_a_command_of_turbopi_with_a_key() -> None:
    words = compose_command()
    check_parses(words, COMPOSE.name)
    assert "--host=0.0.0.0" in words and any(word.startswith("--api-key-file=/run/secrets/") for word in words)


@pytest.mark.parametrize("file", FILES, ids=lambda path: path.name)
def test_what_an_image_copies_is_there_and_not_ignored(file: Path) -> None:
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    for copied in instructions(file, "COPY"):
        for name in copied.split()[:-1]:
            assert (ROOT / name).exists(), name
            assert f"!{name}" in ignored, name


@pytest.mark.parametrize("file", [file for file in FILES if file.suffix != ".libero"], ids=lambda path: path.name)
def test_health_is_asked_at_the_port_that_a_server_takes(file: Path) -> None:
    port = ServerOptions().port
    assert instructions(file, "EXPOSE") == [str(port)]
    (health,) = instructions(file, "HEALTHCHECK")
    assert f"http://127.0.0.1:{port}/healthz" in health
    assert f'"{port}:{port}"' in COMPOSE.read_text(encoding="utf-8")


@pytest.mark.parametrize("file", FILES, ids=lambda path: path.name)
def test_no_image_runs_as_root(file: Path) -> None:
    users = re.findall(r"^USER (\S+)", file.read_text(encoding="utf-8"), re.MULTILINE)
    assert users[-1] == "robot"


def test_an_image_installs_the_extras_that_it_is_built_with() -> None:
    """By the shell's own expansion; the document's extras are the package's."""
    (installed,) = re.findall(r'pip install ("\..*?") ', (ROOT / "Dockerfile").read_text(encoding="utf-8"))
    for extras, expected in (("", "."), ("ray", ".[ray]"), ("ray,view", ".[ray,view]")):
        reported = subprocess.run(["sh", "-c", f"printf %s {installed}"], env={"EXTRAS": extras}, capture_output=True)
        assert reported.stdout.decode() == expected
    assert 'EXTRAS=""' in instructions(ROOT / "Dockerfile", "ARG")
    named = re.findall(r"EXTRAS=([\w,]+)", (ROOT / "docs/docker.md").read_text(encoding="utf-8"))
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert named and all(re.search(rf"^{one} = \[", project, re.MULTILINE) for text in named for one in text.split(","))


def test_the_cpu_image_takes_the_pytorch_that_the_tests_run_with() -> None:
    (ours,) = re.findall(r"torch=\$\{TORCH:-(torch==[\d.]+)\}", (ROOT / "scripts/setup").read_text(encoding="utf-8"))
    assert any(line.startswith(f'CPU_TORCH="{ours} ') for line in instructions(ROOT / "Dockerfile", "ARG"))
