"""Each operation of a backend beside its reference in plain PyTorch, on the very inputs that a call gives it.

An operation that isn't right is named, and PyTorch's result goes on in its place, so that what comes behind
it is judged by itself.
"""

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from turbopi.backends.device_lost import Guard
from turbopi.backends.qualification import DENOISE
from turbopi.kernels.ahead import noting
from turbopi.kernels.interface import Ops
from turbopi.kernels.ops import BESIDE
from turbopi.kernels.plain import PLAIN
from turbopi.tune.race import first_line, wrong

# Of two results' difference, relative rms. Each rounds to bfloat16 once or twice, which is 0.0011 a time; E4M3 to 0.026
BOUND, EIGHT_BITS_BOUND = 0.01, 0.06
TABLE_BYTES = 256 << 20  # from here on a tensor is the table of embeddings, which nothing writes to
AHEAD = "compiling side by side"  # among what is excluded
COMPILING, RUNNING = (
    300.0,
    10.0,
)  # seconds at most: on the host of a small machine; on the GPU, which needs milliseconds
At = Callable[[str, str, float], None]  # what begins, what to exclude if it fails, seconds


class Comparison:
    """errors: the worst of each operation that was compared; failed: why one isn't right; compares: whether it does.

    ahead: whether kernels may be compiled side by side. Where that ends the process, the next one finds out by which.
    """

    def __init__(self, device: torch.device, at: At, ahead: bool = True) -> None:
        self.compares, self._ahead = True, ahead
        self.errors: dict[str, float] = {}
        self.failed: dict[str, str] = {}
        self._at, self._device, self._guard = at, device, Guard(device)

    def around(self, ops: Ops) -> Ops:
        """The same operations, each compared while no graph is captured. One without a reference stays as it is."""
        compared: dict[str, Any] = {}
        for one in fields(Ops):
            ours, plain = getattr(ops, one.name), getattr(BESIDE, one.name)
            if callable(ours) and callable(plain) and ours not in (plain, getattr(PLAIN, one.name)):
                compared[one.name] = partial(self._both, one.name, ours, plain)
        return replace(ops, **compared)

    def denoiser(self, make: Callable[..., Any], *given: Any, **named: Any) -> Any:
        """What `make` makes; its launches are waited for."""
        self._at("the denoising kernel", DENOISE, COMPILING)
        made = make(*given, **named)
        return None if made is None else _Waited(made, self)

    def launched(self, launch: Callable[..., None], *given: Any) -> None:
        if capturing():
            launch(*given)
            return
        self._at("the denoising kernel", DENOISE, RUNNING)
        launch(*given)
        self._wait()
        self._at("kernels", "", COMPILING)

    def _wait(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)

    def _both(self, name: str, ours: Callable[..., Any], plain: Callable[..., Any], *given: Any, **named: Any) -> Any:
        if name in self.failed:
            return plain(*given, **named)
        if noting():
            if not self._ahead:
                return plain(*given, **named)
            self._at("compiling kernels", AHEAD, COMPILING)
            return ours(*given, **named)
        if not self.compares or capturing():
            return ours(*given, **named)
        if name not in self.errors:
            self._at(f"operation {name}", name, COMPILING)
            self.errors[name] = 0.0
        before, named_before = [_copy(one) for one in given], {key: _copy(one) for key, one in named.items()}
        try:
            exact = plain(*before, **named_before)
        except (TypeError, AttributeError):  # an input of our kernels' own
            self.errors.pop(name)
            return ours(*given, **named)
        try:
            result = ours(*given, **named)
            self._wait()
            error, bound = _difference((result, *given, *named.values()), (exact, *before, *named_before.values()))
            why = wrong(error, bound)
        except torch.OutOfMemoryError:
            raise
        except Exception as failure:  # that it doesn't run is a result
            self._guard.examine(failure)
            why, error = first_line(failure), float("inf")
        self.errors[name] = max(self.errors[name], error)
        if why is None:
            return result
        self.failed[name] = why
        for place, right in zip((*given, *named.values()), (*before, *named_before.values()), strict=True):
            if isinstance(place, Tensor):
                place.copy_(right)
        return exact


class _Waited:
    """A denoising kernel whose launches are waited for."""

    def __init__(self, kernel: Any, compared: Comparison) -> None:
        self._kernel, self._compared = kernel, compared

    def launch(self, *given: Any) -> None:
        self._compared.launched(self._kernel.launch, *given)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._kernel, name)


def capturing() -> bool:
    return torch.cuda.is_available() and torch.cuda.is_current_stream_capturing()


def _copy(value: Any) -> Any:
    """What an operation may write to."""
    return value.clone() if isinstance(value, Tensor) and value.nbytes < TABLE_BYTES else value


def _difference(ours: object, exact: object) -> tuple[float, float]:
    """(the largest relative rms of tensors that stand at the same place, its bound); parts [n, …] are added up."""
    worst, bound = 0.0, BOUND
    for a, b in _pairs(ours, exact):
        if not b.dtype.is_floating_point and b.dtype != torch.int8:
            continue
        here = EIGHT_BITS_BOUND if b.dtype.itemsize == 1 else BOUND
        x, y = (a.float().sum(0) if a.dim() == b.dim() + 1 else a.float()).to(b.device), b.float()
        if x.shape != y.shape or not torch.equal(x.isnan(), y.isnan()):
            return float("nan"), here
        x, y = x.nan_to_num(), y.nan_to_num()
        error = float((x - y).norm() / y.norm().clamp(min=1e-30))
        if error / here >= worst / bound:
            worst, bound = error, here
    return worst, bound


def _pairs(ours: object, exact: object) -> Iterator[tuple[Tensor, Tensor]]:
    if isinstance(ours, Tensor) and isinstance(exact, Tensor):
        yield ours, exact
    elif isinstance(ours, tuple) and isinstance(exact, tuple):
        for a, b in zip(ours, exact, strict=True):
            yield from _pairs(a, b)
