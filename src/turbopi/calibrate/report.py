"""What a calibration says of itself: the file's `report`, which goes with it into every policy's metadata."""

from collections.abc import Mapping
from typing import Annotated, Final

from msgspec import Meta, Struct, field

from turbopi.errors import CalibrationError
from turbopi.reading import as_document

Count = Annotated[int, Meta(ge=0)]


class ActionsError(Struct, frozen=True):
    """How far actions are from float32's, normalised."""

    relative_rms: float
    delta_cosine: float
    max: float


class ObservationsSeen(Struct, frozen=True):
    """`calibration` and `held_out`: by its source each observation's SHA-256."""

    source: str
    count: Count
    noises: Count
    seed: int
    calibration: dict[str, str]
    held_out: dict[str, str]


class WorstCall(Struct, frozen=True):
    observation: str
    seed: int
    relative_rms: float


class HeldOut(Struct, frozen=True):
    """On observations that chose nothing. The sites that are kept run in float32 here."""

    fp8: ActionsError
    fp8_mlp: ActionsError = field(name="fp8-mlp")
    vision: ActionsError = field(name="fp8 in the vision alone")
    prefix: ActionsError = field(name="fp8 in the prefix alone")
    expert: ActionsError = field(name="fp8 in the expert alone")
    bf16: ActionsError
    fp8_against_bf16: ActionsError = field(name="fp8 against bf16")
    worst: WorstCall

    def errors(self) -> dict[str, ActionsError]:
        """All but the worst call's, by the name that the file has for each."""
        return {name: getattr(self, own) for own, name in _NAMES_OF_ERRORS.items()}


_NAMES_OF_ERRORS: Final = {
    own: name
    for own, name in zip(HeldOut.__struct_fields__, HeldOut.__struct_encode_fields__, strict=True)
    if own != "worst"
}


class CalibrationReport(Struct, frozen=True):
    """As `turbopi calibrate` writes it.

    methods         of each way to choose scales, on the calls that sites are chosen on
    groups_alone    with one group of sites in FP8
    kept_in_bf16    by site the reason
    target          cosine of the actions' deltas
    target_reached  None where observations were random noise
    """

    turbopi: str
    model: str
    random_weights: bool
    device: str
    observations: ObservationsSeen
    steps: Count
    method: str
    methods: dict[str, ActionsError]
    groups_alone: dict[str, ActionsError]
    kept_in_bf16: dict[str, str]
    target: float
    target_reached: bool | None
    held_out: HeldOut
    warnings: list[str]
    seconds: dict[str, float]


def read_report(report: Mapping[str, object], source: object = "the calibration's report") -> CalibrationReport:
    """Of `Quantization.report`. Raises CalibrationError for a report that today's `turbopi calibrate` doesn't write."""
    return as_document(report, CalibrationReport, source, CalibrationError)
