"""Weights to numbers of eight bits so that their errors cancel where activations lie.

Rounded to nearest, a product's weights are off by 2.6 % each in E4M3, at random. But activations share a few
directions: 16 hold most of a site's second moment. So the weights of a row are rounded one after the other, and
what the earlier ones' errors add up to along those directions is made up for by the later ones. This is GPTQ (Frantar
et al., 2022, arXiv:2210.17323) with a Hessian of low rank, in which an error takes R numbers a row instead of a matrix.

Shapes: a matrix [out, in], R directions.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from turbopi.quantization.fp8 import Directions

Rounded = Callable[[Tensor, float | Tensor], Tensor]  # (x, 1 / scale) -> x in a format's numbers


def feedback(directions: Directions) -> tuple[Tensor, Tensor, Tensor]:
    """(order int64[in], errors float32[in, R], answers float32[in, R]), both in that order.

    A weight that is off by e leaves errors * e; the next one is taken less answers · what all before it left. Such
    answers are best if those behind could be any numbers: with d their changes, rest |d|² + |left + Σ main d|² is
    least. The columns that matter most come first, so that many are left to make up for them.
    """
    main = directions.main.double()
    order = main.square().sum(dim=1).argsort(descending=True, stable=True)
    main = main[order]
    across = main.T.contiguous()  # sums along the last axis are parallel on a GPU
    behind = (across[:, None] * across[None]).flip(2).cumsum(2).flip(2)  # Σ over this column and later ones
    rest = directions.rest * torch.eye(len(across), dtype=torch.float64, device=main.device)
    answers = torch.linalg.solve(behind.permute(2, 0, 1) + rest, main[:, :, None]).squeeze(2)
    return order, main.float(), answers.float()


def round_with_feedback_plain(
    weight: Tensor, inverse: Tensor, order: Tensor, errors: Tensor, answers: Tensor, numbers: Rounded
) -> Tensor:
    """A column at a time: what `kernels.portable.rounding.round_with_feedback` does. `numbers`: `Format.rounded`."""
    scale = 1 / inverse
    rounded = columns_with_feedback(
        weight, order, errors, answers, lambda wanted, _: numbers(wanted, inverse).float() * scale
    )
    return numbers(rounded, inverse[:, None])


def columns_with_feedback(
    weight: Tensor, order: Tensor, errors: Tensor, answers: Tensor, rounded: Callable[[Tensor, int], Tensor]
) -> Tensor:
    """float32[out, in] in any format: `rounded` gets the numbers wanted for a column, float32[out], and its number."""
    left, result = errors.new_zeros(len(weight), errors.shape[1]), torch.empty_like(weight, dtype=torch.float32)
    for i, column in enumerate(order.tolist()):
        exact = weight[:, column].float()
        result[:, column] = rounded(exact - left @ answers[i], column)
        left += (result[:, column] - exact)[:, None] * errors[i]
    return result
