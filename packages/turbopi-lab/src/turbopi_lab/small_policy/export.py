"""Writes a trained model as a checkpoint in openpi's PyTorch layout, which the ordinary loader reads."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from turbopi.checkpoint.base import Checkpoint
from turbopi.checkpoint.convert import convert
from turbopi.checkpoint.norm_stats import NormStats
from turbopi.checkpoint.source import Piece, Shape
from turbopi.config import PolicyConfig, preset
from turbopi.models.pi0.reference import FloatPrecision
from turbopi.preprocess.tokenizer import TINY_TOKENIZER
from turbopi_lab.small_policy.episodes import HORIZON

ASSET_ID = "turbopi/libero_spatial"
# As openpi's own pi05_libero, it doesn't read the state: where the hand is, the images show
CONFIG: PolicyConfig = dataclasses.replace(
    preset("pi05_tiny"), name="pi05_tiny", discrete_state_input=False, asset_id=ASSET_ID
).with_model(action_horizon=HORIZON)


class TrainedWeights:
    """A state dict as a source of weights."""

    format = "openpi_torch"

    def __init__(self, state: dict[str, Tensor], vision_heads: int) -> None:
        self._state = state
        self.vision_heads: int | None = vision_heads
        self.shapes: dict[str, Shape] = {name: tuple(value.shape) for name, value in state.items()}
        self.dtypes = dict.fromkeys(state, "F32")
        self.notes: list[str] = []

    def native_name(self, name: str) -> str:
        return name

    def pieces(self, device: torch.device) -> Iterator[Piece]:
        for name, value in self._state.items():
            yield Piece(name, 0, value.detach().to(device, torch.float32))


def export(
    state: dict[str, Tensor],
    stats: NormStats,
    folder: Path,
    precision: FloatPrecision = "bf16",
    config: PolicyConfig = CONFIG,
) -> Path:
    """Write canonical weights, statistics and the tokenizer into a new folder."""
    assert config.asset_id is not None
    checkpoint = Checkpoint(
        path=None,
        config=config,
        config_source="training",
        norm_stats=stats,
        source=TrainedWeights(state, config.planned_model.vision.num_heads),
        asset_id=config.asset_id,
        tokenizer_candidates=(TINY_TOKENIZER,),
    )
    convert(checkpoint, folder, precision=precision)
    return folder
