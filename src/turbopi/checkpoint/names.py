"""Parameter names: Turbo-Pi's canonical ones and those of openpi's PyTorch files.

Canonical names (see `models/pi0/reference.py`) are openpi's with shorter prefixes. LeRobot's are openpi's behind
`model.`, other programs' behind what they wrap a model in (`module.`, `_orig_mod.`).
"""

from collections.abc import Collection
from typing import Protocol

_PALIGEMMA = "paligemma_with_expert.paligemma."
_VISION = _PALIGEMMA + "model.vision_tower.vision_model."
_LANGUAGE = _PALIGEMMA + "model.language_model."
_EXPERT = "paligemma_with_expert.gemma_expert.model."

EMBEDDING, HEAD = "vlm.embed_tokens.weight", "lm_head.weight"
TIED_HEAD = _PALIGEMMA + "lm_head.weight"  # openpi stores the tied embedding once, under the head's name
TIED_EMBEDDING = _LANGUAGE + "embed_tokens.weight"
_OF_TRAINING = ("value_head.", "noise_head.")  # RLinf's critic and exploration: what it deploys reads neither
UNUSED_HEAD = "paligemma_with_expert.gemma_expert.lm_head.weight"  # in every file, read by nothing

_PREFIXES = (  # canonical, openpi; the first that fits
    (EMBEDDING, TIED_HEAD),
    ("vision.patch_embedding.", _VISION + "embeddings.patch_embedding."),
    ("vision.position_embedding.", _VISION + "embeddings.position_embedding."),
    ("vision.layers.", _VISION + "encoder.layers."),
    ("vision.post_layernorm.", _VISION + "post_layernorm."),
    ("projector.", _PALIGEMMA + "model.multi_modal_projector.linear."),
    ("vlm.", _LANGUAGE),
    ("expert.", _EXPERT),
)


_BEFORE_4_52 = (  # of Transformers, below paligemma.: its names until then, openpi's
    ("vision_tower.", "model.vision_tower."),
    ("multi_modal_projector.", "model.multi_modal_projector."),
    ("language_model.model.", "model.language_model."),
    ("language_model.lm_head.", "lm_head."),
)
_LANDMARK = "action_in_proj.weight"  # in every Pi0 and Pi0.5, below no other module


def common_prefix(keys: Collection[str]) -> str:
    """What a wrapper put before openpi's names, such as "module._orig_mod."; "" unless it is before every one."""
    found = {key.removesuffix(_LANDMARK) for key in keys if f".{key}".endswith(f".{_LANDMARK}")}
    prefix = found.pop() if len(found) == 1 else ""
    return prefix if all(key.startswith(prefix) for key in keys) else ""


def current_name(name: str) -> str:
    """The name that openpi has for a tensor which Transformers named otherwise before 4.52."""
    below = name.removeprefix(_PALIGEMMA)
    for old, new in _BEFORE_4_52 if below != name else ():
        if below.startswith(old):
            return _PALIGEMMA + new + below[len(old) :]
    return name


def to_openpi(name: str) -> str:
    """The name of a canonical parameter in openpi's `model.safetensors`."""
    for ours, theirs in _PREFIXES:
        if name.startswith(ours):
            return theirs + name[len(ours) :]
    return name


def from_openpi(name: str) -> str:
    """The canonical name of a tensor in openpi's `model.safetensors`; unknown names come back unchanged.

    Newer `transformers` releases drop the level `vision_model`, older ones have others: all spellings are read.
    """
    name = current_name(name)
    short = _VISION.removesuffix("vision_model.")
    if name.startswith(short) and not name.startswith(_VISION):
        name = _VISION + name[len(short) :]
    for ours, theirs in _PREFIXES:
        if name.startswith(theirs):
            return ours + name[len(theirs) :]
    return name


class Names(Protocol):
    """How a layout names a family's parameters."""

    def canonical(self, key: str) -> str | None:
        """Turbo-Pi's name of a file's key without its common prefix; None for what no action is computed from."""

    def native(self, name: str) -> str:
        """The other way round."""


class PiNames:
    """Pi0's and Pi0.5's, openpi's and LeRobot's.

    trains_head  LeRobot trains lm_head beside the embedding
    head         its canonical name, where it is a parameter of the model
    """

    trains_head: bool = False
    head: str | None = None

    def current(self, key: str) -> str:
        """The name that openpi has for it; one that isn't a part of its model comes back unchanged."""
        return current_name(key)

    def canonical(self, key: str) -> str | None:
        key = self.current(key)
        return None if key == UNUSED_HEAD or key.startswith(_OF_TRAINING) else from_openpi(key)

    def native(self, name: str) -> str:
        return to_openpi(name)


class TextNames(PiNames):
    """LeRobot's pi052."""

    trains_head = True


class FastNames(PiNames):
    """LeRobot's Pi0-FAST: embed_tokens embeds, lm_head writes. A file with one of the two means both by it.

    apart  two equal ones are two parameters, too: an adapter may change one alone
    """

    head = HEAD

    def __init__(self, *, apart: bool = False) -> None:
        self.apart = apart


class RenamedNames(PiNames):
    """Another program's, of the same tensors.

    renamed  (a beginning of its names, openpi's); the first that fits
    unused   beginnings, in openpi's names, of what it stores and computes no action from
    """

    program: str
    renamed: tuple[tuple[str, str], ...]
    unused: tuple[str, ...] = ()

    def current(self, key: str) -> str:
        for theirs, openpis in self.renamed:
            if key.startswith(theirs):
                return openpis + key.removeprefix(theirs)
        return key

    def canonical(self, key: str) -> str | None:
        return None if self.current(key).startswith(self.unused) else super().canonical(key)

    def native(self, name: str) -> str:
        name = super().native(name)
        for theirs, openpis in self.renamed:
            if name.startswith(openpis):
                return theirs + name.removeprefix(openpis)
        return name


class DexboticNames(RenamedNames):
    """Behind `model.`; source: Dexmal/dexbotic 0.2, dexbotic.model.{pi0,pi05}."""

    program = "Dexbotic"
    renamed = (
        ("llm.embed_tokens.", TIED_HEAD.removesuffix("weight")),
        ("llm.", _LANGUAGE),
        ("action_expert.", _EXPERT),
        ("mm_vision_tower.vision_tower.vision_model.", _VISION),
        ("mm_projector.", _PALIGEMMA + "model.multi_modal_projector.linear."),
    )
    unused = (HEAD, _VISION + "head.", _EXPERT + "embed_tokens.")


class StarVLANames(RenamedNames):
    """Of its frameworks PI0 and PI05; source: starVLA/starVLA 0ed0aad2, starVLA.model.framework.VLM4A."""

    program = "StarVLA"
    renamed = (
        ("vlm.model.", _PALIGEMMA),
        ("action_head.gemma_expert.", "paligemma_with_expert.gemma_expert."),
        ("action_head.", ""),
    )
