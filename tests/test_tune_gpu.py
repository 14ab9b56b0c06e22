"""The tuner on a GPU: small operations of every kind, really compiled, checked and timed."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import pytest
import torch

pytest.importorskip("triton", reason="Triton isn't installed")

from conftest import on_hopper

from turbopi.config import preset
from turbopi.kernels.portable.gemm.tiles import fp8_refusal
from turbopi.kernels.tile_table import NO_TILES, Numbers, TileTable
from turbopi.tune import hopper, portable
from turbopi.tune.gpu import steadiness
from turbopi.tune.plan import bench_maker
from turbopi.tune.race import Bench, Raced, race
from turbopi.tune.shapes import Call, Norm, Operation, Precision, operations

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU")]
DEVICE = torch.device("cuda", 0)
MODEL = preset("pi05_libero").planned_model
FEW = 6  # candidates of each


@cache
def bench() -> Callable[[Operation, TileTable], Bench]:
    return bench_maker(MODEL, DEVICE)


def raced(one: Operation) -> Raced:
    properties = torch.cuda.get_device_properties(DEVICE)
    sms = properties.multi_processor_count
    if one.kernels == "hopper":
        candidates = hopper.candidates(one, sms)
    else:
        candidates = portable.candidates(one, (properties.major, properties.minor), sms)
    return race(bench()(one, NO_TILES), candidates[:FEW])


def check(one: Operation) -> int:
    """How many tiles were timed."""
    found = raced(one)
    assert not [why for why in found.refused.values() if why.startswith("its ")], "no result of ours is wrong"
    assert 0 < found.best.microseconds <= found.usual.microseconds < 1e4
    return found.timed


@pytest.mark.parametrize("kind", ["vision_attention", "prefix_attention", "packed_attention", "suffix_attention"])
@pytest.mark.parametrize("out_fp8", [False, True])
def test_portable_attention(kind: str, out_fp8: bool) -> None:
    if out_fp8 and fp8_refusal(torch.cuda.get_device_capability(DEVICE)):
        pytest.skip("has no FP8")
    rows, heads, dim = (512, 16, 72) if kind == "vision_attention" else (512, 8, 256)
    one = Operation(kind, "portable", kind, "bf16", rows, heads, dim, 1, out_fp8=out_fp8, images=2, batch=2)
    if kind == "suffix_attention":
        one = Operation(kind, "portable", kind, "bf16", 20, heads, dim, 1, out_fp8=out_fp8, batch=2, prefix_rows=560)
    found = raced(one)
    assert not [why for why in found.refused.values() if why.startswith("its ")]
    assert 0 < found.best.microseconds <= found.usual.microseconds


@pytest.mark.parametrize(
    ("operation", "numbers", "in_front", "behind"),
    [
        *(("geglu", "bf16", "rms", None), ("geglu", "fp8", "rms", None), ("plain", "fp8", None, None)),
        *(("gelu", "fp8", "layer", None), ("parts", "fp8", None, "rms"), ("parts", "fp8", None, "layer")),
    ],
)
def test_portable_products(operation: str, numbers: Numbers, in_front: Norm | None, behind: Norm | None) -> None:
    if numbers == "fp8" and fp8_refusal(torch.cuda.get_device_capability(DEVICE)):
        pytest.skip("has no FP8")
    out_fp8, bias = numbers == "fp8" and operation in ("gelu", "geglu"), "layer" in (in_front, behind)
    usual = Operation(operation, "portable", operation, numbers, 500, 1024, 1152, 1, bias=bias, out_fp8=out_fp8)
    assert check(replace(usual, norm_in_front=in_front, norm_behind=behind)) > 1


@on_hopper
@pytest.mark.parametrize("batch", [1, 4])
@pytest.mark.parametrize("precision", ["bf16", "fp8"])
def test_hoppers_products(precision: Precision, batch: int) -> None:
    found = operations(MODEL, Call(1, 48, batch), precision, "hopper", horizon=10)
    sms = torch.cuda.get_device_properties(DEVICE).multi_processor_count
    timed = [check(hopper.resolved(one, sms)) for one in found if one.kernels == "hopper"]
    assert max(timed) > 1  # of some the first candidates don't fit, and the usual tile stays


@pytest.mark.parametrize("precision", ["bf16", "fp8"])
def test_the_experts_portable_operations_in_its_layers(precision: Precision) -> None:
    if precision == "fp8" and fp8_refusal(torch.cuda.get_device_capability(DEVICE)):
        pytest.skip("has no FP8")
    found = operations(MODEL, Call(1, 48, 4), precision, "portable", horizon=10)
    timed = [check(one) for one in found if one.in_layers]
    assert len(timed) == (5 if precision == "fp8" else 2) and max(timed) > 1


def test_an_idle_gpu_is_steady() -> None:
    assert all(taken > 0 for taken in steadiness(DEVICE))
