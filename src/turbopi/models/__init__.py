"""The models: a folder for each family, with its reference, and in `FAMILIES` what it gives besides.

`observation.py` is what all of them take.
"""

from turbopi.config import Kind, ModelConfig
from turbopi.models.family import Family
from turbopi.models.pi0.family import PI0, PI05

FAMILIES: dict[Kind, Family] = {one.kind: one for one in (PI05, PI0)}


def family_of(config: ModelConfig) -> Family:
    return FAMILIES[config.kind]
