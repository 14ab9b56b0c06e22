"""replay.json: what `turbopi replay` found."""

from collections.abc import Mapping
from typing import Literal

from msgspec import Struct

from turbopi.support.provenance import Provenance

Level = Literal["follows", "partly", "differs", "too few"]


class Spread(Struct, frozen=True):
    """Of absolute errors."""

    mean: float
    p95: float
    max: float


class Joint(Struct, frozen=True):
    """One action. Errors are in the robot's units, `relative` in units of the model's normalised actions.

    error, relative   over whole chunks; `relative` is None where the action never moved in training
    by_index          error of the chunk's first action, its second, …
    correlation       of predicted and recorded; None where one of them is constant
    recorded, trained   the recorded actions' 1 % and 99 % quantiles, and what nearly all of the training's were within
    """

    name: str
    unit: str
    error: Spread
    relative: Spread | None
    by_index: list[Spread]
    correlation: float | None
    recorded: tuple[float, float]
    trained: tuple[float, float]


class State(Struct, frozen=True):
    """One number of the state: recorded 1 % and 99 % quantiles, and the range of the checkpoint's statistics."""

    name: str
    recorded: tuple[float, float]
    trained: tuple[float, float] | None  # None: the checkpoint has no statistics of it
    outside: bool


class Control(Struct, frozen=True):
    """What something else than the policy is wrong by: mean relative error, over chunks and by index."""

    name: str
    relative: float
    by_index: list[float]


class Changed(Struct, frozen=True):
    """The policy with its inputs changed on purpose, at some of the moments, beside the same moments as recorded.

    nearer   at how many of them it was nearer to what was recorded than with the inputs as they are
    """

    name: str
    moments: int
    relative: float
    as_recorded: float
    nearer: int


class Broken(Struct, frozen=True):
    """A moment whose answer no robot may be given, and why."""

    episode: str
    step: int
    why: str


class PolicyDocument(Struct, frozen=True):
    """A policy's errors over the moments that it answered; `broken`: those that it didn't."""

    label: str
    checkpoint: str
    policy: Mapping[str, object]
    keys: Mapping[str, str]  # robot's key -> the dataset's
    relative: Spread
    by_index: list[Spread]
    joints: list[Joint]
    call_ms: float  # median; a batch's time is its rows' together
    changed: list[Changed]
    broken: list[Broken] = []


class Against(Struct, frozen=True):
    """The second policy beside the first, paired by moment, with the same noise.

    difference   mean relative error of the second less that of the first, over the indices that both have
    interval     95 %, episodes resampled; None with fewer than three episodes
    nearer       at how many of the moments the second is nearer to what was recorded
    chunks       how far the two are from each other, relative
    """

    difference: float
    interval: tuple[float, float] | None
    nearer: int
    moments: int
    chunks: Spread


class Worst(Struct, frozen=True):
    episode: str
    step: int
    relative: float
    prompt: str


class DatasetDocument(Struct, frozen=True):
    path: str
    kind: str
    fps: float | None
    episodes: int
    moments: int
    episodes_taken: list[int]
    every: int
    moments_taken: int


class Verdict(Struct, frozen=True):
    """level: whether the chunks follow what was recorded; hints: what may be wrong, and what shows it."""

    level: Level
    text: str
    hints: list[str]

    @property
    def passed(self) -> bool:
        """Nothing shows a mistake."""
        return self.level != "differs" and not self.hints


class ReplayDocument(Struct, frozen=True):
    """replay.json."""

    dataset: DatasetDocument
    seed: int
    policies: list[PolicyDocument]
    against: Against | None
    controls: list[Control]
    states: list[State]
    worst: list[Worst]
    verdict: Verdict
    notes: list[str]
    provenance: Provenance
