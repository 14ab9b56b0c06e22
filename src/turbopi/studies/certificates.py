"""FP8's certificates at full size, without a checkpoint: `python -m turbopi.studies.certificates --out DIR`.

For each kind of weights (studies/weights.py): a calibration on varied LIBERO pictures, then `verify` in both tiers on
other ones, each cut down to what fits in a table.
"""

import argparse
import json
import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from turbopi import backends, shipped
from turbopi.backends import Precision
from turbopi.calibrate.run import Settings, calibrate
from turbopi.checkpoint import Checkpoint
from turbopi.files import write_whole
from turbopi.quantization.artifact import Quantization
from turbopi.quantization.plan import TIERS
from turbopi.recordings import RecordedCall, save_call
from turbopi.studies.weights import WEIGHTS, Weights, studied_checkpoint
from turbopi.verify.inputs import VerifyPlan
from turbopi.verify.run import verify

_MOST_SHIFT = 20  # pixels


def varied(seed: int, count: int) -> Iterator[dict[str, Any]]:
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


def _varied(picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    shift = tuple(rng.integers(-_MOST_SHIFT, _MOST_SHIFT + 1, 2))
    return np.clip(np.roll(picture, shift, (0, 1)) * rng.uniform(0.7, 1.3), 0, 255).astype(np.uint8)


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
) -> Iterator[tuple[Precision, dict[str, Any]]]:
    """A certificate of `fused` for each tier."""
    for tier in tiers:
        arguments = {"backend": "fused", "precision": tier, "quantization": quantization, "device": str(device)}
        yield tier, verify(checkpoint, VerifyPlan(arguments, observations, noises=noises))


def condensed(document: Mapping[str, Any]) -> dict[str, Any]:
    """A certificate without what a reader of tables doesn't need: intermediates by name, their worst layer or step."""
    worst: dict[str, dict[str, Any]] = {}
    for row in document["intermediates"]:
        name = row["name"]
        if name not in worst or row["relative_rms"] > worst[name]["relative_rms"]:
            control = row["control"] or {}
            worst[name] = {
                "at": row["index"],
                "relative_rms": row["relative_rms"],
                "control": control.get("relative_rms"),
                "cosine": row["cosine"],
            }
    actions = document["actions"]
    kept = ("verdict", "model", "backend", "precision", "steps", "oracle", "control", "bounds", "checks", "first_off")
    return _rounded(
        {name: document[name] for name in kept}
        | {
            "actions": {
                name: actions[name] for name in ("relative_rms", "cosine", "max", "deltas", "control", "worst")
            },
            "dimensions": {
                f"{one['name']} [{one['unit']}]": {"rms": one["rms"], "max": one["max"], "bf16_rms": one["control_rms"]}
                for one in actions["dimensions"]
            },
            "intermediates": worst,
            "determinism": document["determinism"],
            "gpu_bytes": document["gpu_bytes"],
            "weights": document["weights"]["fingerprint"],
            "observations": {name: document["observations"][name] for name in ("count", "noises", "seed", "sha256")},
            "fp8": document["policy"]["backend_details"].get("fp8"),
            "random_weights": document["weights"]["random"],
        }
    )


def _rounded(value: Any) -> Any:
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
) -> dict[str, Any]:
    """All of them; certificates.json and every calibration are written into `out` as they come."""
    on = backends.resolve_device(device)
    out.mkdir(parents=True, exist_ok=True)
    document: dict[str, Any] = {"preset": preset, "calibration_observations": calibration, "certificates": {}}
    with tempfile.TemporaryDirectory() as temporary:
        seen = _record(Path(temporary) / "calibration", 0, calibration)
        unseen = _record(Path(temporary) / "verification", 1, verification)
        for kind in kinds:
            checkpoint = studied_checkpoint(kind, preset, on)
            quantization = calibrate(checkpoint, Settings({"device": str(on)}, str(seen), calibration))
            quantization.save(out / f"{kind.replace(' ', '_')}.json")
            found = document["certificates"].setdefault(kind, {})
            found["calibration"] = _rounded(
                {name: quantization.report[name] for name in ("method", "groups_alone", "held_out", "seconds")}
            )
            for tier, certificate in certify(checkpoint, quantization, tiers, on, unseen, noises):
                document["provenance"] = certificate["provenance"]
                found[tier] = condensed(certificate)
                print(f"{kind}, {tier}: {certificate['verdict']}", flush=True)
                text = json.dumps(document, indent=1, ensure_ascii=False)
                write_whole(out / "certificates.json", text + "\n")
    return document


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="pi05_libero")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--weights", choices=WEIGHTS, action="append", help="one kind; may be given again")
    parser.add_argument("--tier", choices=TIERS, action="append", help="one tier; may be given again")
    parser.add_argument("--calibration", type=int, default=16, help="observations to calibrate on")
    parser.add_argument("--verification", type=int, default=4, help="others to verify on")
    parser.add_argument("--noises", type=int, default=2, help="for each of these")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    document = run(
        options.out,
        options.weights or WEIGHTS[1:],
        options.tier or TIERS,
        preset=options.preset,
        device=options.device,
        calibration=options.calibration,
        verification=options.verification,
        noises=options.noises,
    )
    tiers = [one for kind in document["certificates"].values() for name, one in kind.items() if name in TIERS]
    raise SystemExit(not all(one["verdict"].startswith("PASS") for one in tiers))


if __name__ == "__main__":
    main()
