"""SmolVLA's sizes and choices, from LeRobot's config.json and the vision-language model's own config.

config.json holds no sizes: LeRobot reads them from the config of `vlm_model_name` in the Hub's cache. Tensor shapes
give all of them but the numbers of heads, the norms' eps and the scale factor.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from turbopi.config import GemmaConfig, Kind, TimeRounding, VisionConfig

ElementType = Literal["float32", "bfloat16"]

ROPE_BASE = 10_000.0  # LeRobot's own function; the text model's rope_theta (100,000) isn't used


SIGLIP = VisionConfig(width=768, depth=12, mlp_dim=3072, num_heads=12, patch_size=16, image_size=512)


@dataclass(frozen=True)
class TextConfig:
    """SmolLM2's layers. depth: of them, those that SmolVLA uses; all of them stay in some files."""

    width: int = 960
    mlp_dim: int = 2560
    num_heads: int = 15
    num_kv_heads: int = 5
    head_dim: int = 64
    rms_norm_eps: float = 1e-5
    vocab_size: int = 49_280
    depth: int = 16


@dataclass(frozen=True)
class ElementTypes:
    """What the config, not the file, says of parameters. state_proj, action_* and cross keys and values: float32."""

    vision: ElementType = "float32"  # and the connector
    text: ElementType = "float32"  # and the expert


@dataclass(frozen=True)
class SmolVLAConfig:
    """One network.

    expert_depth      layers of the action expert; it has one beside every `depth / expert_depth`-th text layer
    image_size        of an image's side, in pixels; the position table may be for another one
    self_every        every so many-th layer's expert attends to prefix and suffix, the others across to the prefix
                      alone; 0: all across. None: attention_mode isn't "cross_attn", all attend to both
    image_start, end  ids of tokens around each image, with `add_image_special_tokens`
    empty_cameras     images that are always masked, beside the tokens around them, which aren't; 0 without such tokens
    min_prefix        places of a shorter prefix are filled up with masked zeros (prefix_length)
    """

    vision: VisionConfig = SIGLIP
    text: TextConfig = TextConfig()
    expert_width: int = 720
    expert_mlp: int = 2048
    expert_depth: int = 16
    self_every: int | None = 2
    scale_factor: int = 4
    image_size: int = 512
    max_prompt_tokens: int = 48
    action_horizon: int = 50
    action_dim: int = 32
    state_dim: int = 32
    min_period: float = 0.004
    max_period: float = 4.0
    image_start: tuple[int, ...] = ()
    image_end: tuple[int, ...] = ()
    empty_cameras: int = 0
    min_prefix: int = -1
    element_types: ElementTypes = ElementTypes()

    kind: ClassVar[Kind] = "smolvla"
    time_grid: ClassVar[TimeRounding] = "multiplied"
    expert_inputs: ClassVar[bool] = False

    @property
    def vlm(self) -> GemmaConfig:
        """The text layers' sizes, and `expert` the expert's, as the engine and `quantization.sites` read them."""
        return self._stack(self.text.width, self.text.mlp_dim, self.text.depth)

    @property
    def expert(self) -> GemmaConfig:
        return self._stack(self.expert_width, self.expert_mlp, self.expert_depth)

    def _stack(self, width: int, mlp_dim: int, depth: int) -> GemmaConfig:
        return GemmaConfig(width, mlp_dim, depth, self.text.num_heads, self.text.num_kv_heads, self.text.head_dim)

    @property
    def last_read(self) -> int:
        return self.expert_at[-1]

    @property
    def vocab_size(self) -> int:
        return self.text.vocab_size

    @property
    def expert_every(self) -> int:
        return self.text.depth // self.expert_depth

    @property
    def expert_at(self) -> range:
        """The text layers that have a layer of the expert beside them."""
        return range(0, self.text.depth, self.expert_every)

    def is_self_layer(self, layer: int) -> bool:
        """Whether the expert at this text layer attends to its own suffix, too."""
        return self.self_every is None or (self.self_every > 0 and layer % self.self_every == 0)


def expert_mlp_dim(width: int) -> int:
    """SmolLM2's rule: two thirds of four widths, up to a multiple of 256."""
    return 256 * ((int(2 * width * 4 / 3) + 255) // 256)


# of its config.json, for checkpoints on machines without it; the sizes are those of the classes above
PUBLISHED: Mapping[str, Mapping[str, Any]] = {
    "HuggingFaceTB/SmolVLM2-500M-Video-Instruct": {
        "scale_factor": 4,
        "text_config": {
            "hidden_size": 960,
            "intermediate_size": 2560,
            "num_attention_heads": 15,
            "num_key_value_heads": 5,
            "head_dim": 64,
            "rms_norm_eps": 1e-5,
            "vocab_size": 49_280,
            "torch_dtype": "bfloat16",
        },
        "vision_config": {
            "hidden_size": 768,
            "intermediate_size": 3072,
            "num_hidden_layers": 12,
            "num_attention_heads": 12,
            "image_size": 512,
            "patch_size": 16,
        },
    }
}


def from_lerobot(config: Mapping[str, Any], vlm: Mapping[str, Any]) -> SmolVLAConfig:
    """The network of LeRobot's config.json and of the vision-language model's config.json, both checked by the caller.

    Keys that are absent have LeRobot's defaults. Element types: with `load_vlm_weights` all of the VLM is bfloat16,
    else the text layers and the expert have the text config's type, and vision and connector float32.
    """
    text, vision = vlm["text_config"], vlm["vision_config"]
    depth = config.get("num_vlm_layers", 16)
    expert_depth = config.get("num_expert_layers", -1)
    width = int(text["hidden_size"] * config.get("expert_width_multiplier", 0.75))
    cross = "cross" in config.get("attention_mode", "cross_attn")
    special = bool(config.get("add_image_special_tokens", False))
    loaded = bool(config.get("load_vlm_weights", False))
    stored: ElementType = "bfloat16" if _dtype(text, vlm) == "bfloat16" else "float32"
    return SmolVLAConfig(
        vision=VisionConfig(
            width=vision["hidden_size"],
            depth=vision["num_hidden_layers"],
            mlp_dim=vision["intermediate_size"],
            num_heads=vision["num_attention_heads"],
            patch_size=vision["patch_size"],
            image_size=vision["image_size"],
            layer_norm_eps=vision.get("layer_norm_eps", 1e-6),
        ),
        text=TextConfig(
            width=text["hidden_size"],
            mlp_dim=text["intermediate_size"],
            num_heads=text["num_attention_heads"],
            num_kv_heads=text["num_key_value_heads"],
            head_dim=text.get("head_dim") or text["hidden_size"] // text["num_attention_heads"],
            rms_norm_eps=text.get("rms_norm_eps", 1e-5),
            vocab_size=text["vocab_size"],
            depth=depth,
        ),
        expert_width=width,
        expert_mlp=expert_mlp_dim(width),
        expert_depth=expert_depth if expert_depth > 0 else depth,
        self_every=max(config.get("self_attn_every_n_layers", 2), 0) if cross else None,
        scale_factor=vlm.get("scale_factor", 4),
        image_size=(config.get("resize_imgs_with_padding", [512, 512]) or [vision["image_size"]])[0],
        max_prompt_tokens=config.get("tokenizer_max_length", 48),
        action_horizon=config.get("chunk_size", 50),
        action_dim=config.get("max_action_dim", 32),
        state_dim=config.get("max_state_dim", 32),
        min_period=config.get("min_period", 0.004),
        max_period=config.get("max_period", 4.0),
        min_prefix=config.get("prefix_length", -1),
        image_start=tuple(vlm.get("image_start_token_ids", (49_189, 49_152))) if special else (),
        image_end=tuple(vlm.get("image_end_token_ids", (49_189,))) if special else (),
        empty_cameras=config.get("empty_cameras", 0) if special else 0,
        element_types=ElementTypes("bfloat16", "bfloat16") if loaded else ElementTypes("float32", stored),
    )


def _dtype(text: Mapping[str, Any], vlm: Mapping[str, Any]) -> str | None:
    for config in (text, vlm):
        for key in ("dtype", "torch_dtype"):
            if config.get(key) is not None:
                return str(config[key])
    return None
