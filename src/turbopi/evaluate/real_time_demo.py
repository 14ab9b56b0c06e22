"""The same policy under delay, in two ways to run, in this process: the demo's episodes and plots."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from turbopi.evaluate.delays import COLORS
from turbopi.evaluate.episode import Ending, Execution, run_episode
from turbopi.evaluate.plan import Job, noise_seed
from turbopi.evaluate.sources import LocalPolicy
from turbopi.evaluate.statistics import Paired, Rate
from turbopi.sim import SimSettings, create
from turbopi.support.plots import MUTED, write_figure

SIMULATOR = "chase"
DELAY, HORIZON = 4, 5  # control steps
WAYS = ("async", "rtc_trained")


@dataclass(frozen=True)
class Played:
    """One way to run, on the same episodes as the others."""

    way: str
    delay: int
    endings: list[Ending]

    @property
    def rate(self) -> Rate:
        return Rate(sum(ending.status == "success" for ending in self.endings), len(self.endings))

    @property
    def seam_jump(self) -> float | None:
        """Mean over episodes, in the command's unit: 1 is full speed."""
        jumps = [
            ending.motion.seam_jump
            for ending in self.endings
            if ending.motion is not None and ending.motion.seam_jump is not None
        ]
        return float(np.mean(jumps)) if jumps else None


def play(
    source: LocalPolicy, way: str, delay: int, episodes: int, *, px: int, seed: int, tick: Callable[[], None]
) -> Played:
    """The simulator's first initial states, one after the other; images are drawn in the model's size."""
    simulator = create(SIMULATOR)
    settings = SimSettings(seed=seed, camera_px=px)
    task = simulator.tasks(simulator.suites[0])[0]
    environment = simulator.open(simulator.suites[0], 0, settings)
    execution = Execution(way, HORIZON, delay, lambda last: np.zeros_like(last), getattr(simulator, "motion_dim", None))
    endings = []
    for state in range(episodes):

        def ask(
            step: int, observation: dict[str, object], arguments: Mapping[str, Any], state: int = state
        ) -> Mapping[str, Any]:
            seeds = [noise_seed(seed, 0, state, step)]
            answer = source.infer([observation], seeds, [arguments] if arguments else None)[0]
            return {"actions": answer.actions, **answer.for_next}

        endings.append(
            run_episode(
                environment,
                Job(task, state),
                ask,
                execution,
                max_steps=task.max_steps,
                image_keys=simulator.image_keys,
            )
        )
        tick()
    return Played(way, delay, endings)


def paired(first: Played, second: Played) -> Paired:
    outcomes = [[ending.status == "success" for ending in played.endings] for played in (first, second)]
    return Paired.of(list(zip(*outcomes, strict=True)))


def plot_successes(path: Path, played: Sequence[Played]) -> Path:
    figure = Figure(figsize=(6.2, 1.2 + 0.5 * len(played)), layout="constrained")
    axes = figure.subplots()
    for place, one in enumerate(played):
        low, high = one.rate.interval
        value = one.rate.value or 0.0
        axes.barh(place, 100 * value, color=COLORS[one.way], alpha=0.75, height=0.6)
        axes.plot([100 * low, 100 * high], [place, place], color="0.15", marker="|", linewidth=1.4)
        axes.text(102.5, place, f"{one.rate.successes}/{one.rate.trials}", va="center", fontsize=8)
    axes.set_yticks(range(len(played)), [f"{one.way}, delay {one.delay}" for one in played], fontsize=9)
    axes.invert_yaxis()
    axes.set_xlim(0, 100)
    axes.set_xlabel("success [%], with Wilson's 95 % interval")
    axes.grid(axis="x", alpha=0.3)
    write_figure(path, figure, dpi=120)
    return path


def plot_commands(path: Path, played: Sequence[Played]) -> Path:
    """The commands of one episode, with the seams: the first one that the last way solved and the one before it didn't,
    else the first one that not all ways solved, else the first. The plot says so.
    """
    solved = [[ending.status == "success" for ending in one.endings] for one in played]
    outcomes = list(enumerate(zip(*solved, strict=True)))
    differing = [number for number, ends in outcomes if ends[-1] and not ends[-2]]
    differing += [number for number, ends in outcomes if len(set(ends)) > 1]
    episode = differing[0] if differing else 0
    figure = Figure(figsize=(8.0, 1.9 * len(played) + 0.6), layout="constrained")
    rows = figure.subplots(len(played), 1, squeeze=False, sharex=True)[:, 0]
    for axes, one in zip(rows, played, strict=True):
        ending = one.endings[episode]
        commands = np.array(ending.commands.values)[:, :2]
        for number, (name, style) in enumerate((("x", "-"), ("y", "--"))):
            axes.step(range(len(commands)), commands[:, number], style, where="post", color=COLORS[one.way], label=name)
        for seam in ending.commands.seams:
            axes.axvline(seam, color=MUTED, linewidth=0.8, linestyle=":")
        axes.set_title(f"{one.way}, delay {one.delay}, initial state {episode}: {ending.status}", fontsize=9)
        axes.set_ylabel("command")
        axes.set_ylim(-1.3, 1.3)
        axes.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    saved = f"an episode that {played[-1].way} solved and {played[-2].way} under the same delay didn't"
    which = saved if solved[-1][episode] and not solved[-2][episode] else "one episode"
    rows[-1].set_xlabel(f"control step; dotted: a chunk takes over\n{which}")
    write_figure(path, figure, dpi=120)
    return path
