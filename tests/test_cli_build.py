"""`turbopi build` around its builder: what it keeps, says and refuses. The engines are twins."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from cli_helpers import refusal, turbopi
from conftest import golden_folder, golden_model
from tensorrt_fakes import ENVIRONMENT, Reference

from turbopi import backends
from turbopi.backends.tensorrt import Library
from turbopi.backends.tensorrt.backend import TensorRTBackend
from turbopi.backends.tensorrt.cache import EngineCache
from turbopi.backends.tensorrt.calibrate import Calibration, from_quantization
from turbopi.backends.tensorrt.engine import Specification
from turbopi.backends.tensorrt.engines import ModelEngines
from turbopi.backends.tensorrt.fp8 import TensorRTFp8Backend
from turbopi.quantization.calibration_file import RANDOM_NOISE, Quantization, SiteScale
from turbopi.support.errors import BackendError, ConfigError
from turbopi.support.installation import install_command

TINY = ("--random-weights", "pi05_tiny", "--cameras", "2", "--prompt-tokens", "20", "--device", "cpu")


@pytest.fixture
def build(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """Runs the command with a builder that needs no TensorRT; its document."""

    def build_one(one: Specification) -> bytes:
        return one.name.encode()

    def engines(library: Any, config: Any, weights: Any, hashed: str, device: Any, *, folder: Path, **more: Any) -> Any:
        cache = EngineCache(folder, dataclasses.replace(ENVIRONMENT, weights=hashed))
        return ModelEngines(config, weights, cache, build=build_one, load=lambda one, plan: Reference(one), **more)

    monkeypatch.setattr("turbopi.backends.tensorrt.engines.for_this_gpu", engines)
    monkeypatch.setattr("turbopi.backends.tensorrt.library", lambda: Library("tensorrt_rtx", "1.0", None))
    monkeypatch.setattr("turbopi.backends.availability", lambda name, device: None)

    def run(*options: str) -> dict[str, Any]:
        result = turbopi("build", *TINY, *options, "--cache", tmp_path, "--json")
        assert result.exit_code == 0, result.output
        document: dict[str, Any] = json.loads(result.stdout)
        return {**document, "said": result.stderr}

    return run


def test_engines_are_built_once_and_then_found(build: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    first, second = build(), build()
    assert set(first["engines"].values()) == {"built"} and set(second["engines"].values()) == {"cached"}
    assert first["shape"] == "2 cameras, up to 32 prompt tokens, H=10"
    assert len(first["engines"]) == 2 + 5 and first["calibration"] is None
    assert "7 engines for 2 cameras, up to 32 prompt tokens, H=10: 7 built, 0 from the cache" in first["said"]
    assert first["load_seconds"] > 0  # loading compiles kernels, and keeps them
    assert Path(first["folder"]).parent == tmp_path
    assert set(build("--rebuild")["engines"].values()) == {"built"}


@pytest.mark.slow
def test_fp8_engines_are_calibrated_on_real_pictures_and_the_scales_kept(
    build: Callable[..., dict[str, Any]],
) -> None:
    document = build("--precision", "fp8")
    assert document["calibration"]["source"] == "LIBERO images that come with Turbo-Pi"
    assert document["calibration"]["observations"] > 1 and document["backend"] == "tensorrt_fp8"
    kept = Calibration.find(Path(document["folder"]))
    assert kept is not None and len(kept.scales) == 5
    assert sum(name.endswith("-fp8") for name in document["engines"]) == 5


@pytest.mark.slow
def test_engines_of_another_calibration_are_refused_and_built_again(build: Callable[..., dict[str, Any]]) -> None:
    folder = Path(build("--precision", "fp8")["folder"])
    file = next(folder.glob("feed_forward-0-*.engine"))
    line, plan = file.read_bytes().split(b"\n", 1)
    about = json.loads(line)
    about["key"]["scales"]["input"] = [1.0]
    file.write_bytes(json.dumps(about).encode() + b"\n" + plan)
    again = build("--precision", "fp8")
    assert [name for name, origin in again["engines"].items() if origin == "built"] == [file.stem]
    assert "refused a cached engine: " in again["said"] and "was built for scales" in again["said"]


def test_a_missing_modelopt_is_told_before_anything_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("turbopi.backends.availability", lambda name, device: None)
    monkeypatch.setattr("turbopi.backends.tensorrt.calibrate.importlib.util.find_spec", lambda name: None)
    said = refusal(turbopi("build", *TINY, "--precision", "fp8", "--method", "modelopt"))
    assert f"ModelOpt isn't installed; {install_command('modelopt')}, or" in said


# -- the file of `turbopi calibrate` -----------------------------------------------------------------------------------


def quantization(kept: Sequence[str] = (), source: str = "recording") -> Quantization:
    model = golden_model("pi05")
    sites = {
        f"prefix.{i}.{kind}": SiteScale(
            0.01 * (i + 1), 1.0, 0.0, 0.01, "too far off" if f"{i}.{kind}" in kept else None
        )
        for i in range(model.config.vlm.depth - 1)
        for kind in ("gate_up", "down")
    }
    return Quantization(
        "f" * 64, {}, sites, {"observations": {"count": 12, "source": source}}, source="turbopi_fp8.json"
    )


def test_scales_of_turbopi_calibrate_are_taken_as_they_are() -> None:
    found = from_quantization(golden_model("pi05"), quantization())
    assert [float(one.input) for one in found.scales if one is not None] == pytest.approx([0.01, 0.02])
    assert found.about() == {"method": "turbopi calibrate", "observations": 12, "source": "turbopi_fp8.json"}


def test_a_layer_that_it_keeps_in_bf16_stays_there() -> None:
    found = from_quantization(golden_model("pi05"), quantization(kept=("1.down",)))
    assert found.scales[0] is not None and found.scales[1] is None


def test_scales_from_noise_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"turbopi_fp8\.json was calibrated on random noise"):
        from_quantization(golden_model("pi05"), quantization(source=RANDOM_NOISE))


# -- GPUs that can't ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cls", "capability", "said"),
    [
        (TensorRTBackend, (7, 5), "needs compute capability 8.0 or newer for bfloat16, this GPU has 7.5"),
        (
            TensorRTFp8Backend,
            (8, 7),
            "E4M3 matmuls need compute capability 8.9 or newer, this GPU has 8.7; use 'tensorrt'",
        ),
        (TensorRTFp8Backend, (8, 9), None),
        (TensorRTBackend, (8, 7), None),
    ],
)
def test_a_gpu_that_lacks_the_precision_is_refused(
    cls: type[TensorRTBackend], capability: tuple[int, int], said: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("turbopi.backends.tensorrt.backend.missing", lambda: None)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)
    reason = cls.unavailable(torch.device("cuda", 0))
    assert (reason is None) if said is None else (reason is not None and said in reason)


def test_other_key_value_heads_are_refused() -> None:
    config = golden_folder().checkpoint("pi05").config.planned_model
    two = {name: dataclasses.replace(getattr(config, name), num_kv_heads=2) for name in ("vlm", "expert")}
    with pytest.raises(BackendError, match="needs one key/value head, this model has 2"):
        TensorRTBackend(
            dataclasses.replace(config, **two),
            lambda device, precision: {},
            device=torch.device("cpu"),
            precision="bf16",
        )


def test_auto_never_takes_tensorrt() -> None:
    assert not any(name.startswith("tensorrt") for name in backends._FASTEST_FIRST)
