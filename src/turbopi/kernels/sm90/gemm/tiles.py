"""Which tiles products take: those that were the fastest on an H200, by [rows, out, in].

Other sizes: in FP8 `fp8.best_tile` estimates, in bfloat16 cuBLAS multiplies, GeGLU takes the best of GEGLU_TILES.
"""

from turbopi.kernels.sm90.gemm.bf16 import Tile
from turbopi.quantization.fp8 import whole_lines

# SigLIP So400m's products that beat cuBLAS on an H200, by [rows, out, in]: the tiles fill its SMs just once.
VISION_TILES = {
    (256, 3456, 1152): Tile(1, 112, cluster_m=2),
    (256, 1152, 1152): Tile(2, 40, splits=2),
    (256, 4304, 1152): Tile(2, 72),
    (256, 1152, 4304): Tile(2, 72, cluster_n=2, splits=4),
    (256, 2048, 1152): Tile(1, 64),
    (512, 3456, 1152): Tile(2, 112, cluster_m=2, ring=5),
    (512, 1152, 1152): Tile(2, 40),
    (512, 4304, 1152): Tile(2, 144, cluster_m=2, ring=5),
    (512, 1152, 4304): Tile(2, 96, cluster_m=2, cluster_n=2, splits=2),
    (512, 2048, 1152): Tile(2, 64),
    (768, 3456, 1152): Tile(2, 160, ring=5),
    (768, 1152, 1152): Tile(2, 64, cluster_m=2),
    (768, 4304, 1152): Tile(3, 136),
    (768, 1152, 4304): Tile(2, 144, cluster_m=2, cluster_n=2, splits=2),
    (768, 2048, 1152): Tile(2, 96),
}

# As VISION_TILES, for products that add their result to the residual stream. Where sums are gathered, all
# clusters must be on the GPU at once: an H200 takes 15 of eight blocks and 30 of four.
RESIDUAL_TILES = {
    (256, 1152, 1152): Tile(1, 64),
    (256, 1152, 4304): Tile(1, 96, cluster_m=2, cluster_n=2, splits=2, gather=True),
    (512, 1152, 1152): Tile(1, 72),
    (512, 1152, 4304): Tile(2, 96, cluster_m=2, cluster_n=2, splits=2, gather=True, ring=6),
    (768, 1152, 1152): Tile(2, 64),
    (768, 1152, 4304): Tile(2, 144, cluster_m=2, cluster_n=2, splits=2, gather=True),
}
RESIDUAL_TILES_FP8 = {(rows, out, whole_lines(inner)): tile for (rows, out, inner), tile in RESIDUAL_TILES.items()} | {
    (512, 1152, 1152): Tile(1, 80, cluster_m=2),
    (768, 1152, 1152): Tile(1, 128, ring=5),
}

# The prefix's products that leave as bfloat16 parts and so beat cuBLAS and its pass that adds parts up, by [rows in
# whole 64, out, in]: in our tiles, or as so many products over parts of the inner axis that cuBLAS makes at once.
PARTS_TILES: dict[tuple[int, int, int], Tile | int] = {
    (64, 1024, 2048): Tile(1, 104, splits=8),  # the action expert's
    (128, 1024, 2048): Tile(1, 80, splits=4),
    (192, 1024, 2048): Tile(3, 64, splits=8),
    (64, 1024, 4096): Tile(1, 120, splits=8),
    (128, 1024, 4096): Tile(2, 64, splits=8),
    (192, 1024, 4096): Tile(3, 64, splits=8),
    (320, 2048, 16384): 4,
    (512, 2048, 16384): 2,
    (576, 2048, 16384): Tile(3, 192, splits=4),
    (768, 2048, 16384): Tile(3, 192, splits=3),
    (832, 2048, 16384): 2,
}

# The action expert's other products, of the tokens of several observations, by [rows in whole 64, out, in].
FEW_TILES = {
    (64, 2560, 1024): Tile(1, 40),
    (128, 2560, 1024): Tile(1, 80),
}
FEW_GEGLU_TILES = {
    (64, 4096, 1024): Tile(1, 64),
    (128, 4096, 1024): Tile(2, 64),
    (192, 4096, 1024): Tile(3, 64),
}

GEGLU_TILES = (Tile(3, 128, 1, 2, overlap=True), Tile(3, 192), Tile(2, 256), Tile(2, 160, 1, 2, overlap=True))

# In FP8, the fastest of some 25 tiles each. Rows count in whole 64, the least that a tile has: so fewer
# kernels are compiled for all the prompt lengths.
TILES_FP8 = {
    (256, 3456, 1152): Tile(1, 112, cluster_m=2),
    (256, 4352, 1152): Tile(2, 72),
    (512, 3456, 1152): Tile(2, 112, cluster_m=2),
    (512, 1152, 1152): Tile(1, 96),
    (512, 4352, 1152): Tile(2, 136, ring=5),
    (768, 3456, 1152): Tile(2, 160, cluster_m=2),
    (768, 4352, 1152): Tile(3, 136),
    (512, 1152, 4352): Tile(2, 96, cluster_m=2, cluster_n=2, splits=2, gather=True),
    (320, 2560, 2048): Tile(1, 112),
    (576, 2560, 2048): Tile(3, 64),
    (576, 2048, 2048): Tile(1, 160),
    **{(rows, 16384, 2048): Tile(3, 128, cluster_n=2, overlap=True) for rows in (320, 576, 704, 768, 960)},
    (832, 16384, 2048): Tile(2, 176, cluster_n=2, overlap=True),
    (576, 2048, 16384): Tile(3, 96, splits=2),
    (832, 2048, 16384): Tile(2, 128, cluster_n=2),
    (576, 512, 2048): Tile(1, 80),
    (832, 512, 2048): Tile(1, 64),
}
