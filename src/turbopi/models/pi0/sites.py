"""Where the places that may be rounded (quantization/sites.py) are in the reference."""

from collections.abc import Callable, Iterator
from typing import Any

from torch import nn

from turbopi.models.pi0.layers import AdaRMSNorm
from turbopi.quantization.sites import Part, Site


def linears(model: Any, site: Site) -> Iterator[nn.Linear]:
    """The matrices of a site, of Pi0's reference or one whose modules are called alike."""
    stacks: dict[Part, Any] = {"vision": model.vision, "prefix": model.vlm, "expert": model.expert}
    stack = stacks[site.part]
    layer = stack.layers[site.layer]
    attention, mlp = layer.self_attn, layer.mlp
    modules: dict[str, Callable[[], tuple[nn.Linear, ...]]] = {
        "qkv": lambda: (attention.q_proj, attention.k_proj, attention.v_proj),
        "out": lambda: (attention.out_proj if site.part == "vision" else attention.o_proj,),
        "gate_up": lambda: (mlp.gate_proj, mlp.up_proj),
        "down": lambda: (mlp.down_proj,),
        "fc1": lambda: (mlp.fc1,),
        "fc2": lambda: (mlp.fc2,),
    }
    found = modules[site.kind]()
    yield from found[1:] if site.last else found  # nothing asks for the last layer's queries


def norm_of(model: Any, site: Site) -> AdaRMSNorm | None:
    """The adaRMS norm inside which a site's activation is, or None: then it is what the matrices read."""
    if site.part != "expert" or site.kind not in ("qkv", "gate_up"):
        return None
    layer = model.expert.layers[site.layer]
    norm = layer.input_layernorm if site.kind == "qkv" else layer.post_attention_layernorm
    return norm if isinstance(norm, AdaRMSNorm) else None
