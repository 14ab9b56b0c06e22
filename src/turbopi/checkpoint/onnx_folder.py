"""Reading a folder that `turbopi export onnx` wrote, as a checkpoint whose weights are in graphs.

<graph>.onnx, .onnx.data     the graphs, see turbopi.backends.onnx.graphs
turbopi_onnx.json            sizes, inputs and outputs, versions, lengths of the files, the weights' hash
turbopi.json, assets/, …     what a checkpoint has beside its weights: configuration, statistics, robot, tokenizer

ONNX Runtime reads the weights, nobody else: `load` raises GraphsOnly, and the backend `onnx` takes the folder from it.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from turbopi.checkpoint.source import Piece, Shape, random_note
from turbopi.config import GemmaConfig, ModelConfig, VisionConfig
from turbopi.models import parameter_shapes
from turbopi.support.errors import CheckpointError, ConfigError
from turbopi.support.reading import Fields, file_inside, is_integer, one_line, read_json, shown

MANIFEST = "turbopi_onnx.json"
GRAPHS = ("vision", "prompt", "prefix", "denoise_step")
FORMAT_VERSION = 1
_AXIS = re.compile(r"\w+( \+ \d{1,6})?")  # a free axis: "prompt", "horizon + 1"


class GraphsOnly(CheckpointError):
    """Weights were asked of an ONNX export, which has graphs instead, in `folder`."""

    def __init__(self, folder: Path) -> None:
        super().__init__(
            f"{folder} holds ONNX graphs, which only backend 'onnx' runs, in f32 on the CPU: backend='onnx', "
            "precision='f32', device='cpu'. For anything else take the checkpoint that it was exported from"
        )
        self.folder = folder


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
        """Of the graphs and their weights."""
        return sum(self.manifest["files"].values())


class GraphSource:
    """The weights of an export: known by name and shape, and readable by ONNX Runtime alone."""

    format = "onnx"

    def __init__(self, export: Export) -> None:
        self.export = export
        self.shapes: dict[str, Shape] = parameter_shapes(export.config)
        self.dtypes = dict.fromkeys(self.shapes, "F32")
        self.vision_heads: int | None = export.config.vision.num_heads
        self.weights_sha256: str = export.manifest["weights_sha256"]
        self.notes = ["ONNX graphs: only --backend onnx runs them"]
        mark = export.manifest.get("random_weights")
        self.random = mark if isinstance(mark, str) else None
        if self.random is not None:
            self.notes.append(random_note(one_line(self.random)))
        if "calibration" in export.manifest:
            quantized = tuple(f"vlm.layers.{layer}.mlp." for layer in range(export.config.vlm.depth - 1))
            self.dtypes |= {name: "F8_E4M3" for name in self.shapes if name.startswith(quantized)}
            self.notes.append("the prefix's MLPs are in FP8; the SHA-256 is of the float32 weights before that")

    def native_name(self, name: str) -> str:
        return name

    def pieces(self, device: torch.device) -> Iterator[Piece]:
        raise GraphsOnly(self.export.folder)


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
    return manifest, model_of_sizes(fields)


def model_of_sizes(fields: Fields) -> ModelConfig:
    """The model whose `asdict` a manifest has as `sizes`. Raises CheckpointError if they aren't one's."""
    try:
        sizes = dict(fields.object("sizes").values)
        vision, vlm = VisionConfig(**sizes.pop("vision")), GemmaConfig(**sizes.pop("vlm"))
        return ModelConfig(vision=vision, vlm=vlm, expert=GemmaConfig(**sizes.pop("expert")), **sizes)
    except (KeyError, TypeError, ConfigError) as error:
        raise CheckpointError(f"{fields.where}: its sizes aren't those of a model ({error})") from error
