"""What `python -m kernel_turns time --json` writes."""

from pathlib import Path

from msgspec import UNSET, Struct, UnsetType

from turbopi.support.errors import ConfigError
from turbopi.support.provenance import Provenance
from turbopi.support.reading import read_document


class TimedVariant(Struct, frozen=True):
    """One variant on one problem: milliseconds of ten steps, relative rms of the actions' error to float32, whether
    they equal the first variant's to the last bit, the clock during the last launch.
    """

    tokens: int
    precision: str
    length: int  # valid prefix tokens
    variant: str
    milliseconds: float  # the median of the rounds
    fastest: float
    error: float
    same: bool
    mhz: float


class MarkedVariant(Struct, frozen=True):
    """Cycles of a layer up to each mark of the kernel, by rank."""

    tokens: int
    precision: str
    variant: str
    warp: int
    cycles: dict[str, list[float]]


class TurnsDocument(Struct, frozen=True):
    """marks: none unless they were asked for; older files don't say."""

    provenance: Provenance
    rows: list[TimedVariant]
    marks: list[MarkedVariant] | UnsetType = UNSET


def read_turns(file: Path) -> TurnsDocument:
    """Raises ConfigError for another file."""
    return read_document(file, TurnsDocument, ConfigError)
