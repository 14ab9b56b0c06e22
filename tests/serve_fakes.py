"""Policies without a model, and a bare HTTP client, for the serving tests."""

import asyncio
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from turbopi.support.errors import ActionError, DeviceLost, ObservationError

OBSERVATION = {
    "observation/image": np.arange(12, dtype=np.uint8).reshape(2, 2, 3),
    "observation/state": np.linspace(-1, 1, 8),
    "prompt": "put the bowl away",
}


NO_CHUNKS: dict[str, Any] = {  # what a policy of one's own may answer, and no robot may get
    "nan": {"actions": np.array([[0.0, 1.0], [np.nan, 2.0]])},
    "inf": {"actions": np.array([[0.0, -np.inf]], np.float32)},
    "half": {"actions": np.array([[np.inf]], np.float16)},
    "beyond float32": {"actions": np.array([[1e39]])},
    "text": {"actions": "hello"},
    "None": {"actions": None},
    "no action": {"actions": np.zeros((0, 7))},
    "no numbers": {"actions": np.zeros((4, 0))},
    "one action": {"actions": np.zeros(7)},
    "a batch": {"actions": np.zeros((1, 4, 7))},
    "objects": {"actions": np.array([[0.0, None]])},
    "complex": {"actions": np.zeros((4, 7), np.complex64)},
    "bool": {"actions": np.zeros((4, 7), bool)},
    "ragged": {"actions": [[1.0], [1.0, 2.0]]},
    "a dict": {"actions": {"arm": np.zeros((4, 7))}},
    "another key": {"action": np.zeros((4, 7))},
    "no dict": [np.zeros((4, 7))],
    "nothing": None,
}


class FakePolicy:
    """Answers with what it was sent; `prompt` selects the trouble it makes, and `hold` makes it wait for `release`."""

    def __init__(self) -> None:
        self.metadata: dict[str, Any] = {"policy": "fake", "reset_pose": [0.0, 1.5], "action_horizon": 2}
        self.seen: list[str] = []
        self.observations: dict[str, dict[str, Any]] = {}
        self.threads: set[int] = set()
        self.overlaps = 0
        self.warmed_up = False
        self.started, self.release = threading.Event(), threading.Event()
        self._running = threading.Lock()

    def warmup(self) -> None:
        self.threads.add(threading.get_ident())
        self.warmed_up = True

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        if not self._running.acquire(blocking=False):
            self.overlaps += 1
        else:
            try:
                return self._infer(obs)
            finally:
                self._running.release()
        raise AssertionError("two inferences at once")

    def _infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        self.threads.add(threading.get_ident())
        if "observation/state" not in obs:
            raise ObservationError(f"the key 'observation/state' is missing; this robot sends {sorted(obs)}")
        state = np.asarray(obs["observation/state"])
        if state.dtype.kind != "f":
            raise ObservationError(f"observation/state must be float, not {state.dtype}")
        if not np.isfinite(state).all():
            raise ObservationError("observation/state holds nan at [0]: every value must be finite")
        prompt = str(obs.get("prompt", ""))
        self.seen.append(prompt)
        self.observations[prompt] = dict(obs)
        if prompt.startswith("hold"):
            self.started.set()
            assert self.release.wait(120)
        if prompt == "crash":
            raise RuntimeError("CUDA error: invalid argument")  # that doesn't lose the device, unlike "lost" below
        if prompt == "nan actions":
            raise ActionError("the actions hold nan at [0, 3]")
        if prompt.endswith("lost"):
            raise DeviceLost("CUDA error: an illegal memory access was encountered")
        if prompt == "stop iteration":
            next(iter(()))
        if prompt == "exit":
            raise SystemExit(3)
        if prompt == "large actions":  # more than sockets hold
            return {"actions": np.zeros((1_000_000, 8))}
        if prompt.startswith("answer "):
            return NO_CHUNKS[prompt.removeprefix("answer ")]
        if prompt == "unpackable":
            return {"actions": np.zeros((1, 1)), "more": object()}
        if prompt == "mutate":
            obs.clear()
        return {"actions": np.stack([state, state]), "policy_timing": {"infer_ms": 1.0}, "prompt": prompt}


class PipelinedFakePolicy(FakePolicy):
    """Answers submitted observations on a thread of its own; `in_flight` of them wait there or are at work."""

    pipelined = True

    def __init__(self) -> None:
        super().__init__()
        self.in_flight = 0
        self._counting = threading.Lock()
        self._executor = ThreadPoolExecutor(1)
        self.submitters: set[int] = set()

    def submit(self, obs: dict[str, Any]) -> "Future[dict[str, Any]]":
        self.submitters.add(threading.get_ident())
        if "refused at once" in str(obs.get("prompt")):
            raise ObservationError("refused at once")
        self._count(1)
        future = self._executor.submit(self.infer, obs)
        future.add_done_callback(lambda done: self._count(-1))
        return future

    def _count(self, change: int) -> None:
        with self._counting:
            self.in_flight += change


class BatchingFakePolicy(FakePolicy):
    """Has `infer_batch`; `batches` are the prompts of each. With `no_batch` it fails for batches alone."""

    def __init__(self) -> None:
        super().__init__()
        self.batches: list[list[str]] = []
        self.no_batch = False

    def example_observation(self) -> dict[str, Any]:
        return observation("example")

    def infer_batch(self, observations: list[dict[str, Any]]) -> list[dict[str, Any]]:
        self.batches.append([str(obs.get("prompt", "")) for obs in observations])
        if self.no_batch:
            raise RuntimeError("out of memory")
        if "short" in self.batches[-1]:
            return []
        return [self.infer(obs) for obs in observations]


def wait_for(true: Callable[[], Any], seconds: float = 120.0) -> Any:
    """What `true` returns, as soon as that is true."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if found := true():
            return found
        time.sleep(0.01)
    raise AssertionError(f"not within {seconds:g} s: {true}")


def observation(prompt: str = "") -> dict[str, Any]:
    return {**OBSERVATION, "prompt": prompt}


async def http_get(port: int, path: str, *headers: str) -> tuple[int, dict[str, str], str]:
    """Status, headers (lower case) and body of a GET."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    lines = [f"GET {path} HTTP/1.1", f"Host: 127.0.0.1:{port}", *headers, "", ""]
    writer.write("\r\n".join(lines).encode())
    answer = (await asyncio.wait_for(reader.read(), 60)).decode()
    writer.close()
    head, _, body = answer.partition("\r\n\r\n")
    status, *fields = head.split("\r\n")
    return int(status.split()[1]), {k.lower(): v.strip() for k, _, v in (f.partition(":") for f in fields)}, body
