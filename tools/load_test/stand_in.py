"""A server for load tests without a GPU: the whole served path, with a backend that sleeps instead of computing.

    PYTHONPATH=src:tools python -m load_test.stand_in --gpu h100_bf16 --port 8001

Everything on the host is what `turbopi serve --random-weights pi05_libero` does: reading, resizing, tokenising, copies
into the engine's input buffers, un-normalising. In place of the GPU there is a queue of stages with their measured
durations; waiting for it releases the GIL, as waiting for a CUDA event does. Actions are the noise.
"""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from turbopi import UnifiedPolicy, serve
from turbopi.backends import BACKENDS, Backend, BackendSpec, LoadState, Precision, Sample
from turbopi.checkpoint import random_checkpoint
from turbopi.config import ImageResize
from turbopi.engine.batch_runner import BegunBatch, Call, Finish, Rows
from turbopi.engine.packing import pack_rows
from turbopi.engine.plan import split
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditionings, Form

# Milliseconds of vision, prefix and denoising of a call for so many observations of two images, and what `fused`
# splits other numbers by: benchmarks/results/h100_2026-11-27_batches/batches.json.xz.
GPUS: dict[str, tuple[dict[int, tuple[float, float, float]], dict[int, float]]] = {
    "h100_bf16": (
        {1: (1.27, 3.4, 3.0), 2: (2.38, 6.67, 3.55), 4: (3.79, 12.76, 5.73), 8: (7.37, 23.83, 6.95)},
        {1: 1, 2: 1.65, 4: 2.9, 8: 5.15},
    ),
    "h100_fp8": (
        {1: (1.0, 2.07, 2.01), 2: (1.77, 3.94, 2.82), 4: (2.83, 7.06, 4.6), 8: (5.34, 13.76, 5.22)},
        {1: 1, 2: 1.65, 4: 2.9, 8: 5.15},
    ),
    "none": ({1: (0.0, 0.0, 0.0)}, {1: 1}),
}


class Device:
    """A GPU's stream: stages run one after the other, each for its time."""

    def __init__(self) -> None:
        self._free = 0.0

    def launch(self, milliseconds: float) -> None:
        self._free = max(self._free, time.perf_counter()) + milliseconds / 1e3

    def wait(self) -> None:
        """Until all that was launched has run."""
        if (left := self._free - time.perf_counter()) > 0:
            time.sleep(left)


class SleepingBackend(Backend):
    """Runs batches in the time that `gpu` says."""

    name: ClassVar[str] = "sleeping"
    precisions: ClassVar[tuple[Precision, ...]] = ("bf16",)
    begins: ClassVar[bool] = True
    runs_batches: ClassVar[bool] = True
    gpu: ClassVar[str] = "none"

    def load_weights(self, load: LoadState) -> None:
        config = self.config
        self.stages, self.costs = GPUS[self.gpu]
        self._device = Device()
        side = config.vision.image_size
        self._images = np.zeros((4 * max(self.stages), side, side, 3), np.uint8)
        self._inputs = np.zeros((max(self.stages), config.action_horizon, config.action_dim), np.float32)

    @property
    def batch_costs(self) -> Mapping[int, float]:
        return self.costs

    def warmup(self, *_: Any, **__: Any) -> None: ...

    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        raise NotImplementedError("a policy calls `begin_batch`")

    def describe(self) -> dict[str, Any]:
        return {"gpu": self.gpu}

    def begin_batch(
        self,
        images: Sequence[Sequence[np.ndarray]],
        resize: ImageResize | None = None,
        forms: Sequence[Form] | None = None,
    ) -> BegunBatch:
        calls: list[Call] = []
        rows = list(range(len(images)))
        for bucket in split(len(images), self.costs):
            calls.append((bucket, rows[:bucket]))
            rows = rows[bucket:]
        return BegunBatch(self._begin_call, calls, images)

    def _begin_call(self, bucket: int, camera_images: Sequence[Sequence[np.ndarray]]) -> Finish:
        self._see(bucket, camera_images)
        cameras = [len(one) for one in camera_images]

        def finish(
            tokens: Sequence[np.ndarray], state: np.ndarray, noise: np.ndarray, num_steps: int, conditionings: Rows
        ) -> Sample:
            return self.finish(bucket, cameras, tokens, state, noise)

        return finish

    def _see(self, bucket: int, camera_images: Sequence[Sequence[np.ndarray]]) -> None:
        for place, camera_image in zip(
            self._images, (camera_image for one in camera_images for camera_image in one), strict=False
        ):
            place[:] = camera_image
        self._device.launch(self.stages[bucket][0])

    def finish(
        self,
        bucket: int,
        cameras: Sequence[int],
        tokens: Sequence[np.ndarray],
        state: np.ndarray,
        noise: np.ndarray,
    ) -> Sample:
        config = self.config
        if bucket > 1:
            rows = sum(cameras) * config.vision.num_tokens + bucket * config.max_prompt_tokens
            per_image, heads = config.vision.num_tokens, config.vlm.num_heads
            pack_rows(cameras, tokens, batch=bucket, rows=rows, per_image=per_image, heads=heads)
        self._inputs[: len(noise)] = noise
        for milliseconds in self.stages[bucket][1:]:
            self._device.launch(milliseconds)
        self._device.wait()
        stages = dict(zip(("vision", "prefix", "denoise"), self.stages[bucket], strict=True))
        return Sample(torch.from_numpy(noise.copy()), stages)


def make_policy(gpu: str) -> UnifiedPolicy:
    """The full-size policy of LIBERO's robot on a GPU that isn't there."""
    SleepingBackend.gpu = gpu
    BACKENDS["sleeping"] = BackendSpec("sleeping", __name__, "SleepingBackend", "sleeps")
    return UnifiedPolicy(random_checkpoint("pi05_libero"), backend="sleeping", device="cpu")


def main(arguments: Sequence[str] | None = None, run: Callable[..., None] = serve.run) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m load_test.stand_in", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gpu", choices=sorted(GPUS), default="h100_bf16", help="whose times")
    parser.add_argument("--port", type=int, default=8001)
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    run(make_policy(given.gpu), port=given.port)


if __name__ == "__main__":
    main()
