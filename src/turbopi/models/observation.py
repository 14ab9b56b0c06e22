"""What goes into the model: the contract between the policy's edges and every backend."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class ModelInputs:
    """One preprocessed observation, on the host, without a batch axis.

    images      (uint8|float32)[C, 224, 224, 3]  RGB; uint8 in [0, 255], float32 in [-1, 1]
    image_mask  bool[C]                          False: the camera is missing and its image is ignored
    tokens      int64[P]                         prompt ids, padded with 0
    token_mask  bool[P]
    state       float32[action_dim]              normalised and zero-padded; only Pi0 reads it
    """

    images: np.ndarray
    image_mask: np.ndarray
    tokens: np.ndarray
    token_mask: np.ndarray
    state: np.ndarray


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

        def stacked(name: str) -> Tensor:
            arrays = [getattr(item, name) for item in inputs]
            batch = arrays[0][None] if len(arrays) == 1 else np.stack(arrays)
            tensor = torch.from_numpy(batch)
            return tensor if device == "cpu" else tensor.to(device)

        return cls(*(stacked(name) for name in ("images", "image_mask", "tokens", "token_mask", "state")))

    def to(self, device: torch.device | str) -> "Observation":
        return Observation(
            self.images.to(device),
            self.image_mask.to(device),
            self.tokens.to(device),
            self.token_mask.to(device),
            self.state.to(device),
        )


def with_cameras(inputs: ModelInputs, count: int) -> ModelInputs:
    """The same inputs with `count` valid cameras, the first ones; images that aren't there are black."""
    images, slots = inputs.images, max(count, len(inputs.image_mask))
    padded = np.concatenate((images, np.zeros((slots - len(images), *images.shape[1:]), images.dtype)))
    return dataclasses.replace(inputs, images=padded, image_mask=np.arange(slots) < count)
