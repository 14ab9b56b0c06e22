"""What captured.py captures of so many cameras and observations, and where the inputs lie."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbopi.config import Network
from turbopi.engine.flat import Fields, Staged
from turbopi.engine.graph import Graph
from turbopi.engine.resize import Resizer
from turbopi.models.observation import Observation
from turbopi.models.pi0.kv_cache import KVCache

Size = tuple[int, int]  # of a call: cameras and observations


@dataclass
class Step:
    """A captured evaluation of the expert: x float32[B, H, A], time float32[1, D] or [1, H, D], v as x."""

    x: Tensor
    time: Tensor
    v: Tensor
    graph: Graph


@dataclass(frozen=True)
class Answer:
    """Actions float32[B, H, A], on the device; each evaluation's x_t and v_t, of the same shape, if they were kept."""

    actions: Tensor
    evaluations: list[tuple[Tensor, Tensor]]


@dataclass
class Graphs:
    """Of so many observations and cameras: the inputs' places, what the prefix leaves, and what is captured behind it.

    staged  all inputs but images and a past
    resizer what the vision graph resizes bytes by; None: it doesn't
    behind  what the reference's expert makes of the cache once a call
    more    what else a backend's prefix leaves
    steps   (horizon, whether each action has its own time) -> step
    noise   horizon -> float32[B, H, A]
    loops   (horizon, steps) -> a backend's whole loop
    """

    inputs: Observation
    staged: Staged
    resizer: Resizer | None
    vision: Graph
    prefix: Graph
    cache: KVCache
    behind: Any
    more: Any
    steps: dict[tuple[int, bool], Step] = field(default_factory=dict)
    noise: dict[int, Staged] = field(default_factory=dict)
    loops: dict[tuple[int, int], Any] = field(default_factory=dict)

    @property
    def size(self) -> Size:
        batch, cameras = self.inputs.image_mask.shape
        return cameras, batch

    def noise_of(self, horizon: int, config: Network) -> Staged:
        """Where a call's noise of so many actions lies."""
        if horizon not in self.noise:
            chunks = (self.size[1], horizon, config.action_dim)
            self.noise[horizon] = Staged({"noise": (chunks, torch.float32)}, self.inputs.tokens.device)
        return self.noise[horizon]


@dataclass(frozen=True)
class Seen:
    """A captured vision: what resizes bytes in it (None: nothing does), and the embedded images that it writes."""

    resizer: Resizer | None
    graph: Graph
    embedded: Tensor


def inputs_of(config: Network, cameras: int, batch: int, device: torch.device) -> tuple[Observation, Staged]:
    """Where a graph finds observations, all of whose places are valid at first."""
    side, prompt = config.image_size, (batch, config.max_prompt_tokens)
    fields: Fields = {
        "image_mask": ((batch, cameras), torch.bool),
        "tokens": (prompt, torch.int64),
        "token_mask": (prompt, torch.bool),
        "state": ((batch, config.state_dim), torch.float32),
        "causal": (prompt, torch.bool),
    }
    staged, images = Staged(fields, device), torch.zeros(batch, cameras, side, side, 3, device=device)
    arrays, there = staged.writable(), staged.tensors
    arrays["image_mask"][:] = arrays["token_mask"][:] = True
    staged.send()
    inputs = Observation(images, *(there[name] for name in ("image_mask", "tokens", "token_mask", "state")))
    return inputs, staged


def write_prompts(
    arrays: Mapping[str, np.ndarray], tokens: Sequence[np.ndarray], state: np.ndarray | None, causal: Tensor | None
) -> None:
    """Of some observations, the first rows of what `inputs_of` stages; None: the state stays, no token is causal."""
    for name in ("tokens", "token_mask", "causal"):
        arrays[name][:] = 0
    for row, one in enumerate(tokens):
        arrays["tokens"][row, : len(one)], arrays["token_mask"][row, : len(one)] = one, True
    if state is not None:
        fill(arrays["state"], state)
    if causal is not None:
        arrays["causal"][:, : causal.shape[1]] = causal.numpy()


def fill(rows: np.ndarray, given: np.ndarray) -> None:
    """The first ones; the others become zeros."""
    rows[: len(given)], rows[len(given) :] = given, 0
