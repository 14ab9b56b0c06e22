"""What rounding does to each site's own products, everything before them exact."""

from collections.abc import Iterable, Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbopi.calibrate.emulate import Round, RoundedWeights, replaced, round_activation
from turbopi.calibrate.sites import Site, linears
from turbopi.model.reference import Pi0Model
from turbopi.observation import Observation


def product_errors(
    model: Pi0Model,
    scales: Mapping[Site, float],
    batches: Iterable[tuple[Observation, Tensor]],
    steps: int,
    weights: RoundedWeights,
) -> dict[str, float]:
    """Site -> relative rms of its products (without bias) of rounded numbers, over all batches and steps."""
    sums: dict[str, Tensor] = {}  # of squares: of the difference, of the exact products
    changes: list[tuple[nn.Linear, Round, Round]] = []
    for site, scale in scales.items():
        for linear in linears(model, site):

            def watch(x: Tensor, site: Site = site, scale: float = scale, linear: nn.Linear = linear) -> Tensor:
                exact = F.linear(x, linear.weight)
                given = x if site.weights_only else round_activation(x, scale)
                difference = F.linear(given, weights(site, linear.weight)) - exact
                both = torch.stack((difference.square().sum(), exact.square().sum())).double()
                name = str(site)
                sums[name] = sums[name] + both if name in sums else both
                return x

            changes.append((linear, watch, lambda weight: weight))
    with replaced(changes):
        for observation, noise in batches:
            model.sample(observation, noise, steps)
    return {name: float((both[0] / both[1]).sqrt()) if both[1] > 0 else 0.0 for name, both in sums.items()}
