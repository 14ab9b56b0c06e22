"""How `fused` chooses between its denoising kernel and operations, and where it keeps the expert: fakes, on a CPU."""

from typing import Any

import pytest
import torch
from conditioned import BY_TOKEN, conditioned
from conftest import golden_cases, golden_model
from test_begin import CPU, Ran
from torch import Tensor

from turbopi.backends.fused import FusedBackend
from turbopi.config import Kind, ModelConfig
from turbopi.engine.call import CallShape
from turbopi.engine.loops import ConditionedLoop, EulerLoop, SolverLoop
from turbopi.engine.weights import Weights
from turbopi.kernels.interface import GemmaLayer, KeptStep, Ops, TokenInputs
from turbopi.kernels.plain import PLAIN
from turbopi.kernels.sm90.denoise import kernel as denoise
from turbopi.kernels.sm90.denoise import packing as denoise_packing
from turbopi.kernels.sm90.denoise.packing import PackedExpert
from turbopi.kernels.sm90.denoise.plain import denoise_plain
from turbopi.models.pi0.solvers import Integration
from turbopi.support.errors import BackendUnavailable, DeviceLost

GPU = torch.device("cuda", 0)
MATRICES = ("qkv", "out", "gate_up", "down")


class ReferenceKernel:
    """Stands for `DenoiseKernel`: the same arguments and results, computed from the packed matrices in PyTorch."""

    made: list["ReferenceKernel"]
    refuse: str | None

    def __init__(
        self,
        config: ModelConfig,
        packed: PackedExpert,
        small: dict[str, Tensor],
        table: Tensor,
        *,
        cache_rows: int,
        suffix: int,
        device: torch.device,
        num_steps: int | None = None,
        by_token: bool = False,
        keep: bool = False,
    ) -> None:
        assert by_token == (num_steps is not None) and (not keep or num_steps == 1)
        if self.refuse is not None:
            raise BackendUnavailable(self.refuse)
        self.config, self.packed, self.small, self.table = config, packed, small, table
        self.cache_rows, self.suffix, self.device, self.by_token = cache_rows, suffix, device, by_token
        self.launches, self.keep = 0, keep
        self.trapped: str | None = None
        self.made.append(self)

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
        assert (tokens is not None) == self.by_token and not self.keep
        x_t[:], v_t[:] = self._loop(noise, cache_k, cache_v, length, tokens)

    def launch_step(
        self, step: int, x_t: Tensor, cache_k: Tensor, cache_v: Tensor, length: Tensor, v_t: Tensor, tokens: TokenInputs
    ) -> KeptStep:
        assert self.keep
        g = self.config.expert
        kept = KeptStep(
            torch.full((2 * g.depth + 1, self.suffix, g.width), torch.nan),
            torch.full((g.depth, self.suffix * g.num_heads, g.head_dim), torch.nan),
            torch.full((g.depth, self.suffix, 2 * g.mlp_dim), torch.nan),
        )
        rows, steps, times = (one[step : step + 1] for one in (tokens.rows, tokens.steps, tokens.times))
        unguided = TokenInputs(rows, steps, times, tokens.target, torch.zeros_like(times))
        v_t[:] = self._loop(x_t, cache_k, cache_v, length, unguided, kept)[1][0]
        return kept

    def _loop(
        self,
        noise: Tensor,
        cache_k: Tensor,
        cache_v: Tensor,
        length: Tensor,
        tokens: TokenInputs | None,
        kept: KeptStep | None = None,
    ) -> tuple[Tensor, Tensor]:
        assert noise.shape[0] == self.suffix and int(length) <= self.cache_rows
        self.launches += 1
        layers: Any = [
            GemmaLayer(**dict(zip(MATRICES, self.packed.matrices(i), strict=True)), norm1=None, norm2=None)
            for i in range(self.config.expert.depth)
        ]
        rest = (self.small, self.table, noise, cache_k, cache_v, int(length))
        return denoise_plain(self.config, layers, *rest, tokens=tokens, kept=kept)

    def clock_mhz(self) -> float | None:
        return 1800.4 if self.launches else None

    def why_it_trapped(self) -> str | None:
        return self.trapped


class OnCpu(FusedBackend):
    """`fused` with plain operations, and without graphs."""

    def _make_ops(self) -> Ops:
        return PLAIN

    def _capture(self, run: Any, after: Any, like: Any = None) -> Any:
        return Ran(run, after, lambda name: None)


@pytest.fixture
def kernels(monkeypatch: pytest.MonkeyPatch) -> type[ReferenceKernel]:
    """The class of kernels that the backend makes; `made` and `refuse` are this test's own."""
    cls = type("Kernel", (ReferenceKernel,), {"made": [], "refuse": None})
    monkeypatch.setattr(denoise, "DenoiseKernel", cls)
    monkeypatch.setattr(denoise, "unavailable", lambda device: None)
    return cls


def fused(kind: Kind = "pi05") -> OnCpu:
    model = golden_model(kind)
    load = lambda device, precision: dict(model.state_dict())  # noqa: E731
    return OnCpu(model.config, load, device=CPU, precision="bf16")


def actions(backend: FusedBackend, steps: int = 3, horizon: int = 10) -> Tensor:
    case = golden_cases()["b_third_masked" if backend.config.kind == "pi05" else "p0_pi0_state"]
    return backend.sample(case.observation, case.noise[:, :horizon], steps).actions


@pytest.mark.parametrize("refused", [False, True])
def test_the_kernel_and_the_operations_give_the_references_actions(
    kernels: type[ReferenceKernel], refused: bool
) -> None:
    kernels.refuse = "the GPU is too small" if refused else None
    backend, case = fused(), golden_cases()["b_third_masked"]
    expected = golden_model("pi05").sample(case.observation, case.noise, 3)
    torch.testing.assert_close(actions(backend), expected, rtol=0, atol=1e-4)  # its weights are bfloat16 numbers
    chosen = "operations, as the GPU is too small" if refused else "one CUDA kernel"
    assert backend.describe()["denoising"] == {chosen: ["H=10, 3 steps"]}
    assert [kernel.launches > 0 for kernel in kernels.made] == ([] if refused else [True])


@pytest.mark.slow
@pytest.mark.parametrize("which", BY_TOKEN)
def test_conditioned_loops_have_a_kernel_of_their_own(kernels: type[ReferenceKernel], which: str) -> None:
    backend, case = fused(), golden_cases()["b_third_masked"]
    requested = conditioned(which, 3, *case.noise.shape[1:])
    expected = golden_model("pi05").sample(case.observation, case.noise, 3, conditioning=requested)
    found = backend.sample(case.observation, case.noise, 3, conditioning=requested).actions
    torch.testing.assert_close(found, expected, rtol=0, atol=3e-4)
    ((reported, (call,)),) = backend.describe()["denoising"].items()
    assert reported == "one CUDA kernel" and call.startswith("H=10, 3 steps, by token, ")


@pytest.mark.slow
@pytest.mark.parametrize("how", ["kernel", "refused", "operations"])
def test_the_true_jacobian_goes_forward_in_a_kernel_and_back_by_operations_that_find_the_expert_there(
    kernels: type[ReferenceKernel], how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if how == "operations":  # sizes that the way back's kernels for few tokens don't take
        monkeypatch.setattr("turbopi.kernels.portable.vjp.tiles.takes", lambda expert, tokens: False)
    backend, case = fused(), golden_cases()["b_third_masked"]
    plain = actions(backend)
    requested = conditioned("jacobian", 3, *case.noise.shape[1:])
    expected = golden_model("pi05").sample(case.observation, case.noise, 3, conditioning=requested)
    kernels.refuse = "too small" if how == "refused" else None
    for _ in range(2):
        found = backend.sample(case.observation, case.noise, 3, conditioning=requested).actions
        torch.testing.assert_close(found, expected, rtol=0, atol=3e-4)
    kernels.refuse = None
    launches = [kernel.launches for kernel in kernels.made]  # one at its capture, a step a launch
    assert launches == ([2, 3 * 3] if how == "kernel" else [2])
    reported = backend.describe()["denoising"]
    assert reported["one CUDA kernel"] == ["H=10, 3 steps"]
    reason = "operations, as the denoising kernel has no way back, which the true Jacobian takes"
    if how == "kernel":
        reason = "one CUDA kernel a step forward, operations back"
    assert reported[reason] == ["H=10, 3 steps, guided by the Jacobian, 4 times"]
    assert torch.equal(actions(backend), plain)


def test_a_kernel_that_keeps_is_refused_once_for_each_loop_and_leaves_no_packed_expert(
    kernels: type[ReferenceKernel], monkeypatch: pytest.MonkeyPatch
) -> None:
    backend, tried = fused(), list[ReferenceKernel | None]()

    def make(*given: Any, **options: Any) -> ReferenceKernel:
        tried.append(None)
        return kernels(*given, **options)

    monkeypatch.setattr(denoise, "DenoiseKernel", make)
    kernels.refuse = "too small"
    shapes = [CallShape(3, slots, ConditionedLoop(2, 10, (1.0, 0.5, 0.0), True)) for slots in (16, 32)]
    assert [backend._make_keeper(shape, backend._table(shape.loop)) for shape in shapes] == [None, None]
    assert len(tried) == 1 and not backend._expert.users["packed"] and not backend._expert._built


def test_a_kernel_is_made_once_for_each_loop_with_the_loops_sizes(kernels: type[ReferenceKernel]) -> None:
    backend = fused()
    for steps, horizon in ((3, 10), (3, 6), (2, 10), (3, 10)):
        actions(backend, steps, horizon)
    assert [(kernel.table.shape[0], kernel.suffix) for kernel in kernels.made] == [(3, 10), (3, 6), (2, 10)]
    assert len({id(kernel.packed) for kernel in kernels.made}) == 1, "one packed expert serves them all"
    config = backend.config  # a kernel serves every prompt, with up to three cameras
    needed = 3 * config.vision.num_tokens + config.max_prompt_tokens
    assert all(needed <= kernel.cache_rows < needed + 16 for kernel in kernels.made)
    assert backend.describe()["denoising_clock_mhz"] == dict.fromkeys(
        ("H=10, 3 steps", "H=6, 3 steps", "H=10, 2 steps"), 1800
    )


def test_four_cameras_have_a_kernel_with_room_for_them(kernels: type[ReferenceKernel]) -> None:
    backend = fused()
    table = backend._table(EulerLoop(2, 10))
    for cameras in (1, 2, 3, 4):
        assert backend._make_denoiser(CallShape(cameras, 16, EulerLoop(2, 10)), table) is not None
    tokens, most = backend.config.vision.num_tokens, -(-backend.config.max_prompt_tokens // 16) * 16
    assert [kernel.cache_rows for kernel in kernels.made] == [3 * tokens + most, 4 * tokens + most]


def test_a_model_horizon_or_gpu_that_the_kernel_does_not_cover_takes_operations_and_says_why(
    kernels: type[ReferenceKernel], monkeypatch: pytest.MonkeyPatch
) -> None:
    pi0 = fused("pi0")
    actions(pi0)
    assert list(pi0.describe()["denoising"]) == ["operations, as it covers Pi0.5, this model is pi0"]
    backend = fused()
    table = backend._table(EulerLoop(2, 10))
    assert backend._make_denoiser(CallShape(3, 16, EulerLoop(2, denoise.MAX_SUFFIX)), table) is not None
    assert backend._make_denoiser(CallShape(3, 16, EulerLoop(2, denoise.MAX_SUFFIX + 1)), table) is None
    monkeypatch.setattr(denoise, "unavailable", lambda device: "this GPU has 12.0")
    assert backend._make_denoiser(CallShape(3, 16, EulerLoop(2, 9)), table) is None
    reported = backend.describe()["denoising"]
    assert reported["one CUDA kernel"] == ["H=56, 2 steps"]
    assert reported["operations, as the denoising kernel takes up to 56 actions"] == ["H=57, 2 steps"]
    assert reported["operations, as this GPU has 12.0"] == ["H=9, 2 steps"]


def test_an_error_of_the_kernel_that_is_no_refusal_is_no_reason_for_operations(
    kernels: type[ReferenceKernel], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*args: Any, **options: Any) -> None:
        raise RuntimeError("CUDA error: unspecified launch failure")

    monkeypatch.setattr(denoise, "DenoiseKernel", broken)
    with pytest.raises(RuntimeError, match="unspecified launch failure"):
        actions(fused())


def test_a_trapped_kernel_is_asked_why_and_the_advice_is_given(
    kernels: type[ReferenceKernel], monkeypatch: pytest.MonkeyPatch
) -> None:
    backend = fused()
    actions(backend)
    (kernel,) = kernels.made
    kernel.trapped = "blocks waited for seconds"

    def fail(*args: Any) -> None:
        raise RuntimeError("CUDA error: unspecified launch failure")

    monkeypatch.setattr(kernel, "launch", fail)
    with pytest.raises(DeviceLost, match=r"blocks waited for seconds; .*use backend 'cuda_graph'"):
        actions(backend)


# ---- where the expert's matrices are: a GPU that isn't there, by matrices that only know their place


class Placed:
    """A matrix that knows where it is."""

    def __init__(self, device: torch.device) -> None:
        self.device = device

    def to(self, device: torch.device) -> "Placed":
        return Placed(device)


class OnFakeGpu:
    """A backend whose device is a GPU, and its loops; `places` are those of all matrices of the expert."""

    def __init__(self, kernels: type[ReferenceKernel], monkeypatch: pytest.MonkeyPatch) -> None:
        self.backend, self.kernels = fused(), kernels
        self.table = self.backend._table(EulerLoop(2, 10))
        self.backend.device = self.backend._expert._device = GPU
        layer: Any = GemmaLayer(**{name: Placed(CPU) for name in MATRICES}, norm1=None, norm2=None)
        self.backend._weights.expert[:] = [layer] * 3
        self.packed_from: list[set[torch.device]] = []

        def pack(config: ModelConfig, layers: Any, **options: Any) -> str:
            self.packed_from.append(self.places)
            return "packed"

        monkeypatch.setattr(denoise_packing.PackedExpert, "pack", pack)
        stream = type("Stream", (), {"synchronize": lambda self: None})
        monkeypatch.setattr(torch.cuda, "current_stream", lambda device: stream())

    @property
    def places(self) -> set[torch.device]:
        return {getattr(layer, name).device for layer in self.backend._weights.expert for name in MATRICES}

    def denoise(self, steps: int, refuse: str | None = None) -> bool:
        """Whether a loop of so many steps has a kernel."""
        self.kernels.refuse = refuse
        shape = CallShape(3, 16, EulerLoop(steps, 10))
        self.backend._graphs.loops.use(EulerLoop(steps, 10))
        return self.backend._make_denoiser(shape, self.table) is not None


@pytest.fixture
def gpu(kernels: type[ReferenceKernel], monkeypatch: pytest.MonkeyPatch) -> OnFakeGpu:
    return OnFakeGpu(kernels, monkeypatch)


def test_the_expert_waits_on_the_host_while_only_kernels_denoise(gpu: OnFakeGpu) -> None:
    assert gpu.denoise(2) and gpu.places == {CPU}
    assert gpu.denoise(3) and gpu.places == {CPU}
    assert gpu.packed_from == [{CPU}], "packed once, from the host"


def test_operations_find_the_expert_on_the_device_whatever_was_there_before(gpu: OnFakeGpu) -> None:
    assert not gpu.denoise(2, refuse="too small") and gpu.places == {GPU}
    assert gpu.denoise(3) and gpu.places == {GPU}, "a graph of operations points to it"
    assert not gpu.denoise(4, refuse="too small") and gpu.places == {GPU}


def test_the_expert_comes_back_from_the_host_for_operations(gpu: OnFakeGpu) -> None:
    assert gpu.denoise(2) and gpu.places == {CPU}
    assert not gpu.denoise(3, refuse="too small") and gpu.places == {GPU}
    assert gpu.denoise(2) and gpu.places == {GPU}


def test_the_expert_leaves_the_device_when_the_last_loop_of_operations_is_forgotten(gpu: OnFakeGpu) -> None:
    assert gpu.denoise(2) and not gpu.denoise(3, refuse="too small") and not gpu.denoise(4, refuse="too small")
    gpu.backend._forget(EulerLoop(3, 10))
    assert gpu.places == {GPU}, "the loop of 4 steps still takes operations"
    gpu.backend._forget(EulerLoop(4, 10))
    assert gpu.places == {CPU}


def test_the_expert_stays_on_the_device_while_a_solvers_loop_reads_it_by_operations(gpu: OnFakeGpu) -> None:
    solver = SolverLoop(2, 10, Integration("ab2", (1.0, 0.5, 0.0)))
    evaluation = ConditionedLoop(1, 10, solver.integration.evaluated)  # which may be a loop of its own
    assert evaluation in solver.evaluations
    gpu.backend._graphs.loops.use(solver)
    gpu.kernels.refuse = "too small"
    assert gpu.backend._make_denoiser(CallShape(3, 16, evaluation), gpu.table) is None
    gpu.backend._graphs.loops.evict(evaluation)
    assert gpu.places == {GPU}
    gpu.backend._graphs.loops._loops.clear()
    gpu.backend._graphs.loops.evict(solver)
    assert gpu.places == {CPU}


def test_a_refused_first_kernel_leaves_no_packed_expert_behind(gpu: OnFakeGpu) -> None:
    assert not gpu.denoise(2, refuse="too small")
    assert not gpu.backend._expert._built
    assert gpu.denoise(3) and gpu.packed_from == [{CPU}, {GPU}]


def test_the_packed_expert_goes_with_the_last_kernel_and_is_packed_anew_for_the_next(gpu: OnFakeGpu) -> None:
    assert gpu.denoise(2) and gpu.denoise(3)
    gpu.backend._forget(EulerLoop(2, 10))
    assert gpu.backend._expert._built == {"packed": "packed"}, "the loop of 3 steps still has its kernel"
    gpu.backend._forget(EulerLoop(3, 10))
    assert not gpu.backend._expert._built
    assert gpu.denoise(2) and gpu.packed_from == [{CPU}, {CPU}]


def test_the_expert_leaves_the_device_with_the_last_batch_that_operations_denoise(gpu: OnFakeGpu) -> None:
    loops = [EulerLoop(2, 10), ConditionedLoop(2, 10, (1.0, 0.5, 0.0), True)]
    for loop in loops:
        weights = gpu.backend._batch_denoises_by(loop, 4, 64)
        assert isinstance(weights, Weights) and weights.expert is gpu.backend._weights.expert and gpu.places == {GPU}
    for loop, places in zip(loops, ({GPU}, {CPU}), strict=True):
        gpu.backend._forget(loop)
        assert gpu.places == places
