"""Several policies in one process on real GPUs: captures beside other threads, other devices, and what is let go.

Run by scripts/gpu_check; two of them need a second GPU.
"""

import gc
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from conftest import on_hopper

from turbopi import UnifiedPolicy, backends
from turbopi.checkpoint import random_checkpoint
from turbopi.engine.graph_cache import MOST_LOOPS
from turbopi.models.pi0 import exact
from turbopi.support.errors import ObservationError

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU"),
    pytest.mark.filterwarnings("default"),  # Inductor warns of what it does
]
GRAPHS = ["cuda_graph", "fused"]
two_gpus = pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two NVIDIA GPUs")


def policy(name: str, device: int = 0, **options: Any) -> UnifiedPolicy:
    reason = backends.availability(name, torch.device("cuda", device))
    if reason is not None:
        pytest.skip(reason)
    return UnifiedPolicy(
        random_checkpoint("pi05_tiny"),
        backend=name,
        device=f"cuda:{device}",
        num_denoising_steps=3,
        robot="plain",
        **options,
    )


def answers(one: UnifiedPolicy, steps: range = range(1, 5)) -> list[np.ndarray]:
    """One call for each number of steps; with a fresh policy each captures."""
    observation = one.example_observation()
    return [one.infer(observation, seed=7, num_steps=n)["actions"] for n in steps]


class Thread(threading.Thread):
    """Keeps what its function returns or raises, for `result`."""

    def __init__(self, function: Callable[[], Any]) -> None:
        super().__init__(daemon=True)
        self._function, self._error, self._value = function, None, None
        self.start()

    def run(self) -> None:
        try:
            self._value = self._function()
        except BaseException as error:
            self._error = error  # type: ignore[assignment]

    def result(self) -> Any:
        self.join(300)
        assert not self.is_alive()
        if self._error is not None:
            raise self._error
        return self._value


def busy_allocating(device: torch.device, until: threading.Event) -> int:
    """Allocate from the device and from the host, copy, launch and wait, on a stream of one's own, as another program
    part does. Returns how many rounds it made."""
    rounds, stream, kept = 0, torch.cuda.Stream(device), list[torch.Tensor]()  # type: ignore[no-untyped-call]
    generator = torch.Generator(device)  # PyTorch's own belongs to whoever captures: see engine/graph.py
    with torch.cuda.stream(stream):
        while not until.is_set():
            size = (1 + rounds % 13) << 18
            x = torch.randn(size, device=device, generator=generator)
            pinned = torch.empty(1000 + rounds % 7, pin_memory=True)
            pinned.copy_((x[:1000] * 2).sum() + pinned.new_zeros(len(pinned)).to(device), non_blocking=True)
            stream.synchronize()
            assert pinned.isfinite().all()
            kept = [*kept[-5:], x]
            rounds += 1
    return rounds


@pytest.mark.parametrize("name", GRAPHS)
def test_captures_beside_a_thread_that_allocates(name: str) -> None:
    expected, one, done = answers(policy(name)), policy(name), threading.Event()
    other = Thread(lambda: busy_allocating(torch.device("cuda", 0), done))
    try:
        found = Thread(lambda: answers(one)).result()
    finally:
        done.set()
    assert other.result() > 0
    for ours, alone in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours, alone)


def together(first: UnifiedPolicy, second: UnifiedPolicy, expected: list[list[np.ndarray]]) -> None:
    """Both warm up and capture at once, each in its thread; then each answers while the other captures on."""
    start = threading.Barrier(2)

    def run(one: UnifiedPolicy, steps: range) -> list[np.ndarray]:
        start.wait(60)
        one.warmup(cameras=3)
        mine = answers(one)
        for n in steps:  # evicts, captures, and answers again
            one.infer(one.example_observation(), seed=0, num_steps=n)
        again = answers(one)
        for before, after in zip(mine, again, strict=True):
            np.testing.assert_array_equal(before, after)
        return mine

    threads = [Thread(lambda: run(first, range(5, 20))), Thread(lambda: run(second, range(20, 5, -1)))]
    for thread, alone in zip(threads, expected, strict=True):
        for ours, theirs in zip(thread.result(), alone, strict=True):
            np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("names", [("cuda_graph", "cuda_graph"), ("fused", "cuda_graph"), ("fused", "fused")])
def test_two_policies_in_two_threads_on_one_gpu(names: tuple[str, str]) -> None:
    expected = [answers(policy(name)) for name in names]
    together(policy(names[0]), policy(names[1]), expected)


@two_gpus
@pytest.mark.parametrize("name", GRAPHS)
def test_two_policies_in_two_threads_on_two_gpus(name: str) -> None:
    expected = [answers(policy(name, device)) for device in (0, 1)]
    together(policy(name, 0), policy(name, 1), expected)


@two_gpus
@pytest.mark.parametrize("name", [*GRAPHS, "pytorch"])
def test_a_policy_runs_on_its_gpu_whichever_is_the_threads_current_one(name: str) -> None:
    with torch.cuda.device(1):
        expected = answers(policy(name, 1))
    torch.cuda.set_device(0)
    before = torch.cuda.memory_allocated(0)
    found = answers(policy(name, 1))
    assert torch.cuda.current_device() == 0 and torch.cuda.memory_allocated(0) == before
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("name", GRAPHS)
def test_forty_numbers_of_steps_keep_no_more_memory_than_twice_as_many_loops_as_are_kept(name: str) -> None:
    one = policy(name)
    observation = one.example_observation()
    first = one.infer(observation, seed=0, num_steps=1)["actions"]

    def held(steps: range) -> int:
        for n in steps:
            one.infer(observation, seed=0, num_steps=n)
        gc.collect()
        torch.cuda.synchronize()
        return torch.cuda.memory_allocated()

    twice, forty = held(range(30, 30 + 2 * MOST_LOOPS)), held(range(1, 41))
    assert forty <= twice * 1.02
    kept = one.metadata["backend_details"]["graphs"]
    assert len(kept["denoising_loops"]) == MOST_LOOPS and kept["forgotten"] > 0
    np.testing.assert_array_equal(one.infer(observation, seed=0, num_steps=1)["actions"], first)


@on_hopper
def test_fuseds_expert_survives_loops_by_operations_that_come_and_go() -> None:
    """At full size. Horizons that the kernel refuses read the first copy of the expert, which comes and goes."""
    one = UnifiedPolicy(random_checkpoint("pi05_libero"), backend="fused", device="cuda:0", robot="plain")
    observation = one.example_observation()
    calls = [(3, 10), (3, 60), *((n, 10) for n in range(4, 4 + MOST_LOOPS)), (3, 60), (3, 10), (4, 60), (5, 10)]
    answered: dict[tuple[int, int], np.ndarray] = {}
    for steps, horizon in calls:
        actions = one.infer(observation, seed=1, num_steps=steps, horizon=horizon)["actions"]
        assert actions.shape[0] == horizon
        before = answered.setdefault((steps, horizon), actions)
        np.testing.assert_array_equal(actions, before)
    denoising = one.metadata["backend_details"]["denoising"]
    assert denoising["one CUDA kernel"] and any("H=60, 3 steps" in calls for calls in denoising.values())


@pytest.mark.parametrize("name", GRAPHS)
def test_nothing_is_captured_in_a_strict_policy(name: str) -> None:
    one = policy(name, strict=True)
    one.warmup()
    example = one.example_observation()
    for count in (1, 2, 3):
        images = dict(list(example["images"].items())[:count])
        assert one.infer({**example, "images": images}, seed=0)["actions"].shape[0] == 10
    with pytest.raises(ObservationError, match=r"strict: .*warmup\(cameras=3, horizons=10, steps=4\)"):
        one.infer(example, num_steps=4)


@pytest.mark.parametrize("name", ["cuda_graph", "pytorch"])
def test_float32_is_float32_on_the_gpu_whatever_the_program_has_set(name: str) -> None:
    expected = answers(policy(name, precision="f32"))
    torch.set_float32_matmul_precision("high")
    try:
        with torch.autocast("cuda", dtype=torch.bfloat16):
            found = answers(policy(name, precision="f32"))
        a, b = torch.randn(2, 512, 512, device="cuda").unbind()
        assert not torch.equal(a @ b, exactly(a, b))  # it does make a difference here
    finally:
        torch.set_float32_matmul_precision("highest")
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def exactly(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    with exact.exact_float32():
        return a @ b


ASSERTS_ON_THE_DEVICE = """
import torch
from turbopi import UnifiedPolicy
from turbopi.checkpoint import random_checkpoint
from turbopi.support.errors import DeviceLost

policy = UnifiedPolicy(random_checkpoint("pi05_tiny"), backend=%r, device="cuda:0", num_denoising_steps=1)
observation = policy.example_observation()
policy.infer(observation, seed=0)
try:
    torch.empty(1 << 50, device="cuda")
except torch.OutOfMemoryError:
    print("out of memory")
policy.infer(observation, seed=0)
print("lost:", policy.lost)
torch.zeros(1, device="cuda")[torch.tensor([5], device="cuda")]  # an assert in a kernel, found out by the next call
for call in range(2):
    try:
        policy.infer(observation, seed=0)
    except DeviceLost as error:
        print(call, error)
print("lost:", policy.lost)
"""


@pytest.mark.parametrize("name", [*GRAPHS, "pytorch"])
def test_an_error_that_sticks_is_found_out_and_out_of_memory_isnt_one(name: str) -> None:
    policy(name)  # skips where it can't be
    program = [sys.executable, "-u", "-c", ASSERTS_ON_THE_DEVICE % name]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    ran = subprocess.run(program, capture_output=True, text=True, timeout=300, check=False, env=environment)
    lines = ran.stdout.splitlines()
    assert lines[:2] == ["out of memory", "lost: None"], ran.stdout + ran.stderr
    assert len(lines) == 5 and lines[2].startswith("0 ") and lines[3].startswith("1 "), ran.stdout + ran.stderr
    assert lines[2][2:] == lines[3][2:] == lines[4].removeprefix("lost: ")
    assert "cudaErrorAssert, 710" in lines[4] and "start it again" in lines[4]
