"""Absurd command lines: every option of every command, with values that nobody means.

The options are read from the command line's own declarations, so that a new one is attacked as soon as it exists. All
that a command may write lies in a folder of its own; devices there are copies, so that /dev stays as it is.
"""

import inspect
import os
import random
import shutil
import stat
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from typer.models import OptionInfo

from attack.arena import Found, Tick
from attack.specimens import write_observation
from attack.zygote import Job, Zygote, fault

SECONDS, MEMORY_MB = 120.0, 4000.0
SERVE_SECONDS = 12.0  # a server that comes up in spite of its options is ended then
FLEET_SECONDS = 60.0  # so is one with --ray, which starts a cluster first

_TINY = ("--random-weights", "pi05_tiny")
_QUICK = (*_TINY, "--steps", "1")
# How a command is called when nothing is absurd. {here} is its folder.
_FEW = ("--trials", "1", "--tasks", "0", "--max-steps", "3", "--workers", "1")
BASES: dict[str, tuple[str, ...]] = {
    "infer": (*_QUICK, "{here}/observation.npz", "--no-warmup", "--no-plot", "-o", "{here}/actions.npz"),
    "serve": (*_QUICK, "--no-warmup", "--port", "0"),
    "inspect": _TINY,
    "convert": (*_TINY, "{here}/converted"),
    "calibrate": (*_TINY, "--count", "2", "--steps", "1", "-o", "{here}/calibration.json"),
    "verify": (*_QUICK, "--count", "1", "--noises", "1", "--backend", "pytorch"),
    "eval": ("reacher", *_QUICK, *_FEW, "--out", "{here}/eval"),
    "compare": ("pytorch:bf16", *_QUICK, *_FEW, "--simulator", "reacher", "--out", "{here}/compare"),
    "bench": (*_TINY, "--steps", "1", "--calls", "1", "--main-calls", "1", "--seconds", "0", "--backends", "pytorch"),
    "tune": ("--seconds", "0", "--out", "{here}/tiles.json"),
    "plan": ("--robots", "3", "--hz", "20", "--horizon", "10", "--gpu", "h200"),
    "export": ("onnx", *_TINY, "{here}/onnx"),
    "build": _TINY,
    "demo": (*_QUICK, "--frames", "1", "--episodes", "0", "--report", "{here}/report"),
    "view": ("{here}/nothing", "--save", "{here}/view.rrd"),
    "replay": ("{here}/observation.npz", *_QUICK, "--changed", "0", "--every", "1", "--report", "{here}/replay"),
    "backends": (),
    "doctor": ("--port", "1"),
}
_RARE = ("eval", "compare", "demo", "bench")  # seconds each: a fifth as often
# Values of these could reach other machines, or files outside the folder.
_NEVER = ("--host", "--help", "--help-all", "-h", "--install-completion", "--show-completion", "--debug", "--version")
_OUTPUTS = ("--out", "--save", "--record", "--report", "--plot", "--cache")

# fmt: off
NUMBERS = (
    "-1", "0", "1", "7", "-0", "1e3", "nan", "inf", "-inf", "1e308", "1e-320", "", " ", "x", "१२", "0x10",
    "1_0", "1.5", "--", "1,2", "0-999999999", "9" * 400, str(2**31), str(2**63), str(2**64), str(10**18),
)
TEXTS = (
    "", " ", "x", "a" * 100_000, "\n", "\x1b[31mred", "[red]", "[/]", "🤖", "\udcff\udcfe", "%s%n", "{0}", "'",
    "--", "../../..", ".", "a/b", "pi05_libero", "cpu:7", "cuda:99", "meta", "mps", "module:Class", "os:system",
    ":", "x:", "bf16,bf16", ",", ",,", "1,2,3", "{here}/observation.npz", "{here}/nothing.json", "{here}",
    "auto",
)
PATHS = (
    "", " ", "{here}", "{here}/nothing", "{here}/nothing/deeper", "{here}/null", "{here}/full", "{here}/zero",
    "{here}/loop", "{here}/dangling", "{here}/fifo", "{here}/empty", "{here}/noise.bin", "{here}/deep.json",
    "{here}/observation.npz", "{here}/" + "a" * 300, "{here}/" + "a/" * 2000, "{here}/\n", "{here}/[red]",
    "{here}/\udcff", "{here}/observation.npz/x",
)
# fmt: on


@dataclass(frozen=True)
class Parameter:
    """An option of a command: its longest name, and whether it takes a value."""

    name: str
    flag: bool
    kind: type


def parameters() -> dict[str, list[Parameter]]:
    """The options of each command, as the command line declares them."""
    from turbopi.cli import app

    found: dict[str, list[Parameter]] = {}
    for command in app.registered_commands:
        assert command.name is not None and command.callback is not None
        given = inspect.signature(command.callback).parameters.values()
        found[command.name] = [option for option in map(_option, given) if option and option.name not in _NEVER]
    return found


def _option(parameter: inspect.Parameter) -> Parameter | None:
    """None of an argument."""
    kind, *rest = get_args(parameter.annotation) or (parameter.annotation,)
    about = next((one for one in rest if isinstance(one, OptionInfo)), None)
    if about is None:
        return None
    given = (about.default, *(about.param_decls or ()))  # typer keeps the first name of an annotation as the default
    names = [name.split("/")[0] for name in given if isinstance(name, str) and name.startswith("--")]
    name = names[0] if names else "--" + parameter.name.replace("_", "-")
    return Parameter(name, kind is bool, next((one for one in get_args(kind) or (kind,) if one is not type(None)), str))


def command_lines(seed: int, count: int, options: dict[str, list[Parameter]]) -> list[list[str]]:
    """`count` command lines. "{here}" in them stands for the folder they run in."""
    draw, lines = random.Random(seed), []
    weights = [0.2 if name in _RARE else 1.0 for name in options]
    for _ in range(count):
        (name,) = draw.choices(tuple(options), weights)
        lines.append([name, *_arguments(draw, name, options[name])])
    return lines


def _arguments(draw: random.Random, name: str, options: Sequence[Parameter]) -> list[str]:
    base = list(BASES.get(name, ()))
    if base and draw.random() < 0.08:  # without one of its arguments
        del base[draw.randrange(len(base))]
    if draw.random() < 0.08:  # a stray one, or a word where a path was
        places = [i for i in range(len(base) + 1) if not i or base[i - 1] not in (*_OUTPUTS, "-o")]  # not as an output
        base.insert(draw.choice(places), draw.choice(("{here}", "x", "", "--", "-x", "--nothing", "🤖")))
    for parameter in draw.sample(options, min(len(options), draw.randrange(1, 4))):
        base.append(parameter.name)
        if not parameter.flag:
            base.append(_absurd(draw, parameter))
    return base


def _absurd(draw: random.Random, parameter: Parameter) -> str:
    if parameter.name in _OUTPUTS:
        return draw.choice([path for path in PATHS if path.startswith("{here}")])
    if parameter.kind in (int, float):
        return draw.choice(NUMBERS)
    if parameter.kind is Path:
        return draw.choice(PATHS)
    return draw.choice((*TEXTS, *PATHS, *NUMBERS))


def furnish(here: Path) -> None:
    """The folder that a command works in: an observation, and files of every odd kind."""
    here.mkdir(parents=True)
    write_observation(here / "observation.npz")
    (here / "empty").write_bytes(b"")
    (here / "noise.bin").write_bytes(random.Random(0).randbytes(5000))
    (here / "deep.json").write_text('{"a":' * 100_000 + "1" + "}" * 100_000)
    (here / "loop").symlink_to("loop")
    (here / "dangling").symlink_to("nowhere")
    os.mkfifo(here / "fifo")
    with suppress(PermissionError):  # only root makes devices
        for name, minor in (("null", 3), ("zero", 5), ("full", 7)):
            os.mknod(here / name, 0o666 | stat.S_IFCHR, os.makedev(1, minor))


def commands(seed: int, count: int, folder: Path, found: Found, tick: Tick) -> None:
    """No traceback, no exit code but 0, 1 and 2, and bounded time and memory, whatever is typed."""
    here = folder / f"commands-{seed}"
    with Zygote() as zygote:
        for number, line in enumerate(command_lines(seed, count, parameters())):
            shutil.rmtree(here, ignore_errors=True)
            furnish(here)
            seconds = SECONDS
            if line[0] == "serve":
                seconds = FLEET_SECONDS if "--ray" in line else SERVE_SECONDS
            arguments = [argument.replace("{here}", str(here)) for argument in line]
            if any("\0" in argument for argument in arguments):
                continue
            job = Job(
                arguments, str(here), seconds=seconds, memory_mb=MEMORY_MB, environment={"TURBOPI_ENGINES": str(here)}
            )
            done = zygote.run(job)
            served = line[0] == "serve" and "Serving at" in done.stdout and done.killed == "time"
            found.count += 1
            found.outcomes[
                "serves" if served else f"exit {done.code}" if done.killed is None else f"killed: {done.killed}"
            ] += 1
            wrong = None if served else fault(done)
            if wrong is None and done.code == 2:
                wrong = _unclear(done.stderr)
            if (here / "null").exists() and not stat.S_ISCHR((here / "null").stat().st_mode):
                wrong = "a device was replaced by a file"
            if wrong is not None:
                found.violate(wrong, job.line.replace(str(here), "HERE"))
            tick((number + 1) / count)
    shutil.rmtree(here, ignore_errors=True)


def _unclear(stderr: str) -> str | None:
    """A refusal must name what is wrong: a line "error: …", or the usage that typer prints."""
    if "error: " in stderr or "Usage:" in stderr:
        return None
    return f"an unclear refusal: {stderr.strip()[:200]}"
