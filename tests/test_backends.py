"""The registry, and the backends that run on a CPU. Those that need a GPU are in test_gpu.py."""

import dataclasses
import subprocess
import sys
from typing import Any

import pytest
import torch
from conftest import golden_cases, golden_folder

from turbopi import backends
from turbopi.backends.base import StageTimer
from turbopi.models.pi0.reference import FloatPrecision
from turbopi.support.errors import BackendUnavailable, ConfigError
from turbopi.verify.check_golden import check_case

CPU = torch.device("cpu")


def create(name: str, precision: FloatPrecision = "f32") -> backends.Backend:
    checkpoint = golden_folder().checkpoint("pi05")
    model = checkpoint.config.planned_model
    return backends.create(
        name, model, lambda to, mode: checkpoint.load(to, mode).state, device=CPU, precision=precision
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # the compiler's own
@pytest.mark.skipif(
    backends.availability("pytorch_compile", CPU) is not None, reason="torch.compile needs a C++ compiler"
)
def test_the_compiled_reference_equals_openpi_and_compiles_nothing_for_another_prompt() -> None:
    backend, case = create("pytorch_compile"), golden_cases()["b_third_masked"]
    comparisons = check_case(case, backend)
    assert {"v_t", "x_t", "actions"} <= {c.tensor for c in comparisons}
    assert not [c for c in comparisons if not c.ok]
    shorter = dataclasses.replace(case.observation, token_mask=torch.arange(200)[None] < 9)
    with torch.compiler.set_stance("fail_on_recompile"):
        compiled = backend.sample(shorter, case.noise, 10).actions
    torch.testing.assert_close(compiled, create("pytorch").sample(shorter, case.noise, 10).actions, rtol=0, atol=1e-5)


def test_prefix_and_denoise_apart_equal_the_whole() -> None:
    backend, case = create("pytorch"), golden_cases()["a_three_cams"]
    apart = backend.denoise(backend.prefix(case.observation), case.noise, 5)
    assert torch.equal(apart, backend.sample(case.observation, case.noise, 5).actions)


def test_auto_says_what_it_chose_and_why() -> None:
    assert backends.choose(CPU) == (
        "pytorch",
        "auto: on a CPU the eager reference starts at once and compiling gains little",
    )


@pytest.mark.slow
def test_a_backend_is_imported_when_it_is_asked_for() -> None:
    code = "import sys, turbopi.backends as b; print([m for m in sys.modules if m.startswith('turbopi.backends.')])"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    for spec in backends.BACKENDS.values():
        assert spec.module not in loaded


@pytest.mark.slow
def test_pytorchs_compiler_is_imported_by_the_first_call_that_needs_it() -> None:
    code = "import sys, turbopi.backends.captured as c; c.compile_stage(abs); print('torch._dynamo' in sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert loaded == "False\n"


@pytest.mark.parametrize("name", ["cuda_graph", "fused"])
def test_a_gpu_backend_says_what_it_needs_on_a_cpu(name: str) -> None:
    precision = backends.precisions(name)[0]
    with pytest.raises(BackendUnavailable, match=rf"backend '{name}' can't run on cpu: .*NVIDIA GPU"):
        backends.check(name, CPU, precision)


@pytest.mark.parametrize(
    ("device", "message"),
    [
        ("tpu", "unknown device 'tpu'|'tpu' isn't supported"),
        ("mps", "'mps' isn't supported"),
        ("warp:1", "unknown device 'warp:1'"),
    ],
)
def test_unknown_devices_are_refused(device: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        backends.resolve_device(device)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_missing_gpu_is_no_silent_cpu() -> None:
    with pytest.raises(ConfigError, match="PyTorch sees no NVIDIA GPU"):
        backends.resolve_device("cuda")
    assert backends.resolve_device("auto") == CPU


def test_stages_are_timed_in_order() -> None:
    timer = StageTimer(CPU)
    timer.mark("first")
    sum(range(100_000))
    timer.mark("second")
    times: dict[str, Any] = timer.milliseconds()
    assert list(times) == ["first", "second"]
    assert times["second"] > times["first"] >= 0
