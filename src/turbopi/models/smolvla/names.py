"""Parameter names: LeRobot's files to canonical ones, and the dtype of each.

LeRobot's are `model.vlm_with_expert.…` and `model.…`; compiled models have `_orig_mod.` inside. Canonical names are
those of `SmolVLAModel`'s parameters.
"""

import re

import torch

from turbopi.models.smolvla.config import SmolVLAConfig

_VLM = "vlm_with_expert.vlm.model."
_PREFIXES = (
    (f"{_VLM}vision_model.embeddings.", ""),
    (f"{_VLM}vision_model.encoder.layers.", "vision_layers."),
    (f"{_VLM}vision_model.post_layernorm.", "post_layernorm."),
    (f"{_VLM}connector.modality_projection.proj.", "connector."),
    (f"{_VLM}text_model.embed_tokens.", "embed_tokens."),
    (f"{_VLM}text_model.layers.", "layers."),
    ("vlm_with_expert.lm_expert.layers.", "expert_layers."),
    ("vlm_with_expert.lm_expert.norm.", "expert_norm."),
    *((name, name) for name in ("state_proj.", "action_in_proj.", "action_out_proj.")),
    *((name, name) for name in ("action_time_mlp_in.", "action_time_mlp_out.")),
)
# never read: the head over words, the text model's final norm, and old files' statistics
_UNUSED = re.compile(r"vlm_with_expert\.vlm\.(lm_head|model\.text_model\.norm)\.|normalize_(inputs|outputs|targets)")
_VISION = ("patch_embedding.", "position_embedding.", "vision_layers.", "post_layernorm.", "connector.")


def canonical_name(name: str, config: SmolVLAConfig) -> str | None:
    """The canonical name of a file's; None: the network doesn't use it. Raises KeyError for one of no SmolVLA."""
    plain = name.replace("_orig_mod.", "").removeprefix("model.")
    if _UNUSED.search(plain):
        return None
    for theirs, ours in _PREFIXES:
        if plain.startswith(theirs):
            canonical = ours + plain.removeprefix(theirs)
            layer = re.match(r"layers\.(\d+)\.", canonical)
            return None if layer and int(layer[1]) >= config.text.depth else canonical
    raise KeyError(name)


def parameter_dtype(name: str, config: SmolVLAConfig) -> torch.dtype:
    """The dtype of a parameter (canonical name): the config decides, whatever the file holds."""
    if name.startswith(("state_proj.", "action_")):
        return torch.float32
    cross = re.match(r"expert_layers\.(\d+)\.self_attn\.[kv]_proj\.", name)
    if cross and not config.is_self_layer(int(cross[1]) * config.expert_every):
        return torch.float32
    types = config.element_types
    found: torch.dtype = getattr(torch, types.vision if name.startswith(_VISION) else types.text)
    return found
