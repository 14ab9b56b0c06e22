"""The least work that a policy's call can do, counted from the sizes: operations, and bytes through device memory.

A stage's floor is the larger of operations / matrix rate and bytes / bandwidth. Norms, RoPE, softmax and launches are
not counted: the floor is what no implementation in that precision gets under, not what one should reach.
"""

from typing import Annotated, Literal

from msgspec import Meta, Struct, field

from turbopi.config import GemmaConfig, ModelConfig, Network
from turbopi.models import family_of

_Count = Annotated[int, Meta(ge=1)]
Join = Literal["none", "held", "identity", "jacobian", "paint"]
JOINS: dict[Join, str] = {  # how a chunk joins a running one (docs/real_time.md), and what the table calls it
    "none": "",
    "held": "the first actions fixed",
    "identity": "guided by the identity",
    "jacobian": "guided by the Jacobian",
    "paint": "its noise chosen",
}
MODEL_SIZE = (224, 224)  # width and height of the images that the model reads


def _written(usual: int) -> int:
    """A field with a default that isn't left out of files: msgspec leaves out none that a function makes."""
    return field(default_factory=lambda: usual)


class Job(Struct, frozen=True, omit_defaults=True):
    """One benchmark point. `prompt_tokens` counts valid tokens, the state's among them.

    writes_tokens  of a model that writes its actions as tokens: `steps` is how many it writes, and `horizon` means
                   nothing; not in files of others
    """

    cameras: _Count = _written(2)
    prompt_tokens: _Count = _written(48)
    horizon: _Count = _written(10)
    steps: _Count = _written(10)
    image_width: _Count = MODEL_SIZE[0]  # of what cameras send; not in files where it is the model's, as in older ones
    image_height: _Count = MODEL_SIZE[1]
    join: Join = "none"  # not in files where it is none
    batch: _Count = 1  # observations of one call; not in files where it is 1
    writes_tokens: bool = False

    def __str__(self) -> str:
        images = f"{self.cameras} cameras{self.of_size}"
        return f"{images}, {self.prompt_tokens} tokens{self.of_horizon}{self.of_batch}, {self.of_steps}{self.joined}"

    @property
    def of_horizon(self) -> str:
        """`H=10` behind a comma; nothing where it means nothing."""
        return "" if self.writes_tokens else f", H={self.horizon}"

    @property
    def unit(self) -> str:
        """Of `steps`."""
        return "tokens written" if self.writes_tokens else "steps"

    @property
    def of_steps(self) -> str:
        return f"{self.steps} {self.unit}"

    @property
    def joined(self) -> str:
        """`guided by …` behind a comma, where a chunk joins another; else nothing."""
        return "" if self.join == "none" else f", {JOINS[self.join]}"

    @property
    def of_batch(self) -> str:
        """`B=8` behind a comma, where a call is for several observations; else nothing."""
        return "" if self.batch == 1 else f", B={self.batch}"

    @property
    def of_size(self) -> str:
        """`of 640x480` behind a space, where images have another size than the model's; else nothing."""
        usual = (self.image_width, self.image_height) == MODEL_SIZE
        return "" if usual else f" of {self.image_width}x{self.image_height}"


class Work(Struct, frozen=True):
    flops: int  # multiply and add counted apart
    bytes: int  # weights read once (denoising: once a step), the KV cache written and read

    def __add__(self, other: "Work") -> "Work":
        return Work(self.flops + other.flops, self.bytes + other.bytes)


def stage_work(config: Network, job: Job, bytes_per_value: int) -> dict[str, Work]:
    """Stage ("vision", "prefix", "denoise") -> its work: compacted, the last prefix layer cut to K and V.

    A batch's observations read the weights together, and each has its own operations and KV cache.
    """
    if not isinstance(config, ModelConfig):
        counts = family_of(config).counts
        assert counts is not None
        stages = counts(config, job.cameras, job.prompt_tokens, job.horizon, job.steps, job.batch)
        return {stage: Work(flops, values * bytes_per_value) for stage, (flops, values) in stages.items()}
    image_tokens = job.cameras * config.vision.num_tokens
    states = config.memory.frames if config.memory is not None and config.memory.proprioceptive else 0
    prefix = image_tokens + states + job.prompt_tokens
    suffix = job.horizon + family_of(config).state_token
    return {
        "vision": _vision(config, image_tokens, job.batch, bytes_per_value),
        "prefix": _prefix(config, prefix, job.batch, bytes_per_value),
        "denoise": _denoise(config, prefix, suffix, job.steps, job.batch, bytes_per_value),
    }


def floor_ms(work: Work, flops_per_second: float, bytes_per_second: float) -> float:
    """The time that no implementation gets under, in milliseconds."""
    return max(work.flops / flops_per_second, work.bytes / bytes_per_second) * 1e3


def _vision(config: ModelConfig, tokens: int, rows: int, value: int) -> Work:
    v = config.vision
    block = 4 * v.width**2 + 2 * v.width * v.mlp_dim
    weights = v.depth * block + 3 * v.patch_size**2 * v.width + v.width * config.vlm.width
    attention = v.depth * 4 * tokens * v.num_tokens * v.width  # q kᵀ and p v, within one image
    work = Work(rows * (2 * tokens * weights + attention), weights * value)
    if config.memory is None or not config.memory.visual:
        return work
    past, every = config.memory.frames - 1, config.memory.temporal_every
    layers = v.depth // every * every  # up to the last temporal one past frames go along
    a_layer = 2 * block + 4 * v.num_tokens * v.width
    more = past * tokens * (layers * a_layer + 2 * 3 * v.patch_size**2 * v.width)
    over_frames = layers // every * tokens * 4 * (past + 1) ** 2 * v.width
    return Work(work.flops + rows * (more + over_frames), work.bytes)


def _layer_weights(g: GemmaConfig) -> tuple[int, int]:
    """Weights of a layer's key and value projections, and of the rest."""
    heads = g.num_heads * g.head_dim
    return 2 * g.width * g.num_kv_heads * g.head_dim, 2 * g.width * heads + 3 * g.width * g.mlp_dim


def _prefix(config: ModelConfig, tokens: int, rows: int, value: int) -> Work:
    g = config.vlm
    kv, rest = _layer_weights(g)
    weights = g.depth * kv + (g.depth - 1) * rest
    attention = (g.depth - 1) * 4 * tokens**2 * g.num_heads * g.head_dim
    cache = g.depth * 2 * tokens * g.num_kv_heads * g.head_dim
    return Work(rows * (2 * tokens * weights + attention), (weights + rows * cache) * value)


def _denoise(config: ModelConfig, prefix: int, suffix: int, steps: int, rows: int, value: int) -> Work:
    g = config.expert
    kv, rest = _layer_weights(g)
    weights = g.depth * (kv + rest) + 2 * config.action_dim * g.width
    attention = g.depth * 4 * suffix * (prefix + suffix) * g.num_heads * g.head_dim
    cache = g.depth * 2 * prefix * g.num_kv_heads * g.head_dim
    return Work(steps * rows * (2 * suffix * weights + attention), steps * (weights + rows * cache) * value)
