"""Merging openpi's LoRA adapters into the weights they adapt.

openpi's JAX fine-tunes keep `lora_a` and `lora_b` beside each Gemma matrix and add their product at run time. In the
layouts of `jax_layout.py`, per layer, with r the rank and s = alpha / r (alpha / sqrt(r) if rank-stabilised):

    attention q, kv    w + s * (a @ b)           a[..., D, r]  b[..., r, h]
    attention output   w + s * (a @ sum_n b[n])  a[N, h, r]    b[N, r, D]: openpi's einsum sums b over the heads
    MLP                w + a @ b                 a[..., D, r]  b[..., r, F]: openpi applies no scale here

No checkpoint records alpha. openpi's two LoRA variants (rank 16 in PaliGemma, 32 in the action expert) have alpha equal
to the rank; for any other rank alpha must be given. The merge is done in float32, before any rounding.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt

import torch
from torch import Tensor

from turbopi.support.errors import CheckpointError, ConfigError

_OPENPI_RANKS = {"vlm": 16, "expert": 32}  # openpi's gemma_2b_lora and gemma_300m_lora: alpha = rank


@dataclass(frozen=True)
class LoraScale:
    """What `turbopi.json` says of adapters: `lora_alpha` by stack ("vlm", "expert"), and `lora_rslora`."""

    alpha: Mapping[str, float] | None = None
    rank_stabilised: bool = False

    def factor(self, stack: str, rank: int) -> float:
        """What openpi multiplies an attention adapter's product by. ConfigError if that can't be known."""
        if self.alpha is not None and stack in self.alpha:
            alpha = self.alpha[stack]
        elif rank == _OPENPI_RANKS[stack]:
            alpha = float(rank)
        else:
            raise ConfigError(
                f"the {stack} LoRA adapters have rank {rank}, which none of openpi's variants uses, and no checkpoint "
                f'records alpha. Give the value of the training config: {{"lora_alpha": {{"{stack}": ...}}}} in '
                "turbopi.json"
            )
        return alpha / sqrt(rank) if self.rank_stabilised else alpha / rank


@dataclass(frozen=True)
class Adapter:
    """The two arrays beside one weight, by their paths in the tree."""

    a: str
    b: str
    stack: str  # "vlm" or "expert"
    kind: str  # "attention", "output" or "mlp"


def find_adapters(paths: Mapping[str, tuple[int, ...]]) -> dict[str, Adapter]:
    """Weight path -> its adapter, for a tree's {path: shape}. CheckpointError for half a pair, or wrong shapes."""
    found: dict[str, Adapter] = {}
    for path in paths:
        if not path.endswith(("lora_a", "lora_b")):
            continue
        stem = path[: -len("lora_a")]
        attention = stem.endswith("/")  # attn/q_einsum/lora_a is beside .../w, mlp/linear_lora_a beside mlp/linear
        weight = stem + "w" if attention else stem.removesuffix("_")
        a, b = stem + "lora_a", stem + "lora_b"
        absent = [name for name in (weight, a, b) if name not in paths]
        if absent:
            raise CheckpointError(f"the LoRA adapter {path} is incomplete: {', '.join(absent)} is missing")
        kind = "output" if "attn_vec_einsum" in stem else "attention" if attention else "mlp"
        module = stem.rstrip("/").rsplit("/", 1)[-1] if attention else stem.rsplit("/", 2)[-2]
        stack = "expert" if module.endswith("_1") else "vlm"
        _check_shapes(weight, paths[weight], paths[a], paths[b])
        found[weight] = Adapter(a, b, stack, kind)
    return found


def _check_shapes(weight: str, w: tuple[int, ...], a: tuple[int, ...], b: tuple[int, ...]) -> None:
    rank = a[-1] if a else 0
    if rank < 1 or a != (*w[:-1], rank) or b != (*w[:-2], rank, w[-1]):
        raise CheckpointError(
            f"the LoRA adapter of {weight} {list(w)} has shapes {list(a)} and {list(b)}; expected "
            f"{[*w[:-1], 'r']} and {[*w[:-2], 'r', w[-1]]}"
        )


def merged(weight: Tensor, a: Tensor, b: Tensor, kind: str, factor: float) -> Tensor:
    """float32 weight with one layer's adapter folded in (shapes above, without the layer axis)."""
    a, b = a.float(), b.float()
    if kind == "output":
        b = b.sum(0, keepdim=True)
    scale = 1.0 if kind == "mlp" else factor
    return torch.matmul(a, b).mul_(scale).add_(weight.float())
