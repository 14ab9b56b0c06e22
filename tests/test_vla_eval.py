"""examples/vla_eval_server.py: a benchmark's observations to the policy's keys, chunks to actions, mistakes to errors.

The last test runs vla-evaluation-harness's own client, server and LIBERO class; the others stand in for it.
"""

import asyncio
import importlib.util
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from serve_fakes import FakePolicy

from turbopi import ConfigError, ObservationError
from turbopi.realtime import ServerLost
from turbopi.serve import running

EXAMPLE = Path(__file__).parents[1] / "examples" / "vla_eval_server.py"
STATE = np.linspace(-1, 1, 8)
IMAGE = np.arange(256 * 256 * 3, dtype=np.uint8).reshape(256, 256, 3)
LIBERO: dict[str, Any] = {  # as the harness's client sends it, with the parameters that the server requests
    "images": {"agentview": IMAGE, "wrist": IMAGE[::-1].copy()},
    "task_description": "put the bowl away",
    "states": STATE,
    "controller_states": np.zeros(8, np.float32),
}


def load() -> Any:
    spec = importlib.util.spec_from_file_location("vla_eval_server", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The example, without the harness."""
    has: dict[str, dict[str, Any]] = {
        "model_servers.base": {"ModelServer": object, "SessionContext": SimpleNamespace},
        "model_servers.serve": {"run_server": None},
        "specs": dict.fromkeys(("IMAGE_RGB", "LANGUAGE", "RAW")) | {"DimSpec": lambda *fields: fields},
    }
    for name in ("", "model_servers", *has):
        module = ModuleType("vla_eval")
        vars(module).update(has.get(name, {}))
        monkeypatch.setitem(sys.modules, f"vla_eval.{name}".strip("."), module)
    return load()


@pytest.fixture
def policy() -> Iterator[SimpleNamespace]:
    fake = FakePolicy()
    with running(fake) as server:
        yield SimpleNamespace(fake=fake, url=server.url)


def episode(server: Any, *observations: dict[str, Any], start: bool = True) -> list[np.ndarray]:
    """The actions of one episode. An error ends it."""
    sent: list[np.ndarray] = []

    async def send_action(action: dict[str, Any]) -> None:
        sent.append(action["actions"])

    async def run() -> None:
        ctx = SimpleNamespace(session_id="s", send_action=send_action)
        if start:
            await server.on_episode_start({}, ctx)
        try:
            for observation in observations:
                await server.on_observation(observation, ctx)
        finally:
            await server.on_episode_end({}, ctx)

    asyncio.run(run())
    return sent


@pytest.mark.parametrize(("restart", "calls"), [(None, 2), (1, 2), (2, 2), (3, 3)])
def test_a_chunk_lasts_until_it_is_used_up_or_the_instruction_changes(
    example: Any, policy: SimpleNamespace, restart: int | None, calls: int
) -> None:
    """Of two actions a chunk. A step that needs no chunk needs no images: RoboTwin skips some."""
    steps = [LIBERO, {"task_description": "skipped"}, LIBERO, {"task_description": "skipped"}]
    if restart is not None:
        steps[restart] = LIBERO | {"episode_restart": True}
    actions = episode(example.TurboPi(policy.url, chunk_size=2), *steps[: 3 if restart == 1 else 4])
    assert len(policy.fake.seen) == calls
    np.testing.assert_array_equal(actions, [STATE.astype(np.float32)] * len(actions), strict=True)


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "no wrist": ({"images": {"agentview": IMAGE}}, r"sent no 'images/wrist' but \['images/agentview', .*--args.keys"),
    "no images": ({"images": None}, r"sent no 'images/agentview' but \['controller_states', 'images', 'states'"),
    "nan": ({"states": np.full(8, np.nan)}, "observation/state holds nan"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_mistake_is_named_and_the_next_episode_has_a_chunk_of_its_own(
    example: Any, policy: SimpleNamespace, case: str
) -> None:
    wrong, text = BAD[case]
    server = example.TurboPi(policy.url, chunk_size=2)
    assert len(episode(server, LIBERO)) == 1
    with pytest.raises(ObservationError, match=text):
        episode(server, LIBERO | wrong)
    with pytest.raises(ObservationError, match="before the start of an episode"):
        episode(server, LIBERO, start=False)
    assert len(episode(server, LIBERO)) == 1 and len(policy.fake.seen) == 2


@pytest.mark.parametrize(
    ("metadata", "text"),
    [
        ({"action_horizon": 4}, "chunk_size is 5; expected 1 to 4,"),
        ({"memory": {}}, "must see every step"),
        ({"real_time": {"execution": "rtc"}}, "serve without --execution"),
    ],
)
def test_a_policy_that_does_not_fit_is_refused_at_the_start(
    example: Any, monkeypatch: pytest.MonkeyPatch, metadata: dict[str, Any], text: str
) -> None:
    server = nullcontext(SimpleNamespace(metadata=metadata))
    monkeypatch.setattr(example, "RealTimeClient", lambda *given, **options: server)
    with pytest.raises(ConfigError, match=text):
        example.TurboPi()


def test_a_lost_policy_is_the_observations_error_never_the_starts(example: Any) -> None:
    """The harness reads no answer to an episode's start: it would take the error for the first observation's."""
    with running(FakePolicy()) as policy:
        server = example.TurboPi(policy.url, chunk_size=2)
    assert episode(server) == []
    with pytest.raises(ServerLost, match="no policy server at ws://"):
        episode(server, LIBERO)


def test_keys_of_ones_own_have_actions_of_ones_own(example: Any, policy: SimpleNamespace) -> None:
    own = partial(example.TurboPi, policy.url, chunk_size=2, keys={"observation/state": "joint_state"})
    assert len(episode(own(), {"joint_state": STATE})) == 1
    assert own().get_action_spec() == {"actions": None}  # RAW: the harness warns that nobody said what they are
    assert own(actions={"joints": "joint_positions"}).get_action_spec() == {"joints": ("joints", 0, "joint_positions")}


@pytest.mark.slow
def test_the_harness_itself_runs_liberos_episodes(policy: SimpleNamespace) -> None:
    """LIBERO's class of the harness, with no simulator below it."""
    pytest.importorskip("vla_eval", reason="pip install vla-eval, with its dependencies")
    import anyio.from_thread
    from vla_eval.benchmarks.base import StepResult
    from vla_eval.benchmarks.libero.benchmark import LIBEROBenchmark
    from vla_eval.connection import Connection
    from vla_eval.model_servers.serve import serve_async
    from vla_eval.runners.sync_runner import SyncEpisodeRunner
    from vla_eval.specs import DimSpec, check_specs

    images = {"agentview_image": IMAGE, "robot0_eye_in_hand_image": IMAGE[::-1]}
    quaternion = np.array([0.0, 0, 0, 1])
    arm = {"robot0_eef_pos": STATE[:3], "robot0_eef_quat": quaternion, "robot0_gripper_qpos": STATE[6:]}
    carried_out: list[np.ndarray] = []

    class Simulator(LIBEROBenchmark):  # type: ignore[misc]
        def reset(self, task: dict[str, Any]) -> Any:
            controller = SimpleNamespace(ee_pos=np.zeros(3), ee_ori_mat=np.eye(3))
            self._env = SimpleNamespace(robots=[SimpleNamespace(controller=controller)])
            return images | arm

        def step(self, action: dict[str, Any]) -> Any:
            carried_out.append(action["actions"])
            return StepResult(obs=images | arm, reward=0.0, done=False, info={})

    async def evaluate(url: str) -> None:
        connection = Connection(url)
        await connection.connect(benchmark="libero")
        about = connection.server_info
        specs = {of: {name: DimSpec.from_dict(one) for name, one in about[of].items()} for of in about if "spec" in of}
        libero = Simulator(**about["observation_params"])
        sent, taken = specs["observation_spec"], specs["action_spec"]
        assert not check_specs(taken, libero.get_action_spec(), sent, libero.get_observation_spec())
        for steps in (3, 2):
            await SyncEpisodeRunner().run_episode(libero, {"name": "a task"}, connection, max_steps=steps)
        await connection.start_episode({})
        with pytest.raises(RuntimeError, match=r"sent no 'images/agentview' but \['task_description'\]"):
            await connection.act({"task_description": "nothing else"})
        await connection.close()

    with anyio.from_thread.start_blocking_portal() as portal:
        server = load().TurboPi(policy.url, chunk_size=2)
        task, port = portal.start_task(partial(serve_async, server, "127.0.0.1", 0))
        asyncio.run(evaluate(f"ws://127.0.0.1:{port}"))
        task.cancel()
    got = policy.fake.observations["a task"]
    np.testing.assert_array_equal(got["observation/image"], IMAGE[::-1, ::-1])  # turned by the harness, once
    np.testing.assert_array_equal(got["observation/wrist_image"], IMAGE[:, ::-1])
    expected = np.concatenate([STATE[:3], np.zeros(3), STATE[6:]])
    np.testing.assert_allclose(got["observation/state"], expected)
    np.testing.assert_allclose(carried_out, [expected] * 5, rtol=1e-6)
    assert len(policy.fake.seen) == 2 + 1
