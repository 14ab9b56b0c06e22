"""Weights to study numbers of eight bits on: Turbo-Pi's random ones, and two kinds that others use for it."""

from collections.abc import Iterator
from dataclasses import replace
from math import prod
from typing import Literal, get_args

import torch
from torch import Tensor

from turbopi.checkpoint import Checkpoint, random_checkpoint
from turbopi.checkpoint.random_weights import RandomSource
from turbopi.checkpoint.source import Piece
from turbopi.config import PolicyConfig

STD = 0.02
OUTLIERS, OUTLIER_FACTOR = 0.01, 20.0
Weights = Literal["turbopi", "std 0.02", "std 0.02 with outliers"]
WEIGHTS: tuple[Weights, ...] = get_args(Weights)


def studied_checkpoint(
    kind: Weights, preset: str | PolicyConfig, device: torch.device | str, seed: int = 0
) -> Checkpoint:
    """Random weights of one of three kinds:

    turbopi                 what `--random-weights` are
    std 0.02                matrices normal with standard deviation 0.02, norms 1, biases 0
    std 0.02 with outliers  the same, and 1 % of the channels behind every norm of vision and prefix 20 times as large

    The last two are drawn on `device` and belong to its kind: a GPU draws other numbers than a CPU.
    """
    checkpoint = random_checkpoint(preset, seed)
    if kind == "turbopi":
        return checkpoint
    source = _NormalSource(checkpoint.config, seed, torch.device(device).type, outliers=kind != "std 0.02")
    return replace(checkpoint, source=source, config_source=f"{checkpoint.config_source}, {kind}")


class _NormalSource(RandomSource):
    """Weights that exist only as a recipe, drawn by PyTorch's generator of one kind of device."""

    def __init__(self, config: PolicyConfig, seed: int, device_type: str, *, outliers: bool) -> None:
        super().__init__(config, seed)
        self._device_type, self._outliers = device_type, outliers
        self.recipe = ("turbopi normal weights 1", seed, sorted(self.shapes.items()), device_type, outliers)  # type: ignore[assignment]

    def pieces(self, device: torch.device) -> Iterator[Piece]:
        """Float32, a parameter at a time; each has a generator of its own, so the order doesn't matter."""
        drawn_on = torch.device(device if device.type == self._device_type else self._device_type)
        for number, name in enumerate(sorted(self.shapes, key=lambda name: (-prod(self.shapes[name]), name))):
            generator = torch.Generator(drawn_on).manual_seed(self._seed * 10_000 + number)
            values = torch.empty(self.shapes[name], device=drawn_on)
            self._draw(name, values, generator)
            yield Piece(name, 0, values.to(device))

    def _draw(self, name: str, values: Tensor, generator: torch.Generator) -> None:
        if values.dim() > 1:
            values.normal_(0.0, STD, generator=generator)
            return
        if name.endswith("bias"):
            values.zero_()
            return
        # LayerNorm's weight is the factor itself, RMSNorm's is added to 1
        one = 1.0 if name.startswith("vision.") else 0.0
        values.fill_(one)
        if self._outliers:
            chosen = torch.rand(values.shape, generator=generator, device=values.device) < OUTLIERS
            values[chosen] = OUTLIER_FACTOR + one - 1.0
