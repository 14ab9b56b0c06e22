"""A CUDA error that sticks to the process ends the policy's work, once and for all; any other error doesn't."""

import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import pytest
import torch
from policy_helpers import policy_on

from turbopi import UnifiedPolicy
from turbopi.backends import Sample
from turbopi.backends import device_lost as lost
from turbopi.backends.device_lost import STICKY, why_lost
from turbopi.backends.fused import FusedBackend
from turbopi.backends.pytorch import PyTorchBackend
from turbopi.checkpoint import random_checkpoint
from turbopi.support.errors import BackendError, BackendUnavailable, DeviceLost, ObservationError

pytestmark = pytest.mark.usefixtures("two_layers")

CPU, GPU = torch.device("cpu"), torch.device("cuda", 0)
ILLEGAL = "CUDA error: an illegal memory access was encountered\nCUDA kernel errors might be asynchronously reported"


def accelerator_error(message: str, number: int) -> RuntimeError:
    error = torch.AcceleratorError(message)
    error.error_code = number  # type: ignore[attr-defined]
    return error


class Failing:
    """The policy's backend, with `fail` raised by every call while it is set. `calls` counts what reached it."""

    def __init__(self, backend: Any) -> None:
        self._backend = backend
        self.fail: Exception | None = None
        self.calls = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def sample(self, *arguments: Any, conditioning: None = None) -> Sample:
        self.calls += 1
        if self.fail is not None:
            raise self.fail
        sample: Sample = self._backend.sample(*arguments)
        return sample

    def warmup(self, *arguments: Any, **options: Any) -> None:
        self.sample(*arguments[:1], torch.zeros(1, 10, 32), 1)


class FailingLater(Failing):
    """Failures come with the answers."""

    submits = True

    def submit(self, *arguments: Any) -> "Future[Sample]":
        future: Future[Sample] = Future()
        try:
            future.set_result(self.sample(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future


@pytest.fixture
def policy() -> UnifiedPolicy:
    return failing(Failing)


def failing(cls: type[Failing]) -> UnifiedPolicy:
    make = lambda *arguments, **options: cls(PyTorchBackend(*arguments, **options))  # noqa: E731
    return policy_on(make, random_checkpoint("pi05_tiny"), precision="bf16", num_denoising_steps=1)


def test_a_sticky_error_loses_the_device_and_later_calls_dont_touch_it(policy: UnifiedPolicy) -> None:
    backend, obs = policy.backend, policy.example_observation()
    assert isinstance(backend, Failing)
    policy.infer(obs, seed=0)
    assert policy.lost is None
    backend.fail = RuntimeError(ILLEGAL)
    with pytest.raises(DeviceLost, match=r"illegal memory access .*\(cudaErrorIllegalAddress, 700\).* start it again"):
        policy.infer(obs, seed=0)
    reason, backend.fail, calls = policy.lost, None, backend.calls
    assert reason is not None and "cudaErrorIllegalAddress" in reason and "\n" not in reason
    for call in (
        lambda: policy.infer(obs, seed=0),
        lambda: policy.infer_batch([obs, obs]),
        lambda: policy.submit(obs, serially=True),
        lambda: policy.infer({}),
        policy.warmup,
    ):
        with pytest.raises(DeviceLost) as raised:
            call()
        assert str(raised.value) == reason
    assert backend.calls == calls


CALLS: dict[str, Callable[[UnifiedPolicy, dict[str, Any]], Any]] = {
    "infer": lambda policy, obs: policy.infer(obs),
    "infer_batch": lambda policy, obs: policy.infer_batch([obs, obs]),
    "warmup": lambda policy, obs: policy.warmup(),
    "submit": lambda policy, obs: policy.submit(obs).result(timeout=120),
}


@pytest.mark.parametrize("call", CALLS)
def test_every_way_to_call_finds_it_out(call: str) -> None:
    policy = failing(FailingLater)
    backend: Any = policy.backend
    backend.fail = accelerator_error("CUDA error: unspecified launch failure", 719)
    obs = policy.example_observation()
    with pytest.raises(DeviceLost, match="cudaErrorLaunchFailure, 719"):
        CALLS[call](policy, obs)
    assert policy.lost is not None
    backend.fail = None
    with pytest.raises(DeviceLost):
        policy.submit(obs)
    assert backend.calls == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
        accelerator_error("CUDA error: out of memory", 2),
        BackendError("cuMemAlloc failed: CUDA_ERROR_OUT_OF_MEMORY"),
        BackendUnavailable("a kernel needs 64 blocks"),
        ObservationError("an observation without any valid camera"),
        RuntimeError("CUDA error: invalid argument"),
    ],
)
def test_an_error_that_doesnt_stick_leaves_the_policy_as_it_was(policy: UnifiedPolicy, error: Exception) -> None:
    backend, obs = policy.backend, policy.example_observation()
    assert isinstance(backend, Failing)
    expected = policy.infer(obs, seed=0)["actions"]
    backend.fail = error
    with pytest.raises(type(error)) as raised:
        policy.infer(obs, seed=0)
    assert raised.value is error and policy.lost is None
    backend.fail = None
    assert (policy.infer(obs, seed=0)["actions"] == expected).all()


@pytest.mark.parametrize("number", STICKY)
def test_sticky_errors_are_known_by_number_by_name_and_by_the_drivers_words(number: int) -> None:
    for error in (
        accelerator_error("CUDA error: whatever it says", number),
        RuntimeError(f"CUDA error: something\nSearch for `{STICKY[number]}' in the documentation"),
        *(BackendError(f"cuLaunchKernel failed: {said}") for said in lost._SAID[number]),
    ):
        reason = why_lost(error, GPU)
        assert reason is not None and f"({STICKY[number]}, {number})" in reason


def test_the_table_is_what_cuda_says() -> None:
    """Those that must be terminated and relaunched, in the runtime's own words; one of them is about graphs alone."""
    runtime = pytest.importorskip("cuda.bindings.runtime")
    known = {int(error): error.name for error in runtime.cudaError_t}
    assert {number: known.get(number, name) for number, name in STICKY.items()} == STICKY
    driver = pytest.importorskip("cuda.bindings.driver")
    names = {int(error): error.name for error in driver.CUresult}
    assert {n: lost._SAID[n][0] for n in STICKY if n in names} == {n: names[n] for n in STICKY if n in names}
    reported = {int(e) for e in runtime.cudaError_t if "process must be terminated and relaunched" in _words(e.__doc__)}
    assert reported <= set(STICKY)


def _words(text: str | None) -> str:
    return " ".join((text or "").split())


@pytest.mark.parametrize(
    ("answer", "is_lost"),
    [
        (None, False),
        (accelerator_error("CUDA error: unspecified launch failure", 719), True),
        (RuntimeError("CUDA error: unknown error"), True),
        (accelerator_error("CUDA error: operation not permitted when stream is capturing", 900), False),
    ],
)
def test_an_unknown_error_asks_the_device(
    monkeypatch: pytest.MonkeyPatch, answer: RuntimeError | None, is_lost: bool
) -> None:
    requested: list[torch.device] = []

    def synchronize(device: torch.device) -> None:
        requested.append(device)
        if answer is not None:
            raise answer

    monkeypatch.setattr(torch.cuda, "synchronize", synchronize)
    reason = why_lost(RuntimeError("CUDA error: CUBLAS_STATUS_EXECUTION_FAILED when calling `cublasGemmEx(…)`"), GPU)
    assert requested == [GPU]
    assert (reason is not None) == is_lost
    if answer is not None and is_lost and reason is not None:
        assert str(answer) in reason and "CUBLAS_STATUS_EXECUTION_FAILED" in reason
    assert why_lost(ValueError("could not broadcast"), GPU) is None
    assert why_lost(torch.OutOfMemoryError("CUDA out of memory"), GPU) is None
    assert requested == [GPU]


def test_the_denoising_kernel_says_why_it_trapped(policy: UnifiedPolicy) -> None:
    class Kernel:
        def clock_mhz(self) -> float | None:
            return None

        def why_it_trapped(self) -> str | None:
            return "blocks of the denoising kernel waited for seconds: layer 3 for queries"

    fused: Any = FusedBackend.__new__(FusedBackend)
    fused._kernels = {"refused": "too many", "made": Kernel()}
    with pytest.raises(DeviceLost) as explained:
        fused._explain(RuntimeError("CUDA error: unspecified launch failure"))
    assert isinstance(policy.backend, Failing)
    policy.backend.fail = explained.value
    with pytest.raises(DeviceLost, match=r"layer 3 for queries.* start it again"):
        policy.infer(policy.example_observation())
    assert policy.lost is not None and "layer 3 for queries" in policy.lost


@pytest.mark.slow
def test_it_holds_without_asserts() -> None:
    code = (
        "import torch\nfrom turbopi.backends.device_lost import Guard\nfrom turbopi.support.errors import DeviceLost\n"
        "guard = Guard(torch.device('cpu'))\n"
        "for _ in range(2):\n"
        "    try:\n"
        "        with guard:\n"
        "            raise RuntimeError('CUDA error: device-side assert triggered')\n"
        "    except DeviceLost as error:\n"
        "        print(error)\n"
    )
    ran = subprocess.run([sys.executable, "-O", "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.count("cudaErrorAssert, 710") == 2
