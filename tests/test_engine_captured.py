"""What is captured in a CUDA graph asks the device for no number, and makes no tensor of Python's numbers there."""

from collections.abc import Callable
from functools import wraps
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from conditioned import conditioned
from test_begin import OnCpu, on_cpu
from test_engine_batch import observations
from torch.utils._python_dispatch import TorchDispatchMode

from turbopi.config import Kind
from turbopi.engine.flat import Staged
from turbopi.models.pi0.conditioning import Conditioning
from turbopi.models.pi0.solvers import Integration

STEPS, H, A = 2, 5, 32
# A tensor's value in Python, a result whose size depends on values, a tensor of Python's numbers.
FORBIDDEN = {
    *("_local_scalar_dense", "equal", "is_nonzero", "nonzero", "masked_select", "_unique2", "lift_fresh", "lift"),
    "repeat_interleave.Tensor",
}


class Requesting(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Fails at an operation that a capture doesn't take."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = function.name().removeprefix("aten::")
        scalar = name.startswith("lift") and args[0].dim() == 0  # what `x[…] = 0` has: on a GPU a kernel's argument
        if not scalar and (name in FORBIDDEN or name.split(".")[0] in FORBIDDEN):
            raise AssertionError(f"a capture can't take {name}")
        if name.startswith(("index.", "index_put")):
            chosen = [one for one in args[1] if one is not None]
            assert all(one.dtype not in (torch.bool, torch.uint8) for one in chosen), f"{name} by a mask"
        return function(*args, **(kwargs or {}))


class Watched(OnCpu):
    def _capture(self, run: Any, after: Any, like: Any = None) -> Any:
        return super()._capture(watched(run), after, like)


def watched(run: Callable[..., None]) -> Callable[..., None]:
    @wraps(run)
    def captured(*arguments: Any) -> None:
        with Requesting():  # type: ignore[no-untyped-call]
            run(*arguments)

    return captured


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pi05", "pi0"])
@pytest.mark.parametrize("rows", [1, 3])
@pytest.mark.parametrize("which", ["plain", "ab2", "staircase", "held_and_identity", "jacobian_and_held"])
def test_nothing_captured_asks_the_host(kind: Kind, rows: int, which: str) -> None:
    requested: Any = {"plain": None, "ab2": Conditioning(integration=Integration("ab2", (1.0, 0.4, 0.0)))}
    reported = requested[which] if which in requested else conditioned(which, STEPS, H, A)
    made, noise = observations(kind, [1, 2, 0][:rows], [3, 5, 7][:rows], H)
    engine = on_cpu(kind, Watched)
    assert engine.sample(made, noise, STEPS, conditioning=[reported] * rows).actions.isfinite().all()


def test_staged_memory_is_written_again_when_its_copy_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    staged, order = Staged({"x": ((2,), torch.float32), "there": ((3,), torch.bool)}, torch.device("cpu")), []
    event = SimpleNamespace(synchronize=lambda: order.append("waited"), record=lambda stream: order.append("sent"))
    monkeypatch.setattr(staged, "_sent", event)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: None)
    arrays = staged.writable()
    arrays["x"][:], arrays["there"][1] = 1, True
    staged.send()
    staged.writable()["x"][:] = 2
    assert order == ["waited", "sent", "waited"]
    assert staged.tensors["x"].tolist() == [1, 1] and staged.tensors["there"].tolist() == [False, True, False]


@pytest.mark.parametrize(
    "wrong",
    [
        lambda x: x[0].item(),
        lambda x: bool(x.sum() > 0),
        lambda x: x[x > 0],
        lambda x: x + torch.tensor([1.0, 2.0]),
        lambda x: torch.where(x > 0),
        lambda x: x.unique(),
    ],
)
def test_what_asks_is_found(wrong: Callable[[torch.Tensor], Any]) -> None:
    with pytest.raises(AssertionError, match=r"a capture can't take|by a mask"):
        watched(wrong)(torch.ones(2))
