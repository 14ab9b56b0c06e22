"""Vision and prefix of the next observation beside the denoising of this one: what does it give, and to whom?

A call is an encoding (vision and prefix) and a denoising. Serially, a chunk is asked for when the one before is there.
Overlapped, the next observation is encoded meanwhile: chunks come more often, each from an observation that is as old
as before, or older, as both share the GPU. So throughput grows; whether a robot gains is asked in closed loop.
"""

import math
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from msgspec import Struct
from torch import Tensor

from turbopi.checkpoint import random_checkpoint
from turbopi.evaluate.statistics import PairedDocument, RateDocument
from turbopi.policy.policy import UnifiedPolicy
from turbopi.support.reading import plain_document
from turbopi_lab.studies.report import (
    PERCENT,
    Cell,
    Control,
    Grid,
    Panel,
    Plot,
    Report,
    paired_cell,
    rate_cells,
    rate_series,
)
from turbopi_lab.studies.rollouts import (
    CHASE,
    REPLAN,
    Actor,
    Call,
    Played,
    ToyPolicy,
    open_policy,
    play,
    rest,
    sampled,
    seeds_of,
)
from turbopi_lab.studies.study import Setup, Study

STEPS = 5
# How much longer an encoding and a denoising take beside each other: `tensorrt` alone and `tensorrt_pipelined` in
# flight, H200 (benchmarks/results/h200_2026-11-21_tensorrt_study.json)
SLOWER = {"encode": (2.337 + 8.553) / (1.995 + 7.841), "denoise": 15.753 / 10.766}
MEASURED = {
    "one at a time": (22.74, 43.8),
    "in flight": (36.16, 63.2),
}  # latency in ms, observations a second: the same


@dataclass(frozen=True)
class Timing:
    """In control steps: from an observation to its chunk, and from an observation to the next one."""

    how: str
    latency: int
    period: int

    @property
    def age(self) -> float:
        """Mean age of the observation behind an action, in steady state."""
        return self.latency + (self.period - 1) / 2


def timings(encode: float, denoise: float) -> list[Timing]:
    """For stages that take so many control steps alone. Whole control steps: what isn't there waits for the next."""
    both = math.ceil(encode + denoise)
    slow_encode, slow_denoise = encode * SLOWER["encode"], denoise * SLOWER["denoise"]
    return [
        Timing("one at a time", both, both),
        Timing("overlapped, each as fast as alone", both, math.ceil(max(encode, denoise))),
        Timing(
            "overlapped, slower as measured",
            math.ceil(slow_encode + slow_denoise),
            math.ceil(max(slow_encode, slow_denoise)),
        ),
    ]


class TimingCell(Struct, frozen=True):
    stage_steps: int  # that an encoding and a denoising take, each
    how: str
    latency: int
    period: int
    age: float  # mean, as it was in the episodes
    oldest: int
    rate: RateDocument
    against_serial: PairedDocument


def play_late(policy: ToyPolicy, episodes: Sequence[int], actor: Actor, timing: Timing) -> tuple[Played, list[int]]:
    """Episodes in which chunks come late, and the age of the observation behind every action, in control steps.

    The clock starts when the first chunk is there. A chunk that arrives takes over at once, from the action that is
    due: what of it has passed meanwhile is left out.
    """
    world = policy.toy.start(seeds_of(episodes))
    solved, touched = (np.zeros(len(episodes), np.bool_) for _ in range(2))
    paths, ages, coming = [world.tip], [], {}
    chunk, seen_at = torch.empty(0), 0
    for step in range(policy.toy.max_steps):
        if step % timing.period == 0:
            left = rest(chunk, step - seen_at) if step else None
            call = Call(step // timing.period, episodes, policy.observe(world), policy.noise(episodes, step), left)
            coming[0 if step == 0 else step + timing.latency] = step, actor(call)
        if step in coming:
            seen_at, chunk = coming.pop(step)
        ages.append(step - seen_at)
        solved |= world.step(chunk[:, step - seen_at, :2].double().numpy())
        touched |= world.stopped & ~solved
        paths.append(world.tip)
    return Played(solved, touched, np.stack(paths)), ages


class Overlap(Struct, frozen=True):
    """Whole calls of two policies on one device, one thread each, against one policy alone."""

    calls: int  # of each measurement
    alone_ms: float  # medians
    together_ms: float
    alone_per_second: float
    together_per_second: float
    actions_equal_bit_for_bit: bool


def overlap(policies: Sequence[Any], observation: object, calls: int) -> Overlap:
    """The policies are of the same weights; each gives the same actions for a seed, alone or beside others."""
    expected = policies[0].infer(observation, seed=0)["actions"]
    for policy in policies:
        policy.infer(observation, seed=0)

    def run(policy: Any, found: list[tuple[float, bool]]) -> None:
        for _ in range(calls):
            begun = time.perf_counter()
            actions = policy.infer(observation, seed=0)["actions"]
            found.append(((time.perf_counter() - begun) * 1e3, bool(np.array_equal(actions, expected))))

    def measured(some: Sequence[Any]) -> tuple[float, float, bool]:
        found: list[tuple[float, bool]] = []
        threads = [threading.Thread(target=run, args=(policy, found)) for policy in some]
        begun = time.perf_counter()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        seconds = time.perf_counter() - begun
        return float(np.median([ms for ms, _ in found])), len(found) / seconds, all(same for _, same in found)

    alone, together = measured(policies[:1]), measured(policies)
    return Overlap(calls, alone[0], together[0], alone[1], together[1], alone[2] and together[2])


# --- the study --------------------------------------------------------------------------------------------------------


def run(setup: Setup) -> Report:
    policy, episodes = open_policy("chase"), range(setup.cell_episodes)
    actor = sampled(policy.model, STEPS)
    cells = []
    for stage in (1, 2) if setup.small else (1, 2, 3):
        serial: Played | None = None
        for timing in timings(stage, stage):
            played, ages = play_late(policy, episodes, actor, timing)
            serial = serial or played
            steady = ages[timing.latency + timing.period :]
            reported = float(np.mean(steady)), max(steady)
            rates = played.rate.document, played.against(serial).document
            cells.append(TimingCell(stage, timing.how, timing.latency, timing.period, *reported, *rates))
            setup.tell(f"{stage} + {stage} steps, {timing.how}: {played.rate}, age {reported[0]:.2f}")
    found = _measured(setup) if setup.device.type == "cuda" else None
    return setup.report(
        STUDY,
        method=METHOD,
        controls=_controls(policy, episodes, cells, found),
        tables=[_table(cells), _throughput_table(found)],
        plots=[_plot(cells)],
        verdict=verdict(cells),
        would_change=WOULD_CHANGE,
        not_run=[] if found else ["`fused` in flight twice, on a GPU: `turbopi study pipelining --device cuda`."],
        data={
            "cells": [plain_document(cell) for cell in cells],
            "slower": SLOWER,
            **({"overlap": plain_document(found)} if found else {}),
        },
    )


def _measured(setup: Setup) -> Overlap:
    checkpoint = setup.checkpoint or random_checkpoint("pi05_libero")
    policies = [UnifiedPolicy(checkpoint, backend="fused", device=setup.device) for _ in range(2)]
    for policy in policies:
        policy.warmup()
    return overlap(policies, policies[0].example_observation(0), 20 if setup.small else setup.calls)


METHOD = (
    "Emulated exactly in control steps, on the chase, which forgives no delay: an encoding and a denoising take 1, 2 "
    "or 3 steps each, what isn't there waits for the next step. A chunk takes over when it arrives, from the action "
    "that is due. Overlapped stages are as fast as alone, or slower as `tensorrt_pipelined` was measured on an H200 "
    f"(encoding {SLOWER['encode']:.2f} ×, denoising {SLOWER['denoise']:.2f} ×). The age is the time since the "
    "observation behind an action, mean over an episode."
)
WOULD_CHANGE = (
    "Stages that don't slow each other, as on two devices; a task in which reacting more often matters more than "
    "reacting sooner; several robots on one GPU, for which throughput is what counts."
)
CLAIMED = "A pipelined TensorRT backend and asynchronous reuse of keys and values raise the rate; ages aren't told."


def _controls(
    policy: ToyPolicy, episodes: Sequence[int], cells: Sequence[TimingCell], found: Overlap | None
) -> list[Control]:
    few, actor = range(min(16, len(episodes))), sampled(policy.model, STEPS)
    noises = _NoiseByStep(actor, policy)
    plain = play(policy, few, noises, everyone=True)
    same = play_late(policy, few, actor, Timing("plain", 0, REPLAN))[0]
    expected = [abs(cell.age - Timing("", cell.latency, cell.period).age) < 0.35 for cell in cells]
    controls = [
        Control(
            "Without delay it is the ordinary loop, bit for bit.", bool(np.array_equal(plain.paths, same.paths)), ""
        ),
        Control("Ages are latency + (period − 1) / 2.", all(expected), f"In {sum(expected)} of {len(cells)} cells."),
    ]
    if found is not None:
        controls.append(Control("Calls in flight give equal actions.", found.actions_equal_bit_for_bit, ""))
    return controls


@dataclass
class _NoiseByStep:
    """An actor of the ordinary loop with the noise of `play_late`, which counts steps."""

    actor: Actor
    policy: ToyPolicy

    def __call__(self, call: Call) -> Tensor:
        noise = self.policy.noise(call.episodes, call.number * REPLAN)
        return self.actor(Call(call.number, call.episodes, call.observation, noise, call.previous))


def verdict(cells: Sequence[TimingCell]) -> str:
    said = []
    for cell in cells:
        if cell.latency == cell.period:
            continue
        low, high = cell.against_serial.difference95
        reported = "better" if low > 0 else "worse" if high < 0 else "no different"
        stages = f"{cell.stage_steps} + {cell.stage_steps} steps"
        said.append(f"{stages} {cell.how}: {paired_cell(cell.against_serial)}, {reported}")
    latency, rate = (MEASURED["in flight"][i] / MEASURED["one at a time"][i] for i in (0, 1))
    return (
        f"Success against one at a time, points: {'; '.join(said)}. On one H200, `tensorrt_pipelined` gives {rate:.2f} "
        f"× the observations a second at {latency:.2f} × the latency."
    )


def _table(cells: Sequence[TimingCell]) -> Grid:
    columns = ["encoding + denoising, steps", "how", "latency", "period", "mean age", "oldest", "solved"]
    rows: list[list[Cell]] = [
        [
            f"{cell.stage_steps} + {cell.stage_steps}",
            cell.how,
            cell.latency,
            cell.period,
            cell.age,
            cell.oldest,
            *rate_cells(cell.rate),
            paired_cell(cell.against_serial),
        ]
        for cell in cells
    ]
    return Grid(f"Closed loop: {CHASE.name}, in control steps", [*columns, "success, % [95 %]", "against serial"], rows)


def _throughput_table(found: Overlap | None) -> Grid:
    rows: list[list[Cell]] = [[f"tensorrt, {how}, H200", *numbers] for how, numbers in MEASURED.items()]
    if found is not None:
        rows.append(["fused, one", found.alone_ms, found.alone_per_second])
        rows.append(["fused, two policies in two threads", found.together_ms, found.together_per_second])
    return Grid("Measured, pi05_libero, ten steps", ["how", "latency, ms", "observations a second"], rows)


def _plot(cells: Sequence[TimingCell]) -> Plot:
    series = []
    for how in dict.fromkeys(cell.how for cell in cells):
        own = [cell for cell in cells if cell.how == how]
        series.append(rate_series(how, [cell.age for cell in own], [cell.rate for cell in own]))
    title, x = "Success by the age of what is acted on", "mean age of the observation behind an action, control steps"
    return Plot("pipelining", [Panel(title, x, PERCENT, series)])


STUDY = Study("pipelining", "What does encoding the next observation beside this one's denoising give?", CLAIMED, run)
