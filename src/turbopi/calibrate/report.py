"""What a calibration says of itself: the file's `report`, which goes with it into every policy's metadata."""

from collections.abc import Mapping
from typing import Annotated

from msgspec import Meta, Struct, field

from turbopi.quantization.formats import Numbers
from turbopi.support.errors import CalibrationError
from turbopi.support.reading import as_document

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


class _HeldOut(Struct, frozen=True):
    """What all formats have."""

    def errors(self) -> dict[str, ActionsError]:
        """All but the worst call's, by the name that the file has for each."""
        names = zip(self.__struct_fields__, self.__struct_encode_fields__, strict=True)
        found = {name: getattr(self, own) for own, name in names if own != "worst"}
        return {name: error for name, error in found.items() if error is not None}


class HeldOut(_HeldOut, frozen=True, omit_defaults=True):
    """Of FP8, on observations that chose nothing. The sites that are kept run in float32 here."""

    fp8: ActionsError
    fp8_mlp: ActionsError = field(name="fp8-mlp")
    vision: ActionsError = field(name="fp8 in the vision alone")
    prefix: ActionsError = field(name="fp8 in the prefix alone")
    expert: ActionsError = field(name="fp8 in the expert alone")
    bf16: ActionsError
    fp8_against_bf16: ActionsError = field(name="fp8 against bf16")
    worst: WorstCall
    f16sums: ActionsError | None = field(name="fp8-f16sums", default=None)  # not in older files


class Int8HeldOut(_HeldOut, frozen=True):
    """The same of INT8."""

    int8: ActionsError
    vision: ActionsError = field(name="int8 in the vision alone")
    prefix: ActionsError = field(name="int8 in the prefix alone")
    expert: ActionsError = field(name="int8 in the expert alone")
    bf16: ActionsError
    int8_against_bf16: ActionsError = field(name="int8 against bf16")
    worst: WorstCall


class Nvfp4HeldOut(_HeldOut, frozen=True):
    """The same of NVFP4, which the expert hasn't."""

    nvfp4: ActionsError
    vision: ActionsError = field(name="nvfp4 in the vision alone")
    prefix: ActionsError = field(name="nvfp4 in the prefix alone")
    bf16: ActionsError
    nvfp4_against_bf16: ActionsError = field(name="nvfp4 against bf16")
    worst: WorstCall


class CalibrationReport(Struct, frozen=True):
    """As `turbopi calibrate` writes it of FP8.

    methods         of each way to choose scales, on the calls that sites are chosen on
    groups_alone    with one group of sites rounded
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


class Int8CalibrationReport(CalibrationReport, frozen=True):
    """The same of INT8."""

    held_out: Int8HeldOut  # type: ignore[assignment]


class Nvfp4CalibrationReport(CalibrationReport, frozen=True):
    """The same of NVFP4."""

    held_out: Nvfp4HeldOut  # type: ignore[assignment]


_REPORTS: Mapping[Numbers, type[CalibrationReport]] = {
    "fp8": CalibrationReport,
    "int8": Int8CalibrationReport,
    "nvfp4": Nvfp4CalibrationReport,
}


def read_report(
    report: Mapping[str, object], numbers: Numbers = "fp8", source: object = "the calibration's report"
) -> CalibrationReport:
    """Of `Quantization.report`, whose `numbers` say of what. Raises CalibrationError for a report that today's
    `turbopi calibrate` doesn't write.
    """
    return as_document(report, _REPORTS[numbers], source, CalibrationError)
