"""The action expert's weights: which forms of them are on the device, and who uses each.

A form is built for its first user and freed with its last one:

  layers  bfloat16, as operations read them, one or several observations at once. Without a user they wait on the host
  packed  in the denoising kernels' order and precision, 0.6 GB of Pi0.5 in bfloat16: all kernels share one copy
  fp8     as operations read them where the denoising kernel runs in FP8: of batches

A user is what a captured graph reads a form through: its memory must stay where it is until the graph is gone.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from turbopi.engine.graph_cache import Loop
from turbopi.engine.weight_placement import HOST
from turbopi.kernels.interface import GemmaLayer

Layers = Sequence[GemmaLayer[Any]]
WeightForm = Literal["layers", "packed", "fp8"]


class User(NamedTuple):
    """single: a call of one observation; keeper: what goes forward where the true Jacobian goes back; pair: two
    observations in one kernel; batch: operations of several. rows: of the cache's prefix, at most
    """

    what: Literal["single", "keeper", "pair", "batch"]
    loop: Loop
    rows: int


class ExpertStore:
    """layers: on the host; they are moved in place. build: makes a form of them on the device."""

    def __init__(
        self,
        layers: list[GemmaLayer[Tensor]],
        device: torch.device,
        build: Mapping[WeightForm, Callable[[Layers], Any]],
    ) -> None:
        self._layers, self._device, self._build = layers, device, build
        self._built: dict[WeightForm, Any] = {}
        self.users: dict[WeightForm, set[User]] = {"layers": set(), "packed": set(), "fp8": set()}

    def use(self, form: WeightForm, user: User) -> Any:
        """The weights in a form, which stays on the device until this user is released."""
        self.users[form].add(user)
        if form == "layers":
            self._move_layers(self._device)
            return self._layers
        if form not in self._built:
            self._built[form] = self._build[form](self._layers)
        return self._built[form]

    def release(self, done: Callable[[User], bool]) -> None:
        """These users' graphs are gone: free the forms that have no other user."""
        for form, users in self.users.items():
            users.difference_update({user for user in users if done(user)})
            if not users:
                self._built.pop(form, None)
        if not self.users["layers"]:
            self._move_layers(HOST)

    def _move_layers(self, device: torch.device) -> None:
        for i, layer in enumerate(self._layers):
            if layer.qkv.device != device:
                self._layers[i] = layer_on(layer, device)


def layer_on(layer: GemmaLayer[Any], device: torch.device) -> GemmaLayer[Any]:
    """The layer with all its tensors on the device."""
    return replace(layer, **{name: value.to(device) for name, value in vars(layer).items() if value is not None})
