"""What the executor commanded, and what became of each observation: the last minutes of it."""

import copy
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from turbopi.realtime.messages import notes_in
from turbopi.support.errors import TurboPiError

KEPT = 20_000  # commands: 400 s at 50 Hz
KEPT_NOTES = 100  # of different kinds, joints and cameras

Kind = Literal["fresh", "slowed", "held", "waiting"]


class OutOfActions(TurboPiError):
    """The robot has no action for this control step, as the policy answers too late or not at all."""


@dataclass(frozen=True)
class Command:
    """What the robot is to do in this control step.

    kind        "fresh"    an action of a chunk, carried out now and never before
                "slowed"   a point half way to the next action: the policy is late, so the motion is stretched
                "held"     there is no action: `action` is the executor's `hold_action`
                "waiting"  no chunk has come yet in this episode; `action` is as for "held"
    action      float64[d], in the robot's units. None: command nothing; the robot's controller keeps its place
    chunk, row  where a fresh action comes from
    takes_over  it is the first action of its chunk that is carried out
    remaining   actions that are left: after so many more steps there is none, if the policy doesn't answer
    """

    kind: Kind
    action: np.ndarray | None
    remaining: int
    chunk: int | None = None
    row: int | None = None
    takes_over: bool = False


@dataclass
class Inferred:
    """One observation that a chunk was asked for.

    chunk         its number, from 0
    begun, ended  control steps before the observation, and before its chunk came; None: it didn't yet
    outcome       "used", "in flight", or why the chunk was dropped
    """

    chunk: int
    begun: int
    ended: int | None = None
    outcome: str = "in flight"


@dataclass
class Noted:
    """A note that answers had, of one kind and on the same joints or cameras: the last text, and in which chunks."""

    kind: str
    names: tuple[str, ...]
    text: str
    chunks: int
    first: int
    last: int


@dataclass
class Journal:
    """The last commands, observations and latencies, and counts of all of them."""

    commands: deque[tuple[int, Command]] = field(default_factory=lambda: deque(maxlen=KEPT))  # with their control step
    inferred: deque[Inferred] = field(default_factory=lambda: deque(maxlen=KEPT // 10))
    kinds: Counter[str] = field(default_factory=Counter)
    observations: Counter[str] = field(default_factory=Counter)
    clock_jumps: int = 0
    latencies_ms: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))
    notes: dict[tuple[str, tuple[str, ...]], Noted] = field(default_factory=dict)

    def command(self, step: int, command: Command) -> None:
        self.commands.append((step, command))
        self.kinds[command.kind] += 1

    def note(self, chunk: int, answer: object) -> None:
        """Keep the notes of a chunk's answer."""
        for one in notes_in(answer):
            known = self.notes.get(one[:2])
            if known is not None:
                known.text, known.chunks, known.last = one.text, known.chunks + 1, chunk
            elif len(self.notes) < KEPT_NOTES:
                self.notes[one[:2]] = Noted(*one, 1, chunk, chunk)

    def copy(self) -> "Journal":
        copied = copy.copy(self)
        copied.commands, copied.latencies_ms = self.commands.copy(), self.latencies_ms.copy()
        copied.inferred = deque(copy.copy(one) for one in self.inferred)
        copied.notes = {key: copy.copy(one) for key, one in self.notes.items()}
        copied.kinds, copied.observations = self.kinds.copy(), self.observations.copy()
        return copied
