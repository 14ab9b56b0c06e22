"""Backends and commands of other distributions: found by entry points, imported when needed, named where broken."""

import json
import logging
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from cli_helpers import refusal, text_of, turbopi
from distributions import install

from turbopi import UnifiedPolicy, backends
from turbopi.checkpoint import random_checkpoint
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning
from turbopi.policy.shipped import SMALL_POLICY
from turbopi.support import extensions
from turbopi.support.errors import BackendError, BackendUnavailable, ConfigError, ObservationError

CPU = torch.device("cpu")
DOCUMENT = (Path(__file__).parents[1] / "docs" / "extending.md").read_text(encoding="utf-8")


def toy(folder: Path, group: str, *points: str, name: str = "toy") -> None:
    """An installed distribution with these entry points."""
    lines = [
        f'name = "{name}"',
        'version = "1.0"',
        'description = "A toy."',
        f'[project.entry-points."{group}"]',
        *points,
    ]
    install(folder, "\n".join(lines) + "\n")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of installed distributions; what it imports is forgotten afterwards."""
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("turbopi_noted", "turbopi_hello", "toy_module"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return tmp_path


@pytest.fixture
def documented(site: Path) -> Path:
    """The two packages of docs/extending.md."""
    for language, text in re.findall(r"^```(\w+)\n(.*?)^```$", DOCUMENT, re.MULTILINE | re.DOTALL):
        if language == "toml":
            install(site, text)
        elif language == "python":
            name = text.splitlines()[0].removeprefix("# ")
            (site / name).write_text(text, encoding="utf-8")
    return site


# The document's examples


def test_the_documented_backend_is_listed_and_runs(documented: Path) -> None:
    listed = json.loads(turbopi("doctor", "--device", "cpu", "--json").stdout)["backends"]
    (noted,) = (one for one in listed if one["name"] == "noted")
    assert (
        noted["available"]
        and noted["summary"] == "the reference in float32, which counts its calls (turbopi-noted 0.1.0)"
    )
    policy, plain = (
        UnifiedPolicy(random_checkpoint("pi05_tiny"), backend=name, precision="f32", device="cpu")
        for name in ("noted", "pytorch")
    )
    observation = plain.example_observation(0)
    ours, theirs = (one.infer(observation, seed=0, num_steps=1)["actions"] for one in (policy, plain))
    assert (ours == theirs).all()
    assert policy.metadata["backend"] == "noted" and policy.metadata["backend_details"]["calls"] == 1
    assert policy.metadata["real_time"]["modes"] == [] and not policy.runs_batches and not policy.pipelined
    with pytest.raises(ObservationError, match="backend 'noted' has no times, held actions or guidance by token"):
        policy.infer(
            observation, conditioning=Conditioning(held=np.arange(10) < 1, values=np.zeros((10, 32), np.float32))
        )
    with pytest.raises(ConfigError, match="backend 'noted' runs one observation at a time"):
        policy.submit(observation)
    with pytest.raises(BackendError, match="backend 'noted' has no halves of a call"):
        policy.backend.prefix(Observation.stack([policy.prepare(observation)]))


def test_the_documented_command_is_listed_without_being_imported_and_runs(documented: Path) -> None:
    help = text_of(turbopi("--help").stdout)
    assert "Of turbopi-hello 0.1.0 hello Greet a checkpoint's robot." in help
    assert "turbopi_hello" not in sys.modules
    assert "How often." in text_of(turbopi("hello", "--help").stdout)
    result = turbopi("hello", SMALL_POLICY, "--times", 2)
    assert (result.exit_code, result.stdout) == (0, "hello, libero\nhello, libero\n")
    assert refusal(turbopi("hello", "nowhere")) == "there is no folder nowhere"


# Broken ones


BROKEN = {
    "toy_missing:Backend": "can't load the {}: ModuleNotFoundError: No module named 'toy_missing'",
    "toy_module:Missing": "can't load the {}: AttributeError: module 'toy_module' has no attribute 'Missing'",
    "json:JSONEncoder": "the {} is no backend: it should derive from turbopi.backends.Backend",
    "toy_module:Half": "the {} is no backend: it lacks precisions, load_weights, sample",
    "turbopi.backends.pytorch:PyTorchBackend": "the {} has the name 'pytorch'; expected 'broken'",
    "toy_exits:Backend": "can't load the {}: SystemExit: 3",
}


@pytest.mark.parametrize("value", BROKEN)
def test_a_broken_backend_is_named_and_skipped(site: Path, value: str) -> None:
    half = "from turbopi.backends import Backend\nclass Half(Backend):\n    name = 'broken'\n"
    (site / "toy_module.py").write_text(half)
    (site / "toy_exits.py").write_text("import sys\nsys.exit(3)\n")
    toy(site, extensions.BACKENDS, f'broken = "{value}"')
    why = BROKEN[value].format(f"entry point 'broken' = '{value}' in turbopi.backends, of toy 1.0")
    listed = turbopi("doctor", "--device", "cpu", "--json")
    assert listed.exit_code == 0 and f"warning: skipped: {why}" in listed.stderr
    assert [one["name"] for one in json.loads(listed.stdout)["backends"]] == list(backends.BACKENDS)
    with pytest.raises(BackendUnavailable, match=re.escape(why)):
        backends.check("broken", CPU, "f32")
    backends.check("pytorch", CPU, "f32")


def test_a_check_of_the_device_that_fails_is_the_reason_why_a_backend_cannot_run(documented: Path) -> None:
    module = documented / "turbopi_noted.py"
    module.write_text(
        module.read_text() + "\n    @classmethod\n    def unavailable(cls, device):\n        return 1 / 0\n"
    )
    reason = backends.availability("noted", CPU)
    assert reason == "its check of the device failed: ZeroDivisionError: division by zero"
    with pytest.raises(BackendUnavailable, match="backend 'noted' can't run on cpu: its check"):
        backends.check("noted", CPU, "f32")


@pytest.mark.parametrize("name", ["fused", "auto"])
def test_a_backend_with_a_built_in_name_is_refused_by_name(
    site: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    toy(site, extensions.BACKENDS, f'{name} = "toy_module:Backend"')
    with caplog.at_level(logging.WARNING, "turbopi"):
        assert backends.known() == backends.BACKENDS
    entry = f"entry point '{name}' = 'toy_module:Backend' in turbopi.backends, of toy 1.0"
    assert caplog.messages == [f"skipped the {entry}: Turbo-Pi has a '{name}' of its own"]


def test_unknown_backends_are_told_of_those_that_are_installed(documented: Path) -> None:
    with pytest.raises(ConfigError, match=r"unknown backend 'notd'; choose one of pytorch, .*, noted, or 'auto'"):
        backends.check("notd", CPU, "f32")


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("import toy_missing", "can't load the {}: ModuleNotFoundError: No module named 'toy_missing'"),
        ("command = 3", "the {} is no command: TypeError: 3 is not a callable object"),
        ("def command(x: 'Missing') -> None: ...", "the {} is no command: NameError: name 'Missing' is not defined"),
    ],
)
def test_a_broken_command_is_named_where_it_runs_and_nowhere_else(site: Path, code: str, said: str) -> None:
    (site / "toy_module.py").write_text(code + "\n")
    toy(site, extensions.COMMANDS, 'broken = "toy_module:command"')
    listed = turbopi("--help")
    assert (listed.exit_code, listed.stderr) == (0, "") and " broken A toy. " in text_of(listed.stdout)
    entry = "entry point 'broken' = 'toy_module:command' in turbopi.commands, of toy 1.0"
    assert refusal(turbopi("broken")).startswith(said.format(entry))
    assert turbopi("inspect", "--random-weights", "pi05_tiny").exit_code == 0


def test_a_fault_in_a_command_is_its_distributions(site: Path) -> None:
    (site / "toy_module.py").write_text("def command() -> None:\n    1 / 0\n")
    toy(site, extensions.COMMANDS, 'broken = "toy_module:command"')
    result = turbopi("broken")
    assert result.exit_code == 3
    assert "error: this is a fault of toy 1.0 (ZeroDivisionError); please report it" in result.stderr


def test_commands_that_cannot_be_used_are_named_in_the_list(site: Path) -> None:
    toy(
        site, extensions.COMMANDS, 'serve = "toy_module:command"', 'nameless = "toy_module"', 'twice = "toy_module:one"'
    )
    toy(site, extensions.COMMANDS, 'twice = "toy_module:two"', name="toy2")
    listed = turbopi("--help")
    assert listed.exit_code == 0 and " twice " not in text_of(listed.stdout)
    entry = "the entry point '{}' = 'toy_module{}' in turbopi.commands, of {} 1.0"
    assert sorted(listed.stderr.splitlines()) == [
        f"warning: skipped {entry.format('nameless', '', 'toy')}: expected module:object",
        f"warning: skipped {entry.format('serve', ':command', 'toy')}: Turbo-Pi has a 'serve' of its own",
        "warning: skipped, as they have one name, "
        + "; ".join((entry.format("twice", ":one", "toy"), entry.format("twice", ":two", "toy2"))),
    ]


@pytest.mark.parametrize("content", [b"[turbopi.commands]\nno equals sign\n", b"\xff\xfe"], ids=["syntax", "binary"])
def test_damaged_metadata_of_one_distribution_hides_only_its_own(documented: Path, content: bytes) -> None:
    toy(documented, extensions.COMMANDS, 'one = "toy_module:one"')
    (documented / "toy-1.0.dist-info" / "entry_points.txt").write_bytes(content)
    listed = turbopi("--help")
    assert listed.exit_code == 0 and " hello " in text_of(listed.stdout)
    assert "warning: skipped the entry points of toy, which can't be read: " in listed.stderr


# What isn't needed isn't read


def test_turbopis_own_backends_and_commands_read_no_entry_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extensions, "found", lambda *_: pytest.fail("entry points were read"))
    assert turbopi("inspect", "--random-weights", "pi05_tiny").exit_code == 0
    backends.check("pytorch", CPU, "f32")


def test_a_command_of_turbopi_lab_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extensions, "found", lambda *_: {})
    for words in (("study",), ("study", "--help"), ("study", "steps", "--small")):
        assert refusal(turbopi(*words)) == (
            "`turbopi study` comes with the package turbopi-lab; in Turbo-Pi's clone: "
            "pip install -e packages/turbopi-lab"
        )
    assert " study " not in text_of(turbopi("--help").stdout)
