"""What the feed says. Each message is a text frame of JSON with a "kind": first a Hello, then Frames.

Numbers that aren't finite become null; bytes are base64. Texts of clients are cut and escaped (`clean`): they are shown
as text, never as markup.
"""

from typing import Any

from msgspec import Struct

from turbopi.support.action_groups import ActionGroup

FEED_VERSION = 2


class Hello(Struct, frozen=True, tag="hello", tag_field="kind"):
    """What doesn't change while the server runs.

    policy   its metadata, as clients get it
    actions  how the dimensions of its actions belong together, by name; empty if the metadata doesn't say
    """

    feed: int
    turbopi: str
    started: float  # seconds since 1970
    queue_limit: int
    policy: dict[str, Any]
    actions: list[ActionGroup]


class Thumbnail(Struct, frozen=True):
    jpeg: bytes
    width: int  # of the image that the robot sent
    height: int


class Preview(Struct, frozen=True):
    """One answered call.

    number   of the robot's calls, from 1. Some are left out: a robot may call more often than the feed shows
    time     when its answer had been sent, in seconds since 1970
    actions  [H, d] in the robot's units; empty if they are too many to show
    state    of the robot, in the order of the metadata's "features"; empty for a policy that doesn't tell
    numbers  the observation's arrays of few numbers, such as its state
    timing   milliseconds of each stage
    note     what isn't shown, and why
    """

    number: int
    time: float
    prompt: str
    actions: list[list[float | None]]
    state: list[float | None]
    numbers: dict[str, list[float | None]]
    images: dict[str, Thumbnail]
    timing: dict[str, float | None]
    note: str = ""


class RobotNote(Struct, frozen=True):
    """A note of a robot's answer, or why a request got no actions. `names`: of joints or cameras."""

    kind: str  # as in turbopi_notes_total or turbopi_errors_total
    names: list[str]
    text: str


class RobotFrame(Struct, frozen=True):
    """A robot that is connected, or was.

    id        one that comes back under its name keeps it, and goes on counting calls
    name      that it gave itself, "" if none
    lost      since when it isn't connected; `how` that came
    times     milliseconds of its last answers, from the observation received to the actions sent
    deadline  milliseconds, of its last request; None: it gave none
    timed     requests that gave a deadline; so many of them were `missed`
    batch     observations in the run of its last answer; `rows` of its last message, if that was a batch
    notes     of its last answer
    refusal   why its last request got no actions; None: it got some
    preview   its last call, if this watcher hasn't had it yet
    """

    id: int
    name: str
    address: str
    connected: float  # seconds since 1970, as `last` and `lost`
    lost: float | None
    how: str
    calls: int
    last: float | None
    times: list[float]
    deadline: float | None
    timed: int
    missed: int
    batch: int
    rows: int | None
    notes: list[RobotNote]
    refusal: RobotNote | None
    preview: Preview | None


class StageTimes(Struct, frozen=True):
    """Milliseconds of a stage in the last calls, and how many of these fell into each bin of `Frame.latency_bin_ms`.

    What is longer than all bins is in the last one.
    """

    stage: str
    calls: int
    p50: float
    p95: float
    max: float
    bins: list[int]


class Trouble(Struct, frozen=True):
    """A request that got no actions, or a note. The text begins with the robot."""

    time: float
    error: str  # its kind, as in turbopi_errors_total or turbopi_notes_total
    text: str


class Memory(Struct, frozen=True):
    what: str
    used: int
    total: int


class Frame(Struct, frozen=True, tag="frame", tag_field="kind"):
    """The server at one moment."""

    time: float
    requests: int
    clients: int
    waiting: int
    running: bool
    lost: str | None
    memory: Memory
    errors: dict[str, int]
    troubles: list[Trouble]  # the last ones
    latency_bin_ms: float
    latency: list[StageTimes]
    batches: dict[int, int]  # observations in a run -> how many of the last answers came from such runs
    timed: int  # requests that gave a deadline
    missed: int  # of them
    robots: list[RobotFrame]  # those with the last requests, in the order in which they connected


def clean(text: str, limit: int = 300) -> str:
    """`text` of a client: cut, and with escapes for what isn't printable, such as marks that turn the line around."""
    cut = text if len(text) <= limit else text[: limit - 1] + "…"
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in cut)
