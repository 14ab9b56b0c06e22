"""What a caller sets for PyTorch's float32 products reaches neither the oracle nor what is captured, and stays set."""

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from conftest import golden_cases, golden_model
from torch.utils._python_dispatch import TorchDispatchMode

from turbopi.models.pi0 import exact
from turbopi.models.pi0.exact import autocast, exact_float32, products
from turbopi.models.pi0.reference import Pi0Model

NEWER = hasattr(torch._C, "_get_fp32_precision_getter")
newer = pytest.mark.skipif(not NEWER, reason="switches of PyTorch 2.9")


def set_cuda(value: str) -> None:
    torch.backends.cuda.matmul.fp32_precision = value


def set_all(value: str) -> None:
    torch.backends.fp32_precision = value  # type: ignore[attr-defined]


def allow_tf32() -> None:
    torch.backends.cuda.matmul.allow_tf32 = True


COARSE: dict[str, Callable[[], Any]] = {
    "set_float32_matmul_precision high": lambda: torch.set_float32_matmul_precision("high"),
    "set_float32_matmul_precision medium": lambda: torch.set_float32_matmul_precision("medium"),
    "allow_tf32": allow_tf32,
}
if NEWER:
    COARSE |= {"cuda.matmul.fp32_precision": lambda: set_cuda("tf32"), "fp32_precision": lambda: set_all("tf32")}


@pytest.fixture(autouse=True)
def _as_a_process_begins() -> Iterator[None]:
    def reset() -> None:
        torch.set_float32_matmul_precision("highest")
        if NEWER:
            torch.backends.fp32_precision = "none"  # type: ignore[attr-defined]
            for group in exact._GROUPS:
                torch._C._set_fp32_precision_setter(group, "matmul", "none")

    reset()
    yield
    reset()


def what_is_set() -> dict[str, str]:
    more = {"generic": torch.backends.fp32_precision} if NEWER else {}  # type: ignore[attr-defined]
    return products() | more


def is_exact() -> bool:
    return exact._is_exact(products()) and autocast() == []


def coarse() -> dict[str, str]:
    COARSE["set_float32_matmul_precision high"]()
    return what_is_set()


@pytest.mark.parametrize("how", COARSE)
def test_the_reference_sets_what_it_needs_and_sets_back_what_it_found(
    how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    case, model = golden_cases()["b_third_masked"], golden_model("pi05")
    expected = model.sample(case.observation, case.noise, 2)
    seen: list[bool] = []

    def watched(part: Any) -> Any:
        def run(self: Pi0Model, *arguments: Any) -> Any:
            seen.append(is_exact())
            return part(self, *arguments)

        return run

    for name in ("embed_images", "encode_prefix", "velocity", "time_condition"):
        monkeypatch.setattr(Pi0Model, name, watched(getattr(Pi0Model, name)))
    COARSE[how]()
    before = what_is_set()
    assert not is_exact()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = model.sample(case.observation, case.noise, 2)
        apart = model.denoise(model.prefix(case.observation), case.noise, 2)
        assert autocast() == ["cpu"]
    assert len(seen) == 10 and all(seen)
    assert torch.equal(found, expected) and torch.equal(apart, expected)
    assert what_is_set() == before and not is_exact()


@pytest.mark.parametrize("how", COARSE)
def test_they_are_set_back_behind_an_error(how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    case, model = golden_cases()["b_third_masked"], golden_model("pi05")

    def fail(*_: Any) -> Any:
        assert is_exact()
        raise RuntimeError("out of luck")

    monkeypatch.setattr(Pi0Model, "velocity", fail)
    COARSE[how]()
    before = what_is_set()
    with torch.autocast("cpu", dtype=torch.bfloat16), pytest.raises(RuntimeError, match="out of luck"):
        model.sample(case.observation, case.noise, 2)
    assert what_is_set() == before


@newer
def test_what_was_inherited_is_inherited_again() -> None:
    set_all("tf32")
    with exact_float32():
        assert is_exact()
    set_all("ieee")
    assert products()["cuda"] == "ieee"


def test_what_is_exact_is_left_alone() -> None:
    before = what_is_set()
    with exact_float32():
        assert what_is_set() == before
    assert what_is_set() == before


def test_the_last_of_several_threads_sets_them_back() -> None:
    """The first one in leaves first, while the second one still computes."""
    before = coarse()
    inside, left, reported = threading.Event(), threading.Event(), list[bool]()

    def second() -> None:
        with exact_float32():
            inside.set()
            assert left.wait(30)
            reported.append(is_exact())

    with exact_float32():
        thread = threading.Thread(target=second)
        thread.start()
        assert inside.wait(30)
    left.set()
    thread.join(30)
    assert reported == [True]
    assert what_is_set() == before


def test_a_switch_turned_during_a_call_is_turned_for_the_next_one() -> None:
    with exact_float32():
        coarse()
        with exact_float32():
            assert is_exact()
    assert products()["all"] == "high"


def test_the_float32_reference_asks_cudnn_for_nothing() -> None:
    """So its switches can't coarsen it: no convolution, no recurrent layer, no attention but our own."""
    requested: list[str] = []

    class Watching(TorchDispatchMode):  # type: ignore[no-untyped-call]
        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            requested.append(str(func))
            return func(*args, **(kwargs or {}))

    case = golden_cases()["b_third_masked"]
    with Watching():  # type: ignore[no-untyped-call]
        golden_model("pi05").sample(case.observation, case.noise, 1)
    assert any("addmm" in name or "mm" in name for name in requested)
    assert not [
        name for name in requested if any(word in name for word in ("conv", "cudnn", "scaled_dot", "rnn", "lstm"))
    ]
