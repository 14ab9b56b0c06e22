"""The engine's operations with our kernels where they win and the library's elsewhere, for NVIDIA GPUs.

Activations are bfloat16; with an `Fp8Matrix` (on Hopper only) they are E4M3 between it and the operation before it.
"""

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.engine import ops as plain
from turbopi.engine.fp8 import Fp8Matrix, Matrix, to_e4m3
from turbopi.engine.ops import Ops
from turbopi.kernels import activations, attention, attention_hopper, embedding, norms, rope
from turbopi.kernels.gemm import Epilogue, Folded, Sums, Tile, matmul
from turbopi.kernels.gemm_fp8 import GATHERING_SMS, best_tile, matmul_fp8
from turbopi.kernels.launch import capability

GEGLU_TILES = (Tile(3, 192), Tile(2, 256))
GEGLU_FILL = 0.885  # where less of our tiles' area is used, the library's choice of tiles is better

# SigLIP So400m's products that beat cuBLAS on an H200, by [rows, out, in]: the tiles fill its SMs just once.
VISION_TILES = {
    (256, 3456, 1152): Tile(1, 112),
    (256, 1152, 1152): Tile(2, 40, splits=2),
    (256, 4304, 1152): Tile(2, 72),
    (256, 1152, 4304): Tile(2, 72, cluster_n=2, splits=4),
    (512, 3456, 1152): Tile(2, 112),
    (512, 1152, 1152): Tile(2, 40),
    (512, 4304, 1152): Tile(2, 136),
    (512, 1152, 4304): Tile(2, 96, cluster_m=2, cluster_n=2, splits=2),
    (768, 3456, 1152): Tile(2, 160),
    (768, 1152, 1152): Tile(2, 64, cluster_m=2),
    (768, 4304, 1152): Tile(3, 136),
    (768, 1152, 4304): Tile(2, 144, cluster_m=2, cluster_n=2, splits=2),
}

# The same for products that add their result to the residual stream, in either precision. Where sums are gathered, all
# clusters must be on the GPU at once: an H200 takes 15 of eight blocks and 30 of four.
RESIDUAL_TILES = {
    (256, 1152, 1152): Tile(1, 40),
    (256, 1152, 4304): Tile(1, 96, cluster_m=2, splits=2, gather=True),
    (512, 1152, 1152): Tile(1, 72),
    (512, 1152, 4304): Tile(2, 96, cluster_m=2, cluster_n=2, splits=2, gather=True),
    (768, 1152, 1152): Tile(2, 64),
    (768, 1152, 4304): Tile(2, 144, cluster_m=2, cluster_n=2, splits=2, gather=True),
}


def fused_ops(device: torch.device) -> Ops:
    """Triton's kernels between the products; on Hopper our products where they win, elsewhere cuBLAS with epilogues."""
    hopper = capability(device) == (9, 0)
    tower = VisionTower()
    return Ops(
        embed_patches=EmbedPatches(),
        embed_prompt=embedding.embed_prompt,
        residual_rms_norm=norms.residual_rms_norm,
        residual_layer_norm=tower.residual_layer_norm if hopper else norms.residual_layer_norm,
        linear=tower.linear if hopper else linear,
        residual_linear=tower.residual_linear if hopper else linear,
        linear_gelu=tower.linear_gelu if hopper else linear_gelu,
        linear_geglu=tuned_linear_geglu if hopper else linear_geglu,
        rope_split=rope.rope_split,
        vision_attention=vision_attention_on_hopper if hopper else attention.vision_attention,
        attention=partial(attend, hopper=hopper),
        origin={
            "matrix products": "cuBLAS, with bias and GELU in its epilogue",
            "vision products": f"CUDA for {_rows_covered()} rows, else cuBLAS" if hopper else "cuBLAS",
            "GeGLU of the prefix": "CUDA, in its product's epilogue, or Triton behind cuBLAS" if hopper else "Triton",
            "vision and prefix attention": "CUDA; Triton where head_dim isn't a multiple of 8 from 16 to 256"
            if hopper
            else "Triton",
            "suffix attention": "cuBLAS and Triton's softmax",
            "LayerNorm": f"most in the bfloat16 products around them for {_rows_folded()} rows, else Triton"
            if hopper and _num_sms(device) >= GATHERING_SMS
            else "Triton",
            "other norms, GeGLU of the suffix, RoPE, patches, prompt embedding": "Triton",
        },
    )


def _rows_covered() -> str:
    return ", ".join(str(rows) for rows in sorted({rows for rows, _, _ in VISION_TILES}))


def _rows_folded() -> str:
    return ", ".join(str(rows) for rows in sorted({rows for rows, _, _ in RESIDUAL_TILES}))


class EmbedPatches:
    """Pixels are whole numbers, so tensor cores can multiply them exactly: see `embedding.odd_rows`."""

    def __init__(self) -> None:
        self._split: dict[int, Tensor] = {}  # by the weight's address

    def __call__(self, images: Tensor, weight: Tensor, position: Tensor, dtype: torch.dtype) -> Tensor:
        patch = round((weight.shape[1] / 3) ** 0.5)
        if images.dtype != torch.uint8:
            return embedding.add_position(F.linear(embedding.patch_rows(images, patch), weight), position, dtype)
        if weight.data_ptr() not in self._split:
            self._split[weight.data_ptr()] = embedding.split_in_two(weight)
        products = torch.mm(
            embedding.odd_rows(images, patch), self._split[weight.data_ptr()].t(), out_dtype=torch.float32
        )
        return embedding.add_position(products, position, dtype)


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None, out: Tensor | None = None) -> Tensor:
    if out is None:
        return F.linear(x, weight, bias)
    return torch.mm(x, weight.t(), out=out) if bias is None else torch.addmm(bias, x, weight.t(), out=out)


def linear_gelu(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    return torch._addmm_activation(bias, x, weight.t(), use_gelu=True)  # on CUDA: tanh's GELU, in the epilogue


def linear_geglu(x: Tensor, gate_up: Tensor) -> Tensor:
    return activations.geglu(F.linear(x, gate_up))


@dataclass(frozen=True)
class Product:
    """A product that isn't made before the norm brings the residual stream to add it to."""

    x: Tensor
    weight: Matrix
    bias: Tensor
    tile: Tile


@dataclass(frozen=True)
class Normed:
    """LayerNorm of x, made only where the product behind it can't do it."""

    x: Tensor
    sums: Sums
    scale: Tensor
    shift: Tensor
    eps: float

    def made(self) -> Tensor:
        return norms.residual_layer_norm(self.x, None, self.scale, self.shift, self.eps)[1]


class VisionTower:
    """Its products. Those in front of a LayerNorm add the residual stream themselves, those behind do the norm."""

    def __init__(self) -> None:
        # by the weight's address; the weight stays with it, so that no other one can come to lie there
        self._folded: dict[int, tuple[Tensor, Folded]] = {}
        self._behind: dict[int, Tensor] = {}  # which matrix came behind the one at this address last time: a hint
        self._last: Tensor | None = None

    def residual_linear(self, x: Tensor, weight: Matrix, bias: Tensor | None = None) -> Tensor | Product:
        tile = RESIDUAL_TILES.get((x.shape[0], weight.shape[0], weight.shape[1]))
        if tile is None or bias is None or _num_sms(x.device) < GATHERING_SMS:
            return tuned_residual_linear(x, weight, bias)
        return Product(x, weight, bias, tile)

    def residual_layer_norm(
        self,
        x: Tensor,
        y: Tensor | Product | None,
        weight: Tensor,
        bias: Tensor,
        eps: float,
        inverse: float | None = None,
    ) -> tuple[Tensor, Tensor | Normed]:
        if not isinstance(y, Product):
            return norms.residual_layer_norm(x, y, weight, bias, eps, inverse)
        ahead = self._next(y.weight)
        if inverse is not None:  # a product can't round its input to E4M3
            made = tuned_residual_linear(y.x, y.weight, y.bias, ahead)
            return norms.residual_layer_norm(x, made, weight, bias, eps, inverse)
        sums = Sums.allocate(y.tile, x.shape[0], x.shape[1], x.device)
        if isinstance(y.weight, Fp8Matrix):
            x = matmul_fp8(y.x, y.weight, y.tile, "bias", y.bias, residual=x, sums_out=sums, ahead=ahead)
        else:
            x = matmul(y.x, y.weight, y.tile, "bias", y.bias, residual=x, sums_out=sums, ahead=ahead)
        return x, Normed(x, sums, weight, bias, eps)

    def linear(
        self, x: Tensor | Normed, weight: Matrix, bias: Tensor | None = None, out: Tensor | None = None
    ) -> Tensor:
        if isinstance(x, Normed):
            if out is None and (made := self._normed(x, weight, bias, "bias")) is not None:
                return made
            x = x.made()
        return tuned_linear(x, weight, bias, out)

    def linear_gelu(self, x: Tensor | Normed, weight: Matrix, bias: Tensor, inverse: float | None = None) -> Tensor:
        if isinstance(x, Normed):
            if (made := self._normed(x, weight, bias, "gelu")) is not None:
                return _as_input(made, inverse)
            x = x.made()
        return tuned_linear_gelu(x, weight, bias, inverse, self._next(weight))

    def _normed(self, x: Normed, weight: Matrix, bias: Tensor | None, epilogue: Epilogue) -> Tensor | None:
        if isinstance(weight, Fp8Matrix) or bias is None or (tile := _tile(x.x, weight)) is None or tile.splits > 1:
            return None
        key = weight.data_ptr()
        if key not in self._folded:
            self._folded[key] = weight, Folded.fold(weight, bias, x.scale, x.shift)
        folded = self._folded[key][1]
        return matmul(x.x, folded, tile, epilogue, sums=x.sums, eps=x.eps, ahead=self._next(folded.data))

    def _next(self, matrix: Matrix) -> Tensor | None:
        """What may be fetched into L2 during a product: the matrix that came behind this one last time."""
        data = matrix.data if isinstance(matrix, Fp8Matrix) else matrix
        if self._last is not None:
            self._behind[self._last.data_ptr()] = data
        self._last = data
        return self._behind.get(data.data_ptr())


def _tile(x: Tensor, weight: Tensor) -> Tile | None:
    return VISION_TILES.get((x.shape[0], weight.shape[0], weight.shape[1]))


def tuned_linear(x: Tensor, weight: Matrix, bias: Tensor | None = None, out: Tensor | None = None) -> Tensor:
    if isinstance(weight, Fp8Matrix):
        return _fp8(x, weight, "plain" if bias is None else "bias", bias, out)
    tile = _tile(x, weight)
    if tile is None or bias is None:
        return linear(x, weight, bias, out)
    return matmul(x, weight, tile, "bias", bias, out)


def tuned_residual_linear(x: Tensor, weight: Matrix, bias: Tensor | None = None, ahead: Tensor | None = None) -> Tensor:
    """The product, or float32 parts of it that the norms add up."""
    if isinstance(weight, Fp8Matrix):
        return _fp8(x, weight, "partial", bias, ahead=ahead)
    tile = _tile(x, weight)
    if tile is None or bias is None:
        return linear(x, weight, bias)
    return matmul(x, weight, tile, "partial" if tile.splits > 1 else "bias", bias, ahead=ahead)


def tuned_linear_gelu(
    x: Tensor, weight: Matrix, bias: Tensor, inverse: float | None = None, ahead: Tensor | None = None
) -> Tensor:
    if isinstance(weight, Fp8Matrix):
        return _fp8(x, weight, "gelu", bias, inverse=inverse, ahead=ahead)
    tile = _tile(x, weight)
    result = linear_gelu(x, weight, bias) if tile is None else matmul(x, weight, tile, "gelu", bias, ahead=ahead)
    return _as_input(result, inverse)


def tuned_linear_geglu(x: Tensor, gate_up: Matrix, inverse: float | None = None) -> Tensor:
    if isinstance(gate_up, Fp8Matrix):
        return _fp8(x, gate_up, "geglu", inverse=inverse)
    tile = _geglu_tile(x.shape[0], gate_up.shape[0] // 2, x.device)
    return _as_input(linear_geglu(x, gate_up) if tile is None else matmul(x, gate_up, tile, "geglu"), inverse)


def _as_input(x: Tensor, inverse: float | None) -> Tensor:
    """x, rounded to E4M3 in a pass of its own where only the product behind this one is in E4M3."""
    return x if inverse is None else to_e4m3(x, inverse)


def _fp8(
    x: Tensor,
    weight: Fp8Matrix,
    epilogue: Epilogue,
    bias: Tensor | None = None,
    out: Tensor | None = None,
    inverse: float | None = None,
    ahead: Tensor | None = None,
) -> Tensor:
    n = weight.shape[0] // 2 if epilogue == "geglu" else weight.shape[0]
    tile = best_tile(x.shape[0], n, weight.shape[1], epilogue, _num_sms(x.device))
    if epilogue == "partial" and (tile.splits == 1 or tile.gather):
        epilogue = "bias"
    return matmul_fp8(x, weight, tile, epilogue, bias, out, inverse, ahead=ahead)


@lru_cache
def _num_sms(device: torch.device) -> int:
    return torch.cuda.get_device_properties(device).multi_processor_count


@lru_cache
def _geglu_tile(rows: int, hidden: int, device: torch.device) -> Tile | None:
    """The tile that wastes least on the matrix's ragged edges and on the last wave of tiles, if that is little."""
    sms = _num_sms(device)

    def fill(tile: Tile) -> float:
        tiles = -(-rows // tile.rows) * -(-2 * hidden // tile.columns)
        return rows * 2 * hidden / (-(-tiles // sms) * sms * tile.rows * tile.columns)

    best = max(GEGLU_TILES, key=fill)
    return best if fill(best) > GEGLU_FILL else None


def attend(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    length: Tensor,
    slots: int,
    heads: int,
    *state_token: Any,
    inverse: float | None = None,
    hopper: bool = False,
) -> Tensor:
    if k.shape[0] == slots:  # no suffix behind the prefix
        ours = attention_hopper if hopper and attention_hopper.takes(q.shape[1]) else attention
        return ours.prefix_attention(q, k, v, length, heads, inverse)
    assert inverse is None, "the suffix's activations stay as they are"
    return plain.attention(q, k, v, length, slots, heads, *state_token, softmax=attention.masked_softmax)


def vision_attention_on_hopper(qkv: Tensor, images: int, heads: int, inverse: float | None = None) -> Tensor:
    ours = attention_hopper if attention_hopper.takes(qkv.shape[1] // 3 // heads) else attention
    return ours.vision_attention(qkv, images, heads, inverse)
