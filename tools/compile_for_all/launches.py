"""The Triton kernels' launches as they would be on a GPU that isn't here.

The product's own functions are called with tensors that have no data (`FakeTensorMode`), and what they launch is noted
down instead. So a variant is compiled exactly as the product would: argument types, constants, warps and stages.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from triton.runtime.jit import JITFunction

from compile_for_all.targets import MULTIPROCESSORS, Target
from turbopi.kernels.dependent_launch import capability
from turbopi.kernels.portable.gemm.kernel import gpu

TYPES = {
    torch.bfloat16: "bf16",
    torch.float32: "fp32",
    torch.float8_e4m3fn: "fp8e4nv",
    torch.float16: "fp16",
    torch.uint8: "u8",
    torch.int8: "i8",
    torch.int32: "i32",
    torch.int64: "i64",
}
OPTIONS = ("num_warps", "num_stages", "launch_pdl", "num_ctas", "arch")


@dataclass(frozen=True)
class Launch:
    """A kernel's specialisation: of Triton's `ASTSource`, and of its options."""

    kernel: Any
    signature: tuple[tuple[str, str], ...]
    constants: tuple[tuple[str, Any], ...]
    divisible: tuple[str, ...]  # arguments that are multiples of 16
    options: tuple[tuple[str, Any], ...]

    @property
    def name(self) -> str:
        module = self.kernel.__module__.removeprefix("turbopi.kernels.portable.")
        return f"{module}.{self.kernel.__name__.strip('_').removesuffix('_kernel')}"

    @property
    def variant(self) -> str:
        """What sets it apart from the kernel's others."""
        chosen = [f"{name}={int(value)}" for name, value in self.constants if name.isupper() and name != "PDL"]
        options = [f"{name}={int(v)}" for name, v in self.options if name not in ("launch_pdl", "arch")]
        pointers = sorted({kind[1:] for _, kind in self.signature if kind.startswith("*")})
        return " ".join([*chosen, *options, *pointers])

    @property
    def threads(self) -> int:
        return 32 * int(dict(self.options).get("num_warps", 4))


def launch_of(kernel: Any, args: tuple[Any, ...], given: dict[str, Any]) -> Launch:
    """As `JITFunction.run` binds them."""
    options = {name: given.pop(name) for name in OPTIONS if name in given}
    values = dict(zip(kernel.arg_names, args, strict=False)) | given
    constexprs = {param.name for param in kernel.params if param.is_constexpr}
    assert values.keys() == set(kernel.arg_names), f"{kernel.__name__}: {values.keys() ^ set(kernel.arg_names)}"
    signature, constants, divisible = [], [], []
    for name in kernel.arg_names:
        value = values[name]
        if name in constexprs or value is None or (type(value) is int and value == 1):
            signature.append((name, "constexpr"))
            constants.append((name, value))
            continue
        if isinstance(value, torch.Tensor):
            signature.append((name, f"*{TYPES[value.dtype]}"))
        else:
            signature.append((name, "fp32" if isinstance(value, float) else "i32" if value < 1 << 31 else "i64"))
        if isinstance(value, torch.Tensor) or (isinstance(value, int) and value % 16 == 0):
            divisible.append(name)
    return Launch(kernel, tuple(signature), tuple(constants), tuple(divisible), tuple(sorted(options.items())))


@contextmanager
def on(target: Target) -> Iterator[None]:
    """The product takes fake tensors to be on this GPU."""
    properties = SimpleNamespace(multi_processor_count=MULTIPROCESSORS[target.capability])
    caches = (capability, gpu)
    with (
        patch("torch.cuda.get_device_capability", lambda *_: target.capability),
        patch("torch.cuda.get_device_properties", lambda *_: properties),
    ):
        for cache in caches:
            cache.cache_clear()
        yield
    for cache in caches:
        cache.cache_clear()


def launches(target: Target, calls: list[Callable[[], Any]]) -> list[Launch]:
    """What `calls`, which take no data, would launch on this GPU: each specialisation once, in order."""
    found: dict[Launch, None] = {}

    def note(self: Any, *args: Any, grid: Any, warmup: bool, **given: Any) -> None:
        found.setdefault(launch_of(self, args, given))

    with on(target), patch.object(JITFunction, "run", note), FakeTensorMode(allow_non_fake_inputs=True):
        for call in calls:
            call()
    return list(found)
