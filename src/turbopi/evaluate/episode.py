"""One episode whose world waits for the policy: exact delays, counted in control steps."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from turbopi.evaluate.frames import Frame, Reel
from turbopi.evaluate.motion import Commands, Motion
from turbopi.evaluate.pacing import Paced
from turbopi.evaluate.plan import Job
from turbopi.realtime import ChunkQueue
from turbopi.sim import Environment

# Asks the policy: (step, observation, what else it is told: `Request.arguments`) -> what `infer` returns, of which
# "actions", float64[H, d], must be there. Raises NoActions if the policy found that its actions can't be used
Ask = Callable[[int, dict[str, object], Mapping[str, Any]], Mapping[str, Any]]
# The action with which the robot stands still, after this one
StandStill = Callable[[np.ndarray], np.ndarray]


@dataclass
class Ending:
    """What the worker found out. `status` as in results.Episode, without crash."""

    status: str
    steps: int
    message: str | None = None
    motion: Motion | None = None
    commands: Commands = field(default_factory=Commands)
    paced: Paced | None = None  # of an episode in real time


@dataclass(frozen=True)
class Execution:
    """How chunks are carried out.

    way           turbopi.realtime.WAYS
    horizon       actions of a chunk after which the policy is asked again
    delay         control steps from an observation to the chunk computed from it. The episode's clock starts when the
                  first chunk is there
    stand_still   where the way, or the delay, leaves the robot without an action; None: that can't be
    motion_dims   the first dimensions of an action, which move the robot
    """

    way: str
    horizon: int
    delay: int = 0
    stand_still: StandStill | None = None
    motion_dims: int | None = None

    def dims(self, commands: Commands) -> int:
        """How many dimensions of these commands move the robot."""
        return self.motion_dims or (len(commands.values[0]) if commands.values else 0)


def run_episode(
    environment: Environment,
    job: Job,
    ask: Ask,
    execution: Execution,
    *,
    max_steps: int,
    image_keys: tuple[str, ...],
    on_frame: Callable[[Frame], None] | None = None,
    smooth: bool = False,
) -> Ending:
    """Reset, then ask and act until the task is solved or the steps are used up.

    The policy's answer is there at once, and joins the running chunk `delay` steps later: exact, and repeatable.
    """
    environment.reset(job.initial_state)
    queue = ChunkQueue(execution.way, execution_horizon=execution.horizon, delay=execution.delay)
    commands, reel = Commands(), Reel(on_frame, smooth)
    answer: Mapping[str, Any] = {}
    due, step, status, message = -1, 0, "failure", None
    refused: np.ndarray | None = None

    while step < max_steps:
        arrives = queue.in_flight is not None and step == due
        if arrives:
            queue.arrive(answer)
        if reel.wants(takes_over=arrives) and not queue.wants_observation:
            reel.camera_image(step, environment.draw())
        if queue.wants_observation:
            observation = environment.observation()
            request = queue.observe()
            reel.camera_image(step, [observation[key] for key in image_keys])
            reel.requested(step)
            try:
                answer = ask(step, observation, request.arguments)
            except NoActions as none:
                status, message = "aborted", f"step {step}: {none}; the episode was aborted"
                break
            reel.answered(request.number, answer["actions"])
            problem = _problem(answer["actions"])
            if problem is not None:
                status, message, refused = "aborted", f"step {step}: {problem}", answer["actions"]
                break
            due = step + (execution.delay if request.number else 0)
            if due == step:
                queue.arrive(answer)
        action = queue.next_action()
        if action is None:
            assert execution.stand_still is not None
            values = execution.stand_still(commands.values[-1])
            reel.act(values)
        else:
            values = action.values
            reel.act(values, action.chunk, action.row)
            if action.takes_over and action.chunk:
                commands.seams.append(step)
        commands.values.append(values)
        step += 1
        arrives = queue.in_flight is not None and due == step
        look = queue.wants_observation or (arrives and execution.delay >= execution.horizon)
        if environment.step(values, look=look):
            status = "success"
            break
    if on_frame is not None and status != "aborted":
        reel.camera_image(step, environment.draw())
    reel.end(refused)
    motion = commands.motion(
        execution.dims(commands), queue.seams, standing=queue.empty_steps, dropped=sum(queue.dropped.values())
    )
    return Ending(status, step, message, motion, commands)


def _problem(chunk: np.ndarray) -> str | None:
    """Why a chunk can't be carried out, or None."""
    bad = ~np.isfinite(chunk)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        return (
            f"the policy's actions aren't finite ({chunk[row, column]} at [{row}, {column}]); the episode was aborted"
        )
    return None


class NoActions(Exception):
    """The policy found itself that its actions can't be used."""
