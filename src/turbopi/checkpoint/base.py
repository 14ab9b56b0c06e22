"""A checkpoint: weights behind one interface, whatever the format they are stored in."""

import hashlib
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from math import prod
from pathlib import Path
from typing import Any, Protocol

import torch
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn
from torch import Tensor

from turbopi.checkpoint import known_hashes
from turbopi.checkpoint.names import EMBEDDING
from turbopi.checkpoint.norm_stats import NormStats
from turbopi.checkpoint.quantized_folder import QuantizedSource
from turbopi.checkpoint.source import Piece, Shape, WeightSource, check_finite
from turbopi.config import FloatPrecision, ModelConfig, PolicyConfig, memory_of
from turbopi.models import family_of
from turbopi.support.errors import CheckpointError

SMALL_BYTES = 64 * 2**20  # of weights that are hashed at once, in a tenth of a second
PARTS = ("vision", "projector", "vlm", "expert")  # the rest: action, state and time projections


class Room(Protocol):
    """Where weights are read to. device: where random ones are made."""

    device: torch.device

    def __call__(self, name: str, shape: Shape, dtype: torch.dtype) -> Tensor:
        """An uninitialised tensor for a parameter."""

    def takes(self, name: str) -> bool:
        """Whether the room is given a parameter once all of it is read: then it isn't in the state that is loaded."""

    def take(self, name: str, tensor: Tensor) -> None: ...


@dataclass(frozen=True)
class OneDevice:
    """All of them on one device."""

    device: torch.device

    def __call__(self, name: str, shape: Shape, dtype: torch.dtype) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=self.device)

    def takes(self, name: str) -> bool:
        return False

    def take(self, name: str, tensor: Tensor) -> None: ...


@dataclass(frozen=True, eq=False)
class Loaded:
    """Weights in memory: `state` under canonical names, on their device, in the dtypes of the precision."""

    state: dict[str, Tensor]
    seconds: float
    bytes: int


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """An opened checkpoint: checked, described, not yet loaded. Made by `open_checkpoint` and `random_checkpoint`."""

    path: Path | None  # None: random weights
    config: PolicyConfig  # sizes are the tensors'
    config_source: str
    norm_stats: NormStats
    source: WeightSource
    asset_id: str | None = None
    tokenizer_candidates: tuple[Path, ...] = ()
    named_tokenizer: Path | None = None  # the folder that LeRobot's processors name, if it is here
    action_tokenizers: tuple[Path, ...] = ()  # folders that it may be in, of models that write their actions as tokens
    action_tokenizer_name: str | None = None  # its repository on the Hub
    expected_sha256: str | None = None  # what the configuration says the weights' hash is

    @property
    def format(self) -> str:
        """One of "openpi_torch", "openpi_jax", "lerobot", "onnx", "quantized", "random"."""
        return self.source.format

    @property
    def random(self) -> str | None:
        """ "seed 0" of random weights; None: they aren't, as far as is known."""
        return getattr(self.source, "random", None)

    @cached_property
    def short_hash(self) -> str | None:
        """12 digits of `fingerprint`, if it is cached, or the weights are small; else None."""
        known = hasattr(self.source, "recipe") or getattr(self.source, "weights_sha256", None) is not None
        if known or self.stored_bytes <= SMALL_BYTES:
            return self.fingerprint(trust_files=True)[:12]
        key = self._files_key()
        found = None if key is None else known_hashes.look_up(key)
        return None if found is None else found[:12]

    @property
    def _loop(self) -> dict[str, Any]:
        """What makes actions: denoising, or tokens."""
        config = self.config
        if family_of(config.model).reader is not None:
            return {
                "max_decoding_steps": getattr(config.model, "max_decoding_steps", None),
                "action_tokenizers": [str(folder) for folder in self.action_tokenizers if folder.is_dir()],
            }
        return {
            "num_denoising_steps": config.num_denoising_steps,
            "solver": config.solver,
            "time_grid": config.solver_grid,
        }

    @property
    def _named_tokenizer(self) -> list[Path]:
        """The one that LeRobot's processors name, if it is elsewhere on this machine."""
        file = None if self.named_tokenizer is None else self.named_tokenizer / "tokenizer.json"
        return [] if file is None or not file.is_file() else [file]

    def load(self, device: torch.device | str | Room, precision: FloatPrecision, *, progress: bool = False) -> Loaded:
        """Read all weights into their final dtype and device, piece by piece.

        Raises CheckpointError if a value is NaN or infinite, and as `check_hash`; for an ONNX export GraphsOnly, and
        QuantizedOnly for weights in eight bits unless the room is for them.
        """
        self.check_hash()
        dtype_of = family_of(self.config.model).parameter_dtype
        room = OneDevice(torch.device(device)) if isinstance(device, (str, torch.device)) else device
        began = time.perf_counter()
        source, shapes, total = self.source, self.source.shapes, 0
        state: dict[str, Tensor] = {}
        sums: dict[str, list[Tensor]] = {}  # of the pieces: one is finite only if all of its values are
        kept = source if isinstance(source, QuantizedSource) else None
        pieces = source.pieces(room.device) if kept is None else kept.pieces_into(room)
        with progress_bar(progress, f"loading {self.format}", self.stored_bytes) as advance:
            for piece in pieces:
                name = piece.name
                if name not in sums:
                    state[name] = room(name, shapes[name], dtype_of(name, precision, self.config.model))
                    total += state[name].nbytes
                place = put(state[name], piece)
                sums.setdefault(name, []).append(place.sum())
                advance.update(piece.values.numel() * piece.values.element_size())
                del place
                if not shapes[name] or piece.start + len(piece.values) == shapes[name][0]:
                    self._hand_over(name, state, sums, room)
        expected = shapes.keys() if kept is None else kept.plain
        assert sums.keys() == expected, sums.keys() ^ expected
        self._check_finite(state, sums)
        if room.device.type == "cuda":
            torch.cuda.current_stream(room.device).synchronize()  # not the device: others may be capturing
        return Loaded(state, time.perf_counter() - began, total if kept is None else kept.bytes)

    def _hand_over(
        self, name: str, state: dict[str, Tensor], sums: dict[str, list[Tensor]], room: OneDevice | Room
    ) -> None:
        """Let the room take a parameter that is read: what it takes is checked before, and then no longer here."""
        if room.takes(name):
            self._check_finite({name: state[name]}, {name: sums[name]})
            sums[name] = []
            room.take(name, state.pop(name))

    def _check_finite(self, state: dict[str, Tensor], sums: dict[str, list[Tensor]]) -> None:
        """Raise CheckpointError if a value is NaN or infinite. sums: of pieces, which may have overflowed."""
        by_device: dict[torch.device, list[Tensor]] = {}
        for some in sums.values():
            for one in some:
                by_device.setdefault(one.device, []).append(one)
        if not all(
            all(torch.stack(some).isfinite().tolist()) for some in by_device.values()
        ):  # one may have overflowed
            for name, tensor in state.items():
                check_finite(tensor, self.source.native_name(name), self.path)

    def load_head(self, device: torch.device | str, precision: FloatPrecision) -> Tensor | None:
        """The language head [V, D] of a Pi0.5 that writes text; None: its embedding table is the head.

        Raises CheckpointError for an adapter's, and if a value is NaN or infinite.
        """
        if self.format == "lerobot" and not hasattr(self.source, "untied_head"):
            raise CheckpointError(
                f"{self.path} is an adapter, whose language head isn't read: merge it into its base model there "
                "(merge_and_unload), and save that"
            )
        if (found := self._untied_head()) is None:
            return None
        check_finite(found, "lm_head.weight", self.path)
        return found.to(device, family_of(self.config.model).parameter_dtype(EMBEDDING, precision, self.config.model))

    def _untied_head(self) -> Tensor | None:
        untied = getattr(self.source, "untied_head", None)
        head: Tensor | None = None if untied is None else untied()
        return head

    def check_hash(self) -> None:
        """Raise CheckpointError if the weights' SHA-256 isn't the one in the configuration, if it has one."""
        if self.expected_sha256 is not None and self.fingerprint() != self.expected_sha256:
            raise CheckpointError(
                f"{self.path}: {self.config_source} says that the weights' SHA-256 is {self.expected_sha256}, but it "
                f"is {self.fingerprint()}: they are damaged, or others. Copy them anew, or correct weights_sha256"
            )

    def check_files(self) -> None:
        """Raise CheckpointError if a folder with weights in eight bits isn't what was written: reads it all."""
        if isinstance(self.source, QuantizedSource):
            self.source.check_file()

    def fingerprint(self, *, trust_files: bool = False) -> str:
        """SHA-256 of the weights: of every parameter's canonical name, shape and float32 bytes (little endian), and of
        a pi052's language head where it isn't the embedding.

        Independent of the format and the stored dtype. Reads all weights, once per object; with `trust_files` the
        cached hash of files that look unchanged is used (known_hashes.py).
        """
        if not trust_files or "_fingerprint" in self.__dict__:
            return self._fingerprint
        key = self._files_key()
        return (None if key is None else known_hashes.look_up(key)) or self._fingerprint

    def _files_key(self) -> str | None:
        files = getattr(self.source, "files", ())
        return known_hashes.key_of(files, getattr(self.source, "variant", ""))

    @cached_property
    def _fingerprint(self) -> str:
        recipe = getattr(self.source, "recipe", None)  # random weights
        if recipe is not None:
            return hashlib.sha256(str(recipe).encode()).hexdigest()
        stored: str | None = getattr(self.source, "weights_sha256", None)  # an ONNX export tells it
        if stored is not None:
            return stored
        key = self._files_key()
        hashes = {name: hashlib.sha256() for name in self.source.shapes}
        for piece in self.source.pieces(torch.device("cpu")):
            values = piece.values.to(torch.float32).contiguous()
            hashes[piece.name].update(values.numpy().data)
        lines = [
            f"{name} {list(self.source.shapes[name])} {digest.hexdigest()}" for name, digest in sorted(hashes.items())
        ]
        if getattr(self.source, "variant", "") == "head" and (head := self._untied_head()) is not None:
            digest = hashlib.sha256(head.to(torch.float32).contiguous().numpy().data)
            lines.append(f"lm_head {list(head.shape)} {digest.hexdigest()}")
        fingerprint = hashlib.sha256("\n".join(lines).encode()).hexdigest()
        if key is not None and key == self._files_key():  # nobody changed them meanwhile
            known_hashes.remember(key, fingerprint)
        return fingerprint

    @property
    def stored_bytes(self) -> int:
        """Bytes of the model's weights as they are stored (uncompressed)."""
        return describe_weights(self.source)["stored_bytes"]

    def info(self) -> dict[str, Any]:
        """What `turbopi inspect` prints, as plain JSON types."""
        return {
            **describe_weights(self.source),
            "path": None if self.path is None else str(self.path),
            "random_weights": self.random is not None,
            "weights": self.short_hash,
            "kind": self.config.model.kind,
            "sizes": model_sizes_info(self.config),
            "name": self.config.name,
            "config_source": self.config_source,
            "robot": self.config.robot,
            "action_horizon": self.config.model.action_horizon,
            **self._loop,
            "max_prompt_tokens": self.config.model.max_prompt_tokens,
            "discrete_state_input": self.config.discrete_state_input,
            "memory": None if (memory := memory_of(self.config.model)) is None else asdict(memory),
            "text": None if self.config.text is None else asdict(self.config.text),
            "normalization": {
                "state": self.config.normalization.state,
                "actions": self.config.normalization.actions,
            },
            "asset_id": self.asset_id,
            "norm_stats": norm_stats_info(self.norm_stats),
            "tokenizers": [str(file) for file in self.tokenizer_candidates or self._named_tokenizer],
        }


def put(target: Tensor, piece: Piece) -> Tensor:
    """Copy a piece into its place, rounding to the target's dtype. That place."""
    values = piece.values
    if not values.is_contiguous() and values.dtype != target.dtype:
        values = values.to(target.dtype)  # torch transposes within one dtype much faster than across two
    place = target[piece.start : piece.start + values.shape[0]] if values.ndim else target
    return place.copy_(values)


def describe_weights(source: WeightSource) -> dict[str, Any]:
    """What is known of weights without any configuration."""
    itemsize = {"F32": 4, "BF16": 2, "F16": 2}
    counts = {name: prod(shape) for name, shape in source.shapes.items()}
    parameters: dict[str, int] = dict.fromkeys((*PARTS, "action_time"), 0)
    for name, count in counts.items():
        part = name.split(".", 1)[0]
        parameters[part if part in PARTS else "action_time"] += count
    return {
        "format": source.format,
        "parameters": {**parameters, "total": sum(counts.values())},
        "tensors": len(counts),
        "stored_dtypes": sorted(set(source.dtypes.values())),
        "stored_bytes": sum(count * itemsize.get(source.dtypes[name], 1) for name, count in counts.items()),
        "notes": list(source.notes),
    }


def model_sizes_info(config: PolicyConfig) -> dict[str, Any]:
    model = config.model
    if not isinstance(model, ModelConfig):
        return asdict(model) | {"vocab_size": model.vocab_size}
    gemma = ("width", "mlp_dim", "depth", "num_heads", "num_kv_heads", "head_dim")
    vision = ("width", "depth", "mlp_dim", "num_heads", "patch_size", "image_size")
    return {
        "vision": {key: getattr(model.vision, key) for key in vision},
        "vlm": {key: getattr(model.vlm, key) for key in gemma},
        "expert": {key: getattr(model.expert, key) for key in gemma},
        "vocab_size": model.vocab_size,
        "action_dim": model.action_dim,
    }


def norm_stats_info(stats: NormStats) -> dict[str, Any]:
    return {
        name: None
        if feature is None
        else {
            "dim": feature.dim,
            "statistics": list(feature.available),
            "values": {one: getattr(feature, one).tolist() for one in feature.available},
        }
        for name, feature in (("state", stats.state), ("actions", stats.actions))
    }


# -- progress ----------------------------------------------------------------------------------------------------------


class Advance(Protocol):
    """A progress bar, or nothing."""

    def update(self, count: int) -> None: ...


class _Silent:
    def update(self, count: int) -> None:
        pass


class _Bar:
    def __init__(self, progress: Progress, description: str, total: int) -> None:
        self._progress = progress
        self._task = progress.add_task(description, total=total)

    def update(self, count: int) -> None:
        self._progress.advance(self._task, count)


@contextmanager
def progress_bar(shown: bool, description: str, total: int) -> Iterator[Advance]:
    if not shown:
        yield _Silent()
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        yield _Bar(progress, description, total)
