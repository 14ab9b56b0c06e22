"""What a call shows of its robot: values outside the training data, and a few pixels of each camera.

A reading remembers nothing, so that any policy of a fleet may make it; `turbopi.policy.watch` compares the readings of
one robot. What a call without findings costs: docs/dev/serving.md.
"""

import functools
from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np

from turbopi.checkpoint.norm_stats import NormStats
from turbopi.policy.known_cameras import KnownCameras
from turbopi.policy.ranges import DrawnRange, TrainingRange, refusal
from turbopi.policy.watch import GRID, MOST_CAMERAS, Comparison, Reading, Sample
from turbopi.preprocess.pipeline import Incoming, Pipeline, of_row
from turbopi.robots.base import Example
from turbopi.robots.labels import Label, action_labels, camera_label, state_labels
from turbopi.support.errors import ActionError, ConfigError

OutOfRange = Literal["warn", "refuse", "clip"]
_UINT8 = np.dtype(np.uint8)


class Checks:
    """Makes the readings of one policy.

    out_of_range     what becomes of actions that are far outside: "warn" leaves them, "clip" moves them to the end of
                     what isn't far, "refuse" raises
    judges_ranges    False: the statistics are made up
    known_cameras    what the images are compared with

    Raises ConfigError for another `out_of_range`.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        stats: NormStats,
        out_of_range: OutOfRange = "warn",
        judges_ranges: bool = True,
        known_cameras: KnownCameras | None = None,
    ) -> None:
        if out_of_range not in get_args(OutOfRange):
            raise ConfigError(f"unknown out_of_range={out_of_range!r}; choose one of {', '.join(get_args(OutOfRange))}")
        self.out_of_range, self._robot, self._pipeline = out_of_range, pipeline.robot, pipeline
        robot, action_width = pipeline.robot, pipeline.metadata["robot_action_dim"]
        state_width = pipeline.state_scale.width if robot.state_dim is None else robot.state_dim
        judged = stats if judges_ranges or out_of_range != "warn" else NormStats()
        self._state_labels = state_labels(robot, state_width or 0)
        self._action_labels = action_labels(robot, action_width)
        self.state = TrainingRange(judged.state if judges_ranges else None, self._state_labels)
        self.actions = TrainingRange(judged.actions, self._action_labels)
        self._least, self._most = self._normalized(self.actions.least), self._normalized(self.actions.most)
        self._surely = min([np.inf, *-self._least, *self._most])  # what no action is far beyond, normalised
        self._labels: dict[tuple[str, ...], list[str]] = {}  # of cameras
        self._known_cameras = known_cameras

    @property
    def drawn(self) -> tuple[DrawnRange, DrawnRange]:
        """For plots: the ranges of state and actions, empty ones where the statistics are made up."""
        actions = self.actions.drawn_of_actions(self._robot, self._pipeline.config.model.action_dim)
        return self.state.drawn, actions

    @functools.cached_property
    def features(self) -> dict[str, list[dict[str, Any]]]:
        """Of state and actions each number's name, unit and training range, in plain values; None where unknown."""
        state, actions = self.drawn
        return {"state": _plain(self._state_labels, state), "actions": _plain(self._action_labels, actions)}

    def _normalized(self, ends: np.ndarray) -> np.ndarray:
        """float64[d], of actions, as the model has them: float32[d]."""
        scale = self._pipeline.action_scale
        if scale.width is None or not len(ends):
            return ends.astype(np.float32)
        whole = np.zeros(scale.width)
        whole[: len(ends)] = ends
        return scale.normalize(whole)[: len(ends)].astype(np.float32)

    def reading(self, seen: Incoming) -> Reading | None:
        """Of an observation that the pipeline has seen; None for a made-up one."""
        if isinstance(seen.observation, Example):
            return None
        values: list[float] = np.asarray(seen.robot.state).reshape(-1).tolist()
        images = self._images(seen)
        cameras = self._known_cameras
        known = None if cameras is None else Comparison(functools.partial(cameras.notes, images))
        missing, unread = seen.robot.missing, seen.robot.unread
        outside = self.state.outside(values)
        return Reading(values, self.state.widths, outside, images=images, missing=missing, unread=unread, known=known)

    def _images(self, seen: Incoming) -> dict[str, Sample]:
        labels = self._labels.get(seen.cameras)
        if labels is None:
            if len(self._labels) >= MOST_CAMERAS:  # of a robot that names them as its clients please
                self._labels.clear()
            labels = self._labels[seen.cameras] = [camera_label(self._robot, camera) for camera in seen.cameras]
        images = seen.robot.images
        known = zip(labels, seen.cameras, seen.sent, strict=True)
        return {label: sample(np.asarray(images[camera])) for label, camera, sent in known if sent}

    def judge(
        self, chunks: np.ndarray, readings: Sequence[Reading | None]
    ) -> tuple[np.ndarray, Sequence[Reading | None]]:
        """The chunks float32[B, H, action_dim] that the robots may have, and the readings with what was found.

        Raises ActionError of the first row that is far outside, if such actions are refused. Chunks that aren't finite
        are left for the pipeline to refuse. What was computed from made-up observations isn't judged.
        """
        if np.maximum.reduce(np.abs(chunks).ravel()) <= self._surely or not np.isfinite(chunks).all():
            return chunks, readings
        used = chunks[..., : len(self._least)]
        beyond = (used < self._least) | (used > self._most)
        clips, judged, allowed = self.out_of_range == "clip", list(readings), chunks
        for row in np.flatnonzero(beyond.any(axis=(1, 2))):
            one, found = readings[row], self.actions.worst(self._pipeline.action_scale.unnormalize(chunks[row]))
            if one is None or not found:  # the latter by the rounding to float32
                continue
            if self.out_of_range == "refuse":
                raise ActionError(of_row(int(row), len(chunks), refusal(found, one.outside)))
            judged[row] = one._replace(actions=found, clipped=clips)
            if clips:
                allowed = chunks.copy() if allowed is chunks else allowed
                np.clip(used[row], self._least, self._most, out=allowed[row, :, : len(self._least)])
        return allowed, judged


def _plain(labels: Sequence[Label], known: DrawnRange) -> list[dict[str, Any]]:
    ends = np.full((2, len(labels)), np.nan)
    ends[:, : len(known.low)] = known.low, known.high
    ranges = [(low, high) if np.isfinite((low, high)).all() else (None, None) for low, high in ends.T.tolist()]
    return [{**label._asdict(), "low": low, "high": high} for label, (low, high) in zip(labels, ranges, strict=True)]


def sample(image: np.ndarray) -> Sample:
    """Of an image uint8[h, w, 3], or float[h, w, 3] in [0, 1]."""
    shape = image.shape[:2]
    if image.flags.c_contiguous:  # a third of the time
        few = image.reshape(-1).take(_grid(shape))
    else:
        rows, columns = map(_lines, shape)
        few = image[rows.start :: rows.step, columns.start :: columns.step][: len(rows), : len(columns)]
    if few.dtype != _UINT8:
        few = (few.clip(0, 1) * 255).astype(_UINT8)
    return Sample(shape, few.tobytes(), image)


def _lines(size: int) -> range:
    """The rows or columns that are looked at, spread evenly."""
    step = max(1, size // GRID)
    return range(step // 2, size, step)[:GRID]


@functools.lru_cache(maxsize=32)
def _grid(shape: tuple[int, int]) -> np.ndarray:
    """Where the pixels that are looked at are in a contiguous image."""
    rows, columns = (np.array(_lines(size)) for size in shape)
    pixels = (rows[:, None] * shape[1] + columns).reshape(-1, 1)
    return np.asarray((3 * pixels + np.arange(3)).ravel())
