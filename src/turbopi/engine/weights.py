"""A checkpoint's tensors as the engine wants them: matrices that share an input are packed into one, layer by layer.

Packing takes tensors out of the state as it goes, so that the device never holds more than one layer twice.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.model.denoise import time_embedding, time_grid

State = dict[str, Tensor]
Affine = tuple[Tensor, Tensor]  # weight [out, in], bias [out]; of a LayerNorm: weight, bias [W]


@dataclass(frozen=True)
class VisionLayer:
    norm1: Affine
    qkv: Affine  # [3W, W], [3W]
    out: Affine
    norm2: Affine
    fc1: Affine
    fc2: Affine


@dataclass(frozen=True)
class GemmaLayer:
    """One layer of either stack. The norms are float32[D], 1 + scale; None where adaRMS replaces them."""

    qkv: Tensor  # [(heads + 2) * K, D]
    out: Tensor  # [D, heads * K]
    gate_up: Tensor  # [2F, D]: gate rows, then up rows
    down: Tensor  # [D, F]
    norm1: Tensor | None
    norm2: Tensor | None


@dataclass(frozen=True)
class Weights:
    """Everything the engine reads, on its device, plus the host's copy of what only depends on the number of steps."""

    patch: Tensor  # float32[W, 3 * 14 * 14]
    position: Tensor  # float32[256, W], with the patch bias added
    vision: list[VisionLayer]
    post_layernorm: Affine
    projector: Affine
    embed_tokens: Tensor  # [vocab, D]
    vlm: list[GemmaLayer]
    expert: list[GemmaLayer]
    expert_norm: Tensor | None  # float32[D], 1 + scale; None: adaRMS
    small: State  # action, state and time projections, float32
    conditioning: State  # Pi0.5: time MLP and adaRMS matrices, float32, on the host: see `modulation`


def pack(config: ModelConfig, state: State) -> Weights:
    """Pack a checkpoint's tensors (canonical names); `state` is emptied."""

    def affine(name: str) -> Affine:
        return state.pop(f"{name}.weight"), state.pop(f"{name}.bias")

    conditioning = {
        name: state.pop(name).cpu()
        for name in sorted(state)
        if ".dense." in name or (config.kind == "pi05" and name.startswith("time_mlp_"))
    }
    patch_weight, patch_bias = affine("vision.patch_embedding")
    state.pop("vlm.norm.weight")  # would change no key and no value
    weights = Weights(
        patch=patch_weight.flatten(1),
        position=state.pop("vision.position_embedding.weight") + patch_bias,
        vision=list(_vision_layers(config, state)),
        post_layernorm=affine("vision.post_layernorm"),
        projector=affine("projector"),
        embed_tokens=state.pop("vlm.embed_tokens.weight"),
        vlm=list(_gemma_layers(config, state, "vlm")),
        expert=list(_gemma_layers(config, state, "expert")),
        expert_norm=_scale(state, "expert.norm"),
        small={name: state.pop(name) for name in list(state) if name.startswith(("action_", "state_proj."))},
        conditioning=conditioning,
    )
    assert not state, f"tensors that the engine doesn't know: {sorted(state)}"
    return weights


def _vision_layers(config: ModelConfig, state: State) -> Iterator[VisionLayer]:
    for i in range(config.vision.depth):
        prefix = f"vision.layers.{i}"
        projections = [f"{prefix}.self_attn.{p}_proj" for p in "qkv"]

        def affine(name: str, prefix: str = prefix) -> Affine:
            return state.pop(f"{prefix}.{name}.weight"), state.pop(f"{prefix}.{name}.bias")

        yield VisionLayer(
            norm1=affine("layer_norm1"),
            qkv=(
                torch.cat([state.pop(f"{p}.weight") for p in projections]),
                torch.cat([state.pop(f"{p}.bias") for p in projections]),
            ),
            out=affine("self_attn.out_proj"),
            norm2=affine("layer_norm2"),
            fc1=affine("mlp.fc1"),
            fc2=affine("mlp.fc2"),
        )


def _gemma_layers(config: ModelConfig, state: State, stack: str) -> Iterator[GemmaLayer]:
    for i in range(config.vlm.depth):
        prefix = f"{stack}.layers.{i}"
        yield GemmaLayer(
            qkv=torch.cat([state.pop(f"{prefix}.self_attn.{p}_proj.weight") for p in "qkv"]),
            out=state.pop(f"{prefix}.self_attn.o_proj.weight"),
            gate_up=torch.cat([state.pop(f"{prefix}.mlp.{p}_proj.weight") for p in ("gate", "up")]),
            down=state.pop(f"{prefix}.mlp.down_proj.weight"),
            norm1=_scale(state, f"{prefix}.input_layernorm"),
            norm2=_scale(state, f"{prefix}.post_attention_layernorm"),
        )
        # gate and up leave two holes that the packed matrix, twice their size, can't fill: 2.4 GB at full size
        if torch.cuda.is_available():
            torch.cuda.empty_cache()


def _scale(state: State, name: str) -> Tensor | None:
    weight = state.pop(f"{name}.weight", None)
    return None if weight is None else 1 + weight.float()


def modulation(config: ModelConfig, conditioning: State, num_steps: int) -> Tensor | None:
    """adaRMS of a whole denoising loop, on the host: float32[N, 2 * layers + 1, 3, D].

    It depends on nothing but the number of steps. Norms in order of use: two a layer, then the final one; each has
    1 + scale, shift and gate. None for Pi0, which has no adaRMS.
    """
    if config.kind == "pi0":
        return None

    def linear(name: str, x: Tensor) -> Tensor:
        return F.linear(x, conditioning[f"{name}.weight"], conditioning[f"{name}.bias"])

    times = time_embedding(time_grid(num_steps, config.time_grid), config.expert.width)
    cond = F.silu(linear("time_mlp_out", F.silu(linear("time_mlp_in", times))))
    layers = [f"expert.layers.{i}" for i in range(config.expert.depth)]
    norms = [f"{layer}.{norm}" for layer in layers for norm in ("input_layernorm", "post_attention_layernorm")]
    rows = [linear(f"{norm}.dense", cond).view(num_steps, 3, -1) for norm in (*norms, "expert.norm")]
    table = torch.stack(rows, dim=1)
    table[:, :, 0] += 1
    return table
