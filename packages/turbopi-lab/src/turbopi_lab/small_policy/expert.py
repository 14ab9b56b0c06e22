"""A scripted expert for libero_spatial: it knows where things are, takes a bowl by its rim and puts it on the plate.

What it does depends on the present state, not on what it did before (but for the side of the rim, chosen when an
episode begins, and a few steps back after a miss). So it can say what to do in any state that a learner has got itself
into, and a learner that sees only the present can imitate it.

Lengths in metres, world axes: x away from the robot, y to its left, z up. Actions are LIBERO's: float64[7] in [-1, 1],
three of position (1 is a set point 5 cm away), three of rotation (1 is 0.5 rad), gripper (-1 opens, 1 closes).
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

Phase = Literal["reach", "descend", "close", "lift", "carry", "lower", "release"]
PHASES: tuple[Phase, ...] = ("reach", "descend", "close", "lift", "carry", "lower", "release")

OPEN, CLOSE = -1.0, 1.0
RIM = 0.048  # the rim's radius, from the bowl's centre
GRASP_Z = 0.036  # of the grip site above the bowl's origin, when the fingers are round the rim
HOVER = 0.09  # above that, while the hand is not over the rim yet
LIFT = 0.10  # of the bowl over where it stood, before it goes sideways
CARRY_Z = 0.13  # of the bowl over the plate while it travels
PATIENCE = 20  # steps for the gripper to close
GAIN, TURN_GAIN = 16.0, 2.0
DOWN = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # the hand straight down, fingers open along y


@dataclass(frozen=True)
class Sight:
    """What the expert goes by at one moment, also the auxiliary targets of training.

    hand, bowl, plate   float64[3]: grip site and bodies
    turn                float64[3, 3]: the hand's orientation
    opening             between the fingers
    held                the bowl touches both fingers
    """

    hand: np.ndarray
    bowl: np.ndarray
    plate: np.ndarray
    turn: np.ndarray
    opening: float
    held: bool


class Expert:
    """Serves one episode of a LIBERO problem (`LiberoEnvironment.domain`), for one of its two bowls.

    Give it a new instance after each reset: it remembers where the bowl stood at first.
    """

    def __init__(self, domain: Any, bowl: str, plate: str = "plate_1") -> None:
        self._domain, self._bowl, self._plate = domain, bowl, plate
        sim = domain.sim
        self._hand_site = sim.model.site_name2id("gripper0_grip_site")
        gripper = domain.robots[0].gripper
        self._fingers = [gripper.important_geoms[name] for name in ("left_finger", "right_finger")]
        self._finger_joints = [sim.model.get_joint_qpos_addr(joint) for joint in gripper.joints]
        self._bowl_geoms = domain.get_object(bowl).contact_geoms
        self._start = self._position(bowl)
        self.rim_angle = self._choose_side()
        self._retreat = 0  # steps left of backing off after a miss
        self._closing = 0  # steps since the gripper began to close
        self.phase: Phase = "reach"

    def look(self) -> Sight:
        data = self._domain.sim.data
        opening = float(np.abs([data.qpos[joint] for joint in self._finger_joints]).sum())
        held = all(self._domain.check_contact(finger, self._bowl_geoms) for finger in self._fingers)
        return Sight(
            np.array(data.site_xpos[self._hand_site]),
            self._position(self._bowl),
            self._position(self._plate),
            np.array(data.site_xmat[self._hand_site]).reshape(3, 3),
            opening,
            held,
        )

    def act(self, sight: Sight | None = None) -> np.ndarray:
        """What to do now; sets `phase` to what it is for."""
        sight = self.look() if sight is None else sight
        if sight.held:
            self._closing = 0
        target, gripper = self._holding(sight) if sight.held else self._empty(sight)
        action = np.zeros(7)
        action[:3] = np.clip(GAIN * (target - sight.hand), -1, 1)
        action[3:6] = np.clip(TURN_GAIN * rotation_between(sight.turn, self._wanted_turn()), -1, 1)
        action[6] = gripper
        return action

    # --- what to do -----------------------------------------------------------------------------------------------

    def _empty(self, sight: Sight) -> tuple[np.ndarray, float]:
        """Come down onto the rim through a funnel: the further aside, the higher."""
        outwards = np.array([np.cos(self.rim_angle), np.sin(self.rim_angle)])
        grasp = sight.bowl + np.array([*RIM * outwards, GRASP_Z])
        missing = (grasp - sight.hand)[:2]
        across = abs(float(missing @ outwards))  # what decides whether the rim gets between the fingers
        along = abs(float(missing @ [outwards[1], -outwards[0]]))
        aside = float(np.hypot(across, max(0.0, along - 0.01)))
        turned = float(np.linalg.norm(rotation_between(sight.turn, self._wanted_turn())))
        above = float(sight.hand[2] - grasp[2])
        near = 0.016 if sight.opening < 0.075 else 0.008  # it stays closing once it has begun
        if self._retreat:
            self._retreat -= 1
        elif aside < near and above < near:
            self._closing += 1
            if sight.opening < 0.004 or self._closing > PATIENCE:
                self._retreat, self._closing = 12, 0  # the rim isn't between the fingers
            self.phase = "close"
            return grasp, CLOSE
        elif aside < 0.012 and turned < 0.15:
            self.phase = "descend"
            return grasp, OPEN
        self.phase = "reach"
        height = np.clip((aside - 0.008) * 4, 0.0, HOVER) if above < HOVER + 0.02 and aside < 0.05 else HOVER
        if turned > 0.15:
            height = max(height, HOVER)
        if aside > 0.06:
            height = max(height, min(above, 0.16))  # no need to come down while far
        return grasp + np.array([0.0, 0.0, height]), OPEN

    def _holding(self, sight: Sight) -> tuple[np.ndarray, float]:
        """Lift, carry over the plate, lower, let go."""
        offset = sight.plate - sight.bowl
        aside = float(np.linalg.norm(offset[:2]))
        height = -float(offset[2])  # of the bowl over the plate
        if aside < 0.06:  # another funnel
            if aside < 0.02 and height < 0.012:
                self.phase = "release"
                return sight.hand, OPEN
            self.phase = "lower"
            wanted = float(np.clip((aside - 0.015) * 4, 0.0, CARRY_Z))
            return sight.hand + np.array([*offset[:2], np.clip(wanted - height, -0.04, 0.04)]), CLOSE
        travelled = float(np.linalg.norm((sight.bowl - self._start)[:2]))
        clear = max(sight.plate[2] + CARRY_Z, self._start[2] + LIFT if travelled < 0.15 else 0.0)
        missing = clear - float(sight.bowl[2])
        self.phase = "lift" if missing > 0.03 else "carry"
        sideways = offset[:2] * float(np.clip((0.06 - missing) / 0.04, 0, 1))
        return sight.hand + np.array([*sideways, np.clip(missing, -0.02, 0.06)]), CLOSE

    # --- where --------------------------------------------------------------------------------------------------------

    def _choose_side(self) -> float:
        """Which point of the rim to take, as an angle: where the hand and its outer finger have room.

        By where the bowl stands, so that a learner sees the same choice every time. Beside, in and on the cabinet the
        hand must come from the robot's side, and turn by 90 degrees; else it needn't turn.
        """
        x, y, _ = self._start
        if x > -0.1 and y < -0.04:
            return float(np.pi)
        return float(np.pi / 2 if y > 0.26 else -np.pi / 2)

    def _wanted_turn(self) -> np.ndarray:
        if abs(np.sin(self.rim_angle)) > 0.5:
            return DOWN
        return np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) @ DOWN

    def _position(self, name: str) -> np.ndarray:
        return np.array(self._domain.sim.data.body_xpos[self._domain.obj_body_id[name]])


def rotation_between(current: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Axis times angle, in world axes, that takes one orientation [3, 3] to the other."""
    error = wanted @ current.T
    angle = float(np.arccos(np.clip((np.trace(error) - 1) / 2, -1, 1)))
    axis = np.array([error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]])
    length = float(np.linalg.norm(axis))
    return np.zeros(3) if length < 1e-9 else axis / length * angle
