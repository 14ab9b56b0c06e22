"""The matrices that the engine multiplies by, and the parameters that they are made of.

A place is a site's name (quantization/sites.py): "vision.3.fc1", "prefix.0.qkv". What shares an input is one matrix.
"""

from turbopi.config import ModelConfig
from turbopi.quantization.sites import Part

QKV, GATE_UP = ("q_proj", "k_proj", "v_proj"), ("gate_proj", "up_proj")  # what is joined, in this order
_SINGLE = {"fc1": "mlp.fc1", "fc2": "mlp.fc2", "down": "mlp.down_proj"}


def matrix_names(part: Part, layer: int, kind: str) -> tuple[str, ...]:
    """The parameters that a matrix of the engine is made of, in canonical names: one below the other."""
    stack = {"prefix": "vlm"}.get(part, part)
    if kind == "qkv":
        own = tuple(f"self_attn.{one}" for one in QKV)
    elif kind == "gate_up":
        own = tuple(f"mlp.{one}" for one in GATE_UP)
    elif kind == "out":
        own = ("self_attn.out_proj" if part == "vision" else "self_attn.o_proj",)
    else:
        own = (_SINGLE[kind],)
    return tuple(f"{stack}.layers.{layer}.{one}.weight" for one in own)


def is_used(config: ModelConfig, place: str) -> bool:
    """Whether a call reads this matrix: of the prefix's last layer nothing but keys and values is. 0.2 GB."""
    part, layer, kind = place.split(".")
    return part != "prefix" or kind == "qkv" or int(layer) + 1 < config.vlm.depth


def names_at(place: str) -> tuple[str, ...]:
    """`matrix_names` of a place such as "prefix.0.qkv"."""
    part, layer, kind = place.split(".")
    return matrix_names(part, int(layer), kind)  # type: ignore[arg-type]
