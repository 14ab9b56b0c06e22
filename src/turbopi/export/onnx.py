"""A model as a folder of ONNX files, written at once or not at all, and read back with checks.

<graph>.onnx         vision, prompt, prefix and denoise_step: the graphs of turbopi.export.graphs, float32, or with a
                     calibration FP8 in the prefix's MLPs
<graph>.onnx.data    its weights, as a file of protobuf holds 2 GB at most
turbopi_onnx.json    sizes, inputs and outputs, versions, the weights' hash
"""

import hashlib
import importlib.util
import json
import logging
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbopi.config import GemmaConfig, ModelConfig, VisionConfig
from turbopi.errors import BackendUnavailable, CheckpointError, ConfigError
from turbopi.export.graphs import Graph, graphs
from turbopi.export.quantized import quantize_mlps
from turbopi.files import new_folder
from turbopi.installation import install_command
from turbopi.model.reference import Pi0Model
from turbopi.reading import Fields, file_inside, is_integer, read_json, shown
from turbopi.tensorrt.calibrate import Calibration
from turbopi.tensorrt.networks import Fp8Scales

MANIFEST = "turbopi_onnx.json"
GRAPHS = ("vision", "prompt", "prefix", "denoise_step")
OPSET = 20  # the first with Gelu as one node
FORMAT_VERSION = 1
_AXIS = re.compile(r"\w+( \+ \d{1,6})?")  # a free axis: "prompt", "horizon + 1"
EXPORT_NEEDS = ("onnx", "onnxscript")


@dataclass(frozen=True)
class Export:
    """An exported folder."""

    folder: Path
    config: ModelConfig
    manifest: Mapping[str, Any]

    def graph(self, name: str) -> Path:
        return self.folder / f"{name}.onnx"

    @property
    def bytes(self) -> int:
        return sum(self.manifest["files"].values())


def missing_library(needed: tuple[str, ...]) -> str | None:
    """None if all of these packages are installed, else which one isn't and what to do."""
    absent = [name for name in needed if importlib.util.find_spec(name) is None]
    return f"{' and '.join(absent)} isn't installed; {install_command('onnx')}" if absent else None


def check_target(dst: Path) -> None:
    """Raise CheckpointError unless a folder can be made at `dst`: nothing is there, or an empty folder."""
    if dst.exists() and (not dst.is_dir() or any(dst.iterdir())):
        raise CheckpointError(f"{dst} exists and isn't an empty folder; give a new one")


def export_onnx(
    model: Pi0Model,
    dst: str | Path,
    *,
    calibration: Calibration | None = None,
    report: Callable[[str], None] = lambda line: None,
    weights: str | None = None,
) -> Export:
    """Write the four graphs of a float32 model on the CPU into the folder `dst`; `report` hears of each one.

    `weights` is what `weights_sha256` says of the model, if that is known.

    With a calibration, the prefix's MLPs are FP8, between standard quantise and dequantise nodes.

    Raises CheckpointError if `dst` exists and isn't an empty folder, BackendUnavailable if a library is missing,
    ConfigError for a model in another precision.
    """
    dst = Path(dst).expanduser()
    check_target(dst)
    missing = missing_library(EXPORT_NEEDS)
    if missing is not None:
        raise BackendUnavailable(f"can't export to ONNX: {missing}")
    if model.compute_dtype != torch.float32 or model.device.type != "cpu":
        raise ConfigError(f"the export takes a float32 model on the CPU, not {model.compute_dtype} on {model.device}")
    signatures = {}
    with new_folder(dst) as folder:
        for graph in graphs(model):
            report(f"exporting {graph.name}")
            quantize = calibration.scales if calibration is not None and graph.name == "prefix" else None
            signatures[graph.name] = _write(graph, folder, quantize)
        manifest = {
            "format_version": FORMAT_VERSION,
            "kind": model.config.kind,
            "precision": "f32" if calibration is None else "fp8 (E4M3) in the prefix's MLPs, f32 elsewhere",
            **({} if calibration is None else {"calibration": calibration.about()}),
            "opset": OPSET,
            "sizes": asdict(model.config),
            "graphs": signatures,
            "weights_sha256": weights or weights_sha256(model.state_dict()),
            "versions": library_versions(),
            "files": {file.name: file.stat().st_size for file in sorted(folder.iterdir())},
        }
        (folder / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n")
    return Export(dst, model.config, manifest)


def open_export(folder: str | Path) -> Export:
    """A folder that `export_onnx` wrote. Raises CheckpointError if it isn't one, or if a file isn't as it was written.

    Files are checked by name and length; contents are read by the runtime.
    """
    folder = Path(folder).expanduser()
    file = folder / MANIFEST
    if not file.is_file():
        raise CheckpointError(f"{folder} has no {MANIFEST}: it isn't a folder that `turbopi export onnx` wrote")
    try:
        manifest, config = _read_manifest(file)
    except (CheckpointError, ConfigError) as error:
        raise CheckpointError(f"{error}; export again") from error
    files = manifest["files"]
    for name in (*(f"{graph}.onnx" for graph in GRAPHS), *files):
        size = (folder / name).stat().st_size if (folder / name).is_file() else None
        if size is None or size != files.get(name):
            found = "is missing" if size is None else f"has {size} bytes instead of {shown(files.get(name))}"
            raise CheckpointError(f"{folder / name} {found}; copy the whole folder or export again")
    return Export(folder, config, manifest)


def _read_manifest(file: Path) -> tuple[dict[str, Any], ModelConfig]:
    """The manifest, in which everything is there that is used of it, and the model that it describes."""
    manifest = read_json(file)
    fields = Fields(manifest, file)
    version = fields.integer("format_version", 0, 2**31)
    if version != FORMAT_VERSION:
        raise CheckpointError(f"{file} has format version {version}, not {FORMAT_VERSION}")
    for name in fields.object("files").values:
        file_inside(file.parent, name, file)
    fields.integer("opset", 1, 1000)
    fields.text("weights_sha256")
    fields.object("versions")
    for graph in GRAPHS:
        for end in ("inputs", "outputs"):
            signature = fields.object("graphs").object(graph).object(end)
            for name in signature.values:
                one = signature.object(name)
                one.text("dtype")
                if not all(is_integer(axis) or _AXIS.fullmatch(str(axis)) for axis in one.list("shape")):
                    one.refuse("shape", "whole numbers and names of axes")
    try:
        sizes = dict(fields.object("sizes").values)
        vision, vlm = VisionConfig(**sizes.pop("vision")), GemmaConfig(**sizes.pop("vlm"))
        config = ModelConfig(vision=vision, vlm=vlm, expert=GemmaConfig(**sizes.pop("expert")), **sizes)
    except (KeyError, TypeError, ConfigError) as error:
        raise CheckpointError(f"{file}: its sizes aren't those of a model ({error})") from error
    return manifest, config


def weights_sha256(state: Mapping[str, Tensor]) -> str:
    """SHA-256 of float32 weights by canonical name: what `turbopi inspect --hash` shows of the same numbers."""
    lines = []
    for name, tensor in sorted(state.items()):
        assert tensor.dtype == torch.float32, (name, tensor.dtype)
        digest = hashlib.sha256(tensor.contiguous().numpy().data).hexdigest()
        lines.append(f"{name} {list(tensor.shape)} {digest}")
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def _write(graph: Graph, folder: Path, scales: Sequence[Fp8Scales | None] | None = None) -> dict[str, Any]:
    """Export one graph; returns its inputs and outputs as name -> dtype and shape, free axes by name."""
    with _quiet_exporter():
        program = torch.onnx.export(
            graph.module.eval(),
            tuple(graph.inputs.values()),
            dynamo=True,
            input_names=list(graph.inputs),
            output_names=list(graph.outputs),
            dynamic_shapes=tuple(graph.dynamic.values()),
            opset_version=OPSET,
            verbose=False,
        )
    assert program is not None
    if scales is not None:
        quantize_mlps(program.model.graph, scales)
    for node in program.model.graph.all_nodes():
        node.metadata_props.pop("pkg.torch.onnx.stack_trace", None)  # paths on the machine that exported
    program.save(str(folder / f"{graph.name}.onnx"), external_data=True)
    ends = program.model.graph
    return {"inputs": _signature(ends.inputs), "outputs": _signature(ends.outputs)}


def _signature(values: Any) -> dict[str, Any]:
    return {
        value.name: {
            "dtype": str(value.dtype.numpy()),
            "shape": [axis if isinstance(axis, int) else str(axis.value) for axis in value.shape],
        }
        for value in values
    }


@contextmanager
def _quiet_exporter() -> Iterator[None]:
    """Without what the exporter says of its own deprecated calls, of axes of one name, of torchvision's absence."""
    logger = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)`", FutureWarning)
            warnings.filterwarnings("ignore", r"# The axis name: .* will not be used", UserWarning)
            yield
    finally:
        logger.setLevel(level)


def library_versions() -> dict[str, str]:
    """Of what an export is made with."""
    return {name: _version(name) for name in ("turbopi", "torch", "onnx", "onnxscript")}


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:  # Turbo-Pi run from its source folder
        return "not installed"
