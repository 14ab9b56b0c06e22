"""The dynamic task: the same whenever it is played, and one that forgives no delay, which its expert shows."""

from dataclasses import replace

import numpy as np
import pytest

from turbopi.sim import SimSettings, create
from turbopi.sim.chase import HOLD, MAX_STEPS, POST, RADIUS, SPEED, Chase, ChaseEnvironment, cut
from turbopi.sim.chase_expert import choose_sides, keep_sides, plan

HORIZON, EVERY = 16, 5


def worlds(episodes: int) -> Chase:
    world = Chase.start([np.random.default_rng([5, row]) for row in range(episodes)])
    for _ in range(10):
        world.step(np.zeros((episodes, 2)))
    return world.cleared()


def expert_success(way: str, delay: int, episodes: int = 150) -> float:
    """The expert's chunks carried out under a delay: it stands still ("sync"), just goes on ("async"), or its new plan
    begins with the actions that are on their way ("joined").
    """
    world, rng = worlds(episodes), np.random.default_rng(0)
    solved, sides = np.zeros(episodes, np.bool_), choose_sides(world, rng)
    chunk, row, coming, due = plan(world, HORIZON, sides), 0, None, -1
    for step in range(MAX_STEPS):
        if coming is None and row >= EVERY:
            if way == "joined":
                tip = world.tip
                for ahead in range(delay):
                    tip = tip + SPEED * cut(chunk[:, row + ahead])
                later = replace(world, tip=tip, angle=world.angle + world.pace / world.orbit * delay)
                sides = keep_sides(later, sides)
                coming = np.concatenate((chunk[:, row : row + delay], plan(later, HORIZON - delay, sides)), axis=1)
            else:
                coming = plan(world, HORIZON, choose_sides(world, rng))
            due = step + delay
        if coming is not None and step == due:
            chunk, row, coming = coming, 0 if way == "sync" else delay, None
        waits = way == "sync" and coming is not None
        solved |= world.step(np.zeros((episodes, 2)) if waits else chunk[:, row])
        row += not waits
    return float(solved.mean())


def test_a_delay_costs_the_expert_its_success_unless_its_chunks_join() -> None:
    ideal, naive, joined = expert_success("async", 0), expert_success("async", 4), expert_success("joined", 4)
    assert ideal > 0.95
    assert naive < ideal - 0.2
    assert joined > naive + 0.1
    assert expert_success("sync", 4) < 0.3  # it stands still while the target runs


def test_an_episode_is_the_same_whenever_it_is_played() -> None:
    def played(first: int) -> list[np.ndarray]:
        environment = ChaseEnvironment(0, SimSettings(camera_px=16))
        environment.reset(first)
        environment.step(np.ones(7), look=False)
        environment.reset(3)
        seen = []
        for step in range(70):
            environment.step(np.sin(np.arange(7) + step), look=True)
            seen.append(np.stack(list(environment.draw())))
        return seen

    once, again = played(0), played(9)
    assert all((one == other).all() for one, other in zip(once, again, strict=True))
    assert (once[0] != once[-1]).any()


def test_holding_the_target_solves_it_and_touching_the_post_never_does() -> None:
    world = worlds(2)
    world.tip = np.stack((world.target[0], np.array([POST + 0.03, 0.0])))
    for step in range(HOLD + 2):
        to_target = (world.target[0] - world.tip[0]) / SPEED
        solved = world.step(np.stack((to_target, [-1.0, 0.0])))
        assert solved[0] == (step >= HOLD - 1)
    assert world.stopped.tolist() == [False, True] and not solved[1]
    world.tip[1] = world.target[1]
    for _ in range(HOLD + 1):
        assert not world.step(np.zeros((2, 2)))[1]


def test_pictures_show_where_target_and_tip_are() -> None:
    world, px = worlds(4), 64
    for camera_image, target, tip in zip(world.draw(px)[:, 0], world.target, world.tip, strict=True):
        for channel, place in ((0, target), (2, tip)):
            row, column = np.unravel_index(int(camera_image[..., channel].argmax()), (px, px))
            found = np.array([(column + 0.5) / px * 2 - 1, 1 - (row + 0.5) / px * 2])
            assert np.abs(found - place).max() < RADIUS


def test_it_has_the_observations_of_the_other_simulators() -> None:
    chase, settings = create("chase"), SimSettings(camera_px=32)
    example, reachers = chase.example(settings), create("reacher").example(settings)
    assert example.keys() == reachers.keys()
    for key in ("observation/image", "observation/wrist_image", "observation/state"):
        assert (example[key].shape, example[key].dtype) == (reachers[key].shape, reachers[key].dtype)


@pytest.mark.parametrize("name", ["libero", "reacher", "chase"])
def test_a_robot_that_stands_still_doesnt_move(name: str) -> None:
    simulator = create(name)
    still = simulator.standing_still(np.arange(1.0, 8.0))  # type: ignore[attr-defined]
    assert not still[: simulator.motion_dim].any()  # type: ignore[attr-defined]
    assert still.shape == (7,) and (name != "libero" or still[6] == 7.0)
