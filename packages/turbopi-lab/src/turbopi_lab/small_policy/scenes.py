"""What is practised: the ten tasks of libero_spatial, the same scenes with the other bowl asked for, and small changes.

All ten scenes have the same furniture, two bowls and ten places for them. The bowl that a task doesn't ask for stands,
in nine of the ten, where another task's bowl does. So its prompt fits this scene too, and only the prompt tells which
bowl is meant.
"""

from dataclasses import dataclass

import numpy as np

from turbopi.sim.base import SimSettings
from turbopi.sim.libero import WAIT_ACTION, LiberoEnvironment

SUITE = "libero_spatial"
NUM_TASKS = 10
MAX_STEPS = 220  # openpi's limit for this suite
BOWL, OTHER_BOWL = "akita_black_bowl_1", "akita_black_bowl_2"
PLATE = "plate_1"
# The tasks' instructions, so that training needs no simulator; a test holds them against LIBERO's
INSTRUCTIONS = tuple(
    f"pick up the black bowl {where} and place it on the plate"
    for where in (
        "between the plate and the ramekin",
        "next to the ramekin",
        "from table center",
        "on the cookie box",
        "in the top drawer of the wooden cabinet",
        "on the ramekin",
        "next to the cookie box",
        "on the stove",
        "next to the plate",
        "on the wooden cabinet",
    )
)
# scene -> the task whose prompt asks for the other bowl, by where LIBERO's problem files put it
OTHER_PROMPT = {0: 1, 1: 6, 2: 8, 3: 9, 4: 9, 5: 3, 6: 7, 7: 9, 8: 1, 9: 7}
TRAINING_STATES = range(25)  # of LIBERO's 50 initial states a task
VALIDATION_STATES = range(25, 30)  # never trained on; 30 to 49 are for the result and used nowhere else
SHIFT = 0.03  # metres: how far an object is moved at most, along each axis
SMALL_SHIFT = 0.012  # for a bowl that stands on the stove, on the cabinet or in its drawer
# A bowl that stands on one of these moves with it
SUPPORTS = {"cookies_1": "cookies_1", "glazed_rim_porcelain_ramekin_1": "glazed_rim_porcelain_ramekin_1"}


@dataclass(frozen=True)
class Setting:
    """One episode's beginning: which scene, from where, which bowl is asked for, and a seed if things are moved."""

    scene: int
    initial_state: int
    other_bowl: bool = False
    moved_seed: int | None = None

    @property
    def prompt(self) -> int:
        """The task whose instruction is given."""
        return OTHER_PROMPT[self.scene] if self.other_bowl else self.scene

    @property
    def bowl(self) -> str:
        return OTHER_BOWL if self.other_bowl else BOWL


class PracticeScene(LiberoEnvironment):
    """The evaluation's own environment, so that images are the evaluation's; resets keep the compiled scene."""

    def __init__(self, scene: int) -> None:
        super().__init__(SUITE, scene, SimSettings())
        self.domain.hard_reset = False  # fixtures are placed by every reset all the same

    def begin(self, setting: Setting) -> None:
        """As `reset`, with the movable objects somewhat elsewhere if the setting says so. Draws the images."""
        assert setting.scene == self.task
        if setting.moved_seed is None:
            self.reset(setting.initial_state)
            return
        rng = np.random.default_rng(setting.moved_seed)
        self._look = False
        np.random.seed(int(rng.integers(2**31)))
        self._place_objects()
        self._obs = self._control.set_init_state(self.initial_states[setting.initial_state])
        self._move_objects(rng)
        waiting = self.settings.wait_steps
        for step in range(waiting):
            self.step(WAIT_ACTION, look=step == waiting - 1)

    def solved(self, setting: Setting) -> bool:
        """Whether the bowl that is asked for is on the plate, as LIBERO's own predicate has it."""
        return bool(self.domain._eval_predicate(("on", setting.bowl, PLATE)))

    # What an image shows: bodies of the scene, which resets place, and joints, which move

    def bodies(self) -> np.ndarray:
        """float64[bodies, 7]: positions and quaternions within their parents."""
        model = self.domain.sim.model
        return np.concatenate((model.body_pos, model.body_quat), axis=1)

    def place_bodies(self, bodies: np.ndarray) -> None:
        model = self.domain.sim.model
        model.body_pos[:], model.body_quat[:] = bodies[:, :3], bodies[:, 3:]

    def joints(self) -> np.ndarray:
        """float64[nq]: everything that moves."""
        return np.array(self.domain.sim.data.qpos)

    def place_joints(self, joints: np.ndarray) -> None:
        self.domain.sim.data.qpos[:] = joints
        self.domain.sim.forward()

    def _move_objects(self, rng: np.random.Generator) -> None:
        sim = self.domain.sim
        poses = {
            name: sim.data.get_joint_qpos(thing.joints[-1]).copy() for name, thing in self.domain.objects_dict.items()
        }
        shifts = {name: rng.uniform(-SHIFT, SHIFT, 2) for name in poses}
        for bowl in (BOWL, OTHER_BOWL):
            below = [name for name in SUPPORTS if np.linalg.norm((poses[name] - poses[bowl])[:2]) < 0.03]
            if below:
                shifts[bowl] = shifts[below[0]] + rng.uniform(-0.004, 0.004, 2)
            elif poses[bowl][1] < -0.1:  # furniture, which stays where it is
                shifts[bowl] = rng.uniform(-SMALL_SHIFT, SMALL_SHIFT, 2)
        for name, thing in self.domain.objects_dict.items():
            poses[name][:2] += shifts[name]
            sim.data.set_joint_qpos(thing.joints[-1], poses[name])
        sim.forward()
