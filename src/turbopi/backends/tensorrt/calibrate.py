"""FP8 scales of the prefix's MLPs, from observations that go through the policy's own model.

Two ways to the same numbers: NVIDIA's ModelOpt (`method="modelopt"`, its FP8_DEFAULT_CFG: one scale a tensor, the
largest magnitude seen), and this file's own measurement of the same (`method="max"`), for machines without ModelOpt.
A scale is the largest magnitude over 448, the largest E4M3 number.
"""

import importlib.util
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from turbopi.backends.tensorrt.networks import Fp8Scales
from turbopi.backends.tensorrt.ops import FP8_MAX
from turbopi.models.observation import Observation
from turbopi.models.pi0.reference import Pi0Model
from turbopi.quantization.calibration_file import Quantization
from turbopi.support.errors import BackendUnavailable, ConfigError
from turbopi.support.files import write_whole
from turbopi.support.installation import install_command
from turbopi.support.reading import Fields, read_json

METHODS = ("modelopt", "max")
FILE = "calibration.json"
_NAMES = ("input", "hidden", "gate", "up", "down")


@dataclass(frozen=True)
class Calibration:
    """Scales of all layers but the last, whose MLP is never used, and where they come from."""

    scales: list[Fp8Scales | None]  # None: that layer stays in bfloat16
    method: str  # "max", or ModelOpt and its version
    observations: int
    source: str

    def about(self) -> dict[str, Any]:
        return {"method": self.method, "observations": self.observations, "source": self.source}

    def save(self, folder: Path) -> None:
        """Put it beside the engines of these weights."""
        folder.mkdir(parents=True, exist_ok=True)
        layers = [None if one is None else {name: float(getattr(one, name)) for name in _NAMES} for one in self.scales]
        write_whole(folder / FILE, json.dumps({**self.about(), "scales": layers}, indent=1) + "\n")

    @classmethod
    def find(cls, folder: Path) -> "Calibration | None":
        """The calibration in a folder, or None. Raises ConfigError for a file that can't be one."""
        file = folder / FILE
        if not file.is_file():
            return None
        try:
            content = Fields(read_json(file, ConfigError), file, ConfigError)
            layers = content.list("scales")
            by_number = Fields({str(i): layer for i, layer in enumerate(layers)}, f"{file}: scales", ConfigError)
            scales = [None if layer is None else _scales(by_number.object(str(i))) for i, layer in enumerate(layers)]
            observations = content.integer("observations", 0, 2**31)
            return cls(scales, content.text("method"), observations, content.text("source"))
        except ConfigError as error:
            raise ConfigError(
                f"{error}, so it isn't a calibration of this version; delete it and build again"
            ) from error


def _scales(layer: Fields) -> Fp8Scales:
    return Fp8Scales(*(torch.tensor(layer.number(name, 1e-30, 1e30)) for name in _NAMES))


def unavailable(method: str) -> str | None:
    """None if a method can be used, else what to do. Raises ConfigError for an unknown one."""
    if method not in METHODS:
        raise ConfigError(f"unknown calibration method {method!r}; choose one of {', '.join(METHODS)}")
    if method == "modelopt" and importlib.util.find_spec("modelopt") is None:
        return f"ModelOpt isn't installed; {install_command('modelopt')}, or take --method max, which measures the same"
    return None


def calibrate(
    model: Pi0Model, observations: Iterable[Observation], *, method: str = "max", source: str = "given observations"
) -> Calibration:
    """Measure the prefix's MLPs while observations run through the model. ModelOpt changes it: don't use it after.

    Raises BackendUnavailable if ModelOpt is asked for and missing, ConfigError for no observation, or for a layer that
    saw nothing but zeros.
    """
    reason = unavailable(method)
    if reason is not None:
        raise BackendUnavailable(reason)
    kept = list(observations)
    if not kept:
        raise ConfigError("a calibration needs at least one observation")

    def run() -> None:
        for observation in kept:
            model.prefix(observation.to(model.device))

    measured = _with_modelopt(model, run) if method == "modelopt" else _with_hooks(model, run)
    for i, layer in enumerate(measured):
        for name, value in zip(_NAMES, layer, strict=True):
            if not torch.isfinite(value) or value <= 0:
                raise ConfigError(
                    f"layer {i}: the largest magnitude of {name} is {float(value)}: not a usable calibration"
                )
    scales: list[Fp8Scales | None] = [
        Fp8Scales(*(value.float().cpu() / FP8_MAX for value in layer)) for layer in measured
    ]
    name = f"ModelOpt {metadata.version('nvidia-modelopt')}" if method == "modelopt" else method
    return Calibration(scales, name, len(kept), source)


def from_quantization(model: Pi0Model, quantization: Quantization) -> Calibration:
    """The prefix MLPs' share of what `turbopi calibrate` measured; layers that it keeps in bfloat16 stay there.

    Weights are rounded with one scale a matrix here, from their largest magnitude. Raises ConfigError for scales from
    random noise, and for INT8.
    """
    if quantization.numbers != "fp8":
        raise ConfigError(f"{quantization.source} is for {quantization.numbers}; engines take scales for fp8")
    if quantization.on_random_noise:
        raise ConfigError(
            f"{quantization.source} was calibrated on random noise; engines take scales from observations"
        )
    scales: list[Fp8Scales | None] = []
    for i, mlp in enumerate(_mlps(model)):
        inputs = [quantization.sites[f"prefix.{i}.{kind}"] for kind in ("gate_up", "down")]
        if any(site.kept is not None or site.scale is None for site in inputs):
            scales.append(None)
            continue
        weights = [part.weight.abs().amax().float().cpu() / FP8_MAX for part in _parts(mlp)]
        scales.append(Fp8Scales(*(torch.tensor(site.scale) for site in inputs), *weights))
    observed = quantization.report.get("observations", {})
    count = int(observed.get("count", 0)) if isinstance(observed, dict) else 0
    return Calibration(scales, "turbopi calibrate", count, quantization.source)


def _mlps(model: Pi0Model) -> Sequence[Any]:
    return [layer.mlp for layer in model.vlm.layers][:-1]


def _with_hooks(model: Pi0Model, run: Callable[[], None]) -> list[list[Tensor]]:
    """The largest magnitudes of each layer, in the order of Fp8Scales."""
    seen: dict[nn.Module, Tensor] = {}

    def hook(module: nn.Module, args: tuple[Tensor, ...]) -> None:
        largest = args[0].abs().amax().float()
        seen[module] = torch.maximum(seen[module], largest) if module in seen else largest

    mlps = _mlps(model)
    handles = [part.register_forward_pre_hook(hook) for mlp in mlps for part in (mlp.gate_proj, mlp.down_proj)]
    try:
        run()
    finally:
        for handle in handles:
            handle.remove()
    return [
        [seen[mlp.gate_proj], seen[mlp.down_proj], *(part.weight.abs().amax().float() for part in _parts(mlp))]
        for mlp in mlps
    ]


def _with_modelopt(model: Pi0Model, run: Callable[[], None]) -> list[list[Tensor]]:
    """The same, by ModelOpt's calibrators."""
    import modelopt.torch.quantization as mtq  # type: ignore[import-not-found, import-untyped, unused-ignore]

    others = {"quantizer_name": "*self_attn*", "enable": False}
    recipe = {**mtq.FP8_DEFAULT_CFG, "quant_cfg": [*mtq.FP8_DEFAULT_CFG["quant_cfg"], others]}
    mtq.quantize(model.vlm, recipe, forward_loop=lambda module: run())
    measured = []
    for mlp in _mlps(model):
        inputs = [mlp.gate_proj.input_quantizer.amax, mlp.down_proj.input_quantizer.amax]
        measured.append([*inputs, *(part.weight_quantizer.amax for part in _parts(mlp))])
    return measured


def _parts(mlp: Any) -> tuple[Any, Any, Any]:
    return mlp.gate_proj, mlp.up_proj, mlp.down_proj
