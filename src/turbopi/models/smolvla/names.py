"""Parameter names: LeRobot's files to canonical ones, and the dtype of each.

LeRobot's are `model.vlm_with_expert.…` and `model.…`; compiled models have `_orig_mod.` inside. Canonical names are
those of `SmolVLAModel`'s parameters.
"""

import re

import torch

from turbopi.config import FloatPrecision
from turbopi.models.smolvla.config import ElementTypes, SmolVLAConfig

_VLM = "vlm_with_expert.vlm.model."
_PREFIXES = (
    (f"{_VLM}vision_model.embeddings.", "vision."),
    (f"{_VLM}vision_model.encoder.layers.", "vision.layers."),
    (f"{_VLM}vision_model.post_layernorm.", "vision.post_layernorm."),
    (f"{_VLM}connector.modality_projection.proj.", "projector."),
    (f"{_VLM}text_model.embed_tokens.", "vlm.embed_tokens."),
    (f"{_VLM}text_model.layers.", "vlm.layers."),
    ("vlm_with_expert.lm_expert.layers.", "expert.layers."),
    ("vlm_with_expert.lm_expert.norm.", "expert.norm."),
    *((name, name) for name in ("state_proj.", "action_in_proj.", "action_out_proj.")),
    *((name, name) for name in ("action_time_mlp_in.", "action_time_mlp_out.")),
)
# never read: the head over words, the text model's final norm, and old files' statistics
_UNUSED = re.compile(r"vlm_with_expert\.vlm\.(lm_head|model\.text_model\.norm)\.|normalize_(inputs|outputs|targets)")
_VISION = ("vision.", "projector.")


def canonical_name(name: str, depth: int) -> str | None:
    """The canonical name of a file's; None: the network, of `depth` text layers, doesn't use it.

    One of no SmolVLA stays as it is.
    """
    plain = name.replace("_orig_mod.", "").removeprefix("model.")
    if _UNUSED.search(plain):
        return None
    for theirs, ours in _PREFIXES:
        if plain.startswith(theirs):
            canonical = ours + plain.removeprefix(theirs)
            layer = re.match(r"vlm\.layers\.(\d+)\.", canonical)
            return None if layer and int(layer[1]) >= depth else canonical
    return name


def native_name(name: str) -> str:
    """LeRobot's name of a canonical parameter, without "model."."""
    for theirs, ours in sorted(_PREFIXES, key=lambda one: -len(one[1])):
        if name.startswith(ours):
            return theirs + name.removeprefix(ours)
    return name


def parameter_dtype(name: str, precision: FloatPrecision, config: SmolVLAConfig) -> torch.dtype:
    """The dtype of a parameter (canonical name), whatever the file holds.

    f32: float32. bf16: the element types of the config, which LeRobot runs it in; all of it in bfloat16 where they are
    float32 alone. What is about actions, the state's projection and cross keys and values stay float32 in each.
    """
    if precision == "f32" or name.startswith(("state_proj.", "action_")):
        return torch.float32
    cross = re.match(r"expert\.layers\.(\d+)\.self_attn\.[kv]_proj\.", name)
    if cross and not config.is_self_layer(int(cross[1]) * config.expert_every):
        return torch.float32
    types = config.element_types
    if types == ElementTypes():
        return torch.bfloat16
    found: torch.dtype = getattr(torch, types.vision if name.startswith(_VISION) else types.text)
    return found
