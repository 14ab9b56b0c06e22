"""Batched calls as CUDA graphs: which are captured and replayed, and how a batch of any size is put together of them.

A batch is split into calls of 1, 2, 4, 8 or 16 observations (batch_runner.py); one of them alone is the runner's own
call. Rows are packed, so a call's sizes are sums over its observations: their pictures, rounded up to a multiple of its
size, and their prompts' tokens, rounded up to 16 an observation. Graphs of each size are kept for good; their rows lie
in the same buffers, as calls run one after the other.
"""

import itertools
import logging
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbopi.config import ImageResize, ModelConfig
from turbopi.engine.batch import BatchBuffers, BatchLoop, BatchSize, PackedPrefix, SharedRows
from turbopi.engine.call import Pictures
from turbopi.engine.graph import Graph, Mark
from turbopi.engine.graph_cache import Loop
from turbopi.engine.weights import Weights
from turbopi.kernels.interface import Ops, PairDenoiser
from turbopi.models.pi0.conditioning import Conditioning, Form
from turbopi.models.pi0.sample import Sample

logger = logging.getLogger(__name__)

STAGES = ("vision", "prefix", "denoise")
Capture = Callable[[Callable[[Mark], None], "Graph | None"], Graph]  # and in whose place it may be launched


class Batches:
    """The batched calls of one runner, which gives what they share with its own: weights, graphs' memory, tables.

    capture     makes a graph of a function, see `GraphRunner`
    table       a loop's modulation
    denoises_by  what denoises so many observations, of at most so many rows, when that is first captured; of a
                 conditioned loop it is operations
    refuse      is told what a call needs that isn't captured, for how many, with which loop if that is what is
                lacking; and raises if that isn't allowed now
    """

    def __init__(
        self,
        config: ModelConfig,
        weights: Weights,
        ops: Ops,
        device: torch.device,
        *,
        bucket: int,
        capture: Capture,
        table: Callable[[Loop], Tensor | None],
        denoises_by: Callable[[Loop, int, int], Weights | PairDenoiser],
        refuse: Callable[[str, int, Loop | None], None],
    ) -> None:
        self._config, self._weights, self._ops, self._device = config, weights, ops, device
        self._bucket, self._capture, self._table = bucket, capture, table
        self._denoises_by, self._refuse = denoises_by, refuse
        self._shared = SharedRows(config, weights.embed_tokens.dtype, device)
        self._pictures: dict[tuple[int, bool], Pictures] = {}
        self._buffers: dict[BatchSize, BatchBuffers] = {}
        self._prefixes: dict[tuple[BatchSize, int], PackedPrefix] = {}
        self._loops: dict[tuple[BatchSize, Loop], BatchLoop] = {}
        self._graphs: dict[tuple[Any, ...], Graph] = {}
        self._marks = [torch.cuda.Event(enable_timing=True) for _ in range(4)] if device.type == "cuda" else []  # type: ignore[no-untyped-call]

    def size(self, batch: int, cameras: Sequence[int], float_images: bool) -> BatchSize:
        """The size of a call of `batch` observations for at most so many, with their numbers of cameras."""
        return BatchSize(batch, -(-sum(cameras) // batch) * batch, float_images)

    def slots(self, batch: int, tokens: Sequence[int]) -> int:
        """Prompt tokens of all observations together, rounded up to a bucket."""
        step = self._bucket * batch
        return max(1, -(-sum(tokens) // step)) * step

    def warm(self, size: BatchSize, loop: Loop, resized: bool) -> None:
        """Capture the calls of a size, for prompts of any length."""
        step = self._bucket * size.batch
        for slots in range(step, self._most_slots(size) + 1, step):
            self._prefix_graph(size, slots)
        self._vision_graph(size, False)
        if resized:
            self._vision_graph(size, True)
        self._loop_graph(size, loop)

    def launch_vision(self, size: BatchSize, pictures: Sequence[np.ndarray], resize: ImageResize | None) -> None:
        """Send the pictures of all observations, part by part, and start on each part when it is sent, without waiting.

        A wrong picture of a later part raises when the earlier ones have been launched. Nothing comes of these.
        """
        buffers = self._pictures_of(size)
        if (missing := size.pictures - len(pictures)) > 0:
            blank = np.zeros(tuple(buffers.images.shape[1:]), np.float32 if size.float_images else np.uint8)
            pictures = [*pictures, *[blank] * missing]
        resized = buffers.resizes(pictures, resize)
        graph, uploads = self._vision_graph(size, resized), buffers.uploads(pictures, resize, resized)
        self._mark(0)
        graph.launch(*uploads)
        self._mark(1)

    def finish(
        self,
        size: BatchSize,
        loop: Loop,
        cameras: Sequence[int],
        tokens: Sequence[np.ndarray],
        state: np.ndarray,
        noise: np.ndarray,
        conditionings: Sequence[Conditioning | None] | None = None,
    ) -> Sample:
        """What comes behind `launch_vision`: actions float32[b, H, A] of the observations that are there."""
        slots = self.slots(size.batch, [len(prompt) for prompt in tokens])
        encode, denoise = self._prefix_graph(size, slots), self._loop_graph(size, loop)
        self._prefixes[size, slots].write(cameras, tokens)
        run = self._loops[size, loop]
        run.write(noise, state, conditionings)
        encode.launch()
        self._mark(2)
        denoise.launch()
        self._mark(3)
        if self._marks:
            self._marks[-1].synchronize()
        times = [start.elapsed_time(end) for start, end in itertools.pairwise(self._marks)]
        return Sample(torch.from_numpy(run.actions_array[: len(noise)].copy()), dict(zip(STAGES, times, strict=False)))

    def trace(self, size: BatchSize, loop: Loop, row: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What the last call left of one observation: keys and values [layer, length, K], x_t and v_t [N.., H, A]."""
        buffers, run = self._buffers[size], self._loops[size, loop]
        start, length = (int(one) for one in buffers.segments[:, row])
        rows = slice(start, start + length)
        return buffers.cache.k[:, rows], buffers.cache.v[:, rows], run.x_t[:, row], run.v_t[:, row]

    def forget(self, loop: Loop) -> None:
        """Let go of all that is a denoising loop's alone."""
        for key in [key for key in self._loops if key[1] == loop]:
            del self._loops[key]
            self._graphs.pop(("denoise", *key), None)

    def describe(self) -> list[str]:
        """What is captured, in words."""
        return [
            f"{size.batch} observations with {size.pictures} pictures, {loop}"
            for size, loop in sorted(self._loops, key=str)
        ]

    def warm_sizes(self, form: Form) -> set[int]:
        """Observations of the calls that are captured with a loop of this form."""
        return {size.batch for size, loop in self._loops if loop.form == form}

    def _mark(self, place: int) -> None:
        if self._marks:
            self._marks[place].record(torch.cuda.current_stream(self._device))

    def _most_slots(self, size: BatchSize) -> int:
        return self.slots(size.batch, [self._config.max_prompt_tokens] * size.batch)

    def _pictures_of(self, size: BatchSize) -> Pictures:
        key = (size.pictures, size.float_images)
        if key not in self._pictures:
            embs = self._shared.pictures(size.pictures * self._config.vision.num_tokens)
            self._pictures[key] = Pictures(self._config, self._weights, self._ops, *key, 0, embs)
        return self._pictures[key]

    def _buffers_of(self, size: BatchSize) -> BatchBuffers:
        if size not in self._buffers:
            pictures, most = self._pictures_of(size), self._most_slots(size)
            own = self._config, self._weights, self._ops
            self._buffers[size] = BatchBuffers(*own, size, pictures, most, self._shared)
        return self._buffers[size]

    def _vision_graph(self, size: BatchSize, resized: bool) -> Graph:
        def capture() -> Graph:
            pictures = self._pictures_of(size)
            if resized:
                return self._capture(pictures.run_resized, self._vision_graph(size, False))
            return self._capture(pictures.run, None)

        return self._graph(size, ("vision", size.pictures, size.float_images, resized), capture)

    def _prefix_graph(self, size: BatchSize, slots: int) -> Graph:
        def capture() -> Graph:
            prefix = PackedPrefix(self._buffers_of(size), slots)
            prefix.write([0] * size.batch, [np.zeros(1, np.int64)] * size.batch)
            graph = self._capture(prefix.run, None)
            self._prefixes[size, slots] = prefix
            return graph

        return self._graph(size, ("prefix", size, slots), capture)

    def _loop_graph(self, size: BatchSize, loop: Loop) -> Graph:
        def capture() -> Graph:
            table, buffers = self._table(loop), self._buffers_of(size)
            by = self._denoises_by(loop, size.batch, buffers.rows)
            run = BatchLoop(buffers, loop, by, table)
            graph = self._capture(run.run, None)
            self._loops[size, loop] = run  # what is here counts as warm
            return graph

        return self._graph(size, ("denoise", size, loop), capture)

    def _graph(self, size: BatchSize, key: tuple[Any, ...], capture: Callable[[], Graph]) -> Graph:
        if key not in self._graphs:
            loop = key[-1] if key[0] == "denoise" else None
            self._refuse(f"{size.batch} observations with {size.pictures} pictures", size.batch, loop)
            self._graphs[key] = capture()
            logger.info("captured %s of %s", key[0], size)
        return self._graphs[key]
