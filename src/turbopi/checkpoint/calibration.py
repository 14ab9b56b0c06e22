"""A checkpoint's calibration: found beside its weights or given, and held against them."""

import logging
from collections import Counter
from pathlib import Path
from typing import Any

from turbopi.checkpoint.base import Checkpoint
from turbopi.checkpoint.quantized_folder import QuantizedSource
from turbopi.models import family_of
from turbopi.quantization.calibration_file import Quantization, check_given
from turbopi.quantization.formats import Numbers
from turbopi.quantization.plan import TIERS, format_of
from turbopi.support.errors import ConfigError

logger = logging.getLogger(__name__)

# in a checkpoint's folder: found there unless another file is named
BESIDE: dict[Numbers, str] = {"fp8": "turbopi_fp8.json", "int8": "turbopi_int8.json", "nvfp4": "turbopi_nvfp4.json"}


def for_policy(given: "str | Path | Quantization | None", tier: str, checkpoint: Checkpoint) -> Quantization | None:
    """The calibration that a policy in this precision runs with, checked against its checkpoint; None: it needs none.

    Hashes all weights, which takes some seconds at full size, unless their files were hashed before. Raises
    ConfigError if there is none, CalibrationError if it doesn't fit.
    """
    quantization = calibration_of(given, tier, checkpoint)
    if quantization is None:
        return None
    if checkpoint.path is None:  # then `calibration_of` has checked the shapes alone
        quantization.check(_sizes(checkpoint), checkpoint.fingerprint(trust_files=True))
    for warning in quantization.warnings:
        logger.warning("%s: %s", quantization.format.label, warning)
    return quantization


def calibration_of(given: "str | Path | Quantization | None", tier: str, checkpoint: Checkpoint) -> Quantization | None:
    """What `for_policy` takes, checked before any work: against the weights only if they are on disk.

    Raises ConfigError too where it leaves no site at all in eight bits: such a policy would be bfloat16 with
    another name.
    """
    kept = checkpoint.source if isinstance(checkpoint.source, QuantizedSource) else None
    if kept is not None:
        kept.check(tier, None)
    if tier not in TIERS:
        check_given(tier, given)
        return None
    model = _sizes(checkpoint)
    if given is None:
        numbers = format_of(tier).name
        beside = None if checkpoint.path is None else checkpoint.path / BESIDE[numbers]
        if beside is None or not beside.is_file():
            raise ConfigError(
                f"precision {tier!r} needs a calibration: run `turbopi calibrate --precision {numbers}` on this "
                f"checkpoint and give the file that it writes (--quantization FILE, or as {BESIDE[numbers]} beside the "
                "weights)"
            )
        given = beside
    quantization = given if isinstance(given, Quantization) else Quantization.load(given)
    if kept is not None:
        kept.check(tier, quantization)
    if checkpoint.path is None:  # weights would have to be made to be hashed
        quantization.check_shapes(model)
    else:
        quantization.check(model, checkpoint.fingerprint(trust_files=True))
    plan = quantization.plan(model, tier)
    if not plan.scales:
        reasons = "; ".join(f"{count} sites: {why}" for why, count in Counter(plan.kept.values()).items())
        raise ConfigError(
            f"{quantization.source or 'the calibration'} leaves nothing in {tier} ({reasons}); take 'bf16'"
        )
    return quantization


def _sizes(checkpoint: Checkpoint) -> Any:
    """Raises ConfigError for a model that no calibration is for."""
    if not (family := family_of(checkpoint.config.model)).tiers:
        raise ConfigError(f"{checkpoint.config.name} is {family.label}, which has no calibrations; take 'bf16'")
    return checkpoint.config.model
