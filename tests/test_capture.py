"""How graphs are captured: thread-locally, one at a time in the process, in exact float32."""

import gc
import threading
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from turbopi.engine import graph
from turbopi.engine.graph import CAPTURING, HEAD, Graph
from turbopi.models.pi0 import exact


class FakeStream(SimpleNamespace):
    def wait_stream(self, other: Any) -> None: ...

    def synchronize(self) -> None:
        DONE.append("waited")


DONE: list[str] = []  # what graphs and streams were told to do


class FakeCuda:
    """PyTorch's graphs on a machine without a GPU; `captures` has what each was told."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.captures: list[dict[str, Any]] = []
        event = SimpleNamespace(record=lambda stream: None, elapsed_time=lambda end: 1.0)
        monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: SimpleNamespace(replay=lambda: DONE.append("launched")))
        monkeypatch.setattr(torch.cuda, "current_stream", lambda device: FakeStream(device=device))
        monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())
        monkeypatch.setattr(torch.cuda, "Event", lambda **options: event)
        monkeypatch.setattr(torch.cuda, "graph", self._graph)

    @contextmanager
    def _graph(self, captured: Any, **options: Any) -> Any:
        self.captures.append(options)
        yield


def capture(run: Any) -> Graph:
    return Graph(run, None, FakeStream(device=torch.device("cpu")))  # type: ignore[arg-type]


def test_a_capture_is_thread_local(monkeypatch: pytest.MonkeyPatch) -> None:
    cuda = FakeCuda(monkeypatch)
    capture(lambda mark: mark("vision"))
    (options,) = cuda.captures
    assert options["capture_error_mode"] == "thread_local"


def test_a_replay_is_waited_for_and_a_launch_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    FakeCuda(monkeypatch)
    graph = capture(lambda mark: mark("vision"))
    DONE.clear()
    graph.launch()
    assert DONE == ["launched"]
    graph.replay()
    assert DONE == ["launched", "launched", "waited"], "actions are read when replay returns"


def test_the_head_of_a_sequence_is_a_graph_of_its_own_and_launched_first(monkeypatch: pytest.MonkeyPatch) -> None:
    cuda = FakeCuda(monkeypatch)
    order: list[str] = []

    def run(mark: Any) -> None:
        order.append(f"head, captured by {len(cuda.captures)}")
        mark(HEAD)
        order.append(f"rest, captured by {len(cuda.captures)}")
        mark("vision")

    graph = capture(run)
    assert order[4:] == ["head, captured by 1", "rest, captured by 2"], "twice to compile, then captured"
    assert "head" not in graph.stage_ms(), "it ends no stage"
    DONE.clear()
    graph.launch(lambda: DONE.append("given"))
    assert DONE == ["given", "launched", "launched"]


def test_no_garbage_is_collected_within_a_capture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Destroying a graph that was let go earlier would break the capture."""
    FakeCuda(monkeypatch)
    collecting: list[bool] = []
    capture(lambda mark: collecting.append(gc.isenabled()))
    assert collecting == [True, True, False]  # twice to compile, then captured
    assert gc.isenabled()

    def fail(mark: Any) -> None:
        if not gc.isenabled():
            raise RuntimeError("out of memory")

    with pytest.raises(RuntimeError, match="out of memory"):
        capture(fail)
    assert gc.isenabled()
    gc.disable()
    try:
        capture(lambda mark: None)
        assert not gc.isenabled(), "who has turned it off keeps it off"
    finally:
        gc.enable()


def test_captures_of_several_threads_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second one neither runs nor empties a cache nor probes the device while the first one captures."""
    FakeCuda(monkeypatch)
    within, done, order = threading.Event(), threading.Event(), list[str]()

    def first(mark: Any) -> None:
        within.set()
        assert done.wait(30)
        order.append("first")

    def second(mark: Any) -> None:
        order.append("second")

    def cache() -> None:
        graph.empty_cache()
        order.append("cache")

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: None)
    threads = [threading.Thread(target=capture, args=(first,))]
    threads[0].start()
    assert within.wait(30)
    threads += [threading.Thread(target=capture, args=(second,)), threading.Thread(target=cache)]
    for thread in threads[1:]:
        thread.start()
    for thread in threads[1:]:
        thread.join(0.2)
    assert order == [] and all(thread.is_alive() for thread in threads)
    done.set()
    for thread in threads:
        thread.join(30)
    assert order[:3] == ["first"] * 3 and order.count("second") == 3 and order.count("cache") == 1
    assert CAPTURING.acquire(timeout=120)
    CAPTURING.release()


def test_what_is_captured_is_exact_whatever_the_caller_has_set(monkeypatch: pytest.MonkeyPatch) -> None:
    FakeCuda(monkeypatch)
    seen: list[bool] = []
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            capture(lambda mark: seen.append(exact._is_exact(exact.products()) and not exact.autocast()))
            assert exact.autocast() == ["cpu"]
        assert torch.get_float32_matmul_precision() == "medium"
    finally:
        torch.set_float32_matmul_precision(before)
    assert seen == [True] * 3


def test_a_capture_that_fails_lets_the_next_one_have_its_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    FakeCuda(monkeypatch)

    def fail(mark: Any) -> None:
        raise RuntimeError("no kernel")

    with pytest.raises(RuntimeError, match="no kernel"):
        capture(fail)
    thread = threading.Thread(target=capture, args=(lambda mark: None,))
    thread.start()
    thread.join(30)
    assert not thread.is_alive()
