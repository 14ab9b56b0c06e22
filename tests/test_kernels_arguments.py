"""What reaches a kernel: declared once, given by name, each value what its name says. All on a CPU."""

import ctypes
import re
from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels.arguments import Parameter, Parameters, Struct, enumeration
from turbopi.kernels.sm90 import instructions
from turbopi.kernels.sm90.attention import kernel as attention_hopper
from turbopi.kernels.sm90.denoise import kernel as denoise
from turbopi.kernels.sm90.gemm import bf16 as gemm
from turbopi.kernels.sm90.gemm import fp8 as gemm_fp8
from turbopi.quantization.fp8 import E4M3, ScaledMatrix

PAIR = (Parameter("const float*", "values"), Parameter("int", "count", "of them"))


def test_values_come_in_the_declared_order_whatever_the_order_they_are_given_in() -> None:
    count, values = reversed(Parameters(PAIR).values({"count": 3, "values": 0xABC0}))
    assert (type(count), count.value) == (ctypes.c_int, 3)
    assert (type(values), values.value) == (ctypes.c_void_p, 0xABC0)


@pytest.mark.parametrize("given", [{"values": 1}, {"values": 1, "count": 2, "more": 3}, {}])
def test_a_missing_or_unknown_name_is_found(given: dict[str, int]) -> None:
    with pytest.raises(AssertionError, match=r"missing: .*unknown: "):
        Parameters(PAIR).values(given)
    with pytest.raises(AssertionError, match=r"missing: .*unknown: "):
        Struct("Pair", PAIR).value(given)


@pytest.mark.parametrize("given", [{"values": 1.5, "count": 1}, {"values": 1, "count": None}])
def test_an_address_and_a_number_are_not_taken_for_each_other(given: dict[str, Any]) -> None:
    with pytest.raises(AssertionError, match=r"takes an? (address|number)"):
        Parameters(PAIR).values(given)


def test_a_struct_is_written_with_its_sizes_checked() -> None:
    text = Struct("Pair", PAIR).source
    assert text.startswith("struct Pair {\n  const float*values;\n  int count;  // of them\n};")
    for size in ("sizeof(Pair) == 16", "sizeof(Pair::values) == 8", "sizeof(Pair::count) == 4"):
        assert f"static_assert({size}," in text
    assert enumeration("What", ("A", "B")) == "enum What { A, B };"


def denoising_source() -> str:
    """All files of all forms, without what is generated."""
    return "\n".join(path.read_text() for path in sorted((denoise.FOLDER / "denoise").glob("**/*.cu")))


def test_the_denoising_kernel_names_no_wait_that_is_not_declared_and_declares_none_twice() -> None:
    text = denoising_source()
    named = set(re.findall(r"\bWAIT_[A-Z0-9]+\b", text)) | {"FINISHED"}
    assert named == set(denoise.WAITS)
    assert len(set(denoise.WAITS.values())) == len(denoise.WAITS)


@pytest.mark.parametrize(
    ("by_token", "keep", "args"),
    [(False, False, denoise.ARGS), (True, False, denoise.ARGS_BY_TOKEN), (True, True, denoise.ARGS_KEEPING)],
)
@pytest.mark.parametrize("suffix", [10, 50])
def test_the_denoising_kernels_struct_has_what_its_source_reads(
    suffix: int, by_token: bool, keep: bool, args: Struct
) -> None:
    source = denoise.source(suffix, False, by_token, keep=keep)
    if not keep:  # as the preprocessor does
        source = re.sub(r"#ifdef TP_KEEP\n.*?#endif", "", re.sub(r"\bKEEP\(.*\)", "", source), flags=re.DOTALL)
    read = set(re.findall(r"\ba(?:rgs)?\.([a-z_]\w+)", source))
    declared = {one.name for one in args.fields}
    assert read <= declared, read - declared
    assert ("keys_ready" in read) == keep


# ---- products: a fake takes the launch, and each value must be what its name says


class Launched:
    """Stands for a compiled kernel; keeps what it was launched with."""

    max_clusters = 66

    def __init__(self) -> None:
        self.blocks = 0
        self.given: dict[str, Any] = {}

    def launch_dependent(self, blocks: int, given: dict[str, Any]) -> None:
        self.blocks, self.given = blocks, given


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> Launched:
    kernel = Launched()
    for module in (gemm, gemm_fp8, attention_hopper):
        monkeypatch.setattr(module, "_kernel", lambda *args: kernel)
    monkeypatch.setattr(instructions, "tensor_map", lambda address, sizes, *rest: (address, sizes))
    monkeypatch.setattr(instructions, "multiprocessors", lambda device: 132)
    return kernel


M, N, K = 320, 1152, 640
TILE = gemm.Tile(1, 96)


def sums(tile: gemm.Tile = TILE) -> gemm.Sums:
    return gemm.Sums.allocate(tile, M, N, torch.device("cpu"))


def fp8_copy() -> gemm.Copy:
    scale, shift = torch.rand(N), torch.rand(N)
    return gemm.Copy(torch.empty(M, N).to(E4M3), sums(), scale, shift, 1e-6, sums())


def at(tensor: Tensor) -> int:
    return tensor.data_ptr()


def expect_product(launched: Launched, a: Tensor, weight: Tensor, out: Tensor, depth: int) -> None:
    given = launched.given
    assert (given["map_a"], given["map_w"]) == ((at(a), (K, M)), (at(weight), (K, N)))
    assert given["out"] == at(out) and out.shape == (M, N)
    assert (given["M"], given["N"], given["k_blocks"]) == (M, N, -(-K // depth))
    assert (given["m_groups"], given["n_groups"]) == (M // 64, N // 96)


def test_a_products_launch_says_what_its_operands_are(launched: Launched) -> None:
    a, weight, bias = (torch.zeros(*shape, dtype=torch.bfloat16) for shape in ((M, K), (N, K), (N,)))
    residual, ahead, made = torch.zeros(M, N, dtype=torch.bfloat16), torch.zeros(4096, 64), sums()
    out = gemm.matmul(a, weight, TILE, "bias", bias, residual=residual, sums_out=made, ahead=ahead)
    expect_product(launched, a, weight, out, gemm.DEPTH)
    given = launched.given
    assert given["bias"] == at(bias) and given["residual"] == at(residual) and given["sums_out"] == at(made.parts)
    assert given["ahead"] == at(ahead) and given["ahead_bytes"] * launched.blocks <= ahead.numel() * 4
    takes = gemm.parameters(fp8=False, residual=True, normed=False, copied=False)
    assert {one.name for one in takes.all} == given.keys()


def test_an_fp8_products_launch_says_what_its_operands_are(launched: Launched) -> None:
    a, bias = torch.zeros(M, K).to(E4M3), torch.zeros(N, dtype=torch.bfloat16)
    weight = ScaledMatrix(torch.zeros(N, K).to(E4M3), torch.rand(N), 1.0, torch.bfloat16)
    residual, made, copy = torch.zeros(M, N, dtype=torch.bfloat16), sums(), fp8_copy()
    out = gemm_fp8.matmul_fp8(a, weight, TILE, "bias", bias, residual=residual, sums_out=made, copy=copy)
    expect_product(launched, a, weight.data, out, gemm_fp8.DEPTH)
    given = launched.given
    assert given["scale"] == at(weight.scale) and given["bias"] == at(bias) and given["inverse"] == 1.0
    assert (given["norm_scale"], given["norm_shift"]) == (at(copy.scale), at(copy.shift))
    assert (given["copy"], given["plain_sums"]) == (at(copy.out), at(copy.plain.parts))
    assert (given["sums_in"], given["inverse_width"], given["eps"]) == (at(copy.sums.parts), 1 / N, 1e-6)
    takes = gemm.parameters(fp8=True, residual=True, normed=False, copied=True)
    assert {one.name for one in takes.all} == given.keys()


def test_a_product_behind_a_norm_is_given_the_rows_sums(launched: Launched) -> None:
    a = torch.zeros(M, K, dtype=torch.bfloat16)
    data, of_rows, offset = torch.zeros(N, K, dtype=torch.bfloat16), torch.rand(N), torch.rand(N)
    folded = gemm.Folded(data, of_rows, offset)
    rows = gemm.Sums(torch.rand(7, M, 2))
    out = gemm.matmul(a, folded, TILE, "gelu", sums=rows, eps=1e-5)
    expect_product(launched, a, data, out, gemm.DEPTH)
    given = launched.given
    assert (given["sums_of_w"], given["offset"]) == (at(of_rows), at(offset))
    assert (given["sums_in"], given["inverse_width"], given["eps"]) == (at(rows.parts), 1 / K, 1e-5)


def test_attentions_launch_says_what_its_operands_are(launched: Launched) -> None:
    q, k, v = (torch.zeros(rows, 256, dtype=torch.bfloat16) for rows in (8 * 48, 560, 560))
    length = torch.tensor([48])
    out = attention_hopper.prefix_attention(q, k, v, length, 8)
    given = launched.given
    maps = tuple(given[f"map_{name}"][0] for name in "qkv")
    assert maps == (at(q), at(k), at(v)) and given["length"] == at(length) and given["out"] == at(out)
    assert (given["rows"], given["keys"], given["heads"], given["tiles"]) == (8 * 48, 560, 1, 6)  # its heads are rows
    assert {one.name for one in attention_hopper.PARAMETERS.all} == given.keys()
