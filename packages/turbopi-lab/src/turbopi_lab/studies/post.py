"""The task of studies that need several ways of doing the same: past a post, to a target that stands still behind it.

The world is the chase's (sim/chase.py), with a target that doesn't run. It begins on the other side of the post, so
that both ways around take about as long: an expert that draws one for each episode has two modes, and one that always
takes the same has one. `python -m turbopi_lab.small_policy post` trains a policy on either.
"""

from collections.abc import Sequence

import numpy as np

from turbopi.sim.chase import Chase, polar

SPREAD = 0.5  # radians: how far from opposite the target may be, both sides together
INSTRUCTION = "pass the post"
Ways = tuple[int, ...]  # sides of the post that demonstrations take: (1,) or (1, -1); 1 is counterclockwise
ONE_WAY: Ways = (1,)
TWO_WAYS: Ways = (1, -1)


def start(seeds: Sequence[Sequence[int]]) -> Chase:
    """An episode for each seed. The target stands still: nothing in such an episode is random after its start."""
    generators = [np.random.default_rng(list(seed)) for seed in seeds]
    drawn = np.array([generator.uniform(0, 1, 4) for generator in generators])
    side = 2 * np.pi * drawn[:, 0]
    tip = polar(side, 0.55 + 0.3 * drawn[:, 1])
    angle, orbit = side + np.pi + (drawn[:, 2] - 0.5) * SPREAD, 0.5 + 0.25 * drawn[:, 3]
    before = np.repeat(polar(angle, orbit)[:, None], 3, axis=1)
    still = np.zeros(len(generators))
    return Chase(tip, angle, orbit, still, before, np.ones((len(generators), 1))).cleared()
