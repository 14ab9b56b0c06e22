"""One episode of practice: what was done in it, which frames of it teach something, and how it is kept.

An expert's chunk is only right if the expert goes on to act as it says. So a frame is labelled where the expert drove
the HORIZON steps from it on. Its first steps, up to `lead` of them, may be the learner's: those are never learned, but
held, as actions are that a robot carries out while it waits for the rest of a chunk (forward.py).

A frame can be kept without its images: a `Tape` has the physics to draw them from, on a machine with a GPU.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from turbopi_lab.small_policy.expert import PHASES, Sight
from turbopi_lab.small_policy.scenes import Setting

HORIZON = 16  # so that delays of 6 fit beside an execution horizon of up to 10
IMAGE_PX = 224
AUX_DIM = 11  # hand 3, bowl 3, plate 3, opening, held
HOPELESS = 150  # steps of the expert without success: it is stuck, and its labels with it
Kind = Literal["demonstration", "dagger", "trial"]


@dataclass
class Record:
    """`n` labelled frames of one episode, without their images.

    chunks     float32[n, H, 7]: the expert's actions, without the noise that some are carried out with
    executed   float32[n, H, 7]: those that were carried out
    leads      int64[n]: so many first actions of `chunks` are no labels, as the learner drove
    aux float32[n, AUX_DIM]   phases int64[n]   states float32[n, 8]
    """

    kind: Kind
    setting: Setting
    success: bool
    steps: int
    learner_steps: int
    chunks: np.ndarray
    executed: np.ndarray
    leads: np.ndarray
    aux: np.ndarray
    phases: np.ndarray
    states: np.ndarray


@dataclass
class Tape:
    """A record and what its frames are drawn from: bodies float64[bodies, 7] of the scene, joints float64[n, nq]."""

    record: Record
    bodies: np.ndarray
    joints: np.ndarray


@dataclass
class Frame:
    """A moment that may be labelled; `images` uint8[2, 224, 224, 3], or None if it is to be drawn later."""

    step: int
    lead: int
    camera_images: np.ndarray | None
    sight: Sight
    phase: str
    state: np.ndarray
    joints: np.ndarray


@dataclass
class Episode:
    """By step: the expert's action, the one that was carried out, and who drove. Frames of some steps."""

    setting: Setting
    labels: list[np.ndarray] = field(default_factory=list)
    executed: list[np.ndarray] = field(default_factory=list)
    by_expert: list[bool] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    success: bool = False

    @property
    def useful(self) -> bool:
        """Whether the expert knew what it did: it got there, and soon, or has hardly driven."""
        return self.success or sum(self.by_expert) < HOPELESS

    @property
    def labelled(self) -> list[Frame]:
        return [frame for frame in self.frames if self.useful and self.followed(frame.step, frame.lead)]

    def followed(self, step: int, lead: int = 0) -> bool:
        """Whether the expert drove for the rest of the chunk, or into success, from `lead` steps on."""
        driven = self.by_expert[step + lead : step + HORIZON]
        complete = step + HORIZON <= len(self.by_expert) or self.success
        return complete and bool(driven) and all(driven)

    def record(self, kind: Kind) -> Record:
        frames, learner_steps = self.labelled, len(self.by_expert) - sum(self.by_expert)
        return Record(
            kind,
            self.setting,
            self.success,
            len(self.labels),
            learner_steps,
            chunks=self._chunks(self.labels, frames),
            executed=self._chunks(self.executed, frames),
            leads=np.array([frame.lead for frame in frames], np.int64),
            aux=np.array([auxiliary(frame.sight) for frame in frames], np.float32).reshape(-1, AUX_DIM),
            phases=np.array([PHASES.index(frame.phase) for frame in frames], np.int64),
            states=np.array([frame.state for frame in frames], np.float32).reshape(-1, 8),
        )

    def camera_images(self) -> np.ndarray:
        """uint8[n, 2, 224, 224, 3] of the labelled frames, all of which were drawn."""
        drawn = [frame.camera_images for frame in self.labelled]
        return np.array(drawn, np.uint8).reshape(-1, 2, IMAGE_PX, IMAGE_PX, 3)

    def tape(self, kind: Kind, bodies: np.ndarray) -> Tape:
        return Tape(self.record(kind), bodies, np.array([frame.joints for frame in self.labelled]))

    def _chunks(self, actions: list[np.ndarray], frames: list[Frame]) -> np.ndarray:
        chunks = [self.chunk(actions, frame.step) for frame in frames]
        return np.array(chunks, np.float32).reshape(-1, HORIZON, 7)

    @staticmethod
    def chunk(actions: list[np.ndarray], step: int) -> np.ndarray:
        """The HORIZON actions from `step` on; where the episode has ended, the last one goes on."""
        chunk = actions[step : step + HORIZON]
        return np.array(chunk + [chunk[-1]] * (HORIZON - len(chunk)))


def auxiliary(sight: Sight) -> np.ndarray:
    return np.concatenate([sight.hand, sight.bowl, sight.plate, [sight.opening, float(sight.held)]])


# --- files ------------------------------------------------------------------------------------------------------------

_PLAIN = ("kind", "setting", "success", "steps", "learner_steps")
_ARRAYS = ("chunks", "executed", "leads", "aux", "phases", "states")


def save_tapes(file: Path, tapes: list[Tape]) -> None:
    """Into a new .npz."""
    arrays: dict[str, Any] = {name: np.concatenate([getattr(t.record, name) for t in tapes]) for name in _ARRAYS}
    arrays |= {"frames": np.array([len(t.joints) for t in tapes]), "bodies": np.stack([t.bodies for t in tapes])}
    arrays["joints"] = np.concatenate([t.joints for t in tapes if len(t.joints)]).astype(np.float32)
    plain = [{name: getattr(tape.record, name) for name in _PLAIN} for tape in tapes]
    part = file.with_suffix(".part.npz")
    np.savez_compressed(part, plain=np.frombuffer(msgspec.json.encode(plain), np.uint8), **arrays)
    part.replace(file)


def load_tapes(files: Iterable[Path]) -> Iterator[Tape]:
    for file in files:
        with np.load(file) as found:
            arrays = {name: found[name] for name in found.files}
        ends = np.cumsum(arrays["frames"])
        plain = msgspec.json.decode(arrays["plain"].tobytes())
        for reported, end, length, bodies in zip(plain, ends, arrays["frames"], arrays["bodies"], strict=True):
            span = slice(end - length, end)
            reported["setting"] = Setting(**reported["setting"])
            record = Record(**reported, **{name: arrays[name][span] for name in _ARRAYS})
            yield Tape(record, bodies, arrays["joints"][span].astype(np.float64))
