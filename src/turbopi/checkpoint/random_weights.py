"""Seeded random weights of sensible scale, for any preset: every command and benchmark runs without a checkpoint.

A value is a hash of (seed, parameter's name, index), mapped to a uniform number. Only integer arithmetic and exact
float operations are used, so a parameter has the same values on a CPU and on a GPU, in any order of generation.

Scales keep activations healthy at any size: matrices have standard deviation 1 / sqrt(fan-in), so that outputs of
normalised inputs have about unit variance; embeddings 1 / sqrt(width), which the model multiplies by sqrt(width);
LayerNorm weights 1 +- 0.1, RMSNorm scales (added to 1) 0.1, biases 0.1. So that the observation matters as much as in
trained models, Gemma's queries and keys get 1.5 and attention outputs 2 times that (flatter attention averages
everything away); so that adaRMS matters, its matrices, whose input is small, get 2 times and its biases 0.5. Measured
on pi05_tiny (10 steps): actions have rms 1.5; another observation moves them by 14 %, one other prompt token by 3.6 %,
bfloat16 by 0.4 %.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import fields, replace
from math import prod, sqrt
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from turbopi.checkpoint.base import Checkpoint
from turbopi.checkpoint.norm_stats import FeatureStats, NormStats
from turbopi.checkpoint.settings import ABOUT_WEIGHTS, ConfigSource, Settings, policy_config, read_settings, with_values
from turbopi.checkpoint.source import Piece, Shape, random_note, row_ranges
from turbopi.config import PRESETS, PolicyConfig, preset
from turbopi.models import RANDOM, family_of, parameter_shapes
from turbopi.support.errors import ConfigError

_ROBOT_DIMS = {"libero": (8, 7), "droid": (8, 8), "aloha": (14, 14)}  # state, actions; other robots: the model's width
_BLOCK = {"cpu": 2**14, "cuda": 2**24}  # values made at once: few, so that torch takes one core; enough for a GPU


class RandomSource:
    """Weights that exist only as a recipe."""

    format = "random"

    def __init__(self, config: PolicyConfig, seed: int) -> None:
        self.shapes: dict[str, Shape] = parameter_shapes(config.model)
        self.dtypes = dict.fromkeys(self.shapes, "F32")
        self.vision_heads: int | None = None  # as in LeRobot's layout
        self._norms = 0.0  # what their scales are around: Gemma's are stored less 1
        if family_of(config.model).paligemma:
            self.vision_heads = config.model.vision.num_heads
        else:
            self._norms = 1.0
        self.random: str | None = f"seed {seed}"
        self.notes = [random_note(self.random)]
        self.recipe = ("turbopi random weights 1", seed, sorted(self.shapes.items()))
        self._seed = seed

    def native_name(self, name: str) -> str:
        return name

    def pieces(self, device: torch.device) -> Iterator[Piece]:
        """Float32 pieces on `device`."""
        for name in sorted(self.shapes, key=lambda name: -prod(self.shapes[name])):
            shape = self.shapes[name]
            mean, std = _scale(name, shape, self._norms)
            row = prod(shape[1:])
            for start, stop in row_ranges(shape, 4):
                values = torch.empty(stop - start, row, dtype=torch.float32, device=device).flatten()
                _fill(values, start * row, _stream(self._seed, name), mean, std)
                yield Piece(name, start, values.view(stop - start, *shape[1:]))


def random_checkpoint(
    preset_name: str | PolicyConfig, seed: int = 0, config_source: ConfigSource = "auto"
) -> Checkpoint:
    """A checkpoint of random weights for a preset (or any PolicyConfig), with statistics of its robot's width.

    The sizes are the preset's; so is all else, unless `config_source` (see settings.py) says it.

    Raises ConfigError for an unknown preset, a configuration that doesn't fit, or a seed outside [0, 2**32).
    """
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed < 2**32:
        raise ConfigError(f"seed is {seed!r}; expected a whole number in [0, 2**32)")
    config = (
        preset_name
        if isinstance(preset_name, PolicyConfig)
        else PRESETS.get(preset_name) or RANDOM.get(preset_name) or preset(preset_name)
    )
    made_of = f"random weights, preset {config.name}, seed {seed}"
    if family_of(config.model).reader is not None:
        config = config.with_model(broken_answers="unread")  # they write no words
    if config_source != "auto":
        settings = read_settings(config_source, Path())
        config, made_of = _configured(config, settings), f"{made_of}, with {settings.source}"
    state, actions = _ROBOT_DIMS.get(config.robot, (config.model.action_dim, config.model.action_dim))
    return Checkpoint(
        path=None,
        config=config,
        config_source=made_of,
        norm_stats=NormStats(_plausible(state), _plausible(actions)),
        source=RandomSource(config, seed),
        asset_id=config.asset_id,
    )


def _configured(base: PolicyConfig, settings: Settings) -> PolicyConfig:
    """What the settings say, over the sizes of `base`."""
    about_weights = sorted(settings.values.keys() & ABOUT_WEIGHTS)
    if about_weights:
        raise ConfigError(f"{settings.source}: {', '.join(about_weights)} only applies to a checkpoint's own weights")
    if settings.policy is None and "preset" not in settings.values:
        config = with_values(base, settings)
    else:
        where = Path(f"the preset {base.name} of the random weights")
        config = policy_config(settings, base.model.kind, assets=[], where=where)
    own = {one.name for one in fields(base.model)}
    free = {name: getattr(config.model, name) for name in own & {"action_horizon", "max_prompt_tokens", "time_grid"}}
    return replace(config, model=base.with_model(**free).model)


def _plausible(dim: int) -> FeatureStats:
    """Statistics of values around 0 with a spread of about 1, a little different in every dimension."""
    ramp = np.linspace(-0.1, 0.1, dim)
    return FeatureStats(
        mean=ramp, std=0.5 + np.abs(ramp), q01=ramp - 1.0, q99=ramp + 1.0, min=ramp - 1.5, max=ramp + 1.5
    )


def _scale(name: str, shape: Shape, norms: float) -> tuple[float, float]:
    """Mean and standard deviation of a parameter; see the top of the file."""
    if ".dense." in name:
        return (0.0, 0.5) if name.endswith("bias") else (0.0, 2.0 / sqrt(shape[1]))
    if name.endswith("bias"):
        return 0.0, 0.1
    if len(shape) == 1:
        return (1.0 if name.startswith("vision.") else norms), 0.1
    if name == "vision.position_embedding.weight":
        return 0.0, 0.3
    gain = 1.0
    if not name.startswith("vision."):
        gain = 2.0 if "o_proj" in name else 1.5 if "q_proj" in name or "k_proj" in name else 1.0
    return 0.0, gain / sqrt(prod(shape[1:]))


def _stream(seed: int, name: str) -> tuple[int, int]:
    """Two 32-bit keys of a parameter."""
    digest = hashlib.sha256(f"{seed}/{name}".encode()).digest()
    return int.from_bytes(digest[:4], "little"), int.from_bytes(digest[4:8], "little")


def _fill(values: Tensor, first: int, keys: tuple[int, int], mean: float, std: float) -> None:
    """values[k] = mean + std * sqrt(3) * u, with u in [-1, 1) made from the index `first + k`."""
    block = _BLOCK.get(values.device.type, _BLOCK["cpu"])
    for start in range(0, len(values), block):
        part = values[start : start + block]
        x = torch.arange(first + start, first + start + len(part), dtype=torch.int64, device=values.device)
        x = _mix(x.bitwise_xor_(keys[0]))
        x = _mix(x.bitwise_xor_(keys[1]))
        part.copy_(x.bitwise_right_shift_(8))  # 24 bits: exact in float32, as are the next two steps
        part.mul_(2.0**-23).sub_(1.0).mul_(std * sqrt(3.0)).add_(mean)


def _mix(x: Tensor) -> Tensor:
    """A bijective hash of 32-bit values kept in int64; the constant is below 2**31, so products never overflow."""
    for _ in range(2):
        x = x.bitwise_xor_(x >> 16).mul_(0x45D9F3B).bitwise_and_(0xFFFFFFFF)
    return x.bitwise_xor_(x >> 16)
