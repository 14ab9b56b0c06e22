"""Parameter names: Turbo-Pi's canonical ones and those of openpi's PyTorch files.

Canonical names (see `model/reference.py`) are openpi's with shorter prefixes. LeRobot's are openpi's behind `model.`.
"""

_PALIGEMMA = "paligemma_with_expert.paligemma."
_VISION = _PALIGEMMA + "model.vision_tower.vision_model."
_LANGUAGE = _PALIGEMMA + "model.language_model."

EMBEDDING = "vlm.embed_tokens.weight"
TIED_HEAD = _PALIGEMMA + "lm_head.weight"  # openpi stores the tied embedding once, under the head's name
TIED_EMBEDDING = _LANGUAGE + "embed_tokens.weight"
UNUSED_HEAD = "paligemma_with_expert.gemma_expert.lm_head.weight"  # in every file, read by nothing

_PREFIXES = (  # canonical, openpi; the first that fits
    (EMBEDDING, TIED_HEAD),
    ("vision.patch_embedding.", _VISION + "embeddings.patch_embedding."),
    ("vision.position_embedding.", _VISION + "embeddings.position_embedding."),
    ("vision.layers.", _VISION + "encoder.layers."),
    ("vision.post_layernorm.", _VISION + "post_layernorm."),
    ("projector.", _PALIGEMMA + "model.multi_modal_projector.linear."),
    ("vlm.", _LANGUAGE),
    ("expert.", "paligemma_with_expert.gemma_expert.model."),
)


def to_openpi(name: str) -> str:
    """The name of a canonical parameter in openpi's `model.safetensors`."""
    for ours, theirs in _PREFIXES:
        if name.startswith(ours):
            return theirs + name[len(ours) :]
    return name


def from_openpi(name: str) -> str:
    """The canonical name of a tensor in openpi's `model.safetensors`; unknown names come back unchanged.

    Newer `transformers` releases drop the level `vision_model`: both spellings are read.
    """
    short = _VISION.removesuffix("vision_model.")
    if name.startswith(short) and not name.startswith(_VISION):
        name = _VISION + name[len(short) :]
    for ours, theirs in _PREFIXES:
        if name.startswith(theirs):
            return ours + name[len(theirs) :]
    return name
