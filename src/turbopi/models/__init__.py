"""The models: a folder for each family, with its reference, and in `FAMILIES` what it gives besides.

`observation.py` is what all of them take.
"""

from collections.abc import Iterator
from typing import Any

import torch
from torch import nn

from turbopi.config import PRESETS, Kind, Network, PolicyConfig, memory_of
from turbopi.models.family import Family
from turbopi.models.pi0.family import PI0, PI05, PI05_STATE_MEMORY, PI05_VISUAL_MEMORY
from turbopi.models.pi0_fast.family import PI0_FAST
from turbopi.models.smolvla.family import BASE, SMOLVLA
from turbopi.quantization.sites import Site

FAMILIES: dict[Kind, Family] = {one.kind: one for one in (PI05, PI0, PI0_FAST, SMOLVLA)}

RANDOM: dict[str, PolicyConfig] = {**PRESETS, BASE.name: BASE}  # what random weights are made for, by name


def family_of(config: Network) -> Family:
    if (memory := memory_of(config)) is not None:
        return PI05_STATE_MEMORY if memory.proprioceptive else PI05_VISUAL_MEMORY
    return FAMILIES[config.kind]


def parameter_shapes(config: Network) -> dict[str, tuple[int, ...]]:
    """Canonical name -> shape of every parameter of a model."""
    with torch.device("meta"):
        model = family_of(config).reference(config)
    return {name: tuple(parameter.shape) for name, parameter in model.state_dict().items()}


def linears(model: Any, site: Site) -> Iterator[nn.Linear]:
    """A reference's matrices of a site (quantization/sites.py), of a family that has calibrations."""
    of = family_of(model.config).linears
    assert of is not None, f"{model.config.kind} has no sites"
    return of(model, site)
