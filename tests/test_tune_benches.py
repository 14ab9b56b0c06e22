"""The operations that the tuner measures are given what a call gives them, and a wrong result is seen: on a CPU.

Portable kernels run in Triton's interpreter; of Hopper's the arithmetic of their forms, and the layout of every tile.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")
if torch.cuda.is_available():
    pytest.skip("of a machine without a GPU: on one `turbopi tune` itself runs", allow_module_level=True)

from turbopi.config import preset
from turbopi.kernels import plain
from turbopi.kernels.portable import norms
from turbopi.kernels.sm90.gemm import bf16, fp8
from turbopi.kernels.sm90.gemm.bf16 import Folded, Tile
from turbopi.kernels.sm90.gemm.fp8 import FoldedFp8
from turbopi.kernels.tile_checks import why_not
from turbopi.kernels.tile_table import LIBRARY, Knobs, TileTable
from turbopi.quantization.fp8 import E4M3, ScaledMatrix, to_e4m3
from turbopi.tune import gpu, hopper, portable, product_bench
from turbopi.tune.gpu import GpuBench
from turbopi.tune.in_layers import ExpertLayers, InLayers, LayersOf
from turbopi.tune.race import Round, race
from turbopi.tune.shapes import Call, Operation, operations

CPU = torch.device("cpu")
SMS = 132
FULL = preset("pi05_libero").planned_model
pytestmark = [pytest.mark.filterwarnings(f"ignore::{one}") for one in ("RuntimeWarning", "DeprecationWarning")]


@pytest.fixture(autouse=True)
def on_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(product_bench, "cold_copies", lambda size, device: 2)
    monkeypatch.setattr(gpu, "poison", lambda size, device: None)


@pytest.fixture
def float32(monkeypatch: pytest.MonkeyPatch) -> None:
    """The interpreter has no bfloat16."""

    def random(self: GpuBench, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self._generator, device=self.device)

    monkeypatch.setattr(GpuBench, "random", random)


@pytest.fixture
def plain_norms(monkeypatch: pytest.MonkeyPatch) -> None:
    """The interpreter has no E4M3 either."""
    monkeypatch.setattr(norms, "residual_layer_norm", plain.residual_layer_norm)
    monkeypatch.setattr(norms, "residual_rms_norm", plain.residual_rms_norm)


def product(operation: str, numbers: Any = "fp8", **more: Any) -> Operation:
    return Operation("prefix qkv", "portable", operation, numbers, 40, 32, 64, 17, **more)


SMALL = {"rows": 32, "columns": 64, "warps": 4, "stages": 6, "splits": 1}


@pytest.mark.usefixtures("float32")
@pytest.mark.parametrize(
    "one",
    [
        *(product("plain"), product("plain", bias=True), product("gelu", bias=True), product("geglu")),
        *(product("parts", norm_behind="rms"), product("geglu", "bf16")),
    ],
)
def test_portable_products_are_right_by_their_own_measure(one: Operation) -> None:
    bench = portable.bench(one, CPU)
    assert bench.error(SMALL) <= bench.bound < 0.05


@pytest.mark.usefixtures("float32", "plain_norms")
@pytest.mark.parametrize("norm", ["layer", "rms"])
@pytest.mark.parametrize("numbers", ["bf16", "fp8"])
def test_a_norm_in_front_runs_before_each_product_which_takes_its_result(
    norm: Any, numbers: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = product("geglu", numbers, norm_in_front=norm)
    bench = portable.bench(one, CPU)
    assert bench.error(SMALL) <= bench.bound < 0.05
    assert in_a_call(bench, SMALL, "product", portable, monkeypatch) == ["norm", "product of it"]


@pytest.mark.usefixtures("float32", "plain_norms")
def test_a_norm_behind_runs_after_each_product(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = portable.bench(product("parts", norm_behind="rms"), CPU)
    assert in_a_call(bench, SMALL, "product", portable, monkeypatch) == ["product", "norm"]


def in_a_call(bench: GpuBench, knobs: Knobs, name: str, module: Any, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is launched where this is timed; `name` is the product's, in that module."""
    launched: list[str] = []
    made: list[Tensor] = []

    def norm(kernel: Any) -> Any:
        def run(*given: Any) -> Any:
            launched.append("norm")
            result = kernel(*given)
            made.append(result[1])
            return result

        return run

    def product(x: Tensor, *given: Any, **more: Any) -> Any:
        launched.append("product of it" if made and x is made[-1] else "product")
        return multiplied(x, *given, **more)

    multiplied = getattr(module, name)
    with monkeypatch.context() as patch:
        patch.setattr(module, name, product)
        for kernel in ("residual_layer_norm", "residual_rms_norm"):
            patch.setattr(norms, kernel, norm(getattr(norms, kernel)))
        bench.in_call(knobs, 1)
    return launched


@pytest.mark.usefixtures("float32")
@pytest.mark.parametrize("kind", ["vision_attention", "prefix_attention", "packed_attention", "suffix_attention"])
@pytest.mark.parametrize("rows", [16, 64])
def test_portable_attention_is_right_by_its_own_measure(kind: str, rows: int) -> None:
    one = Operation("attention", "portable", kind, "bf16", 32, 2, 16, 1, images=2, batch=2, prefix_rows=24)
    tile = {"rows": 64 if kind == "packed_attention" else rows, "keys": 16, "warps": 4, "stages": 2}
    bench = portable.bench(one, CPU)
    assert bench.error(tile) <= bench.bound < 0.02


@pytest.mark.usefixtures("float32")
@pytest.mark.parametrize("damage", ["another number", "a row left out"])
def test_a_damaged_result_is_refused(damage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ours: Any = portable.product

    def wrong(x: Tensor, *rest: Any) -> Tensor:
        tile, out = rest[-1], rest[3]
        if tile.columns != 32:
            return ours(x, *rest)
        result = ours(x, *rest[:3], None, *rest[4:])
        if damage == "another number":
            return result * 1.2
        out[:-1] = result[:-1]
        return out

    monkeypatch.setattr(portable, "product", wrong)
    bench = portable.bench(product("plain"), CPU)
    monkeypatch.setattr(bench, "prepare", lambda candidates: {})
    monkeypatch.setattr(bench, "timer", lambda knobs: timer(9.0 if knobs["columns"] == 64 else 1.0))
    raced = race(bench, [SMALL, SMALL | {"columns": 32}])
    assert raced.best.knobs == SMALL and raced.timed == 1
    assert ("finite" if damage == "a row left out" else "at most") in raced.refused[1]


def timer(microseconds: float) -> Round:
    return lambda: microseconds


def test_the_first_candidate_is_what_runs_without_a_table() -> None:
    for precision in ("bf16", "fp8"):
        for one in operations(FULL, Call(2, 48, 4), precision, "portable", horizon=10):
            found = portable.candidates(one, (8, 9), 128)
            assert found[0] == portable.usual(one, (8, 9), 128)
            assert len(found) == len({tuple(sorted(knobs.items())) for knobs in found}), one
            assert len(found) > 1 or one.operation in ("packed_attention", "suffix_attention"), one
            assert all(why_not(one.key, knobs, (8, 9)) is None for knobs in found), one


# ---- Hopper


def hoppers(precision: Any, batch: int = 1) -> list[Operation]:
    found = operations(FULL, Call(2, 48, batch), precision, "hopper", horizon=10)
    return [hopper.resolved(one, SMS) for one in found if one.kernels == "hopper"]


def finished(epilogue: str, sums: Tensor) -> Tensor:
    return plain.gelu(sums) if epilogue == "gelu" else plain.geglu(sums) if epilogue == "geglu" else sums


def statistics_of(sums: bf16.Sums, width: int, eps: float) -> tuple[Tensor, Tensor]:
    """(mean, 1 / deviation) [M, 1]"""
    total = sums.parts.double().sum(0) / width
    mean = total[:, :1]
    return mean, (total[:, 1:] - mean.square() + eps).rsqrt()


def matmul_reference(
    a: Tensor, weight: Any, tile: Tile, epilogue: Any, bias: Any = None, out: Any = None, **more: Any
) -> Any:
    """`bf16.matmul`, in float64, for every layout that it asserts."""
    data = weight.data if isinstance(weight, Folded) else weight
    n = data.shape[0] // 2 if epilogue == "geglu" else data.shape[0]
    residual = more.get("residual")
    bf16.layout(tile, epilogue, len(a), n, -(-a.shape[1] // bf16.DEPTH), residual, more.get("sums_out"))
    sums = a.double() @ data.double().T
    if isinstance(weight, Folded):
        mean, factor = statistics_of(more["sums"], a.shape[1], more["eps"])
        sums = (sums - mean * weight.sums) * factor + weight.offset
    return stored(
        finished(epilogue, sums if bias is None else sums + bias.double()), tile, epilogue, out, residual, None
    )


def fp8_reference(
    a: Tensor,
    weight: Any,
    tile: Tile,
    epilogue: Any,
    bias: Any = None,
    out: Any = None,
    inverse: Any = None,
    **more: Any,
) -> Any:
    """`fp8.matmul_fp8`, likewise."""
    matrix = weight.matrix if isinstance(weight, FoldedFp8) else weight
    assert a.dtype == E4M3 and isinstance(matrix, ScaledMatrix)
    n = matrix.shape[0] // 2 if epilogue == "geglu" else matrix.shape[0]
    residual = more.get("residual")
    bf16.layout(tile, epilogue, len(a), n, -(-a.shape[1] // fp8.DEPTH), residual, more.get("sums_out"))
    sums = a.double() @ matrix.data.double().T
    if isinstance(weight, FoldedFp8):
        mean, factor = statistics_of(more["sums"], a.shape[1], fp8.NO_EPS)
        sums = (sums * weight.scale - mean * weight.of_scale - weight.of_shift) * factor + weight.of_shift
    else:
        sums = sums * matrix.scale
    assert bias is None or epilogue not in ("plain", "geglu", "parts")
    sums = sums if bias is None else sums + bias.double()
    return stored(finished(epilogue, sums), tile, epilogue, out, residual, inverse)


def stored(result: Tensor, tile: Tile, epilogue: str, out: Any, residual: Any, inverse: Any) -> Tensor:
    if residual is not None:
        result = result + residual.double()
    made = result.float().to(torch.bfloat16) if inverse is None else to_e4m3(result.float(), inverse)
    if epilogue in ("parts", "partial"):
        whole = torch.zeros(tile.splits, *made.shape, dtype=made.dtype)
        whole[0] = made
        return whole
    return made if out is None else out.copy_(made)


@pytest.fixture
def references(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hopper, "matmul", matmul_reference)
    monkeypatch.setattr(hopper, "matmul_fp8", fp8_reference)


def smaller(one: Operation) -> Operation:
    """With few enough rows and columns for a CPU; sizes of the inner axis stay."""
    square = one.norm_behind == "layer" and one.columns == one.inner
    return replace(one, rows=64, columns=one.columns if square else min(one.columns, 1152), inner=min(one.inner, 1152))


@pytest.mark.usefixtures("references", "plain_norms")
@pytest.mark.parametrize("precision", ["bf16", "fp8"])
def test_hoppers_products_are_given_what_makes_their_forms_right(
    precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = set()
    for one in (*hoppers(precision), *hoppers(precision, 4)):
        form = (one.operation, one.numbers, one.normed, one.norm_in_front, one.norm_behind)
        if form not in seen:
            seen.add(form)
            bench = hopper.Product(smaller(one), CPU)
            for knobs in chosen(hopper.candidates(one, SMS)):
                error = bench.error(knobs)
                assert error <= bench.bound < 0.08, (form, knobs, error, bench.bound)
                kernel = "matmul_fp8" if one.numbers == "fp8" else "matmul"
                launched = in_a_call(bench, knobs, kernel, hopper, monkeypatch)
                assert launched == around(one), (form, launched)
    assert len(seen) >= 9


def around(one: Operation) -> list[str]:
    """What a call launches for it."""
    first = ["norm", "product of it"] if one.norm_in_front else ["product"]
    return first + (["norm"] if one.norm_behind and one.operation != "residual" else [])


def chosen(candidates: Sequence[Knobs]) -> list[Knobs]:
    """The first tile, and the first whose inner axis is split."""
    tiles = [knobs for knobs in candidates if LIBRARY not in knobs]
    split = [knobs for knobs in tiles if knobs["splits"] > 1]
    return [tiles[0], *split[:1]]


@pytest.mark.parametrize("precision", ["bf16", "fp8"])
@pytest.mark.parametrize("batch", [1, 4, 16])
def test_every_candidate_of_hoppers_can_be_laid_out(precision: str, batch: int) -> None:
    for one in hoppers(precision, batch):
        found = hopper.candidates(one, SMS)
        assert len(found) > 10, one
        steps = -(-one.inner // (fp8.DEPTH if one.numbers == "fp8" else bf16.DEPTH))
        for knobs in found:
            assert why_not(one.key, knobs, (9, 0)) is None, (one, knobs)
            if LIBRARY in knobs:
                continue
            tile = hopper.from_knobs(knobs)
            assert isinstance(tile, Tile)
            assert not one.normed or tile.splits == 1
            whole = tile.splits == 1 or tile.gather
            epilogue: Any = "bias" if one.operation == "residual" or whole else one.operation
            bf16.layout(
                tile, "geglu" if one.operation == "geglu" else epilogue, one.rows, one.columns, steps, None, None
            )
            assert tile.stages(factors=2, lines=one.operation == "parts") >= 3


def test_the_towers_products_are_measured_in_the_form_that_they_run_in() -> None:
    forms = {one.name: (one.operation, one.normed, one.norm_in_front) for one in hoppers("bf16")}
    assert forms["vision qkv"] == ("bias", True, None) and forms["vision out"] == ("residual", False, None)
    several = {one.name: (one.operation, one.normed, one.norm_in_front) for one in hoppers("bf16", 4)}
    assert several["vision qkv"] == ("bias", False, "layer") and several["vision out"] == ("partial", False, None)
    assert several["expert qkv"] == ("plain", False, "rms")
    few = [hopper.resolved(one, SMS - 1) for one in operations(FULL, Call(2, 48), "bf16", "hopper")]
    assert {one.operation for one in few if one.name == "vision fc2"} == {"partial"}


# ---- Within layers


@pytest.mark.usefixtures("float32")
@pytest.mark.parametrize("name", ["pi05_libero", "pi0_libero"])
@pytest.mark.parametrize("numbers", ["bf16", "fp8"])
def test_the_experts_layers_are_those_of_a_denoising_step(name: str, numbers: Any) -> None:
    """Finite, of the operations' sizes, and each of them as often as a layer has it."""
    expert = replace(FULL.expert, depth=2, width=64, mlp_dim=96, num_heads=2, head_dim=64)
    config = replace(
        preset(name).planned_model, expert=expert, vlm=replace(FULL.vlm, depth=2, head_dim=64, num_heads=2)
    )
    tokens, of_state = 4, name == "pi0_libero"
    found = [one for one in operations(config, Call(1, 16, 3), numbers, "hopper", horizon=tokens) if one.in_layers]
    assert {LayersOf.of(one) for one in found} == {
        LayersOf("hopper", numbers == "fp8", 3, tokens + of_state, config.vision.num_tokens + 16)
    }
    layers = ExpertLayers(config, LayersOf.of(found[0]), CPU)
    sizes: list[tuple[int, int, int]] = []

    def counted(kernel: Any, halves: int = 1) -> Any:
        def run(x: Tensor, weight: Any, *rest: Any, **more: Any) -> Any:
            sizes.append((len(x), weight.shape[0] // halves, x.shape[1]))
            return kernel(x, weight, *rest, **more)

        return run

    ops = replace(
        plain.PLAIN,
        linear=counted(plain.PLAIN.linear),
        residual_linear=counted(plain.PLAIN.residual_linear),
        linear_geglu=counted(plain.PLAIN.linear_geglu, 2),
    )
    assert torch.isfinite(layers.run(ops)).all() and layers.depth == 2
    products = [(one.rows, one.columns, one.inner) for one in found if not one.operation.endswith("attention")]
    assert sizes == products * 2


def test_a_tile_is_timed_in_layers_whose_other_tiles_stay() -> None:
    seen: list[Any] = []

    class Layers:
        depth = 18

        def ops(self, tiles: TileTable) -> str:
            seen.append(tiles.tiles)
            return "operations"

        def run(self, ops: str) -> None:
            seen.append(ops)

    class Alone:
        operation = replace(product("plain"), name="expert qkv")

        def captured(self, run: Any, calls: int, least: float) -> Round:
            run()
            return timer(calls)

    other = replace(Alone.operation, rows=640).key
    bench = InLayers(Alone(), Layers(), TileTable({other: SMALL}))  # type: ignore[arg-type]
    assert bench.timer({"columns": 32})() == 18
    assert seen == [{other: SMALL, Alone.operation.key: {"columns": 32}}, "operations", "operations"]
