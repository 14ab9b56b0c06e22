"""Where the time of an inference went, for people."""

from collections.abc import Mapping

# `model` is openpi's infer_ms: the stages between, from inputs on the host to actions on the host
_COLUMNS = {
    "preprocess": "preprocess_ms",
    "queue": "queue_ms",
    "vision": "vision_ms",
    "text": "text_ms",
    "prefix": "prefix_ms",
    "denoise": "denoise_ms",
    "postprocess": "postprocess_ms",
    "model": "infer_ms",
    "total": "total_ms",
}

STAGES = (
    "vision, prefix (the tokens of images and prompt) and denoise (the actions) are the model's stages; queue is "
    "waiting for other calls"
)


def timing_columns(timing: Mapping[str, float]) -> dict[str, str]:
    """Heading -> key of `policy_timing`, in the order of time, then the sums; without stages the backend can't tell."""
    others = {key.removesuffix("_ms"): key for key in timing if key not in _COLUMNS.values()}
    return {name: key for name, key in (others | _COLUMNS).items() if key in timing}
