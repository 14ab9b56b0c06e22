"""The protocol, in the real simulator. Skipped without it: pip install 'turbopi[libero]', and libosmesa6 or EGL."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_helpers import turbopi
from evaluate_fakes import SeekingPolicy

from turbopi.evaluate.plan import Protocol, VideoPlan, choose_tasks, make_jobs
from turbopi.evaluate.run import evaluate, prepare
from turbopi.evaluate.sources import LocalPolicy, PolicyRefused
from turbopi.policy.policy import UnifiedPolicy
from turbopi.policy.shipped import SMALL_POLICY
from turbopi.sim import SimSettings, SimulatorUnavailable, create
from turbopi.sim.libero import LiberoEnvironment, openpi_state

try:
    create("libero").check()
except SimulatorUnavailable as error:
    pytest.skip(str(error), allow_module_level=True)

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]  # the simulator's libraries warn as they like
SUITE, TASK = "libero_spatial", 0
PX = 128


@pytest.fixture(scope="module")
def environment() -> Iterator[LiberoEnvironment]:
    made = LiberoEnvironment(SUITE, TASK, SimSettings(camera_px=PX))
    yield made
    made.close()


@pytest.fixture(scope="module")
def stock(environment: LiberoEnvironment) -> Iterator[Any]:
    """LIBERO's own environment of the same task; it takes seconds to make."""
    from libero.libero.envs import OffScreenRenderEnv

    made = OffScreenRenderEnv(bddl_file_name=environment.domain.bddl_file_name, camera_heights=PX, camera_widths=PX)
    yield made
    made.close()


def actions(count: int, seed: int = 0) -> np.ndarray:
    moves = np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 6))
    return np.concatenate([moves, -np.ones((count, 1))], axis=1)


def play(environment: LiberoEnvironment, initial_state: int, steps: int = 10) -> list[np.ndarray]:
    """Everything that is observed: at the start, and after every fifth step."""
    environment.reset(initial_state)
    seen = [environment.observation()]
    for number, action in enumerate(actions(steps), start=1):
        environment.step(action, look=number % 5 == 0)
        if number % 5 == 0:
            seen.append(environment.observation())
    camera_images = [one[key] for one in seen for key in ("observation/image", "observation/wrist_image")]
    return camera_images + [one["observation/state"] for one in seen] + [np.array(environment.domain.sim.data.qpos)]


def test_the_episode_starts_from_the_bundled_initial_state(environment: LiberoEnvironment) -> None:
    for state in (0, 7):
        environment.reset(state)
        wanted = environment.initial_states[state]
        names = environment.domain.objects_dict
        for name, thing in names.items():
            address = environment.domain.sim.model.get_joint_qpos_addr(thing.joints[0])
            bundled = wanted[1 + address[0] : 1 + address[0] + 3]  # a flattened state begins with the time
            now = environment.domain.sim.data.qpos[address[0] : address[0] + 3]
            assert np.linalg.norm(now[:2] - bundled[:2]) < 0.02, name  # where it was put,
            assert -0.08 < now[2] - bundled[2] < 0.005, name  # and fallen onto what is below
    moved = environment.initial_states[0] - environment.initial_states[7]
    assert np.abs(moved).max() > 0.02  # the two states differ, so that a lost one would be seen


def test_observations_equal_those_of_the_stock_environment(environment: LiberoEnvironment, stock: Any) -> None:
    settings = environment.settings
    stock.seed(settings.episode_seed(TASK, 3))
    stock.reset()
    obs = stock.set_init_state(environment.initial_states[3])
    for _ in range(settings.wait_steps):
        obs, *_ = stock.step([0.0] * 6 + [-1.0])
    environment.reset(3)
    for number in range(11):
        if number % 5 == 0:
            mine = environment.observation()
            assert (mine["observation/image"] == obs["agentview_image"][::-1, ::-1]).all()
            assert (mine["observation/wrist_image"] == obs["robot0_eye_in_hand_image"][::-1, ::-1]).all()
            assert (mine["observation/state"] == openpi_state(obs)).all()
        action = actions(11)[number]
        environment.step(action, look=number % 5 == 4)
        obs, *_ = stock.step(action.tolist())


def test_pictures_are_upright_and_mirrored(environment: LiberoEnvironment) -> None:
    environment.reset(0)
    camera_image = environment.observation()["observation/image"]
    sim = environment.domain.sim
    seen = {}
    for name, thing in environment.domain.objects_dict.items():
        seen[name] = sim.data.body_xpos[sim.model.body_name2id(thing.root_body)]
    # The camera looks at the robot: world y grows to its right, in a true image; mirrored, to the left.
    camera = sim.model.camera_name2id("agentview")
    right = sim.data.cam_xmat[camera].reshape(3, 3)[:, 0]
    plate = seen["plate_1"] - sim.data.cam_xpos[camera]
    reddish = camera_image[..., 0].astype(int) - camera_image[..., 2] > 60  # the plate's rim
    reddish[: PX // 2] = False
    centre = np.nonzero(reddish)[1].mean() / PX - 0.5
    assert np.sign(centre) == -np.sign(plate @ right)
    assert camera_image[: PX // 8].std() < camera_image[PX // 2 :].std()  # the wall is above, the table below


def test_an_episode_is_the_same_whatever_ran_before(environment: LiberoEnvironment) -> None:
    first = play(environment, 4)
    play(environment, 9, steps=5)
    for one, other in zip(first, play(environment, 4), strict=True):
        assert (one == other).all()


def test_seeding_by_task_is_openpis(stock: Any) -> None:
    mine = LiberoEnvironment(SUITE, TASK, SimSettings(camera_px=PX, seeding="task"))
    mine.reset(1)  # the resets of skipped episodes are made up for
    fixtures = np.array(mine.domain.sim.model.body_pos)
    stock.seed(7)
    for _ in range(2):
        stock.reset()
    assert (np.array(stock.sim.model.body_pos) == fixtures).all()
    mine.reset(0)
    assert (np.array(mine.domain.sim.model.body_pos) != fixtures).any()
    mine.close()


def test_success_is_the_simulators_own_verdict(environment: LiberoEnvironment) -> None:
    environment.reset(0)
    still = np.array([0.0] * 6 + [-1.0])
    assert not environment.step(still, look=False)
    sim, objects = environment.domain.sim, environment.domain.objects_dict
    plate = sim.data.get_joint_qpos(objects["plate_1"].joints[0])[:3]
    bowl = objects["akita_black_bowl_1"].joints[0]
    sim.data.set_joint_qpos(
        bowl, np.concatenate([plate + np.array([0, 0, 0.03]), [1, 0, 0, 0]])
    )  # put it there by hand
    verdicts = [environment.step(still, look=False) for _ in range(10)]
    assert verdicts[-1]


def test_actions_of_another_width_end_a_run_in_libero_and_what_was_finished_stays(tmp_path: Path) -> None:
    simulator = create("libero")
    protocol = Protocol("libero", SUITE, SimSettings(camera_px=64), image_px=64, max_steps=6)
    videos = VideoPlan("none")
    jobs = make_jobs(choose_tasks(simulator, SUITE, [0]), [0, 1], None, videos)

    class Widening(SeekingPolicy):
        """Its second episode gets actions that the controller can't take."""

        def infer_batch(self, observations: Any, seed: Any) -> Any:
            results = super().infer_batch(observations, seed)
            wide = len(self.batches) == 3
            return [{"actions": np.zeros((10, 9))} if wide else result for result in results]

    source = LocalPolicy(Widening())
    results = prepare(tmp_path, protocol, source, simulator, jobs, restart=False)
    with pytest.raises(PolicyRefused, match=r"\[10, 9\]; expected at least 5 actions of 7"):
        evaluate(results, protocol, source, simulator, jobs, num_workers=1, max_batch=1, videos=videos)
    (first,) = results.in_order()
    assert (first.status, first.steps) == ("failure", 6)
    assert json.loads(results.path.read_text())["versions"]["simulator"]["mujoco"] == "3.2.3"


@pytest.mark.usefixtures("two_layers")
def test_the_command_runs_two_tasks_with_random_weights(tmp_path: Path) -> None:
    command = "eval libero --random-weights pi05_tiny --precision f32 --steps 2 --suite libero_spatial --tasks 0,1"
    arguments = [*f"{command} --trials 1 --max-steps 6 --camera-px 64 --json".split(), "--out", str(tmp_path)]
    done = turbopi(*arguments)
    assert done.exit_code == 0, done.output
    reported = json.loads(done.stdout)
    assert reported["episodes"] == 2 and reported["success"]["trials"] == 2 and reported["crashes"] == 0
    assert len(list((tmp_path / "videos").iterdir())) == 2


def test_the_small_policy_solves_tasks_it_was_trained_for(tmp_path: Path) -> None:
    """Seeded. It solves 40 of 40 on a GPU machine's renders; should physics or renders differ, one of two suffices."""
    simulator, protocol, videos = create("libero"), Protocol("libero", SUITE), VideoPlan("none")
    source = LocalPolicy(UnifiedPolicy(SMALL_POLICY, backend="pytorch", precision="f32", device="cpu"))

    def solves(task: int) -> bool:
        jobs = make_jobs(choose_tasks(simulator, SUITE, [task]), [30], None, videos)
        results = prepare(tmp_path / str(task), protocol, source, simulator, jobs, restart=False)
        evaluate(results, protocol, source, simulator, jobs, num_workers=1, max_batch=1, videos=videos)
        return all(episode.success for episode in results.in_order())

    assert solves(0) or solves(2)
