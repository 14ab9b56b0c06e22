"""One robot's calls, watched: what is worth a note, said once and not with every call.

A note says what is wrong in this call; what is remembered is from the calls since the robot's last reset:

    state_range        a value of the state is far outside the training data, or somewhat outside in the first call,
                       before the robot moves, or for SUSTAINED calls
    action_range       so is an action, of the chunk in this answer
    action_clipped     it was clipped
    camera_black       an image is black, or of one colour everywhere
    camera_frozen      it was the same in FROZEN calls, while the robot or another camera's image moved
    camera_size        it has another resolution than before
    camera_exchanged   two cameras show what the other one showed before, or in known images
    camera_channels    red and blue are exchanged, compared with before, or with known images
    camera_turned      it is turned by 180 degrees, compared with known images

No checkpoint has such images. Without them (known_cameras.py), cameras that were wrong from the first call on are
beyond this; those that show much the same always are.
"""

import itertools
import logging
import threading
import time
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from turbopi.realtime.messages import NOTES, Note
from turbopi.robots.base import listed

logger = logging.getLogger(__name__)

READING = "reading"  # of a result, for a server, which knows the robots apart
NEAR, FAR = 0.25, 2.0  # margins, in widths of the training range on either side of it: beyond the latter is far
SUSTAINED = 20  # calls
FROZEN = 5  # calls
GRID = 12  # pixels of an image that are looked at, in each direction
REPEAT_SECONDS = 60.0  # until the log says the same of the same joint or camera again
MOVED = 0.025  # widths of the training range of a value of the state: then the robot isn't where it was
DARK = bytes(range(8))  # grey levels of a black image
MOST_CAMERAS = 64  # that are remembered: no robot has as many
COMPARED_EVERY = 16  # calls: with the images of before
DIFFERENT = 12.0  # grey levels in the mean, from the images of before: these may be another camera's
_LEARNING = 0.25  # of the images of before, in each comparison


class Outside(NamedTuple):
    """A value outside the training range [low, high], by more than the margin NEAR; `far`: by more than FAR."""

    name: str
    value: float
    low: float
    high: float
    far: bool
    step: int | None = None  # of a chunk, from 0


class Sample:
    """Of one image: its height and width, and 12 x 12 of its pixels, uint8 RGB.

    image  itself, which isn't copied
    whole  CRC-32 of it, made when it is wanted, and when a sample is sent to another process
    """

    __slots__ = ("_image", "_whole", "pixels", "shape")

    def __init__(
        self, shape: tuple[int, ...], pixels: bytes, image: np.ndarray | None = None, whole: int | None = None
    ) -> None:
        self.shape, self.pixels, self._image, self._whole = shape, pixels, image, whole

    @property
    def whole(self) -> int | None:
        if self._whole is None and self._image is not None:
            self._whole = zlib.crc32(np.ascontiguousarray(self._image).data)
        return self._whole

    def __reduce__(self) -> tuple[Any, ...]:
        return Sample, (self.shape, self.pixels, None, self.whole)


class Comparison:
    """Of one call's images with known ones: made when it is wanted, and when it is sent to another process."""

    __slots__ = ("_compare", "_notes")

    def __init__(self, compare: Callable[[], tuple[Note, ...]] | None, notes: tuple[Note, ...] = ()) -> None:
        self._compare, self._notes = compare, notes

    @property
    def notes(self) -> tuple[Note, ...]:
        if self._compare is not None:
            self._notes, self._compare = self._compare(), None
        return self._notes

    def __reduce__(self) -> tuple[Any, ...]:
        return Comparison, (None, self.notes)


class Reading(NamedTuple):
    """Of one call.

    state    of the robot
    widths   of the training range of its values: how far it has moved is seen by them
    outside  values of the state that are outside the training range
    actions  the farthest value of each action that is far outside
    clipped  whether the actions were clipped
    images   by camera, under the robot's own key
    missing, unread  of cameras, as `RobotInputs`'
    known    how they compare with known images
    """

    state: Sequence[float]
    widths: Sequence[float] = ()
    outside: tuple[Outside, ...] = ()
    actions: tuple[Outside, ...] = ()
    clipped: bool = False
    images: Mapping[str, Sample] = {}
    missing: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()
    known: Comparison | None = None


class Watch:
    """Of one robot. For one thread at a time.

    remembers  False: the readings are of several robots, so none is compared with the one before
    at_once    what is somewhat outside is said of every call
    clock      in seconds
    """

    def __init__(
        self, *, remembers: bool = True, at_once: bool = False, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._remembers, self._at_once, self._clock = remembers, at_once, clock
        self._logged: dict[str, tuple[float, set[str]]] = {}  # kind -> when, and of which joints or cameras
        self.reset()

    def reset(self) -> None:
        """A new episode: nothing is remembered but what the log has said."""
        self._streaks: dict[str, int] = {}  # values of the state that are outside, for how many calls
        self._shown: set[str] = set()  # of them, those that a note was about
        self._begins = self._remembers
        self._cameras = CameraWatch()

    def notes(self, reading: Reading) -> list[Note]:
        """What there is to say of a call."""
        found, at_once = [], self._begins or self._at_once
        self._begins = False
        if reading.outside or self._streaks:
            found += self._of_state(reading, at_once)
        if reading.actions:
            found.append(_of_actions(reading))
        if reading.missing and reading.unread:
            found.append(_of_names(reading))
        return [*found, *self._of_cameras(reading)]

    def to_log(self, notes: Iterable[Note]) -> list[Note]:
        """Of a call's notes, those that the log hasn't said in the last REPEAT_SECONDS."""
        now, new = self._clock(), []
        for note in notes:
            at, names = self._logged.get(note.kind, (-np.inf, set()))
            expired = now - at >= REPEAT_SECONDS
            if expired or not names.issuperset(note.names):
                self._logged[note.kind] = (now if expired else at, {*note.names} | (set() if expired else names))
                new.append(note)
        return new

    def _of_state(self, reading: Reading, at_once: bool) -> list[Note]:
        if self._remembers:
            self._streaks = {one.name: self._streaks.get(one.name, 0) + 1 for one in reading.outside}
        shown = [
            one
            for one in reading.outside
            if at_once or one.far or one.name in self._shown or self._streaks.get(one.name, 0) >= SUSTAINED
        ]
        if self._remembers:  # one that was shown stays so until it is back in range
            self._shown = {one.name for one in shown}
        if not shown:
            return []
        if any(one.far for one in shown):
            how = "far from"
        elif any(self._streaks.get(one.name, 0) >= SUSTAINED for one in shown):
            how = f"outside, for {SUSTAINED} calls and more,"
        else:
            how = "outside"
        text = (
            f"the state is {how} the checkpoint's training range: {listed_values(shown)}. Are its units and the order "
            "of its joints those of the training data?"
        )
        return [Note("state_range", tuple(one.name for one in shown), text)]

    def _of_cameras(self, reading: Reading) -> list[Note]:
        if not self._remembers:
            known = [] if reading.known is None else reading.known.notes
            return [*known, *(note for name, one in reading.images.items() for note in _black(name, one))]
        return self._cameras.notes(reading)


class PolicyWatch:
    """A policy's own: of the one robot whose observations `infer` gets, and of the several of `infer_batch`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._one, self._several = Watch(), Watch(remembers=False)

    def reset(self) -> None:
        with self._lock:
            self._one.reset()

    def report(
        self, results: list[dict[str, Any]], readings: Sequence[Reading | None], *, hand_over: bool, one_robot: bool
    ) -> None:
        """Put the notes of each call into its result, and into the log; or with `hand_over` its reading instead."""
        for result, reading in zip(results, readings, strict=True):
            if reading is None:
                continue
            if hand_over:
                result[READING] = reading
                continue
            watch = self._one if one_robot else self._several
            with self._lock:
                if not (notes := watch.notes(reading)):
                    continue
                new = watch.to_log(notes)
            result[NOTES] = [note.plain for note in notes]
            for note in new:
                logger.warning("%s", note.text)


def listed_values(found: Sequence[Outside], verb: str = "is") -> str:
    """The first three, for a message, each with its training range."""
    shown = [
        f"{one.name} {verb} {one.value:.4g}{'' if one.step is None else f' at step {one.step}'}, in the training data "
        f"{one.low:.4g} to {one.high:.4g}"
        for one in found[:3]
    ]
    more = f"; and {len(found) - 3} more" if len(found) > 3 else ""
    return "; ".join(shown) + more


def _of_names(reading: Reading) -> Note:
    text = (
        f"the observation has {listed(reading.unread)}, which isn't read, and lacks {listed(reading.missing)}: the "
        "model acts without it. Is one of them misspelt?"
    )
    return Note("camera_missing", reading.missing, text)


def _of_actions(reading: Reading) -> Note:
    names = tuple(one.name for one in reading.actions)
    values = listed_values(reading.actions, "reached" if reading.clipped else "reaches")
    text = f"the actions are far from the checkpoint's training range: {values}"
    if reading.clipped:
        return Note("action_clipped", names, f"{text}. They were clipped, to {FAR:g} widths of the range beyond it")
    return Note("action_range", names, text)


@dataclass
class _Camera:
    """shape and pixels of the last image, and the robot's state when it came; `same` calls had these pixels, and in the
    second of them the image was `whole`. `moved`: meanwhile another camera's image has changed, or the robot moved.
    """

    shape: tuple[int, ...]
    pixels: bytes
    state: Sequence[float]
    same: int = 1
    moved: bool = False
    whole: int | None = None


class CameraWatch:
    """The cameras of one robot, each compared with its images before."""

    def __init__(self) -> None:
        self._cameras: dict[str, _Camera] = {}
        self._calls = 0
        self._names: tuple[str, ...] = ()
        self._before: np.ndarray = np.empty((0, 0), np.float32)  # [C, pixels]: their images, a mean of the last ones
        self._suspected: list[Note] = []  # by the last comparison
        self._by_known: tuple[Note, ...] = ()  # in the call before, compared with known images

    def notes(self, reading: Reading) -> list[Note]:
        """What there is to say of a call's images."""
        found: list[Note] = []
        images, state = reading.images, reading.state
        if 0 < len(images) < len(self._cameras) and all(name in self._cameras for name in images):
            missing = tuple(name for name in self._cameras if name not in images)
            text = f"no image of camera {', '.join(missing[:4])} came, as in earlier calls: the model acts without it"
            found.append(Note("camera_missing", missing, text))
        same = [name for name, one in images.items() if not self._changed(name, one, state, found)]
        for name in same:
            camera = self._cameras[name]
            camera.moved = camera.moved or len(same) < len(images)
            if camera.same % FROZEN == 0 and not camera.moved:
                camera.moved = _far_apart(camera.state, state, reading.widths)
            if camera.same < FROZEN or not camera.moved:
                continue
            if camera.whole != images[name].whole:  # it is another one, where no pixel is looked at
                camera.state, camera.same, camera.moved = state, 1, False
            else:
                found.append(
                    Note(
                        "camera_frozen",
                        (name,),
                        f"camera {name} has sent the same image in {camera.same} calls, while the robot or another "
                        "camera's image moved",
                    )
                )
        if reading.known is not None and (self._by_known or self._calls % COMPARED_EVERY == 0):
            found += self._compared_with_known(reading.known.notes)
        if self._suspected or self._calls % COMPARED_EVERY == 0:
            said = {(note.kind, note.names) for note in found}
            found += [note for note in self._compared(images) if (note.kind, note.names) not in said]
        self._calls += 1
        return found

    def _compared_with_known(self, notes: tuple[Note, ...]) -> list[Note]:
        """In the first call at once, as the robot hasn't moved; then what two comparisons show."""
        confirmed = [note for note in notes if self._calls == 0 or note in self._by_known]
        self._by_known = notes
        return confirmed

    def _changed(self, name: str, one: Sample, state: Sequence[float], found: list[Note]) -> bool:
        """Whether the image isn't the last one; adds what can be said of it alone."""
        found += _black(name, one)
        camera = self._cameras.get(name)
        if camera is None:
            if len(self._cameras) >= MOST_CAMERAS:
                self._cameras.clear()
            self._cameras[name] = _Camera(one.shape, one.pixels, state)
            return True
        if camera.shape != one.shape:
            found.append(
                Note(
                    "camera_size",
                    (name,),
                    f"camera {name} sends images of {one.shape[1]} x {one.shape[0]} pixels, before they were "
                    f"{camera.shape[1]} x {camera.shape[0]}",
                )
            )
            self._cameras[name] = _Camera(one.shape, one.pixels, state)
            return True
        if camera.pixels == one.pixels:
            camera.same += 1
            if camera.same == 2:
                camera.whole = one.whole
            return False
        camera.pixels, camera.state, camera.same, camera.moved = one.pixels, state, 1, False
        return True

    def _compared(self, images: Mapping[str, Sample]) -> list[Note]:
        """Notes on images that fit others of before better than their own, found in two comparisons."""
        pixels = [one.pixels for one in images.values()]
        if len({len(one) for one in pixels}) != 1:
            return []  # no image, or one of fewer than GRID pixels in a direction
        now = np.frombuffer(b"".join(pixels), np.uint8).reshape(len(images), -1).astype(np.float32)
        names = tuple(images)
        if names != self._names or now.shape != self._before.shape:
            self._names, self._before, self._suspected = names, now, []
            return []
        difference = now - self._before
        own = np.add.reduce(np.abs(difference), 1) / now.shape[1]  # [C], as `mean`, which takes three times as long
        suspects = self._mistaken(now, own) if max(own.tolist()) > DIFFERENT else []
        if not suspects:
            difference *= _LEARNING
            self._before += difference
        confirmed = [note for note in suspects if note in self._suspected]
        self._suspected = suspects
        return confirmed

    def _mistaken(self, now: np.ndarray, own: np.ndarray) -> list[Note]:
        """An image is taken for another one's if it is twice as close to that."""
        found, names, before = [], self._names, self._before
        close = np.abs(now[:, None] - before).mean(axis=2) * 2 < own[:, None]  # [C, C]
        exchanged = np.abs(now.reshape(len(now), -1, 3)[..., ::-1].reshape(now.shape) - before).mean(axis=1)
        for i, j in itertools.combinations(range(len(names)), 2):
            if close[i, j] and close[j, i] and min(own[i], own[j]) > DIFFERENT:
                text = (
                    f"cameras {names[i]} and {names[j]} each show what the other one showed before: are they exchanged?"
                )
                found.append(Note("camera_exchanged", (names[i], names[j]), text))
        for i, name in enumerate(names):
            if own[i] > DIFFERENT and exchanged[i] * 2 < own[i]:
                text = f"red and blue of camera {name} are exchanged, compared with its images before: is it BGR now?"
                found.append(Note("camera_channels", (name,), text))
        return found


def _far_apart(before: Sequence[float], state: Sequence[float], widths: Sequence[float]) -> bool:
    each = zip(before, state, widths or itertools.repeat(1.0), strict=False)
    return any(abs(a - b) > MOVED * width for a, b, width in each)


def _black(name: str, one: Sample) -> list[Note]:
    if not one.pixels.strip(DARK):
        return [Note("camera_black", (name,), f"camera {name} is black")]
    first = one.pixels[:3]
    if first == one.pixels[-3:] and one.pixels == first * (len(one.pixels) // 3):
        return [
            Note("camera_black", (name,), f"camera {name} has one colour everywhere: {tuple(one.pixels[:3])} in RGB")
        ]
    return []
