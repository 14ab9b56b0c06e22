"""Episodes in real time: the world advances with the wall clock, while the policy computes in the background.

The robot's side is `turbopi.realtime.RealTimeExecutor`, as on a robot. Delays are what they are, and are measured.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from turbopi.evaluate.episode import Ending, Execution, NoActions
from turbopi.evaluate.frames import Frame, Reel
from turbopi.evaluate.motion import Commands
from turbopi.evaluate.pacing import Paced, Pacer
from turbopi.evaluate.plan import Job
from turbopi.realtime import Command, RealTimeExecutor
from turbopi.realtime.inference import BackgroundThread, Inference
from turbopi.sim import Environment
from turbopi.support.errors import ConfigError

MAX_OBSERVATION_AGE_S: Final = 600.0  # far above any policy's latency: a slow policy is measured, not refused
_STEP: Final = "turbopi.evaluate/step"  # the key under which an observation carries its step through the executor


# As `episode.Ask`; step None: to warm the policy up
Ask = Callable[[int | None, dict[str, object], Mapping[str, Any]], Mapping[str, Any]]


class Unfit(Exception):
    """The policy can't be run in this way in real time."""


class RealTimeLoop:
    """The control loop beside a simulator, for one episode after the other.

    ask           the policy; called on a thread that does nothing else
    offered       what the policy offers for chunks that join: its metadata's "real_time"
    control_hz    control steps in a second of the wall clock
    clock, sleep, inference
                  the wall clock in seconds, what waits for it, and what runs the policy: for tests
    """

    def __init__(
        self,
        ask: Ask,
        offered: Mapping[str, Any],
        execution: Execution,
        control_hz: float,
        *,
        action_dim: int,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
        inference: Inference | None = None,
    ) -> None:
        self._execution = execution
        self._still = np.zeros(action_dim)
        self._policy = _Policy(ask, offered, clock)
        self._inference = BackgroundThread("turbopi-eval-policy") if inference is None else inference
        self._pacer = Pacer(control_hz, clock, sleep)
        self._executor = RealTimeExecutor(
            self._policy,
            control_hz=control_hz,
            execution=execution.way,  # type: ignore[arg-type]
            execution_horizon=execution.horizon,
            max_observation_age_s=MAX_OBSERVATION_AGE_S,
            clock=clock,
            inference=self._inference,
        )
        self._warm = False
        self._requests = 0  # chunks that were asked for, in all episodes

    def run(
        self,
        environment: Environment,
        job: Job,
        *,
        max_steps: int,
        image_keys: tuple[str, ...],
        on_frame: Callable[[Frame], None] | None = None,
    ) -> Ending:
        """One episode. Its clock starts with the first observation, and the robot stands still until the first chunk.

        The policy is warmed up before the first episode. Raises Unfit if the policy is too slow for the way to run,
        and what `ask` raises; only NoActions isn't raised: that chunk is dropped, and counted.
        """
        environment.reset(job.initial_state)
        try:
            self._warm_up(environment.observation())
        except NoActions as none:
            return Ending("aborted", 0, f"warm-up: {none}; the episode was aborted")
        self._executor.reset()
        first = self._requests
        self._policy.begin_episode(first)
        commands, reel = Commands(), Reel(on_frame, smooth=False)
        step, status, standing, seen = 0, "failure", 0, True
        self._pacer.begin()
        try:
            while step < max_steps:
                self._pacer.wait()
                self._policy.check()
                camera_images = self._look(environment, step, reel, image_keys) if seen else []
                command = self._executor.next_action()
                if command.takes_over:
                    if len(commands.values) > standing:  # it takes over from another chunk
                        commands.seams.append(step)
                    if camera_images:
                        reel.camera_image(step, camera_images)
                commands.values.append(self._values(command, commands, reel, first))
                standing += command.kind != "fresh"
                step += 1
                seen = self._executor.wants_observation
                if environment.step(commands.values[-1], look=seen):
                    status = "success"
                    break
            seconds = self._pacer.seconds
        finally:  # after a crash, too: an answer that comes later would be taken for the next episode's
            self._inference.begin(lambda: None).result()  # waits until the call that is under way has ended
        self._policy.check()
        if on_frame is not None:
            for number, chunk in self._policy.chunks.items():
                reel.answered(number - first, chunk)
            reel.camera_image(step, environment.draw())
        reel.end()
        paced = self._paced(first, seconds)
        seams = [seam for seam in self._executor.seams if seam.chunk >= first]
        dims = self._execution.dims(commands)
        motion = commands.motion(dims, seams, standing=standing, dropped=sum(paced.dropped.values()))
        return Ending(status, step, None, motion, commands, paced)

    def _warm_up(self, observation: Mapping[str, Any]) -> None:
        if self._warm:
            return
        try:
            self._executor.warm_up(observation)
        except ConfigError as error:
            raise Unfit(str(error)) from error
        self._warm = True

    def _look(self, environment: Environment, step: int, reel: Reel, image_keys: tuple[str, ...]) -> list[np.ndarray]:
        """Give the executor what is seen; the images, for a video."""
        observation = environment.observation()
        camera_images = [observation[key] for key in image_keys]
        if self._executor.observe({**observation, _STEP: step}):
            self._requests += 1
            reel.requested(step)
            reel.camera_image(step, camera_images)
            return []
        return camera_images

    def _values(self, command: Command, commands: Commands, reel: Reel, first: int) -> np.ndarray:
        """What the simulator is commanded."""
        if command.kind != "fresh" or command.action is None or command.chunk is None:
            assert self._execution.stand_still is not None
            values = self._execution.stand_still(commands.values[-1] if commands.values else self._still)
            reel.act(values)
            return values
        reel.act(command.action, command.chunk - first, command.row or 0)
        return command.action

    def _paced(self, first: int, seconds: float) -> Paced:
        own = [one for one in self._executor.inferred if one.chunk >= first and one.outcome != "in flight"]
        step_ms = self._pacer.step_ms or [0.0]
        return Paced(
            delays=[one.ended - one.begun for one in own if one.ended is not None],
            latency_ms=[round(ms, 3) for ms in self._policy.latency_ms],
            dropped=dict(Counter(one.outcome for one in own if one.outcome != "used")),
            late_ms=[round(ms, 3) for ms in self._pacer.late_ms],
            step_ms=(round(float(np.median(step_ms)), 3), round(max(step_ms), 3)),
            seconds=round(seconds, 6),
        )


class _Policy:
    """The policy as the executor calls it: on another thread than everything else."""

    def __init__(self, ask: Ask, offered: Mapping[str, Any], clock: Callable[[], float]) -> None:
        self.metadata = {"real_time": dict(offered)} if offered else {}
        self._ask, self._clock = ask, clock
        self.begin_episode(0)

    def begin_episode(self, number: int) -> None:
        """`number`: of the chunk that will be asked for next."""
        self._next = number
        self._lost: BaseException | None = None
        self.latency_ms: list[float] = []
        self.chunks: dict[int, np.ndarray] = {}  # as they were answered

    def infer(
        self, observation: Mapping[str, Any], *, previous: Any = None, model_actions: bool = False
    ) -> Mapping[str, Any]:
        requested = dict(observation)
        step = requested.pop(_STEP, None)
        arguments = {"previous": previous, "model_actions": True} if model_actions else {}
        began = self._clock()
        number, self._next = self._next, self._next + (step is not None)
        try:
            result = self._ask(step, requested, arguments)
        except NoActions:
            raise
        except BaseException as error:
            self._lost = error
            raise
        if step is not None:
            self.latency_ms.append((self._clock() - began) * 1e3)
            self.chunks[number] = result["actions"]
        return result

    def check(self) -> None:
        """Raise what ended the policy, if that has happened."""
        if self._lost is not None:
            raise self._lost
