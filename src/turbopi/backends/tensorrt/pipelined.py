"""Backend `tensorrt_pipelined`: `tensorrt` in two stages, so that consecutive observations overlap.

While one observation is denoised on one stream, the next one is encoded (vision and prefix) on another, into the other
of two sets of buffers. Nothing is computed differently: the graphs hold the same engines and kernels, and the actions
are those of `tensorrt`, bit for bit. It pays where observations come faster than one call takes (several robots, or a
replay); the latency of a single observation is no better, and is worse while two share the GPU.
"""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from queue import SimpleQueue
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from turbopi.backends.base import LoadState, Sample
from turbopi.backends.tensorrt.backend import CallKey, TensorRTBackend
from turbopi.engine.graph import Graph
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditionings
from turbopi.models.pi0.reference import Trace
from turbopi.support.errors import BackendError

BUFFERS = 2


@dataclass
class _InFlight:
    """One set of buffers: free, or between `submit` and its answer."""

    free: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(1))


@dataclass(frozen=True)
class _Job:
    wait: Callable[[], None]
    collect: Callable[[], Sample]
    future: "Future[Sample]"
    slot: _InFlight


class TensorRTPipelinedBackend(TensorRTBackend):
    """`submit` returns at once; `sample` is `submit` and its answer."""

    name: ClassVar[str] = "tensorrt_pipelined"
    submits: ClassVar[bool] = True

    def load_weights(self, load: LoadState) -> None:
        super().load_weights(load)
        self._slots = [_InFlight() for _ in range(BUFFERS)]
        self._next = 0
        self._submitting = threading.Lock()
        self._jobs: SimpleQueue[_Job] = SimpleQueue()
        self._collector: threading.Thread | None = None

    def submit(self, observation: Observation, noise: Tensor, num_steps: int) -> "Future[Sample]":
        """Start one observation (batch 1) and return; waits only while both sets of buffers are in use.

        Answers come in the order of submission. Raises what `sample` raises for an observation that doesn't fit.
        """
        if observation.batch_size != 1:
            raise BackendError(f"submit takes one observation at a time, not {observation.batch_size}")
        row = self._row(observation, 0)
        requested = time.perf_counter()
        with self._submitting:
            shape = self._shape(len(row.images), len(row.tokens), noise.shape[1])
            slot, buffers = self._slots[self._next], self._next
            slot.free.acquire()
            queue_ms = (time.perf_counter() - requested) * 1e3
            try:
                key = CallKey(shape, num_steps, row.images.dtype == np.float32, buffers)
                encode, denoise = self._captured(key)
                call = self._calls[key]
                call.write_inputs(row.images, noise[0].cpu().numpy(), row.state, row.tokens)
                wait = self._launch(encode, denoise)
            except BaseException:
                slot.free.release()
                raise
            self._next = (self._next + 1) % BUFFERS

        def collect() -> Sample:
            stage_ms = {**_ends(encode.stage_ms()), **denoise.stage_ms()}
            return Sample(call.actions.clone()[None], stage_ms, queue_ms)

        future: Future[Sample] = Future()
        self._collect(_Job(wait, collect, future, slot))
        return future

    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        self.check_conditioning(conditioning)
        rows = [self.submit(observation.row(b), noise[b : b + 1], num_steps) for b in range(observation.batch_size)]
        samples = [row.result() for row in rows]
        stages = {name: sum(one.stage_ms[name] for one in samples) for name in samples[0].stage_ms}
        return Sample(torch.cat([one.actions for one in samples]), stages)

    def warmup(self, *arguments: Any, **options: Any) -> None:
        with self._submitting, _all_free(self._slots):  # graphs may be captured, and others forgotten
            super().warmup(*arguments, **options)

    def intermediates(self, *arguments: Any, **options: Any) -> Trace:
        with self._submitting, _all_free(self._slots):
            return super().intermediates(*arguments, **options)

    def _captured(self, key: CallKey) -> tuple[Graph, Graph]:
        """Both graphs of a key whose buffers are ours; nothing else is in flight while one is captured."""
        others = self._slots[: key.buffers] + self._slots[key.buffers + 1 :]
        missing = {(key, "encode"), (key, "denoise")} - self._graphs.keys()
        with _all_free(others if missing else []):
            return self._graph(key, "encode"), self._graph(key, "denoise")

    def _prepare(self, key: CallKey) -> None:
        for buffers in range(BUFFERS):
            one = replace(key, buffers=buffers)
            self._graph(one, "encode")
            self._graph(one, "denoise")

    def describe(self) -> dict[str, Any]:
        return {**super().describe(), "buffers": BUFFERS, "stages": ["vision and prefix", "denoise"]}

    def _launch(self, encode: Graph, denoise: Graph) -> Callable[[], None]:
        """Queue both halves on their streams, the second behind the first; returns what waits for the end."""
        (_, first), (_, second) = self._pools["encode"], self._pools["denoise"]
        _queue(encode, first)
        second.wait_stream(first)
        _queue(denoise, second)
        done = torch.cuda.Event()  # type: ignore[no-untyped-call]
        done.record(second)
        return done.synchronize

    def _collect(self, job: _Job) -> None:
        """Have the job's answer put into its future by the one thread that does so."""
        if self._collector is None:
            self._collector = threading.Thread(
                target=_collect_all, args=(self._jobs,), daemon=True, name="turbopi-collect"
            )
            self._collector.start()
        self._jobs.put(job)


@contextmanager
def _all_free(slots: Sequence[_InFlight]) -> Iterator[None]:
    """Wait until these buffers are free, and keep them."""
    with ExitStack() as kept:
        for slot in slots:
            kept.enter_context(slot.free)
        yield


def _queue(graph: Graph, stream: torch.cuda.Stream) -> None:
    with torch.cuda.stream(stream):
        graph.launch()


def _collect_all(jobs: "SimpleQueue[_Job]") -> None:
    while True:
        job = jobs.get()
        try:
            job.wait()
            sample = job.collect()
        except BaseException as error:
            job.slot.free.release()
            job.future.set_exception(error)
        else:
            job.slot.free.release()
            job.future.set_result(sample)


def _ends(stages: dict[str, float]) -> dict[str, float]:
    return {name: stages[name] for name in ("vision", "prefix")}
