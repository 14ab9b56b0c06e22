"""A model as a folder of ONNX files, written at once or not at all; turbopi.checkpoint.onnx_folder reads it.

<graph>.onnx         vision, prompt, prefix and denoise_step: the graphs of graphs.py, float32, or with a
                     calibration FP8 in the prefix's MLPs
<graph>.onnx.data    its weights, as a file of protobuf holds 2 GB at most
turbopi_onnx.json    sizes, inputs and outputs, versions, the weights' hash
turbopi.json, …      given a checkpoint: its configuration, statistics, robot and tokenizer, as `convert` writes them
"""

import hashlib
import importlib.util
import json
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbopi.backends.onnx.graphs import Graph, graphs
from turbopi.backends.onnx.quantized import quantize_mlps
from turbopi.backends.tensorrt.calibrate import Calibration
from turbopi.backends.tensorrt.networks import Fp8Scales
from turbopi.checkpoint import Checkpoint, write_beside
from turbopi.checkpoint.onnx_folder import FORMAT_VERSION, GRAPHS, MANIFEST, Export, open_export
from turbopi.models.pi0.reference import Pi0Model
from turbopi.support.errors import BackendUnavailable, CheckpointError, ConfigError
from turbopi.support.files import new_folder
from turbopi.support.installation import install_command

__all__ = ["GRAPHS", "MANIFEST", "Export", "check_target", "export_onnx", "missing_library", "open_export"]

OPSET = 20  # the first with Gelu as one node
EXPORT_NEEDS = ("onnx", "onnxscript")


def missing_library(needed: tuple[str, ...]) -> str | None:
    """None if all of these packages are installed, else which one isn't and what to do."""
    absent = [name for name in needed if importlib.util.find_spec(name) is None]
    missing = f"{', '.join(absent)} {'is' if len(absent) == 1 else 'are'}n't installed"
    return f"{missing}; {install_command('onnx')}" if absent else None


def check_target(dst: Path) -> None:
    """Raise CheckpointError unless a folder can be made at `dst`: nothing is there, or an empty folder."""
    if dst.exists() and (not dst.is_dir() or any(dst.iterdir())):
        raise CheckpointError(f"{dst} exists and isn't an empty folder; give a new one")


def export_onnx(
    model: Pi0Model,
    dst: str | Path,
    *,
    checkpoint: Checkpoint | None = None,
    calibration: Calibration | None = None,
    report: Callable[[str], None] = lambda line: None,
    weights: str | None = None,
) -> Export:
    """Write the four graphs of a float32 model on the CPU into the folder `dst`; `report` hears of each one.

    checkpoint   what the model was loaded from: its configuration, statistics, robot and tokenizer go beside the
                 graphs, so that the folder can be opened as a checkpoint
    calibration  the prefix's MLPs are FP8 with it, between standard quantise and dequantise nodes
    weights      what `weights_sha256` says of the model, if that is known

    Raises CheckpointError if `dst` exists and isn't an empty folder, BackendUnavailable if a library is missing,
    ConfigError for a model in another precision, and for a checkpoint whose configuration can't be written.
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
        if checkpoint is not None:
            write_beside(checkpoint, folder)  # first, as it may refuse
        for graph in graphs(model):
            report(f"exporting {graph.name}")
            quantize = calibration.scales if calibration is not None and graph.name == "prefix" else None
            signatures[graph.name] = _write(graph, folder, quantize)
        manifest = {
            "format_version": FORMAT_VERSION,
            "kind": model.config.kind,
            "precision": "f32" if calibration is None else "fp8 (E4M3) in the prefix's MLPs, f32 elsewhere",
            **({} if calibration is None else {"calibration": calibration.about()}),
            **({} if checkpoint is None or checkpoint.random is None else {"random_weights": checkpoint.random}),
            "opset": OPSET,
            "sizes": asdict(model.config),
            "graphs": signatures,
            "weights_sha256": weights or weights_sha256(model.state_dict()),
            "versions": library_versions(),
            "files": {file.name: file.stat().st_size for file in sorted(folder.glob("*.onnx*"))},
        }
        (folder / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n")
    return Export(dst, model.config, manifest)


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
