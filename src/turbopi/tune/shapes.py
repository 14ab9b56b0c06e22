"""The operations of a model's calls that have a choice of tiles, with their sizes and how often a call runs them.

Kept apart from kernels and GPUs. Shapes as in engine/forward.py: D width, F hidden width of an MLP, K head_dim.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from turbopi.config import ModelConfig, Network, VisionConfig
from turbopi.engine.call import places_of_parts
from turbopi.engine.forward import HEAD_LAYERS, row_chunks
from turbopi.engine.plan import BUCKET, bucket
from turbopi.kernels.sm90.attention.suffix_tile import takes
from turbopi.kernels.tile_table import Kernels, Numbers, TileKey, whole_64
from turbopi.models import family_of
from turbopi.models.smolvla.config import SmolVLAConfig
from turbopi.quantization.fp8 import whole_lines
from turbopi.support.errors import ConfigError

Precision = Literal["bf16", "fp8"]
Norm = Literal["layer", "rms"]


@dataclass(frozen=True)
class Call:
    """A policy's call. prompt_tokens: of each observation, already rounded up to its bucket."""

    cameras: int
    prompt_tokens: int
    batch: int = 1

    def __str__(self) -> str:
        several = f", {self.batch} observations" if self.batch > 1 else ""
        return f"{self.cameras} cameras, {self.prompt_tokens} tokens{several}"


@dataclass(frozen=True)
class Operation:
    """One operation of a call.

    rows       of its result; of attention tokens
    uses       how often a call runs it
    out_fp8    whether its result leaves in E4M3
    images     of vision's attention
    batch      observations of its call; of vision 1, as nothing depends on them
    prefix_rows  of the expert's operations: rows of each observation's prefix
    norm_in_front  a kernel of its own, which makes the input from the residual stream
    norm_behind    likewise; adds the result to the residual stream
    normed     whether the product itself takes the LayerNorm of its input: see `tune.hopper.resolved`
    adds       whether a whole product is added to the residual stream in place: see there
    """

    name: str
    kernels: Kernels
    operation: str
    numbers: Numbers
    rows: int
    columns: int
    inner: int
    uses: int
    bias: bool = False
    out_fp8: bool = False
    images: int = 0
    batch: int = 1
    prefix_rows: int = 0
    norm_in_front: Norm | None = None
    norm_behind: Norm | None = None
    normed: bool = False
    adds: bool = False

    @property
    def key(self) -> TileKey:
        return TileKey(self.kernels, self.operation, self.numbers, whole_64(self.rows), self.columns, self.inner)

    @property
    def in_layers(self) -> bool:
        """Whether it is timed within the expert's layers: see `tune.in_layers`."""
        return self.name.startswith("expert")

    @property
    def size(self) -> str:
        return f"{self.rows} x {self.columns} x {self.inner}"


def calls(config: Network, cameras: Sequence[int], prompts: Sequence[int], batches: Sequence[int]) -> list[Call]:
    """Every combination, the first prompt length of all of them first: what matters most.

    Without `prompts` those of one observation are of every length, those of batches of the usual one.
    """
    lengths = dict.fromkeys(bucket(tokens) for tokens in prompts) or every_prompt(config)
    return [
        Call(count, tokens, batch)
        for place, tokens in enumerate(lengths)
        for batch in batches
        for count in cameras
        if prompts or place == 0 or batch == 1
    ]


def every_prompt(config: Network) -> list[int]:
    """All buckets, that of the usual 48 tokens first."""
    longest = bucket(config.max_prompt_tokens)
    usual = min(48, longest)
    return [usual, *(tokens for tokens in range(BUCKET, longest + 1, BUCKET) if tokens != usual)]


def operations(
    config: Network, call: Call, precision: Precision, kernels: Kernels, *, steps: int = 10, horizon: int = 10
) -> list[Operation]:
    """Those of one call whose tiles can be chosen. `horizon` and `steps` matter to batches alone.

    Raises ConfigError for a family that has none.
    """
    if isinstance(config, SmolVLAConfig):
        found = [*_smolvla(config, call, precision, kernels, steps, horizon)]
        return [one for one in found if _has_choice(one)]
    if not isinstance(config, ModelConfig):
        raise ConfigError(f"{family_of(config).label} runs no operations whose tiles can be chosen")
    found = [*_vision(config, call, precision, kernels), *_prefix(config, call, precision, kernels)]
    if call.batch > 1:
        found += _expert(config, call, precision, kernels, steps, horizon + family_of(config).state_token)
    return [one for one in found if _has_choice(one)]


def distinct(found: Sequence[Operation]) -> list[Operation]:
    """Each key once, as it first came."""
    return list({one.key: one for one in reversed(found)}.values())[::-1]


def _has_choice(one: Operation) -> bool:
    """The portable kernels leave bfloat16's products to the library, but for GeGLU. Sizes must be whole 16."""
    if one.operation.endswith("_attention"):
        return one.inner >= 16
    aligned = one.columns % 16 == 0 and one.inner % 16 == 0
    return aligned and (one.kernels == "hopper" or one.numbers != "bf16" or one.operation == "geglu")


def _vision(config: ModelConfig, call: Call, precision: Precision, kernels: Kernels) -> Iterator[Operation]:
    v = config.vision
    for images, layers in _image_parts(config, call.cameras * call.batch):
        yield from _vision_layers(v, images, v.num_tokens, layers, precision, kernels)
        if images == call.cameras * call.batch:
            linear, rows = "bias" if kernels == "hopper" else "plain", images * v.num_tokens
            projector = Operation("projector", kernels, linear, "bf16", rows, config.vlm.width, v.width, 1, bias=True)
            yield replace(projector, norm_in_front="layer")


def _vision_layers(
    v: VisionConfig, images: int, tokens: int, layers: int, precision: Precision, kernels: Kernels
) -> Iterator[Operation]:
    """tokens: of an image"""
    fp8, hopper, rows = precision == "fp8", kernels == "hopper", images * tokens
    linear, residual = ("bias", "residual") if hopper else ("plain", "parts")
    hidden = v.mlp_dim if precision == "bf16" else whole_lines(v.mlp_dim)  # see `engine.weights`
    usual = Operation("", kernels, linear, precision, rows, v.width, v.width, layers, bias=True)
    yield replace(usual, name="vision qkv", columns=3 * v.width, norm_in_front="layer")
    if not hopper:
        attention = replace(usual, operation="vision_attention", numbers="bf16", bias=False, images=images)
        yield replace(attention, name="vision attention", columns=v.num_heads, inner=v.head_dim, out_fp8=fp8)
    yield replace(usual, name="vision out", operation=residual, norm_behind="layer")
    fc1 = replace(usual, name="vision fc1", operation="gelu", columns=hidden, out_fp8=fp8)
    yield replace(fc1, norm_in_front="layer")
    yield replace(usual, name="vision fc2", operation=residual, inner=hidden, norm_behind="layer")


def _smolvla(
    config: SmolVLAConfig, call: Call, precision: Precision, kernels: Kernels, steps: int, horizon: int
) -> Iterator[Operation]:
    """Prompts of all lengths have as many places. Connector and actions are in bfloat16 in each precision."""
    v, text, factor = config.vision, config.text, config.scale_factor**2
    images, patches = call.cameras * call.batch, (config.image_size // v.patch_size) ** 2
    yield from _vision_layers(v, images, patches, v.depth, precision, kernels)
    rows = images * patches // factor
    yield Operation("projector", kernels, "plain", "bf16", rows, text.width, factor * v.width, 1)
    around = len(config.image_start) + len(config.image_end)
    rows += images * around + call.batch * (config.max_prompt_tokens + 1)
    heads, kv = text.num_heads * text.head_dim, 2 * text.num_kv_heads * text.head_dim

    def layer(part: str, numbers: Numbers, rows: int, width: int, hidden: int, uses: int) -> Iterator[Operation]:
        usual = Operation("", kernels, "plain", numbers, rows, heads + kv, width, uses, batch=call.batch)
        normed = replace(usual, norm_in_front="rms")
        yield replace(normed, name=f"{part} qkv")
        yield replace(usual, name=f"{part} out", operation="parts", columns=width, inner=heads, norm_behind="rms")
        yield replace(normed, name=f"{part} gate, up", columns=2 * hidden)
        yield replace(usual, name=f"{part} down", operation="parts", columns=width, inner=hidden, norm_behind="rms")

    qkv, *others = layer("prefix", precision, rows, text.width, text.mlp_dim, text.depth - 1)
    yield from (qkv, replace(qkv, name="prefix last k, v", columns=kv, uses=1), *others)
    if call.batch > 1:
        uses = config.expert_depth * steps
        yield from layer("actions", "bf16", call.batch * horizon, config.expert_width, config.expert_mlp, uses)


def _image_parts(config: ModelConfig, images: int) -> Iterator[tuple[int, int]]:
    """(how many images, layers that run over so many): see `engine.forward.vision_tokens`."""
    parts = Counter(place.stop - place.start for place in places_of_parts(images))
    if parts.total() == 1:
        yield images, config.vision.depth
    elif parts:
        yield images, config.vision.depth - HEAD_LAYERS
        for size, count in parts.items():
            yield size, count * HEAD_LAYERS


def _prefix(config: ModelConfig, call: Call, precision: Precision, kernels: Kernels) -> Iterator[Operation]:
    g, fp8 = config.vlm, precision == "fp8"
    rows = call.batch * (call.cameras * config.vision.num_tokens + call.prompt_tokens)
    heads, width = g.num_heads * g.head_dim, g.width
    if kernels == "portable":
        kind, uses = "prefix_attention" if call.batch == 1 else "packed_attention", g.depth - 1
        attention = Operation("prefix attention", kernels, kind, "bf16", rows, g.num_heads, g.head_dim, uses)
        yield replace(attention, batch=call.batch, out_fp8=fp8)
    for size, count in Counter(chunk.stop - chunk.start for chunk in row_chunks(rows)).items():
        uses = (g.depth - 1) * count
        columns = heads + 2 * g.head_dim
        usual = Operation("", kernels, "plain", precision, size, columns, width, uses, batch=call.batch)
        normed = replace(usual, norm_in_front="rms")
        yield replace(normed, name="prefix qkv")
        yield replace(normed, name="prefix last k, v", columns=2 * g.head_dim, uses=count)
        yield replace(usual, name="prefix out", operation="parts", columns=width, inner=heads, norm_behind="rms")
        yield replace(normed, name="prefix gate, up", operation="geglu", columns=g.mlp_dim, out_fp8=fp8)
        yield replace(usual, name="prefix down", operation="parts", columns=width, inner=g.mlp_dim, norm_behind="rms")


def _expert(
    config: ModelConfig, call: Call, precision: Precision, kernels: Kernels, steps: int, tokens: int
) -> Iterator[Operation]:
    """Of a batch, whose denoising is operations."""
    g, fp8, rows = config.expert, precision == "fp8", call.batch * tokens
    heads, width, uses = g.num_heads * g.head_dim, g.width, g.depth * steps
    prefix = call.cameras * config.vision.num_tokens + call.prompt_tokens
    usual = Operation("", kernels, "plain", precision, rows, heads + 2 * g.head_dim, width, uses, batch=call.batch)
    usual = replace(usual, prefix_rows=prefix)
    normed = replace(usual, norm_in_front="rms")
    yield replace(normed, name="expert qkv")
    attention = replace(usual, kernels="portable", operation="suffix_attention", numbers="bf16", out_fp8=fp8)
    if kernels == "portable" or not takes(g.head_dim):
        yield replace(attention, name="expert attention", columns=g.num_heads, inner=g.head_dim)
    yield replace(usual, name="expert out", operation="parts", columns=width, inner=heads, norm_behind="rms")
    yield replace(normed, name="expert gate, up", operation="geglu", columns=g.mlp_dim, out_fp8=fp8)
    yield replace(usual, name="expert down", operation="parts", columns=width, inner=g.mlp_dim, norm_behind="rms")
