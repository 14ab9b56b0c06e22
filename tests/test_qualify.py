"""What the process does that qualifies a GPU: faults in operations, kernels, stages and times are found by their names.

The GPU's answers are stand-ins; tests/test_gpu_qualify.py plants three on a GPU.
"""

import dataclasses
import sys
import weakref
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import verify_fakes
from shared import SIX_LAYERS, TWO_LAYERS, golden_model
from test_engine import answer, made_up, shape_of, static_call
from test_fused_choice import OnCpu, kernels  # noqa: F401
from torch import Tensor

from turbopi import backends
from turbopi.backends import qualification, qualifying
from turbopi.backends.qualification import DENOISE
from turbopi.backends.qualifying import STAGES, Event
from turbopi.checkpoint.random_weights import random_checkpoint
from turbopi.config import PRESETS, Network
from turbopi.kernels.ahead import compiling_ahead
from turbopi.kernels.interface import Ops
from turbopi.kernels.ops import BESIDE
from turbopi.kernels.plain import PLAIN
from turbopi.models.smolvla.family import BASE
from turbopi.qualify import ahead, run, stages
from turbopi.qualify.ahead import Ahead
from turbopi.qualify.operations import AHEAD, BOUND, Comparison
from turbopi.qualify.stages import Faulty, Raced, Subject, race, shallow
from turbopi.support.errors import DeviceLost

CPU = torch.device("cpu")


# -- operations --------------------------------------------------------------------------------------------------------


def wrong_tile(given: Callable[..., Any]) -> Callable[..., Any]:
    """The same with eight rows that nobody computed."""

    def run(*args: Any, **named: Any) -> Any:
        result = given(*args, **named)
        (result[1] if isinstance(result, tuple) else result)[:8] = 0
        return result

    return run


def nan(given: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *args, **named: given(*args, **named) * torch.nan


def broken(given: Callable[..., Any]) -> Callable[..., Any]:
    def run(*args: Any, **named: Any) -> Any:
        raise RuntimeError("out of resource: shared memory, Required: 131072, Hardware limit: 101376")

    return run


def in_other_order(given: Callable[..., Any]) -> Callable[..., Any]:
    """Right, and not the same bits."""
    return lambda *args, **named: (given(*args, **named).float() * (1 + 2.0**-7)).to(torch.bfloat16)


def keys_in_place(given: Callable[..., Any]) -> Callable[..., Any]:
    """Queries are right, and what is written in place is not."""

    def run(qkv: Tensor, cos: Tensor, sin: Tensor, k_out: Tensor, v_out: Tensor) -> Any:
        queries = given(qkv, cos, sin, k_out, v_out)
        v_out[-1] = 0
        return queries

    return run


def call_with(ops: Ops) -> Tensor:
    observation, noise = made_up("pi05", 1, 16)
    return answer(static_call("pi05", shape_of(observation, noise, 1), "bf16", ops), observation, noise)


@pytest.mark.parametrize(
    ("name", "fault", "why"),
    [
        ("linear_geglu", wrong_tile, "its error is"),
        ("residual_layer_norm", wrong_tile, "its error is"),
        ("attention", nan, "its result isn't finite"),
        ("vision_attention", broken, "out of resource: shared memory"),
        ("rope_split", keys_in_place, "its error is"),
        ("linear_gelu", in_other_order, None),
    ],
)
def test_an_operation_that_is_wrong_is_named_and_the_call_goes_on_right(
    name: str, fault: Callable[..., Any], why: str | None
) -> None:
    begun: list[tuple[str, str, float]] = []
    comparison = Comparison(CPU, lambda *event: begun.append(event))
    ops: Any = dataclasses.replace(PLAIN, **{name: fault(getattr(PLAIN, name))})
    actions = call_with(comparison.around(ops))
    assert [(what, path) for what, path, _ in begun] == [(f"operation {name}", name)]
    if why is None:
        assert comparison.failed == {} and 0 < comparison.errors[name] <= BOUND
    else:
        assert set(comparison.failed) == {name} and comparison.failed[name].startswith(why)
        assert torch.equal(actions, call_with(PLAIN)), "PyTorch's result goes on"


@pytest.mark.parametrize("ahead", [True, False])
def test_what_is_compiled_side_by_side_is_announced_and_not_compared(ahead: bool) -> None:
    begun: list[str] = []
    comparison = Comparison(CPU, lambda what, path, quiet: begun.append(path), ahead=ahead)
    noted: list[Tensor] = []

    def linear(*given: Any) -> Tensor:
        noted.append(PLAIN.linear(*given).fill_(torch.nan))
        return noted[-1]

    with compiling_ahead():
        call_with(comparison.around(dataclasses.replace(PLAIN, linear=linear)))
    assert not comparison.errors and not comparison.failed
    assert bool(noted) == ahead and set(begun) == ({AHEAD} if ahead else set())


def test_parts_of_a_matmul_are_added_up() -> None:
    def parts(x: Tensor, weight: Any, bias: Tensor | None = None) -> Tensor:
        half = PLAIN.linear(x, weight, bias).float() / 2
        return torch.stack((half, half))

    norms: Any = {name: in_order(getattr(BESIDE, name)) for name in ("residual_rms_norm", "residual_layer_norm")}
    comparison = Comparison(CPU, lambda *event: None)
    actions = call_with(comparison.around(dataclasses.replace(PLAIN, residual_linear=parts, **norms)))
    assert comparison.failed == {} and {"residual_linear", *norms} <= comparison.errors.keys()
    assert torch.equal(actions, call_with(PLAIN))


def in_order(given: Callable[..., Any]) -> Callable[..., Any]:
    """The same by another name, which is compared."""
    return lambda *args, **named: given(*args, **named)


def test_a_gpu_that_is_lost_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(*args: Any) -> Any:
        raise RuntimeError("CUDA error: an illegal memory access was encountered")

    with pytest.raises(DeviceLost, match="illegal memory access"):
        call_with(Comparison(CPU, lambda *event: None).around(dataclasses.replace(PLAIN, linear=lost)))


def test_what_failed_is_left_to_pytorch_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("triton")
    from turbopi.kernels import ops

    monkeypatch.setattr(ops, "capability", lambda device: (9, 0))
    assert ops.hopper_kernels(CPU) and not ops.hopper_kernels(CPU, {"sm90": "it hangs"})
    found = ops.fused_ops(CPU, without={"attention": "wrong", "batch": "wrong", "sm90": "wrong", DENOISE: "wrong"})
    assert found.attention is PLAIN.attention and found.batch is None and found.linear is not PLAIN.linear
    assert ops.fused_ops(CPU, without={"residual_rms_norm", "sm90"}).residual_rms_norm is BESIDE.residual_rms_norm
    assert found.origin["attention, batch, excluded by a self-test"] == "PyTorch"


# -- a backend's call --------------------------------------------------------------------------------------------------


class WrongBatch(OnCpu):
    """Two observations together give the first one's actions twice."""

    def sample(self, observation: Any, *given: Any, **named: Any) -> Any:
        found = super().sample(observation, *given, **named)
        if observation.batch_size > 1 and "batch" not in self._without:
            found.actions[1] = found.actions[0]
        return found


def checked(
    cls: str, monkeypatch: pytest.MonkeyPatch, excluded: dict[str, str] | None = None, model: Any = TWO_LAYERS.model
) -> Any:
    """What `check_kernels` finds in a `fused` that runs on a CPU, and the events."""
    spec = backends.BackendSpec("on_cpu", __name__, cls, "a test's")
    monkeypatch.setitem(backends.BACKENDS, "on_cpu", spec)
    begun: list[tuple[str, str]] = []
    without = {} if excluded is None else excluded
    monkeypatch.setattr(qualification, "under_test", without)
    subject = Subject(model, "bf16", CPU, lambda what, path, quiet: begun.append((what, path)), without, name="on_cpu")
    checkpoint = random_checkpoint(subject.policy_config(model))
    return stages.check_kernels(subject, checkpoint, None), begun


@pytest.mark.slow
@pytest.mark.usefixtures("kernels")
def test_a_right_call_is_compared_and_its_denoising_kernel_announced(monkeypatch: pytest.MonkeyPatch) -> None:
    model = dataclasses.replace(golden_model("pi05").config, vocab_size=1024)
    comparison, begun = checked("OnCpu", monkeypatch, model=model)
    assert comparison.failed == {}
    assert begun.count(("the denoising kernel", DENOISE)) >= 3, "when it is made, and at each launch"
    assert ("a batch of two", "batch") in begun and begun[-1] == ("kernels", "")


def test_a_batch_that_is_wrong_is_a_path_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(Faulty, match="a batch's actions are off by") as fault:
        checked("WrongBatch", monkeypatch, {DENOISE: "not on a CPU"})
    assert fault.value.path == "batch"
    assert checked("WrongBatch", monkeypatch, {DENOISE: "not on a CPU", "batch": "wrong"})[0].failed == {}


# -- sizes -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", [PRESETS["pi05_base"].model, PRESETS["pi0_base"].model, BASE.model])
def test_a_shallow_model_has_every_size_but_the_depth(model: Network) -> None:
    few: Any = shallow(model)
    full: Any = dataclasses.asdict(model)
    differing = {name for name, value in dataclasses.asdict(few).items() if value != full[name]}
    assert differing <= {"vision", "vlm", "expert", "text", "expert_depth"}
    assert few.vision.depth == 4 and dataclasses.replace(few.vision, depth=model.vision.depth) == model.vision
    assert shallow(few) == few
    half: Any = shallow(dataclasses.replace(BASE.model, expert_depth=8))
    assert (half.text.depth, half.expert_depth) == (4, 2), "half as many stay half as many"


# -- stages ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def subject(monkeypatch: pytest.MonkeyPatch) -> Subject:
    monkeypatch.setattr(qualification, "under_test", None)
    monkeypatch.setattr(stages, "check_barrier", lambda device: None)
    monkeypatch.setattr(stages, "barrier_us", lambda device: 1.0)
    monkeypatch.setattr(stages, "hopper_kernels", lambda *given: False)
    monkeypatch.setattr(run, "golden", lambda subject: None)
    monkeypatch.setattr(
        run, "race", lambda *given: Raced({"pytorch": {"total": 2.0}, "other": {"total": 3.0}}, 5, True, "")
    )
    return Subject(TWO_LAYERS.model, "bf16", CPU, lambda *event: None, {}, name="pytorch", rival="other")


def events(subject: Subject) -> tuple[bool, list[Event]]:
    said: list[Event] = []
    return run.run(subject, said.append), said


@pytest.mark.slow
@pytest.mark.parametrize(("fake", "excluded"), [("WrongKeys", []), ("EarlySuffix", [DENOISE])])
def test_a_stage_that_is_wrong_excludes_its_own_path_and_no_other(
    fake: str, excluded: list[str], subject: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(backends.BACKENDS, "faulty", backends.BackendSpec("faulty", "verify_fakes", fake, "a test's"))
    assert hasattr(verify_fakes, fake)
    ended, said = events(dataclasses.replace(subject, name="faulty"))
    assert not ended and said[-1].failed.startswith("FAIL: actions' relative rms")
    assert [path for one in said for path in one.excluded] == excluded, "there is no other path in the stand-in"


@pytest.fixture
def quick(subject: Subject, monkeypatch: pytest.MonkeyPatch) -> Subject:
    """Nothing but the order of stages."""
    monkeypatch.setattr(run, "random_checkpoint", lambda config: None)
    monkeypatch.setattr(run, "check_kernels", lambda *given: Comparison(CPU, lambda *event: None))
    monkeypatch.setattr(run, "certify", lambda *given: {"actions, error over bound": 0.5})
    return subject


def test_a_barrier_that_does_not_hold_excludes_the_denoising_kernel(
    quick: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stages, "check_barrier", lambda device: "3 of 9 blocks waited for the others in vain")
    ended, said = events(quick)
    assert ended and said[0].excluded[DENOISE].endswith("3 of 9 blocks waited for the others in vain")
    assert said[1].stage is not None and said[1].stage.text == "left out" and said[-1].done


def test_operations_that_fail_are_excluded_and_all_are_compared_again(
    quick: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    def check(subject: Subject, *given: object) -> Comparison:
        comparison = Comparison(CPU, lambda *event: None)
        comparison.failed = {} if "attention" in subject.excluded else {"attention": "its error is 1"}
        return comparison

    monkeypatch.setattr(run, "check_kernels", check)
    ended, said = events(quick)
    assert ended and {path: why for one in said for path, why in one.excluded.items()} == {
        "attention": "beside PyTorch's, its error is 1"
    }


def test_the_race_is_without_what_the_shipped_policy_excludes(quick: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    def certify(subject: Subject, checkpoint: object, calibration: object) -> dict[str, float]:
        if checkpoint is not None and DENOISE not in subject.excluded:
            raise Faulty("v_t is off by 1", DENOISE)
        return {"actions, error over bound": 0.5}

    monkeypatch.setattr(run, "certify", certify)
    monkeypatch.setattr(run, "golden", lambda subject: "a checkpoint")
    ended, said = events(quick)
    assert ended and [DENOISE in one.excluded for one in said if one.excluded or one.reason] == [True, False]
    assert [one.stage.name for one in said if one.stage] == list(STAGES)


@pytest.mark.parametrize(
    ("failure", "transient", "why"),
    [
        (torch.OutOfMemoryError("CUDA out of memory. Tried\nmore"), True, "the GPU's memory isn't enough: CUDA out of"),
        (Faulty("actions are off"), False, "actions are off"),
        (RuntimeError("CUDA error: all CUDA-capable devices are busy or unavailable"), True, "CUDA error: all CUDA"),
        (RuntimeError("a kernel doesn't compile"), False, "a kernel doesn't compile"),
    ],
)
def test_what_ends_it_is_said(
    failure: Exception, transient: bool, why: str, quick: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*given: object) -> Any:
        raise failure

    monkeypatch.setattr(run, "certify", fails)
    said: list[Event] = []
    if isinstance(failure, torch.OutOfMemoryError | Faulty):
        assert not run.run(quick, said.append)
    else:
        with pytest.raises(type(failure)):
            run.run(quick, said.append)
    assert said[-1].failed.startswith(why) and said[-1].transient == transient and said[-1].taken is None


# -- the race ----------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(eq=False)
class Policy:
    name: str


class Policies:
    """In place of policies: calls of a fixed time, and as many policies as the memory holds."""

    def __init__(self) -> None:
        self.milliseconds = {"fused": 20.0, "cuda_graph": 30.0}
        self.room, self.jitter = 2, 0.0
        self._alive = 0
        self._turn = 0

    def make(self, checkpoint: object, name: str, *given: object, **named: object) -> object:
        if self._alive >= self.room:
            raise torch.OutOfMemoryError("CUDA out of memory")
        self._alive += 1
        made = Policy(name)
        weakref.finalize(made, self._closed)
        return made

    def _closed(self) -> None:
        self._alive -= 1

    def measure(self, policy: Any, job: object, calls: int) -> dict[str, Any]:
        self._turn += 1
        slower = 1 + self.jitter * (self._turn % 2)
        return {"total": SimpleNamespace(median=self.milliseconds[policy.name] * slower)}


@pytest.fixture
def policies(monkeypatch: pytest.MonkeyPatch) -> Policies:
    made = Policies()
    monkeypatch.setattr(stages, "bench_policy", made.make)
    monkeypatch.setattr(stages, "measure_calls", made.measure)
    return made


RACING = Subject(SIX_LAYERS, "bf16", CPU, lambda *event: None, {})


@pytest.mark.parametrize(("ours", "wins"), [(20.0, True), (29.9, False), (31.0, False)])
def test_what_is_faster_by_more_than_noise_wins(ours: float, wins: bool, policies: Policies) -> None:
    policies.milliseconds["fused"] = ours
    raced = race(RACING, None, lambda: None)
    assert raced.wins == wins and raced.note == ""
    assert raced.milliseconds == {"fused": {"total": ours}, "cuda_graph": {"total": 30.0}}


def test_a_clock_that_varies_is_said_and_hits_both(policies: Policies) -> None:
    policies.jitter = 1.0
    assert race(RACING, None, lambda: None).note == "times varied by more than 15 %: was the GPU used by others?"


def test_without_memory_for_both_they_run_one_after_the_other(policies: Policies) -> None:
    policies.room = 1
    raced = race(RACING, None, lambda: None)
    assert raced.wins and raced.note == "one after the other, as the memory isn't enough for both"
    policies.room = 0
    with pytest.raises(torch.OutOfMemoryError):
        race(RACING, None, lambda: None)


def test_where_nothing_else_has_the_precision_it_is_timed_alone(policies: Policies) -> None:
    raced = race(dataclasses.replace(RACING, rival=None), None, lambda: None)
    assert raced.wins and set(raced.milliseconds) == {"fused"} and raced.note == ""


# -- the process that works ahead --------------------------------------------------------------------------------------

REQUEST = qualifying.Request(device=0, precision="bf16", kind="pi05", model={}, excluded={})
SAYS = """
import json, sys
sys.stdin.readline()
print('{}', flush=True)
for _ in sys.stdin:
    print('{"turn": {"total": 30.0}}', flush=True)
"""


def ahead_of(script: str, monkeypatch: pytest.MonkeyPatch) -> Ahead:
    monkeypatch.setattr(ahead, "_command", lambda: [sys.executable, "-c", script])
    return Ahead(REQUEST)


def test_what_was_done_ahead_is_taken_over(quick: Subject, policies: Policies, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "race", race)
    monkeypatch.setitem(policies.milliseconds, "pytorch", 20.0)
    monkeypatch.setattr(stages, "random_checkpoint", lambda config: None)
    monkeypatch.setattr(ahead, "PATIENCE", 600.0)
    said: list[Event] = []
    beside = ahead_of(SAYS, monkeypatch)
    assert run.run(quick, said.append, beside)
    assert [one.milliseconds for one in said if one.milliseconds] == [
        {"pytorch": {"total": 20.0}, "other": {"total": 30.0}}
    ]
    assert beside.stop() and not beside.stop()
    with pytest.raises(torch.OutOfMemoryError, match="ended"):
        beside._turn()


@pytest.mark.parametrize("script", ["", "import time; time.sleep(600)"])
def test_what_was_not_done_ahead_is_done_now(script: str, quick: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ahead, "PATIENCE", 0.3)
    beside = ahead_of(script, monkeypatch)
    assert beside.rival() is None
    assert run.run(quick, lambda event: None, beside)


def test_its_memory_is_given_back_where_it_is_missing(quick: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    def certify(*given: object) -> dict[str, float]:
        if beside._process is not None:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return {"actions, error over bound": 0.5}

    beside = ahead_of(SAYS, monkeypatch)
    monkeypatch.setattr(run, "certify", certify)
    assert run.run(quick, lambda event: None, beside)
