"""Float32 that is float32, whatever the caller has set for PyTorch.

`torch.set_float32_matmul_precision`, `allow_tf32`, `fp32_precision` and autocast let products of float32 numbers be
computed from operands rounded to TensorFloat-32 or bfloat16. `exact_float32` forbids it around the code that must not
depend on them, and sets back what it found.

cuDNN's switches (`allow_tf32`, `benchmark`, `deterministic`) stay as they are: the model has no convolution and asks
cuDNN for nothing in float32.
"""

import threading
from contextlib import ContextDecorator, ExitStack
from typing import Any

import torch

_GROUPS = ("cuda", "mkldnn")  # whose products have a switch of their own, since PyTorch 2.9
_DEVICES = ("cuda", "cpu")  # whose autocast is asked for


class _Switches:
    """The process' switches, set while any call is within. They are of all threads, so the last one out sets them back.

    Another thread that changes them while a call is within changes them for that call, too, until the next one comes.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._within = 0
        self._found: dict[str, str] | None = None  # what a caller had set; None: nothing that matters

    def enter(self) -> None:
        with self._lock:
            self._within += 1
            if not _is_exact(found := products()):
                self._found = found
                torch.set_float32_matmul_precision("highest")  # also of each group
                for group in _groups():
                    torch._C._set_fp32_precision_setter(group, "matmul", "ieee")

    def leave(self) -> None:
        with self._lock:
            self._within -= 1
            if self._within or self._found is None:
                return
            found, self._found = self._found, None
            torch.set_float32_matmul_precision(found["all"])
            for group in _groups():
                torch._C._set_fp32_precision_setter(group, "matmul", "none")  # takes torch.backends.fp32_precision
                if torch._C._get_fp32_precision_getter(group, "matmul") != found[group]:
                    torch._C._set_fp32_precision_setter(group, "matmul", found[group])


_switches = _Switches()


class exact_float32(ContextDecorator):
    """Products of float32 numbers are of float32 numbers within, on every device, and autocast is off.

    `with exact_float32():` or `@exact_float32()`. What was set before is set back at the end, also when that is an
    error. Autocast is of a thread, the other switches are of the process: see `_Switches`.
    """

    def __init__(self) -> None:
        self._local = threading.local()  # a decorator's one object is entered by several threads, and within itself

    def __enter__(self) -> None:
        _switches.enter()
        stack = ExitStack()
        for device in autocast():
            stack.enter_context(torch.autocast(device, enabled=False))
        self._local.__dict__.setdefault("stacks", []).append(stack)

    def __exit__(self, *raised: Any) -> None:
        self._local.stacks.pop().close()
        _switches.leave()


def products() -> dict[str, str]:
    """How products of float32 numbers are computed now: "highest" or "ieee" is float32, anything else coarser.

    "all" is `torch.get_float32_matmul_precision()`, which PyTorch can't say once the newer switches contradict it.
    """
    found = {group: torch._C._get_fp32_precision_getter(group, "matmul") for group in _groups()}
    try:
        found["all"] = torch.get_float32_matmul_precision()
    except RuntimeError:
        found["all"] = "highest" if found.get("cuda") == "tf32" or found.get("mkldnn") != "ieee" else "high"
    return found


def autocast() -> list[str]:
    """The devices whose autocast is on in this thread."""
    return [device for device in _DEVICES if torch.is_autocast_enabled(device)]


def certificate() -> dict[str, Any]:
    """What a certificate says of the oracle's float32: what is in force within its calls, and what the caller had."""
    found: dict[str, Any] = {"products": products(), "autocast": autocast()}
    with exact_float32():
        within: dict[str, Any] = {"products": products(), "autocast": autocast()}
    return {"exact": _is_exact(within["products"]) and not within["autocast"], "within": within, "callers": found}


def _is_exact(found: dict[str, str]) -> bool:
    return found["all"] == "highest" and all(found[group] in ("none", "ieee") for group in _groups())


def _groups() -> tuple[str, ...]:
    return _GROUPS if hasattr(torch._C, "_get_fp32_precision_getter") else ()
