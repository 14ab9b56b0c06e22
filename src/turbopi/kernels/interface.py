"""What the engine and kernels agree on: each folder of kernels gives one `Ops` and one `Denoiser`.

Shapes: D, W widths, F hidden width of an MLP, K head_dim, A action_dim.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

from torch import Tensor

from turbopi.quantization.fp8 import Matrix

State = dict[str, Tensor]
Affine = tuple[Tensor, Tensor]  # weight [out, in], bias [out]; of a LayerNorm: weight, bias [W]
AffineMatrix = tuple[Matrix, Tensor]
AnyMatrix = TypeVar("AnyMatrix", bound=Matrix)


PILLOW_BITS = 22  # of the fraction of its weights: 32 less 8 of a pixel and 2 to spare


@dataclass(frozen=True)
class Taps:
    """One axis of an image resized: number i of the result is made of `weights[i]` times those from `first[i]` on.

    first      int32[n]
    weights    int32[n, taps], in units of 2^-22 (Pillow), or float32[n, 2]. Beyond the image its last number counts,
               with a weight of 0 but for float32
    """

    first: Tensor
    weights: Tensor


# What `resize_images` is given of each camera's image: int64[len(SOURCE)] in the device's memory, so that a captured
# graph takes images of any size. Addresses of the image uint8[height, width, 3] and of its `Taps`; sizes; where in
# the result it begins, and how much of it it fills (no rows: the result stays as it is); `kernels.plain`'s `low`.
SOURCE = (
    *("image", "x_first", "x_weights", "y_first", "y_weights"),
    *("width", "height", "x_taps", "y_taps", "top", "left", "rows", "columns", "low"),
)


@dataclass(frozen=True)
class VisionLayer:
    norm1: Affine
    qkv: AffineMatrix  # [3W, W], [3W]
    out: AffineMatrix
    norm2: Affine
    fc1: AffineMatrix
    fc2: AffineMatrix


@dataclass(frozen=True)
class VisionStream:
    """The vision tower's residual stream, and what is known of it or still to be added to it.

    pending  what the next norm adds: None, a matmul's result or its parts, or a matmul that is still to run
    sums     of x's rows, from the matmul that made x; None: not known
    """

    x: Tensor  # [V * 256, W]
    pending: Any = None
    sums: Any = None


class VisionOps(Protocol):
    """The vision tower by layers: for kernels that put norms and the residual stream into their matmuls.

    `pending` and `sums` of a stream are the implementation's own: only it may read them.
    """

    def layer(
        self, layer: VisionLayer, stream: VisionStream, *, images: int, heads: int, eps: float, following: Matrix
    ) -> VisionStream:
        """One layer. following: the matrix that is multiplied behind it."""

    def finish(self, stream: VisionStream, norm: Affine, eps: float) -> Tensor:
        """The residual stream with all that was pending. norm: the one behind it, whose result isn't needed yet."""

    def project(self, stream: VisionStream, norm: Affine, projector: AffineMatrix, eps: float, out: Tensor) -> None:
        """The last norm and the projector, into `out` [V * 256, D]."""


@dataclass(frozen=True)
class GemmaLayer(Generic[AnyMatrix]):
    """One layer of either stack. The norms are float32[D], 1 + scale; None where adaRMS replaces them."""

    qkv: AnyMatrix  # [(heads + 2) * K, D]
    out: AnyMatrix  # [D, heads * K]
    gate_up: AnyMatrix  # [2F, D]: gate rows, then up rows
    down: AnyMatrix  # [D, F]
    norm1: Tensor | None
    norm2: Tensor | None


@dataclass(frozen=True)
class Ops:
    """Any of them may be exchanged for another implementation; `origin` says whose they are, for metadata.

    `residual_linear` may return parts of its product, [parts, T, D], that are still to be added up: only a residual
    norm may read it, as `y`. A norm's second result may have the next product's numbers: only a product may read it.
    """

    transfer: Callable[[Tensor, Tensor], None]  # between the device and pinned memory of the host
    embed_patches: Callable[..., Tensor]
    embed_prompt: Callable[..., None]
    residual_rms_norm: Callable[..., tuple[Tensor, Tensor]]
    residual_layer_norm: Callable[..., tuple[Tensor, Any]]
    linear: Callable[..., Tensor]
    residual_linear: Callable[..., Any]
    linear_gelu: Callable[..., Tensor]
    linear_geglu: Callable[..., Tensor]
    rope_split: Callable[..., Tensor]
    vision_attention: Callable[..., Tensor]
    attention: Callable[..., Tensor]
    # adds a product to the residual stream, its first argument, in place; further arguments as of `residual_linear`.
    # Returns whether it did: where it didn't, `residual_linear` is the faster way
    add_linear: Callable[..., bool] | None = None
    vision: VisionOps | None = None  # None: `forward.VisionByOps` of these operations
    prefix_cache: Callable[..., None] | None = None  # in place of `forward.prefix_cache`
    resize_images: Callable[[Tensor, Tensor], None] | None = None  # as `SOURCE` says; None: the host resizes them
    # by the expert's sizes, the number of its tokens, and whether keys are hidden from some of them (`Expert.hidden`);
    # None: `kernels.backward.PLAIN_BACKWARD`
    backward: "Callable[..., BackwardOps] | None" = None
    batch: "BatchOps | None" = None  # None: `kernels.plain_batch.PLAIN_BATCH`
    origin: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class BackwardOps:
    """The action expert with a way back, for guidance by the true Jacobian: see `kernels.backward` for the twins.

    The first five are forward, with `Ops.residual_rms_norm` between them, and keep what the way back needs. `attention`
    and `attention_vjp` may return sums that are unfinished: only `out` may read the first result of one, only `qkv_vjp`
    that of the other. A product that only a norm or its way back reads may be float32 parts [parts, T, D], still to be
    added up.
    """

    qkv: Callable[..., Tensor]
    attention: Callable[..., tuple[Any, Any]]
    out: Callable[[Any, Tensor], Tensor]
    gate_up: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
    down: Callable[[Tensor, Tensor], Tensor]
    down_vjp: Callable[[Tensor, Tensor, Tensor], Tensor]
    gate_up_vjp: Callable[[Tensor, Tensor], Tensor]
    rms_norm_vjp: Callable[..., tuple[Tensor, Tensor | None]]
    out_vjp: Callable[[Tensor, Tensor], Tensor]
    attention_vjp: Callable[..., Any]
    qkv_vjp: Callable[[Any, Tensor, Tensor, Tensor], Tensor]
    # queries [L, T * n, K], k and v [L, R, K] to what `attention` keeps of each layer: one kernel went forward
    kept_attention: Callable[..., Sequence[Any]]
    # the ends of such a step of one observation: from v_t to the final norm, from the tokens to the next x_t
    pull: Callable[..., tuple[Tensor, Tensor]]
    move: Callable[..., None]
    origin: str


@dataclass(frozen=True)
class Segments:
    """Which packed rows belong together, on the device: observations one behind the other, then padding."""

    starts: Tensor  # int32[B + 1]  first row of each; the last one is the padding's
    lengths: Tensor  # int32[B + 1]  rows of each, perhaps none
    # int32[tiles, 4]  tiles of 64 query rows of packed attention: the first one, where its segment ends, and that
    # segment's first key and number of keys. A tile that ends where it begins is none. Each segment begins with an even
    # tile, so that a block may take two.
    tiles: Tensor


@dataclass(frozen=True)
class StepEnd:
    """What is between the expert's last layer and the next step's tokens (Pi0.5), all float32.

    The last norm's scale and shift [D]; the projection of the expert's output to v [A, D], [A]; Euler's step, by which
    v is multiplied before it is added to x; the projection of x to tokens [D, A], [D].
    """

    scale: Tensor
    shift: Tensor
    eps: float
    out: Affine
    step: float
    into: Affine


@dataclass(frozen=True)
class BatchOps:
    """What a batch takes beside `Ops`: see `kernels.plain_batch` for the twins."""

    embed_rows: Callable[[Tensor, Tensor, Tensor, Tensor], None]
    packed_attention: Callable[..., Tensor]
    suffix_attention: Callable[..., Tensor]
    end_step: Callable[..., Tensor]
    # the expert's operations on a batch's tokens, of the usual ones
    expert: "Callable[[Ops], Ops]"
    origin: str


@dataclass(frozen=True)
class TokenInputs:
    """A conditioned loop's inputs by action (models/pi0/conditioning.py), on the device, read when its kernels run.

    Identity guidance is v ← v + gain · ((x − times · v) − target), so without guidance gain is 0.
    """

    rows: Tensor  # int32[N, T]  of the table of modulation, which has one for each distinct time
    steps: Tensor  # float32[N, T]  what x moves by, times v
    times: Tensor  # float32[N, T]
    target: Tensor  # float32[T, A]
    gain: Tensor  # float32[N, T]  strength times weight


class Denoiser(Protocol):
    """All denoising steps in one launch, for one number of steps and one horizon."""

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
        """From noise float32[H, A] and the cache's first `length` rows: x_t float32[N + 1, H, A], v_t [N, H, A].

        `tokens` of a loop that was made for them, and of no other; v_t then is the guided v that was integrated.
        """


@dataclass(frozen=True)
class KeptStep:
    """What one evaluation of the expert leaves for a way back, all bfloat16. L layers, T tokens, F hidden units.

    Beside it the suffix's keys and values are in the cache's last rows.
    """

    stream: Tensor  # [2L + 1, T, D]  the residual stream in front of each norm
    q: Tensor  # [L, T * n, K]  turned queries
    gate_up: Tensor  # [L, T, 2F]


class KeepingDenoiser(Protocol):
    """One evaluation of the expert in one launch, with what its way back needs."""

    def launch_step(
        self, step: int, x_t: Tensor, cache_k: Tensor, cache_v: Tensor, length: Tensor, v_t: Tensor, tokens: TokenInputs
    ) -> KeptStep:
        """Of x_t float32[H, A] in one step of a loop: v_t float32[H, A], without guidance. Steps come in order, and
        what one leaves is there until the next.
        """


class PairDenoiser(Protocol):
    """All denoising steps of two observations beside each other in one launch: their weights are read once."""

    def launch_pair(
        self, noise: Tensor, cache_k: Tensor, cache_v: Tensor, segments: Tensor, x_t: Tensor, v_t: Tensor
    ) -> None:
        """From noise float32[2, H, A]: x_t float32[N + 1, 2, H, A], v_t float32[N, 2, H, A].

        The observations' rows of the cache bfloat16[L, rows, K] lie one behind the other. segments int32[3], on the
        device: the first row of either, and the first one behind them; one may have none.
        """
