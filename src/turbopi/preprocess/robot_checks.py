"""A robot held against its policy: what its `outputs` gives, and which statistics it leaves out."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from turbopi.preprocess.normalize import Normalizer
from turbopi.robots.base import Robot, RobotInputs
from turbopi.support.errors import ActionError, ConfigError, ObservationError, TurboPiError
from turbopi.support.text import kind_of


def read_observation(robot: Robot, observation: Mapping[str, object]) -> RobotInputs:
    """The robot's `inputs`. Raises ObservationError also for errors of a robot's own code, which are no fault of ours:
    most often a key that its client doesn't send.
    """
    try:
        given: Any = robot.inputs(observation)
    except TurboPiError:
        raise
    except Exception as error:
        if type(robot).__module__.startswith("turbopi."):
            raise
        raise ObservationError(
            f"robot {robot.name}: `inputs` failed on this observation: {type(error).__name__}: {error}"
        ) from error
    if not isinstance(given, RobotInputs):
        raise ObservationError(f"robot {robot.name}: `inputs` gives {kind_of(given)}, expected RobotInputs")
    return given


def width_of_outputs(robot: Robot, actions: np.ndarray) -> int:
    """How many actions a step the robot gets, found by a dry run of its `outputs`.

    actions  float64[H, D], an un-normalised chunk

    Raises ConfigError if `outputs` fails, or gives another shape than float[H, robot.action_dim].
    """
    try:
        with np.errstate(all="ignore"):
            given: Any = np.asarray(robot.outputs(actions.copy()))
    except Exception as error:
        raise ConfigError(
            f"robot {robot.name}: `outputs` failed on actions [{', '.join(map(str, actions.shape))}] of float64: "
            f"{type(error).__name__}: {error}"
        ) from error
    if given.dtype.kind not in "fiu":
        raise ConfigError(f"robot {robot.name}: `outputs` gives {given.dtype}, expected numbers: float[H, action_dim]")
    if given.ndim != 2 or given.shape[0] != len(actions) or given.shape[1] == 0:
        raise ConfigError(
            f"robot {robot.name}: `outputs` gives actions of shape {list(given.shape)}, expected "
            f"[{len(actions)}, {'action_dim' if robot.action_dim is None else robot.action_dim}]: a row for each step "
            "of the action horizon"
        )
    if robot.action_dim is not None and given.shape[1] != robot.action_dim:
        raise ConfigError(
            f"robot {robot.name}: `outputs` gives {given.shape[1]} actions a step, but its action_dim is "
            f"{robot.action_dim}: cut them in `outputs`, or set action_dim"
        )
    return int(given.shape[1])


def check_shape(robot: Robot, actions: Any, expected: tuple[int, int]) -> None:
    """Raise ActionError if the actions of a call haven't the shape that the dry run had."""
    if np.shape(actions) != expected:
        raise ActionError(
            f"robot {robot.name}: `outputs` gave actions of shape {list(np.shape(actions))}, expected "
            f"{list(expected)}. They aren't sent: look at the robot's `outputs`"
        )


def notes_on_statistics(robot: Robot, state: Normalizer, actions: Normalizer) -> list[str]:
    """What the user should know of a robot that is narrower than the statistics.

    openpi cuts the state's statistics to the state, and un-normalises all of the model's actions before the robot
    takes its own; both run here as there. It is right for a robot that leaves the last dimensions out, and wrong for
    statistics of another robot: only the user can tell. Statistics that are nothing but padding need no note.
    """
    notes = []
    done: tuple[tuple[str, int | None, Normalizer, Callable[[int, int], str]], ...] = (
        ("state", robot.state_dim, state, lambda width, extra: f"the first {width} are used"),
        ("actions", robot.action_dim, actions, lambda width, extra: f"the model's other {extra} are dropped"),
    )
    for name, width, scale, what in done:
        extra = 0 if width is None or scale.width is None else scale.width - width
        if width is not None and extra > 0 and scale.says_something_past(width):
            notes.append(
                f"robot {robot.name} has {width} values of {name}, but the checkpoint's statistics cover "
                f"{scale.width}: {what(width, extra)}, as openpi does. Are they this robot's statistics?"
            )
    return notes
