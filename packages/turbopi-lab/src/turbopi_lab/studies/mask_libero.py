"""A padded cache without its mask in a simulator: caches of `mask` on LIBERO, or on any other simulator."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from torch import Tensor

from turbopi.backends.pytorch import reference_model
from turbopi.evaluate.sources import PolicySource
from turbopi_lab.studies.answering import Requested
from turbopi_lab.studies.mask import CACHES, CLAIMED, cache_of
from turbopi_lab.studies.simulated import Given, Variant, Variants


@contextmanager
def _open(given: Given, name: str) -> Iterator[PolicySource]:
    policy = given.policy()
    model = reference_model(policy.backend)

    def answer(requested: Requested) -> Tensor:
        return model.denoise(cache_of(model, requested.observation, name), requested.noise, requested.steps)

    yield given.answered(policy, answer)


def _variant(name: str) -> Variant:
    return Variant(name, partial(_open, name=name))


STUDY = Variants(
    name="mask_libero",
    question="What happens to success on LIBERO if a padded cache isn't masked?",
    claimed=CLAIMED,
    cells=[_variant(name) for name in CACHES if name != "compacted"],
    few=["padded, not masked"],
    neutral=_variant("padded, masked"),
    exact=False,
    method=(
        "The action expert attends to all slots of a padded cache: those of the missing camera and of the prompt's "
        "padding, too, unless they are masked."
    ),
    would_change="Observations without padding and with all cameras: then the caches are one.",
    x_label="cell, in the table's order",
).study
