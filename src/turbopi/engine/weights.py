"""A checkpoint's tensors as the engine wants them: matrices that share an input are packed into one, layer by layer.

Packing takes tensors out of the state as it goes, so that the device never holds more than one layer twice; and if the
state is the host's, no more than one layer as the checkpoint has it. Of a state that was read to a `WeightPlacement`
nothing is there twice.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.engine.graph import empty_cache
from turbopi.engine.weight_placement import GATE_UP, QKV, is_conditioning, join
from turbopi.kernels.interface import Affine, AffineMatrix, AnyMatrix, GemmaLayer, State, VisionLayer
from turbopi.models import family_of
from turbopi.models.pi0.denoise import time_embedding, time_grid
from turbopi.quantization.fp8 import Matrix, ScaledMatrix, whole_lines

MakeMatrix = Callable[[str, Tensor], Matrix]  # by its place, such as "vision.3.fc1" or "prefix.0.qkv"


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

    def __init__(self, state: State, device: torch.device | None) -> None:
        self._state, self._device = state, device

    def __call__(self, name: str) -> Tensor:
        tensor = self._state.pop(name)
        return tensor if self._device is None else tensor.to(self._device)

    def affine(self, name: str) -> Affine:
        return self(f"{name}.weight"), self(f"{name}.bias")

    def joined(self, names: Sequence[str]) -> Tensor:
        return join([self._state.pop(name) for name in names], self._device)

    def scale(self, name: str) -> Tensor | None:
        """1 + a norm's weight, float32; None for adaRMS, which has none."""
        return 1 + self(f"{name}.weight").float() if f"{name}.weight" in self._state else None


def pack(
    config: ModelConfig,
    state: State,
    make: MakeMatrix = _as_it_is,
    *,
    device: torch.device | None = None,
    expert_device: torch.device | None = None,
) -> Weights:
    """Pack a checkpoint's tensors (canonical names); `state` is emptied.

    make    may turn the vision tower's and the prefix's packed matrices, on the device, into others, one by one
    device  where they shall lie; None: where they are
    expert_device  the same for the action expert's layers
    """
    take = _Tensors(state, device)
    conditioning = {name: state.pop(name).cpu() for name in sorted(state) if is_conditioning(config, name)}
    empty_cache()  # of what loading needed besides
    patch_weight, patch_bias = take.affine("vision.patch_embedding")
    state.pop("vlm.norm.weight")  # would change no key and no value
    weights = Weights(
        patch=patch_weight.flatten(1),
        position=take("vision.position_embedding.weight") + patch_bias,
        vision=list(_vision_layers(config, take, make)),
        post_layernorm=take.affine("vision.post_layernorm"),
        projector=take.affine("projector"),
        embed_tokens=take("vlm.embed_tokens.weight"),
        vlm=list(_gemma_layers(config, take, state, "vlm", make)),
        expert=list(_gemma_layers(config, _Tensors(state, expert_device or device), state, "expert", _as_it_is)),
        expert_norm=take.scale("expert.norm"),
        small={name: take(name) for name in list(state) if name.startswith(("action_", "state_proj."))},
        conditioning=conditioning,
    )
    assert not state, f"tensors that the engine doesn't know: {sorted(state)}"
    return weights


def _vision_layers(config: ModelConfig, take: _Tensors, make: MakeMatrix) -> Iterator[VisionLayer]:
    for i in range(config.vision.depth):
        prefix = f"vision.layers.{i}"
        projections = [f"{prefix}.self_attn.{p}" for p in QKV]

        def matrix(kind: str, name: str, i: int = i, prefix: str = prefix) -> AffineMatrix:
            weight, bias = take.affine(f"{prefix}.{name}")
            return make(f"vision.{i}.{kind}", weight), bias

        fc1, fc2 = _in_whole_lines(matrix("fc1", "mlp.fc1"), matrix("fc2", "mlp.fc2"))
        yield VisionLayer(
            norm1=take.affine(f"{prefix}.layer_norm1"),
            qkv=(
                make(f"vision.{i}.qkv", take.joined([f"{p}.weight" for p in projections])),
                take.joined([f"{p}.bias" for p in projections]),
            ),
            out=matrix("out", "self_attn.out_proj"),
            norm2=take.affine(f"{prefix}.layer_norm2"),
            fc1=fc1,
            fc2=fc2,
        )


def _in_whole_lines(fc1: AffineMatrix, fc2: AffineMatrix) -> tuple[AffineMatrix, AffineMatrix]:
    """Both as they are; if both are in eight bits, with hidden columns of zeros up to whole lines of memory.

    With SigLIP's 4,304 hidden columns seven rows of fc2 in eight begin inside a line, and fc2 takes 1.05 to 1.4 times
    as long. GELU of 0 is 0, and 0 adds nothing.
    """
    (first, bias), (second, last_bias) = fc1, fc2
    if not (isinstance(first, ScaledMatrix) and isinstance(second, ScaledMatrix)):
        return fc1, fc2
    (hidden, inner), columns = first.shape, second.shape[0]
    if (wide := whole_lines(hidden)) == hidden:
        return fc1, fc2
    return (first.padded(wide, inner), F.pad(bias, (0, wide - hidden))), (second.padded(columns, wide), last_bias)


def _gemma_layers(
    config: ModelConfig,
    take: _Tensors,
    state: State,
    stack: str,
    make: Callable[[str, Tensor], AnyMatrix],
) -> Iterator[GemmaLayer[AnyMatrix]]:
    for i in range(config.vlm.depth):
        prefix, place = f"{stack}.layers.{i}", f"prefix.{i}"
        if stack == "vlm" and i + 1 == config.vlm.depth:  # nothing but its keys and values is ever used: 0.2 GB
            for name in ("self_attn.o_proj", "mlp.gate_proj", "mlp.up_proj", "mlp.down_proj"):
                state[f"{prefix}.{name}.weight"] = state[f"{prefix}.{name}.weight"][:0].clone()
        qkv = take.joined([f"{prefix}.self_attn.{p}.weight" for p in QKV])
        gate_up = take.joined([f"{prefix}.mlp.{p}.weight" for p in GATE_UP])
        yield GemmaLayer(
            qkv=make(f"{place}.qkv", qkv),
            out=make(f"{place}.out", take(f"{prefix}.self_attn.o_proj.weight")),
            gate_up=make(f"{place}.gate_up", gate_up),
            down=make(f"{place}.down", take(f"{prefix}.mlp.down_proj.weight")),
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
