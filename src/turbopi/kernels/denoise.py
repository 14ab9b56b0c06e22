"""The whole denoising loop of Pi0.5 in one persistent kernel (denoise.cu): its weights, its sizes and its launch.

Ten steps read the action expert's 311 M weights ten times and do little else, so the loop is a race between memory
and the delay of some thousand dependent operations. One kernel keeps every SM resident, streams the weights through
shared memory without pause and passes activations between SMs in words that are their own ready flags.

Shapes: N steps, L layers, T suffix tokens, D width, F feed-forward width, n query heads of K columns, A action_dim.
"""

import ctypes
import math
from dataclasses import dataclass
from importlib.resources import files

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.engine.weights import GemmaLayer, State
from turbopi.errors import BackendError, BackendUnavailable
from turbopi.kernels.nvrtc import Kernel, compile_cubin
from turbopi.model.denoise import euler_step
from turbopi.model.layers import rope_tables

ROWS, BLOCK = 8, 32  # weight rows of a tile, columns of a block of it
CHUNKS = 16  # parts the keys are split into, for each head
MAX_SUFFIX = 64
WARPS = 8  # that multiply; there are four more
DEEP = 4  # instances of an exchange buffer


def refusal(config: ModelConfig) -> str | None:
    """Why the kernel can't run this model, or None if it can."""
    g = config.expert
    if config.kind != "pi05":
        return f"it covers Pi0.5, this model is {config.kind}"
    if g.num_kv_heads != 1:
        return f"it needs one key/value head, this model has {g.num_kv_heads}"
    if g.width % BLOCK or g.mlp_dim % BLOCK or (g.num_heads * g.head_dim) % BLOCK:
        return (
            f"widths must be multiples of {BLOCK}: width {g.width}, mlp_dim {g.mlp_dim}, heads * head_dim "
            f"{g.num_heads * g.head_dim}"
        )
    if g.head_dim % 16 or g.head_dim > 256:
        return f"head_dim must be a multiple of 16 up to 256, it is {g.head_dim}"
    if config.action_dim % 4:
        return f"action_dim must be a multiple of 4, it is {config.action_dim}"
    return None


def unavailable(device: torch.device) -> str | None:
    """Why the kernel can't run on this device, or None if it can."""
    if device.type != "cuda":
        return "the denoising kernel needs an NVIDIA GPU"
    major, minor = torch.cuda.get_device_capability(device)
    if major < 9:
        return f"the denoising kernel needs compute capability 9.0 or newer, this GPU has {major}.{minor}"
    return None


def rope_pairs(num_heads: int, head_dim: int) -> Tensor:
    """int64[(n + 2) * K]: which row of q|k|v is row i of the kernel's tiles.

    A tile of a query or key head holds four columns of the head's first half in turn with their partners in the
    second, which RoPE turns together. Values stay as they are.
    """
    half = head_dim // 2
    columns = torch.stack((torch.arange(half), torch.arange(half) + half), dim=1).flatten()
    rotated = (torch.arange(num_heads + 1)[:, None] * head_dim + columns).flatten()
    return torch.cat((rotated, (num_heads + 1) * head_dim + torch.arange(head_dim)))


def gate_up_pairs(mlp_dim: int) -> Tensor:
    """int64[2F]: gate rows and up rows in turn."""
    return torch.stack((torch.arange(mlp_dim), torch.arange(mlp_dim) + mlp_dim), dim=1).flatten()


def tiles(matrix: Tensor) -> Tensor:
    """[rows, columns] -> flat: tiles of 8 rows, each in blocks [columns / 32][8][32]."""
    rows, columns = matrix.shape
    return matrix.view(rows // ROWS, ROWS, columns // BLOCK, BLOCK).transpose(1, 2).reshape(-1)


@dataclass(frozen=True)
class PackedExpert:
    """The expert's matrices in the kernel's order. One serves kernels of any number of steps and suffix tokens."""

    weights: Tensor  # bfloat16[L, elements]: of a layer qkv, out, gate|up, down
    num_rows: tuple[int, int]  # of qkv and of gate|up

    @classmethod
    def pack(cls, config: ModelConfig, layers: list[GemmaLayer]) -> "PackedExpert":
        """Raises BackendError for sizes that the kernel doesn't cover."""
        reason = refusal(config)
        if reason is not None:
            raise BackendError(f"the denoising kernel can't run this model: {reason}")
        g = config.expert
        device = layers[0].qkv.device
        qkv_rows = rope_pairs(g.num_heads, g.head_dim).to(device)
        gate_up_rows = gate_up_pairs(g.mlp_dim).to(device)
        size = sum(m.numel() for m in (layers[0].qkv, layers[0].out, layers[0].gate_up, layers[0].down))
        packed = torch.empty(len(layers), size, dtype=torch.bfloat16, device=device)
        for row, layer in zip(packed, layers, strict=True):
            parts = (layer.qkv[qkv_rows], layer.out, layer.gate_up[gate_up_rows], layer.down)
            torch.cat([tiles(part.to(torch.bfloat16)) for part in parts], out=row)
        return cls(packed, (len(qkv_rows), len(gate_up_rows)))

    def matrices(self, config: ModelConfig, layer: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """A layer's qkv, out, gate|up and down as [rows, columns], rows in the order of the tiles."""
        g = config.expert
        width = g.num_heads * g.head_dim
        shapes = (self.num_rows[0], g.width), (g.width, width), (self.num_rows[1], g.width), (g.width, g.mlp_dim)
        out, start = [], 0
        for rows, columns in shapes:
            flat = self.weights[layer, start : start + rows * columns]
            blocks = flat.view(rows // ROWS, columns // BLOCK, ROWS, BLOCK).transpose(1, 2)
            out.append(blocks.reshape(rows, columns))
            start += rows * columns
        return out[0], out[1], out[2], out[3]


def shifted_rows(config: ModelConfig, packed: PackedExpert, table: Tensor) -> Tensor:
    """float32[N, L, qkv rows + gate|up rows]: what the norms' shifts add to the products behind them."""
    layers = []
    for i in range(config.expert.depth):
        qkv, _, gate_up, _ = packed.matrices(config, i)
        products = [table[:, 2 * i + j, 1].double() @ m.double().T for j, m in enumerate((qkv, gate_up))]
        layers.append(torch.cat(products, dim=1).float())
    return torch.stack(layers, dim=1).contiguous()


class _Args(ctypes.Structure):
    """`Args` of denoise.cu."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("weights", "table", "shifted", "out_w", "out_shift", "in_w", "in_b")),
        *((name, ctypes.c_void_p) for name in ("inv_freq", "cache_k", "cache_v", "length", "noise", "x_t", "v_t")),
        ("scratch", ctypes.c_void_p),
        ("layer_stride", ctypes.c_longlong),
        ("steps", ctypes.c_int),
        ("dt", ctypes.c_float),
        ("eps", ctypes.c_float),
        ("zero", ctypes.c_uint32),
    )


def kernel_sizes(
    config: ModelConfig, *, cache_rows: int, suffix: int, num_sms: int, shared_bytes: int
) -> dict[str, int]:
    """The kernel's compile-time constants."""
    g = config.expert
    qkv = (g.num_heads + 2) * g.head_dim
    blocks = min(num_sms, g.width // ROWS, qkv // ROWS, g.mlp_dim // 4, g.num_heads * CHUNKS)
    chunk = math.ceil((cache_rows + suffix) / CHUNKS)
    keys = math.ceil(chunk / 8) * 8
    exchanged = suffix * (2 * g.width + qkv + g.num_heads * g.head_dim + g.mlp_dim) // 2
    partial = g.num_heads * CHUNKS * suffix * (g.head_dim + 2)
    return {
        "TP_D": g.width,
        "TP_F": g.mlp_dim,
        "TP_L": g.depth,
        "TP_NH": g.num_heads,
        "TP_HD": g.head_dim,
        "TP_G": blocks,
        "TP_T": suffix,
        "TP_A": config.action_dim,
        "TP_KEYS": keys,
        "TP_SMEM": shared_bytes,
        "TP_SCRATCH": DEEP * (exchanged + 2 * suffix * g.width // ROWS) + 2 * suffix * config.action_dim + 2 * partial,
        "TP_W": WARPS,
    }


def source() -> str:
    return (files("turbopi.kernels") / "denoise.cu").read_text()


class DenoiseKernel:
    """The loop for a fixed number of steps and suffix tokens; capturable in a CUDA graph.

    `table` float32[N, 2L + 1, 3, D] is the modulation (`engine.weights.modulation`), `small` holds action_in_proj and
    action_out_proj, `cache_rows` is an upper bound of the valid cache rows. Raises BackendError for a model, suffix or
    GPU that it doesn't cover.
    """

    def __init__(
        self,
        config: ModelConfig,
        packed: PackedExpert | list[GemmaLayer],
        small: State,
        table: Tensor,
        *,
        cache_rows: int,
        suffix: int,
        device: torch.device,
    ) -> None:
        reason = unavailable(device)
        if reason is not None:
            raise BackendUnavailable(reason)
        if not 1 <= suffix <= MAX_SUFFIX:
            raise BackendError(f"the denoising kernel takes 1 to {MAX_SUFFIX} suffix tokens, not {suffix}")
        self._config, self._device = config, device
        self._packed = packed if isinstance(packed, PackedExpert) else PackedExpert.pack(config, packed)
        g, properties = config.expert, torch.cuda.get_device_properties(device)
        assert table.shape[1:] == (2 * g.depth + 1, 3, g.width), table.shape
        sizes = kernel_sizes(
            config,
            cache_rows=cache_rows,
            suffix=suffix,
            num_sms=properties.multi_processor_count,
            shared_bytes=properties.shared_memory_per_block_optin,  # type: ignore[attr-defined]
        )
        self._suffix, self._cache_rows, self._blocks = suffix, cache_rows, sizes["TP_G"]
        self._threads = (sizes["TP_W"] + 4) * 32
        self._table = table.to(device).float().contiguous()
        self._tensors = {
            "weights": self._packed.weights,
            "table": self._table,
            "shifted": shifted_rows(config, self._packed, self._table),
            "out_w": small["action_out_proj.weight"].float().contiguous(),
            "out_shift": _affine(small, "action_out_proj", self._table[:, -1, 1].double()).float().contiguous(),
            "in_w": small["action_in_proj.weight"].float().contiguous(),
            "in_b": small["action_in_proj.bias"].float().contiguous(),
            "inv_freq": _inverse_frequencies(config, device),
            "scratch": torch.empty(sizes["TP_SCRATCH"], dtype=torch.int32, device=device),
        }
        with torch.cuda.device(device):
            arch = f"sm_{properties.major}{properties.minor}a"
            self._kernel = Kernel(compile_cubin(source(), arch, sizes), "turbopi_denoise", sizes["TP_SMEM"])

    def launch(self, noise: Tensor, cache_k: Tensor, cache_v: Tensor, length: Tensor, x_t: Tensor, v_t: Tensor) -> None:
        """Denoise on the current stream.

        noise float32[T, A]; cache_k, cache_v bfloat16[L, rows, K], the first `length` (int64[1], on the device) rows
        valid and the others never read; written: x_t float32[N + 1, T, A], v_t float32[N, T, A].
        """
        steps, g, chunk = self._table.shape[0], self._config.expert, (self._suffix, self._config.action_dim)
        assert noise.shape == chunk and x_t.shape == (steps + 1, *chunk) and v_t.shape == (steps, *chunk)
        assert cache_k.stride() == cache_v.stride() and cache_k.stride()[1:] == (g.head_dim, 1), cache_k.stride()
        assert cache_k.dtype == cache_v.dtype == torch.bfloat16 and length.dtype == torch.int64
        assert all(t.is_contiguous() and t.dtype == torch.float32 for t in (noise, x_t, v_t))
        named = {**self._tensors, "cache_k": cache_k, "cache_v": cache_v, "length": length, "noise": noise}
        pointers = {name: t.data_ptr() for name, t in {**named, "x_t": x_t, "v_t": v_t}.items()}
        args = _Args(
            **pointers,
            layer_stride=cache_k.stride(0),
            steps=steps,
            dt=float(np.float32(-1.0 / steps)),
            eps=self._config.rms_norm_eps,
            zero=0,
        )
        self._tensors["scratch"].fill_(-1)  # nothing is there yet
        self._kernel.launch_cooperative(self._blocks, self._threads, args)


def _inverse_frequencies(config: ModelConfig, device: torch.device) -> Tensor:
    """float32[K/2], as `model.layers.rope_tables` computes them."""
    exponents = torch.arange(0, config.expert.head_dim, 2, dtype=torch.float32, device=device) / config.expert.head_dim
    return 1.0 / config.rope_base**exponents


def denoise_plain(
    config: ModelConfig,
    layers: list[GemmaLayer],
    small: State,
    table: Tensor,
    noise: Tensor,
    cache_k: Tensor,
    cache_v: Tensor,
    length: int,
) -> tuple[Tensor, Tensor]:
    """What the kernel computes, in PyTorch and in `noise`'s dtype throughout: (x_t [N + 1, T, A], v_t [N, T, A])."""
    g, dtype, suffix = config.expert, noise.dtype, noise.shape[0]
    positions = length + torch.arange(suffix, device=noise.device)
    cos, sin = (t[0].to(dtype) for t in rope_tables(positions[None], g.head_dim, config.rope_base))
    cos, sin = cos[0][:, None], sin[0][:, None]  # [T, 1, K/2]
    x_t, v_t = [noise], []
    for modulation in table.to(dtype):

        def normed(x: Tensor, index: int, modulation: Tensor = modulation) -> tuple[Tensor, Tensor]:
            scale, shift, gate = modulation[index]
            unit = x * torch.rsqrt(x.square().mean(-1, keepdim=True) + config.rms_norm_eps)
            return unit * scale + shift, gate

        x = _affine(small, "action_in_proj", x_t[-1])
        for i, layer in enumerate(layers):
            y, gate = normed(x, 2 * i)
            parts = (y @ layer.qkv.to(dtype).T).view(suffix, -1, g.head_dim)
            q, k, v = parts[:, :-2], parts[:, -2:-1], parts[:, -1:]
            q, k = (_rotate(part, cos, sin) for part in (q, k))
            keys = torch.cat((cache_k[i, :length].to(dtype), k[:, 0]))
            values = torch.cat((cache_v[i, :length].to(dtype), v[:, 0]))
            attended = (q @ keys.T * g.head_dim**-0.5).softmax(-1) @ values
            x = x + attended.reshape(suffix, -1) @ layer.out.to(dtype).T * gate
            y, gate = normed(x, 2 * i + 1)
            up_gate, up = (y @ layer.gate_up.to(dtype).T).chunk(2, dim=-1)
            x = x + (F.gelu(up_gate, approximate="tanh") * up) @ layer.down.to(dtype).T * gate
        v_t.append(_affine(small, "action_out_proj", normed(x, 2 * g.depth)[0]))
        x_t.append(euler_step(x_t[-1], v_t[-1], table.shape[0]))
    return torch.stack(x_t), torch.stack(v_t)


def _rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """RoPE in x's dtype. x [T, heads, K]"""
    first, second = x.chunk(2, dim=-1)
    return torch.cat((first * cos - second * sin, second * cos + first * sin), dim=-1)


def _affine(small: State, name: str, x: Tensor) -> Tensor:
    return F.linear(x, small[f"{name}.weight"].to(x.dtype), small[f"{name}.bias"].to(x.dtype))
