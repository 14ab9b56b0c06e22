"""Weights distilled for one denoising step with a target time s (SnapFlow, arXiv 2604.05656), read as ordinary ones.

Beside the time t of a step their model is told the time s that the step leads to:

    time embedding = sincos(t) + MLP(sincos(s))

before time_mlp_in (Pi0: action_time_mlp_in). One step leads from noise to actions: a = noise − v(noise, t = 1, s). As s
is always the same, the MLP's output c is, too, and W (sincos(t) + c) + b = W sincos(t) + (b + W c): read this way, only
a bias differs. So every backend runs them, at no cost.

No file says s, and public forks differ, in the names, too: `_PAIRS`. Others add the MLP's output elsewhere, or compute
something else from a second time; they are refused.
"""

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.checkpoint.source import Piece, Shape, WeightSource, listing
from turbopi.models.pi0.denoise import time_embedding
from turbopi.support.errors import CheckpointError, ConfigError
from turbopi.support.reading import shown

UNUSED = "unused"
TargetTime = float | str  # s, or UNUSED
_PAIRS = (  # the two layers of the MLP: tether's, of forks of openpi's JAX, Physical AI Studio's
    ("target_time_embed_mlp.0", "target_time_embed_mlp.2"),
    ("target_time_mlp_1", "target_time_mlp_2"),
    ("target_time_mlp_in", "target_time_mlp_out"),
)
_REFUSED = {
    "target_time_mlp": "a target time that forks add in different places, some behind time_mlp_out",
    "logvar_proj": "a decoupled mean flow (DMF), whose second time goes through time_mlp_in, too",
    "time_proj": "a mean flow of two times (SMF)",
}
_MEETS = ("time_mlp_in", "action_time_mlp_in")  # whose input the time's embedding is, or is the last part of


class TargetTimeSource:
    """Weights of another source, without the MLP: its output for s is in a bias. s None: nothing reads the MLP."""

    def __init__(self, source: WeightSource, layers: tuple[str, str], s: float | None, where: object) -> None:
        self._source, self._s = source, s
        self._mlp = [f"{layer}.{part}" for layer in layers for part in ("weight", "bias")]
        self.shapes: dict[str, Shape] = {name: one for name, one in source.shapes.items() if name not in self._mlp}
        self.dtypes = {name: source.dtypes[name] for name in self.shapes}
        self.variant = f"{getattr(source, 'variant', '')} target_time {s}".strip()
        if s is None:
            source.notes.append(f"{' and '.join(layers)} aren't read: target_time is {UNUSED!r}")
            return
        self._weight = next((f"{name}.weight" for name in _MEETS if f"{name}.weight" in source.shapes), "")
        self._bias = self._weight.replace(".weight", ".bias")
        self._check(where)
        self.dtypes[self._bias] = "F32"
        source.notes.append(f"{' and '.join(layers)}: one denoising step, to target time {s:g}, which {self._bias} has")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def pieces(self, device: torch.device) -> Iterator[Piece]:
        if self._s is None:
            yield from (piece for piece in self._source.pieces(device) if piece.name in self.shapes)
            return
        needed = {name: torch.empty(self._source.shapes[name]) for name in (*self._mlp, self._weight, self._bias)}
        for piece in self._source.pieces(device):
            if piece.name in needed:
                needed[piece.name][piece.start : piece.start + len(piece.values)] = piece.values.float()
            if piece.name in self.shapes and piece.name != self._bias:
                yield piece
        yield Piece(self._bias, 0, self._folded(needed))

    def _folded(self, values: dict[str, Tensor]) -> Tensor:
        """b + W c, in float64; of Pi0's W the columns that meet the time, which come last."""
        first, first_bias, last, last_bias, weight, bias = (one.double() for one in values.values())
        embedded = time_embedding(np.array([self._s or 0.0]), first.shape[1]).double()[0]
        c = F.linear(F.silu(F.linear(embedded, first, first_bias)), last, last_bias)
        return (bias + weight[:, -len(c) :] @ c).float()

    def _check(self, where: object) -> None:
        shapes = self._source.shapes
        if self._bias not in shapes:
            raise CheckpointError(f"{where} has a target time, but neither {' nor '.join(_MEETS)}, which it is for")
        width = shapes[self._weight][0]
        hidden = shapes.get(self._mlp[1], (0,))[0]
        expected = [(hidden, width), (hidden,), (width, hidden), (width,)]
        wrong = [
            f"{self._source.native_name(name)} is {list(shapes[name]) if name in shapes else 'missing'}, "
            f"expected {list(shape)}"
            for name, shape in zip(self._mlp, expected, strict=True)
            if shapes.get(name) != shape
        ]
        if wrong:
            raise CheckpointError(f"{where}: the target time's MLP doesn't fit the model: {listing(wrong)}")


def with_target_time(source: WeightSource, s: TargetTime | None, where: object, config_source: str) -> WeightSource:
    """The same source, or one whose target time is s: `TargetTimeSource`. Its weights are for one denoising step.

    Raises CheckpointError for weights of another way to make one step, ConfigError where s isn't known, or is for none.
    """
    for module, what in _REFUSED.items():
        if found := [source.native_name(name) for name in source.shapes if re.match(rf"{module}[./]", name)]:
            raise CheckpointError(f"{where} has {listing(found)}: {what}. Turbo-Pi doesn't compute that")
    layers = next((pair for pair in _PAIRS if any(f"{layer}.weight" in source.shapes for layer in pair)), None)
    if layers is None:
        if s is not None:
            raise ConfigError(
                f"{config_source}: target_time is {shown(s)}, but {where} has no tensors of a target time"
            )
        return source
    if s is None:
        raise ConfigError(
            f"{where} has {', '.join(layers)}: weights that were distilled for one denoising step (SnapFlow), and no "
            'file says for which target time. Put "target_time" into turbopi.json: 1 if tether made them; 0 where '
            'the target time of the plain flow is the step\'s own time, as in the paper; "unused" for a policy of '
            "Physical AI Studio's that wasn't distilled"
        )
    return TargetTimeSource(source, layers, None if isinstance(s, str) else s, where)
