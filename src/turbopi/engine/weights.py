"""A checkpoint's tensors as the engine wants them: matrices that share an input are packed into one, layer by layer.

Packing takes tensors out of the state as it goes, so that the device never holds more than one layer twice; and if the
state is the host's, no more than one layer as the checkpoint has it. Of a state that was read to a `WeightPlacement`
nothing is there twice.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.checkpoint.matrices import QKV, is_used, matrix_names
from turbopi.config import ModelConfig
from turbopi.engine.graph import empty_cache
from turbopi.engine.weight_placement import AnyMatrix, MakeMatrix, in_whole_lines, is_conditioning, join
from turbopi.kernels.interface import Affine, GemmaLayer, State, VisionLayer
from turbopi.models import family_of
from turbopi.models.pi0.denoise import time_embedding, time_grid
from turbopi.quantization.fp8 import Matrix
from turbopi.quantization.sites import Part


@dataclass(frozen=True)
class Weights:
    """Everything the engine reads, on its device, plus the host's copy of what only depends on the number of steps."""

    patch: Tensor  # float32[W, 3 * 14 * 14]
    position: Tensor  # float32[256, W], with the patch bias added
    vision: list[VisionLayer]
    post_layernorm: Affine
    projector: Affine
    embed_tokens: Tensor  # [vocab, D]
    vlm: list[GemmaLayer[Matrix]]
    expert: list[GemmaLayer[Tensor]]
    expert_norm: Tensor | None  # float32[D], 1 + scale; None: adaRMS
    small: State  # action, state and time projections, float32
    conditioning: State  # Pi0.5: time MLP and adaRMS matrices, float32, on the host: see `modulation`


def _as_it_is(place: str, matrix: Tensor) -> Tensor:
    return matrix


class _Tensors:
    """A checkpoint's, each of which is taken once, and then lies on the device."""

    def __init__(
        self,
        state: State,
        device: torch.device | None,
        make: MakeMatrix = _as_it_is,
        made: dict[str, AnyMatrix] | None = None,
    ) -> None:
        self._state, self._device, self._make, self._made = state, device, make, made or {}

    def __call__(self, name: str) -> Tensor:
        tensor = self._state.pop(name)
        return tensor if self._device is None else tensor.to(self._device)

    def affine(self, name: str) -> Affine:
        return self(f"{name}.weight"), self(f"{name}.bias")

    def joined(self, names: Sequence[str]) -> Tensor:
        return join([self._state.pop(name) for name in names], self._device)

    def matrix(self, config: ModelConfig, part: Part, layer: int, kind: str) -> Any:
        """The one at this place, made into what it shall be, if it isn't yet."""
        place, names = f"{part}.{layer}.{kind}", matrix_names(part, layer, kind)
        if place in self._made:
            return self._made.pop(place)
        if not is_used(config, place):
            self._state |= {name: self._state[name][:0].clone() for name in names if name in self._state}
        if names[0] not in self._state:  # of a folder that keeps what is used
            return torch.empty(0, 0, device=self._device)
        return self._make(place, self(names[0]) if len(names) == 1 else self.joined(names))

    def scale(self, name: str) -> Tensor | None:
        """1 + a norm's weight, float32; None for adaRMS, which has none."""
        return 1 + self(f"{name}.weight").float() if f"{name}.weight" in self._state else None


def pack(
    config: ModelConfig,
    state: State,
    make: MakeMatrix = _as_it_is,
    *,
    made: dict[str, AnyMatrix] | None = None,
    device: torch.device | None = None,
    expert_device: torch.device | None = None,
) -> Weights:
    """Pack a checkpoint's tensors (canonical names); `state` and `made` are emptied.

    make    may turn the vision tower's and the prefix's packed matrices, on the device, into others, one by one
    made    those that a `WeightPlacement` has turned already
    device  where they shall lie; None: where they are
    expert_device  the same for the action expert's layers
    """
    take = _Tensors(state, device, make, made)
    conditioning = {name: state.pop(name).cpu() for name in sorted(state) if is_conditioning(config, name)}
    empty_cache()  # of what loading needed besides
    patch_weight, patch_bias = take.affine("vision.patch_embedding")
    state.pop("vlm.norm.weight")  # would change no key and no value
    weights = Weights(
        patch=patch_weight.flatten(1),
        position=take("vision.position_embedding.weight") + patch_bias,
        vision=list(_vision_layers(config, take)),
        post_layernorm=take.affine("vision.post_layernorm"),
        projector=take.affine("projector"),
        embed_tokens=take("vlm.embed_tokens.weight"),
        vlm=list(_gemma_layers(config, take, "prefix")),
        expert=list(_gemma_layers(config, _Tensors(state, expert_device or device), "expert")),
        expert_norm=take.scale("expert.norm"),
        small={name: take(name) for name in list(state) if name.startswith(("action_", "state_proj."))},
        conditioning=conditioning,
    )
    assert not state and not made, f"tensors that the engine doesn't know: {sorted({*state, *(made or {})})}"
    return weights


def _vision_layers(config: ModelConfig, take: _Tensors) -> Iterator[VisionLayer]:
    for i in range(config.vision.depth):
        prefix, matrix = f"vision.layers.{i}", partial(take.matrix, config, "vision", i)
        fc1, fc2 = in_whole_lines(matrix("fc1"), matrix("fc2"))
        fc1_bias = take(f"{prefix}.mlp.fc1.bias")
        yield VisionLayer(
            norm1=take.affine(f"{prefix}.layer_norm1"),
            qkv=(matrix("qkv"), take.joined([f"{prefix}.self_attn.{p}.bias" for p in QKV])),
            out=(matrix("out"), take(f"{prefix}.self_attn.out_proj.bias")),
            norm2=take.affine(f"{prefix}.layer_norm2"),
            fc1=(fc1, F.pad(fc1_bias, (0, fc1.shape[0] - len(fc1_bias)))),
            fc2=(fc2, take(f"{prefix}.mlp.fc2.bias")),
        )


def _gemma_layers(config: ModelConfig, take: _Tensors, part: Part) -> Iterator[GemmaLayer[Any]]:
    for i in range(config.vlm.depth):
        prefix, matrix = f"{'vlm' if part == 'prefix' else part}.layers.{i}", partial(take.matrix, config, part, i)
        yield GemmaLayer(
            qkv=matrix("qkv"),
            out=matrix("out"),
            gate_up=matrix("gate_up"),
            down=matrix("down"),
            norm1=take.scale(f"{prefix}.input_layernorm"),
            norm2=take.scale(f"{prefix}.post_attention_layernorm"),
        )
        empty_cache()  # of what making them left


def modulation(config: ModelConfig, conditioning: State, num_steps: int) -> Tensor | None:
    """adaRMS of a whole denoising loop, on the host: `modulation_at` the times at which its steps begin."""
    return modulation_at(config, conditioning, time_grid(num_steps, config.time_grid))


def modulation_at(config: ModelConfig, conditioning: State, times: np.ndarray) -> Tensor | None:
    """adaRMS at times float32[U], on the host: float32[U, 2 * layers + 1, 3, D].

    It depends on nothing but the time. Norms in order of use: two a layer, then the final one; each has
    1 + scale, shift and gate. None for Pi0, which has no adaRMS.
    """
    if not family_of(config).modulated:
        return None

    def linear(name: str, x: Tensor) -> Tensor:
        return F.linear(x, conditioning[f"{name}.weight"], conditioning[f"{name}.bias"])

    embedded = time_embedding(times, config.expert.width)
    cond = F.silu(linear("time_mlp_out", F.silu(linear("time_mlp_in", embedded))))
    layers = [f"expert.layers.{i}" for i in range(config.expert.depth)]
    norms = [f"{layer}.{norm}" for layer in layers for norm in ("input_layernorm", "post_attention_layernorm")]
    rows = [linear(f"{norm}.dense", cond).view(len(times), 3, -1) for norm in (*norms, "expert.norm")]
    table = torch.stack(rows, dim=1)
    table[:, :, 0] += 1
    return table
