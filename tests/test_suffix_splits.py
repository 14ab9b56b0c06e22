"""Suffix attention over keys that several blocks share, whose result leaves in the units of an FP8 product."""

import pytest
import torch

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels import plain_batch
from turbopi.kernels.portable import batch
from turbopi.models.pi0.layers import rope_tables

HEADS, DIM, TOKENS, LENGTHS = 2, 32, 3, (300, 0, 129)
INVERSE = 55.0


pytestmark = [
    pytest.mark.skipif(torch.cuda.is_available(), reason="of the interpreter, as tensor cores round float32"),
    *(pytest.mark.filterwarnings(f"ignore::{warning}") for warning in ("RuntimeWarning", "DeprecationWarning")),
]


@pytest.mark.parametrize("state_token", [False, True])
@pytest.mark.parametrize("blocks", [1, 1000])
def test_the_result_is_scaled_once(blocks: int, state_token: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """With an observation that has no keys, and splits that have none of another's. The interpreter rounds nothing."""
    monkeypatch.setattr(batch, "BLOCKS_AT_ONCE", blocks)
    sizes = torch.tensor([*LENGTHS, 0], dtype=torch.int32)
    starts, rows = (sizes.cumsum(0) - sizes).int(), len(LENGTHS) * TOKENS
    torch.manual_seed(0)
    k, v = torch.randn(2, sum(LENGTHS), DIM)
    cos, sin = (table[0, 0] for table in rope_tables(torch.arange(rows)[None], DIM, 10_000.0))
    given = (torch.randn(rows, (HEADS + 2) * DIM), cos, sin, k, v, starts, sizes, HEADS, state_token)
    exact = plain_batch.suffix_attention(*given)
    ours = batch.suffix_attention(*given, inverse=INVERSE)
    torch.testing.assert_close(ours.float() / INVERSE, exact)
