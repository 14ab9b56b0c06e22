"""Backend `fused`: the call of `cuda_graph` with kernels of our own where they beat PyTorch's.

Nothing is compiled by Inductor. On compute capability 9.0 the whole denoising loop, attention of vision and prefix, the
prefix's feed-forward and many of vision's products are CUDA C++ kernels for it. On other GPUs, and with
TURBOPI_KERNELS=portable, they are the kernels of kernels/portable. A model, horizon or loop that the denoising kernels
don't cover takes the engine's operations one by one. `describe()` says what runs.
"""

import importlib.util
import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, Protocol, runtime_checkable

import torch
from torch import Tensor

from turbopi.backends.base import LoadState, Precision
from turbopi.backends.cuda_graph import CudaGraphBackend
from turbopi.backends.device_lost import ADVICE
from turbopi.backends.tuned_tiles import BY_MODEL, Tiles, tiles_of
from turbopi.config import ModelConfig
from turbopi.engine.call import CallShape
from turbopi.engine.loops import Loop
from turbopi.engine.plan import MAX_CAMERAS, bucket
from turbopi.engine.weight_placement import HOST, WeightPlacement, is_conditioning
from turbopi.engine.weights import Weights, pack
from turbopi.kernels.interface import Denoiser, KeepingDenoiser, Ops, PairDenoiser
from turbopi.kernels.portable.quantize import quantize
from turbopi.kernels.tile_table import NO_TILES
from turbopi.quantization.calibration_file import Quantization, check_given
from turbopi.quantization.formats import INT8
from turbopi.quantization.fp8 import Directions, Matrix
from turbopi.quantization.plan import TIERS
from turbopi.quantization.sites import KINDS
from turbopi.support.errors import BackendUnavailable, DeviceLost
from turbopi.support.toolchain import missing_for_c

logger = logging.getLogger(__name__)


@runtime_checkable
class Watched(Protocol):
    """A denoising kernel that tells how it fares: the one for Hopper."""

    def clock_mhz(self) -> float | None: ...

    def why_it_trapped(self) -> str | None: ...


class FusedBackend(CudaGraphBackend):
    """As `cuda_graph`, in bfloat16 or, as a calibration says, partly in FP8 or INT8: `describe()` says what runs."""

    name: ClassVar[str] = "fused"
    # measured on an H200 with two cameras in bfloat16: benchmarks/results/h200_2026-11-27_attention, of 2 without the
    # kernel for pairs docs/dev/log.md; in FP8 two take 1.6, four 2.7, eight 4.6, sixteen 8.7
    COSTS: ClassVar[Mapping[int, float]] = {1: 1, 2: 2.2, 4: 2.9, 8: 5.15, 16: 10.1}
    COSTS_WITH_PAIRS: ClassVar[Mapping[int, float]] = {**COSTS, 2: 1.65}
    # where one guided call alone goes forward in the denoising kernel; of two estimated
    JACOBIAN_COSTS_BESIDE_KERNEL: ClassVar[Mapping[int, float]] = {1: 1, 2: 2.2, 4: 3.3, 8: 5.2}
    _tiles = Tiles(NO_TILES, BY_MODEL)  # measured ones, as they were when this backend was made
    _on_hopper = True  # whether kernels for compute capability 9.0 run
    _batches_denoise_in_bf16 = False  # for good, as their graphs point to the matrices on the device
    _batches_guide_in_bf16 = False  # the same, of those guided by the true Jacobian
    _fp8_expert: list[Any] | None = None  # layers with `ScaledMatrix`, of batches
    precisions: ClassVar[tuple[Precision, ...]] = ("bf16", *TIERS)

    def __init__(
        self,
        config: ModelConfig,
        load: LoadState,
        *,
        device: torch.device,
        precision: Precision,
        quantization: Quantization | None = None,
    ) -> None:
        check_given(precision, quantization)
        self._quantization = quantization
        self._plan = None if quantization is None else quantization.plan(config, precision)
        self._packed_expert: Any = None  # as the denoising kernels have it
        self._denoisers: dict[tuple[Loop, int], Denoiser] = {}  # by loop and cache rows
        self._pair_denoisers: dict[tuple[Loop, int], PairDenoiser] = {}  # of two observations, for batches
        # forward, where the true Jacobian goes back; None: refused
        self._keepers: dict[tuple[Loop, int], KeepingDenoiser | None] = {}
        self._refused: dict[tuple[Loop, int], str] = {}  # what operations denoise, and why
        super().__init__(config, load, device=device, precision=precision)

    @classmethod
    def unavailable(cls, device: torch.device) -> str | None:
        reason = super().unavailable(device)
        if reason is not None:
            return reason
        if importlib.util.find_spec("triton") is None:
            return "its kernels are written in Triton, which isn't installed; `pip install triton`"
        if (missing := missing_for_c()) is not None:
            return f"Triton can't build its launcher here: {missing}"
        if importlib.util.find_spec("cuda") is None or importlib.util.find_spec("cuda.bindings") is None:
            return (
                "its CUDA kernels are compiled through cuda.bindings, which isn't installed; `pip install cuda-python`"
            )
        return None

    @classmethod
    def unavailable_in(cls, device: torch.device, precision: Precision) -> str | None:
        """Why this precision, besides the backend, can't run on a GPU that the backend runs on; or None."""
        if precision not in TIERS or importlib.util.find_spec("triton") is None:  # which `unavailable` tells
            return None
        from turbopi.kernels.ops import forced_portable
        from turbopi.kernels.portable.gemm.tiles import fp8_refusal, int8_refusal

        capability = torch.cuda.get_device_capability(device)
        if precision == "int8":
            reason = int8_refusal(capability)
            measured_here = capability == (9, 0) and forced_portable()
            return None if reason is None or measured_here else f"{reason}; use 'fp8'"
        reason = fp8_refusal(capability)
        return None if reason is None else f"{reason}; use 'bf16', or 'int8'"

    def describe(self) -> dict[str, Any]:
        described = super().describe() | {"tiles": self._tiles.about}
        if self._plan is not None and self._quantization is not None:
            numbers = self._plan.format.name
            described[numbers] = self._quantization.describe(self._plan)
            expert, plan = self._expert_precision(), described[numbers]["plan"]
            for name, what in plan.items():
                if name.startswith("expert.") and what == numbers and not expert.startswith(numbers):
                    plan[name] = expert  # its kernel takes one precision
            plan["expert"] = expert
            if self._fp8_expert is not None:
                plan["expert of batches"] = numbers
            elif self._batches_denoise_in_bf16 and self._plan.expert != "bf16":
                plan["expert of batches"] = "bf16, as operations denoise"
            if self._batches_guide_in_bf16 and self._plan.expert != "bf16":
                plan["expert of batches guided by the Jacobian"] = "bf16, as its way back is"

        by_kernel = sorted({str(loop) for loop, _ in list(self._denoisers)})
        by_operations: dict[str, list[str]] = {}
        for (loop, rows), why in list(self._refused.items()):
            kept = self._keepers.get((loop, rows)) is not None
            how = "one CUDA kernel a step forward, operations back" if kept else f"operations, as {why}"
            calls = by_operations.setdefault(how, [])
            if str(loop) not in calls:
                calls.append(str(loop))
        kernel = "one CUDA kernel" if self._on_hopper else "one portable CUDA kernel"
        described["denoising"] = ({kernel: by_kernel} if by_kernel else {}) | by_operations
        if pairs := sorted({str(loop) for loop, _ in list(self._pair_denoisers)}):
            described["denoising"]["one CUDA kernel for two observations"] = pairs
        clocks = {
            str(loop): round(clock)
            for (loop, _), kernel in list(self._denoisers.items())
            if isinstance(kernel, Watched) and (clock := kernel.clock_mhz()) is not None
        }
        if clocks:
            described["denoising_clock_mhz"] = clocks
        return described

    def _pack(self, load: LoadState) -> Weights:
        def on_host(name: str) -> bool:
            """What is rounded comes to the GPU a matrix at a time, which then never holds the checkpoint in bfloat16;
            so does the expert, in its kernel's order.
            """
            return self._plan is not None or name.startswith("expert.layers.") or is_conditioning(self.config, name)

        placement = WeightPlacement(self.config, self.device, on_host)
        return pack(self.config, load(placement, "bf16"), self._quantized, device=self.device, expert_device=HOST)

    @property
    def _directions(self) -> Mapping[str, Directions]:
        return {} if self._plan is None else self._plan.directions

    def _expert_inputs(self) -> Mapping[str, float] | None:
        """The scales of the expert's activations where the denoising kernel is to run in FP8 or with INT8 weights."""
        return None if self._plan is None or self._plan.expert == "bf16" else self._plan.scales

    def _expert_precision(self) -> str:
        """What the expert runs in, openly."""
        if self._plan is None or self._plan.expert == "bf16":
            kept = {} if self._plan is None else self._plan.kept
            why = next((reason for site, reason in kept.items() if site.startswith("expert.")), "it isn't planned")
            return f"bf16, all of it, as its kernel takes one precision; {why}"
        numbers = self._plan.expert
        if not self._refused:
            return numbers
        if not self._denoisers:
            return "bf16, as operations denoise"
        return f"{numbers} in the denoising kernel; bf16 where operations denoise"

    def _make_ops(self) -> Ops:
        from turbopi.kernels.ops import fused_ops, hopper_kernels  # Triton isn't imported for other backends

        self._on_hopper, self._tiles = hopper_kernels(self.device), tiles_of(self.device)
        return fused_ops(self.device, self._tiles.table)

    @property
    def _times_by_token(self) -> bool:
        return self._on_hopper

    def _make_denoiser(self, shape: CallShape, table: Tensor | None) -> Denoiser | None:
        """The kernel of all steps; None, with the reason noted, where it doesn't cover the model, loop or GPU."""
        rows = self._most_rows(shape)
        key = (shape.loop, rows)
        if key not in self._denoisers and key not in self._refused:
            try:
                self._denoisers[key] = self._denoising_kernel(shape.loop, rows, table)
            except BackendUnavailable as e:
                self._refused[key] = str(e)
        if key in self._denoisers:
            return self._denoisers[key]
        self._drop_unused_expert()
        self._keep_expert_on(self.device)  # while such a graph is kept, as it points to it
        return None

    def _drop_unused_expert(self) -> None:
        """Let go of the packed matrices, 0.6 GB, if no kernel has them."""
        if not any((*self._denoisers.values(), *self._pair_denoisers.values(), *self._keepers.values())):
            self._packed_expert = None

    def _most_rows(self, shape: CallShape) -> int:
        """Of the cache's prefix, of all calls that one denoising kernel serves."""
        cameras = min(max(shape.cameras, 3), MAX_CAMERAS)
        return cameras * self.config.vision.num_tokens + bucket(self.config.max_prompt_tokens)

    def _make_keeper(self, shape: CallShape, table: Tensor | None) -> KeepingDenoiser | None:
        """Hopper's denoising kernel of one step, in bfloat16; None, with the reason logged, where it can't run."""
        horizon, rows = shape.loop.horizon, self._most_rows(shape)
        if table is None or not self._guides_by_kernel(horizon):
            return None
        from turbopi.kernels.sm90.denoise.kernel import DenoiseKernel
        from turbopi.kernels.sm90.denoise.packing import PackedExpert

        key = (shape.loop, rows)
        if key not in self._keepers:
            try:
                self._keepers[key] = DenoiseKernel(
                    *(self.config, self._packed(PackedExpert), self._weights.small, table),
                    cache_rows=rows,
                    suffix=horizon,
                    device=self.device,
                    num_steps=1,
                    by_token=True,
                    keep=True,
                )
            except BackendUnavailable as e:
                logger.info("operations go forward where the true Jacobian goes back: %s", e)
                self._keepers[key] = None
                self._drop_unused_expert()
        return self._keepers[key]

    def _guides_by_kernel(self, horizon: int) -> bool:
        """Whether one call guided by the true Jacobian goes forward in Hopper's denoising kernel."""
        if not self._on_hopper or (self._plan is not None and self._plan.expert != "bf16"):
            return False
        from turbopi.kernels.portable.vjp.tiles import takes
        from turbopi.kernels.sm90.denoise.kernel import MAX_SUFFIX, unavailable
        from turbopi.kernels.sm90.denoise.packing import refusal

        if unavailable(self.device) or refusal(self.config) or horizon > MAX_SUFFIX:
            return False
        return takes(self.config.expert, horizon)

    @property
    def jacobian_costs(self) -> Mapping[int, float]:
        by_kernel = self._guides_by_kernel(self.config.action_horizon)
        return self.JACOBIAN_COSTS_BESIDE_KERNEL if by_kernel else self.JACOBIAN_COSTS

    @property
    def batch_costs(self) -> Mapping[int, float]:
        return self.COSTS_WITH_PAIRS if self._denoises_pairs(self.config.action_horizon) else self.COSTS

    def _denoises_pairs(self, horizon: int) -> bool:
        """Whether Hopper's kernel denoises two observations of such a horizon at once."""
        if not self._on_hopper:
            return False
        from turbopi.kernels.sm90.denoise.kernel import FEW, MAX_SUFFIX
        from turbopi.kernels.sm90.denoise.packing import refusal

        return FEW < 2 * horizon <= MAX_SUFFIX and refusal(self.config) is None

    def _batch_denoises_by(self, loop: Loop, batch: int, rows: int) -> Weights | PairDenoiser:
        """Hopper's kernel for two plain observations; else operations in its precision, which are as fast.

        The way back of the true Jacobian goes through the bfloat16 expert, as in a single call.
        """
        if loop.form == "jacobian":
            self._batches_guide_in_bf16 = True
            self._keep_expert_on(self.device)
            return self._weights
        if loop.form != "plain":
            return self._batch_weights()
        if batch != 2 or not self._denoises_pairs(loop.horizon):
            return self._batch_weights()
        key = (loop, rows)
        if key not in self._pair_denoisers:
            try:
                self._pair_denoisers[key] = self._pair_kernel(loop, rows)
            except BackendUnavailable as e:  # more keys than fit, or fewer multiprocessors than it needs
                logger.info("operations denoise two observations: %s", e)
                return self._batch_weights()
        return self._pair_denoisers[key]

    def _pair_kernel(self, loop: Loop, rows: int) -> PairDenoiser:
        """Raises BackendUnavailable where it can't run."""
        from turbopi.kernels.sm90.denoise.kernel import DenoiseKernel
        from turbopi.kernels.sm90.denoise.packing import PackedExpert

        table = self._table(loop)
        assert table is not None, "the kernel takes Pi0.5 alone"
        kernel = DenoiseKernel(
            *(self.config, self._packed(PackedExpert), self._weights.small, table),
            cache_rows=rows,
            suffix=2 * loop.horizon,
            device=self.device,
            pair=True,
        )
        self._put_expert_away()
        return kernel

    def _batch_weights(self) -> Weights:
        """Operations denoise batches: where the denoising kernel runs in FP8, they do, else in bfloat16."""
        if self._plan is None or self._plan.expert != "fp8":
            self._batches_denoise_in_bf16 = True
            self._keep_expert_on(self.device)
            return self._weights
        if self._fp8_expert is None:
            self._keep_expert_on(self.device)
            self._fp8_expert = []
            for i, layer in enumerate(self._weights.expert):
                made: dict[str, Any] = {
                    kind: self._quantized(f"expert.{i}.{kind}", getattr(layer, kind)) for kind in KINDS["expert"]
                }
                self._fp8_expert.append(replace(layer, **made))
            self._put_expert_away()
        return replace(self._weights, expert=self._fp8_expert)

    def _quantized(self, place: str, matrix: Tensor) -> Matrix:
        if self._plan is None or place not in self._plan.scales:
            return matrix
        return quantize(matrix, self._plan.scales[place], self._directions.get(place), self._plan.format)

    def _forget(self, loop: Loop) -> None:
        super()._forget(loop)
        kept: dict[tuple[Loop, int], Any]
        for kept in (self._denoisers, self._pair_denoisers, self._keepers, self._refused):
            for key in [key for key in kept if key[0] == loop]:
                del kept[key]
        if self._denoisers:  # if no graph of operations is left, none points to the matrices on the device
            self._put_expert_away()

    def _denoising_kernel(self, loop: Loop, rows: int, table: Tensor | None) -> Denoiser:
        """Raises BackendUnavailable for what it doesn't cover."""
        kernel = self._hopper_kernel(loop, rows, table) if self._on_hopper else self._portable_kernel(loop, rows, table)
        self._put_expert_away()
        return kernel

    def _hopper_kernel(self, loop: Loop, rows: int, table: Tensor | None) -> Denoiser:
        from turbopi.kernels.sm90.denoise.kernel import MAX_SUFFIX, DenoiseKernel, unavailable
        from turbopi.kernels.sm90.denoise.packing import PackedExpert, refusal

        table = self._covered(unavailable(self.device) or refusal(self.config), loop, MAX_SUFFIX, table)
        by_token = loop.form != "plain"
        return DenoiseKernel(
            *(self.config, self._packed(PackedExpert), self._weights.small, table),
            cache_rows=rows,
            suffix=loop.horizon,
            device=self.device,
            num_steps=loop.steps if by_token else None,
            by_token=by_token,
        )

    def _portable_kernel(self, loop: Loop, rows: int, table: Tensor | None) -> Denoiser:
        from turbopi.kernels.portable.denoise.kernel import MAX_SUFFIX, PortableDenoiser, unavailable
        from turbopi.kernels.portable.denoise.packing import PackedExpert, refusal

        weights = "bf16" if self._plan is None else self._plan.expert
        table = self._covered(unavailable(self.device, weights) or refusal(self.config), loop, MAX_SUFFIX, table)
        if loop.form != "plain":
            raise BackendUnavailable("the portable denoising kernel has one time for all actions")
        return PortableDenoiser(
            *(self.config, self._packed(PackedExpert), self._weights.small, table),
            cache_rows=rows,
            suffix=loop.horizon,
            device=self.device,
        )

    def _covered(self, reason: str | None, loop: Loop, most: int, table: Tensor | None) -> Tensor:
        """The table, of a loop that a denoising kernel takes. `reason`: why it doesn't, whatever the loop."""
        if reason is None and loop.horizon > most:
            reason = f"the denoising kernel takes up to {most} actions"
        if reason is None and loop.form == "jacobian":
            reason = "the denoising kernel has no way back, which the true Jacobian takes"
        if reason is not None or table is None:
            raise BackendUnavailable(reason or "there is no modulation")
        return table

    def _packed(self, kind: Any) -> Any:
        """The expert's matrices as a denoising kernel has them."""
        if self._packed_expert is None:
            int8 = self._plan is not None and self._plan.expert == "int8"  # which the portable kernel alone has
            self._packed_expert = kind.pack(
                self.config,
                self._weights.expert,
                inputs=self._expert_inputs(),
                directions=self._directions,
                device=self.device,
                **({"format": INT8} if int8 else {}),
            )
        return self._packed_expert

    def _explain(self, error: RuntimeError) -> None:
        for kernel in (*self._denoisers.values(), *self._pair_denoisers.values(), *self._keepers.values()):
            if isinstance(kernel, Watched) and (why := kernel.why_it_trapped()) is not None:
                raise DeviceLost(
                    f"{why}; {ADVICE}, and free the GPU of other work; if that doesn't help, use backend 'cuda_graph'"
                ) from error

    def _put_expert_away(self) -> None:
        """A kernel has its own copy of the expert's matrices; the first one, 0.6 GB, waits on the host."""
        if not (self._refused or self._batches_denoise_in_bf16 or self._batches_guide_in_bf16):
            self._keep_expert_on(HOST)

    def _keep_expert_on(self, device: torch.device) -> None:
        layers = self._weights.expert
        for i, layer in enumerate(layers):
            if layer.qkv.device != device:
                tensors = {name: value for name, value in vars(layer).items() if value is not None}
                layers[i] = replace(layer, **{name: tensor.to(device) for name, tensor in tensors.items()})
