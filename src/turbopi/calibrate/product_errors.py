"""What rounding does to each site's own products, everything before them exact."""

from collections.abc import Iterable, Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbopi.engine.emulate import MakeMatrix, Round, RoundedWeights, input_rounding, replaced, through_norm
from turbopi.models import linears
from turbopi.models.observation import Observation
from turbopi.models.pi0.layers import AdaRMSNorm
from turbopi.models.pi0.sites import norm_of
from turbopi.quantization.sites import Site


def product_errors(
    model: Any,
    scales: Mapping[Site, float],
    batches: Iterable[tuple[Observation, Tensor]],
    steps: int,
    weights: RoundedWeights,
) -> dict[str, float]:
    """Site -> relative rms of its products (without bias) of rounded numbers, over all batches and steps."""
    sums: dict[str, Tensor] = {}  # of squares: of the difference, of the exact products
    behind: dict[Site, Tensor] = {}  # what norms make of rounded activations
    changes: list[tuple[nn.Linear, Round, MakeMatrix]] = []
    handles = []
    for site, scale in scales.items():
        norm, rounding = norm_of(model, site), input_rounding(site, scale, weights.format)
        if norm is not None:

            def keep(
                norm: AdaRMSNorm, inputs: tuple[Tensor, Tensor], site: Site = site, rounding: Round = rounding
            ) -> None:
                behind[site] = through_norm(norm, rounding, *inputs)[0]

            handles.append(norm.register_forward_pre_hook(keep))
        for linear in linears(model, site):

            def watch(x: Tensor, site: Site = site, rounding: Round = rounding, linear: nn.Linear = linear) -> Tensor:
                exact = F.linear(x, linear.weight)
                given = behind[site] if site in behind else rounding(x)
                difference = F.linear(given, weights(site, linear.weight)) - exact
                both = torch.stack((difference.square().sum(), exact.square().sum())).double()
                name = str(site)
                sums[name] = sums[name] + both if name in sums else both
                return x

            changes.append((linear, watch, lambda weight: weight))
    try:
        with replaced(changes):
            for observation, noise in batches:
                model.sample(observation, noise, steps)
    finally:
        for handle in handles:
            handle.remove()
    return {name: float((both[0] / both[1]).sqrt()) if both[1] > 0 else 0.0 for name, both in sums.items()}
