"""CUDA graphs run again on a CPU: what a capture holds asks no host (`test_engine_captured.watched`)."""

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from test_engine_captured import watched
from torch import Tensor

from turbopi.backends import captured, tokens
from turbopi.backends.pytorch_compile import PyTorchCompileBackend


class Replayed:
    """A graph that runs its operations again, into the tensors that the first run left in its lists."""

    launches = 0

    def __init__(self, run: Callable[..., None], pool: Any, stream: Any) -> None:
        self._run = watched(run)
        self._run(lambda stage: None)
        cells = [cell.cell_contents for cell in run.__closure__ or ()]
        self._lists = [one for one in cells if isinstance(one, list)]

    def launch(self) -> None:
        Replayed.launches += 1
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


def replay_on_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Backend `cuda_graph` of families without a plan runs on a CPU, uncompiled."""
    for module in (captured, tokens):
        monkeypatch.setattr(module, "Graph", Replayed)
    monkeypatch.setattr(captured.CapturedBackend, "unavailable", classmethod(lambda cls, device: None))
    monkeypatch.setattr(captured.CudaGraphBackend, "unavailable", classmethod(lambda cls, device: None))
    monkeypatch.setattr(PyTorchCompileBackend, "unavailable", classmethod(lambda cls, device: "not here"))
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: None)
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: SimpleNamespace(device=device))
