"""SmolVLA's plan: vision by the engine's layers, the text layers in merged matrices, the whole denoising loop in the
portable kernel. What a CUDA graph captures: shapes are static, and nothing is copied to the host.

A prefix is compact: images, the prompt's tokens, the state, then padding; `length`, in device memory, says where that
begins.

Shapes: B observations, S places of a prefix with its padding, L layers of the expert, D its width, A action_dim, N
steps, G key heads, K head_dim.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import gcd
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbopi.config import GemmaConfig
from turbopi.engine.forward import HEAD_LAYERS, Rope, VisionByOps
from turbopi.engine.weight_placement import WeightPlacement, in_whole_lines
from turbopi.kernels.interface import Affine, GemmaLayer, Ops, VisionLayer, VisionStream
from turbopi.kernels.portable.denoise.kernel import Mixing, PortableDenoiser
from turbopi.kernels.portable.denoise.packing import Form, PackedExpert, refusal_of_sizes
from turbopi.kernels.portable.grouped import grouped_attention, rope_grouped, swiglu
from turbopi.kernels.portable.quantize import by_plan
from turbopi.models.observation import Observation
from turbopi.models.pi0.denoise import time_grid
from turbopi.models.pi0.layers import rope_tables
from turbopi.models.pi0.vision import EncoderLayer, normalize_images
from turbopi.models.smolvla.config import ROPE_BASE, SmolVLAConfig
from turbopi.models.smolvla.reference import Layer, SmolVLAModel, pixel_shuffle
from turbopi.quantization.fp8 import Matrix, ScaledMatrix, input_of
from turbopi.quantization.nvfp4 import Nvfp4Matrix
from turbopi.quantization.plan import PrecisionPlan


def refusal(config: SmolVLAConfig) -> str | None:
    """Why the kernels can't run this network, or None if they can."""
    if config.text.head_dim < 16 or config.vision.head_dim < 16:
        return "heads are narrower than a tensor core's 16 columns"
    return refusal_of_sizes(ExpertSizes.of(config).expert)


class Placement(WeightPlacement):
    """Where a checkpoint is read to: all on the device, parts of merged matrices in their places. Vision and connector
    come in the dtype that they are packed in, whatever the config says: nothing else reads them.
    """

    def __init__(self, config: Any, device: torch.device, packed: torch.dtype) -> None:
        super().__init__(config, device, on_host=lambda name: False)
        self._packed = packed

    def __call__(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        return super().__call__(name, shape, self._packed if name.startswith(("vision.", "projector.")) else dtype)


# -- vision -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Vision:
    """SigLIP and the connector.

    positions  [patches, W]: the position table at the grid of an image
    """

    model: SmolVLAModel
    ops: Ops
    layers: list[VisionLayer]
    patch: Affine
    positions: Tensor
    norm: Affine
    projector: Tensor

    @classmethod
    def pack(cls, model: SmolVLAModel, ops: Ops, dtype: torch.dtype, plan: PrecisionPlan | None = None) -> "Vision":
        """plan: in what the layers' matrices are, None: all in `dtype`; the model loses those that are rounded."""
        vision, side = model.vision, model.config.image_size // model.config.vision.patch_size
        weight, bias = _affine(vision.patch_embedding, dtype)
        layers = [_vision_layer(layer, dtype, plan, i) for i, layer in enumerate(vision.layers)]  # type: ignore[arg-type]
        norm = _affine(vision.post_layernorm, dtype)
        positions = vision.positions(side, side).to(dtype)
        return cls(model, ops, layers, (weight.flatten(1), bias), positions, norm, model.projector.weight.to(dtype))

    def __call__(self, images: Tensor, head_ends: Callable[[], None] = lambda: None) -> Tensor:
        """float32[V, S, S, 3] in [-1, 1] -> [V, T, D of the text layers], unscaled. head_ends: `engine.graph.HEAD`."""
        config, ops, (count, height) = self.model.config, self.ops, images.shape[:2]
        vision, by_layer = config.vision, ops.vision or VisionByOps(ops)
        heads, eps = vision.num_heads, vision.layer_norm_eps
        stream = VisionStream(self._embed(images).flatten(0, 1))
        matrices = [*(layer.qkv[0] for layer in self.layers[1:]), self.projector]
        for number, (layer, behind) in enumerate(zip(self.layers, matrices, strict=True)):
            if number == HEAD_LAYERS:
                head_ends()
            stream = by_layer.layer(layer, stream, images=count, heads=heads, eps=eps, following=behind)
        _, normed = ops.residual_layer_norm(by_layer.finish(stream, self.norm, eps), None, *self.norm, eps)
        patches = normed.view(count, -1, vision.width)
        return ops.linear(pixel_shuffle(patches, height // vision.patch_size, config.scale_factor), self.projector)

    def _embed(self, images: Tensor) -> Tensor:
        """[V, patches, W]"""
        p, (count, side) = self.model.config.vision.patch_size, images.shape[:2]
        if rest := side % p:  # pixels beside whole patches
            images = images[:, : side - rest, : side - rest].contiguous()
        pixels = normalize_images(images).view(count, side // p, p, side // p, p, 3).permute(0, 1, 3, 5, 2, 4)
        patches = self.projector.new_empty(pixels.shape).copy_(pixels)  # both in one kernel
        return F.linear(patches.view(count, -1, 3 * p * p), *self.patch) + self.positions


def _affine(module: Any, dtype: torch.dtype) -> Affine:
    return module.weight.to(dtype), module.bias.to(dtype)


def _merged(modules: Sequence[nn.Linear], dtype: torch.dtype) -> Tensor:
    """Their weights one below the other. Of this dtype they lie in there alone from then on, and stay there, as a
    captured graph may read them.
    """
    weights = [one.weight for one in modules]
    first, rows = weights[0], [len(weight) for weight in weights]
    ends = [weight.data_ptr() + weight.nbytes for weight in weights]
    beside = all(weight.data_ptr() == end for weight, end in zip(weights[1:], ends, strict=False))
    if first.dtype == dtype and beside and len({weight.untyped_storage().data_ptr() for weight in weights}) == 1:
        return first.detach().as_strided((sum(rows), first.shape[1]), first.stride())
    whole = torch.cat([weight.detach().to(dtype) for weight in weights])
    for weight, part in zip(weights, torch.split(whole, rows), strict=True):
        if weight.dtype == dtype:
            weight.data = part
    return whole


def _made(plan: PrecisionPlan | None, place: str, *modules: nn.Linear, dtype: torch.dtype) -> Matrix:
    """Their weights, `_merged`, as the plan has them. Of rounded ones the modules keep nothing: nobody reads them."""
    made = by_plan(plan, place, _merged(modules, dtype))
    assert not isinstance(made, Nvfp4Matrix), "a backend's precisions say what it has"
    if isinstance(made, ScaledMatrix):
        for one in modules:
            one.weight.data = one.weight.data.new_empty(0)
    return made


def _vision_layer(layer: EncoderLayer, dtype: torch.dtype, plan: PrecisionPlan | None, number: int) -> VisionLayer:
    attention, mlp = layer.self_attn, layer.mlp
    projections = (attention.q_proj, attention.k_proj, attention.v_proj)

    def matrix(kind: str, *modules: nn.Linear) -> Matrix:
        return _made(plan, f"vision.{number}.{kind}", *modules, dtype=dtype)

    fc1, fc2 = in_whole_lines(matrix("fc1", mlp.fc1), matrix("fc2", mlp.fc2))
    return VisionLayer(
        norm1=_affine(layer.layer_norm1, dtype),
        qkv=(matrix("qkv", *projections), torch.cat([one.bias.to(dtype) for one in projections])),
        out=(matrix("out", attention.out_proj), attention.out_proj.bias.to(dtype)),
        norm2=_affine(layer.layer_norm2, dtype),
        fc1=(fc1, F.pad(mlp.fc1.bias.to(dtype), (0, fc1.shape[0] - len(mlp.fc1.bias)))),
        fc2=(fc2, mlp.fc2.bias.to(dtype)),
    )


# -- prefix -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Prefix:
    """The text layers, and what the expert's layers across make of their keys and values.

    every   of the expert's layers each so many-th is a self layer, the first of them; 0: none is
    across  the others, by their places among so many, and their matrices [2 layers, G K, G K], keys' before values'
    """

    model: SmolVLAModel
    ops: Ops
    layers: list[GemmaLayer[Any]]
    every: int
    across: list[tuple[slice, Tensor]]
    special: tuple[Tensor, Tensor]  # embeddings around each image, [start or end tokens, D]
    scale: float  # of images' embeddings
    _numbered: dict[tuple[int, int], tuple[Tensor, Rope]] = field(default_factory=dict)

    @classmethod
    def pack(cls, model: SmolVLAModel, ops: Ops, dtype: torch.dtype, plan: PrecisionPlan | None = None) -> "Prefix":
        """plan: as of `Vision`"""
        config, embed, every = model.config, model.vlm.embed_tokens, form(model.config).self_every

        def matrices(its: slice) -> Tensor:
            of = [layer.self_attn for layer in model.expert.layers[its]]
            both = [one.k_proj for one in of] + [one.v_proj for one in of]
            return torch.stack([one.weight.to(dtype).T for one in both])

        others = [slice(first, None, every) for first in range(1, every)] if every else [slice(None)]
        across = [(its, matrices(its)) for its in others if model.expert.layers[its]]
        start, end = (
            embed(torch.tensor(ids, dtype=torch.int64, device=model.device)).to(dtype)
            for ids in (config.image_start, config.image_end)
        )
        scale = float(torch.tensor(config.text.width**0.5, dtype=dtype))  # rounded, as LeRobot's is
        layers = [joined(layer, dtype, plan, f"prefix.{i}") for i, layer in enumerate(model.vlm.layers)]
        return cls(model, ops, layers, every, across, (start, end), scale)

    def places(self, cameras: int) -> int:
        """S for so many cameras."""
        return self.before_prompt(cameras) + self.model.config.max_prompt_tokens + 1

    def numbered(self, batch: int, places: int) -> tuple[Tensor, Rope]:
        """int64[S], and RoPE's tables at the places of B prefixes. They are made once, by a graph's first run: what it
        captures later has none of these kernels.
        """
        if (batch, places) not in self._numbered:
            at = torch.arange(places, device=self.model.device)
            self._numbered[batch, places] = at, rope_at(at.repeat(batch), self.model.config)
        return self._numbered[batch, places]

    def before_prompt(self, cameras: int) -> int:
        config = self.model.config
        image = (config.image_size // config.vision.patch_size // config.scale_factor) ** 2
        return cameras * (image + sum(map(len, self.special)))

    def embed(self, images: Tensor, tokens: Tensor, state: Tensor, length: Tensor) -> Tensor:
        """[S, D] of image embeddings [V, T, D], tokens int64[max_prompt_tokens], whatever they are behind the prompt's
        end, and state float32[1, A]. length int64[1]: of the prefix, with the state.
        """
        x = self._all_places(images[None], tokens[None], state)[0]
        return x.index_copy_(0, length - 1, x[-1:].clone())

    def embed_several(self, images: Tensor, observations: Observation) -> tuple[Tensor, Tensor]:
        """[B * S, D] of image embeddings [B * V, T, D], and int64[B], how long each prefix is.

        Cameras and places of the prompt may be missing: a prefix's valid places come first, in their order.
        """
        batch, cameras = observations.image_mask.shape
        x = self._all_places(images.view(batch, cameras, *images.shape[1:]), observations.tokens, observations.state)
        there = observations.image_mask.repeat_interleave(self.before_prompt(1), dim=1)
        valid = torch.cat((there, observations.token_mask, there.new_ones(batch, 1)), dim=1)
        lengths = valid.sum(1)
        behind = lengths[:, None] + (~valid).cumsum(1)
        first = torch.arange(batch, device=x.device)[:, None] * x.shape[1]
        to = first + torch.where(valid, valid.cumsum(1), behind) - 1
        x = x.flatten(0, 1)
        return torch.empty_like(x).index_copy_(0, to.flatten(), x), lengths

    def _all_places(self, images: Tensor, tokens: Tensor, state: Tensor) -> Tensor:
        """[B, S, D] of [B, V, T, D], [B, max_prompt_tokens] and [B, A], the state's place last."""
        model, batch = self.model, len(tokens)
        start, end = (one.expand(batch, -1, -1) for one in self.special)
        parts = [part for image in (images * self.scale).unbind(1) for part in (start, image, end)]
        prompt = model.vlm.embed_tokens(tokens) * model.config.text.width**0.5
        of_state = model.state_proj(state)[:, None]
        return torch.cat((*parts, prompt.to(images.dtype), of_state.to(images.dtype)), dim=1)

    def keys_values(self, x: Tensor, lengths: Tensor) -> Tensor:
        """Each text layer's keys, rotated, and values, [2, layer, G, B * S, K], of embeddings [B * S, D]."""
        text, ops, batch = self.model.config.text, self.ops, len(lengths)
        _, rope = self.numbered(batch, len(x) // batch)
        k, v = made = x.new_empty(2, text.depth, text.num_kv_heads, len(x), text.head_dim)
        y, eps = None, text.rms_norm_eps
        for i, layer in enumerate(self.layers):
            x, normed = ops.residual_rms_norm(x, y, None, layer.norm1, None, eps, **input_of(layer.qkv))
            last = i + 1 == len(self.layers)  # its keys and values alone are read
            matrix = layer.qkv[-2 * text.num_kv_heads * text.head_dim :] if last else layer.qkv
            q = rope_grouped(ops.linear(normed, matrix), *rope, k[i], v[i])
            if not last:
                attended = grouped_attention(q, k[i], v[i], lengths, **input_of(layer.out, x))
                x, y = behind_attention(ops, layer, x, attended, eps)
        return made

    def of_expert(self, keys_values: Tensor) -> Tensor:
        """What each of the expert's layers attends to of them, [2, L, G, B * S, K], contiguous."""
        cached = keys_values[:, :: self.model.config.expert_every]
        if not self.across:
            return cached.contiguous()
        made = torch.empty_like(cached, memory_format=torch.contiguous_format)
        if self.every:
            made[:, :: self.every] = cached[:, :: self.every]
        for its, matrices in self.across:
            to = made[:, its].transpose(2, 3)  # [2, layers, B * S, G, K]
            rows = cached[:, its].transpose(2, 3).reshape(len(matrices), -1, matrices.shape[1])
            to.copy_((rows @ matrices).view(to.shape))
        return made


def rope_at(positions: Tensor, config: SmolVLAConfig) -> Rope:
    """cos and sin float32[*positions, K/2]"""
    cos, sin = rope_tables(positions[None], config.text.head_dim, ROPE_BASE)
    return cos[0, 0], sin[0, 0]


def behind_attention(
    ops: Ops, layer: GemmaLayer[Any], x: Tensor, attended: Tensor, eps: float
) -> tuple[Tensor, Tensor]:
    """The rest of a layer: the residual stream [rows, D], and what the next norm adds to it."""
    y = ops.residual_linear(attended, layer.out)
    x, normed = ops.residual_rms_norm(x, y, None, layer.norm2, None, eps, **input_of(layer.gate_up))
    hidden = swiglu(ops.linear(normed, layer.gate_up), **input_of(layer.down, x))
    return x, ops.residual_linear(hidden, layer.down)


# -- the expert -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ExpertSizes:
    """Of the expert, as the kernel reads them."""

    expert: GemmaConfig
    action_dim: int
    rms_norm_eps: float
    rope_base: float = ROPE_BASE

    @classmethod
    def of(cls, config: SmolVLAConfig) -> "ExpertSizes":
        return cls(config.expert, config.action_dim, config.text.rms_norm_eps)


def form(config: SmolVLAConfig) -> Form:
    every = 1 if config.self_every is None else config.self_every
    self_every = every // gcd(every, config.expert_every) if every else 0
    return Form(modulated=False, self_every=self_every, causal=True, silu=True)


@dataclass(frozen=True)
class Expert:
    """The expert's weights for the kernel, of any number of steps.

    table  float32[1, 2L + 1, 3, D]: of each norm its weight, a shift of 0, a gate of 1
    """

    packed: PackedExpert
    table: Tensor
    model: SmolVLAModel

    @classmethod
    def pack(cls, model: SmolVLAModel, plan: PrecisionPlan | None = None) -> "Expert":
        """plan: in what its matrices are; None: in bfloat16"""
        config, layers = model.config, model.expert.layers
        norms = [norm for layer in layers for norm in (layer.input_layernorm, layer.post_attention_layernorm)]
        scale = torch.stack([norm.weight.float() for norm in (*norms, model.expert.norm)])
        table = torch.stack((scale, torch.zeros_like(scale), torch.ones_like(scale)), dim=1)[None]
        one_by_one = (joined(layer, torch.bfloat16) for layer in layers)
        rounded: dict[str, Any] = {}
        if plan is not None and plan.expert != "bf16":
            rounded = {"inputs": plan.scales, "directions": plan.directions, "format": plan.format}
        packed = PackedExpert.pack(ExpertSizes.of(config), one_by_one, form=form(config), **rounded)
        return cls(packed, table, model)

    def denoiser(
        self, num_steps: int, *, cache_rows: int, suffix: int, device: torch.device, **launch: Any
    ) -> PortableDenoiser:
        """cache_rows: S, of what it attends to. launch: as `PortableDenoiser` takes it."""
        ends = {"action_in_proj": self.model.action_in_proj, "action_out_proj": self.model.action_out_proj}
        small = {f"{name}.{part}": getattr(one, part) for name, one in ends.items() for part in ("weight", "bias")}
        sizes: dict[str, Any] = {"cache_rows": cache_rows, "suffix": suffix, "device": device, **launch}
        return PortableDenoiser(
            self.packed.config, self.packed, small, self.table, mixing=self.mixing(num_steps), **sizes
        )

    def mixing(self, num_steps: int) -> Mixing:
        """action_in_proj and the MLP behind it, whose first matrix also meets the time."""
        model = self.model
        into, first, last = model.action_in_proj, model.action_time_mlp_in, model.action_time_mlp_out
        of_actions, of_time = first.weight.double().chunk(2, dim=1)
        times = model.embed_times(time_grid(num_steps, model.config.time_grid)).to(of_time)
        bias = of_actions @ into.bias.double() + first.bias.double()
        return Mixing(
            (of_actions @ into.weight.double()).float(),
            (times @ of_time.T + bias).float(),
            last.weight,
            last.bias.float(),
        )


def joined(layer: Layer, dtype: torch.dtype, plan: PrecisionPlan | None = None, place: str = "") -> GemmaLayer[Any]:
    """A layer across has keys and values of its own, made of the prefix's: their rows here are zeros, which are never
    read.
    """
    of, mlp = layer.self_attn, layer.mlp
    q = of.q_proj.weight.to(dtype)
    across = of.k_proj.weight.shape[1] != q.shape[1]
    none = q.new_zeros(2 * len(of.k_proj.weight), q.shape[1]) if across else q[:0]

    def matrix(kind: str, *modules: nn.Linear) -> Matrix:
        return _made(plan, f"{place}.{kind}", *modules, dtype=dtype)

    return GemmaLayer(
        torch.cat((q, none)) if across else matrix("qkv", of.q_proj, of.k_proj, of.v_proj),
        matrix("out", of.o_proj),
        matrix("gate_up", mlp.gate_proj, mlp.up_proj),
        matrix("down", mlp.down_proj),
        layer.input_layernorm.weight.float(),
        layer.post_attention_layernorm.weight.float(),
    )
