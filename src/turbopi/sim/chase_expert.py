"""The expert of the chase: it knows where things are, how fast the target runs and which way, and not when it turns.

It runs to where the target will be, if that stays on its way, around the post on one of the two sides. N episodes at
once, as `Chase`. Sides are +1 (counterclockwise around the post) and -1.
"""

import numpy as np

from turbopi.sim.chase import POST, SPEED, Chase, cut, polar

MARGIN = 0.06  # from the post
AHEAD = 28  # steps that it looks ahead
INDIFFERENCE = 2.0  # steps: how much longer the chosen way around may well be
_CLEARANCE = POST + MARGIN


def plan(world: Chase, horizon: int, sides: np.ndarray) -> np.ndarray:
    """The next actions float64[N, horizon, 2], if the target stays on its way. `sides` [N]: see `choose_sides`."""
    tip, actions = world.tip, []
    for step in range(horizon):
        length, direction, _ = _way(world, tip, step, sides)
        actions.append(direction * np.minimum(1, length / SPEED)[:, None])
        tip = tip + SPEED * cut(actions[-1])
    return np.stack(actions, axis=1)


def choose_sides(world: Chase, generator: np.random.Generator) -> np.ndarray:
    """±1 [N]: the quicker way around, mostly; any of the two where they take about as long."""
    times = [_way(world, world.tip, 0, np.full(len(world.tip), side))[2] for side in (1, -1)]
    chance = 1 / (1 + np.exp((times[0] - times[1]) / INDIFFERENCE))
    return np.where(generator.uniform(size=len(chance)) < chance, 1, -1)


def keep_sides(world: Chase, sides: np.ndarray) -> np.ndarray:
    """`sides`, each exchanged where the other way around is clearly quicker."""
    own, other = (_way(world, world.tip, 0, chosen)[2] for chosen in (sides, -sides))
    return np.where(other < own - 2 * INDIFFERENCE, -sides, sides)


def _way(world: Chase, tip: np.ndarray, step: int, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """To where tip and target meet first: the way's length in the next step, its direction now, and steps until then.

    Shapes [N], [N, 2], [N].
    """
    ahead = np.arange(1, AHEAD + 1)
    angles = world.angle[:, None] + (world.pace / world.orbit)[:, None] * (step + ahead)
    meetings = polar(angles, np.repeat(world.orbit[:, None], AHEAD, axis=1))  # [N, AHEAD, 2]
    lengths, directions = _around(tip[:, None], meetings, sides[:, None])
    late = lengths - SPEED * ahead
    first = np.where((late <= 0).any(axis=1), (late <= 0).argmax(axis=1), late.argmin(axis=1))
    rows = np.arange(len(tip))
    steps = ahead[first] + np.maximum(late[rows, first], 0) / SPEED
    return lengths[rows, first] / ahead[first], directions[rows, first], steps


def _around(tip: np.ndarray, place: np.ndarray, side: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The way from tips [N, 1, 2] to places [N, K, 2], past the post on a side [N, 1]: length, direction at its start.

    Straight where the post isn't in the way; else along tangents and the circle between them.
    """
    line = place - tip
    straight = np.linalg.norm(line, axis=-1)
    along = np.clip(-(tip * line).sum(-1) / np.maximum(straight**2, 1e-9), 0, 1)
    blocked = np.linalg.norm(tip + along[..., None] * line, axis=-1) < _CLEARANCE
    here, there = (np.maximum(np.linalg.norm(at, axis=-1), _CLEARANCE + 1e-6) for at in (tip, place))
    turn = np.arctan2(place[..., 1], place[..., 0]) - np.arctan2(tip[..., 1], tip[..., 0])
    turn = (turn * side) % (2 * np.pi)  # how far around, on that side
    arc = np.maximum(turn - np.arccos(_CLEARANCE / here) - np.arccos(_CLEARANCE / there), 0)
    length = np.sqrt(here**2 - _CLEARANCE**2) + np.sqrt(there**2 - _CLEARANCE**2) + _CLEARANCE * arc
    inwards = np.arcsin(_CLEARANCE / here)  # between the tangent and the way to the post's middle
    to_middle = np.arctan2(-tip[..., 1], -tip[..., 0])
    tangent = to_middle - side * inwards
    direction = np.stack((np.cos(tangent), np.sin(tangent)), axis=-1)
    direction = np.broadcast_to(direction, line.shape)
    unit = line / np.maximum(straight, 1e-9)[..., None]
    return np.where(blocked, length, straight), np.where(blocked[..., None], direction, unit)
