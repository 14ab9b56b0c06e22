"""Attention of a batch's suffixes in clusters, for compute capability 9.0: see suffix.cu and suffix_few.cu.

Twin: `kernels.plain_batch.suffix_attention`. The kernel for all other GPUs, and for what these don't take, is in
kernels/portable/batch.py.
"""

import torch
from torch import Tensor

from turbopi.kernels.ahead import MadeOnce
from turbopi.kernels.arguments import TENSOR_MAP, Parameter, Parameters
from turbopi.kernels.dependent_launch import result_dtype
from turbopi.kernels.nvrtc import compile_cubin
from turbopi.kernels.portable.attention import LOG2_E
from turbopi.kernels.sm90 import instructions
from turbopi.kernels.sm90.attention.suffix_tile import FewTile, Tile, tiles
from turbopi.kernels.sm90.instructions import DependentKernel
from turbopi.support.errors import BackendUnavailable

PARAMETERS = Parameters(
    (
        *(Parameter(TENSOR_MAP, f"map_{name}") for name in "kv"),
        Parameter("const u16*", "qkv"),
        *(Parameter("const float*", name) for name in ("cos", "sin")),
        *(Parameter("const int*", name) for name in ("starts", "lengths")),
        Parameter("Element*", "out"),  # bfloat16 or E4M3: common.cu
        *(Parameter("int", name) for name in ("tokens", "heads", "tiles", "state_token")),
        *(Parameter("float", name) for name in ("scale", "inverse")),
    )
)


def suffix_attention(
    qkv: Tensor,
    cos: Tensor,
    sin: Tensor,
    prefix_k: Tensor,
    prefix_v: Tensor,
    starts: Tensor,
    lengths: Tensor,
    heads: int,
    state_token: bool = False,
    inverse: float | None = None,
    *,
    tile: Tile | None = None,
) -> Tensor:
    """See `kernels.plain_batch.suffix_attention`. All contiguous. With `inverse` the result leaves as E4M3.

    The prefix's keys and values and the segments must have been written before the kernel in front of this one began.
    """
    given = {"qkv": qkv, "cos": cos, "sin": sin, "starts": starts, "lengths": lengths}
    assert all(one.is_contiguous() for one in (*given.values(), prefix_k, prefix_v)), "rows are read as they lie"
    assert all(one.dtype == torch.bfloat16 for one in (qkv, prefix_k, prefix_v))
    assert cos.dtype == sin.dtype == torch.float32 and starts.dtype == lengths.dtype == torch.int32
    batch, count, dim = len(starts) - 1, len(qkv), prefix_k.shape[1]
    tokens = count // batch
    assert qkv.shape[1] == (heads + 2) * dim and cos.shape == sin.shape == (count, dim // 2)
    assert starts.shape == lengths.shape and prefix_k.shape == prefix_v.shape
    rows, in_fp8 = tokens * heads, inverse is not None  # of queries of an observation
    tile = tile or chosen_tile(dim, rows, batch, len(prefix_k) // batch + tokens, in_fp8, qkv.device)
    per_batch, out = -(-rows // tile.rows), qkv.new_empty(count, heads * dim, dtype=result_dtype(qkv, inverse))
    maps = {
        name: instructions.tensor_map(one.data_ptr(), (dim, 1, len(one)), (dim, dim), (64, 1, tile.keys))
        for name, one in (("map_k", prefix_k), ("map_v", prefix_v))
    }
    _kernel(tile, in_fp8, qkv.device).launch_dependent(
        batch * per_batch * tile.ranks,
        {
            **maps,
            **{name: one.data_ptr() for name, one in {**given, "out": out}.items()},
            "tokens": tokens,
            "heads": heads,
            "tiles": per_batch,
            "state_token": int(state_token),
            "scale": dim**-0.5 * LOG2_E,
            "inverse": 1.0 if inverse is None else inverse,
        },
    )
    return out


def chosen_tile(dim: int, rows: int, batch: int, keys: int, in_fp8: bool, device: torch.device) -> Tile:
    """The first of whose clusters the device holds all at once, else the one of smallest clusters.

    Arguments as in `suffix_tile.tiles`.
    """
    for tile, clusters in tiles(dim, rows, batch, keys):
        kernel = _kernel_or_why_not(tile, in_fp8, device)
        if not isinstance(kernel, BackendUnavailable) and kernel.max_clusters >= clusters:
            break
    return tile


def constants(tile: Tile, out_fp8: bool) -> dict[str, int]:
    """What the kernel is compiled with."""
    own = {"TP_PART": tile.part, "TP_COLUMNS": tile.columns} if isinstance(tile, FewTile) else {}
    return own | {
        "TP_DIM": tile.dim,
        "TP_WGS": tile.warpgroups,
        "TP_KEYS": tile.keys,
        "TP_STAGES": tile.stages,
        "TP_OUT_FP8": int(out_fp8),
        "TP_OUT_INT8": 0,
        "TP_ROWS": tile.rows,
        "TP_RANKS": tile.ranks,
    }


def source(tile: Tile) -> str:
    """The kernel with the instructions for a tile."""
    functions = [
        instructions.wgmma("mma_logits", tile.keys),
        instructions.wgmma("mma_values", tile.dim, from_registers=True, across=True),
    ]
    if isinstance(tile, FewTile):
        functions += [
            instructions.wgmma("mma_part", tile.part),
            instructions.wgmma("mma_columns", tile.columns, across=True),
        ]
    parameters = f"#define SUFFIX_PARAMETERS {PARAMETERS.declarations}"
    files = [f"attention/{name}.cu" for name in ("common", "suffix_common", tile.source)]
    return instructions.source(*files, generated="\n".join((*functions, parameters, "")))


def _kernel(tile: Tile, out_fp8: bool, device: torch.device) -> DependentKernel:
    made = _kernel_or_why_not(tile, out_fp8, device)
    if isinstance(made, BackendUnavailable):
        raise made.with_traceback(None)
    return made


@MadeOnce
def _kernel_or_why_not(tile: Tile, out_fp8: bool, device: torch.device) -> DependentKernel | BackendUnavailable:
    """`chosen_tile` asks again for each layer: where no cluster of a size fits, it is loaded once to find that out."""
    with torch.cuda.device(device):
        cubin = compile_cubin(source(tile), "sm_90a", constants(tile, out_fp8))
        try:
            return DependentKernel(
                cubin, "attention", PARAMETERS, shared_bytes=tile.shared_bytes, threads=tile.threads, cluster=tile.ranks
            )
        except BackendUnavailable as why:
            return why
