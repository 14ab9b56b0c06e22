"""A folder that `turbopi convert --precision fp8` (or int8) wrote: weights that stay in eight bits on disk.

    quantized.safetensors       a parameter under its canonical name, in bfloat16 or float32 as the engine has it; or a
                                matrix of the engine by its place: prefix.0.qkv.codes e4m3 or int8[out, in],
                                prefix.0.qkv.scale float32[out], of its channels alone
    turbopi_quantized.json      precision, sizes, versions, the file's length, hashes of it, of weights, calibration and
                                all that this document says
    turbopi_fp8.json, or _int8  the calibration
    turbopi.json, assets/, ...  what a checkpoint has beside its weights

No kernel's order is in it, so all that `fused` has for a precision read the same file. The expert is there in bfloat16,
too, for the calls that operations denoise.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

import torch

from turbopi.checkpoint.matrices import is_used, names_at
from turbopi.checkpoint.onnx_folder import model_of_sizes
from turbopi.checkpoint.source import Piece, Shape, random_note, row_ranges
from turbopi.checkpoint.tensor_file import DTYPES
from turbopi.checkpoint.torch_files import Stored, read_header, read_tensor
from turbopi.config import ModelConfig
from turbopi.models import family_of, parameter_shapes
from turbopi.quantization.calibration_file import Quantization
from turbopi.quantization.formats import OF_EIGHT_BITS
from turbopi.quantization.fp8 import ScaledMatrix
from turbopi.quantization.plan import KEPT_TIERS, PrecisionPlan, Tier, format_of
from turbopi.quantization.sites import KINDS
from turbopi.support.errors import CheckpointError, ConfigError
from turbopi.support.reading import Fields, one_line, read_json, shown

MANIFEST, TENSORS = "turbopi_quantized.json", "quantized.safetensors"
FORMAT, VERSION = "turbopi-quantized-weights", 1
_ANEW = "Copy the whole folder, or convert the checkpoint anew"


class QuantizedOnly(ConfigError):
    """Weights that are kept in eight bits can't do what was requested."""

    def __init__(self, folder: Path, precision: str) -> None:
        super().__init__(
            f"{folder} keeps its weights in {precision}, which backend 'fused' alone runs, in that precision. For "
            "another backend or precision, the float32 reference, another calibration or conversion take the "
            "checkpoint that it was made from"
        )


@runtime_checkable
class QuantizedRoom(Protocol):
    """A `Room` that takes matrices in eight bits, if they are for its precision."""

    precision: str | None

    def give(self, place: str, matrix: ScaledMatrix) -> None:
        """A matrix of the engine, mapped from the file, with its channels' scales alone."""


def tensors_of(config: ModelConfig, plan: PrecisionPlan) -> dict[str, tuple[str, Shape]]:
    """Dtype and shape of all that the file holds for a model in a precision."""
    names = {torch.bfloat16: "BF16", torch.float32: "F32"}
    shapes, dtype_of = parameter_shapes(config), family_of(config).parameter_dtype
    unused = {f"prefix.{config.vlm.depth - 1}.{kind}" for kind in KINDS["prefix"]}
    unused = {place for place in unused if not is_used(config, place)}
    elsewhere = {name for place in {*plan.rounded, *unused} for name in names_at(place) if place[:6] != "expert"}
    found = {
        name: (names[dtype_of(name, "bf16", config)], shape) for name, shape in shapes.items() if name not in elsewhere
    }
    stored = next(name for name, dtype in DTYPES.items() if dtype == plan.format.dtype)
    for place in plan.rounded:
        parts = [shapes[name] for name in names_at(place)]
        rows = sum(shape[0] for shape in parts)
        found[f"{place}.codes"], found[f"{place}.scale"] = (stored, (rows, parts[0][1])), ("F32", (rows,))
    return found


class QuantizedSource:
    """The weights of such a folder: `pieces` are refused, `pieces_into` gives them to a room that takes them.

    Raises CheckpointError for what isn't as it was written.
    """

    format = "quantized"

    def __init__(self, folder: Path) -> None:
        self.folder, self.file = folder, folder / TENSORS
        manifest, self.config = _read_manifest(folder / MANIFEST)
        self.precision: Tier = manifest["precision"]
        self.bytes: int = manifest["bytes"]  # of the file
        self.weights_sha256: str = manifest["weights_sha256"]
        self._file_sha256: str = manifest["file_sha256"]
        self._identity: str = manifest["calibration"]
        calibration = Quantization.load(folder / manifest["calibration_file"])
        if calibration.identity != self._identity:
            raise CheckpointError(f"{calibration.source} isn't the calibration that {folder} was made with. {_ANEW}")
        calibration.check(self.config, self.weights_sha256)
        self.plan = calibration.plan(self.config, self.precision)
        self._stored = self._checked_header()
        self.shapes: dict[str, Shape] = parameter_shapes(self.config)
        rounded = {name for place in self.plan.rounded for name in names_at(place)}
        own = next(name for name, dtype in DTYPES.items() if dtype == self.plan.format.dtype)
        self.dtypes = {name: own if name in rounded else self._stored_dtype(name) for name in self.shapes}
        self.vision_heads: int | None = self.config.vision.num_heads
        mark = manifest.get("random_weights")
        self.random = mark if isinstance(mark, str) else None
        self.notes = [f"weights in {self.precision}, rounded on {one_line(str(manifest['rounded_on']))}"]
        if self.random is not None:
            self.notes.append(random_note(one_line(self.random)))

    def check_file(self) -> None:
        """Read the whole file. Raises CheckpointError if it isn't what was written."""
        if file_sha256(self.file) != self._file_sha256:
            raise CheckpointError(f"{self.file} is damaged: its SHA-256 isn't what {MANIFEST} says. {_ANEW}")

    @property
    def plain(self) -> set[str]:
        """The canonical names of the parameters that the file has as they are."""
        return self._stored.keys() & self.shapes.keys()

    def native_name(self, name: str) -> str:
        return name

    def pieces(self, device: torch.device) -> Iterator[Piece]:
        raise QuantizedOnly(self.folder, self.precision)

    def pieces_into(self, room: object) -> Iterator[Piece]:
        """Gives the room the matrices in eight bits, then yields all else. Raises QuantizedOnly if it is for others."""
        if not isinstance(room, QuantizedRoom) or room.precision != self.precision:
            raise QuantizedOnly(self.folder, self.precision)
        for place in self.plan.rounded:
            codes, scale = (read_tensor(self._stored[f"{place}.{part}"]) for part in ("codes", "scale"))
            if not (scale.isfinite() & (scale > 0)).all():
                raise CheckpointError(f"{self.file}: {place}.scale isn't all positive, finite numbers. {_ANEW}")
            room.give(place, ScaledMatrix(codes, scale, 1.0, torch.bfloat16))
        for name in sorted(self.plain, key=lambda name: (-_bytes_of(self._stored[name]), name)):
            values = read_tensor(self._stored[name])
            for start, stop in row_ranges(values.shape, values.element_size()):
                yield Piece(name, start, values[start:stop])

    def check(self, precision: str, calibration: Quantization | None) -> None:
        """Raise QuantizedOnly for another precision, ConfigError for another calibration."""
        if precision != self.precision:
            raise QuantizedOnly(self.folder, self.precision)
        if calibration is not None and calibration.identity != self._identity:
            raise ConfigError(
                f"{self.folder} was made with the calibration that lies in it, and {calibration.source} is another, or "
                "of other parts: leave it out, or convert the checkpoint anew with it"
            )

    def _stored_dtype(self, name: str) -> str:
        return self._stored[name].dtype if name in self._stored else "BF16"  # unused, so not kept

    def _checked_header(self) -> dict[str, Stored]:
        expected = tensors_of(self.config, self.plan)
        found = {stored.key: stored for stored in read_header(self.file)}
        for name in sorted(expected.keys() | found.keys()):
            there = (found[name].dtype, found[name].shape) if name in found else "missing"
            if name not in expected or there != expected[name]:
                what = expected.get(name, "nothing of that name")
                raise CheckpointError(f"{self.file}: {name} is {there}, expected {what}. {_ANEW}")
        return found


def _bytes_of(stored: Stored) -> int:
    return DTYPES[stored.dtype].itemsize * torch.Size(stored.shape).numel()


def precision_kept(checkpoint: Any) -> Tier | None:
    """The precision that a folder, or an open checkpoint, keeps its weights in; None: it is an ordinary one."""
    if not isinstance(checkpoint, str | Path):
        source = getattr(checkpoint, "source", None)
        return source.precision if isinstance(source, QuantizedSource) else None
    file = Path(checkpoint).expanduser() / MANIFEST
    return cast(Tier, _read_manifest(file)[0]["precision"]) if file.is_file() else None


def _read_manifest(file: Path) -> tuple[dict[str, Any], ModelConfig]:
    """The manifest, in which everything is there that is used of it, and the model that it describes."""
    manifest = read_json(file)
    fields = Fields(manifest, file)
    fields.choice("format", (FORMAT,))
    if (version := fields.integer("version", 0, 2**31)) != VERSION:
        raise CheckpointError(
            f"{file} has version {version} of {FORMAT}, this Turbo-Pi reads version {VERSION}: convert the checkpoint "
            "that it was made from anew"
        )
    format = format_of(fields.choice("precision", KEPT_TIERS))
    fields.choice("calibration_file", tuple(f"turbopi_{name}.json" for name in OF_EIGHT_BITS))
    if manifest["calibration_file"] != f"turbopi_{format.name}.json":
        fields.refuse("calibration_file", f"turbopi_{format.name}.json")
    for name in ("weights_sha256", "file_sha256", "calibration", "rounded_on"):
        fields.text(name)
    length = (file.parent / TENSORS).stat().st_size if (file.parent / TENSORS).is_file() else None
    if length != fields.integer("bytes", 0, 2**50):
        found = "is missing" if length is None else f"has {length} bytes instead of {shown(manifest['bytes'])}"
        raise CheckpointError(f"{file.parent / TENSORS} {found}. {_ANEW}")
    model = model_of_sizes(fields)
    if sealed(manifest) != manifest:
        raise CheckpointError(f"{file} was changed since it was written. {_ANEW}")
    return manifest, model


def sealed(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """A manifest with the SHA-256 of all else that it says."""
    said = {name: value for name, value in manifest.items() if name != "sha256"}
    return said | {"sha256": hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()}


def file_sha256(file: Path) -> str:
    digest = hashlib.sha256()
    with file.open("rb") as content:
        while block := content.read(1 << 24):
            digest.update(block)
    return digest.hexdigest()
