"""The action expert with a way back: which kernels a GPU gets, by the expert's sizes and the number of tokens.

Up to 64 tokens all is Triton, 14 launches a layer. Forward: attention's norm, q|k|v with RoPE, attention in splits of
its keys, the product behind it, the MLP's norm, gate|up with GeGLU, down. Back: down with GeGLU, gate|up, norm, out,
attention, q|k|v with RoPE, norm. Products whose result only a norm reads leave parts, which the norm adds up.
"""

from turbopi.config import GemmaConfig
from turbopi.kernels.interface import BackwardOps
from turbopi.kernels.portable import backward
from turbopi.kernels.portable.vjp import attention, ends, products
from turbopi.kernels.portable.vjp.tiles import MOST_TOKENS, takes

BETWEEN_PRODUCTS = backward.PIECES.ops("Triton, between cuBLAS's products")
FEW_TOKENS = BackwardOps(
    qkv=products.qkv,
    attention=attention.attention,
    out=attention.out,
    gate_up=products.gate_up,
    down=products.down,
    down_vjp=products.down_vjp,
    gate_up_vjp=products.gate_up_vjp,
    rms_norm_vjp=backward.rms_norm_vjp,
    out_vjp=products.out_vjp,
    attention_vjp=attention.attention_vjp,
    qkv_vjp=products.qkv_vjp,
    kept_attention=attention.kept_attention,
    pull=ends.pull,
    move=ends.move,
    origin="Triton",
)
ORIGIN = f"Triton for up to {MOST_TOKENS} tokens, else cuBLAS and Triton"


def backward_form(expert: GemmaConfig, tokens: int, masked: bool = False) -> BackwardOps:
    """masked: keys are hidden from some tokens, as of several observations together."""
    return FEW_TOKENS if takes(expert, tokens) and not masked else BETWEEN_PRODUCTS
