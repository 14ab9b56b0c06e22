"""FP8's certificates at full size, without a checkpoint: `python -m turbopi_lab.studies.certificates --out DIR`.

For each kind of weights (studies/weights.py): a calibration on varied LIBERO images, then `verify` in both tiers on
other ones, each cut down to what fits in a table.
"""

import argparse
import json
import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
import torch
from msgspec import Struct

from turbopi import backends
from turbopi.backends import Precision
from turbopi.calibrate.run import Settings, calibrate
from turbopi.checkpoint import Checkpoint
from turbopi.policy import shipped
from turbopi.quantization.calibration_file import Quantization
from turbopi.quantization.plan import FP8_TIERS, HALF_SUMS
from turbopi.recordings import RecordedCall, save_call
from turbopi.support.files import write_whole
from turbopi.support.reading import plain_document
from turbopi.verify.document import (
    ActionsControl,
    Bounds,
    Certificate,
    Check,
    Deltas,
    Determinism,
    Number,
    SuspectDocument,
    WorstCall,
)
from turbopi.verify.inputs import VerifyPlan
from turbopi.verify.run import verify
from turbopi_lab.studies.weights import WEIGHTS, Weights, studied_checkpoint

_MOST_SHIFT = 20  # pixels


def varied(seed: int, count: int) -> Iterator[dict[str, np.ndarray | str]]:
    """Observations made of the packaged LIBERO frames: shifted, relit, with another state."""
    frames, rng = shipped.load_frames(), np.random.default_rng(seed)
    for number in range(count):
        frame = frames[number % len(frames)]
        yield {
            "observation/image": _varied(frame.base, rng),
            "observation/wrist_image": _varied(frame.wrist, rng),
            "observation/state": frame.state + rng.normal(0.0, 0.02, frame.state.shape),
            "prompt": frame.prompt,
        }


def _varied(camera_image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    shift = tuple(rng.integers(-_MOST_SHIFT, _MOST_SHIFT + 1, 2))
    return np.clip(np.roll(camera_image, shift, (0, 1)) * rng.uniform(0.7, 1.3), 0, 255).astype(np.uint8)


def _record(folder: Path, seed: int, count: int) -> Path:
    folder.mkdir()
    for number, observation in enumerate(varied(seed, count)):
        save_call(folder / f"{number:06d}.npz", RecordedCall(observation, {}, 0.0))
    return folder


def certify(
    checkpoint: Checkpoint,
    quantization: Quantization,
    tiers: Sequence[Precision],
    device: torch.device,
    observations: Path,
    noises: int,
) -> Iterator[tuple[Precision, Certificate]]:
    """A certificate of `fused` for each tier."""
    for tier in tiers:
        arguments = {"backend": "fused", "precision": tier, "quantization": quantization, "device": str(device)}
        yield tier, verify(checkpoint, VerifyPlan(arguments, observations, noises=noises))


class CondensedActions(Struct, frozen=True):
    """`ActionsDocument` without its dimensions."""

    relative_rms: Number
    cosine: Number
    max: Number
    deltas: Deltas
    control: ActionsControl
    worst: WorstCall


class CondensedDimension(Struct, frozen=True):
    """In the robot's unit."""

    rms: Number
    max: Number
    bf16_rms: Number


class WorstPlace(Struct, frozen=True):
    """The layer or step (`at`) where an intermediate is furthest off."""

    at: int | None
    relative_rms: Number
    control: Number
    cosine: Number


class CondensedObservations(Struct, frozen=True):
    count: int
    noises: int
    seed: int
    sha256: str


class CondensedCertificate(Struct, frozen=True):
    """A certificate without what a reader of tables doesn't need: four digits, of cosines seven."""

    verdict: str
    model: str
    backend: str
    precision: str
    steps: int
    oracle: str
    control: str
    bounds: Bounds
    checks: list[Check]
    first_off: SuspectDocument | None
    actions: CondensedActions
    dimensions: dict[str, CondensedDimension]  # by name and unit
    intermediates: dict[str, WorstPlace]  # by name
    determinism: Determinism
    gpu_bytes: int | None
    weights: str | None  # their fingerprint
    observations: CondensedObservations
    fp8: Mapping[str, object] | None
    random_weights: bool


def condensed(certificate: Certificate) -> CondensedCertificate:
    worst: dict[str, WorstPlace] = {}
    for row in certificate.intermediates:
        before = worst.get(row.name)
        if before is None or _size(row.relative_rms) > _size(before.relative_rms):
            control = None if row.control is None else row.control.relative_rms
            worst[row.name] = WorstPlace(row.index, row.relative_rms, control, row.cosine)
    actions, seen = certificate.actions, certificate.observations
    whole = CondensedCertificate(
        verdict=certificate.verdict,
        model=certificate.model,
        backend=certificate.backend,
        precision=certificate.precision,
        steps=certificate.steps,
        oracle=certificate.oracle,
        control=certificate.control,
        bounds=certificate.bounds,
        checks=certificate.checks,
        first_off=certificate.first_off,
        actions=CondensedActions(
            actions.relative_rms, actions.cosine, actions.max, actions.deltas, actions.control, actions.worst
        ),
        dimensions={
            f"{one.name} [{one.unit}]": CondensedDimension(one.rms, one.max, one.control_rms)
            for one in actions.dimensions
        },
        intermediates=worst,
        determinism=certificate.determinism,
        gpu_bytes=certificate.gpu_bytes,
        weights=certificate.weights.fingerprint,
        observations=CondensedObservations(seen.count, seen.noises, seen.seed, seen.sha256),
        fp8=certificate.calibrated,
        random_weights=certificate.weights.random,
    )
    return msgspec.convert(_rounded(plain_document(whole)), CondensedCertificate)


def _size(error: Number) -> float:
    return math.inf if error is None else error


def _rounded(value: object) -> object:
    """Four digits, of cosines seven: more is noise here."""
    if isinstance(value, Mapping):
        return {name: _rounded(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        return None  # JSON has no such number
    return round(value, 7) if 0.9 < abs(value) <= 1 else float(f"{value:.4g}")


def run(
    out: Path,
    kinds: Sequence[Weights],
    tiers: Sequence[Precision],
    *,
    preset: str = "pi05_libero",
    device: str = "auto",
    calibration: int = 16,
    verification: int = 4,
    noises: int = 2,
) -> bool:
    """Whether all pass. certificates.json and every calibration are written into `out` as they come."""
    passed = True
    on = backends.resolve_device(device)
    out.mkdir(parents=True, exist_ok=True)
    found: dict[str, dict[str, object]] = {}
    document: dict[str, object] = {"preset": preset, "calibration_observations": calibration, "certificates": found}
    with tempfile.TemporaryDirectory() as temporary:
        seen = _record(Path(temporary) / "calibration", 0, calibration)
        unseen = _record(Path(temporary) / "verification", 1, verification)
        for kind in kinds:
            checkpoint = studied_checkpoint(kind, preset, on)
            quantization = calibrate(checkpoint, Settings({"device": str(on)}, str(seen), calibration))
            quantization.save(out / f"{kind.replace(' ', '_')}.json")
            of_kind = found.setdefault(kind, {})
            of_kind["calibration"] = _rounded(
                {name: quantization.report[name] for name in ("method", "groups_alone", "held_out", "seconds")}
            )
            for tier, certificate in certify(checkpoint, quantization, tiers, on, unseen, noises):
                document["provenance"] = plain_document(certificate.provenance)
                of_kind[tier] = plain_document(condensed(certificate))
                passed = passed and certificate.ok
                print(f"{kind}, {tier}: {certificate.verdict}", flush=True)
                text = json.dumps(document, indent=1, ensure_ascii=False)
                write_whole(out / "certificates.json", text + "\n")
    return passed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="pi05_libero")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--weights", choices=WEIGHTS, action="append", help="one kind; may be given again")
    parser.add_argument("--tier", choices=FP8_TIERS, action="append", help="one tier; may be given again")
    parser.add_argument("--calibration", type=int, default=16, help="observations to calibrate on")
    parser.add_argument("--verification", type=int, default=4, help="others to verify on")
    parser.add_argument("--noises", type=int, default=2, help="for each of these")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    passed = run(
        options.out,
        options.weights or WEIGHTS[1:],
        options.tier or [tier for tier in FP8_TIERS if tier != HALF_SUMS],  # which Hopper's kernels haven't
        preset=options.preset,
        device=options.device,
        calibration=options.calibration,
        verification=options.verification,
        noises=options.noises,
    )
    raise SystemExit(not passed)


if __name__ == "__main__":
    main()
