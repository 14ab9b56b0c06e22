"""Weights to start training from."""

import math
from pathlib import Path

import torch
from torch import Tensor

from turbopi.checkpoint import open_checkpoint
from turbopi.config import ModelConfig, VisionConfig
from turbopi.models.pi0.reference import Pi0Model


def fresh_model(config: ModelConfig, seed: int) -> Pi0Model:
    """A model to train, float32 on the CPU.

    Matrices have variance 1 / fan-in, those that write into a residual stream less with depth; adaRMS starts at zero,
    so that the action expert's blocks do nothing at first, and so does the output; position embeddings start as sines
    of row and column.
    """
    generator = torch.Generator().manual_seed(seed)
    model = Pi0Model(config)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            parameter.copy_(initial(name, parameter, config.vision, config.vlm.depth, generator))
    return model.requires_grad_(True)


def trained_model(config: ModelConfig, folder: Path) -> Pi0Model:
    """A checkpoint's weights as a model to train on, float32 on the CPU.

    The checkpoint's action horizon may be another: no weight of the model depends on it.
    """
    model = Pi0Model(config)
    model.load_state_dict(open_checkpoint(folder).load(torch.device("cpu"), "f32").state)
    return model.requires_grad_(True)


def initial(name: str, parameter: Tensor, vision: VisionConfig, depth: int, generator: torch.Generator) -> Tensor:
    """A parameter's first value, see `fresh_model`; depth: layers of the language model."""
    if name == "vision.position_embedding.weight":
        return 0.5 * position_sines(vision.num_tokens, vision.width)
    if name.startswith("action_out_proj") or (name.startswith("expert.") and ".dense." in name):
        return torch.zeros_like(parameter)
    if parameter.ndim == 1:
        is_layer_norm = name.startswith("vision.") and "norm" in name and name.endswith("weight")
        return torch.ones_like(parameter) if is_layer_norm else torch.zeros_like(parameter)
    fan_in = parameter[0].numel()
    scale = 1 / math.sqrt(fan_in)
    if name.endswith(("o_proj.weight", "out_proj.weight", "down_proj.weight", "fc2.weight")):
        scale /= math.sqrt(2 * (vision.depth if name.startswith("vision.") else depth))
    return torch.randn(parameter.shape, generator=generator) * scale


def position_sines(tokens: int, width: int) -> Tensor:
    """float32[tokens, width]: sines and cosines of the row in one half, of the column in the other."""
    side = math.isqrt(tokens)
    frequencies = 1 / 100 ** (torch.arange(width // 4) / (width // 4))
    at = torch.arange(side)[:, None] * frequencies
    waves = torch.cat((at.sin(), at.cos()), dim=1)
    rows, columns = waves.repeat_interleave(side, 0), waves.repeat(side, 1)
    return torch.cat((rows, columns), dim=1)
