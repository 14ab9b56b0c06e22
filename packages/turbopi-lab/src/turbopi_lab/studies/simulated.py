"""Variants of a policy in a simulator, each against the plain policy: the form of the studies named after LIBERO.

Episodes are `turbopi eval`'s: the same protocol, seeds and noise, so that cells are paired with each other and with
runs of `turbopi eval`. Each cell keeps its episodes in a folder of its own, and goes on where a run was cut short; a
report is made of the folders alone, so that cells may be run by several processes, or on other machines.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from msgspec import Struct

from turbopi.checkpoint import Checkpoint, open_checkpoint
from turbopi.evaluate.plan import Job, Protocol, VideoPlan, choose_tasks, make_jobs
from turbopi.evaluate.reading import load_results
from turbopi.evaluate.results import FILE, Episode, Results
from turbopi.evaluate.run import default_workers, evaluate, prepare
from turbopi.evaluate.sources import LocalPolicy, PolicySource
from turbopi.evaluate.statistics import Paired, PairedDocument, Rate, RateDocument
from turbopi.policy import shipped
from turbopi.policy.policy import UnifiedPolicy
from turbopi.sim import SimSettings, Simulator, Task, create
from turbopi.support.errors import ConfigError
from turbopi.support.reading import plain_document, shown
from turbopi_lab.studies.answering import Answering, AnsweringPolicy
from turbopi_lab.studies.report import (
    MARGIN,
    PERCENT,
    Cell,
    Control,
    Grid,
    Panel,
    Plot,
    Report,
    compared,
    paired_cell,
    rate_cells,
    rate_series,
)
from turbopi_lab.studies.study import Setup, Study

PLAIN, CONTROL = "plain", "control"  # names of cells that every study here has
UNSEEN = range(30, 50)  # LIBERO's initial states that the small policy's training never saw
STEPS = 10  # of denoising, as the small policy was judged
_CONTROL_EPISODES = 4
_SMALL_EPISODES = 2  # of a cell in the small form
_LOST = -0.2  # of the rate: what a broken variant loses at least
_NO_VIDEOS = VideoPlan("none")


@dataclass(frozen=True)
class Given:
    """What a cell's policy is made of. folder: the cell's, which is there when the policy is first asked"""

    checkpoint: Checkpoint
    device: torch.device
    protocol: Protocol
    jobs: Sequence[Job]
    folder: Path
    small: bool

    def policy(self, **options: Any) -> UnifiedPolicy:
        """The float32 reference with options of UnifiedPolicy; ten Euler steps unless they say otherwise."""
        options = {"num_denoising_steps": STEPS} | options
        return UnifiedPolicy(self.checkpoint, backend="pytorch", precision="f32", device=self.device, **options)

    def source(self, policy: UnifiedPolicy) -> LocalPolicy:
        return LocalPolicy(policy, self.checkpoint.fingerprint(trust_files=True))

    def answered(self, policy: UnifiedPolicy, answer: Answering) -> LocalPolicy:
        """The policy with `answer` in its model's place."""
        weights = self.checkpoint.fingerprint(trust_files=True)
        return AnsweringPolicy(policy, weights, answer, self.protocol, self.jobs)


@dataclass(frozen=True)
class Variant:
    """A cell: a policy under the name that `--way` has for it.

    open    gives the policy for as long as its episodes run
    series  the line of the plot that it belongs to; None: one of its own
    x       its place in the plot; None: what the study's `measured` says, or without that its place in the table
    """

    name: str
    open: Callable[[Given], AbstractContextManager[PolicySource]]
    series: str | None = None
    x: float | None = None


@contextmanager
def open_plain(given: Given) -> Iterator[PolicySource]:
    """The policy as it is."""
    yield given.source(given.policy())


class SimulatorCell(Struct, frozen=True):
    way: str
    rate: RateDocument
    against_plain: PairedDocument
    measured: dict[str, float]  # by the study's own names

    @property
    def verdict(self) -> str:
        return compared(self.against_plain)


@dataclass(frozen=True, kw_only=True)
class Variants:
    """A study of variants.

    few        names of the small form's cells
    neutral    the plain policy asked for in the study's way: four episodes must end as the plain policy's, `exact`:
               after the same commands
    broken     a cell that must lose twenty points, if the study has one; without it no full report is sound
    measured   {column: number} of what else a cell's folder tells, by the cell's name and folder; the first is the
               plot's x where variants have none, and a cell whose folder tells nothing isn't in the plot
    """

    name: str
    question: str
    claimed: str
    cells: Sequence[Variant]
    few: Sequence[str]
    neutral: Variant
    exact: bool
    method: str
    would_change: str
    x_label: str
    broken: str | None = None
    measured: Callable[[str, Path], Mapping[str, float]] | None = None
    plain: Variant = Variant(PLAIN, open_plain)
    ticks: list[float] | None = None

    @property
    def study(self) -> Study:
        return Study(self.name, self.question, self.claimed, self.run, episodes=self.episodes)

    # --- episodes ---------------------------------------------------------------------------------------------------

    def chosen(self, setup: Setup) -> list[str]:
        """Names of the cells that `--way` asks for: all, unless it names some."""
        known = [PLAIN, *(cell.name for cell in self.cells), CONTROL]
        unknown = [name for name in setup.ways if name not in known]
        if unknown:
            raise ConfigError(f"unknown way {unknown[0]!r} of {self.name}; choose of: {'; '.join(known)}")
        return list(dict.fromkeys(setup.ways)) or ([PLAIN, *self.few, CONTROL] if setup.small else known)

    def episodes(self, setup: Setup) -> None:
        """Run the chosen cells' episodes, or what is left of them, into their folders."""
        chosen = self.chosen(setup)
        running = Running.of(setup)
        for cell in (self.plain, *self.cells):
            if cell.name in chosen:
                running.run(cell, running.folder / slug(cell.name), running.jobs)
        if CONTROL in chosen:  # one request at a time: then a run repeats bit for bit
            few = running.jobs[:_CONTROL_EPISODES]
            for cell, folder in zip((self.neutral, self.plain), self._control(running.folder), strict=True):
                running.run(cell, folder, few, max_batch=1)

    def _control(self, folder: Path) -> tuple[Path, Path]:
        return folder / f"{self.name}_{CONTROL}", folder / f"{self.name}_{CONTROL}_{PLAIN}"

    # --- the report -------------------------------------------------------------------------------------------------

    def run(self, setup: Setup) -> Report:
        """The chosen cells, the plain policy and the control, then a report of all cells that are in the folder."""
        with setup.kept_in() as folder:
            self.chosen(setup)
            if not setup.report_only:
                ways = [PLAIN, *setup.ways, CONTROL] if setup.ways else ()
                self.episodes(replace(setup, folder=folder, ways=ways))
            return self._report(setup, folder)

    def _report(self, setup: Setup, folder: Path) -> Report:
        plain = finished(folder / PLAIN)
        if plain is None:
            raise ConfigError(f"{folder / PLAIN} holds no finished run; run {self.name} with --way {PLAIN}")
        cells, solved, missing = [], {PLAIN: _solved(plain)}, []
        ran_on: dict[str, list[str]] = {}  # cells by device
        for cell in (self.plain, *self.cells):
            place = folder / slug(cell.name)
            results = finished(place)
            if results is None:
                missing.append(f"{cell.name}{left_of(place)}: `--way '{cell.name}'`")
                continue
            _check_pair(plain, results)
            solved[cell.name] = _solved(results)
            ran_on.setdefault(str(results.policy.about.get("device_name")), []).append(cell.name)
            reported = {} if self.measured is None else self.measured(cell.name, place)
            cells.append(_cell(cell.name, solved[PLAIN], solved[cell.name], reported))
        count = len(solved[PLAIN])
        return setup.report(
            self.study,
            method=(
                f"`turbopi eval {plain.protocol['simulator']}`'s episodes: {plain.suite}, {count} of them, the same "
                f"ones with the same noise in every cell, run on {_devices_reported(ran_on)}. {self.method} "
                f"Differences are against the plain policy: the float32 reference, ten Euler steps."
            ),
            controls=self.controls(folder, cells, setup.small),
            tables=[_table(cells)],
            plots=[self._plot(cells)],
            verdict=_verdict(cells),
            would_change=self.would_change,
            not_run=missing,
            data={
                "cells": [plain_document(cell) for cell in cells],
                "solved": {name: [list(key) for key, won in of.items() if won] for name, of in solved.items()},
            },
        )

    def controls(self, folder: Path, cells: Sequence[SimulatorCell], small: bool) -> list[Control]:
        """Of what is in the folder. One whose episodes aren't there has failed."""
        how = "alike after the same commands" if self.exact else "alike"
        claim = f"Asked for in this study's way, the plain policy's first episodes end {how}, one request at a time."
        ours, plains = (finished(one) for one in self._control(folder))
        if ours is None or plains is None:
            controls = [Control(claim, False, f"Not run: `--way {CONTROL}`.")]
        else:
            _check_pair(plains, ours)
            pairs = [(ours.episodes[key], plains.episodes[key]) for key in plains.episodes]
            same = [(a.status, *self._way(a)) == (b.status, *self._way(b)) for a, b in pairs]
            ends = ", ".join(f"{b.status} after {b.steps}" for _, b in pairs)
            controls = [Control(claim, all(same), f"{sum(same)} of {len(same)}: {ends}.")]
        if self.broken is not None and not small:  # in the small form nobody solves anything of LIBERO
            claim = f"{self.broken} isn't as good: it loses {-100 * _LOST:.0f} points at least."
            broken = next((cell.against_plain for cell in cells if cell.way == self.broken), None)
            if broken is None:
                controls.append(Control(claim, False, f"Not run: `--way '{self.broken}'`."))
            else:
                controls.append(Control(claim, (broken.difference or 0.0) <= _LOST, f"{paired_cell(broken)} points."))
        return controls

    def _way(self, episode: Episode) -> tuple[object, ...]:
        """What tells two episodes' commands apart, to the last bit."""
        return (episode.steps, episode.motion) if self.exact else ()

    def _plot(self, cells: Sequence[SimulatorCell]) -> Plot:
        """Success by x, see `Variant.x`. A cell that should have a measured x and has none is left out."""
        variants = {cell.name: cell for cell in (self.plain, *self.cells)}
        points: dict[str, list[tuple[float, SimulatorCell]]] = {}
        for place, cell in enumerate(cells):
            variant = variants[cell.way]
            x = variant.x
            if x is None:
                x = float(place) if self.measured is None else next(iter(cell.measured.values()), None)
            if x is None:
                continue
            points.setdefault(variant.series or cell.way, []).append((x, cell))
        series = []
        for name, own in points.items():
            own.sort(key=lambda point: point[0])
            series.append(rate_series(name, [x for x, _ in own], [cell.rate for _, cell in own]))
        return Plot(self.name, [Panel("Success", self.x_label, PERCENT, series, ticks=self.ticks)])


# --- running ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Running:
    """Episodes to run, and with what."""

    setup: Setup
    folder: Path
    simulator: Simulator
    protocol: Protocol
    jobs: list[Job]
    checkpoint: Checkpoint

    @classmethod
    def of(cls, setup: Setup) -> "Running":
        """Episodes of all tasks of the simulator's first suite; in the small form of its first task."""
        if setup.folder is None:
            raise ConfigError("episodes alone are of no use without a folder: give --out")
        simulator = create(setup.simulator)
        simulator.check()
        suite, libero = simulator.suites[0], setup.simulator == "libero"
        tasks = choose_tasks(simulator, suite, [0] if setup.small else None)
        jobs = make_jobs(tasks, _initial_states(setup, tasks), None, _NO_VIDEOS)
        protocol = Protocol(simulator.name, suite, SimSettings(), max_steps=40 if setup.small and libero else None)
        checkpoint = setup.checkpoint or open_checkpoint(shipped.SMALL_POLICY)
        return cls(setup, setup.folder, simulator, protocol, jobs, checkpoint)

    def run(self, cell: Variant, folder: Path, jobs: list[Job], *, max_batch: int | None = None) -> None:
        """What is left of a cell. Episodes in which the simulator crashed are tried once more.

        Raises ConfigError if it crashes again, or if the folder's episodes were run in another way.
        """
        workers = min(self.setup.workers or default_workers(), len(jobs))
        given = Given(self.checkpoint, self.setup.device, self.protocol, jobs, folder, self.setup.small)
        with cell.open(given) as source:
            source.label = source.identity["way"] = cell.name
            for _ in range(2):
                results = prepare(folder, self.protocol, source, self.simulator, jobs, restart=False)
                results = evaluate(
                    *(results, self.protocol, source, self.simulator, jobs),
                    num_workers=workers,
                    max_batch=max_batch or workers,
                    videos=_NO_VIDEOS,
                )
        crashed = [job.key for job in jobs if not results.episodes[job.key].judged]
        if crashed:
            broken = f"the simulator broke in {len(crashed)} episodes of {cell.name}, {crashed[0]} first"
            raise ConfigError(f"{broken}; give the command again")
        self.setup.tell(f"{folder.name}: {sum(_solved(results).values())} of {len(jobs)}")


def _initial_states(setup: Setup, tasks: Sequence[Task]) -> Sequence[int]:
    """The first ones of every task that together are a cell's episodes, or a few more; of LIBERO those UNSEEN.

    Raises ConfigError if more episodes were asked for than there are.
    """
    there = UNSEEN if setup.simulator == "libero" else range(min(task.num_initial_states for task in tasks))
    if setup.episodes is not None and setup.episodes > len(there) * len(tasks):
        raise ConfigError(
            f"--episodes is {setup.episodes}; a cell on {setup.simulator} has {len(there) * len(tasks)} at most: "
            f"tasks {len(tasks)}, initial states {there[0]} to {there[-1]}"
        )
    episodes = _SMALL_EPISODES if setup.small and setup.episodes is None else setup.cell_episodes
    return there[: math.ceil(episodes / len(tasks))]


def slug(name: str) -> str:
    """A folder's name for a cell's."""
    return re.sub(r"[^A-Za-z0-9.]+", "_", name).strip("_")


def finished(folder: Path) -> Results | None:
    """The results in a folder, if every episode that was planned has a verdict."""
    if not (folder / FILE).exists():
        return None
    results = load_results(folder)
    return results if results.complete else None


def left_of(folder: Path) -> str:
    """In words, how far an unfinished cell is; nothing if it never began."""
    if not (folder / FILE).exists():
        return ""
    results = load_results(folder)
    judged = sum(episode.judged for episode in results.episodes.values())
    return f", cut short after {judged} of {len(results.planned)} episodes"


def _solved(results: Results) -> dict[tuple[int, int], bool]:
    """By task and initial state."""
    return {episode.key: episode.success for episode in results.in_order()}


def _check_pair(plain: Results, results: Results) -> None:
    """Raise ConfigError for a cell whose episodes aren't the plain policy's, or whose weights are others."""

    def decisive(of: Results) -> dict[str, object]:
        names = ("weights", "config", "backend", "precision", "robot")
        reported: dict[str, object] = {f"policy's {name}": of.policy.identity.get(name) for name in names}
        return reported | {f"protocol's {name}": value for name, value in of.protocol.items()}

    if apart := sorted(plain.planned ^ results.planned):
        owner = plain if apart[0] in plain.planned else results
        found = f"episodes differ: {len(results.planned)} and {len(plain.planned)}, of which task {apart[0][0]} from "
        raise _not_comparable(results, plain, f"{found}initial state {apart[0][1]} is in {owner.folder.name} alone")
    ours, theirs = decisive(results), decisive(plain)
    for name in ours | theirs:
        if ours.get(name) != theirs.get(name):
            found = f"{name} differ: {shown(ours.get(name))} and {shown(theirs.get(name))}"
            raise _not_comparable(results, plain, found)


def _not_comparable(results: Results, plain: Results, why: str) -> ConfigError:
    return ConfigError(
        f"{results.folder} and {plain.folder} can't be compared: the {why}; run one of them again with another --out"
    )


# --- what is told -----------------------------------------------------------------------------------------------------


def _cell(
    way: str,
    plain: Mapping[tuple[int, int], bool],
    solved: Mapping[tuple[int, int], bool],
    measured: Mapping[str, float],
) -> SimulatorCell:
    paired = Paired.of([(plain[key], solved[key]) for key in plain])
    return SimulatorCell(way, Rate(sum(solved.values()), len(solved)).document, paired.document, dict(measured))


def _devices_reported(ran_on: Mapping[str, Sequence[str]]) -> str:
    """Of cells by device; where there are several, which cells each has run."""
    if len(ran_on) == 1:
        return next(iter(ran_on))
    return ", ".join(f"{device} ({'; '.join(names)})" for device, names in ran_on.items())


def _table(cells: Sequence[SimulatorCell]) -> Grid:
    measured = list(dict.fromkeys(name for cell in cells for name in cell.measured))
    columns = ["policy", *measured, "solved", "success, % [95 %]", "against plain, points"]
    rows: list[list[Cell]] = []
    for cell in cells:
        extra: list[Cell] = [cell.measured.get(name, "") for name in measured]
        against = "" if cell.way == PLAIN else paired_cell(cell.against_plain)
        rows.append([cell.way, *extra, *rate_cells(cell.rate), against])
    return Grid("Closed loop", columns, rows)


def _verdict(cells: Sequence[SimulatorCell]) -> str:
    said = [f"{PLAIN} solves {rate_cells(cells[0].rate)[1]} %"]
    said += [f"{cell.way} {paired_cell(cell.against_plain)}, {cell.verdict}" for cell in cells[1:]]
    return f"{'; '.join(said)}. “As good”: not worse by {100 * MARGIN:.0f} points, with 95 % confidence."
