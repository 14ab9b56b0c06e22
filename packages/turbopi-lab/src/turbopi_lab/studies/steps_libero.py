"""Fewer denoising steps in a simulator: solvers of `steps` on LIBERO, or on any other simulator of `turbopi eval`."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from turbopi.evaluate.sources import PolicySource
from turbopi_lab.studies.simulated import PLAIN, Given, Variant, Variants, open_plain
from turbopi_lab.studies.solvers import BASELINE, Way, grid_times

WAYS = (
    *(Way("euler", "uniform", 1), Way("euler", "uniform", 2), Way("euler", "uniform", 3)),
    *(Way("ab2", "uniform", 2), Way("exponential", "uniform", 2), Way("exponential", "uniform", 3)),
)


@contextmanager
def _open(given: Given, way: Way) -> Iterator[PolicySource]:
    times = (*grid_times(way, {}), 0.0)
    yield given.source(given.policy(num_denoising_steps=way.evaluations, solver=way.solver, time_grid=times))


def _variant(way: Way) -> Variant:
    return Variant(str(way), partial(_open, way=way), way.solver, way.evaluations)


STUDY = Variants(
    name="steps_libero",
    question="How few denoising steps are enough on LIBERO?",
    claimed=(
        "10 → 3 steps cost less than 1 % of mean squared error; success on nine episodes a suite is unchanged at 1 "
        "step."
    ),
    cells=[_variant(way) for way in WAYS],
    few=["exponential, uniform, 2"],
    plain=Variant(PLAIN, open_plain, BASELINE.solver, BASELINE.evaluations),
    neutral=_variant(BASELINE),  # ten Euler steps by their times
    exact=False,  # the plain policy adds its times up in float32, as openpi
    method="Each solver on a uniform grid.",
    would_change="Demonstrations with several ways of doing it: this policy imitates one deterministic expert.",
    x_label="evaluations of the action expert",
    ticks=[1, 2, 3, 10],
).study
