"""Fewer denoising steps in a simulator: solvers of `steps` on LIBERO, or on any other simulator of `turbopi eval`.

Episodes are `turbopi eval`'s: the same protocol, seeds and noise, so that cells are paired with each other and with
runs of `turbopi eval`. A folder for each cell is kept, and continued where a run was cut short.
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from msgspec import Struct

from turbopi import shipped
from turbopi.checkpoint import open_checkpoint
from turbopi.errors import ConfigError
from turbopi.evaluate.plan import Job, Protocol, VideoPlan, choose_tasks, make_jobs
from turbopi.evaluate.results import Results
from turbopi.evaluate.run import default_workers, evaluate, prepare
from turbopi.evaluate.sources import LocalPolicy
from turbopi.evaluate.statistics import Paired, PairedDocument, Rate, RateDocument
from turbopi.policy import UnifiedPolicy
from turbopi.reading import plain_document
from turbopi.sim import SimSettings, create
from turbopi.studies.report import Cell, Control, Grid, Panel, Plot, Report, Series, paired_cell, rate_cells
from turbopi.studies.solvers import BASELINE, Way, grid_times
from turbopi.studies.study import Setup, Study

WAYS = (
    *(BASELINE, Way("euler", "uniform", 1), Way("euler", "uniform", 2), Way("euler", "uniform", 3)),
    *(Way("ab2", "uniform", 2), Way("exponential", "uniform", 2), Way("exponential", "uniform", 3)),
)
UNSEEN = range(30, 50)  # LIBERO's initial states that the small policy's training never saw


class SimulatorCell(Struct, frozen=True):
    solver: str
    grid: str
    evaluations: int
    rate: RateDocument
    against_baseline: PairedDocument


def run(setup: Setup) -> Report:
    simulator = create(setup.simulator)
    simulator.check()
    suite = simulator.suites[0]
    videos = VideoPlan("none")
    libero = setup.simulator == "libero"
    tasks = choose_tasks(simulator, suite, [0] if setup.small else None)
    states = UNSEEN if libero else range(setup.cell_episodes)
    jobs = make_jobs(tasks, states[:2] if setup.small else states, None, videos)
    chosen = _chosen(setup)
    protocol = Protocol(simulator.name, suite, SimSettings(), max_steps=40 if setup.small and libero else None)
    cells, outcomes = [], {}
    with _folder(setup) as folder:
        for way in chosen:
            outcomes[way] = _solved(setup, way, protocol, jobs, folder)
            setup.tell(f"{way}: {sum(outcomes[way].values())} of {len(jobs)}")
        again = _solved(setup, BASELINE, protocol, jobs[:4], folder, plain=True)
    baseline = outcomes[BASELINE]
    for way, solved in outcomes.items():
        paired = Paired.of([(baseline[key], solved[key]) for key in baseline])
        rate = Rate(sum(solved.values()), len(solved)).document
        cells.append(SimulatorCell(way.solver, way.grid, way.evaluations, rate, paired.document))
    same = all(baseline[key] == ended for key, ended in again.items())
    return setup.report(
        STUDY,
        method=(
            f"`turbopi eval {setup.simulator}`'s episodes: {suite}, {len(jobs)} of them, the float32 reference; each "
            "solver on a uniform grid. Differences are against ten Euler steps."
        ),
        controls=[Control("Four episodes end as with `turbopi eval` and no solver of this study.", same, "")],
        tables=[_table(cells)],
        plots=[_plot(cells)],
        verdict="; ".join(
            f"{cell.solver} {cell.evaluations}: {paired_cell(cell.against_baseline)}" for cell in cells[1:]
        )
        or "Ten Euler steps alone.",
        would_change="Demonstrations with several ways of doing it: this policy imitates one deterministic expert.",
        not_run=[f"{way}" for way in WAYS if way not in chosen],
        data={
            "cells": [plain_document(cell) for cell in cells],
            "solved": {str(way): [list(key) for key, ended in of.items() if ended] for way, of in outcomes.items()},
        },
    )


def _chosen(setup: Setup) -> list[Way]:
    """The baseline first."""
    if setup.small:
        return [BASELINE, Way("exponential", "uniform", 2)]
    known = {str(way): way for way in WAYS}
    unknown = [name for name in setup.ways if name not in known]
    if unknown:
        raise ConfigError(f"unknown way {unknown[0]!r}; choose of: {'; '.join(known)}")
    return list(dict.fromkeys([BASELINE, *(known[name] for name in setup.ways or known)]))


@contextmanager
def _folder(setup: Setup) -> Iterator[Path]:
    if setup.folder is not None:
        yield setup.folder
        return
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def _solved(
    setup: Setup, way: Way, protocol: Protocol, jobs: list[Job], folder: Path, *, plain: bool = False
) -> dict[tuple[int, int], bool]:
    """By task and initial state; crashes of the simulator are tried once more, then refused."""
    checkpoint = setup.checkpoint or open_checkpoint(shipped.SMALL_POLICY)
    options: dict[str, Any] = {"num_denoising_steps": way.evaluations}
    if not plain:  # the baseline's, too, by its times: so the control compares two ways to ask for the same
        options |= {"solver": way.solver, "time_grid": (*grid_times(way, {}), 0.0)}
    policy = UnifiedPolicy(checkpoint, backend="pytorch", precision="f32", device=setup.device, **options)
    name = "plain" if plain else str(way).replace(", ", "_")
    source = LocalPolicy(policy, label=name)
    source.identity["way"] = name
    simulator = create(setup.simulator)
    for _ in range(2):
        results = prepare(folder / name, protocol, source, simulator, jobs, restart=False)
        workers = min(setup.workers or default_workers(), len(jobs))
        results = evaluate(
            results, protocol, source, simulator, jobs, num_workers=workers, max_batch=workers, videos=VideoPlan("none")
        )
    return _judged(results, jobs)


def _judged(results: Results, jobs: list[Job]) -> dict[tuple[int, int], bool]:
    crashed = [job.key for job in jobs if not results.episodes[job.key].judged]
    if crashed:
        raise ConfigError(f"the simulator broke in {len(crashed)} episodes, {crashed[0]} first; give the command again")
    return {job.key: results.episodes[job.key].success for job in jobs}


def _table(cells: list[SimulatorCell]) -> Grid:
    rows: list[list[Cell]] = [
        [cell.solver, cell.grid, cell.evaluations, *rate_cells(cell.rate), paired_cell(cell.against_baseline)]
        for cell in cells
    ]
    columns = ["solver", "grid", "evaluations", "solved", "success, % [95 %]", "against ten Euler steps, points"]
    return Grid("Closed loop", columns, rows)


def _plot(cells: list[SimulatorCell]) -> Plot:
    series = []
    for solver in dict.fromkeys(cell.solver for cell in cells):
        own = sorted((cell for cell in cells if cell.solver == solver), key=lambda cell: cell.evaluations)
        ends = [cell.rate.wilson95 for cell in own]
        rates = [100 * (cell.rate.rate or 0.0) for cell in own]
        low, high = [100 * a for a, _ in ends], [100 * b for _, b in ends]
        series.append(Series(solver, [float(cell.evaluations) for cell in own], rates, low, high))
    panel = Panel("Success", "evaluations", "%, with Wilson's interval, 95 %", series, True, ticks=[1, 2, 3, 5, 10])
    return Plot("steps_libero", [panel])


STUDY = Study(
    "steps_libero",
    "How few denoising steps are enough on LIBERO?",
    "10 → 3 steps cost less than 1 % of mean squared error; success on nine episodes a suite is unchanged at 1 step.",
    run,
)
