"""What a video of an episode is made of, and how it is taken."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Frame:
    """One image of a video: what the cameras see at a step, and the chunk that is carried out there.

    entered   the row at which the chunk took over. While it was computed, the robot carried out the one before
    planned   rows entered to planned - 1 were carried out
    done      the row that comes next
    before    float64[n, d], n ≤ entered: what the robot was commanded instead of the rows before `entered`
    note      what the robot waits for, if it does
    """

    step: int
    camera_images: list[np.ndarray]
    chunk: np.ndarray  # [H, d]
    planned: int
    done: int
    entered: int = 0
    before: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    note: str = ""


@dataclass
class _Carried:
    """What was carried out of a chunk."""

    step: int  # at which it took over
    entered: int
    planned: int
    before: list[np.ndarray]


class Reel:
    """Takes images during an episode. Frames are made when it is over: then it is known what was carried out.

    video    is given the frames. None: there is no video, and nothing is kept
    smooth  an image at every step, instead of those at which the policy looks or a chunk takes over
    """

    def __init__(self, on_frame: Callable[[Frame], None] | None, smooth: bool) -> None:
        self._video, self._smooth = on_frame, smooth
        self._images: list[tuple[int, list[np.ndarray]]] = []
        self._requested: list[int] = []  # at which step each chunk was asked for
        self._chunks: dict[int, np.ndarray] = {}
        self._rows: list[tuple[int, int] | None] = []  # chunk and row of each step; None: no action
        self._carried: dict[int, _Carried] = {}
        self._last: list[np.ndarray] = []  # actions before now

    def wants(self, *, takes_over: bool) -> bool:
        """Whether an image is wanted at a step at which nobody looks."""
        return self._video is not None and (self._smooth or takes_over)

    def camera_image(self, step: int, camera_images: list[np.ndarray]) -> None:
        if self._video is not None:
            self._images.append((step, camera_images))

    def requested(self, step: int) -> None:
        """The next chunk was asked for, with what is seen at this step."""
        if self._video is not None:
            self._requested.append(step)

    def answered(self, number: int, chunk: np.ndarray) -> None:
        """float64[H, d], what the policy predicted when it was asked for the chunk of this number."""
        if self._video is not None:
            self._chunks[number] = chunk

    def act(self, values: np.ndarray, chunk: int | None = None, row: int = 0) -> None:
        """This step's command; `chunk` None: there is no action, and the robot stands still."""
        if self._video is None:
            return
        self._rows.append(None if chunk is None else (chunk, row))
        if chunk is None:
            return
        if chunk not in self._carried:
            before = self._last[len(self._last) - min(row, len(self._last)) :]
            self._carried[chunk] = _Carried(len(self._rows) - 1, row, row, before)
        self._carried[chunk].planned = row + 1
        self._last.append(values)

    def end(self, refused: np.ndarray | None = None) -> None:
        """Hand the frames on. `refused`: the last chunk, if it ended the episode."""
        if self._video is not None:
            for step, camera_images in self._images:
                self._video(self._frame(step, camera_images, refused))

    def _frame(self, step: int, camera_images: list[np.ndarray], refused: np.ndarray | None) -> Frame:
        now = self._rows[step] if step < len(self._rows) else None
        if now is None and step == len(self._rows) and refused is not None:
            return Frame(step, camera_images, refused, 0, 0)
        note = self._note(step)
        if now is None:
            earlier = [row for row in self._rows[:step] if row is not None]
            if not earlier:
                width = next((chunk.shape[1] for chunk in self._chunks.values()), 1)
                return Frame(step, camera_images, np.full((1, width), np.nan), 0, 0, note=note)
            now = earlier[-1][0], earlier[-1][1] + 1
        number, row = now
        carried = self._carried[number]
        before = np.array(carried.before).reshape(len(carried.before), self._chunks[number].shape[1])
        return Frame(step, camera_images, self._chunks[number], carried.planned, row, carried.entered, before, note)

    def _note(self, step: int) -> str:
        """Whether a chunk is computed at this step, and whether the robot stands still meanwhile."""
        if step >= len(self._rows):
            return ""
        if self._rows[step] is None:
            return "stands still: the policy computes"
        requested = [number for number, when in enumerate(self._requested) if when <= step]
        late = requested and (requested[-1] not in self._carried or self._carried[requested[-1]].step > step)
        return "the next chunk is computed" if late else ""


def lengths(frames: Sequence[Frame]) -> list[int]:
    """How many control steps each frame is shown: until the next one; the last one for as long as the one before."""
    gaps = [max(1, after.step - frame.step) for frame, after in itertools.pairwise(frames)]
    return [*gaps, gaps[-1] if gaps else 1]
