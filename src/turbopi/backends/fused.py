"""Backend `fused`: the call of `cuda_graph` with kernels of our own where they beat PyTorch's.

Nothing is compiled by Inductor. On compute capability 9.0 the whole denoising loop, attention of vision and prefix, the
prefix's feed-forward and many of vision's products are CUDA C++ kernels for it. On other GPUs and with
TURBOPI_KERNELS=portable they are the kernels of kernels/portable. A model, horizon or loop that the denoising kernels
don't cover takes the engine's operations one by one. `describe()` says what runs.
"""

import importlib.util
import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any, ClassVar, Protocol, runtime_checkable

import torch
from torch import Tensor

from turbopi.backends.base import LoadState, Precision
from turbopi.backends.cuda_graph import CudaGraphBackend
from turbopi.backends.device_lost import ADVICE
from turbopi.backends.expert_store import ExpertStore, Layers, User, layer_on
from turbopi.backends.qualification import DENOISE, excluded
from turbopi.backends.tuned_tiles import BY_MODEL, Tiles, tiles_of
from turbopi.engine.call import CallShape
from turbopi.engine.loops import Loop
from turbopi.engine.plan import MAX_CAMERAS, bucket
from turbopi.engine.weight_placement import HOST, WeightPlacement, is_conditioning, rows_of_parts
from turbopi.engine.weights import Weights, pack
from turbopi.kernels.interface import Denoiser, GemmaLayer, KeepingDenoiser, Ops, PairDenoiser
from turbopi.kernels.portable.quantize import by_plan
from turbopi.kernels.tile_table import NO_TILES
from turbopi.quantization.formats import INT8, RoundedMatrix
from turbopi.quantization.fp8 import Directions, Matrix, ScaledMatrix
from turbopi.quantization.plan import HALF_SUMS, TIERS, PrecisionPlan
from turbopi.quantization.sites import KINDS
from turbopi.support.errors import BackendUnavailable, DeviceLost
from turbopi.support.toolchain import missing_for_c

logger = logging.getLogger(__name__)

INT8_ON_HOPPER = "Hopper's denoising kernel has no INT8, and is faster in bf16 than the portable one in INT8"


@runtime_checkable
class Watched(Protocol):
    """A denoising kernel that tells how it fares: the one for Hopper."""

    def clock_mhz(self) -> float | None: ...

    def why_it_trapped(self) -> str | None: ...


class FusedBackend(CudaGraphBackend):
    """As `cuda_graph`, in bfloat16, or partly in FP8, INT8 or NVFP4 as a calibration says: see `describe()`."""

    name: ClassVar[str] = "fused"
    # measured on an H200 with two cameras in bfloat16: benchmarks/results/h200_2026-11-27_attention, of 2 without the
    # kernel for pairs docs/dev/log.md; in FP8 two take 1.6, four 2.7, eight 4.6, sixteen 8.7
    COSTS: ClassVar[Mapping[int, float]] = {1: 1, 2: 2.2, 4: 2.9, 8: 5.15, 16: 10.1}
    COSTS_WITH_PAIRS: ClassVar[Mapping[int, float]] = {**COSTS, 2: 1.65}
    # where one guided call alone goes forward in the denoising kernel; of two estimated
    JACOBIAN_COSTS_BESIDE_KERNEL: ClassVar[Mapping[int, float]] = {1: 1, 2: 2.2, 4: 3.3, 8: 5.2}
    _tiles = Tiles(NO_TILES, BY_MODEL)  # measured ones, as they were when this backend was made
    _without: Mapping[str, str] = MappingProxyType({})  # what failed its self-test on this GPU, and how
    _kept_expert: Mapping[str, ScaledMatrix] = MappingProxyType({})  # in eight bits, of a folder that has them so
    _on_hopper = True  # whether kernels for compute capability 9.0 run
    _plan: PrecisionPlan | None = None
    precisions: ClassVar[tuple[Precision, ...]] = ("bf16", *TIERS)
    instead: ClassVar[str] = "backend 'pytorch' with precision 'bf16'"

    def load_weights(self, load: LoadState) -> None:
        given = self._quantization
        self._plan = None if given is None else given.plan(self.config, self.precision)
        self._kernels: dict[User, Any] = {}  # denoising kernels, or why one is refused: operations denoise then
        self._without = excluded(self.device, self.precision, self.config)
        super().load_weights(load)

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
        from turbopi.kernels.ops import KERNELS_VARIABLE, forced_portable
        from turbopi.kernels.portable.gemm.tiles import fp8_refusal, half_sums_refusal, int8_refusal, nvfp4_refusal

        capability = torch.cuda.get_device_capability(device)
        if precision == HALF_SUMS and capability == (9, 0) and not forced_portable():
            return (
                "Hopper's kernels sum in float32, at the same rate; those that "
                f"{KERNELS_VARIABLE}=portable takes have float16 sums"
            )
        refusals = {"int8": int8_refusal, "nvfp4": nvfp4_refusal, HALF_SUMS: half_sums_refusal}
        return refusals.get(precision, fp8_refusal)(capability)

    def describe(self) -> dict[str, Any]:
        described = super().describe() | {"tiles": self._tiles.about}
        if self._without:
            described["excluded"] = dict(self._without)
        if self._plan is not None and self._quantization is not None:
            numbers = self._plan.format.name
            described[numbers] = self._quantization.describe(self._plan)
            expert, plan = self._expert_precision(), described[numbers]["plan"]
            for name, what in plan.items():
                if name.startswith("expert.") and what == numbers and not expert.startswith(numbers):
                    plan[name] = expert  # its kernel takes one precision
            plan["expert"] = expert
            batches = [user.loop.form for user in list(self._expert.users["layers"]) if user.what == "batch"]
            if self._expert.users["fp8"]:
                plan["expert of batches"] = numbers
            elif self._plan.expert != "bf16" and {*batches} - {"jacobian"}:
                plan["expert of batches"] = "bf16, as operations denoise"
            if self._plan.expert != "bf16" and "jacobian" in batches:
                plan["expert of batches guided by the Jacobian"] = "bf16, as its way back is"

        kernel = "one CUDA kernel" if self._hopper_denoises else "one portable CUDA kernel"
        denoising = {kernel: sorted({str(loop) for loop in self._made("single")})}
        for user, why in self._refused().items():
            kept = user.loop in self._made("keeper")
            how = "one CUDA kernel a step forward, operations back" if kept else f"operations, as {why}"
            calls = denoising.setdefault(how, [])
            if str(user.loop) not in calls:
                calls.append(str(user.loop))
        denoising["one CUDA kernel for two observations"] = sorted({str(loop) for loop in self._made("pair")})
        described["denoising"] = {how: calls for how, calls in denoising.items() if calls}
        clocks = {
            str(loop): round(clock)
            for loop, made in self._made("single").items()
            if isinstance(made, Watched) and (clock := made.clock_mhz()) is not None
        }
        if clocks:
            described["denoising_clock_mhz"] = clocks
        return described

    def _pack(self, load: LoadState) -> Weights:
        def on_host(name: str) -> bool:
            """The expert comes to the GPU a matrix at a time, in its kernel's order."""
            return name.startswith("expert.layers.") or is_conditioning(self.config, name)

        make = None if self._plan is None else self._quantized
        placement = WeightPlacement(self.config, self.device, on_host, make, precision=self.precision)
        state = load(placement, "bf16")
        made = placement.made
        for place in [place for place in placement.kept if not place.startswith("expert.")]:
            made[place] = self._quantized(place, placement.kept.pop(place).to(self.device))
        self._kept_expert = placement.kept
        weights = pack(self.config, state, made=made, device=self.device, expert_device=HOST)
        self._expert = ExpertStore(weights.expert, self.device, {"packed": self._packed, "fp8": self._in_fp8})
        return weights

    def _kernel(self, user: User, make: Callable[[], Any]) -> Any:
        """What `make` makes, once; None, with the reason noted, where it raises BackendUnavailable."""
        if user not in self._kernels:
            try:
                if (failed := self._without.get(DENOISE)) is not None:
                    raise BackendUnavailable(f"it failed its self-test on this GPU: {failed}")
                self._kernels[user] = make()
            except BackendUnavailable as e:
                logger.info("operations in place of a denoising kernel of %s (%s): %s", user.loop, user.what, e)
                self._expert.release(lambda one: one == user)
                self._kernels[user] = str(e)
        made = self._kernels[user]
        return None if isinstance(made, str) else made

    def _made(self, what: str) -> dict[Loop, Any]:
        """The denoising kernels of a kind, by their loop."""
        kernels = list(self._kernels.items())  # a call of another thread may add some
        return {user.loop: one for user, one in kernels if user.what == what and not isinstance(one, str)}

    def _refused(self) -> dict[User, str]:
        """What operations denoise of single calls, and why."""
        kernels = list(self._kernels.items())
        return {user: why for user, why in kernels if user.what == "single" and isinstance(why, str)}

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
        if not self._refused():
            return numbers
        if not self._made("single"):
            return "bf16, as operations denoise"
        return f"{numbers} in the denoising kernel; bf16 where operations denoise"

    def _make_ops(self) -> Ops:
        from turbopi.kernels.ops import fused_ops, hopper_kernels  # Triton isn't imported for other backends

        self._tiles = tiles_of(self.device)
        self._on_hopper = hopper_kernels(self.device, self._without)
        if self._on_hopper and self._plan is not None and self._plan.expert == "int8" and not self._kept_expert:
            self._plan = self._plan.without_expert(INT8_ON_HOPPER)
        return fused_ops(self.device, self._tiles.table, self._without, self.precision)

    @property
    def _hopper_denoises(self) -> bool:
        """Whether denoising is by Hopper's kernel, which has no INT8: a folder may keep the expert's weights so."""
        return self._on_hopper and (self._plan is None or self._plan.expert != "int8")

    @property
    def _times_by_token(self) -> bool:
        return self._hopper_denoises

    def _make_denoiser(self, shape: CallShape, table: Tensor | None) -> Denoiser | None:
        """The kernel of all steps; None, with the reason noted, where it doesn't cover the model, loop or GPU."""
        user = User("single", shape.loop, self._most_rows(shape))
        kernel: Denoiser | None = self._kernel(user, partial(self._denoising_kernel, user, table))
        if kernel is None:
            self._expert.use("layers", user)  # while its graph is kept, as it points to them
        return kernel

    def _most_rows(self, shape: CallShape) -> int:
        """Of the cache's prefix, of all calls that one denoising kernel serves."""
        cameras = min(max(shape.cameras, 3), MAX_CAMERAS)
        return cameras * self.config.vision.num_tokens + bucket(self.config.max_prompt_tokens)

    def _make_keeper(self, shape: CallShape, table: Tensor | None) -> KeepingDenoiser | None:
        """Hopper's denoising kernel of one step, in bfloat16; None, with the reason logged, where it can't run."""
        user = User("keeper", shape.loop, self._most_rows(shape))
        if table is None or not self._guides_by_kernel(user.loop.horizon):
            return None
        kernel: KeepingDenoiser | None = self._kernel(
            user, partial(self._hopper_kernel, user, table, num_steps=1, by_token=True, keep=True)
        )
        return kernel

    def _guides_by_kernel(self, horizon: int) -> bool:
        """Whether one call guided by the true Jacobian goes forward in Hopper's denoising kernel."""
        if not self._hopper_denoises or (self._plan is not None and self._plan.expert != "bf16"):
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
        if not self._hopper_denoises:
            return False
        from turbopi.kernels.sm90.denoise.kernel import FEW, MAX_SUFFIX
        from turbopi.kernels.sm90.denoise.packing import refusal

        return FEW < 2 * horizon <= MAX_SUFFIX and refusal(self.config) is None

    def _batch_denoises_by(self, loop: Loop, batch: int, rows: int) -> Weights | PairDenoiser:
        """Hopper's kernel for two plain observations; else operations in its precision, which are as fast.

        The way back of the true Jacobian goes through the bfloat16 expert, as in a single call.
        """
        if loop.form == "plain" and batch == 2 and self._denoises_pairs(loop.horizon):
            table, user = self._table(loop), User("pair", loop, rows)
            assert table is not None, "the kernel takes Pi0.5 alone"
            pair: PairDenoiser | None = self._kernel(user, partial(self._hopper_kernel, user, table, pair=True))
            if pair is not None:
                return pair
        return self._batch_weights(loop, batch, rows)

    def _batch_weights(self, loop: Loop, batch: int, rows: int) -> Weights:
        in_fp8 = self._plan is not None and self._plan.expert == "fp8" and loop.form != "jacobian"
        layers = self._expert.use("fp8" if in_fp8 else "layers", User("batch", loop, rows))
        return replace(self._weights, expert=layers)

    def _in_fp8(self, layers: Layers) -> list[GemmaLayer[Any]]:
        """The expert's layers on the device, as operations multiply in FP8."""

        def quantized(number: int, layer: GemmaLayer[Any]) -> GemmaLayer[Any]:
            made: Any = {
                kind: self._quantized(f"expert.{number}.{kind}", getattr(layer, kind)) for kind in KINDS["expert"]
            }
            return replace(layer, **made)

        known = self._rounded_before(layers)
        return [quantized(number, layer_on(layer, self.device)) for number, layer in enumerate(known)]

    def _rounded_before(self, layers: Layers) -> Layers:
        """The expert's layers with the matrices that a folder keeps in eight bits, if it does."""
        if not self._kept_expert:
            return layers
        return [
            replace(layer, **{kind: self._kept_expert[f"expert.{number}.{kind}"] for kind in KINDS["expert"]})  # type: ignore[arg-type]
            for number, layer in enumerate(layers)
        ]

    def _quantized(self, place: str, matrix: Matrix) -> Tensor | RoundedMatrix:
        return by_plan(self._plan, place, matrix, rows_of_parts(self.config, place))

    def _forget(self, loop: Loop) -> None:
        super()._forget(loop)
        if any(loop in other.evaluations for other in self._graphs.loops):  # a solver's graph goes on reading them
            return
        for user in [user for user in self._kernels if user.loop == loop]:
            del self._kernels[user]
        self._expert.release(lambda user: user.loop == loop)

    def _denoising_kernel(self, user: User, table: Tensor | None) -> Denoiser:
        """Raises BackendUnavailable for what it doesn't cover."""
        if self._hopper_denoises:
            from turbopi.kernels.sm90.denoise.kernel import MAX_SUFFIX, unavailable
            from turbopi.kernels.sm90.denoise.packing import refusal

            table = self._covered(unavailable(self.device) or refusal(self.config), user.loop, MAX_SUFFIX, table)
            by_token = {} if user.loop.form == "plain" else {"num_steps": user.loop.steps, "by_token": True}
            denoiser: Denoiser = self._hopper_kernel(user, table, **by_token)
            return denoiser
        return self._portable_kernel(user, table)

    def _hopper_kernel(self, user: User, table: Tensor, **options: Any) -> Any:
        from turbopi.kernels.sm90.denoise.kernel import DenoiseKernel

        return DenoiseKernel(
            *(self.config, self._expert.use("packed", user), self._weights.small, table),
            cache_rows=user.rows,
            suffix=user.loop.horizon * (2 if user.what == "pair" else 1),
            device=self.device,
            **options,
        )

    def _portable_kernel(self, user: User, table: Tensor | None) -> Denoiser:
        from turbopi.kernels.portable.denoise.kernel import MAX_SUFFIX, PortableDenoiser, unavailable
        from turbopi.kernels.portable.denoise.packing import refusal

        weights = "bf16" if self._plan is None else self._plan.expert
        table = self._covered(unavailable(self.device, weights) or refusal(self.config), user.loop, MAX_SUFFIX, table)
        if user.loop.form != "plain":
            raise BackendUnavailable("the portable denoising kernel has one time for all actions")
        return PortableDenoiser(
            *(self.config, self._expert.use("packed", user), self._weights.small, table),
            cache_rows=user.rows,
            suffix=user.loop.horizon,
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

    def _packed(self, layers: Layers) -> Any:
        """The expert's matrices as the denoising kernels have them."""
        from turbopi.kernels.portable.denoise.packing import PackedExpert as Portable
        from turbopi.kernels.sm90.denoise.packing import PackedExpert as Hopper

        kind: Any = Hopper if self._hopper_denoises else Portable
        int8 = self._plan is not None and self._plan.expert == "int8"  # which the portable kernel alone has
        return kind.pack(
            self.config,
            self._rounded_before(layers),
            inputs=self._expert_inputs(),
            directions=self._directions,
            device=self.device,
            **({"format": INT8} if int8 else {}),
        )

    def _explain(self, error: RuntimeError) -> None:
        for kernel in self._kernels.values():
            if isinstance(kernel, Watched) and (why := kernel.why_it_trapped()) is not None:
                other = "" if self._plan is None else " with precision 'bf16'"
                raise DeviceLost(
                    f"{why}; {ADVICE}, and free the GPU of other work; if that doesn't help, use backend 'cuda_graph'"
                    f"{other}"
                ) from error
