"""The precision `nvfp4`: what is in it, and where it is refused. No GPU here has it."""

import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from cli_helpers import turbopi
from conftest import golden_folder
from shared import TWO_LAYERS
from test_backend_choice import GPU, on_a_gpu_of

from turbopi import backends
from turbopi.backends import qualification
from turbopi.backends.qualification import Verdict, unqualified
from turbopi.config import ModelConfig
from turbopi.qualify import stages
from turbopi.quantization.formats import NVFP4
from turbopi.support.errors import BackendUnavailable, ConfigError
from turbopi.verify.check_golden import golden_calibration

CPU, MODEL = torch.device("cpu"), ModelConfig()
needs_triton = pytest.mark.skipif(not importlib.util.find_spec("triton"), reason="Triton isn't installed")
COMMAND = "`turbopi doctor --qualify --checkpoint CKPT --precision nvfp4`"


def test_vision_and_prefix_are_in_it_and_the_expert_is_not() -> None:
    calibration = golden_calibration(golden_folder(), "pi05", CPU, target=0.5, format=NVFP4)
    model = golden_folder().checkpoint("pi05").config.planned_model
    plan = calibration.plan(model, "nvfp4")
    assert {name.split(".")[0] for name in plan.rounded} == {"vision", "prefix"} and plan.expert == "bf16"
    assert {why for name, why in plan.kept.items() if name.startswith("expert.")} == {
        "NVFP4 is for vision and prefix: no denoising kernel has it"
    }
    assert "prefix.1.qkv" in plan.rounded, "E4M3's scales hold a NaN, so the last keys and values may be rounded"
    with pytest.raises(ConfigError, match="is for nvfp4, the precision is 'fp8'"):
        calibration.plan(model, "fp8")


def qualified(**changes: Any) -> Verdict:
    about = {"gpu": "Thor", "compute_capability": "11.0", "multiprocessors": 20, "memory_bytes": 1, "driver": ""}
    more = {"versions": {}, "kernels": "portable", "kernels_hash": "", "precision": "nvfp4", "model": "pi05"}
    rest = {"sizes": "", "date": "2026-11-30", "seconds": 1.0, "taken": "fused", "reason": "right; 20 ms"}
    return Verdict(**{**about, **more, **rest, **changes})


@pytest.mark.parametrize("capability", [(10, 0), (10, 3), (11, 0), (12, 0), (12, 1)])
def test_it_is_refused_until_the_machine_has_found_it_right(
    capability: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    on_a_gpu_of(monkeypatch, capability)
    verdicts: list[Verdict | None] = [None]
    monkeypatch.setattr(qualification, "kept", lambda *_: verdicts[-1])
    for verdict, says in (
        (None, f"{COMMAND} has found it right"),
        (
            qualified(taken=None, reason="its self-test failed: off", failed=True),
            "right; here: its self-test failed: off",
        ),
        (qualified(unfinished=1, reason="time was up"), "right; here: time was up"),
    ):
        verdicts.append(verdict)
        with pytest.raises(BackendUnavailable, match=re.escape(says)):
            backends.check("fused", GPU, "nvfp4", MODEL)
        with pytest.raises(BackendUnavailable, match=re.escape(says)):
            backends.create("fused", MODEL, lambda *_: {}, device=GPU, precision="nvfp4")
    assert backends.refusal("fused", GPU, "nvfp4", MODEL) is None, "or nothing could be qualified"
    backends.qualified(GPU, "nvfp4", MODEL)  # starts nothing by itself
    verdicts.append(qualified())
    backends.check("fused", GPU, "nvfp4", MODEL)
    for precision in ("bf16", "int8"):
        assert unqualified(GPU, precision, MODEL) is None
    verdicts.append(None)
    monkeypatch.setattr(qualification, "under_test", {})  # in the process that qualifies
    assert unqualified(GPU, "nvfp4", MODEL) is None


@pytest.mark.parametrize(
    ("capability", "instead"), [((8, 6), "'bf16' or 'int8'"), ((9, 0), "'bf16' or 'fp8' or 'int8'")]
)
def test_gpus_without_it_are_told_what_to_take(
    capability: tuple[int, int], instead: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_a_gpu_of(monkeypatch, capability)
    says = f"10.x, 11.0 and 12.x; this GPU has {capability[0]}.{capability[1]}; take precision {instead}"
    with pytest.raises(BackendUnavailable, match=re.escape(says)):
        backends.check("fused", GPU, "nvfp4", MODEL)


def test_a_cpu_is_told_of_the_emulation() -> None:
    with pytest.raises(BackendUnavailable, match=r"10\.x, 11\.0 or 12\.x; .* backend 'emulated_nvfp4'"):
        backends.check("fused", CPU, "nvfp4", MODEL)


@needs_triton
def test_products_are_its_own_in_this_precision_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    from turbopi.kernels import ops

    monkeypatch.setattr(ops, "hopper_kernels", lambda *_: False)
    assert "NVFP4 products" in ops.fused_ops(CPU, precision="nvfp4").origin
    assert not any("NVFP4" in one for one in ops.fused_ops(CPU).origin)


def test_no_folder_keeps_four_bits(tmp_path: Path) -> None:
    result = turbopi("convert", "--random-weights", "pi05_tiny", tmp_path / "out", "--precision", "nvfp4")
    assert result.exit_code == 2 and "'nvfp4'; expected one of bf16, f32, fp8, fp8-mlp, fp8-f16sums, int8" in " ".join(
        result.output.split()
    )


def test_an_operation_that_is_wrong_refuses_the_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    """In bfloat16 PyTorch's would take its place; in NVFP4 that is no product at all."""
    subject = stages.Subject(TWO_LAYERS.model, "nvfp4", CPU, lambda *_: None, {})
    monkeypatch.setattr(stages, "check_four_bits", lambda device: ("geglu is off by 0.1", {}))
    with pytest.raises(stages.Faulty, match=r"geglu is off by 0\.1") as found:
        stages.check_kernels(subject, None, None)  # type: ignore[arg-type]
    assert found.value.path == ""
