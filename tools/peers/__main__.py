"""Time other programs beside Turbo-Pi on one GPU, in one run. From the repository, with PYTHONPATH=src:tools:

    python -m peers list                                what there is, and what is installed
    python -m peers install lerobot                     into build/peers/lerobot; `all` installs each
    python -m peers run --peers all --out benchmarks/results/h200_DATE_peers/peers.json
    python -m peers run --peers lerobot,openpi-pytorch --dry-run
    python -m peers run --model smolvla --horizons 50 --out FOLDER/smolvla.json
    python -m peers run --model pi0_fast --horizons 10 --steps 30 --out FOLDER/pi0_fast.json    steps: tokens written

Pi0.5, or --model, of full size, random weights, the same job for all that run it. Turbo-Pi always runs too. For each
horizon all programs stand ready, in processes of their own, and are called in turns, so they need room on the GPU
together: some 100 GB for all.
The file is written after each round. What can't be installed, doesn't start or fails in a call is in it with its
reason, and has no figures. Exit code 1 if a program that was requested has none.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import get_args

import torch
from msgspec import json
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from peers.document import NotMeasured, PeersRun, Timed
from peers.entries import BY_NAME, IMAGES, OURS, PROGRAMS, Model, Program
from peers.installing import commands, folder_of, install, missing, python_of
from peers.running import Limits, time_job
from turbopi.bench.work import Job
from turbopi.models.smolvla.config import PUBLISHED
from turbopi.support.files import write_whole
from turbopi.support.provenance import Gpu, provenance

HOME = Path("build") / "peers"
OTHERS = [program.name for program in PROGRAMS if program is not OURS]
_ABOUT_CHECKPOINT = "it loads a checkpoint only: give one of LeRobot's pi05 with --checkpoint FOLDER"


def main(arguments: list[str] | None = None, console: Console | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m peers", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--home", type=Path, default=HOME, help="where the environments are; build/peers")
    verbs = parser.add_subparsers(dest="verb", required=True)
    verbs.add_parser("list", help="what there is, and what is installed")
    installing = verbs.add_parser("install", help="install programs anew")
    installing.add_argument("names", nargs="+", metavar="NAME", help=f"{', '.join(OTHERS)}; or all")
    installing.add_argument("--site-packages", action="store_true", help="environments see this Python's packages")
    running = verbs.add_parser("run", help="time programs beside Turbo-Pi")
    running.add_argument("--peers", default="all", help=f"some of {','.join(OTHERS)}; all")
    running.add_argument("--model", choices=get_args(Model), default="pi05")
    running.add_argument(
        "--without", action="append", default=[], metavar="NAME=SETTING", help="leave out: 'openpi-pytorch=bf16 eager'"
    )
    running.add_argument("--out", type=Path, metavar="FILE")
    running.add_argument(
        "--python", action="append", default=[], metavar="NAME=PATH", help="an environment that exists"
    )
    running.add_argument("--checkpoint", type=Path, metavar="FOLDER", help="for the servers: LeRobot's pi05_base")
    running.add_argument("--cameras", type=int, default=2)
    running.add_argument("--prompt-tokens", type=int, default=48)
    running.add_argument("--horizons", default="10,50")
    running.add_argument("--steps", type=int, default=10, help="of denoising; of pi0_fast tokens")
    running.add_argument("--rounds", type=int, default=5)
    running.add_argument("--calls", type=int, default=40, help="of each part in a round")
    running.add_argument("--start-s", type=float, metavar="S", help="to get ready, instead of each program's own limit")
    running.add_argument("--round-s", type=float, default=120.0, metavar="S", help="for a round's calls")
    running.add_argument("--part-s", type=float, metavar="S", help="for a part's calls in a round: then they are fewer")
    running.add_argument("--device", choices=("cuda", "cpu"), default="cuda" if torch.cuda.is_available() else "cpu")
    running.add_argument("--small", action="store_true", help="small models, to try the tool; no figure")
    for verb in (installing, running):
        verb.add_argument("--src", action="append", default=[], metavar="NAME=FOLDER", help="sources that exist")
        verb.add_argument("--dry-run", action="store_true", help="only print what would be run")
    given = parser.parse_args(arguments)
    console = console or Console(soft_wrap=True)
    if given.verb == "list":
        return show(given.home, console)
    try:
        if given.verb == "install":
            return install_all(chosen(",".join(given.names)), given, console)
        return run(chosen(given.peers, given.model), given, console)
    except ValueError as error:  # ConfigError among them
        parser.error(str(error))


def chosen(names: str, model: str = "pi05") -> list[Program]:
    """Of "a,b" or "all", in the order that they are timed in. Raises ValueError for another name, and for one that
    doesn't run the model.
    """
    wanted = OTHERS if names == "all" else [name for name in names.split(",") if name]
    for name in wanted:
        if name not in OTHERS:
            raise ValueError(f"no program is named {name!r}; expected some of {', '.join(OTHERS)}, or all")
        if names != "all" and BY_NAME[name].of(model) is None:
            having = [other for other in OTHERS if BY_NAME[other].of(model)]
            raise ValueError(f"{name} is not timed with {model}; expected some of {', '.join(having)}, or all")
    return [BY_NAME[name] for name in OTHERS if name in wanted]


def show(home: Path, console: Console) -> int:
    table = Table("program", "settings", "from", "state", box=None)
    for program in PROGRAMS:
        repository, commit = program.git or ("", "")
        pinned = " ".join(word for command in program.install for word in command if "==" in word)
        source = f"{repository} {commit[:8]}" if repository else pinned
        table.add_row(program.name, "; ".join(program.settings), source or "here", missing(program, home) or "ready")
    console.print(table)
    return 0


def arch() -> str:
    """The GPU's compute capability, "90"; of a machine without one, what is measured most."""
    return "{}{}".format(*torch.cuda.get_device_capability()) if torch.cuda.is_available() else "90"


def install_all(programs: list[Program], given: argparse.Namespace, console: Console) -> int:
    failed, sources = False, _named(given.src)
    for program in programs:
        src = sources.get(program.name)
        if given.dry_run:
            for command in commands(program, given.home, arch(), src=src, site_packages=given.site_packages):
                console.print(escape(f"{program.name}: {' '.join(command)}"))
            continue
        reason = install(program, given.home, arch(), src=src, site_packages=given.site_packages)
        failed = failed or reason is not None
        console.print(escape(f"{program.name}: {reason or 'installed'}"))
    return int(failed)


Setting = tuple[Program, str, str, dict[str, object]]  # program, setting, its Python, words of its driver


def run(programs: list[Program], given: argparse.Namespace, console: Console) -> int:
    shape, images = (given.cameras, given.prompt_tokens), IMAGES.get(given.model, {})
    jobs = [Job(*shape, int(horizon), given.steps, **images) for horizon in given.horizons.split(",")]
    if none := [program.name for program in programs if program.of(given.model) is None]:
        console.print(escape(f"left out: {', '.join(none)}: not timed with {given.model}"))
    with tempfile.TemporaryDirectory(prefix="peers-run-") as shared:
        having = [found for program in (OURS, *programs) if (found := program.of(given.model))]
        settings, lost = to_run(having, given, shared)
        if not given.dry_run:
            return time_all(settings, lost, jobs, given, console)
    for program, setting, python, _ in settings:
        console.print(escape(f"{program.name}, {setting}: {python} {program.script.name}"))
    show_lost(lost, console)
    return 0


def to_run(programs: list[Program], given: argparse.Namespace, shared: str) -> tuple[list[Setting], list[NotMeasured]]:
    """The settings that can run, and those that can't. shared: a folder that lasts as long as the run."""
    pythons, sources = (_named(pairs) for pairs in (given.python, given.src))
    without = left_out(given.without, given.model)
    lost: list[NotMeasured] = []
    settings: list[Setting] = []
    for program in programs:
        reason = None if program.name in pythons else missing(program, given.home)
        if reason is None and program.needs_checkpoint and given.checkpoint is None:
            reason = _ABOUT_CHECKPOINT
        python = pythons.get(program.name, python_of(program, given.home))
        words: dict[str, object] = {
            "device": given.device,
            "model": given.model,
            "smolvlm": PUBLISHED["HuggingFaceTB/SmolVLM2-500M-Video-Instruct"],
            "small": given.small,
            "src": str(Path(sources.get(program.name, folder_of(program, given.home) / "src")).resolve()),
            "commit": program.git[1][:8] if program.git else "",
            "checkpoint": str(given.checkpoint.resolve()) if given.checkpoint else None,
            "shared": shared,
        }
        for setting in program.settings:
            if (program.name, setting) in without or (given.device == "cpu" and setting.startswith(("fp8", "int8"))):
                continue  # on a CPU no program has these
            if reason is None:
                settings.append((program, setting, python, words))
            else:
                lost.append(
                    NotMeasured(program=program.name, setting=setting, job=None, stage="install", reason=reason)
                )
    return settings, lost


def left_out(pairs: list[str], model: str) -> set[tuple[str, str]]:
    """(program, setting) of each NAME=SETTING. Raises ValueError for what no program has, with that model."""
    found = {(name, setting) for name, _, setting in (pair.partition("=") for pair in pairs)}
    known = {one.name: one.settings for program in BY_NAME.values() if (one := program.of(model))}
    for name, setting in found - {(name, setting) for name, settings in known.items() for setting in settings}:
        expected = "; ".join(known[name]) if name in known else f"a NAME of {', '.join(known)}"
        raise ValueError(f"--without {name}={setting}: expected {expected}")
    return found


def time_all(
    settings: list[Setting], lost: list[NotMeasured], jobs: list[Job], given: argparse.Namespace, console: Console
) -> int:
    device = torch.device("cuda:0" if given.device == "cuda" else "cpu")
    of_run = provenance(device)
    clocks: list[Gpu] = []
    timed: list[Timed] = []

    def note_clocks() -> None:
        if gpu := provenance(device).gpu:
            clocks.append(gpu)

    def write(of_job: list[Timed], lost_of_job: list[NotMeasured]) -> None:
        """After each round: a run that is cut has what it measured."""
        if given.out is None:
            return
        document = PeersRun(
            kind="turbopi-peers",
            provenance=of_run,
            clocks=clocks,
            command=["python", "-m", "peers", *sys.argv[1:]],
            small=given.small,
            model=given.model,
            timed=[*timed, *of_job],
            not_measured=[*lost, *lost_of_job],
        )
        write_whole(given.out, json.format(json.encode(document), indent=1) + b"\n")

    for job in jobs:
        console.print(f"[bold]{job}[/]")
        found, failed = time_job(
            settings,
            job,
            rounds=given.rounds,
            calls=given.calls,
            limits=Limits(given.start_s, given.round_s, given.part_s),
            before_round=note_clocks,
            after_round=write,
            say=lambda line: console.print(escape(line)),
        )
        timed, lost = [*timed, *found], [*lost, *failed]
        write([], [])
    show_timed(timed, console)
    show_lost(lost, console)
    return int(bool(lost))


def _named(pairs: list[str]) -> dict[str, str]:
    found = dict(pair.partition("=")[::2] for pair in pairs)
    for name, value in found.items():
        if name not in BY_NAME or not value:
            raise ValueError(f"{name}={value}: expected NAME=PATH with a NAME of {', '.join(BY_NAME)}")
    return found


def show_timed(timed: list[Timed], console: Console) -> None:
    table = Table("program", "setting", "part", "H", "p50, ms", "p95", "calls", box=None)
    for one in timed:
        row = (one.program, one.setting, one.part, str(one.job.horizon), f"{one.p50_ms:.2f}", f"{one.p95_ms:.2f}")
        table.add_row(*row, str(one.calls))
    console.print(table)


def show_lost(lost: list[NotMeasured], console: Console) -> None:
    for one in lost:
        job = "" if one.job is None else f" ({one.job})"
        console.print(escape(f"not measured: {one.program}, {one.setting}{job}, {one.stage}: {one.reason}"))


if __name__ == "__main__":
    sys.exit(main())
