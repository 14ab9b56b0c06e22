"""The prefix: images and prompt to one sequence, and that sequence to keys and values.

Bidirectional attention among the valid tokens. The last layer's queries, its MLP and the final norm would change no
key and no value, so they aren't computed.
"""

import math

import torch
from torch import Tensor

from turbopi.models.observation import Observation
from turbopi.models.pi0.gemma import Gemma
from turbopi.models.pi0.layers import gated_residual
from turbopi.models.pi0.vision import VisionTower


def embed_images(vision: VisionTower, projector: torch.nn.Linear, images: Tensor) -> tuple[Tensor, Tensor]:
    """Images [B, C, 224, 224, 3] -> (language-model tokens [B, C * 256, D], the tower's output [C, B, 256, W]).

    Image tokens are not multiplied by √D, unlike prompt tokens.
    """
    b, c = images.shape[:2]
    hidden = vision(images.flatten(0, 1))
    return projector(hidden).unflatten(0, (b, c)).flatten(1, 2), hidden.unflatten(0, (b, c)).transpose(0, 1)


def embed_prompt(vlm: Gemma, tokens: Tensor) -> Tensor:
    """Prompt ids int64[B, P] -> [B, P, D]"""
    weight = vlm.embed_tokens.weight
    return vlm.embed_tokens(tokens) * math.sqrt(weight.shape[1])


def camera_slots(observation: Observation, *, compact: bool) -> Tensor | None:
    """Indices of the cameras that some batch row has; None: all (nothing to select)."""
    used = observation.image_mask.any(0)
    return None if not compact or bool(used.all()) else used.nonzero().squeeze(1)


def prefix_keys_values(
    vlm: Gemma, embs: Tensor, rope: tuple[Tensor, Tensor], mask: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Run embeddings [B, S, D] through all layers -> K, V [layer, B, G, S, K].

    `mask` bool[B, 1, 1 or S, S] says which keys are seen. Padded queries need none: what they see is never read.
    """
    keys, values = [], []
    x = embs
    for i, layer in enumerate(vlm.layers):
        normed, gate = layer.input_layernorm(x)
        k, v = layer.keys_values(normed, rope)
        keys.append(k)
        values.append(v)
        if i + 1 < len(vlm.layers):
            x = layer.feed_forward(gated_residual(x, layer.attend(normed, rope, k, v, mask), gate))
    return torch.stack(keys), torch.stack(values)
