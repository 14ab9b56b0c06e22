"""Weights rounded with error feedback: what it gains, and that the kernel does what its twin does.

Exact in the interpreter and on a GPU where all sums are; elsewhere a sum's last bit may decide.
"""

from collections.abc import Iterator

import pytest
import torch
from conftest import gpu_or_interpreter
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels.portable.quantize import quantize, round_rows
from turbopi.kernels.portable.rounding import round_with_feedback
from turbopi.quantization.directions import COUNT, ROWS, Rows, directions
from turbopi.quantization.formats import OF_EIGHT_BITS, Format
from turbopi.quantization.fp8 import Directions, to_e4m3
from turbopi.quantization.int8 import to_int8
from turbopi.quantization.rounding import feedback, round_with_feedback_plain

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
pytestmark = gpu_or_interpreter()


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed)).to(DEVICE)


def activations(count: int, width: int, seed: int = 1) -> Tensor:
    """Much in common, three outlier channels, and a tenth of noise."""
    common = random(4, width, seed=7) * torch.tensor([3.0, 2.0, 1.0, 1.0], device=DEVICE)[:, None]
    common[:, [5, 20, 33]] *= 20
    return random(count, 4, seed=seed) @ common + 0.3 * random(count, width, seed=seed + 1)


def error(rounded: Tensor, weight: Tensor, x: Tensor) -> float:
    return float((x @ (rounded - weight).T).norm() / (x @ weight.T).norm())


EVERY_FORMAT = pytest.mark.parametrize("format", OF_EIGHT_BITS.values(), ids=OF_EIGHT_BITS)


@EVERY_FORMAT
@pytest.mark.parametrize(("out", "width", "count"), [(24, 64, 600), (17, 200, 40), (1, 40, 3)])
def test_errors_cancel_where_activations_lie(out: int, width: int, count: int, format: Format) -> None:
    weight, seen, unseen = random(out, width) / 50, activations(count, width), activations(300, width, seed=3)
    known = directions(seen)
    assert known is not None and known.codes.shape == (width, min(COUNT, count, width))
    nearest, spared = (quantize(weight, 1.0, d, format).dequantized() for d in (None, known))
    assert error(spared, weight, seen) < 0.3 * error(nearest, weight, seen)
    if count > COUNT:
        assert error(spared, weight, unseen) < 0.3 * error(nearest, weight, unseen)
    white = random(300, width, seed=5)  # what has nothing in common pays little
    assert error(spared, weight, white) < 2 * error(nearest, weight, white)


def test_answers_are_those_of_the_whole_least_squares_problem() -> None:
    width, rest = 12, 0.1
    main = random(width, 3)
    order, errors, answers = feedback(Directions(to_e4m3(main, 1.0), torch.ones(3, device=DEVICE), rest))
    hessian = (errors @ errors.T).double() + rest * torch.eye(width, device=DEVICE)
    assert torch.equal(errors, to_e4m3(main, 1.0).float()[order])
    assert bool((errors.square().sum(1).diff() <= 0).all())
    for first in (1, 5, width - 1):
        off = random(first, seed=first).double()  # of the weights before: those behind change so that least is left
        best = -torch.linalg.solve(hessian[first:, first:], hessian[first:, :first] @ off)
        assert float(best[0]) == pytest.approx(-float(answers[first].double() @ (errors[:first].double().T @ off)))


def exact_sums(rows: int, columns: int, num: int) -> tuple[Tensor, ...]:
    """weight, inverse, order, errors, answers of few bits, so that no sum is rounded."""
    weight = (random(rows, columns) * 64).round() / 64
    errors, answers = (torch.sign(random(columns, num, seed=s)) * size for s, size in ((1, 0.5), (2, 0.25)))
    inverse = torch.where(torch.arange(rows, device=DEVICE) % 2 == 0, 2.0, 0.5)
    return (
        weight,
        inverse,
        torch.randperm(columns, generator=torch.Generator().manual_seed(0)).to(DEVICE),
        errors,
        answers,
    )


@pytest.mark.slow
@EVERY_FORMAT
@pytest.mark.parametrize(("rows", "columns", "num"), [(40, 32, 4), (16, 24, 3), (5, 1, 1)])
def test_the_kernel_rounds_as_its_twin(rows: int, columns: int, num: int, format: Format) -> None:
    weight, inverse, order, errors, answers = exact_sums(rows, columns, num)
    ours = round_with_feedback(weight, inverse, order, errors, answers, format.dtype)
    reference = round_with_feedback_plain(weight, inverse, order, errors, answers, format.rounded)
    assert torch.equal(ours.float(), reference.float())
    assert not torch.equal(reference.float(), format.rounded(weight, inverse[:, None]).float()) or columns == 1


def in_e4m3(x: Tensor) -> tuple[Tensor, Tensor]:
    """Bytes of float32 x: the kernel's, without feedback, and PyTorch's."""
    weight, none = x[:, None].contiguous().to(DEVICE), torch.zeros(1, 1, device=DEVICE)
    order, inverse = torch.zeros(1, dtype=torch.int64, device=DEVICE), torch.ones(len(x), device=DEVICE)
    ours = round_with_feedback(weight, inverse, order, none, none)
    assert ours.dtype == torch.float8_e4m3fn
    return ours.view(torch.uint8).flatten().cpu(), to_e4m3(x, 1.0).view(torch.uint8)


@pytest.mark.slow
def test_bfloat16_becomes_the_byte_that_pytorch_makes_of_it() -> None:
    """Positive ones from 2^-11, which becomes 0, to 2^9, which saturates."""
    first, last = (torch.tensor(x, dtype=torch.bfloat16).view(torch.int16).item() for x in (2**-11, 512.0))
    x = torch.arange(int(first), int(last) + 1, dtype=torch.int16).view(torch.bfloat16).float()
    ours, theirs = in_e4m3(x)
    assert torch.equal(ours, theirs)


def test_numbers_between_two_of_e4m3_become_the_byte_that_pytorch_makes_of_them() -> None:
    numbers = torch.arange(256, dtype=torch.uint8).view(torch.float8_e4m3fn).float()
    numbers = torch.unique(numbers[numbers.isfinite()])
    between = (numbers[1:] + numbers[:-1]) / 2
    beside = [torch.nextafter(between, torch.full_like(between, side)) for side in (-torch.inf, torch.inf)]
    ends = torch.tensor([449.0, 463.9, 464.0, 480.0, -1e30, torch.inf, -torch.inf, 1e-40, -1e-40, -0.0])
    ours, theirs = in_e4m3(torch.cat((numbers, between, *beside, ends)))
    assert torch.equal(ours, theirs)
    damaged, _ = in_e4m3(torch.tensor([torch.nan, -torch.nan]))
    assert (damaged & 0x7F).tolist() == [0x7F, 0x7F]


def test_without_feedback_the_kernel_rounds_every_whole_number_to_nearest() -> None:
    x = torch.cat((torch.arange(-300, 300) / 2, torch.tensor([0.49, 126.51, -1e30, torch.inf, -torch.inf, torch.nan])))
    weight, none = x[:, None].contiguous().to(DEVICE), torch.zeros(1, 1, device=DEVICE)
    order, inverse = torch.zeros(1, dtype=torch.int64, device=DEVICE), torch.ones(len(x), device=DEVICE)
    ours = round_with_feedback(weight, inverse, order, none, none, torch.int8)
    assert ours.dtype == torch.int8 and torch.equal(ours, to_int8(weight, 1.0))
    assert to_int8(torch.tensor([0.5, 1.5, -2.5, 127.4, 128.0, torch.nan]), 1.0).tolist() == [0, 2, -2, 127, 127, 0]


@EVERY_FORMAT
def test_nan_shows_in_its_row_alone(format: Format) -> None:
    weight, known = random(20, 64), directions(activations(100, 64))
    weight[3, 10] = torch.nan
    matrix = quantize(weight, 1.0, known, format).dequantized()
    assert bool(matrix[3].isnan().any()) and bool(matrix[torch.arange(20) != 3].isfinite().all())


def test_rows_of_fused_matrices_are_rounded_as_they_are_alone() -> None:
    weight, known = random(48, 64), directions(activations(100, 64))
    whole = quantize(weight, 1.0, known)
    for rows in (slice(0, 16), slice(16, 48)):
        assert torch.equal(quantize(weight[rows], 1.0, known).data.float(), whole.data[rows].float())


# Directions


def test_directions_are_the_largest_of_the_second_moment() -> None:
    x = activations(500, 64)
    known = directions(x)
    assert known is not None
    moment = x.double().T @ x.double() / len(x)
    power = torch.linalg.eigvalsh(moment).flip(0)
    main = known.main.double()
    assert float((moment - main @ main.T).norm() / moment.norm()) < 0.05  # E4M3's three bits
    assert known.rest == pytest.approx(float(power[COUNT:].sum()) / 64, rel=1e-3)
    assert directions(torch.zeros(10, 64)) is None
    single = directions(torch.ones(10, 64))
    assert single is not None and single.rest > 0


def batches(count: int) -> Iterator[Tensor]:
    for i in range(count):
        yield torch.full((300, 4), float(i))


def test_rows_stand_for_all_that_came() -> None:
    few, many, again = (Rows(torch.device("cpu")) for _ in range(3))
    few.add(activations(10, 40).cpu())
    assert torch.equal(few.rows.sort(0).values, activations(10, 40).cpu().sort(0).values)
    for x in batches(20):
        many.add(x)
        again.add(x)
    assert many.rows.shape == (ROWS, 4) and torch.equal(many.rows, again.rows)
    of_each = torch.bincount(many.rows[:, 0].long(), minlength=20)
    assert int(of_each.min()) > 8 and int(of_each.max()) < 50  # 25.6 each, expected


def test_no_directions_round_to_nearest() -> None:
    weight, inverse = random(8, 16), torch.full((8,), 3.0, device=DEVICE)
    assert torch.equal(round_rows(weight, inverse).float(), to_e4m3(weight, inverse[:, None]).float())
