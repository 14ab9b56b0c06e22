"""The operations of a call's matrices, and the numbers that it reads and writes at least."""

from turbopi.models.smolvla.config import SmolVLAConfig

Counts = dict[str, tuple[int, int]]  # stage: operations (multiply and add counted apart), numbers through memory


def counts(config: SmolVLAConfig, cameras: int, tokens: int, horizon: int, steps: int, batch: int) -> Counts:
    """Of "vision" (with the connector), "prefix" and "denoise": weights once, in denoising once a step; the last text
    layer cut to keys and values; cross keys and values once a call.
    """
    vision, text, width = config.vision, config.text, config.expert_width
    factor = config.scale_factor**2
    patches = (config.image_size // vision.patch_size) ** 2
    block = 4 * vision.width**2 + 2 * vision.width * vision.mlp_dim
    tower = vision.depth * block + 3 * vision.patch_size**2 * vision.width
    connector = factor * vision.width * text.width
    attention = vision.depth * 4 * patches * vision.width
    seen = 2 * (tower + connector // factor) + attention  # of a patch

    prefix = cameras * patches // factor + tokens + 1
    heads, kv_heads = text.num_heads * text.head_dim, text.num_kv_heads * text.head_dim
    kv, rest = 2 * text.width * kv_heads, 2 * text.width * heads + 3 * text.width * text.mlp_dim
    layers = text.depth * kv + (text.depth - 1) * rest
    read = 2 * prefix * layers + (text.depth - 1) * 4 * prefix**2 * heads
    cache = text.depth * 2 * prefix * kv_heads

    own = sum(config.is_self_layer(at) for at in config.expert_at)
    across = config.expert_depth - own
    crossing = across * 2 * kv_heads**2
    expert = config.expert_depth * (2 * width * heads + 3 * width * config.expert_mlp) + own * 2 * width * kv_heads
    expert += 2 * config.action_dim * width + 3 * width**2  # the actions' projections and the time's two layers
    attended = 4 * heads * (own * (prefix + horizon) + across * prefix)
    step = horizon * (2 * expert + attended)
    return {
        "vision": (batch * cameras * patches * seen, tower + connector),
        "prefix": (batch * (read + 2 * prefix * crossing), layers + crossing + batch * cache),
        "denoise": (steps * batch * step, steps * (expert + batch * config.expert_depth * 2 * prefix * kv_heads)),
    }
