"""The command line as a whole: help, exit codes, where output and errors go."""

import inspect
import io
import json
import logging
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from checkpoint_helpers import GOLDEN
from cli_helpers import check_help, refusal, text_of, turbopi
from rich.console import Console
from rich.progress import Progress
from typer.testing import CliRunner

from turbopi.checkpoint import open_checkpoint
from turbopi.cli import app
from turbopi.cli.framework import Output, log_to_stderr, plain, with_errors_reported
from turbopi.cli.progress import with_stages
from turbopi.cli.typed import OF_POLICIES, OF_SERVERS, as_typed
from turbopi.policy.policy import UnifiedPolicy
from turbopi.serve import ServerOptions
from turbopi.support.errors import ConfigError, ObservationError

COMMANDS = (
    *(
        "demo",
        "infer",
        "serve",
        "view",
        "replay",
        "inspect",
        "convert",
        "calibrate",
        "build",
        "tune",
        "export",
        "verify",
        "bench",
        "plan",
    ),
    *("eval", "compare", "backends", "doctor"),
)
OLD_NAMES = ("backends",)  # that work for one version


def test_help_lists_every_command_and_the_exit_codes() -> None:
    help = text_of(turbopi("--help").stdout)
    group: Any = typer.main.get_command(app)
    assert set(COMMANDS) == set(group.commands), "a command came or went"
    for command in set(COMMANDS) - set(OLD_NAMES):
        assert f" {command} " in help
    for old in OLD_NAMES:
        assert (
            not re.search(rf"^│ {old} ", turbopi("--help").stdout, re.MULTILINE)
            and turbopi(old, "--help").exit_code == 0
        )
    for group in ("Run demo ", "Checkpoint inspect ", "Measure bench ", "Advanced plan "):
        assert group in help
    assert "Start with `turbopi demo`: it needs no checkpoint and no GPU." in help
    assert "0 all is well, 1 a check failed, 2 bad usage or input, 3 a fault of Turbo-Pi's own" in help


@pytest.mark.parametrize("command", COMMANDS)
def test_every_help_ends_with_examples_of_that_command(command: str) -> None:
    result = turbopi(command, "--help")
    assert result.exit_code == 0
    assert text_of(result.stdout).split("Examples ")[1].startswith(f"turbopi {command}")


@pytest.mark.parametrize("words", [(), *((command,) for command in COMMANDS)], ids=" ".join)
def test_help_is_whole_at_eighty_columns(words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """No word of an option, its values or its help is cut or broken, and every example can be copied as one line."""
    monkeypatch.setenv("COLUMNS", "80")
    group: Any = typer.main.get_command(app)
    check_help(group.commands[words[0]] if words else group, *words)


def test_help_shows_what_is_common_and_all_of_it_by_topic(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    short, whole = (turbopi("serve", word) for word in ("--help", "--help-all"))
    assert short.exit_code == whole.exit_code == 0
    assert len(short.stdout.splitlines()) <= 75
    assert "--host" in short.stdout and "--autoscaling" not in short.stdout
    left = re.search(r"(\d+) more options, by topic: turbopi serve --help-all", short.stdout)
    options = set(re.findall(r"(?:^  |, )(--[a-z-]+)", whole.stdout, re.MULTILINE))
    shown = set(re.findall(r"(?:^  |, )(--[a-z-]+)", short.stdout, re.MULTILINE))
    assert left is not None and shown < options and len(options - shown) == int(left[1])
    headings = [line for line in whole.stdout.splitlines() if re.fullmatch("[A-Z][^.:;]*", line)]
    assert headings[:2] == ["Arguments", "Network"] and headings[-1] == "Others"


@pytest.mark.parametrize("command", COMMANDS)
def test_descriptions_in_help_are_wide(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    group: Any = typer.main.get_command(app)
    names = {name for one in group.commands[command].params for name in one.opts}
    lines = turbopi(command, "--help-all" if "--help-all" in names else "--help").stdout.splitlines()
    wrapped = [line for line in lines if line.startswith(" " * 32) and line.strip()]
    assert not any(line.startswith(" " * 33) for line in wrapped), "all descriptions begin in one column: 48 are theirs"


@pytest.mark.parametrize("terminal", [True, False])
def test_messages_wrap_between_words_on_a_terminal_alone(terminal: bool) -> None:
    output, text = Output(), "word " * 30
    output.console = Console(file=io.StringIO(), width=40, force_terminal=terminal, color_system=None)
    output.line(text)
    lines = output.console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert len(lines) == (4 if terminal else 1)
    assert " ".join(" ".join(lines).split()) == text.strip()


def test_a_log_line_stands_above_a_progress_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = io.StringIO()
    terminal.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    log_to_stderr()
    with Progress(console=Console(file=terminal, force_terminal=True, width=60)) as bar:
        bar.add_task("moments", total=2)
        logging.getLogger("turbopi").warning("something is odd")
        bar.refresh()
    assert any(
        line.strip() == "warning: something is odd"
        for line in re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue()).splitlines()
    )


@pytest.mark.parametrize("command", app.registered_commands, ids=lambda command: str(command.name))
def test_an_option_whose_value_is_called_as_itself_has_its_name_written_out(command: Any) -> None:
    """Typer 0.27 takes the name from `metavar` otherwise: `--DEVICE`."""
    for parameter in inspect.signature(command.callback).parameters.values():
        for reported in getattr(parameter.annotation, "__metadata__", ()):
            if isinstance(reported, typer.models.OptionInfo) and str(reported.metavar).lower() == parameter.name:
                names = [reported.default, *(reported.param_decls or ())]  # Typer moves the first later
                assert f"--{parameter.name}" in names, parameter.name


@pytest.mark.parametrize("command", ["demo", "infer", "serve"])
def test_commands_that_run_a_policy_share_its_options(command: str) -> None:
    help = text_of(turbopi(command, "--help-all" if command == "serve" else "--help").stdout)
    shared = "random-weights weights-seed config backend precision steps device tokenizer default-prompt robot debug"
    for option in shared.split():
        assert f"--{option} " in help


def test_a_list_of_paths_is_named_in_the_usage_line() -> None:
    assert "turbopi infer [OPTIONS] [CHECKPOINT] OBSERVATION" in text_of(turbopi("infer", "--help").stdout)
    assert "turbopi convert [OPTIONS] [CHECKPOINT] FOLDER" in text_of(turbopi("convert", "--help").stdout)


def test_help_imports_neither_torch_nor_matplotlib() -> None:
    code = (
        "import sys; sys.argv = ['turbopi', 'demo', '--help']\n"
        "from turbopi.cli import main\n"
        "try: main()\n"
        "except SystemExit as end: assert end.code == 0\n"
        "heavy = {'torch', 'numpy', 'matplotlib', 'PIL', 'websockets'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, timeout=300)


def test_the_module_runs_as_the_console_script_does() -> None:
    command = [sys.executable, "-m", "turbopi.cli", "infer", "only-one-path"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith("error: infer takes two paths")
    assert "\x1b" not in result.stderr


def test_version_is_one_line() -> None:
    assert re.fullmatch(r"turbopi .+\n", turbopi("--version").stdout)


@pytest.mark.parametrize("arguments", [["nonsense"], ["demo", "--nonsense"], ["serve", "--port", "70000"], ["infer"]])
def test_bad_usage_is_exit_code_2(arguments: list[str]) -> None:
    assert turbopi(*arguments).exit_code == 2


def test_weights_must_be_named_exactly_once() -> None:
    assert refusal(turbopi("inspect")) == (
        "no weights: give a checkpoint's folder, or --random-weights PRESET (such as pi05_tiny) to do without"
    )
    assert refusal(turbopi("serve", "folder", "--random-weights", "pi05_tiny")) == (
        "two kinds of weights: the checkpoint 'folder' and --random-weights pi05_tiny; give one of them"
    )


def test_options_that_would_be_ignored_are_refused() -> None:
    assert "--weights-seed is the seed of --random-weights" in refusal(turbopi("inspect", "x", "--weights-seed", 1))


def test_messages_name_options_as_they_were_typed(tmp_path: Path) -> None:
    """The library says config= to a program, and the command line --config to whoever types."""
    golden = GOLDEN / "pi05" / "torch"
    with pytest.raises(ConfigError, match=r"Choose with config= one of pi05_base, "):
        open_checkpoint(golden)
    reported = refusal(turbopi("convert", golden, tmp_path / "out"))
    assert "Choose with --config one of pi05_base, " in reported and "config=" not in reported
    reported = turbopi("inspect", golden).stdout
    assert "Choose with --config one of pi05_base, " in reported and "config=" not in reported
    assert refusal(turbopi("convert", golden, tmp_path / "out", "--config", "pi06")).startswith(
        "--config pi06 is neither a preset, nor 'auto', nor a path to a .json; presets are pi05_base, "
    )
    reported = refusal(turbopi("convert", golden, tmp_path / "out", "--config", "pi05_liberoo"))
    assert "; did you mean pi05_libero? Presets are pi05_base, " in reported


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ("Choose with config= one of a, b", "Choose with --config one of a, b"),
        ('use config="auto", and', "use --config auto, and"),
        ("config='' is none", "--config '' is none"),
        ("Or pass its path as tokenizer=, or put", "Or pass its path as --tokenizer, or put"),
        ("try it with backend='fused'", "try it with --backend fused"),
        ("give num_denoising_steps=", "give --steps"),
        ("queue_limit=-1 should be 0 or more", "--queue-limit -1 should be 0 or more"),
        ("max_batch=2.5, or record_dir=", "--max-batch 2.5, or --record"),
        ("as in deadline_ms=nan.", "as in --deadline-ms nan."),
        ("CUDA graphs need a GPU; use backend 'pytorch'", "CUDA graphs need a GPU; use --backend pytorch"),
        (
            "backend 'onnx' can't; take solver 'euler' and time grid 'uniform', or backend 'fused' or 'pytorch'",
            "backend 'onnx' can't; take --solver euler and --time-grid uniform, or --backend fused or pytorch",
        ),
        (
            "take precision 'bf16', or to judge FP8 without such a GPU backend 'emulated_fp8'",
            "take --precision bf16, or to judge FP8 without such a GPU --backend emulated_fp8",
        ),
        ("take the GPU's; backend 'fused' has none", "take the GPU's; backend 'fused' has none"),
        ("runs/config=a.json isn't there", "runs/config=a.json isn't there"),
        ("my_config= is nothing of ours", "my_config= is nothing of ours"),
    ],
)
def test_only_arguments_are_worded_as_options(said: str, shown: str) -> None:
    assert as_typed(said) == shown


def test_options_are_called_as_the_command_has_them() -> None:
    said = "take precision 'bf16', or to judge FP8 without such a GPU backend 'emulated_fp8'"
    shown = "take --precisions bf16, or to judge FP8 without such a GPU --backends emulated_fp8"
    assert as_typed(said, {"--precisions", "--backends"}) == shown
    ran = turbopi("bench", "--random-weights", "pi05_tiny", "--precisions", "fp8", "--device", "cpu")
    assert ran.exit_code == 2 and "take --precisions bf16" in ran.stderr


def test_tables_fit_a_narrow_dumb_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.delenv("COLUMNS", raising=False)
    monkeypatch.setenv("TERM", "dumb")
    monkeypatch.setattr("shutil.get_terminal_size", lambda: os.terminal_size((60, 20)))
    monkeypatch.setattr(sys, "stdout", Terminal())
    assert Output().console.width == 60


@pytest.mark.parametrize("columns", [60, 100])
def test_help_is_as_wide_as_a_dumb_terminal(monkeypatch: pytest.MonkeyPatch, columns: int) -> None:
    monkeypatch.setenv("TERM", "dumb")
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("FORCE_COLOR", "1")  # as on a terminal
    described = turbopi("bench", "--help").stdout.split("Examples")[0]
    assert columns - 12 < max(map(len, described.splitlines())) <= columns


@pytest.mark.parametrize(("option", "value"), [("--port", "80x"), ("--port", "99999"), ("--max-batch", "-1")])
def test_a_wrong_value_is_named(option: str, value: str) -> None:
    ran = turbopi("serve", option, value)
    assert ran.exit_code == 2 and value in text_of(ran.stderr)


def test_every_argument_of_the_policy_is_an_option_of_the_policy_commands() -> None:
    arguments = set(inspect.signature(UnifiedPolicy.__init__).parameters) - {"self", "checkpoint_dir", "progress"}
    assert set(OF_POLICIES) == arguments


def test_every_option_of_a_server_is_worded_as_it_is_typed() -> None:
    assert set(OF_SERVERS) == {field.name for field in fields(ServerOptions)} | {"autoscaling"}
    shown = text_of(turbopi("serve", "--help-all").stdout)
    assert not [option for option in (*OF_POLICIES.values(), *OF_SERVERS.values()) if option not in shown]


def test_an_unknown_preset_lists_the_choices() -> None:
    message = refusal(turbopi("inspect", "--random-weights", "pi06"))
    assert message.startswith("unknown preset 'pi06'; choose one of pi05_base, pi05_libero")


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("--backend", "cuda", "unknown backend 'cuda'; choose one of pytorch, pytorch_compile"),
        ("--precision", "fp7", "unknown precision 'fp7'; choose one of bf16, f32"),
        ("--steps", "0", "the number of denoising steps is 0; it should be a whole number from 1"),
        ("--device", "tpu", "unknown device 'tpu'; use 'auto', 'cpu', 'cuda' or 'cuda:N'"),
        ("--tokenizer", "nowhere.model", "there is no tokenizer at nowhere.model"),
        ("--robot", "r2d2", "unknown robot 'r2d2'; choose one of libero"),
        ("--robot", "nomodule:Arm", "can't import the robot 'nomodule:Arm'"),
    ],
)
def test_wrong_values_of_shared_options_are_refused(option: str, value: str, expected: str) -> None:
    result = turbopi("demo", "--json", option, value)  # --json: what comes before the error goes to stderr
    assert (result.exit_code, result.stdout) == (2, "")
    assert expected in result.stderr.splitlines()[-1]


def errors_of(work: Callable[[], None], capsys: Any, debug: bool = False) -> tuple[int, str]:
    with pytest.raises(typer.Exit) as stopped:
        with_errors_reported(work, debug=debug)
    return stopped.value.exit_code, capsys.readouterr().err


def raising(error: BaseException) -> Callable[[], None]:
    def work() -> None:
        raise error

    return work


def test_an_error_on_purpose_is_one_line_and_code_2(capsys: Any) -> None:
    assert errors_of(raising(ObservationError("no [base] camera")), capsys) == (2, "error: no [base] camera\n")


def test_an_error_that_quotes_a_very_long_argument_is_short_and_keeps_its_end(capsys: Any) -> None:
    code, text = errors_of(raising(ObservationError(f"unknown {'x' * 10**5!r}; choose a, b")), capsys)
    assert (code, len(text) < 2100) == (2, True)
    assert text.startswith("error: unknown 'xxx") and text.endswith("xxx'; choose a, b\n")


def test_debug_adds_the_traceback(capsys: Any) -> None:
    code, text = errors_of(raising(ObservationError("no camera")), capsys, debug=True)
    assert code == 2
    assert text.startswith("Traceback")
    assert text.endswith("error: no camera\n")


def test_the_debug_variable_adds_the_traceback() -> None:
    result = CliRunner().invoke(app, ["inspect"], env={"TURBOPI_DEBUG": "1"})
    assert result.exit_code == 2
    assert "Traceback" in result.stderr


def test_our_own_fault_shows_its_traceback_and_is_code_3(capsys: Any) -> None:
    code, text = errors_of(raising(KeyError("vision")), capsys)
    assert code == 3
    assert text.startswith("Traceback")
    assert text.endswith(
        "this is a fault of Turbo-Pi's own (KeyError); please report it with the traceback "
        "and what `turbopi doctor --json` prints\n"
    )


def test_a_file_that_cannot_be_used_is_named(capsys: Any) -> None:
    error = PermissionError(13, "Permission denied", "/x/actions.npz")
    assert errors_of(raising(error), capsys) == (2, "error: /x/actions.npz: Permission denied\n")


def test_a_full_disk_is_no_fault_of_ours(capsys: Any) -> None:
    assert errors_of(raising(OSError(28, "No space left on device")), capsys) == (
        2,
        "error: can't write: No space left on device\n",
    )


def test_running_out_of_memory_says_what_the_model_needs(capsys: Any) -> None:
    code, text = errors_of(raising(MemoryError("8 GB")), capsys)
    assert code == 2
    assert text == (
        "error: out of memory: 8 GB. Full-size models need 7.2 GB in bf16 and 14.5 GB in f32; "
        "`turbopi doctor` shows what there is\n"
    )


def test_a_bar_is_drawn_once_its_first_stage_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """`0/?` tells nothing."""
    seen = io.StringIO()
    console = Console(file=seen, force_terminal=True, width=80)
    monkeypatch.setattr("turbopi.cli.progress.new_console", lambda *, stderr: console)
    monkeypatch.setattr(Output, "shows_progress", True)

    def work(reported: tuple[Callable[[str, int], None], Callable[[], None]]) -> str:
        begin, advance = reported
        begin("a stage", 2)
        advance()
        return "done"

    assert with_stages(work, lambda begin, advance: (begin, advance), Output()) == "done"
    assert "a stage" in seen.getvalue() and "1/2" in seen.getvalue()
    assert "?" not in seen.getvalue().replace("\x1b[?25", "")


def test_ctrl_c_is_quiet_and_code_130(capsys: Any) -> None:
    assert errors_of(raising(KeyboardInterrupt()), capsys) == (130, "")


def test_json_has_only_what_json_can_say() -> None:
    document = {"a": np.array([1.5, np.nan]), "b": (np.float32(2), float("inf")), 3: {"path": None}}
    assert json.loads(json.dumps(plain(document), allow_nan=False)) == {
        "a": [1.5, None],
        "b": [2.0, None],
        "3": {"path": None},
    }
