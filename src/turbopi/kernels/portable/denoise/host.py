"""The host's half of both denoising kernels, Hopper's and the portable one: what differs between them is data."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.kernels.arguments import Parameter, Struct
from turbopi.kernels.interface import State, TokenInputs
from turbopi.kernels.nvrtc import Kernel
from turbopi.kernels.portable.denoise.packing import Expert
from turbopi.support.errors import BackendError, BackendUnavailable


def ends(layout: str) -> tuple[Parameter, ...]:
    """Both structs' fields of the projections to actions and from them, and of the cache. `layout`: of the matrices."""
    return (
        Parameter("const float*", "out_w", layout),
        Parameter("const float*", "out_shift", "[N][A]: action_out_proj of the final norm's shift, and its bias"),
        Parameter("const float*", "in_w", layout),
        Parameter("const float*", "in_b", "[D]"),
        Parameter("const float*", "inv_freq", "[K/2]"),
        Parameter("const unsigned char*", "cache_k", "bf16 [L][rows][K], layer_stride bytes from layer to layer"),
        Parameter("const unsigned char*", "cache_v"),
    )


OF_LAUNCH = (
    Parameter("const long long*", "length", "valid rows of the cache"),
    Parameter("const float*", "noise", "[T][A]"),
    Parameter("float*", "x_t", "[N+1][T][A]"),
    Parameter("float*", "v_t", "[N][T][A]"),
)


def model_sizes(config: Expert, suffix: int) -> dict[str, int]:
    """The compile-time constants that both kernels have."""
    g = config.expert
    return {
        "TP_WIDTH": g.width,
        "TP_MLP_DIM": g.mlp_dim,
        "TP_DEPTH": g.depth,
        "TP_HEADS": g.num_heads,
        "TP_HEAD_DIM": g.head_dim,
        "TP_TOKENS": suffix,
        "TP_ACTION_DIM": config.action_dim,
    }


def check_covered(kernel: str, reason: str | None, suffix: int, most: int) -> None:
    """Raises BackendUnavailable with the reason, if there is one, and BackendError for too many suffix tokens."""
    if reason is not None:
        raise BackendUnavailable(reason)
    if not 1 <= suffix <= most:
        raise BackendError(f"{kernel} takes 1 to {most} suffix tokens, not {suffix}")


def affine(small: State, name: str, x: Tensor) -> Tensor:
    return F.linear(x, small[f"{name}.weight"].to(x.dtype), small[f"{name}.bias"].to(x.dtype))


def end_tensors(config: Expert, small: State, table: Tensor, *, out_w: Tensor, in_w: Tensor) -> dict[str, Tensor]:
    """What the fields of `ends` point to, but for the cache; `table` float32[N, 2L + 1, 3, D] on the device."""
    exponents = torch.arange(0, config.expert.head_dim, 2, dtype=torch.float32, device=table.device)
    return {
        "out_w": out_w.float().contiguous(),
        "out_shift": affine(small, "action_out_proj", table[:, -1, 1].double()).float().contiguous(),
        "in_w": in_w.float().contiguous(),
        "in_b": small["action_in_proj.bias"].float().contiguous(),
        # as `model.layers.rope_tables` computes them
        "inv_freq": 1.0 / config.rope_base ** (exponents / config.expert.head_dim),
    }


@dataclass(frozen=True)
class Launched:
    """A kernel and its grid."""

    kernel: Kernel
    blocks: int
    threads: int


class CooperativeDenoiser:
    """A loop for a fixed number of steps and suffix tokens, one cooperative launch; capturable in a CUDA graph.

    arguments  the struct that both kernels take: its fields are given by name, from `tensors` (their addresses),
        `numbers`, and what a launch brings
    prepare    runs in front of the loop
    """

    def __init__(
        self,
        config: Expert,
        *,
        steps: int,
        suffix: int,
        arguments: Struct,
        tensors: Mapping[str, Tensor],
        numbers: Mapping[str, float],
        prepare: Launched,
        loop: Launched,
    ) -> None:
        self._config, self._steps, self._suffix = config, steps, suffix
        self._arguments, self._tensors, self._prepare, self._loop = arguments, tensors, prepare, loop
        self._numbers = {"steps": steps, "eps": config.rms_norm_eps, "dt": float(np.float32(-1.0 / steps)), **numbers}

    def launch(
        self,
        noise: Tensor,
        cache_k: Tensor,
        cache_v: Tensor,
        length: Tensor,
        x_t: Tensor,
        v_t: Tensor,
        tokens: TokenInputs | None = None,
    ) -> None:
        """Denoise on the current stream.

        noise float32[T, A]; cache_k, cache_v bfloat16[L, rows, K], of several heads [L, G, rows, K], the first
        `length` (int64[1], on the device) rows valid and the others never read; written: x_t float32[N + 1, T, A],
        v_t float32[N, T, A]. `tokens`: by token.
        """
        assert length.dtype == torch.int64, length.dtype
        self._launch(noise, cache_k, cache_v, x_t, v_t, length=length, **self._token_tensors(tokens))

    def _token_tensors(self, tokens: TokenInputs | None) -> dict[str, Tensor]:
        assert tokens is None, "this kernel has no times by token"
        return {}

    def _launch(
        self, noise: Tensor, cache_k: Tensor, cache_v: Tensor, x_t: Tensor, v_t: Tensor, **more: Tensor | int
    ) -> None:
        chunk = self._suffix, self._config.action_dim
        assert noise.shape == chunk and x_t.shape == (self._steps + 1, *chunk) and v_t.shape == (self._steps, *chunk)
        head_dim = self._config.expert.head_dim
        assert cache_k.stride() == cache_v.stride() and cache_k.stride()[-2:] == (head_dim, 1), cache_k.stride()
        assert cache_k.dtype == cache_v.dtype == torch.bfloat16
        assert all(t.is_contiguous() and t.dtype == torch.float32 for t in (noise, x_t, v_t))
        given = {**self._tensors, "noise": noise, "cache_k": cache_k, "cache_v": cache_v, "x_t": x_t, "v_t": v_t}
        values = {name: one.data_ptr() if isinstance(one, Tensor) else one for name, one in {**given, **more}.items()}
        args = self._arguments.value({**self._numbers, "layer_stride": cache_k.stride(0) * 2, **values})
        self._prepare.kernel.launch(self._prepare.blocks, self._prepare.threads, args)
        self._loop.kernel.launch_cooperative(self._loop.blocks, self._loop.threads, args)  # blocks wait for one another
