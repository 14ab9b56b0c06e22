"""Which matrix a product brings into L2: the one that came behind it last time, of this call."""

import pytest
import torch

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels.sm90 import weights_ahead
from turbopi.kernels.sm90.gemm.vision_products import VisionProducts
from turbopi.kernels.sm90.weights_ahead import ProductsAhead


def test_products_learn_their_order_and_the_last_one_expects_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    first, small, large, last = (torch.zeros(rows, 8) for rows in (8, 8, 16, 4))
    monkeypatch.setattr(weights_ahead, "MOST_BYTES", small.nbytes)
    products = ProductsAhead(VisionProducts())
    call = (first, small, large, last)
    assert [products.behind(one) for one in call] == [None] * 4
    for _ in range(2):
        found = [products.behind(one) for one in call]
        assert found[0] is small and found[1] is None and found[2] is last  # too large isn't brought
        assert found[3] is None, "behind the last one comes the next call's first"
