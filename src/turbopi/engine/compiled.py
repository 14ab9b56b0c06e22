"""The plain operations with Inductor's kernels between the matmuls."""

import inspect
import os
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.engine import without_compiler
from turbopi.kernels import backward
from turbopi.kernels.interface import BatchOps, Ops
from turbopi.kernels.plain import (
    PLAIN,
    attention,
    embed_patches,
    embed_prompt,
    geglu_by_sigmoid,
    gelu_by_sigmoid,
    linear,
    masked_softmax,
    residual_layer_norm,
    residual_rms_norm,
    rope_split,
    transfer,
    vision_attention,
)

# Axes that differ from call to call (tokens, keys), by argument; all others are fixed by the model's sizes. A norm's
# gate, scale and shift are [width], or [tokens, width] in a conditioned loop.
_DYNAMIC_AXES: dict[Callable[..., Any], dict[str, tuple[int, ...]]] = {
    residual_rms_norm: {"x": (0,), "y": (0,)},
    residual_layer_norm: {"x": (0,), "y": (0,)},
    gelu_by_sigmoid: {"x": (0,)},
    geglu_by_sigmoid: {"gate_up": (0,)},
    rope_split: {"qkv": (0,), "cos": (0,), "sin": (0,), "k_out": (0,), "v_out": (0,)},
    masked_softmax: {"logits": (0, 1)},
    backward.geglu: {"gate_up": (0,)},
    backward.rms_norm_vjp: {"d_normed": (0,), "x": (0,), "d_x": (0,)},
    backward.geglu_vjp: {"d_hidden": (0,), "gate_up": (0,)},
    backward.softmax_vjp: {"probabilities": (0, 1), "d_probabilities": (0, 1)},
    backward.rope_vjp: {"d_q": (0,), "d_k": (0,), "d_v": (0,), "cos": (0,), "sin": (0,)},
}
_RECOMPILE_LIMIT = 64  # one compilation per width and per set of optional arguments; PyTorch's default is 8


def _resize_images(table: Tensor, images: Tensor) -> None:
    from turbopi.kernels.portable.resize import resize_images  # Triton is there where Inductor is

    resize_images(table, images)


def _batch() -> BatchOps:
    from turbopi.kernels.portable.batch import BATCH  # as above

    return BATCH


def compiled() -> Ops:
    """The same operations with torch.compile between the matmuls, for any number of tokens and keys.

    Where it is switched off (TORCH_COMPILE_DISABLE or TORCHDYNAMO_DISABLE is 1, which PyTorch reads when it compiles)
    `without_compiler.OPS`, as what suits a compiler is slower one by one.
    """
    if torch._dynamo.config.disable or os.environ.get("TORCHDYNAMO_DISABLE") == "1":
        return without_compiler.OPS
    softmax, rope = _compiled(masked_softmax), _compiled(rope_split)
    compiled_gelu, compiled_geglu = _compiled(gelu_by_sigmoid), _compiled(geglu_by_sigmoid)

    def compiled_attention(*args: Any) -> Tensor:
        return attention(*args, softmax=softmax)

    backward_between_matmuls = backward.BetweenProducts(
        softmax=softmax,
        geglu=_compiled(backward.geglu),
        rope_split=rope,
        rms_norm_vjp=_compiled(backward.rms_norm_vjp),
        geglu_vjp=_compiled(backward.geglu_vjp),
        softmax_vjp=_compiled(backward.softmax_vjp),
        rope_vjp=_compiled(backward.rope_vjp),
    ).ops("Inductor, between cuBLAS's products")

    return Ops(
        transfer=transfer,
        resize_images=_resize_images if torch.cuda.is_available() else None,
        embed_patches=embed_patches,
        embed_prompt=embed_prompt,
        residual_rms_norm=_compiled(residual_rms_norm),
        residual_layer_norm=_compiled(residual_layer_norm),
        linear=linear,
        residual_linear=linear,
        linear_gelu=lambda x, weight, bias: compiled_gelu(F.linear(x, weight, bias)),
        linear_geglu=lambda x, gate_up: compiled_geglu(F.linear(x, gate_up)),
        rope_split=rope,
        vision_attention=vision_attention,
        attention=compiled_attention,
        batch=_batch() if torch.cuda.is_available() else None,
        backward=lambda expert, tokens, masked=False: backward_between_matmuls,
        origin={**PLAIN.origin, "all else": "Inductor"},
    )


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    jitted = torch.compile(function, fullgraph=True)
    norms = (residual_rms_norm, backward.rms_norm_vjp)
    by_token = ("gate", "scale", "shift") if function in norms else ()
    names = list(inspect.signature(function).parameters)
    dynamic_axes = _DYNAMIC_AXES[function]
    # elsewhere a second width would make widths unknown, too, and every index a division
    unknown_numbers = function is masked_softmax  # `slots` differs from bucket to bucket

    def call(*args: Any) -> Any:
        for name, arg in zip(names, args, strict=False):
            axes = (0,) if name in by_token and arg is not None and arg.dim() == 2 else dynamic_axes.get(name, ())
            for axis in axes if arg is not None else ():
                torch._dynamo.maybe_mark_dynamic(arg, axis)
        with torch._dynamo.config.patch(recompile_limit=_RECOMPILE_LIMIT, automatic_dynamic_shapes=unknown_numbers):
            return jitted(*args)

    return call
