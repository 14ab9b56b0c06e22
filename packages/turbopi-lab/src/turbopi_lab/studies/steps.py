"""Fewer denoising steps: which solver and time grid need how few evaluations, where several ways lead to the goal?

Two policies of the post (studies/post.py) have the same model, amount of data and training, but one imitates an expert
with one way, the other one with two. Where a policy has one way its flow is nearly straight, and few steps cost
nothing. A single step from noise gives the mean of all ways: between two ways around a post, that is the post.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import torch
from msgspec import Struct
from torch import Tensor

from turbopi.checkpoint import open_checkpoint, random_checkpoint
from turbopi.evaluate.statistics import PairedDocument, RateDocument
from turbopi.policy import shipped
from turbopi.support.reading import plain_document
from turbopi_lab.studies import solvers
from turbopi_lab.studies.problems import EXACT, ErrorCell, Problem, errors, learned_grids, libero_problems
from turbopi_lab.studies.report import (
    MARGIN,
    Cell,
    Control,
    Grid,
    Panel,
    Plot,
    Report,
    Series,
    compared,
    paired_cell,
    rate_cells,
    rate_series,
)
from turbopi_lab.studies.rollouts import POST, Call, Played, ToyPolicy, met, open_policy, play, seeds_of
from turbopi_lab.studies.solvers import BASELINE, Learned, Way, grid_times, ways
from turbopi_lab.studies.spread import UNIFORM, Spread, spread, spread_plot, spread_table
from turbopi_lab.studies.study import Setup, Study, Tell

WARM = 0.6  # where a warm start begins: that much noise, and the rest is the chunk of before
_PRACTICE, _JUDGED = 10_000, 20_000  # numbers of the first episodes that grids are learned on, and errors measured on
LIBERO, RANDOM = "small policy", "random weights"


class SuccessCell(Struct, frozen=True):
    """A way to integrate on a policy's task."""

    policy: str
    solver: str
    grid: str
    warm: bool
    evaluations: int
    rate: RateDocument
    against_baseline: PairedDocument  # ten Euler steps
    touched_post: int  # episodes

    @property
    def verdict(self) -> str:
        return compared(self.against_baseline)


# --- closed loop ------------------------------------------------------------------------------------------------------


def actor(policy: ToyPolicy, way: Way, learned: Learned, warm: float = WARM) -> Callable[[Call], Tensor]:
    """What answers calls in this way."""
    times = grid_times(way, learned)

    def answer(call: Call) -> Tensor:
        model, cache = policy.model, policy.model.prefix(call.observation)
        if not way.warm or call.previous is None:
            return solvers.solve(model, cache, call.noise, way.solver, times, way.evaluations)
        begun = warm * call.noise + (1 - warm) * call.previous
        return solvers.solve(model, cache, begun, way.solver, [warm * t for t in times], way.evaluations)

    return answer


def practice(policy: ToyPolicy, episodes: int) -> Problem:
    """What the policy meets in its first calls, ten Euler steps each, with the exact solutions."""
    numbers = range(_PRACTICE, _PRACTICE + episodes)
    return Problem.of(policy.model, *met(policy, numbers, actor(policy, BASELINE, {})), 2)


def successes(policy: ToyPolicy, learned: Learned, count: int, small: bool, tell: Tell) -> list[SuccessCell]:
    episodes = range(count)
    baseline = play(policy, episodes, actor(policy, BASELINE, learned))
    cells = []
    for way in ways(small):
        played = baseline if way == BASELINE else play(policy, episodes, actor(policy, way, learned))
        cells.append(_cell(policy, way, played, baseline))
        tell(f"{policy.name}: {way}: {played.rate}, {cells[-1].verdict}")
    return cells


def _cell(policy: ToyPolicy, way: Way, played: Played, baseline: Played) -> SuccessCell:
    touched = int(played.touched.sum())
    rates = played.rate.document, played.against(baseline).document
    return SuccessCell(policy.name, way.solver, way.grid, way.warm, way.evaluations, *rates, touched)


def warm_from_noise_is_plain(policy: ToyPolicy) -> bool:
    """A warm start that begins at t = 1 is no warm start, to the last bit."""
    ways_, episodes = (BASELINE, Way(BASELINE.solver, BASELINE.grid, BASELINE.evaluations, warm=True)), range(4)
    plain, warm = (play(policy, episodes, actor(policy, way, {}, warm=1.0)) for way in ways_)
    return bool(np.array_equal(plain.paths, warm.paths))


def loop_is_the_models(policy: ToyPolicy) -> float:
    """How far Euler's steps on the uniform grid are from openpi's loop: largest difference of an action."""
    world = policy.toy.start(seeds_of(range(4)))
    cache, noise = policy.model.prefix(policy.observe(world)), policy.noise(range(4), 0)
    ours = solvers.solve(policy.model, cache, noise, "euler", solvers.begins("uniform", 10), 10)
    return float((ours - policy.model.denoise(cache, noise, 10)).abs().max())


# --- the study --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Judged:
    """What is found of a policy, or of weights without a task."""

    name: str
    errors: list[ErrorCell]
    halved: float  # what half as many steps of the exact solution's solver change
    spread: Spread | None = None
    cells: list[SuccessCell] = field(default_factory=list)


def judge(tell: Tell, name: str, folder: Path, *, count: int, small: bool) -> Judged:
    """A policy of a toy task."""
    policy = open_policy(name, folder)
    learned = learned_grids(practice(policy, 2 if small else 24), small)
    judged = beginnings(policy, 4 if small else 64)
    broad = None
    if policy.toy is POST:
        broad = spread(policy, range(count), 16 if small else 64)
        tell(f"{name}: bimodality {broad.bimodality:.3f}, rarer side {broad.minority:.3f}")
    cells = successes(policy, learned, count, small, tell)
    return Judged(name, errors(name, judged, learned, small), judged.halved, broad, cells)


def judge_errors(tell: Tell, name: str, folder: Path, *, small: bool) -> Judged:
    """A checkpoint for LIBERO, by its errors alone; RANDOM needs no folder."""
    checkpoint = random_checkpoint("pi05_tiny") if name == RANDOM else open_checkpoint(folder)
    learning, judged = libero_problems(checkpoint, torch.device("cpu"), small)
    found = errors(name, judged, learned_grids(learning, small), small)
    tell(f"{name}: errors measured")
    return Judged(name, found, judged.halved)


def run(setup: Setup) -> Report:
    weights = {LIBERO: shipped.SMALL_POLICY} if setup.small else {LIBERO: shipped.SMALL_POLICY, RANDOM: Path()}
    every = setup.each(partial(_judge_any, count=setup.cell_episodes, small=setup.small), weights | setup.toy_policies)
    found = [error for one in every for error in one.errors]
    cells = [cell for one in every for cell in one.cells]
    spreads = [one.spread for one in every if one.spread is not None]
    parts: dict[str, Sequence[Struct]] = {"errors": found, "successes": cells, "spread": spreads}
    return setup.report(
        STUDY,
        method=METHOD,
        controls=_controls(open_policy("chase"), spreads, {one.name: one.halved for one in every}, setup.small),
        tables=[
            *([spread_table("How broad the policies of the post are", "policy", spreads)] if spreads else []),
            *(_success_table(name, cells) for name in setup.toy_policies),
            _error_table(found),
        ],
        plots=[_plot(cells, found)] + ([spread_plot("spread", spreads)] if spreads else []),
        verdict=verdict(cells),
        would_change=WOULD_CHANGE,
        not_run=_not_run(setup),
        data={name: [plain_document(one) for one in some] for name, some in parts.items()},
    )


def _judge_any(tell: Tell, name: str, folder: Path, *, count: int, small: bool) -> Judged:
    if name in (LIBERO, RANDOM):
        return judge_errors(tell, name, folder, small=small)
    return judge(tell, name, folder, count=count, small=small)


def beginnings(policy: ToyPolicy, episodes: int) -> Problem:
    """The first calls of other episodes than those that grids are learned on, and than the study's own."""
    numbers = range(_JUDGED, _JUDGED + episodes)
    return Problem.of(policy.model, policy.observe(policy.toy.start(seeds_of(numbers))), policy.noise(numbers, 0), 2)


METHOD = (
    "The float32 reference's action expert, integrated by five solvers on four time grids (uniform, shifted to noise "
    "and to actions, learned on other observations by moving one time after the other) in 1, 2, 3, 5 and 10 "
    f"evaluations; and by the same from a warm start (t = {WARM}: the rest of the chunk before, with noise). Errors "
    f"against {EXACT} steps of the midpoint method from the same noise. Closed loop on toy tasks, five actions of a "
    "chunk carried out, no delay, the same episodes and noise in every cell; differences are against ten Euler steps "
    "on a uniform grid. The two policies of the post differ in their demonstrations alone: the expert passes on one "
    "side, or on either, drawn for each episode."
)
WOULD_CHANGE = (
    "A policy of a real task whose demonstrations differ: several people, several grasps. The toy's two ways are as "
    "far apart as can be, and a tip that touches the post is lost, so it shows the effect at its largest."
)
CLAIMED = (
    "10 → 3 steps cost less than 1 % of mean squared error; success on nine episodes a suite is unchanged at 1 step."
)


def verdict(cells: Sequence[SuccessCell]) -> str:
    """In words what the intervals say, for each policy."""
    said = []
    for policy in dict.fromkeys(cell.policy for cell in cells):
        own = [cell for cell in cells if cell.policy == policy]
        (one,) = [cell for cell in own if cell.evaluations == 1 and not cell.warm]
        good = [cell for cell in own if cell.verdict == "as good" and not cell.warm]
        fewest = min((cell.evaluations for cell in good), default=None)
        difference = f"difference {paired_cell(one.against_baseline)}, {one.verdict}"
        text = f"{policy}: one evaluation {_percent(one.rate)}, {difference}"
        if fewest is not None:
            which = [f"{cell.solver} {cell.grid}" for cell in good if cell.evaluations == fewest]
            text += f"; as good with {fewest} ({', '.join(which)})"
        said.append(text)
    return f"{'. '.join(said)}. “As good”: not worse by {100 * MARGIN:.0f} points, with 95 % confidence."


def _percent(rate: RateDocument) -> str:
    return str(rate_cells(rate)[1]) + " %"


def _controls(policy: ToyPolicy, spreads: Sequence[Spread], halved: Mapping[str, float], small: bool) -> list[Control]:
    off = loop_is_the_models(policy)
    worst = max(value for name, value in halved.items() if name != RANDOM)
    bound = 0.3 if small else 0.01  # ten steps in the small form
    random = f", with random weights {halved[RANDOM]:.1e}" if RANDOM in halved else ""
    reported = f"{worst:.1e} of the actions{random}."
    controls = [
        Control("Ten Euler steps here are `Pi0Model.denoise`'s.", off < 1e-5, f"Largest difference {off:.1e}."),
        Control("A warm start at t = 1 is the plain run, bit for bit.", warm_from_noise_is_plain(policy), ""),
        Control("Half as many steps give the exact solution, too, of every trained policy.", worst < bound, reported),
    ]
    by_name = {one.policy: one for one in spreads}
    if {"one_way", "two_ways"} <= by_name.keys():
        one, two = by_name["one_way"], by_name["two_ways"]
        reported = (
            f"{one.bimodality:.2f} and {two.bimodality:.2f}, rarer side {one.minority:.3f} and {two.minority:.3f}."
        )
        controls.append(
            Control(
                "Actions of two_ways are bimodal, those of one_way aren't "
                f"(Sarle's coefficient; uniform {UNIFORM:.2f}).",
                one.bimodality < UNIFORM < two.bimodality and one.minority < 0.05 < two.minority,
                reported,
            )
        )
    return controls


def _not_run(setup: Setup) -> list[str]:
    lines = [
        "Warm starts on grids that aren't uniform.",
        "Success on LIBERO, which needs its simulator and a GPU: docs/research.md has the command.",
    ]
    if not {"one_way", "two_ways"} <= setup.policies.keys():
        lines.append(
            "The policies of the post: `python -m turbopi_lab.small_policy post` makes them, `--policy NAME=FOLDER` "
            "adds them."
        )
    return lines


# --- tables and plots -------------------------------------------------------------------------------------------------


def _success_table(policy: str, cells: Sequence[SuccessCell]) -> Grid:
    columns = [
        "solver",
        "grid",
        "start",
        "evaluations",
        "solved",
        "success, % [95 %]",
        "against ten Euler steps, points",
    ]
    rows: list[list[Cell]] = [
        [
            cell.solver if cell.evaluations > 1 else "any",
            cell.grid if cell.evaluations > 1 else "any",
            "warm" if cell.warm else "noise",
            cell.evaluations,
            *rate_cells(cell.rate),
            paired_cell(cell.against_baseline),
            cell.verdict,
        ]
        for cell in cells
        if cell.policy == policy
    ]
    return Grid(f"Closed loop: {policy}", [*columns, "verdict"], rows)


def _error_table(found: Sequence[ErrorCell]) -> Grid:
    weights = list(dict.fromkeys(cell.weights for cell in found))
    by_way: dict[tuple[str, str, int], dict[str, float]] = {}
    for cell in found:
        by_way.setdefault((cell.solver, cell.grid, cell.evaluations), {})[cell.weights] = cell.relative
    rows: list[list[Cell]] = [[*way, *(of.get(name) for name in weights)] for way, of in by_way.items()]
    return Grid("Relative error of the actions", ["solver", "grid", "evaluations", *weights], rows)


def _plot(cells: Sequence[SuccessCell], found: Sequence[ErrorCell]) -> Plot:
    panels = []
    for policy in dict.fromkeys(cell.policy for cell in cells):
        panels.append(_panel(policy, [cell for cell in cells if cell.policy == policy]))
    errors_ = [
        Series(f"{solver}", *_points([c for c in found if (c.weights, c.grid) == (LIBERO, "uniform")], solver))
        for solver in dict.fromkeys(cell.solver for cell in found)
    ]
    ticks = [float(n) for n in solvers.EVALUATIONS]
    panels.append(
        Panel("LIBERO's small policy, uniform grid", "evaluations", "relative error", errors_, True, True, ticks)
    )
    return Plot("steps", panels)


def _points(cells: Sequence[ErrorCell], solver: str) -> tuple[list[float], list[float]]:
    own = [cell for cell in cells if cell.solver == solver or cell.evaluations == 1]
    return [float(cell.evaluations) for cell in own], [cell.relative for cell in own]


def _panel(policy: str, cells: Sequence[SuccessCell]) -> Panel:
    series = []
    for label, solver, grid, warm in (
        ("Euler", "euler", "uniform", False),
        ("Euler, learned grid", "euler", "learned", False),
        ("exponential", "exponential", "uniform", False),
        ("Euler, warm", "euler", "uniform", True),
    ):
        own = [c for c in cells if c.warm == warm and ((c.solver, c.grid) == (solver, grid) or c.evaluations == 1)]
        series.append(rate_series(label, [float(c.evaluations) for c in own], [c.rate for c in own]))
    ticks = [float(n) for n in solvers.EVALUATIONS]
    return Panel(
        f"{policy}: success", "evaluations of the action expert", "%, Wilson's 95 %", series, True, ticks=ticks
    )


STUDY = Study("steps", "How few denoising steps are enough, and with which solver?", CLAIMED, run)
