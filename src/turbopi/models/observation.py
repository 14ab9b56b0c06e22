"""What goes into the model: the contract between the policy's edges and every backend."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbopi.config import MemoryConfig

_TENSORS = ("images", "image_mask", "tokens", "token_mask", "state")  # of every policy


@dataclass(frozen=True)
class PastInputs:
    """What a policy with memory sees besides the current observation, oldest first; None: it doesn't see it.

    F frames, the current one included. False in a mask: the episode hadn't begun, or the camera is missing.

    images      as ModelInputs.images  [C, F - 1, 224, 224, 3]
    image_mask  bool[C, F - 1]
    states      float32[F, state_dim]  normalised and zero-padded, the current one last
    state_mask  bool[F]
    """

    images: np.ndarray | None = None
    image_mask: np.ndarray | None = None
    states: np.ndarray | None = None
    state_mask: np.ndarray | None = None


@dataclass(frozen=True)
class ModelInputs:
    """One preprocessed observation, on the host, without a batch axis.

    images      (uint8|float32)[C, 224, 224, 3]  RGB; uint8 in [0, 255], float32 in [-1, 1]
    image_mask  bool[C]                          False: the camera is missing and its image is ignored
    tokens      int64[P]                         prompt ids, padded with 0
    token_mask  bool[P]
    state       float32[action_dim]              normalised and zero-padded; only Pi0 reads it
    past        for a policy with memory
    """

    images: np.ndarray
    image_mask: np.ndarray
    tokens: np.ndarray
    token_mask: np.ndarray
    state: np.ndarray
    past: PastInputs | None = None


@dataclass(frozen=True)
class Past:
    """A batch of `PastInputs`, with a leading B axis."""

    images: Tensor | None = None
    image_mask: Tensor | None = None
    states: Tensor | None = None
    state_mask: Tensor | None = None

    @property
    def parts(self) -> dict[str, Tensor]:
        """Those that there are, by name."""
        return {name: part for name, part in vars(self).items() if part is not None}

    def each(self, change: Callable[[Tensor], Tensor]) -> "Past":
        return Past(**{name: change(part) for name, part in self.parts.items()})

    def of_cameras(self, mask: Tensor) -> "Past":
        """Images of some cameras alone: mask bool[C]."""
        if self.images is None or self.image_mask is None:
            return self
        return dataclasses.replace(self, images=self.images[:, mask], image_mask=self.image_mask[:, mask])


@dataclass(frozen=True)
class Observation:
    """A batch of model inputs on the model's device: `ModelInputs` with a leading B axis."""

    images: Tensor  # (uint8|float32)[B, C, 224, 224, 3]
    image_mask: Tensor  # bool[B, C]
    tokens: Tensor  # int64[B, P]
    token_mask: Tensor  # bool[B, P]
    state: Tensor  # float32[B, action_dim]

    def __post_init__(self) -> None:
        b, c = self.image_mask.shape
        assert self.images.shape[:2] == (b, c) and self.images.shape[-1] == 3, self.images.shape
        assert self.images.dtype in (torch.uint8, torch.float32), self.images.dtype
        assert self.tokens.shape == self.token_mask.shape and self.tokens.shape[0] == b, self.tokens.shape
        assert self.state.ndim == 2 and self.state.shape[0] == b, self.state.shape

    @property
    def batch_size(self) -> int:
        return self.tokens.shape[0]

    @classmethod
    def stack(cls, inputs: Sequence[ModelInputs], device: torch.device | str = "cpu") -> "Observation":
        """Batch one or more preprocessed observations and put them on `device`.

        One on the host stays where it is: its tensors share the memory of its arrays.
        """

        def stacked(arrays: Sequence[np.ndarray]) -> Tensor:
            batch = arrays[0][None] if len(arrays) == 1 else np.stack(arrays)
            tensor = torch.from_numpy(batch)
            return tensor if device == "cpu" else tensor.to(device)

        tensors = [stacked([getattr(item, name) for item in inputs]) for name in _TENSORS]
        pasts = [vars(item.past) for item in inputs if item.past is not None]
        if not pasts:
            return Observation(*tensors)
        assert len(pasts) == len(inputs), "some of a batch have a past, others none"
        there = [name for name, part in pasts[0].items() if part is not None]
        return PastObservation(*tensors, past=Past(**{name: stacked([one[name] for one in pasts]) for name in there}))

    @classmethod
    def joined(cls, batches: Sequence["Observation"]) -> "Observation":
        """All rows of batches without a past."""
        return Observation(*(torch.cat([getattr(one, name) for one in batches]) for name in _TENSORS))

    def each(self, change: Callable[[Tensor], Tensor]) -> "Observation":
        """With each tensor changed."""
        return Observation(*(change(getattr(self, name)) for name in _TENSORS))

    def to(self, device: torch.device | str) -> "Observation":
        return self.each(lambda part: part.to(device))

    def row(self, row: int) -> "Observation":
        """One of a batch, as a batch of one."""
        return self.each(lambda part: part[row : row + 1])


@dataclass(frozen=True)
class PastObservation(Observation):
    """Of a policy with memory."""

    past: Past = field(kw_only=True)

    def each(self, change: Callable[[Tensor], Tensor]) -> Observation:
        return PastObservation(*(change(getattr(self, name)) for name in _TENSORS), past=self.past.each(change))


@dataclass(frozen=True)
class SeenObservation(Observation):
    """One observation whose images are embedded already, or whose prompt is causal in part.

    seen    what the reference's `embed_cameras` returned, or what a writer keeps of it; None: it is still to be done
    causal  bool[1, P]  tokens that see what is before them, and that nothing before them sees; None: none is
    """

    seen: Any = field(default=None, kw_only=True)
    causal: Tensor | None = field(default=None, kw_only=True)

    @classmethod
    def of(cls, observation: Observation, seen: Any = None, causal: Tensor | None = None) -> "SeenObservation":
        assert observation.batch_size == 1
        return cls(*(getattr(observation, name) for name in _TENSORS), seen=seen, causal=causal)

    def each(self, change: Callable[[Tensor], Tensor]) -> Observation:
        causal = None if self.causal is None else change(self.causal)
        return SeenObservation(*(change(getattr(self, name)) for name in _TENSORS), seen=self.seen, causal=causal)


def past_of(observation: Observation) -> Past:
    """What a policy with memory sees besides; nothing for an observation of another."""
    return observation.past if isinstance(observation, PastObservation) else Past()


def remembering(observation: Observation, memory: MemoryConfig) -> PastObservation:
    """With a past of zeros, all of it valid."""
    (batch, cameras, *image), frames = observation.images.shape, memory.frames
    there = observation.image_mask.new_ones
    parts: dict[str, Tensor] = {}
    if memory.visual:
        parts["images"] = observation.images.new_zeros(batch, cameras, frames - 1, *image)
        parts["image_mask"] = there(batch, cameras, frames - 1)
    if memory.proprioceptive:
        parts["states"] = observation.state.new_zeros(batch, frames, memory.state_dim)
        parts["state_mask"] = there(batch, frames)
    return PastObservation(*(getattr(observation, name) for name in _TENSORS), past=Past(**parts))


def with_cameras(inputs: ModelInputs, count: int) -> ModelInputs:
    """The same inputs with `count` valid cameras, the first ones; images that aren't there are black."""
    slots, past = max(count, len(inputs.image_mask)), inputs.past

    def padded(of_cameras: np.ndarray) -> np.ndarray:
        more = slots - len(of_cameras)
        return np.concatenate((of_cameras, np.zeros((more, *of_cameras.shape[1:]), of_cameras.dtype)))

    if past is not None and past.images is not None and past.image_mask is not None:
        past = dataclasses.replace(past, images=padded(past.images), image_mask=padded(past.image_mask))
    mask = np.arange(slots) < count
    return dataclasses.replace(inputs, images=padded(inputs.images), image_mask=mask, past=past)
