"""The config.json of SmolVLA's vision-language model: what it leaves out, and what in it Turbo-Pi doesn't compute.

A value that is absent is transformers' default: the published SmolVLM2 leaves out its vision tower's depth and MLP.
Source: `SmolVLMConfig`, `SmolVLMVisionConfig`, `LlamaConfig` and their Idefics3 likes of transformers 5.5.4.
"""

from collections.abc import Mapping
from typing import Any

from turbopi.support.reading import shown

TEXT, VISION = "text_config", "vision_config"
_DEFAULTS: dict[str, dict[str, object]] = {
    TEXT: {
        "hidden_size": 4096,
        "intermediate_size": 11_008,
        "num_hidden_layers": 32,
        "num_attention_heads": 32,
        "vocab_size": 32_000,
        "rms_norm_eps": 1e-6,
    },
    VISION: {
        "hidden_size": 1152,
        "intermediate_size": 3072,
        "num_hidden_layers": 12,
        "num_attention_heads": 16,
        "image_size": 224,
        "patch_size": 32,
        "layer_norm_eps": 1e-6,
    },
}
_SCALE_FACTOR = 2
_COMPUTED: dict[str, dict[str, tuple[object, ...]]] = {
    "": {"model_type": ("smolvlm", "idefics3")},
    TEXT: {"model_type": ("llama",), "hidden_act": ("silu",)},
    VISION: {"hidden_act": ("gelu_pytorch_tanh",)},
}


def completed(config: Mapping[str, Any]) -> dict[str, Any]:
    """The same with transformers' defaults. KeyError or TypeError for what is no such config."""
    whole: dict[str, Any] = {"scale_factor": _SCALE_FACTOR, **config}
    for part, defaults in _DEFAULTS.items():
        whole[part] = defaults | {key: value for key, value in {**config[part]}.items() if value is not None}
    whole[TEXT].setdefault("num_key_value_heads", whole[TEXT]["num_attention_heads"])
    return whole


def refused(config: Mapping[str, Any]) -> str | None:
    """The first value that computes something else, and what Turbo-Pi computes."""
    for part, keys in _COMPUTED.items():
        values = config[part] if part else config
        for key, known in keys.items():
            if values.get(key) is not None and values[key] not in known:
                name = f"{part}.{key}" if part else key
                return f"{name} = {shown(values[key])}; Turbo-Pi computes {' or '.join(map(str, known))} alone"
    return None
