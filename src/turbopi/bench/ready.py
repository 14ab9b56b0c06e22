"""How long a program takes from its start to its first answer: measured in a process of its own.

Cold means that no kernel was ever compiled here, cached that a run before did. The weights' file is in the page cache
if something has read it, as a run before has; random weights are made on the spot.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import msgspec
from msgspec import Struct

from turbopi.bench.document import Ready, ReadyTimes
from turbopi.quantization.plan import TIERS
from turbopi.support.errors import BackendError

_TIMEOUT = 900  # seconds


@dataclass(frozen=True)
class Start:
    """What the process loads and how: UnifiedPolicy's arguments, in plain values."""

    checkpoint: str | None  # a folder, or None for random weights
    preset: str | None  # of random weights
    seed: int
    config: str | None
    backend: str
    precision: str
    device: str
    steps: int
    tokenizer: str | None
    quantization: str | None = None
    robot: str | None = None  # as --robot is typed


@contextmanager
def empty_caches() -> Iterator[None]:
    """Compiled kernels are looked for, and kept, in an empty folder; only while no kernel library is imported yet."""
    places = {"XDG_CACHE_HOME": "", "TRITON_CACHE_DIR": "triton", "TORCHINDUCTOR_CACHE_DIR": "inductor"}
    before = {name: os.environ.get(name) for name in places}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        os.environ.update({name: str(Path(folder) / place) for name, place in places.items()})
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


def measure_ready(start: Start) -> Ready:
    """To be called under `empty_caches`. Raises BackendError with what the process said."""
    return Ready(start.backend, start.precision, cold=_run(start), cached=_run(start))


class _Reported(Struct, frozen=True):
    """What the process says: seconds, the moment of its answer, and bytes."""

    load: float
    warmup: float
    at: float
    device_reserved: int | None


def _run(start: Start) -> ReadyTimes:
    command = [sys.executable, "-m", "turbopi.bench.ready", json.dumps(asdict(start))]
    began = time.time()
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT)
    except subprocess.TimeoutExpired:
        raise BackendError(f"{start.backend} wasn't ready after {_TIMEOUT} s") from None
    if done.returncode != 0:
        raise BackendError(f"{start.backend} didn't start:\n{done.stderr[-2000:]}")
    reported = msgspec.json.decode(done.stdout.splitlines()[-1], type=_Reported)
    ready = reported.at - began
    return ReadyTimes(
        imports=round(ready - reported.load - reported.warmup, 2),
        load=reported.load,
        warmup=reported.warmup,
        device_reserved=reported.device_reserved,
        ready=round(ready, 2),
    )


def _main(start: Start) -> None:
    import torch

    from turbopi.checkpoint import open_checkpoint, random_checkpoint
    from turbopi.policy.policy import UnifiedPolicy
    from turbopi.robots import import_robot

    if start.preset is None:
        assert start.checkpoint is not None
        checkpoint = open_checkpoint(start.checkpoint, start.config or "auto")
    else:
        checkpoint = random_checkpoint(start.preset, start.seed, start.config or "auto")
    begin = time.perf_counter()
    policy = UnifiedPolicy(
        checkpoint,
        backend=start.backend,
        precision=start.precision,  # type: ignore[arg-type]  # checked when a backend is created
        num_denoising_steps=start.steps,
        device=start.device,
        tokenizer=start.tokenizer,
        quantization=start.quantization if start.precision in TIERS else None,
        robot=import_robot(start.robot) if start.robot is not None and ":" in start.robot else start.robot,
    )
    load = time.perf_counter() - begin
    warmup = policy.warmup()  # ends with an answer
    at, reserved = time.time(), torch.cuda.max_memory_reserved() if torch.cuda.is_available() else None
    print(msgspec.json.encode(_Reported(round(load, 2), round(warmup, 2), at, reserved)).decode())


if __name__ == "__main__":
    _main(Start(**json.loads(sys.argv[1])))
