"""Calls as rerun's entities, on the timelines "time" (wall clock) and "call" (the call's number).

    cameras/KEY        the images
    state/KEY          the observation's arrays of numbers, one series a value
    prompt             when it changes
    chunk/values       the predicted chunk [H, d], exact
    chunk/GROUP        the same as lines, to look at: steps to the right, the group's limits from bottom to top
    executed/GROUP     the actions that the robot carried out, each at its time: known only with the robot's rate
    latency/STAGE      milliseconds
    errors             what went wrong

With several robots, as live, each robot's are below its name, or its address.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from turbopi.support.action_groups import ActionGroup, action_groups, names_of
from turbopi.view.calls import ViewedCall, ViewedTrouble
from turbopi.view.viewer import open_viewer

WIDTH, HEIGHT = 160.0, 60.0  # of a drawn chunk, in the units of a 2D view
COLORS = ((59, 111, 182), (221, 132, 82), (85, 168, 104), (196, 78, 82), (129, 114, 179), (176, 127, 79))


class Drawing:
    """A rerun recording that calls are added to.

    file    where it goes, an .rrd; None opens the viewer
    name    what it is called
    policy  its metadata: names and units of state and actions
    rate    control steps a second: how long an action takes. None: executed actions aren't drawn
    """

    def __init__(self, file: Path | None, name: str, policy: Mapping[str, Any], rate: float | None = None) -> None:
        self._policy, self._rate = policy, rate
        self._stream = rr.RecordingStream("turbopi")
        if file is None:
            self._viewer = open_viewer()
            self._stream.connect_grpc(self._viewer.address)
        else:
            self._stream.save(file)
        self._stream.send_recording_name(name)
        self._last: dict[str, ViewedCall] = {}
        self._views: dict[str, rrb.Container] = {}

    def close(self) -> None:
        """Draw what is still to be drawn, and wait until all is written or handed to the viewer."""
        for call in self._last.values():
            self._draw_executed(call, None)
        self._stream.flush()
        self._stream.disconnect()

    def trouble(self, trouble: ViewedTrouble) -> None:
        self._stream.set_time("time", timestamp=trouble.time)
        level = rr.TextLogLevel.ERROR if trouble.serious else rr.TextLogLevel.WARN
        self._stream.log("errors", rr.TextLog(trouble.text, level=level))

    def call(self, call: ViewedCall) -> None:
        before = self._last.get(call.robot)
        if before is None:
            self._lay_out(call)
        elif before.number + 1 == call.number:
            self._draw_executed(before, call.time)
        self._last[call.robot] = call
        self._stream.set_time("time", timestamp=call.time)
        self._stream.set_time("call", sequence=call.number)
        for camera, camera_image in call.camera_images.items():
            image = rr.EncodedImage(contents=camera_image.data, media_type=camera_image.media_type)
            self._stream.log(_path(call, "cameras", camera), image)
        for key, values in call.numbers.items():
            self._stream.log(_path(call, "state", key), rr.Scalars(values))
        for stage, milliseconds in call.timing.items():
            self._stream.log(_path(call, "latency", stage), rr.Scalars(milliseconds))
        if before is None or before.prompt != call.prompt:
            self._stream.log(_path(call, "prompt"), rr.TextDocument(call.prompt))
        if call.actions is not None:
            chunk = rr.Tensor(call.actions, dim_names=("step", "dimension"))
            self._stream.log(_path(call, "chunk", "values"), chunk)
            for group in self._groups(call.actions):
                self._stream.log(_path(call, "chunk", group.title), _drawn(group, call.actions))

    def _groups(self, actions: np.ndarray) -> list[ActionGroup]:
        return action_groups(str(self._policy.get("robot", "")), actions.shape[1], names_of(self._policy, "actions"))

    def _draw_executed(self, call: ViewedCall, until: float | None) -> None:
        """The actions of a call that were carried out before the answer of the next one came; all, if there is none."""
        if self._rate is None or call.actions is None:
            return
        times = call.time + np.arange(len(call.actions)) / self._rate
        count = len(times) if until is None else int(np.searchsorted(times, until))
        for group in self._groups(call.actions):
            self._stream.send_columns(
                "/".join(_escaped(_path(call, "executed", group.title))),
                indexes=[rr.TimeColumn("time", timestamp=times[:count])],
                columns=rr.Scalars.columns(scalars=call.actions[:count, list(group.names)]),
            )

    def _lay_out(self, call: ViewedCall) -> None:
        """Names of the series, and a view for what the robot's first call has."""

        def origin(*parts: str) -> str:
            return "/".join(_escaped(_path(call, *parts)))

        groups = [] if call.actions is None else self._groups(call.actions)
        state = names_of(self._policy, "state") or []
        for key, values in call.numbers.items():
            names = state if len(state) == len(values) else None
            lines = rr.SeriesLines(names=names, colors=_colors(len(values)))
            self._stream.log(_path(call, "state", key), lines, static=True)
        if self._rate is not None:
            for group in groups:
                lines = rr.SeriesLines(names=list(group.names.values()), colors=_colors(len(group.names)))
                self._stream.log(_path(call, "executed", group.title), lines, static=True)
        cameras = [rrb.Spatial2DView(origin=origin("cameras", camera), name=camera) for camera in call.camera_images]
        bounds = rrb.VisualBounds2D(x_range=(0, WIDTH), y_range=(-0.05 * HEIGHT, 1.05 * HEIGHT))
        drawn = [
            rrb.Spatial2DView(origin=origin("chunk", group.title), name=_title(group), visual_bounds=bounds)
            for group in groups
        ]
        there = {"state": bool(call.numbers), "latency": bool(call.timing), "executed": self._rate is not None}
        series = [name for name, any_of_it in there.items() if any_of_it]
        self._views[call.robot] = rrb.Vertical(
            rrb.Horizontal(rrb.TextDocumentView(origin=origin("prompt"), name="prompt"), *cameras),
            rrb.Horizontal(*drawn),
            rrb.Horizontal(*(rrb.TimeSeriesView(origin=origin(name), name=name) for name in series)),
            rrb.TextLogView(origin="errors", name="errors"),
            row_shares=(4, 3, 3, 1),
            name=call.robot or "robot",
        )
        layout = next(iter(self._views.values())) if len(self._views) == 1 else rrb.Tabs(*self._views.values())
        self._stream.send_blueprint(rrb.Blueprint(layout, rrb.TimePanel(timeline="time"), collapse_panels=True))


def _path(call: ViewedCall, *parts: str) -> list[object]:
    """An entity's path. Keys of observations have slashes, which divide here, too."""
    joined = [call.robot, *(piece for part in parts for piece in part.split("/"))]
    return [part for part in joined if part]


def _escaped(path: Sequence[object]) -> list[str]:
    return [rr.escape_entity_path_part(str(part)) for part in path]


def _title(group: ActionGroup) -> str:
    if group.limits is None:
        return f"{group.title}, {group.unit}, from its least value to its greatest"
    low, high = group.limits
    return f"{group.title}, {group.unit}, {low:.3g} to {high:.3g}"


def _drawn(group: ActionGroup, actions: np.ndarray) -> rr.LineStrips2D:
    """One line a dimension, between the group's limits, or those of the values where it has none."""
    values = np.nan_to_num(actions[:, list(group.names)])
    low, high = group.limits or (float(values.min()), float(values.max()))
    x = np.linspace(0, WIDTH, len(values))
    y = HEIGHT * (1 - (values - low) / max(high - low, 1e-9))
    strips = [np.column_stack([x, column]) for column in y.T]
    names = list(group.names.values())
    return rr.LineStrips2D(strips, colors=_colors(len(strips)), labels=names, show_labels=False)


def _colors(count: int) -> list[tuple[int, int, int]]:
    """Of so many dimensions: the same for a dimension wherever it is drawn."""
    return [COLORS[number % len(COLORS)] for number in range(count)]
