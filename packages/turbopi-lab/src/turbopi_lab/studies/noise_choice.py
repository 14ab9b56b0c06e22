"""Noise chosen by going back from the running chunk, mode `paint`: what of it matters? (models/pi0/noise_choice.py)

Against `rtc` it is judged by `turbopi eval chase --execution rtc,paint`, see docs/dev/log/real_time.md.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from msgspec import Struct
from torch import Tensor

from turbopi.evaluate.statistics import PairedDocument, RateDocument
from turbopi.models.pi0.conditioning import Conditioning, TokenTimes
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.noise_choice import NoiseChoice
from turbopi.models.pi0.reference import Pi0Model
from turbopi.support.reading import plain_document
from turbopi_lab.studies.pipelining import Timing, play_late
from turbopi_lab.studies.report import Cell, Control, Grid, Report, paired_cell, rate_cells
from turbopi_lab.studies.rollouts import REPLAN, Call, Played, ToyPolicy, open_policy
from turbopi_lab.studies.study import Setup, Study

STEPS, ROUNDS = 5, 10  # of denoising; of the fixed point that inverts a step
DELAYS = (2, 4)
PLAIN, PAINT = "plain", "paint"
Back = Callable[[Pi0Model, KVCache, Tensor], Tensor]  # actions to noise


class NoiseCell(Struct, frozen=True):
    """prefix, gap: mean distance to the running chunk, before the delay and at it, in the actions' own unit."""

    delay: int
    way: str
    evaluations: int
    rate: RateDocument
    against_paint: PairedDocument
    prefix: float
    gap: float


@dataclass(frozen=True)
class Way:
    """back: None: noise isn't chosen. rows: whose noise is; None: as many as the delay. own: its episode's chunk"""

    name: str
    back: Back | None
    evaluations: int = 3 * STEPS
    rows: int | None = None
    own: bool = True


def _back(times: Callable[[TokenTimes], np.ndarray]) -> Back:
    def back(model: Pi0Model, cache: KVCache, x: Tensor) -> Tensor:
        there = TokenTimes.plain(STEPS, x.shape[1])
        tokens = TokenTimes(times(there), there.reversed().steps)
        return model.denoise(cache, x, STEPS, conditioning=Conditioning(tokens=tokens))

    return back


def inverted(model: Pi0Model, cache: KVCache, x: Tensor) -> Tensor:
    """The noise from which the loop gives x: each step's start is found as a fixed point."""
    there = TokenTimes.plain(STEPS, x.shape[1])
    for t, step in zip(there.times[::-1, None], there.steps[::-1, None], strict=True):
        one, start = Conditioning(tokens=TokenTimes(t.copy(), step.copy())), x
        for _ in range(ROUNDS):
            start = x - (model.denoise(cache, start, 1, conditioning=one) - start)
        x = start
    return x


leaving = _back(lambda there: there.reversed().times)
WAYS = (
    Way(PLAIN, None, STEPS),
    Way(PAINT, leaving),
    Way("time of the point it arrives at", _back(lambda there: there.times[::-1].copy())),
    Way("each step inverted", inverted, (2 + ROUNDS) * STEPS),
    Way("noise of the whole left-over", leaving, rows=11),
    Way("another episode's chunk", leaving, own=False),
)


@dataclass
class Joining:
    """An actor of delayed episodes."""

    model: Pi0Model
    way: Way
    delay: int
    prefix: list[float] = field(default_factory=list)
    gap: list[float] = field(default_factory=list)

    def __call__(self, call: Call) -> Tensor:
        cache, noise, back = self.model.prefix(call.observation), call.noise, self.way.back
        if call.previous is not None and back is not None and self.delay:
            rows = np.arange(noise.shape[1]) < (self.way.rows or self.delay)
            values = call.previous if self.way.own else call.previous.roll(1, 0)

            def loop(x: Tensor, backwards: bool, back: Back = back) -> Tensor:
                return back(self.model, cache, x) if backwards else self.model.denoise(cache, x, STEPS)

            noise = NoiseChoice(rows, values.numpy()).chosen(noise, loop)  # values of each episode
        chunk = self.model.denoise(cache, noise, STEPS)
        if call.previous is not None:
            apart = (chunk - call.previous)[..., :2].norm(dim=-1).mean(0)
            self.prefix.append(float(apart[: self.delay].mean()))
            self.gap.append(float(apart[self.delay]))
        return chunk


def run(setup: Setup) -> Report:
    policy, episodes = open_policy("chase"), range(setup.cell_episodes)
    cells: list[NoiseCell] = []
    for delay in DELAYS[-1:] if setup.small else DELAYS:
        played: dict[str, tuple[Played, Joining]] = {}
        for way in WAYS:
            actor = Joining(policy.model, way, delay)
            played[way.name] = play_late(policy, episodes, actor, Timing(way.name, delay, REPLAN))[0], actor
            setup.tell(f"delay {delay}, {way.name}: {played[way.name][0].rate}")
        for way in WAYS:
            found, actor = played[way.name]
            rates = found.rate.document, found.against(played[PAINT][0]).document
            apart = float(np.mean(actor.prefix)), float(np.mean(actor.gap))
            cells.append(NoiseCell(delay, way.name, way.evaluations, *rates, *apart))
    return setup.report(
        STUDY,
        method=METHOD,
        controls=_controls(policy, episodes, cells),
        tables=[_table(cells)],
        plots=[],
        verdict=verdict(cells),
        would_change=WOULD_CHANGE,
        not_run=["LIBERO: `turbopi eval libero … --execution rtc,paint` judges the mode itself."],
        data={"cells": [plain_document(cell) for cell in cells]},
    )


METHOD = (
    f"The chase, float32, {STEPS} Euler steps, {REPLAN} actions of a chunk, chunks that come 2 or 4 steps late. "
    "The noise of the actions that will be carried out meanwhile is found by going back from them (arXiv 2606.19774), "
    "with the velocity at the time and the x of the point that a step leaves; variants change one thing."
)
WOULD_CHANGE = "A policy whose demonstrations differ more, longer chunks, more denoising steps."
CLAIMED = "Noise that is chosen by inversion continues the running chunk, without gradients."


def _controls(policy: ToyPolicy, episodes: Sequence[int], cells: Sequence[NoiseCell]) -> list[Control]:
    few, model = range(min(8, len(episodes))), policy.model
    paths = [play_late(policy, few, Joining(model, way, 0), Timing("", 0, REPLAN))[0].paths for way in WAYS[:2]]
    world = policy.toy.start([(7, n) for n in few])
    cache, noise = model.prefix(policy.observe(world)), policy.noise(few, 0)
    made = model.denoise(cache, noise, STEPS)
    off = float((model.denoise(cache, inverted(model, cache, made), STEPS) - made).norm() / made.norm())
    of = {(cell.delay, cell.way): cell for cell in cells}
    farther = all(of[d, WAYS[-1].name].prefix > of[d, PAINT].prefix for d, _ in of)
    return [
        Control("Without a delay it is the plain call, bit for bit.", bool(np.array_equal(paths[0], paths[1])), ""),
        Control("Inverted steps give the noise of a chunk.", off < 0.05, f"The chunk again within {off:.1e} of it."),
        Control("Another episode's chunk is farther from the running one.", farther, ""),
    ]


def verdict(cells: Sequence[NoiseCell]) -> str:
    said = [f"delay {one.delay}, {one.way} {paired_cell(one.against_paint)}" for one in cells if one.way != PAINT]
    return f"Solved beyond Algorithm 1, points: {'; '.join(said)}."


def _table(cells: Sequence[NoiseCell]) -> Grid:
    columns = ["delay", "noise", "evaluations", "solved", "success, % [95 %]", "against paint", "prefix", "gap"]
    rows: list[list[Cell]] = [
        [
            one.delay,
            one.way,
            one.evaluations,
            *rate_cells(one.rate),
            paired_cell(one.against_paint),
            one.prefix,
            one.gap,
        ]
        for one in cells
    ]
    return Grid("Closed loop: chase", columns, rows)


STUDY = Study("noise_choice", "Noise chosen before the loop: what of it matters?", CLAIMED, run)
