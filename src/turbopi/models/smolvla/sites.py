"""Where the places that may be rounded (quantization/sites.py) are in the reference."""

from collections.abc import Iterator
from itertools import islice

from torch import nn

from turbopi.models.pi0 import sites
from turbopi.models.smolvla.reference import SmolVLAModel
from turbopi.quantization.sites import Site


def linears(model: SmolVLAModel, site: Site) -> Iterator[nn.Linear]:
    """The reference's matrices of a site. Across, those of keys and values read another activation, which stays as it
    is.
    """
    config, found = model.config, sites.linears(model, site)
    across = site.group == "expert.qkv" and not config.is_self_layer(config.expert_at[site.layer])
    return islice(found, 1) if across else found
