"""A call's intermediates in golden layouts, as the reference's trace has them."""

from typing import Any

import torch
from torch import Tensor

from turbopi.models.pi0.reference import Trace


def golden_trace(call: Any, length: int, valid: Tensor) -> Trace:
    """A call's intermediates in golden layouts: its `length` cache rows go back to the slots in `valid` bool[S]."""
    return padded_trace(call.cache_k[:, :length], call.cache_v[:, :length], call.x_t, call.v_t, valid)


def padded_trace(k: Tensor, v: Tensor, x_t: Tensor, v_t: Tensor, valid: Tensor) -> Trace:
    """One observation's intermediates in golden layouts: k, v [layer, length, K], x_t [N + 1, H, A], v_t [N, H, A]."""

    def padded(x: Tensor) -> Tensor:  # -> [layer, 1, S, 1, K]
        out = torch.zeros(x.shape[0], len(valid), x.shape[-1])
        out[:, valid] = x.float().cpu()
        return out[:, None, :, None]

    return {
        "kv_k": padded(k),
        "kv_v": padded(v),
        "x_t": x_t[:, None].clone(),
        "v_t": v_t[:, None].clone(),
        "actions": x_t[-1:].clone(),
    }
