"""The operations of a call's matrices, and the numbers that it reads and writes at least."""

from turbopi.config import Pi0FastConfig


def counts(
    config: Pi0FastConfig, cameras: int, tokens: int, horizon: int, steps: int, batch: int
) -> dict[str, tuple[int, int]]:
    """Of "vision", "prefix", with the first token of the answer, and "denoise", the `steps` - 1 tokens behind it: all
    weights once a token, the embedding table as the head.
    """
    vision, text = config.vision, config.vlm
    tower = vision.depth * (4 * vision.width**2 + 2 * vision.width * vision.mlp_dim)
    tower += 3 * vision.patch_size**2 * vision.width + vision.width * text.width
    patches = cameras * vision.num_tokens
    seen = 2 * patches * tower + vision.depth * 4 * patches * vision.num_tokens * vision.width

    heads, kv_heads = text.num_heads * text.head_dim, text.num_kv_heads * text.head_dim
    layers = text.depth * (2 * text.width * (heads + kv_heads) + 3 * text.width * text.mlp_dim)
    head, prefix = config.vocab_size * text.width, patches + tokens
    cache = text.depth * 2 * kv_heads
    read = 2 * prefix * layers + 2 * head + text.depth * 4 * prefix**2 * heads
    attended = (steps - 1) * prefix + steps * (steps - 1) // 2  # keys of all steps
    written = (steps - 1) * 2 * (layers + head) + text.depth * 4 * attended * heads
    return {
        "vision": (batch * seen, tower),
        "prefix": (batch * read, layers + head + batch * prefix * cache),
        "denoise": (batch * written, (steps - 1) * (layers + head) + batch * attended * cache),
    }
