"""Writing a folder whose weights stay in eight bits: see `checkpoint.quantized_folder` for what is in it.

Matrices are rounded as they are read, by the code that `fused` rounds them with, so a policy of the folder has the bits
of one that rounds by itself on the same kind of device. Rounding for directions on a CPU and on a GPU may differ.
"""

import json
import os
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from turbopi.checkpoint.base import Checkpoint
from turbopi.checkpoint.convert import check_new, write_beside
from turbopi.checkpoint.quantized_folder import FORMAT, MANIFEST, TENSORS, VERSION, file_sha256, sealed, tensors_of
from turbopi.checkpoint.source import RANDOM_KEY
from turbopi.checkpoint.tensor_file import TensorFile
from turbopi.engine.graph import preparing
from turbopi.engine.weight_placement import WeightPlacement
from turbopi.kernels.portable.quantize import round_channels
from turbopi.quantization.calibration_file import Quantization
from turbopi.quantization.fp8 import ScaledMatrix
from turbopi.quantization.plan import PrecisionPlan, Tier
from turbopi.quantization.sites import PARTS
from turbopi.support.errors import ConfigError
from turbopi.support.files import new_folder
from turbopi.support.provenance import provenance


def write_quantized(
    checkpoint: Checkpoint,
    dst: str | Path,
    calibration: Quantization,
    precision: Tier,
    device: torch.device,
    *,
    progress: bool = False,
) -> Path:
    """Write a checkpoint in a calibrated precision to the new folder `dst`, whole or not at all; returns `dst`.

    calibration  of this checkpoint, checked (`checkpoint.calibration.for_policy`), of all parts
    device       where weights are rounded: the kind that the policy will run on

    Raises ConfigError for calibrations of some parts alone and what turbopi.json can't say, CheckpointError if `dst`
    exists and isn't an empty folder, or as `Checkpoint.load`.
    """
    dst = check_new(dst)
    if calibration.parts != PARTS:
        raise ConfigError("a folder in eight bits has all parts that its calibration allows: leave out the parts")
    config = checkpoint.config.planned_model
    plan = calibration.plan(config, precision)
    fingerprint = checkpoint.fingerprint(trust_files=True)
    with new_folder(dst) as folder, preparing(device):
        write_beside(checkpoint, folder)
        with (folder / TENSORS).open("wb") as out:
            tensors = tensors_of(config, plan)
            marks = {} if checkpoint.random is None else {RANDOM_KEY: checkpoint.random}
            room = _Room(checkpoint, device, plan, TensorFile(out, tensors, marks), set(tensors))
            checkpoint.load(room, "bf16", progress=progress)
            assert room.written == set(tensors), room.written ^ set(tensors)
            out.flush()
            os.fsync(out.fileno())
        own = f"turbopi_{plan.format.name}.json"
        calibration.save(folder / own)
        about = provenance(device)
        manifest = {
            "format": FORMAT,
            "version": VERSION,
            "precision": precision,
            "weights_sha256": fingerprint,
            "calibration_file": own,
            "calibration": calibration.identity,
            "rounded_on": torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU",
            "random_weights": checkpoint.random,
            "bytes": (folder / TENSORS).stat().st_size,
            "file_sha256": file_sha256(folder / TENSORS),
            "sizes": asdict(config),
            "versions": {"turbopi": about.turbopi, "torch": about.torch, "triton": about.triton},
        }
        written = sealed(json.loads(json.dumps(manifest)))  # with lists for tuples, as it is read
        (folder / MANIFEST).write_text(json.dumps(written, indent=1) + "\n")
    return dst


class _Room(WeightPlacement):
    """Where weights are read to, to be written: one after the other, and nothing stays."""

    def __init__(
        self, checkpoint: Checkpoint, device: torch.device, plan: PrecisionPlan, file: TensorFile, names: set[str]
    ) -> None:
        super().__init__(checkpoint.config.planned_model, device, lambda name: True, self._round, parts=PARTS)
        self._plan, self._file, self._names = plan, file, names
        self._rounded = frozenset(plan.rounded)
        self.written: set[str] = set()

    def takes(self, name: str) -> bool:
        return True

    def take(self, name: str, tensor: Tensor) -> None:
        if name in self._names:
            self._write(name, tensor)
        if name in self._places and self._places[name] in self._rounded:
            super().take(name, tensor)

    def _round(self, place: str, matrix: Tensor) -> Tensor:
        made: ScaledMatrix = round_channels(matrix, self._plan.directions.get(place), self._plan.format)
        self._write(f"{place}.codes", made.data)
        self._write(f"{place}.scale", made.scale)
        return matrix.new_empty(0, 0)  # no view, which would keep it

    def _write(self, name: str, tensor: Tensor) -> None:
        self._file.write(name, tensor)
        self.written.add(name)
