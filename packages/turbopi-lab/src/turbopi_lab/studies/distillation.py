"""One denoising step by distillation: does a student solve in one step what its teacher solves in ten?

Students are made by `python -m turbopi_lab.small_policy distill`, which says how. Where a teacher has two ways, one
plain step gives the mean of both, and so does a student that learns by regression on actions: of one observation, all
noises have the same mean. A student that learns, for each noise, the actions that the teacher makes of this very
noise has nothing to average. The recipes differ in this alone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from msgspec import Struct, structs

from turbopi.evaluate.statistics import PairedDocument, RateDocument
from turbopi.support.errors import ConfigError
from turbopi.support.reading import plain_document
from turbopi_lab.studies.report import (
    MARGIN,
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
from turbopi_lab.studies.rollouts import POST, Played, ToyPolicy, open_policy, play, sampled, seeds_of
from turbopi_lab.studies.spread import UNIFORM, Spread, spread, spread_plot, spread_table
from turbopi_lab.studies.study import Setup, Study, Tell

RECIPES = {  # and what a student of it learned
    "consistency": "where each of the teacher's ways ends, from its noise and from points on it",
    "shuffled": "the same with the actions of another noise: control",
    "mean": "regression on the mean of the teacher's actions: control",
}
TEACHER, STEPS = "teacher", 10
_JUDGED = 20_000  # number of the first episode that errors are measured on


class DistilledCell(Struct, frozen=True):
    """Weights at so many Euler steps on a teacher's task."""

    policy: str
    weights: str  # TEACHER or a recipe
    steps: int
    rate: RateDocument
    against_teacher: PairedDocument  # at ten steps
    touched_post: int
    error: float  # relative rms of the actions against the teacher's at ten steps, from the same noise

    @property
    def verdict(self) -> str:
        return compared(self.against_teacher)


@dataclass(frozen=True)
class Judged:
    """What is found of a teacher and its students."""

    cells: list[DistilledCell]
    spreads: list[Spread]
    pairs_matter: PairedDocument | None  # one step: shuffled less consistency
    same_prefix: bool
    repeated: bool  # whether the teacher's run, given again, is the same to the last bit


def run(setup: Setup) -> Report:
    teachers, students = _sorted(setup.toy_policies)
    work = partial(_judge, students=students, count=setup.cell_episodes, small=setup.small)
    every = dict(zip(teachers, setup.each(work, teachers), strict=True))
    cells = [cell for one in every.values() for cell in one.cells]
    spreads = [one for judged in every.values() for one in judged.spreads]
    return setup.report(
        STUDY,
        method=METHOD,
        controls=_controls(every),
        tables=[
            *(_table(name, cells) for name in teachers),
            *([spread_table("Which ways are left", "weights", spreads)] if spreads else []),
        ],
        plots=[_plot(cells), *([spread_plot("ways", spreads)] if spreads else [])],
        verdict=verdict(cells),
        would_change=WOULD_CHANGE,
        not_run=_not_run(teachers, students),
        data={"cells": [plain_document(cell) for cell in cells], "spread": [plain_document(one) for one in spreads]},
    )


def _sorted(policies: Mapping[str, Path]) -> tuple[dict[str, Path], dict[str, dict[str, Path]]]:
    """Teachers' folders by name, and their students' by recipe: those are called TEACHER.RECIPE. Raises ConfigError."""
    teachers = {name: folder for name, folder in policies.items() if "." not in name}
    students: dict[str, dict[str, Path]] = {name: {} for name in teachers}
    for name, folder in policies.items():
        teacher, _, recipe = name.partition(".")
        if not recipe:
            continue
        if teacher not in teachers or recipe not in RECIPES:
            raise ConfigError(
                f"--policy {name} is no student: it should be TEACHER.RECIPE, of the teachers {', '.join(teachers)} "
                f"and the recipes {', '.join(RECIPES)}"
            )
        students[teacher][recipe] = folder
    return teachers, students


def _judge(
    tell: Tell, name: str, folder: Path, *, students: Mapping[str, Mapping[str, Path]], count: int, small: bool
) -> Judged:
    teacher = open_policy(name, folder)
    models = {TEACHER: teacher} | {recipe: open_policy(name, students[name][recipe]) for recipe in students[name]}
    episodes, found, cells = range(count), {}, []
    baseline = play(teacher, episodes, sampled(teacher.model, STEPS))
    for weights, policy in models.items():
        for steps in _steps(weights):
            same = (weights, steps) == (TEACHER, STEPS)
            played = baseline if same else play(policy, episodes, sampled(policy.model, steps))
            found[weights, steps] = played
            cells.append(_cell(name, weights, steps, played, baseline, error(teacher, policy, steps)))
            tell(f"{name}: {weights}, {steps} steps: {played.rate}, {cells[-1].verdict}")
    spreads = []
    if teacher.toy is POST:
        for weights, policy in models.items():
            for steps in (STEPS, 1) if weights == TEACHER else (1,):
                one = spread(policy, episodes, 16 if small else 64, steps)
                spreads.append(structs.replace(one, policy=f"{name}, {weights}, {_reported(steps)}"))
    pairs_matter = None
    if {"consistency", "shuffled"} <= models.keys():
        pairs_matter = found["shuffled", 1].against(found["consistency", 1]).document
    again = play(open_policy("again", folder), range(4), sampled(teacher.model, STEPS)).paths
    first = play(teacher, range(4), sampled(teacher.model, STEPS)).paths
    return Judged(cells, spreads, pairs_matter, same_prefix(list(models.values())), bool(np.array_equal(again, first)))


def _steps(weights: str) -> tuple[int, ...]:
    return {TEACHER: (STEPS, 1), "consistency": (1, 2, STEPS)}.get(weights, (1,))


def _reported(steps: int) -> str:
    return "one step" if steps == 1 else f"{steps} steps"


def _cell(policy: str, weights: str, steps: int, played: Played, baseline: Played, off: float) -> DistilledCell:
    rates = played.rate.document, played.against(baseline).document
    return DistilledCell(policy, weights, steps, *rates, int(played.touched.sum()), off)


def error(teacher: ToyPolicy, student: ToyPolicy, steps: int, episodes: int = 64) -> float:
    """Relative rms of a student's actions against the teacher's at ten steps, at the beginning of other episodes."""
    numbers = range(_JUDGED, _JUDGED + episodes)
    seen, noise = teacher.observe(teacher.toy.start(seeds_of(numbers))), teacher.noise(numbers, 0)
    exact, found = (
        policy.model.sample(seen, noise, n)[..., :2].double() for policy, n in ((teacher, STEPS), (student, steps))
    )
    return float((found - exact).norm() / exact.norm())


def same_prefix(policies: Sequence[ToyPolicy]) -> bool:
    """Whether all have the first one's keys and values for an observation, to the last bit."""
    seen = policies[0].observe(policies[0].toy.start(seeds_of(range(2))))
    caches = [policy.model.prefix(seen) for policy in policies]
    return all(torch.equal(one.k, caches[0].k) and torch.equal(one.v, caches[0].v) for one in caches)


METHOD = (
    "A student begins with its teacher's weights; the action expert alone learns, from what the teacher makes of "
    f"noises in {STEPS} Euler steps. Recipes: {'; '.join(f'{name}, {what}' for name, what in RECIPES.items())}. Data, "
    "steps and rates of training are the same for all. Closed loop on toy tasks, five actions of a chunk carried out, "
    "no delay, the same episodes and noise in every cell; differences are against the teacher at ten steps."
)
WOULD_CHANGE = (
    "A policy of full size on a real task: there the expert may need more than minutes, and a teacher's own errors are "
    "copied, too. A recipe without the teacher's whole ways (targets of the student's own steps) would need less data."
)


def verdict(cells: Sequence[DistilledCell]) -> str:
    """In words what the intervals say, for each teacher."""
    said = []
    for policy in dict.fromkeys(cell.policy for cell in cells):
        own = {(cell.weights, cell.steps): cell for cell in cells if cell.policy == policy}
        text = f"{policy}: the teacher solves {_percent(own[TEACHER, STEPS].rate)} in ten steps"
        for weights, steps in [(weights, 1) for weights in (TEACHER, *RECIPES)] + [("consistency", STEPS)]:
            cell = own.get((weights, steps))
            if cell is not None:
                of = f"{weights} in {'one' if steps == 1 else 'ten'}"
                text += f"; {of} {_percent(cell.rate)}, {paired_cell(cell.against_teacher)}, {cell.verdict}"
        said.append(text)
    return f"{'. '.join(said)}. “As good”: not worse by {100 * MARGIN:.0f} points, with 95 % confidence."


def _percent(rate: RateDocument) -> str:
    return f"{rate_cells(rate)[1]} %"


def _controls(every: Mapping[str, Judged]) -> list[Control]:
    controls = [
        Control(
            "The same weights under another name have the same episodes, bit for bit.",
            all(judged.repeated for judged in every.values()),
            "",
        ),
        Control(
            "Keys and values of every student are its teacher's, bit for bit: the action expert alone has learned.",
            all(judged.same_prefix for judged in every.values()),
            "",
        ),
    ]
    for name, judged in every.items():
        by_label = {one.policy: one for one in judged.spreads}
        if judged.pairs_matter is not None and by_label:
            controls.append(
                Control(
                    f"{name}: the same training with other noises' actions is worse in one step.",
                    judged.pairs_matter.difference95[1] < 0,
                    f"Difference {paired_cell(judged.pairs_matter)} points.",
                )
            )
        ways, mean = by_label.get(f"{name}, {TEACHER}, 10 steps"), by_label.get(f"{name}, mean, one step")
        if ways is not None and mean is not None:
            controls.append(
                Control(
                    f"{name}: a student of the mean has no two ways, the teacher has (Sarle's coefficient; uniform "
                    f"{UNIFORM:.2f}).",
                    mean.bimodality < UNIFORM < ways.bimodality,
                    f"{mean.bimodality:.2f} and {ways.bimodality:.2f}, "
                    f"rarer side {mean.minority:.3f} and {ways.minority:.3f}.",
                )
            )
    return controls


def _not_run(teachers: Mapping[str, Path], students: Mapping[str, Mapping[str, Path]]) -> list[str]:
    lines = [
        f"{teacher}.{recipe}: `python -m turbopi_lab.small_policy distill --recipe {recipe}` makes it, `--policy` adds "
        "it."
        for teacher in teachers
        for recipe in RECIPES
        if recipe not in students[teacher]
    ]
    return [*lines, "LIBERO: its small policy imitates one expert, so there are no two ways to keep."]


# --- tables and plots -------------------------------------------------------------------------------------------------


def _table(policy: str, cells: Sequence[DistilledCell]) -> Grid:
    rows: list[list[Cell]] = [
        [cell.weights, cell.steps, *rate_cells(cell.rate), paired_cell(cell.against_teacher), cell.verdict, cell.error]
        for cell in cells
        if cell.policy == policy
    ]
    columns = ["weights", "steps", "solved", "success, % [95 %]", "against the teacher, points", "verdict"]
    note = "Error: relative rms of the actions against the teacher's at ten steps, from the same noise."
    return Grid(f"Closed loop: {policy}", [*columns, "error"], rows, note)


def _plot(cells: Sequence[DistilledCell]) -> Plot:
    panels = []
    for policy in dict.fromkeys(cell.policy for cell in cells):
        series = []
        for weights in (TEACHER, *RECIPES):
            own = [cell for cell in cells if (cell.policy, cell.weights) == (policy, weights)]
            own.sort(key=lambda cell: cell.steps)
            if own:
                series.append(rate_series(weights, [float(cell.steps) for cell in own], [cell.rate for cell in own]))
        panels.append(
            Panel(f"{policy}: success", "Euler steps", "%, Wilson's 95 %", series, True, ticks=[1.0, 2.0, 10.0])
        )
    return Plot("distillation", panels)


STUDY = Study(
    "distillation",
    "Does a distilled student solve in one denoising step what its teacher solves in ten?",
    "One step solves as much as ten on LIBERO, without any training for it.",
    run,
)
