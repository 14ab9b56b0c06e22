"""What "auto" stands for, and that it says why."""

import re
from dataclasses import replace
from typing import Any, get_args

import pytest
import torch
from tile_helpers import verdict

from turbopi import backends
from turbopi.backends import qualification
from turbopi.backends.fused import FusedBackend
from turbopi.backends.qualification import Verdict
from turbopi.config import PRESETS, MemoryConfig
from turbopi.models.pi0.conditioning import Form
from turbopi.models.smolvla.family import BASE
from turbopi.support.errors import BackendUnavailable, ConfigError

GPU = torch.device("cuda", 0)


def pretend(
    monkeypatch: pytest.MonkeyPatch,
    missing: dict[str, str],
    name: str = "NVIDIA H200",
    verdict: Verdict | None = None,
) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: name)
    monkeypatch.setattr(qualification, "kept", lambda device, precision, model: verdict)
    monkeypatch.setattr(backends, "availability", lambda name, device: missing.get(name))


def test_auto_takes_the_fastest_backend_of_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, {})
    assert backends.choose(GPU) == ("fused", "auto: the fastest backend for this GPU and precision")


def test_auto_names_what_it_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, {"fused": "Triton isn't installed", "cuda_graph": "too old"})
    name, why = backends.choose(GPU)
    assert name == "pytorch_compile"
    assert "not fused: Triton isn't installed; not cuda_graph: too old" in why


@pytest.mark.parametrize("gpu", ["NVIDIA GeForce RTX 4090", "NVIDIA H20", "NVIDIA H100 PCIe"])
def test_auto_takes_no_kernels_of_ours_on_a_gpu_that_is_not_qualified(
    gpu: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend(monkeypatch, {}, gpu)
    name, why = backends.choose(GPU)
    assert name == "cuda_graph"
    assert "not fused: it isn't qualified on this GPU yet, which `turbopi doctor --qualify` does; try it with" in why
    assert "it isn't qualified on this GPU yet" in backends.choose(GPU, "fp8")[1]


def test_auto_takes_what_the_verdict_says(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(
        monkeypatch, {}, "NVIDIA L40S", verdict(taken="fused", reason="right; 14 ms", excluded={"batch": "it hangs"})
    )
    name, why = backends.choose(GPU)
    assert name == "fused" and why.endswith("precision: right; 14 ms; without batch: it hangs")
    pretend(monkeypatch, {}, "NVIDIA L40S", verdict(taken="cuda_graph", reason="right; 24 ms, and cuda_graph 20 ms"))
    name, why = backends.choose(GPU)
    assert name == "cuda_graph" and "not fused: tested on this GPU: right; 24 ms, and cuda_graph 20 ms" in why


def test_auto_takes_no_backend_that_lacks_the_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, {})
    assert backends.choose(GPU, "f32")[0] == "cuda_graph"


def test_auto_falls_to_the_reference_last(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, dict.fromkeys(("fused", "cuda_graph", "pytorch_compile"), "no"))
    assert backends.choose(GPU)[0] == "pytorch"


def test_fused_refuses_a_cpu() -> None:
    assert "need an NVIDIA GPU" in str(FusedBackend.unavailable(torch.device("cpu")))


@pytest.mark.parametrize(
    ("package", "reason"), [("triton", "written in Triton, which isn't installed"), ("cuda", "through cuda.bindings")]
)
def test_fused_says_what_is_missing(monkeypatch: pytest.MonkeyPatch, package: str, reason: str) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    monkeypatch.setattr("shutil.which", lambda name: "/usr/bin/gcc")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name.startswith(package) else object())
    assert reason in str(FusedBackend.unavailable(GPU))


@pytest.mark.parametrize(
    ("capability", "missing", "says", "doesnt_say"),
    [
        ((9, 0), "cuda", "cuda.bindings, which isn't installed; `pip install cuda-python`", "9.0"),
        ((9, 0), "triton", "Triton, which isn't installed", "9.0"),
        ((8, 9), "cuda", "cuda.bindings, which isn't installed; `pip install cuda-python`", "8.9"),
        ((8, 6), None, "from compute capability 8.9 on; this GPU has 8.6", "9.0"),
    ],
)
def test_fp8_names_what_is_truly_missing(
    monkeypatch: pytest.MonkeyPatch, capability: tuple[int, int], missing: str | None, says: str, doesnt_say: str
) -> None:
    found = lambda name: None if missing and name.startswith(missing) else object()  # noqa: E731
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)
    monkeypatch.setattr("shutil.which", lambda name: "/usr/bin/gcc")
    monkeypatch.setattr("importlib.util.find_spec", found)
    with pytest.raises(BackendUnavailable) as refused:
        backends.check("fused", GPU, "fp8")
    assert says in str(refused.value) and doesnt_say not in str(refused.value)


@pytest.mark.parametrize(
    ("capability", "reason"),
    [
        *((one, None) for one in ((8, 0), (8, 6), (8, 7), (8, 9), (9, 0), (12, 0), (12, 1))),
        *(
            (
                (10, minor),
                f"multiplies INT8 by mma.sync, which nobody timed there; this GPU has 10.{minor}; take precision",
            )
            for minor in (0, 3)
        ),
        ((11, 0), "this GPU has 11.0; take precision 'bf16' or 'fp8'"),
    ],
)
def test_int8_runs_where_its_fast_instruction_is_taken(
    monkeypatch: pytest.MonkeyPatch, capability: tuple[int, int], reason: str | None
) -> None:
    on_a_gpu_of(monkeypatch, capability)
    name, why = backends.choose(GPU, "int8")
    assert name == "fused" and ("fp8 is quicker here" in why) == (capability == (9, 0))
    if reason is None:
        backends.check("fused", GPU, "int8")
    else:
        with pytest.raises(BackendUnavailable, match=re.escape(reason)):
            backends.check("fused", GPU, "int8")


def test_int8_on_a_cpu_names_the_emulation() -> None:
    with pytest.raises(BackendUnavailable, match=r"compute capability 8\.x, 9\.0 or 12\.x; .* backend 'emulated_int8'"):
        backends.check("fused", torch.device("cpu"), "int8")


SMOLVLA, FAST = BASE.model, PRESETS["pi0_fast_base"].model
REMEMBERING = replace(PRESETS["pi05_base"].model, memory=MemoryConfig(visual=True, proprioceptive=False))


@pytest.mark.parametrize("device", ["cpu", "gpu"])
@pytest.mark.parametrize("model", [PRESETS["pi05_base"].model, REMEMBERING, SMOLVLA, FAST], ids=lambda one: one.kind)
@pytest.mark.parametrize("precision", backends.PRECISIONS)
@pytest.mark.parametrize("name", backends.BACKENDS)
def test_what_an_error_advises_the_model_can_do_on_the_device(
    monkeypatch: pytest.MonkeyPatch, name: str, precision: Any, model: Any, device: str
) -> None:
    on_a_gpu_of(monkeypatch, (8, 6))  # which has INT8 and no FP8
    where = GPU if device == "gpu" else torch.device("cpu")

    def refused(name: str, precision: Any) -> str | None:
        try:
            backends.check(name, where, precision, model)
        except (BackendUnavailable, ConfigError) as error:
            return str(error)
        return None

    advice = re.findall(r"\b(?:take|use|judge) [^;]*", refused(name, precision) or "")
    own = backends.all_precisions(name)
    taken = [one for text in advice for one in re.findall(r"'(\w[\w-]*)'", text) if text != "use device 'cpu'"]
    for one in taken:
        if one in backends.PRECISIONS:
            assert refused(backends.choose(where, one, model)[0], one) is None, advice
        else:
            tier = precision if precision in own or one.startswith("emulated") else own[0]
            chosen = backends.choose(where, tier, model)[0] if one == "auto" else one
            assert refused(chosen, tier) is None, advice


@pytest.mark.parametrize("model", [PRESETS["pi05_base"].model, SMOLVLA], ids=lambda one: one.kind)
@pytest.mark.parametrize("name", backends.BACKENDS)
def test_a_backend_without_a_form_names_those_that_have_it(name: str, model: Any) -> None:
    cls = backends.class_for(name, model)
    for form in get_args(Form) if cls.refuses_model(model) is None else ():
        for advice in re.findall(r"or take (backend .*)", cls.refuses_form(form) or ""):
            for other in set(re.findall(r"'(\w+)'", advice)) & backends.BACKENDS.keys():
                assert backends.class_for(other, model).refuses_form(form) is None, (form, advice)


def test_a_family_without_a_precision_is_told_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    on_a_gpu_of(monkeypatch, (9, 0))
    fast = "precision 'fp8' isn't for Pi0-FAST; take precision 'bf16'"
    with pytest.raises(ConfigError, match=f"{fast}$"):
        backends.check("fused", torch.device("cpu"), "fp8", FAST)
    with pytest.raises(ConfigError, match=f"{fast} or 'int8-weights'$"):
        backends.check("fused", GPU, "fp8", FAST)
    with pytest.raises(BackendUnavailable, match=r"int8-weights needs an NVIDIA GPU .*; take precision 'bf16'$"):
        backends.check("cuda_graph", torch.device("cpu"), "int8-weights", FAST)


def on_a_gpu_of(monkeypatch: pytest.MonkeyPatch, capability: tuple[int, int]) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "NVIDIA H200")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)
    monkeypatch.setattr("shutil.which", lambda name: "/usr/bin/gcc")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: object())


def test_auto_takes_for_a_model_what_runs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, {})
    assert backends.choose(GPU, model=SMOLVLA)[0] == "fused"
    assert backends.choose(GPU, "f32", model=SMOLVLA)[0] == "cuda_graph"
    narrow = replace(SMOLVLA, text=replace(SMOLVLA.text, width=120, head_dim=8))  # type: ignore[attr-defined]
    name, said = backends.choose(GPU, model=narrow)
    assert name == "cuda_graph" and "heads are narrower than a tensor core's 16 columns" in said
    for model in (FAST, REMEMBERING):
        name, said = backends.choose(GPU, model=model)
        assert name == "cuda_graph" and "not fused" in said
