"""What is kept for numbers of steps and horizons is bounded, and what is let go is let go whole."""

import weakref
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from conftest import golden_cases, golden_model
from tensorrt_fakes import golden_backend
from test_begin import Unrun, on_cpu
from test_engine import made_up
from test_engine_batch import observations
from test_fused_choice import GPU, MATRICES, Placed
from torch import Tensor

from turbopi.backends.expert_store import ExpertStore, User
from turbopi.backends.fused import FusedBackend
from turbopi.backends.tensorrt.backend import TensorRTBackend
from turbopi.backends.tensorrt.pipelined import TensorRTPipelinedBackend
from turbopi.engine.batch import SharedRows
from turbopi.engine.call import CallShape
from turbopi.engine.graph_cache import MOST_LOOPS, MOST_STEPS, Loop, RecentLoops, fit
from turbopi.engine.runner import HostRow
from turbopi.engine.solving import evaluation_loops
from turbopi.engine.without_compiler import OPS
from turbopi.kernels.interface import GemmaLayer
from turbopi.models.pi0.solvers import Integration
from turbopi.support.errors import BackendUnavailable, ObservationError

STEPS = range(1, 41)


def test_the_least_recently_used_loop_goes() -> None:
    gone: list[Loop] = []
    recent = RecentLoops(gone.append)
    for steps in range(1, MOST_LOOPS + 1):
        recent.use(Loop(steps, 10))
    recent.use(Loop(1, 10))
    assert gone == []
    recent.use(Loop(MOST_LOOPS + 1, 10))
    recent.use(Loop(2, 50))
    assert gone == [Loop(2, 10), Loop(3, 10)]
    assert list(recent)[-2:] == [Loop(MOST_LOOPS + 1, 10), Loop(2, 50)] and Loop(1, 10) in list(recent)
    assert recent.describe()["forgotten"] == 2 and recent.describe()["denoising_loops"][-1] == "H=50, 2 steps"


def test_many_steps_leave_room_for_few_loops() -> None:
    """1.27 MB a step: all together stay at some 1.3 GB."""
    gone: list[Loop] = []
    recent = RecentLoops(gone.append)
    for steps in (10, 5, 1000, 20, 500):
        recent.use(Loop(steps, 10))
    assert gone == [Loop(10, 10), Loop(5, 10), Loop(1000, 10)]
    assert fit(recent) and sum(loop.steps for loop in recent) <= MOST_STEPS
    recent.use(Loop(1000, 10))
    assert Loop(1000, 10) in list(recent)


@pytest.mark.slow
def test_forty_numbers_of_steps_leave_few_graphs_and_every_answer_is_right() -> None:
    backend = on_cpu(cls=Unrun)
    observation, noise = made_up("pi05", 2, 5)
    first = {steps: backend.sample(observation, noise, steps).actions for steps in STEPS}
    details = backend.describe()["graphs"]
    assert details["kept"] == MOST_LOOPS + 1 == len(backend._graphs)  # and vision's, which is every loop's
    assert details["forgotten"] == len(STEPS) - MOST_LOOPS and details["most_loops"] == MOST_LOOPS
    assert details["denoising_loops"] == [f"H=7, {steps} steps" for steps in STEPS[-MOST_LOOPS:]]
    assert len(backend._calls) == len(backend._tables) == MOST_LOOPS
    for steps in (1, 20, 40, 39):
        assert torch.equal(backend.sample(observation, noise, steps).actions, first[steps])


def test_horizons_are_bounded_too_and_steps_they_share_stay() -> None:
    backend = on_cpu(cls=Unrun)
    observation, _ = made_up("pi05", 2, 5)
    for horizon in range(1, 21):
        backend.sample(observation, torch.zeros(1, horizon, 32), 2)
    assert len(backend._calls) == MOST_LOOPS and list(backend._tables) == [Loop(2, 7).table]


def test_a_loop_without_a_compiler_is_let_go_as_well() -> None:
    backend = on_cpu(cls=Unrun)
    backend._ops = OPS
    backend._cache = type(backend._cache).allocate(
        backend.config, backend._cache.k.shape[1], backend.device, torch.float32, True
    )
    observation, noise = made_up("pi05", 1, 5)
    for steps in STEPS[:12]:
        backend.sample(observation, noise, steps)
    assert len(backend._loops) == MOST_LOOPS


def test_what_is_begun_is_finished_though_its_loop_makes_others_go() -> None:
    backend = on_cpu(cls=Unrun)
    observation, noise = made_up("pi05", 2, 5)
    row = HostRow.of(observation, 0)
    rest = (row.tokens, row.state, noise[0].numpy())
    expected = {steps: on_cpu(cls=Unrun).sample(observation, noise, steps).actions for steps in (9, 1)}
    for steps in STEPS[:MOST_LOOPS]:
        backend.sample(observation, noise, steps)
    begun = backend.begin(row.images)
    assert torch.equal(begun.finish(*rest, MOST_LOOPS + 1).actions, expected[9])
    begun = backend.begin(row.images)
    assert torch.equal(begun.finish(*rest, 1).actions, expected[1])


def test_what_is_forgotten_is_freed() -> None:
    backend = on_cpu(cls=Unrun)
    observation, noise = made_up("pi05", 2, 5)
    backend.sample(observation, noise, 1)
    (call,) = backend._calls.values()
    buffer = weakref.ref(call)
    del call
    for steps in STEPS[1 : MOST_LOOPS + 1]:
        backend.sample(observation, noise, steps)
    assert buffer() is None


def test_a_loop_of_its_own_outlives_a_solvers_loop_with_the_same_evaluation() -> None:
    backend = on_cpu(cls=Unrun)
    gone: list[Loop] = []
    backend._forget = gone.append  # type: ignore[method-assign, assignment]
    integration = Integration("ab2", (1.0, 0.5, 0.0))
    solver = Loop(2, 7, "solver", integration.evaluated, integration)
    mine, others = sorted(evaluation_loops(solver), key=str)[0], evaluation_loops(solver)
    backend._recent.use(solver)
    backend._recent.use(mine)
    for steps in STEPS[: MOST_LOOPS - 1]:
        backend._recent.use(Loop(steps, 10))
    assert set(gone) == {solver} | others - {mine}


class OutOfMemory(Unrun):
    """Whose captures fail while there is no memory."""

    full = True

    def _capture(self, run: Any, after: Any, like: Any = None) -> Any:
        if self.full:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return super()._capture(run, after, like)


def test_what_failed_to_be_captured_is_not_called_warm() -> None:
    backend: Any = on_cpu(cls=OutOfMemory)
    observation, noise = observations("pi05", [1, 1], [3, 3], 7)
    alone = made_up("pi05", 1, 5)
    for _ in range(2):
        with pytest.raises(torch.OutOfMemoryError):
            backend.warmup(alone[0], 2, 7)
        with pytest.raises(torch.OutOfMemoryError):
            backend.warmup_batches(observation, 2, 7, [2])
    assert backend.describe()["captured"] == [] == backend.describe()["batches"]
    backend.full, backend.strict = False, True
    with pytest.raises(ObservationError, match="Warm is: nothing yet"):
        backend.sample(*alone, 2)
    backend.warmup(alone[0], 2, 7)
    assert backend.sample(observation, noise, 2).actions.shape == noise.shape, "one by one"
    assert not backend.describe()["batches"]


def test_batches_of_all_sizes_have_their_rows_in_the_same_buffers() -> None:
    """And each observation gets what it gets alone, whichever sizes ran before."""
    backend = on_cpu(cls=Unrun)
    expected: dict[int, Tensor] = {}
    batches = {count: observations("pi05", [1] * count, [3] * count, 7) for count in (4, 2)}
    for _ in range(2):
        for count, (observation, noise) in batches.items():
            found = backend.sample(observation, noise, 1).actions
            assert torch.equal(expected.setdefault(count, found), found)
    kept = backend._batches._buffers.values()
    for parts in ([one.cache.k for one in kept], [one.embs for one in kept], [one.pictures.embs for one in kept]):
        assert len({part.data_ptr() for part in parts}) == 1
    whole = golden_model("pi05").sample(*batches[4], 1)
    torch.testing.assert_close(expected[4], whole, atol=2e-5, rtol=2e-5)


def test_shared_rows_grow_to_at_least_twice_as_many() -> None:
    shared = SharedRows(golden_model("pi05").config, torch.float32, torch.device("cpu"))
    small, large = shared.embs(10), shared.embs(11)
    assert shared.embs(20).data_ptr() == large.data_ptr() != small.data_ptr()
    first = shared.cache(10)
    assert first.k.shape[1] == 10 and shared.cache(12).k.shape[1] == 12
    assert shared.cache(20).k.data_ptr() == shared.cache(1).k.data_ptr() != first.k.data_ptr()


class Fused(FusedBackend):
    """Without a GPU: its kernels are fakes, and refuse horizons from 50 on."""

    def __init__(self) -> None:
        self.config, self.device = golden_model("pi05").config, torch.device("cpu")
        self._graphs, self._calls, self._tables, self._loops, self._kernels = {}, {}, {}, {}, {}
        layer: Any = GemmaLayer(**{name: Placed(self.device) for name in MATRICES}, norm1=None, norm2=None)
        self._expert = ExpertStore([layer], GPU, {"packed": lambda layers: "packed"})
        self._recent = RecentLoops(self._forget)
        self._batches = SimpleNamespace(forget=lambda loop: None)  # type: ignore[assignment]

    @property
    def expert_on(self) -> str:
        return {"cuda": "device", "cpu": "host"}[self._expert._layers[0].qkv.device.type]

    def _denoising_kernel(self, user: User, table: Tensor | None) -> Any:
        self._expert.use("packed", user)
        if user.loop.horizon >= 50:
            raise BackendUnavailable("too many")
        return SimpleNamespace()

    def call(self, steps: int, horizon: int) -> Any:
        self._recent.use(Loop(steps, horizon))
        return self._make_denoiser(CallShape(2, 16, Loop(steps, horizon)), None)


def test_fuseds_kernels_go_with_their_loops_and_the_expert_goes_away_with_the_last_graph_that_reads_it() -> None:
    backend = Fused()
    assert backend.expert_on == "host"
    assert backend.call(10, 50) is None and backend.expert_on == "device"
    for steps in range(1, MOST_LOOPS):
        assert backend.call(steps, 10) is not None
    assert backend.expert_on == "device" and len(backend._refused()) == 1  # a graph of operations points to it
    backend.call(MOST_LOOPS, 10)
    assert not backend._refused() and backend.expert_on == "host"
    assert backend.call(10, 50) is None and backend.expert_on == "device"
    for steps in STEPS:
        backend.call(steps, 10)
    assert len(backend._kernels) == MOST_LOOPS and backend.expert_on == "host"


@pytest.mark.slow
@pytest.mark.parametrize("cls", [TensorRTBackend, TensorRTPipelinedBackend])
def test_graphs_around_engines_are_bounded(cls: type[TensorRTBackend], tmp_path: Path) -> None:
    case, backend = golden_cases()["b_third_masked"], golden_backend(cls, "pi05", tmp_path)
    expected = backend.sample(case.observation, case.noise, 1).actions
    for steps in range(2, 13):
        backend.sample(case.observation, case.noise, steps)
    parts = 1 if cls is TensorRTBackend else 2
    details = backend.describe()["graphs"]
    assert details["denoising_loops"] == [f"H={case.noise.shape[1]}, {steps} steps" for steps in range(5, 13)]
    assert len({key.num_steps for key in backend._calls}) == len(backend._tables) == MOST_LOOPS
    assert details["kept"] == parts * len(backend._calls)
    assert torch.equal(backend.sample(case.observation, case.noise, 1).actions, expected)
