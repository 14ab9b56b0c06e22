"""Numbers of eight and four bits in a simulator: formats of `fp8_and_fp4` on LIBERO, or any other simulator."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import torch

from turbopi.backends.pytorch import reference_model
from turbopi.calibrate.observations import Batch
from turbopi.evaluate.sources import PolicySource
from turbopi.models.observation import Observation
from turbopi.policy import shipped
from turbopi.policy.policy import UnifiedPolicy
from turbopi.quantization.sites import sites
from turbopi_lab.studies.fp8_and_fp4 import CLAIMED, WRONG, cases, in_four_bits
from turbopi_lab.studies.simulated import STEPS, Given, Variant, Variants

FORMATS = ("FP8", "NVFP4", "NVFP4, weights alone", "W4A8", "W4A8 (MXFP4)", WRONG)
NOISES = 2  # of each image that activations' scales come from


@contextmanager
def _open(given: Given, name: str) -> Iterator[PolicySource]:
    policy = given.policy()
    seen = _images(policy, few=given.small)
    with cases(reference_model(policy.backend), [seen], [seen], STEPS)[name]():
        yield given.source(policy)


@contextmanager
def _open_exact(given: Given) -> Iterator[PolicySource]:
    """Every product goes through the emulation, with its numbers as they are."""
    policy = given.policy()
    model = reference_model(policy.backend)
    scales = dict.fromkeys(sites(model.config), 1.0)
    with in_four_bits(model, scales, activations="exact", weights=lambda weight, _: weight):
        yield given.source(policy)


def _images(policy: UnifiedPolicy, few: bool) -> Batch:
    """LIBERO images that come with Turbo-Pi, all with the first one's prompt, as calibration needs it of a batch."""
    given = shipped.observations(policy, shipped.load_frames()[: 1 if few else None])
    inputs = [policy.prepare(one | {"prompt": given[0]["prompt"]}) for one in given for _ in range(NOISES)]
    model, device = policy.config.model, policy.backend.device
    shape = (len(inputs), model.action_horizon, model.action_dim)
    noise = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    return Observation.stack(inputs).to(device), noise.to(device)


STUDY = Variants(
    name="fp8_and_fp4_libero",
    question="What do numbers of eight and four bits do to success on LIBERO?",
    claimed=CLAIMED,
    cells=[Variant(name, partial(_open, name=name)) for name in FORMATS],
    few=["FP8", WRONG],
    neutral=Variant("emulated, exact", _open_exact),
    exact=True,
    broken=WRONG,
    method=(
        "Every product of vision, prefix and expert whose sizes allow it, with operands rounded exactly as the format "
        "holds them, float32 between; activations' scales for FP8 from LIBERO images that come with Turbo-Pi."
    ),
    would_change="Trained weights of full size, whose outliers are larger; a kernel, which sums in another order.",
    x_label="cell, in the table's order",
).study
