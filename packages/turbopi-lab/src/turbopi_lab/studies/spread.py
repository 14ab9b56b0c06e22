"""How broad a policy's actions are where the post is in the way: one way past it, or two?"""

from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from turbopi_lab.studies.report import Cell, Grid, Panel, Plot, Series
from turbopi_lab.studies.rollouts import REPLAN, ToyPolicy, seeds_of

UNIFORM = 5 / 9  # Sarle's coefficient of a uniform distribution; a normal one has 1/3, two equal points have 1
STEPS = 10
SIDES = np.linspace(-5, 5, 41)


class Spread(Struct, frozen=True):
    """Of many chunks for each observation at the beginning of an episode.

    Sideways is how far a chunk's first actions lead to the left of the straight way to the target.

    bimodality   mean over observations of Sarle's coefficient of sideways
    minority     mean over observations of the share of chunks that go to the rarer side
    density      of sideways, over all chunks, between SIDES
    """

    policy: str
    observations: int
    samples: int
    bimodality: float
    minority: float
    density: list[float]


def spread(policy: ToyPolicy, episodes: Sequence[int], samples: int, steps: int = STEPS) -> Spread:
    world = policy.toy.start(seeds_of(episodes))
    seen = policy.observe(world)
    cache = policy.model.prefix(seen)
    line = world.target - world.tip
    left = np.stack((-line[:, 1], line[:, 0]), axis=1) / np.linalg.norm(line, axis=1, keepdims=True)
    found = []
    for sample in range(samples):
        noise = policy.noise(episodes, 1_000_000 + sample)
        chunks = policy.model.denoise(cache, noise, steps)
        moved = chunks[:, :REPLAN, :2].double().numpy().sum(1)
        found.append((moved * left).sum(1))
    sideways = np.stack(found, axis=1)  # [N, M]
    share = (sideways > 0).mean(1)
    return Spread(
        policy.name,
        len(episodes),
        samples,
        float(np.mean([bimodality(row) for row in sideways])),
        float(np.minimum(share, 1 - share).mean()),
        np.histogram(sideways, SIDES, density=True)[0].tolist(),
    )


def spread_table(title: str, whose: str, spreads: Sequence[Spread]) -> Grid:
    """whose: what their names are, the head of the first column."""
    rows: list[list[Cell]] = [
        [one.policy, one.observations, one.samples, one.bimodality, one.minority] for one in spreads
    ]
    columns = [whose, "observations", "chunks each", "Sarle's coefficient", "share of the rarer side"]
    return Grid(title, columns, rows)


def spread_plot(name: str, spreads: Sequence[Spread]) -> Plot:
    middles = ((SIDES[1:] + SIDES[:-1]) / 2).tolist()
    title = "Where five actions lead at an episode's start"
    series = [Series(one.policy, middles, one.density) for one in spreads]
    return Plot(name, [Panel(title, "to the left of the straight way", "density", series)])


def bimodality(values: np.ndarray) -> float:
    """Sarle's coefficient (skewness² + 1) / kurtosis, with the corrections for few values, of float[M], M > 3."""
    count = len(values)
    centred = values - values.mean()
    deviation = np.sqrt((centred**2).mean())
    skewness = (centred**3).mean() / deviation**3 * np.sqrt(count * (count - 1)) / (count - 2)
    excess = (centred**4).mean() / deviation**4 - 3
    excess = (count - 1) / ((count - 2) * (count - 3)) * ((count + 1) * excess + 6)
    return float((skewness**2 + 1) / (excess + 3 * (count - 1) ** 2 / ((count - 2) * (count - 3))))
