"""One whole call with fixed shapes: inputs up, vision, prefix, all denoising steps, actions down.

`StaticCall.run` is that sequence of kernels on fixed buffers; on a GPU it is captured in two parts and replayed:
`Images.run`, which needs nothing but images and so starts while the host still tokenises, and `StaticCall.answer`.
Each begins with its inputs' way out of pinned memory, and actions go back there. Where images have other sizes than
the model's, they are copied before the first part. Of many images, a batch's, vision begins with some of them while
the host still copies the others: see `Images.uploads`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from turbopi.config import ImageResize, ModelConfig
from turbopi.engine import forward
from turbopi.engine.backward import Expert, backward_ops, jacobian_step, jacobian_velocity
from turbopi.engine.conditioned import Conditioned, StepTimes
from turbopi.engine.flat import allocate
from turbopi.engine.graph import HEAD, Mark
from turbopi.engine.loops import ConditionedLoop, Loop, SolverLoop
from turbopi.engine.resize import Resizer
from turbopi.engine.weights import Weights
from turbopi.kernels.interface import Denoiser, KeepingDenoiser, Ops
from turbopi.models import family_of
from turbopi.models.pi0.conditioning import Conditioning
from turbopi.models.pi0.denoise import euler_step
from turbopi.preprocess.images import fitted

# Images that are sent together: while the device works on the head of some, the host copies the next ones, which it
# takes 26 us for each (224 x 224, uint8).
PART = 8


def places_of_parts(images: int) -> list[slice]:
    """Which of so many images are sent together."""
    return [slice(first, min(first + PART, images)) for first in range(0, images, PART)]


@dataclass(frozen=True)
class CallShape:
    """What a captured call is fixed to."""

    cameras: int  # valid ones
    prompt_slots: int  # the bucket: valid prompt tokens and padding behind them
    loop: Loop
    float_images: bool = False  # LeRobot's resizing leaves the uint8 grid

    def prefix_slots(self, config: ModelConfig) -> int:
        return self.cameras * config.vision.num_tokens + self.prompt_slots

    def suffix_tokens(self, config: ModelConfig) -> int:
        return self.loop.horizon + family_of(config).state_token

    def cache_rows(self, config: ModelConfig) -> int:
        """Keys of the suffix's attention: the prefix's slots, rows that nothing sees, the suffix's.

        A multiple of 16, since the library's matmuls take 16 bytes at a time or a kernel half as fast.
        """
        return -(-(self.prefix_slots(config) + self.suffix_tokens(config)) // 16) * 16


@dataclass(frozen=True)
class Inputs:
    """All but images: views into one flat buffer, on the host or on the device."""

    flat: Tensor  # uint8
    noise: Tensor  # float32[H, action_dim]
    state: Tensor  # float32[action_dim]
    tokens: Tensor  # int64[P]
    length: Tensor  # int64[1]  valid prefix tokens

    @classmethod
    def allocate(cls, config: ModelConfig, shape: CallShape, device: torch.device, *, pinned: bool) -> "Inputs":
        fields = {
            "noise": ((shape.loop.horizon, config.action_dim), torch.float32),
            "state": ((config.action_dim,), torch.float32),
            "tokens": ((shape.prompt_slots,), torch.int64),
            "length": ((1,), torch.int64),
        }
        flat, views = allocate(fields, device, pinned=pinned)
        return cls(flat, **views)

    def arrays(self) -> dict[str, np.ndarray]:
        """The same memory as NumPy's arrays, by name; of a buffer on the host only. Writing through them is cheap."""
        return {name: getattr(self, name).numpy() for name in ("noise", "state", "tokens", "length")}


@dataclass(frozen=True)
class Cache:
    """Keys and values of the largest prefix and suffix that fit; calls of all shapes take views of it in turn."""

    k: Tensor  # [layer, rows, K]
    v: Tensor

    @classmethod
    def allocate(
        cls, config: ModelConfig, rows: int, device: torch.device, dtype: torch.dtype, joint: bool = False
    ) -> "Cache":
        """`joint`: as parts of one tensor."""
        size = (config.vlm.depth, rows, config.vlm.head_dim)
        # NaN: a row that is read before it is written shows
        if joint:
            return cls(*torch.full((2, *size), torch.nan, device=device, dtype=dtype))
        return cls(*(torch.full(size, torch.nan, device=device, dtype=dtype) for _ in range(2)))


class Part:
    """Images of a call that are sent together: their places in pinned memory, and on the device."""

    def __init__(self, host: Tensor, images: Tensor) -> None:
        self.host, self.images, self.resizer = host, images, Resizer(images)
        self._array = host.numpy()

    def fits(self, image: np.ndarray) -> bool:
        """Whether it has the size and dtype of `images`."""
        return image.dtype == self._array.dtype and image.shape == self._array.shape[1:]

    def write(self, images: Sequence[np.ndarray]) -> None:
        """Images as `images` to where `transferred` takes them from."""
        for target, image in zip(self._array, images, strict=True):
            target[:] = image

    def send(self, images: Sequence[np.ndarray], resize: ImageResize) -> None:
        """Images as `images`, or uint8[h, w, 3], to where `resized` takes them from."""
        self.resizer.upload([None if self.fits(one) else one for one in images], resize)
        for camera, image in enumerate(images):
            if self.fits(image):
                self._array[camera] = image
                self.images[camera].copy_(self.host[camera], non_blocking=True)

    def transferred(self, ops: Ops) -> Tensor:
        """`images`, by a kernel, from what `write` has written."""
        ops.transfer(self.host, self.images)
        return self.images

    def resized(self, ops: Ops) -> Tensor:
        """`images`, by a kernel, from what `send` has sent."""
        assert ops.resize_images is not None, "else the host has resized them: `transferred`"
        ops.resize_images(self.resizer.table, self.images)
        return self.images


class Images:
    """The vision stage of every call with so many images, whatever its prompt.

    Args:
        cameras: how many images; with none of them the stage is empty.
        float_images: as `CallShape`'s.
        prompt_slots: the most of any call: `embs` has the cameras' tokens, then space for the prompt's.
        embs: these rows, if they are shared with other calls; None: its own.
    """

    def __init__(
        self,
        config: ModelConfig,
        weights: Weights,
        ops: Ops,
        cameras: int,
        float_images: bool,
        prompt_slots: int,
        embs: Tensor | None = None,
    ) -> None:
        self.config, self.weights, self.ops = config, weights, ops
        self.cameras, self.float_images, self.rows = cameras, float_images, cameras * config.vision.num_tokens
        table, side = weights.embed_tokens, config.vision.image_size
        dims, dtype = (cameras, side, side, 3), torch.float32 if float_images else torch.uint8
        host = torch.zeros(dims, dtype=dtype, pin_memory=table.is_cuda)
        self.images = torch.zeros(dims, dtype=dtype, device=table.device)
        self._places = places_of_parts(cameras)
        self._parts = [Part(host[place], self.images[place]) for place in self._places]
        size = (self.rows + prompt_slots, config.vlm.width)
        # NaN as in `Cache`
        self.embs = torch.full(size, torch.nan, device=table.device, dtype=table.dtype) if embs is None else embs
        assert self.embs.shape == size

    def resizes(self, images: Sequence[np.ndarray], resize: ImageResize | None) -> bool:
        """Whether `run_resized` is needed: some image hasn't the size and dtype of `images`, and the device may
        resize it.
        """
        if resize is None or self.ops.resize_images is None:
            return False
        return not all(self._parts[0].fits(one) for one in images)

    def uploads(
        self, images: Sequence[np.ndarray], resize: ImageResize | None, resized: bool
    ) -> list[Callable[[], None]]:
        """What sends valid images to where `run` or, `resized`, `run_resized` takes them from, without waiting.

        One for each head of the run, to be done before it: see `Graph.launch`. An image is as `images`, or
        uint8[h, w, 3]: then the device resizes it, or the host if the device can't. A wrong one raises; those before it
        may have been sent, and the next call's take the place of them all.
        """
        assert len(images) <= self.cameras, f"{len(images)} images, there is space for {self.cameras}"

        def upload(part: Part, place: slice) -> None:
            these = images[place]
            if resize is None:
                part.write(these)
            elif resized:
                part.send(these, resize)
            else:
                side = self.config.vision.image_size
                part.write([one if part.fits(one) else fitted(one, side, resize) for one in these])

        return [partial(upload, part, place) for part, place in zip(self._parts, self._places, strict=True)]

    def run_resized(self, mark: Mark = lambda stage: None) -> None:
        """Images of which some have other sizes, to the first rows of `embs`."""
        self._encode([partial(part.resized, self.ops) for part in self._parts], mark)

    def run(self, mark: Mark = lambda stage: None) -> None:
        """Images from the host, in place of what is in `images`, to the first rows of `embs`."""
        self._encode([partial(part.transferred, self.ops) for part in self._parts], mark)

    def _encode(self, parts: Sequence[Callable[[], Tensor]], mark: Mark) -> None:
        if parts:
            out = self.embs[: self.rows]
            forward.vision_tokens(self.config, self.weights, self.ops, parts, out, lambda: mark(HEAD))
        mark("vision")


class StaticCall:
    """A call of one shape on buffers of its own; `images`, `cache` and weights are shared with other shapes."""

    def __init__(
        self,
        config: ModelConfig,
        weights: Weights,
        ops: Ops,
        shape: CallShape,
        images: Images,
        cache: Cache,
        table: Tensor | None,  # float32[N, 2 * layers + 1, 3, D], Pi0.5's modulation; a conditioned loop's: [U, …]
    ) -> None:
        self.config, self.weights, self.ops, self.shape, self.images = config, weights, ops, shape, images
        assert (images.cameras, images.float_images) == (shape.cameras, shape.float_images), shape
        device = cache.k.device
        on_gpu = device.type == "cuda"
        suffix, rows = shape.suffix_tokens(config), shape.cache_rows(config)
        assert rows <= cache.k.shape[1], f"{shape} needs {rows} cache rows, there are {cache.k.shape[1]}"
        self.cache_k, self.cache_v = cache.k[:, :rows], cache.v[:, :rows]
        self._unseen = slice(shape.prefix_slots(config), rows - suffix)
        self.denoiser: Denoiser | None = None  # in place of the operations of `denoise`
        self.keeper: KeepingDenoiser | None = None  # in place of the forward operations of guidance by the Jacobian
        self.rope = forward.rope_of_all_positions(config, rows, device)
        self.suffix_offsets = torch.arange(suffix, device=device)
        self.embs = images.embs[: shape.prefix_slots(config)]
        loop = shape.loop
        self.conditioned = Conditioned.allocate(config, loop, device) if isinstance(loop, ConditionedLoop) else None
        self.times = StepTimes.of(config, loop, table, self.conditioned, device)
        self.host = Inputs.allocate(config, shape, torch.device("cpu"), pinned=on_gpu)
        self._arrays = self.host.arrays()
        self.inputs = Inputs.allocate(config, shape, device, pinned=False)
        chunk = (loop.horizon, config.action_dim)
        self.x_t = torch.empty(loop.steps + 1, *chunk, device=device)
        self.v_t = torch.empty(loop.steps, *chunk, device=device)
        self.actions = torch.empty(chunk, pin_memory=on_gpu)
        self.actions_array = self.actions.numpy()

    def write_inputs(
        self,
        noise: np.ndarray,
        state: np.ndarray,
        tokens: np.ndarray,
        conditioning: Conditioning | None = None,
    ) -> None:
        """Put what a call has beside its images into the host buffer: of the tokens the valid ones only.

        `conditioning` is one of the shape's loop.
        """
        arrays = self._arrays
        arrays["noise"][:] = self.started(noise, conditioning)
        arrays["state"][:] = state
        padded = arrays["tokens"]
        padded[: len(tokens)] = tokens
        padded[len(tokens) :] = 0
        arrays["length"][0] = self.images.rows + len(tokens)

    def started(self, noise: np.ndarray, conditioning: Conditioning | None) -> np.ndarray:
        """x float32[H, A] before the first step; the rest of the conditioning goes into the host's buffer."""
        if self.conditioned is None or conditioning is None:
            return noise
        self.conditioned.write(conditioning)
        return conditioning.started(noise)

    def run(self, mark: Mark = lambda stage: None) -> None:
        """All kernels of the call, in order. `mark` is called at the end of each stage."""
        self.images.run(mark)
        self.answer(mark)

    def answer(self, mark: Mark = lambda stage: None) -> None:
        """What comes after `images.run`: prompt, state and noise to actions on the host."""
        self.encode(mark)
        self.denoise(mark)

    def encode(self, mark: Mark = lambda stage: None) -> None:
        """Upload; then the images' rows, which are there, and the prompt to the cache's first rows."""
        config, weights, ops, inputs = self.config, self.weights, self.ops, self.inputs
        ops.transfer(self.host.flat, inputs.flat)
        slots = self.shape.prefix_slots(config)
        ops.embed_prompt(inputs.tokens, weights.embed_tokens, self.embs[self.images.rows :])
        rope = (self.rope[0][:slots], self.rope[1][:slots])
        prefix_cache = ops.prefix_cache or forward.prefix_cache
        prefix_cache(config, weights, ops, self.embs, inputs.length, self.cache_k, self.cache_v, rope)
        mark("prefix")

    def denoise(self, mark: Mark = lambda stage: None) -> None:
        """Noise to actions on the host, all steps, from the cache's first rows."""
        if self.conditioned is not None:
            self.conditioned.upload()
        if self.denoiser is None:
            self._denoise_by_operations()
        else:
            inputs, by_token = self.inputs, () if self.conditioned is None else (self.conditioned.tokens,)
            self.denoiser.launch(inputs.noise, self.cache_k, self.cache_v, inputs.length, self.x_t, self.v_t, *by_token)
        self.ops.transfer(self.x_t[-1], self.actions)
        mark("denoise")

    def _denoise_by_operations(self) -> None:
        for cache in (self.cache_k, self.cache_v):
            cache[:, self._unseen] = 0  # masked, but 0 * NaN is NaN
        positions = self.inputs.length + self.suffix_offsets
        rope = (self.rope[0][positions], self.rope[1][positions])
        self.x_t[0] = self.inputs.noise
        loop, conditioned = self.shape.loop, self.conditioned
        for step in range(loop.steps):
            x_t = self.x_t[step]
            if self.keeper is not None:
                assert conditioned is not None and self.times.table is not None, "it is made for Pi0.5's guided loops"
                expert = self._expert(self.times.table.movedim(0, 2), rope, conditioned.tokens.rows[step])
                jacobian_step(expert, conditioned, step, self.keeper, x_t, self.v_t[step], self.x_t[step + 1])
            elif isinstance(loop, SolverLoop):
                self.v_t[step] = self._velocity(step, rope)
                self.x_t[step + 1] = loop.integration.next_x(step, self.x_t, self.v_t)
            elif conditioned is None:
                v_t = self._velocity(step, rope)
                self.x_t[step + 1] = euler_step(x_t, v_t, loop.steps)
                self.v_t[step] = v_t
            else:
                v_t = self._guided_velocity(conditioned, step, rope)
                self.x_t[step + 1] = conditioned.next_x(step, x_t, v_t)
                self.v_t[step] = v_t

    def _velocity(self, step: int, rope: forward.Rope) -> Tensor:
        """v_t float32[H, A] of x_t, without guidance."""
        out = forward.expert_output(
            self.config,
            self.weights,
            self.ops,
            self._suffix_tokens(step),
            self.times.modulation(step),
            self.inputs.length,
            self.cache_k,
            self.cache_v,
            rope,
        )
        return forward.project(self.weights.small, "action_out_proj", out[-self.shape.loop.horizon :])

    def _guided_velocity(self, conditioned: Conditioned, step: int, rope: forward.Rope) -> Tensor:
        """v_t float32[H, A], pulled as `model.conditioning` says."""
        x_t = self.x_t[step]
        if not conditioned.loop.jacobian:
            return conditioned.pulled(step, x_t, self._velocity(step, rope))
        tokens = self._suffix_tokens(step)
        expert = self._expert(self.times.modulation(step), rope)
        return jacobian_velocity(expert, conditioned, step, x_t, tokens, self.times.embedding(step))

    def _expert(self, table: Tensor | None, rope: forward.Rope, rows: Tensor | None = None) -> Expert:
        """The expert, forward and backward."""
        back = backward_ops(self.ops, self.config, self.shape.suffix_tokens(self.config))
        cache = self.cache_k, self.cache_v
        return Expert(self.config, self.weights, self.ops, back, table, self.inputs.length, *cache, rope, rows=rows)

    def _suffix_tokens(self, step: int) -> Tensor:
        """The suffix [H, D] of a step: actions, and for Pi0 the state token before them and the time mixed in."""
        x_t, time = self.x_t[step], self.times.embedding(step)
        tokens = forward.suffix_tokens(self.config, self.weights.small, x_t, time, self.inputs.state)
        return tokens.to(self.weights.embed_tokens.dtype)
