"""A model's kind and sizes, read from the shapes of its parameters."""

from collections.abc import Mapping
from dataclasses import replace
from math import isqrt
from typing import Any, get_args

from turbopi.checkpoint.names import HEAD
from turbopi.checkpoint.source import Shape, WeightSource, listing
from turbopi.config import LIMITS, GemmaConfig, Kind, ModelConfig, Pi0FastConfig, PiKind, VisionConfig
from turbopi.models import FAMILIES
from turbopi.support.errors import CheckpointError, ConfigError
from turbopi.support.reading import shown

VARIANTS = {  # openpi's names of sizes
    "gemma_2b": GemmaConfig(width=2048, mlp_dim=16384),
    "gemma_300m": GemmaConfig(width=1024, mlp_dim=4096),
    "dummy": GemmaConfig(width=64, mlp_dim=128, depth=4, head_dim=16),
}
_STANDARD_VISION = VisionConfig()  # So400m: 1152 wide, 16 heads

# What sizes are read from. A checkpoint without one of these gets a message about it rather than about sizes.
_PROBES = (
    "vision.patch_embedding.weight",
    "vision.position_embedding.weight",
    "vision.layers.0.mlp.fc1.weight",
    "vlm.embed_tokens.weight",
    "vlm.layers.0.self_attn.q_proj.weight",
    "vlm.layers.0.self_attn.k_proj.weight",
    "vlm.layers.0.mlp.gate_proj.weight",
    "expert.layers.0.self_attn.q_proj.weight",
    "expert.layers.0.self_attn.k_proj.weight",
    "expert.layers.0.mlp.gate_proj.weight",
    "action_in_proj.weight",
)
_OF_EXPERT = ("expert.", "action_")


def detect_kind(source: WeightSource, where: object) -> Kind:
    """Pi0.5, Pi0 or Pi0-FAST, by the marks of its weights. CheckpointError if it is none of them, or Pi0.5 and Pi0."""
    names = source.shapes
    families = {kind: FAMILIES[kind] for kind in get_args(PiKind)}
    marked = {kind: [name for name in names if name.startswith(one.marks)] for kind, one in families.items()}
    fitting: list[PiKind] = [kind for kind, ours in marked.items() if ours]
    has_actions = any(name.startswith(("action_in_proj.", "expert.")) for name in names)
    if not has_actions and any(name.startswith("vlm.") for name in names):
        if source.format == "openpi_torch":
            raise CheckpointError(
                f"{where} has a language model but no action expert: this looks like LeRobot's Pi0-FAST, but no "
                "config.json beside it says so: copy LeRobot's config.json and its processors' files there, too"
            )
        return "pi0_fast"
    for other in (one for kind, one in FAMILIES.items() if kind not in families):
        if any(name.startswith(other.marks) for name in names):
            raise CheckpointError(
                f"{where} holds weights of {other.label}, but no config.json beside them says so: copy LeRobot's "
                "config.json and its processors' files there, too"
            )
    if len(fitting) != 1:
        found = f"tensors of both ({', '.join(marked[kind][0] for kind in fitting)})"
        if not fitting:
            found = f"neither {' nor '.join(f'{one.marks[0]} ({one.label})' for one in families.values())}"
            first = {name.split(".")[0].split("/")[0]: source.native_name(name) for name in sorted(names, reverse=True)}
            found += f". Of its {len(names)} tensors the first of each module: {listing(sorted(first.values()))}"
        raise CheckpointError(
            f"{where} is neither {' nor '.join(one.label for one in families.values())}: it has {found}"
        )
    return fitting[0]


def model_sizes(
    source: WeightSource,
    base: ModelConfig | Pi0FastConfig,
    *,
    vision_heads: int | None,
    where: object,
) -> ModelConfig | Pi0FastConfig:
    """`base` with its kind and every size replaced by what the parameters' shapes say.

    Of `base` stay the horizon, the prompt length, the time grid and the constants. Vision heads, which the PyTorch
    layout doesn't store: the JAX layout's; else `vision_heads`; else 16 at width 1152; else those of `base` if its
    vision tower has the checkpoint's width; else ConfigError.

    Raises CheckpointError if a parameter that sizes are read from is missing or impossible.
    """
    shapes, has_expert = source.shapes, isinstance(base, ModelConfig)
    probes = [name for name in _PROBES if has_expert or not name.startswith(_OF_EXPERT)]
    absent = [source.native_name(name) for name in probes if name not in shapes]
    if absent:
        raise CheckpointError(f"{where}: tensors are missing: {listing(absent)}")
    try:
        vision = _vision_sizes(shapes, base.vision)
        depth = max(_depth(shapes, "vlm.layers."), _depth(shapes, "expert.layers."))  # check_tensors: absent layers
        found: dict[str, Any] = {"vlm": _gemma_sizes(shapes, "vlm", depth)}
        found["vocab_size"] = shapes["vlm.embed_tokens.weight"][0]
        if has_expert:
            found |= {
                "expert": _gemma_sizes(shapes, "expert", depth),
                "action_dim": shapes["action_in_proj.weight"][1],
                "kind": detect_kind(source, where),
            }
        else:
            found["tied_head"] = HEAD not in shapes
    except (IndexError, ZeroDivisionError, ValueError) as error:
        raise CheckpointError(f"{where}: tensors have impossible shapes ({error})") from error
    vision = replace(vision, num_heads=_vision_heads(source, vision.width, base.vision, vision_heads, where))
    try:
        return replace(base, vision=vision, **found)
    except ConfigError as error:
        raise CheckpointError(f"{where}: {error}") from error


def _vision_sizes(shapes: Mapping[str, Shape], base: VisionConfig) -> VisionConfig:
    width, _, patch, _ = shapes["vision.patch_embedding.weight"]
    tokens = shapes["vision.position_embedding.weight"][0]
    side = isqrt(tokens)
    if side * side != tokens:
        raise ValueError(f"{tokens} vision positions aren't a square grid of patches")
    return replace(
        base,
        width=width,
        depth=_depth(shapes, "vision.layers."),
        mlp_dim=shapes["vision.layers.0.mlp.fc1.weight"][0],
        num_heads=1,
        patch_size=patch,
        image_size=side * patch,
    )


def _gemma_sizes(shapes: Mapping[str, Shape], stack: str, depth: int) -> GemmaConfig:
    mlp_dim, width = shapes[f"{stack}.layers.0.mlp.gate_proj.weight"]
    head_dim = shapes[f"{stack}.layers.0.self_attn.k_proj.weight"][0]  # one KV head in every Pi0 and Pi0.5
    heads = shapes[f"{stack}.layers.0.self_attn.q_proj.weight"][0] // head_dim
    return GemmaConfig(width=width, mlp_dim=mlp_dim, depth=depth, num_heads=heads, num_kv_heads=1, head_dim=head_dim)


def _depth(shapes: Mapping[str, Shape], prefix: str) -> int:
    """1 + the last layer's number. ValueError for numbers that no model has: what a name says costs no memory."""
    last = -1
    for name in shapes:
        index = name[len(prefix) :].split(".", 1)[0] if name.startswith(prefix) else ""
        if index.isdecimal():
            if len(index) > 6 or int(index) >= LIMITS["depth"]:
                raise ValueError(f"{shown(name)} is of layer {index[:40]}; at most {LIMITS['depth']} layers are read")
            last = max(last, int(index))
    return 1 + last


def _vision_heads(source: WeightSource, width: int, base: VisionConfig, explicit: int | None, where: object) -> int:
    if source.vision_heads is not None:
        if explicit not in (None, source.vision_heads):
            raise ConfigError(f"vision_heads is {explicit}, but {where} stores {source.vision_heads} attention heads")
        return source.vision_heads
    if explicit is not None:
        if width % explicit:
            raise ConfigError(f"vision_heads is {explicit}, but the vision tower of {where} is {width} wide")
        return explicit
    for known in (_STANDARD_VISION, base):
        if width == known.width:
            return known.num_heads
    raise ConfigError(
        f"the vision tower of {where} is {width} wide, and no tensor tells its number of attention heads (16 at the "
        f"standard width {_STANDARD_VISION.width}). Give it in turbopi.json beside the weights, or in the .json that "
        'config= names: {"preset": ..., "vision_heads": ...}'
    )
