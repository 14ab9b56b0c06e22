"""Fleets without Ray: a replica, what may be asked of a fleet, and the way through Ray Serve's proxy."""

import asyncio
import contextlib
import logging
import os
import re
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numpy as np
import pytest
from cli_helpers import refusal, text_of, turbopi
from serve_fakes import FakePolicy, observation
from websockets.sync.client import connect

from turbopi.cli.fleet_update import Requested
from turbopi.cli.options import PolicyOptions
from turbopi.cli.serve_ray import FleetWishes, check_fits, check_runs
from turbopi.realtime.client import RealTimeClient, ServerRefused
from turbopi.realtime.wire import pack, unpack
from turbopi.serve import PolicyServer, running
from turbopi.serve.fleet import ray_app
from turbopi.serve.fleet.fleet import STARTED_HERE, TOKEN_LOGGER, FleetOptions, check_known, import_ray, reason_in
from turbopi.serve.fleet.fleet import connect as connect_to_ray
from turbopi.serve.fleet.ray_app import Arguments, build, gpus_for, name_of, read_autoscaling, relay
from turbopi.serve.fleet.remote_calls import RemoteCalls
from turbopi.serve.fleet.replica import Replica
from turbopi.serve.metrics import Metrics
from turbopi.serve.options import ServerOptions
from turbopi.serve.requests import Result
from turbopi.serve.scheduling.schedule import Request
from turbopi.support.errors import ConfigError

TINY = ("serve", "--random-weights", "pi05_tiny")


# --- a replica --------------------------------------------------------------------------------------------------------


def replicated(
    test: Callable[[Replica, FakePolicy], Awaitable[None]],
    *,
    warm: dict[str, Any] | None = None,
    end: Callable[[], None] = lambda: None,
) -> None:
    """Run `test(replica, policy)` on one that lets a single request wait."""

    async def main() -> None:
        policy = FakePolicy()
        replica = Replica.__new__(Replica)  # as Ray Serve makes one
        options = ServerOptions(queue_limit=1)
        made: Any = replica.__init__(lambda: policy, "weights", warm, options, end, {"steps": 3})  # type: ignore[misc]
        await made
        try:
            await asyncio.wait_for(test(replica, policy), 60)
        finally:
            policy.release.set()

    asyncio.run(main())


def test_a_replica_answers_with_actions_or_whose_fault_it_is() -> None:
    async def test(replica: Replica, policy: FakePolicy) -> None:
        answer = await replica.infer(observation("left"), {})
        result = answer.result
        assert result.answer is not None and result.answer["prompt"] == "left"
        assert answer.checkpoint == "weights" and answer.seconds >= result.seconds > 0
        for obs, wrong in (
            ({}, "observation"),
            (observation("nan actions"), "actions"),
            (observation("answer nan"), "actions"),
            (observation("crash"), "policy"),
        ):
            assert (await replica.infer(obs, {})).result.error == wrong
        replica.check_health()
        assert not policy.warmed_up
        assert await replica.about() == policy.metadata
        assert await replica.started_with() == {"steps": 3}

    replicated(test)


def test_a_replica_is_warm_before_its_first_request() -> None:
    async def test(replica: Replica, policy: FakePolicy) -> None:
        assert policy.warmed_up
        await replica.infer(observation(), {})
        assert len(policy.threads) == 1

    replicated(test, warm={})


def test_a_full_replica_says_so_and_a_request_that_is_given_up_never_runs() -> None:
    async def test(replica: Replica, policy: FakePolicy) -> None:
        held = asyncio.ensure_future(replica.infer(observation("hold"), {}))
        await asyncio.to_thread(policy.started.wait, 60)
        waiting = asyncio.ensure_future(replica.infer(observation("waits"), {}))
        await asyncio.sleep(0)
        assert (await replica.infer(observation("one too many"), {})).result.error == "busy"
        waiting.cancel()
        policy.release.set()
        await held
        await replica.infer(observation("next"), {})
        assert policy.seen == ["hold", "next"]

    replicated(test)


def test_a_lost_device_is_told_and_ends_the_process() -> None:
    ended = asyncio.Event()

    async def test(replica: Replica, policy: FakePolicy) -> None:
        result = (await replica.infer(observation("lost"), {})).result
        assert result.error == "lost" and "illegal memory access" in result.text
        with pytest.raises(RuntimeError, match="the device is lost: CUDA error"):
            replica.check_health()
        await ended.wait()

    replicated(test, end=ended.set)


class SecondTimeWell(RemoteCalls):
    """Where requests are computed: the replica of the first one ends."""

    def __init__(self, metrics: Metrics, on_lost: Callable[[str], None]) -> None:
        super().__init__("arms", metrics, 60.0, on_lost=on_lost)
        self.requested = 0

    async def run(self, request: Request, observation: dict[str, Any], arguments: Mapping[str, Any]) -> Result:
        self.requested += 1
        if self.requested == 1:
            return Result(0.0, error="replica", text="its process ended during this request; ask again")
        return Result(0.0, answer={"actions": np.zeros((2, 8))})


def test_a_robot_is_told_of_a_lost_replica_and_keeps_its_connection() -> None:
    with running(FakePolicy(), calls=SecondTimeWell) as server, connect(server.url) as connection:
        connection.recv()
        connection.send(pack(observation()))
        assert connection.recv() == "the replica is lost: its process ended during this request; ask again"
        connection.send(pack(observation()))
        assert unpack(cast(bytes, connection.recv()))["actions"].shape == (2, 8)
        assert server.metrics.errors_so_far() == {"replica": 1}


def test_our_client_keeps_its_connection_too() -> None:
    with (
        running(FakePolicy(), calls=SecondTimeWell) as server,
        RealTimeClient("127.0.0.1", server.port) as client,
    ):
        socket = client._socket
        with pytest.raises(ServerRefused, match="the replica is lost: its process ended"):
            client.infer(observation())
        client.infer(observation())
        assert client._socket is socket


def test_a_request_that_comes_at_the_moment_when_ray_ends_is_answered() -> None:
    async def main() -> None:
        calls = RemoteCalls("arms", Metrics(), 60.0)
        answer = calls.submit(Request(0.0, 1.0), observation(), {})
        calls._lose("Ray's cluster has ended")
        (result,) = await answer
        assert result.error == "lost" and result.text == "Ray's cluster has ended"

    asyncio.run(main())


# --- what may be asked of a fleet -------------------------------------------------------------------------------------


def test_without_ray_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"needs Ray Serve, which can't be imported .* install -e '.*\[ray\]'"):
        import_ray()
    assert "needs Ray Serve" in refusal(turbopi(*TINY, "--ray", "--port", "0"))
    with pytest.raises(ConfigError, match="needs Ray Serve"):
        build({"random_weights": "pi05_tiny"})


def test_another_version_of_ray_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    ray, serve = ModuleType("ray"), ModuleType("ray.serve")
    ray.__version__, ray.serve = "2.9.3", serve  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setitem(sys.modules, "ray.serve", serve)
    with pytest.raises(ConfigError, match=r"a fleet needs Ray <3,>=2.60, but 2.9.3 is installed"):
        import_ray()


def test_a_ray_that_is_started_here_says_nothing_of_its_token_which_stays_on(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    ray, serve, started = ModuleType("ray"), ModuleType("ray.serve"), []

    def init(address: str, **options: Any) -> None:
        if address == "auto":
            raise ConnectionError("no cluster")
        logger = logging.getLogger(TOKEN_LOGGER)
        logger.warning("Token authentication is enabled for this Ray cluster. Set RAY_AUTH_MODE=disabled to opt out.")
        logger.warning("Token authentication is disabled for this Ray cluster.")
        started.append(os.environ.get("RAY_AUTH_MODE"))

    ray.__version__, ray.serve = "2.60.0", serve  # type: ignore[attr-defined]
    ray.init, ray.is_initialized = init, lambda: False  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setitem(sys.modules, "ray.serve", serve)
    for name in ("RAY_ADDRESS", "RAY_AUTH_MODE"):
        monkeypatch.delenv(name, raising=False)
    for name, value in STARTED_HERE.items():  # `connect` sets them; so they are gone after the test
        monkeypatch.setenv(name, value)
    assert connect_to_ray()
    assert started == [None], "Ray chooses itself: with a token"
    assert caplog.messages == ["Token authentication is disabled for this Ray cluster."]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--replicas", "2"), "--replicas is of a fleet: give --ray, too"),
        (("--ray", "--gpus", "2"), "--gpus is all, or left out, not '2'"),
        (("--ray", "--gpus", "all", "--replicas", "2"), "--replicas and --gpus each say how many replicas there are"),
        (("--ray", "--update"), "--update needs the running fleet's name: --fleet NAME"),
        (("--ray", "--strict", "--no-warmup"), "--strict refuses what warm-up didn't cover"),
    ],
)
def test_options_that_contradict_each_other_are_refused(options: tuple[str, ...], words: str) -> None:
    assert words in refusal(turbopi(*TINY, "--port", "0", *options))


def test_what_does_not_run_is_not_updated() -> None:
    check_runs("arms", ["arms", "legs"])
    with pytest.raises(ConfigError, match="no fleet 'arm' runs on this machine's Ray cluster; there: arms, legs"):
        check_runs("arm", ["arms", "legs"])
    with pytest.raises(ConfigError, match="none does"):
        check_runs("arm", [])


def test_weights_with_other_chunks_or_for_another_robot_are_no_update() -> None:
    running = {"action_horizon": 10, "robot": "libero"}
    for robot in ("libero", None):  # None: a class of the user's, which isn't run here
        check_fits(running, 10, robot)
    with pytest.raises(ConfigError, match="the running fleet's chunks have 10 actions, this checkpoint's 50"):
        check_fits(running, 50, "libero")
    with pytest.raises(ConfigError, match="is for the robot libero, this checkpoint for droid: start another fleet"):
        check_fits(running, 10, "droid")


@pytest.mark.parametrize(
    ("device", "words"),
    [
        ("cuda:1", "device='cuda:1' was asked for, but in a fleet Ray gives each replica its GPU"),
        ("cpu", "--gpus all gives each replica a GPU, but --device cpu was asked for"),
    ],
)
def test_all_gpus_are_not_one_by_number_and_not_cpus(device: str, words: str) -> None:
    requested = Requested(PolicyOptions(random_weights="pi05_tiny", device=device), ServerOptions(), True, False)
    wishes = FleetWishes(True, None, "all", None, None, False)
    with pytest.raises(ConfigError, match=re.escape(words)):
        wishes.options(requested, None)
    assert wishes.options(replace(requested, policy=replace(requested.policy, device="cuda")), None).use_gpus


def test_the_help_shows_a_fleet() -> None:
    text = text_of(turbopi("serve", "--help-all").stdout)
    assert "--ray --gpus all" in text and "docs/fleet.md" in text


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"name": "two words"}, "letters, digits"),
        ({"replicas": 0}, "replicas must be 1 or more, not 0"),
        ({"replicas": 1, "autoscaling": {"max_replicas": 2}}, "replicas and autoscaling were given"),
        ({"answer_seconds": 0.0}, "answer_seconds must be more than 0"),
    ],
)
def test_fleets_that_cannot_be_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        FleetOptions(**{"name": "arms", "checkpoint": "arms", **options})


def test_a_fleet_is_called_as_its_checkpoint_is(tmp_path: Path) -> None:
    assert name_of(str(tmp_path / "pi05 libero"), None) == "pi05_libero"
    assert name_of(None, "pi05_tiny") == "pi05_tiny"


def test_a_fleet_is_not_called_as_a_step_is(tmp_path: Path) -> None:
    assert name_of(str(tmp_path / "policy a" / "20000"), None) == "policy_a-20000"
    assert name_of("/20000", None) == "20000"


def test_ray_gives_each_replica_its_gpu_so_none_is_named() -> None:
    assert (gpus_for("auto"), gpus_for("cuda"), gpus_for("cpu")) == (None, True, False)
    with pytest.raises(ConfigError, match="device='cuda:1' was asked for, but in a fleet Ray gives"):
        gpus_for("cuda:1")


def test_autoscaling_is_rays_own_as_json() -> None:
    assert read_autoscaling('{"min_replicas": 1, "max_replicas": 4}') == {"min_replicas": 1, "max_replicas": 4}
    for text in ("1-4", "[1, 4]"):
        with pytest.raises(ConfigError, match="autoscaling= takes"):
            read_autoscaling(text)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # Ray's own
def test_what_autoscaling_has_and_ray_has_not_is_refused() -> None:
    pytest.importorskip("ray")
    check_known({"min_replicas": 1, "max_replicas": 4, "upscale_delay_s": 5})
    with pytest.raises(ConfigError, match=r"autoscaling= has min_replica, which .* it has .*min_replicas"):
        check_known({"min_replica": 1})


def test_the_reason_is_found_in_rays_tracebacks() -> None:
    message = (
        'Deployment failed to start 3 times. Error:\n\x1b[36mray::Replica\x1b[39m (pid=1)\n  File "a.py", line 1\n'
        "turbopi.support.errors.CheckpointError: no weights in /srv/x\n"
    )
    assert reason_in(message) == "turbopi.support.errors.CheckpointError: no weights in /srv/x"
    assert reason_in("Waiting for a GPU.\nMore.") == "Waiting for a GPU."


@pytest.fixture
def with_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if Ray could be imported, for what is refused before it is used."""
    monkeypatch.setattr(ray_app, "import_ray", lambda: (None, None))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({}, "give one of checkpoint=FOLDER and random_weights=PRESET"),
        ({"checkpoint": "a", "random_weights": "pi05_tiny"}, "give one of"),
        ({"checkpoint": "a", "replicaz": "2"}, "unknown field `replicaz`; it takes checkpoint, random_weights"),
        ({"checkpoint": "a", "replicas": "two"}, "Expected `int | null`"),
        (
            {"checkpoint": "a", "max_message_mb": "64"},
            "max_message_mb=64 was asked for, but Ray Serve's proxy takes 16 MB",
        ),
        ({"checkpoint": "a", "api_key_file": "/nowhere/key"}, "can't be read from /nowhere/key"),
        ({"checkpoint": "a", "execution": "rtc"}, "needs the robots' control rate"),
    ],
)
def test_arguments_of_serve_run_that_cannot_be_are_refused(
    arguments: dict[str, Any], words: str, with_ray: None
) -> None:
    with pytest.raises(ConfigError) as refused:
        build(arguments)
    assert words in str(refused.value)


def test_a_key_in_the_environment_does_not_leave_a_cluster_open(
    monkeypatch: pytest.MonkeyPatch, with_ray: None
) -> None:
    monkeypatch.setenv("TURBOPI_API_KEY", "k3y")
    with pytest.raises(ConfigError, match="a cluster takes the key from a file: api_key_file=FILE"):
        build({"random_weights": "pi05_tiny"})


def test_arguments_are_text_on_a_command_line_and_numbers_in_a_file() -> None:
    import msgspec

    for value in ("2", 2):
        given = msgspec.convert({"checkpoint": "a", "replicas": value, "strict": "true"}, Arguments, strict=False)
        assert given.replicas == 2 and given.strict


# --- through Ray Serve's proxy ----------------------------------------------------------------------------------------


class Asgi:
    """One websocket, as an ASGI server hands it to an application."""

    def __init__(self, port: int, *headers: tuple[bytes, bytes]) -> None:
        self._in: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self._out: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        scope = {"type": "websocket", "path": "/", "query_string": b"", "headers": [(b"host", b"lab:8000"), *headers]}
        self.send({"type": "websocket.connect"})
        self.task = asyncio.ensure_future(relay(lambda: port)(scope, self._in.get, self._out.put))

    def send(self, event: dict[str, Any]) -> None:
        self._in.put_nowait(event)

    def ask(self, obs: dict[str, Any]) -> None:
        self.send({"type": "websocket.receive", "bytes": pack(obs)})

    async def event(self) -> dict[str, Any]:
        return await asyncio.wait_for(self._out.get(), 60)


@contextlib.asynccontextmanager
async def proxied(server: PolicyServer) -> AsyncIterator[Asgi]:
    robot = Asgi(server.port)
    assert (await robot.event())["type"] == "websocket.accept"
    assert unpack((await robot.event())["bytes"])["policy"] == "fake"
    yield robot
    robot.send({"type": "websocket.disconnect", "code": 1000})
    await asyncio.wait_for(robot.task, 60)


def relayed(test: Callable[[PolicyServer, FakePolicy], Awaitable[None]], **options: Any) -> None:
    async def main() -> None:
        policy = FakePolicy()
        try:
            async with PolicyServer(policy, port=0, page=False, **options) as server:
                await asyncio.wait_for(test(server, policy), 100)
        finally:
            policy.release.set()

    asyncio.run(main())


def test_frames_go_both_ways_unchanged_and_a_mistake_is_a_text_frame() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with proxied(server) as robot:
            robot.ask(observation("left"))
            answer = unpack((await robot.event())["bytes"])
            np.testing.assert_array_equal(answer["actions"][0], observation()["observation/state"])
            robot.ask({"prompt": ""})
            assert (await robot.event())["text"].startswith("bad observation: the key 'observation/state' is missing")
            robot.send({"type": "websocket.receive", "text": "hello", "bytes": None})
            assert (await robot.event())["text"].startswith("bad request: a request is a binary frame")

    relayed(test)


def test_a_policy_that_failed_sends_its_traceback_and_the_same_close_code() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        robot = Asgi(server.port)
        for _ in range(2):
            await robot.event()
        robot.ask(observation("crash"))
        assert "RuntimeError: CUDA error: invalid argument" in (await robot.event())["text"]
        assert await robot.event() == {
            "type": "websocket.close",
            "code": 1011,
            "reason": "internal server error: the last frame has the traceback",
        }
        await robot.task

    relayed(test)


def test_the_key_is_the_servers_to_judge() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        refused = Asgi(server.port)
        event = await refused.event()
        assert (event["type"], event["status"]) == ("websocket.http.response.start", 401)
        assert b"Send the header" in (await refused.event())["body"]
        let_in = Asgi(server.port, (b"authorization", b"Api-Key k3y"))
        assert (await let_in.event())["type"] == "websocket.accept"
        let_in.send({"type": "websocket.disconnect", "code": 1001})
        await asyncio.gather(refused.task, let_in.task)

    relayed(test, api_key="k3y")


def test_web_pages_of_other_origins_are_refused_through_the_proxy_too() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        robot = Asgi(server.port, (b"origin", b"http://evil.example"))
        assert (await robot.event())["status"] == 403
        await robot.task

    relayed(test)


def test_who_sends_ahead_without_end_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_app, "AHEAD_BYTES", 2_000_000)

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with proxied(server) as robot:
            robot.ask(observation("hold"))
            await asyncio.to_thread(policy.started.wait, 60)
            for _ in range(30):
                robot.send({"type": "websocket.receive", "bytes": bytes(1_000_000)})
            event = await robot.event()
            assert event["code"] == 1008 and "await each answer" in event["reason"]
            policy.release.set()

    relayed(test)


def test_health_and_metrics_come_through() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        for path, host, status in (
            ("/healthz", b"lab", 200),
            ("/metrics", b"127.0.0.1", 200),
            ("/metrics", b"lab", 403),
        ):
            sent: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
            scope = {"type": "http", "path": path, "query_string": b"", "headers": [(b"host", host)]}
            await relay(lambda: server.port)(scope, sent.get, sent.put)
            assert (await sent.get())["status"] == status
            assert (await sent.get())["body"]
            await relay(lambda: server.port)({**scope, "method": "POST"}, sent.get, sent.put)
            assert await sent.get() == {"type": "http.response.start", "status": 405, "headers": [(b"allow", b"GET")]}
            assert not (await sent.get())["body"]

    relayed(test)
