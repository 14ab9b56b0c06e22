"""A certificate: what `turbopi verify` writes as verify.json, one definition for all who write and read it.

docs/verify.md tells what its numbers mean. JSON has neither infinity nor NaN: a number that isn't finite is None.
"""

import math
from collections.abc import Mapping
from typing import Annotated

from msgspec import Meta, Struct

from turbopi.quantization.formats import named_by
from turbopi.support.provenance import Provenance

Number = float | None
Count = Annotated[int, Meta(ge=0)]


def finite(value: float) -> Number:
    return value if math.isfinite(value) else None


class ErrorsDocument(Struct, frozen=True, kw_only=True):
    """A tensor's difference from the reference's, pooled over all calls."""

    relative_rms: Number  # over the reference's own rms
    cosine: Number
    rms: Number
    max: Number
    finite: bool


class ActionsControl(ErrorsDocument, frozen=True, kw_only=True):
    deltas_cosine: Number


class Deltas(Struct, frozen=True):
    """Of what denoising did: actions less noise."""

    cosine: Number
    relative_rms: Number


class WorstCall(Struct, frozen=True, kw_only=True):
    """The call whose actions are furthest off."""

    observation: str
    seed: int  # of its noise
    relative_rms: Number
    cosine: Number
    rms: Number
    max: Number
    finite: bool


class Dimension(Struct, frozen=True):
    """One number of an action, in the robot's unit."""

    index: int
    name: str
    unit: str
    rms: Number
    max: Number
    control_rms: Number
    control_max: Number


class ActionsDocument(ErrorsDocument, frozen=True, kw_only=True):
    deltas: Deltas
    control: ActionsControl
    worst: WorstCall
    dimensions: list[Dimension]


class IntermediateDocument(Struct, frozen=True, kw_only=True):
    """One named intermediate, at one layer or step (`index`) where it has them, in the flow of data."""

    name: str
    index: int | None
    relative_rms: Number
    cosine: Number
    rms: Number
    max: Number
    finite: bool
    allowed: Number  # of its relative rms; it decides about the actions alone. None: nothing is held to it
    control: ErrorsDocument | None  # None: the control doesn't show it

    @property
    def badness(self) -> float:
        """Its relative rms in proportion to what is allowed."""
        error = math.inf if self.relative_rms is None else self.relative_rms
        return error / self.allowed if self.allowed else error

    @property
    def above(self) -> bool:
        """Whether it is more than is allowed."""
        return self.allowed is not None and (self.relative_rms is None or self.relative_rms > self.allowed)


class Check(Struct, frozen=True):
    """One of the things that decide."""

    name: str  # "signal", "actions" or "logits", "answers", "deltas", "finite", "determinism"
    ok: bool
    value: int | float | None
    bound: int | float | None
    text: str


class Bounds(Struct, frozen=True):
    actions_relative_rms: Number
    factor_of_control: float | None  # None: the bound isn't a multiple of the control's error
    reason: str
    deltas_cosine: float | None  # the least; None: no bound on it
    overridden: bool  # given by the user
    suspect_factor: float | None
    jump: float


class SuspectDocument(Struct, frozen=True):
    """The first intermediate that is further off than its inputs and rounding explain."""

    name: str
    index: int | None
    relative_rms: Number
    control_relative_rms: Number
    why: str
    text: str


class Determinism(Struct, frozen=True):
    """Calls that were made again, in order and in reverse."""

    calls: Count
    identical: Count  # bit for bit
    max: float  # the largest difference of an action
    differing: str | None  # the first observation that differed


class Judged(Struct, frozen=True, kw_only=True):
    """Checks, verdict, errors and their controls."""

    ok: bool
    verdict: str
    checks: list[Check]
    bounds: Bounds
    first_off: SuspectDocument | None
    actions: ActionsDocument
    intermediates: list[IntermediateDocument]
    determinism: Determinism
    decides: str = "actions"  # what is held to the bound; "logits" of models that write their actions as tokens


class Latency(Struct, frozen=True):
    """Milliseconds of a call, from host to host."""

    calls: Count
    p50: float
    p95: float


class Latencies(Struct, frozen=True):
    backend: Latency
    oracle: Latency


class ObservationsDocument(Struct, frozen=True):
    """What it was run on."""

    calibrated_on: int | None  # how many the calibration was made on, too; None: no calibration
    path: str | None  # None: Turbo-Pi's own
    count: Count
    names: list[str]
    sha256: str  # of all of the model's inputs
    noises: Count  # for each observation
    seed: int  # of the first noise


class WeightsDocument(Struct, frozen=True):
    path: str | None
    format: str
    random: bool
    fingerprint: str | None  # None: not hashed


class CalibrationDetails(Struct, frozen=True):
    """What a policy in FP8 or INT8 tells of its calibration."""

    plan: Mapping[str, object]  # group of sites -> what it runs in; an object: its sites differ
    calibration: str
    identity: str
    observations: str


class Certificate(Judged, frozen=True, kw_only=True):
    """verify.json."""

    model: str
    backend: str
    precision: str
    steps: int  # of denoising
    oracle: str
    oracle_float32: Mapping[str, object]  # PyTorch's settings for float32's products: models/pi0/exact.py
    control: str
    not_exposed: list[str]  # the reference's intermediates that the backend doesn't show
    latency_ms: Latencies
    warmup_seconds: float
    gpu_bytes: int | None  # after all calls: weights, and all else that stays
    observations: ObservationsDocument
    weights: WeightsDocument
    policy: Mapping[str, object]  # the policy's metadata
    provenance: Provenance

    @property
    def calibrated(self) -> Mapping[str, object] | None:
        """What the backend tells of its calibration, as it tells it (`CalibrationDetails`); None: it has none."""
        return named_by(self.policy.get("backend_details"))
