"""Backend `cuda_graph` of Pi0.5 with memory, its graphs run again on a CPU: what a capture holds asks no host."""

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from memory_golden import CASES, MemoryRuns, make_checkpoint
from smolvla_golden import relative
from test_engine_captured import watched
from torch import Tensor

from turbopi import UnifiedPolicy
from turbopi.backends import captured
from turbopi.backends.pytorch_compile import PyTorchCompileBackend
from turbopi.support.errors import ObservationError


class Replayed:
    """A graph that runs its operations again, into the tensors that the first run left in its lists."""

    def __init__(self, run: Callable[..., None], pool: Any, stream: Any) -> None:
        self._run = watched(run)
        self._run(lambda stage: None)
        cells = [cell.cell_contents for cell in run.__closure__ or ()]
        self._lists = [one for one in cells if isinstance(one, list)]

    def launch(self) -> None:
        kept = [list(one) for one in self._lists]
        before = list(tensors(kept))
        self._run(lambda stage: None)
        for old, new in zip(before, list(tensors(self._lists)), strict=True):
            old.copy_(new)
        for one, old_content in zip(self._lists, kept, strict=True):
            one[:] = old_content


def tensors(held: Any) -> Iterator[Tensor]:
    if isinstance(held, Tensor):
        yield held
    elif isinstance(held, list | tuple):
        for one in held:
            yield from tensors(one)
    elif is_dataclass(held):
        for one in fields(held):
            yield from tensors(getattr(held, one.name))


@pytest.fixture
def on_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(captured, "Graph", Replayed)
    monkeypatch.setattr(captured.CapturedBackend, "unavailable", classmethod(lambda cls, device: None))
    monkeypatch.setattr(captured.CudaGraphBackend, "unavailable", classmethod(lambda cls, device: None))
    monkeypatch.setattr(PyTorchCompileBackend, "unavailable", classmethod(lambda cls, device: "not here"))
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: None)
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: SimpleNamespace(device=device))


@pytest.mark.parametrize("name", CASES)
def test_captured_calls_in_order_give_lerobots_actions(name: str, tmp_path: Path, on_cpu: None) -> None:
    checkpoint = make_checkpoint(name, tmp_path / name)
    policy = UnifiedPolicy(checkpoint, backend="cuda_graph", precision="f32", device="cpu", strict=True)
    golden, queue = MemoryRuns(name), list[np.ndarray]()
    with pytest.raises(ObservationError, match="warmup"):
        policy.infer(golden.observation(0))
    policy.warmup()
    policy.reset()
    part, asks_rarely = "training/" if "proprio" in name or name == "select_action" else "", name == "select_action"
    for run in range(len(golden)):
        if golden.resets(run):
            policy.reset()
            queue.clear()
        theirs = golden.expected(run, part)
        if queue:
            policy.observe(golden.observation(run))
        else:
            actions = policy.infer(golden.observation(run), noise=golden.noise)["actions"]
            queue += list(actions[:3]) if asks_rarely else []
            assert asks_rarely or relative(actions, theirs["actions"]) <= 2e-6
        assert not asks_rarely or relative(queue.pop(0), theirs["selected"]) <= 2e-6
