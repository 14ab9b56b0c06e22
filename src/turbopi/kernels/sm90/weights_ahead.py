"""The prefix's products with the next one's weights on their way: DRAM rests while the large products multiply.

Each product of our own brings the matrix behind it into L2 when it has asked for the last of its own. The vision
tower's do so already: gemm/vision_products.py.
"""

from torch import Tensor

from turbopi.kernels.sm90.gemm.bf16 import matmul
from turbopi.kernels.sm90.gemm.fp8 import matmul_fp8
from turbopi.kernels.sm90.gemm.products import bf16_tile, chosen_fp8, num_sms, tuned_residual_linear
from turbopi.kernels.sm90.gemm.vision_products import Normed, NormedCopy, Product, VisionProducts
from turbopi.kernels.tile_table import NO_TILES, TileTable
from turbopi.quantization.fp8 import Matrix, ScaledMatrix

MOST_BYTES = 16 << 20  # of a matrix: L2 has 50 MB, and what is multiplied meanwhile passes through it


class ProductsAhead:
    """`linear` and `residual_linear` without a bias, which the language models' are; others are the tower's."""

    def __init__(self, vision: VisionProducts, tiles: TileTable = NO_TILES) -> None:
        self._vision, self._tiles = vision, tiles
        self._behind: dict[int, Tensor] = {}  # which matrix came behind the one at this address last time: a hint
        self._first: int | None = None  # the address of the one that a call begins with: behind the last is no other
        self._last: Tensor | None = None

    def linear(
        self, x: Tensor | Normed | NormedCopy, weight: Matrix, bias: Tensor | None = None, out: Tensor | None = None
    ) -> Tensor:
        if bias is not None or not isinstance(x, Tensor):
            return self._vision.linear(x, weight, bias, out)
        ahead = self.behind(weight)
        if isinstance(weight, ScaledMatrix):
            fp8 = chosen_fp8(self._tiles, "plain", x.shape[0], weight.shape[0], weight.shape[1], num_sms(x.device))
            assert fp8 is not None, "the library has no such product"
            return matmul_fp8(x, weight, fp8, "plain", None, out, ahead=ahead)
        tile = bf16_tile(self._tiles, "plain", x, weight)
        if tile is None:
            return self._vision.linear(x, weight, bias, out)
        return matmul(x, weight, tile, "plain", None, out, ahead=ahead)

    def residual_linear(self, x: Tensor, weight: Matrix, bias: Tensor | None = None) -> Tensor | Product:
        if bias is not None:
            return self._vision.residual_linear(x, weight, bias)
        return tuned_residual_linear(x, weight, None, self.behind(weight), tiles=self._tiles)

    def behind(self, matrix: Matrix) -> Tensor | None:
        """This one is multiplied now: which one came behind it last time, unless that is too large."""
        data: Tensor = matrix.data if isinstance(matrix, ScaledMatrix) else matrix
        if self._first is None:
            self._first = data.data_ptr()
        if self._last is not None and data.data_ptr() != self._first:
            self._behind[self._last.data_ptr()] = data
        self._last = data
        behind = self._behind.get(data.data_ptr())
        return None if behind is None or behind.numel() * behind.element_size() > MOST_BYTES else behind
