"""The plan of graphs and their cache: complete, bounded, an entry only when its capture has succeeded, freed whole."""

import weakref
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
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
from turbopi.engine.graph_cache import MOST_LOOPS, MOST_STEPS, Captured, GraphCache, LoopCache, fit
from turbopi.engine.loops import ConditionedLoop, EulerLoop, Loop, SolverLoop
from turbopi.engine.plan import BUCKET, GraphKey, batch_slots, bucket, warm_graphs
from turbopi.engine.runner import HostRow
from turbopi.engine.without_compiler import OPS
from turbopi.kernels.interface import GemmaLayer
from turbopi.models.pi0.solvers import Integration
from turbopi.support.errors import BackendUnavailable, ObservationError

STEPS = range(1, 41)


@pytest.mark.parametrize("batch", [1, 4])
def test_warm_up_captures_every_graph_that_calls_of_any_prompt_need(batch: int) -> None:
    loop, most, sizes = EulerLoop(10, 50), 200, (batch, 2 * batch, False)
    warm = list(warm_graphs(*sizes, loop, most, resizes=True))
    needed = {GraphKey("vision", *sizes), GraphKey("resized", *sizes)}
    for tokens in range(1, most + 1):
        slots = batch_slots(batch, [tokens] * batch)
        assert slots % BUCKET == 0 and batch * tokens <= slots < batch * (tokens + BUCKET)
        if batch == 1:
            assert slots == bucket(tokens)
            needed.add(GraphKey("answer", *sizes, slots, loop))
        else:
            needed |= {GraphKey("prefix", *sizes, slots), GraphKey("denoise", *sizes, loop=loop)}
    assert needed == set(warm) and len(needed) == len(warm), "and no other, and none twice"
    assert "resized" not in {key.part for key in warm_graphs(*sizes, loop, most, resizes=False)}


def test_a_row_of_a_loops_table_has_a_time_and_loops_of_two_kinds_are_never_one() -> None:
    integration = Integration("heun", (1.0, 0.5, 0.0))
    solver = SolverLoop(3, 7, integration)
    loops: list[Loop] = [EulerLoop(3, 7), EulerLoop(1, 7, 0.5), solver, *solver.evaluations]
    loops += [ConditionedLoop(3, 7, (1.0, 0.5, 0.0)), ConditionedLoop(3, 7, (1.0, 0.5, 0.0), True)]
    for loop in loops:
        times = loop.table_times("accumulated")
        assert len(times) == loop.rows and times.dtype == np.float32
    assert solver.table_times("accumulated").tolist() == list(integration.evaluated) == [1.0, 0.5, 0.5]
    assert [loop.table for loop in solver.evaluations] == [(1.0, 0.5, 0.5), (1.0,), (0.5,), (0.5,)]
    assert {loop.form for loop in loops} == {"plain", "solver", "tokens", "jacobian"}
    assert len({*loops, *(str(loop) for loop in loops)}) == 2 * len({*loops})


def test_the_least_recently_used_loop_goes() -> None:
    lost: list[Loop] = []
    recent = LoopCache(lost.append)
    for steps in range(1, MOST_LOOPS + 1):
        recent.use(EulerLoop(steps, 10))
    recent.use(EulerLoop(1, 10))
    assert lost == []
    recent.use(EulerLoop(MOST_LOOPS + 1, 10))
    recent.use(EulerLoop(2, 50))
    assert lost == [EulerLoop(2, 10), EulerLoop(3, 10)]
    assert list(recent)[-2:] == [EulerLoop(MOST_LOOPS + 1, 10), EulerLoop(2, 50)] and EulerLoop(1, 10) in list(recent)
    assert recent.describe()["forgotten"] == 2 and recent.describe()["denoising_loops"][-1] == "H=50, 2 steps"


def test_many_steps_leave_room_for_few_loops() -> None:
    """1.27 MB a step: all together stay at some 1.3 GB."""
    lost: list[Loop] = []
    recent = LoopCache(lost.append)
    for steps in (10, 5, 1000, 20, 500):
        recent.use(EulerLoop(steps, 10))
    assert lost == [EulerLoop(10, 10), EulerLoop(5, 10), EulerLoop(1000, 10)]
    assert fit(recent) and sum(loop.steps for loop in recent) <= MOST_STEPS
    recent.use(EulerLoop(1000, 10))
    assert EulerLoop(1000, 10) in list(recent)


@pytest.mark.slow
def test_forty_numbers_of_steps_leave_few_graphs_and_every_answer_is_right() -> None:
    backend = on_cpu(cls=Unrun)
    observation, noise = made_up("pi05", 2, 5)
    first = {steps: backend.sample(observation, noise, steps).actions for steps in STEPS}
    details = backend.describe()["graphs"]
    assert details["kept"] == MOST_LOOPS + 1 == len(backend._graphs.entries)  # and vision's, which is every loop's
    assert details["forgotten"] == len(STEPS) - MOST_LOOPS and details["most_loops"] == MOST_LOOPS
    assert details["denoising_loops"] == [f"H=7, {steps} steps" for steps in STEPS[-MOST_LOOPS:]]
    assert len(backend._tables) == MOST_LOOPS
    for steps in (1, 20, 40, 39):
        assert torch.equal(backend.sample(observation, noise, steps).actions, first[steps])


def test_horizons_are_bounded_too_and_steps_they_share_stay() -> None:
    backend = on_cpu(cls=Unrun)
    observation, _ = made_up("pi05", 2, 5)
    for horizon in range(1, 21):
        backend.sample(observation, torch.zeros(1, horizon, 32), 2)
    assert len(backend._graphs.entries) == MOST_LOOPS + 1 and list(backend._tables) == [EulerLoop(2, 7).table]


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
    (buffer,) = (weakref.ref(one.buffers) for key, one in backend._graphs.entries.items() if key.part == "answer")
    for steps in STEPS[1 : MOST_LOOPS + 1]:
        backend.sample(observation, noise, steps)
    assert buffer() is None


def test_a_loop_of_its_own_outlives_a_solvers_loop_with_the_same_evaluation() -> None:
    lost: list[Loop] = []
    loops, solver = LoopCache(lost.append), SolverLoop(2, 7, Integration("ab2", (1.0, 0.5, 0.0)))
    mine, *others = solver.evaluations
    loops.use(solver)
    loops.use(mine)
    for steps in STEPS[: MOST_LOOPS - 1]:
        loops.use(EulerLoop(steps, 10))
    assert lost == [solver, *others]


def test_a_failed_capture_leaves_nothing_of_its_loop_and_the_next_one_succeeds() -> None:
    lost: list[Loop] = []
    graphs, key = GraphCache(lost.append), GraphKey("answer", 1, 2, False, 16, EulerLoop(2, 7))

    def fail(key: GraphKey) -> Captured:
        raise torch.OutOfMemoryError("CUDA out of memory")

    for _ in range(2):
        with pytest.raises(torch.OutOfMemoryError):
            graphs.capture(key, fail)
        assert graphs.entries == {} and graphs.get(key) is None and list(graphs.loops) == []
    assert lost == [key.loop] * 2, "tables and kernels that were made for it are let go"
    graphs.capture(key, lambda key: Captured(cast(Any, None), "buffers"))
    with pytest.raises(torch.OutOfMemoryError):
        graphs.capture(key._replace(slots=32), fail)
    assert list(graphs.entries) == [key] and list(graphs.loops) == [key.loop] and len(lost) == 2, "another has it"


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
    assert backend.describe()["graphs"]["denoising_loops"] == [] and not backend._tables
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
    kept = backend._buffers.values()
    for parts in ([one.cache.k for one in kept], [one.embs for one in kept], [one.images.embs for one in kept]):
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
        self._graphs, self._tables, self._loops, self._kernels = GraphCache(self._forget), {}, {}, {}
        layer: Any = GemmaLayer(**{name: Placed(self.device) for name in MATRICES}, norm1=None, norm2=None)
        self._expert = ExpertStore([layer], GPU, {"packed": lambda layers: "packed"})

    @property
    def expert_on(self) -> str:
        return {"cuda": "device", "cpu": "host"}[self._expert._layers[0].qkv.device.type]

    def _denoising_kernel(self, user: User, table: Tensor | None) -> Any:
        self._expert.use("packed", user)
        if user.loop.horizon >= 50:
            raise BackendUnavailable("too many")
        return SimpleNamespace()

    def call(self, steps: int, horizon: int) -> Any:
        self._graphs.loops.use(EulerLoop(steps, horizon))
        return self._make_denoiser(CallShape(2, 16, EulerLoop(steps, horizon)), None)


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
