"""What a sequence of kernels needs is compiled side by side, before it runs."""

import threading
from typing import Any

import pytest
import torch
from torch import Tensor

from turbopi.kernels.ahead import MadeOnce, compiling_ahead, noting


class Loaded:
    """In place of a kernel."""

    max_clusters = 66

    def __init__(self) -> None:
        self.launches = 0

    def launch_dependent(self, blocks: int, given: dict[str, Any]) -> None:
        self.launches += 1


def test_kernels_are_made_side_by_side_and_none_is_launched(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("turbopi.kernels.ahead.usable_processors", lambda: 3)
    together, made = threading.Barrier(3, timeout=60), []

    @MadeOnce
    def make(name: str) -> Loaded:
        together.wait()  # ends only if three are made at a time
        made.append(name)
        return Loaded()

    with compiling_ahead():
        for name in "abcabc":
            assert make(name).max_clusters >= 1 << 16
            make(name).launch_dependent(1, {})
    assert sorted(made) == ["a", "b", "c"]
    kernel = make("a")
    kernel.launch_dependent(1, {})
    assert sorted(made) == ["a", "b", "c"] and kernel.launches == 1 and make("a") is kernel


def test_what_does_not_compile_fails_where_it_is_launched() -> None:
    @MadeOnce
    def make(name: str) -> Loaded:
        raise ValueError(f"{name} doesn't compile")

    with compiling_ahead():
        make("a").launch_dependent(1, {})
    with pytest.raises(ValueError, match="a doesn't compile"):
        make("a")


def test_only_the_thread_that_compiles_ahead_notes() -> None:
    seen: list[bool] = []
    with compiling_ahead():
        other = threading.Thread(target=lambda: seen.append(noting()))
        other.start()
        other.join()
        assert noting() and seen == [False]
    assert not noting()
    with pytest.raises(RuntimeError, match="a stage fails"), compiling_ahead():
        raise RuntimeError("a stage fails")
    assert not noting()


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Whether each launch of a Triton kernel only warmed up."""
    jit = pytest.importorskip("triton.runtime.jit")
    found: list[bool] = []
    monkeypatch.setattr(jit.JITFunction, "run", lambda _, *given, grid, warmup, **named: found.append(warmup))
    return found


def test_tritons_kernels_only_warm_up_while_compiling_ahead(runs: list[bool]) -> None:
    from triton.runtime.jit import JITFunction

    run = JITFunction.run
    launched = JITFunction(test_tritons_kernels_only_warm_up_while_compiling_ahead)
    launched[(1,)]()
    with compiling_ahead():
        launched[(1,)]()
        other = threading.Thread(target=launched[(1,)])
        other.start()
        other.join()
    launched[(1,)]()
    assert runs == [False, True, False, False] and JITFunction.run is run


@pytest.mark.gpu
def test_a_kernel_compiled_ahead_runs_when_it_is_launched() -> None:
    from turbopi.kernels.portable import norms, transfer
    from turbopi.kernels.sm90.norms import layer_norm

    def launch(source: Tensor, to: Tensor, x: Tensor, weight: Tensor) -> Tensor:
        transfer.transfer(source, to)
        return layer_norm.residual_layer_norm(x, None, weight, weight, 1e-6)[1]

    source, to = torch.arange(64, device="cuda"), torch.zeros(64, dtype=torch.int64, device="cuda")
    x, weight = torch.randn(layer_norm.ROWS, 128, device="cuda").bfloat16(), torch.ones(128, device="cuda").bfloat16()
    with compiling_ahead():
        launch(source, to, x, weight)
    torch.cuda.synchronize()
    assert not to.any()
    assert torch.cuda.current_device() in transfer._transfer_kernel.device_caches
    normed = launch(source, to, x, weight)
    assert torch.equal(source, to)
    torch.testing.assert_close(normed, norms.residual_layer_norm(x, None, weight, weight, 1e-6)[1])
