"""A fleet's server and its cluster: Ray that ends, and a fleet without a replica. Without Ray."""

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from serve_fakes import FakePolicy, http_get, observation, wait_for
from websockets.sync.client import connect

from turbopi.realtime.wire import pack, unpack
from turbopi.serve import PolicyServer, running, server
from turbopi.serve.fleet import watch as fleet_watch
from turbopi.serve.fleet.remote_calls import RemoteCalls
from turbopi.serve.fleet.watch import Watch, answers
from turbopi.serve.metrics import Metrics
from turbopi.serve.requests import Result
from turbopi.support.errors import DeviceLost

MOST_SECONDS = 60.0


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_watch, "RAY_SECONDS", 0.01)
    monkeypatch.setattr(fleet_watch, "REPLICAS_SECONDS", 0.01)


@pytest.fixture
def ray() -> Iterator[socket.socket]:
    """Where Ray's control service listens."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening


def at(ray: socket.socket) -> str:
    return f"127.0.0.1:{ray.getsockname()[1]}"


class Cluster:
    """What a watch asks: each question is noted."""

    def __init__(self) -> None:
        self.reachable, self.requested, self.unwell = False, threading.Event(), threading.Event()
        self.why: str | Exception | None = None

    def answers(self) -> bool:
        self.requested.set()
        return self.reachable

    def why_unwell(self) -> str | None:
        self.unwell.set()
        if isinstance(self.why, Exception):
            raise self.why
        return self.why


def watching(ray: socket.socket, cluster: Cluster) -> tuple[Watch, threading.Event, list[str]]:
    reasons: list[str] = []
    ended = threading.Event()
    watch = Watch(at(ray), cluster.answers, cluster.why_unwell)

    def when_lost(reason: str) -> None:
        reasons.append(reason)
        ended.set()

    watch.start(when_lost)
    return watch, ended, reasons


def test_ray_that_has_ended_is_told_once(ray: socket.socket) -> None:
    address, cluster = at(ray), Cluster()
    assert answers(address)
    watch, ended, reasons = watching(ray, cluster)
    assert not cluster.requested.wait(0.2) and not ended.is_set(), "as long as Ray is there, no replica is asked"
    ray.close()
    assert ended.wait(MOST_SECONDS)
    watch.stop()
    assert reasons == [f"Ray's cluster at {address} has ended, and all replicas with it. Start this server again"]


def test_replicas_that_answer_go_on_without_rays_control_service(ray: socket.socket) -> None:
    cluster = Cluster()
    cluster.reachable = True
    watch, ended, _ = watching(ray, cluster)
    ray.close()
    assert cluster.requested.wait(MOST_SECONDS) and not ended.wait(0.2)
    watch.stop()


def test_why_no_replica_runs_is_known_and_forgotten(ray: socket.socket) -> None:
    cluster = Cluster()
    watch, _, _ = watching(ray, cluster)

    def comes(what: str | None) -> None:
        for _ in range(2):  # one question may have been under way
            cluster.unwell.clear()
            assert cluster.unwell.wait(MOST_SECONDS)
        wait_for(lambda: watch.unwell == what, MOST_SECONDS)

    cluster.why = "no replica runs"
    comes("no replica runs")
    cluster.why = RuntimeError("Ray's controller is being restarted")  # nobody knows
    comes(None)
    watch.stop()


class Held(RemoteCalls):
    """Where requests are computed: they wait for a replica, and there is none."""

    def __init__(self, metrics: Metrics, on_lost: Callable[[str], None], watch: Watch) -> None:
        super().__init__("arms", metrics, MOST_SECONDS, watch=watch, on_lost=on_lost)


def test_requests_that_wait_are_answered_when_ray_ends_and_health_says_so(ray: socket.socket) -> None:
    watch, address = Watch(at(ray), lambda: False, lambda: None), at(ray)
    with (
        running(FakePolicy(), calls=lambda metrics, on_lost: Held(metrics, on_lost, watch)) as serving,
        connect(serving.url) as robot,
    ):
        robot.recv()
        robot.send(pack(observation()))
        wait_for(lambda: serving._calls.running, MOST_SECONDS)
        assert health(serving) == (200, "OK\n")
        ray.close()
        lost = f"the device is lost: Ray's cluster at {address} has ended, and all replicas with it. "
        assert str(robot.recv(timeout=MOST_SECONDS)).startswith(lost)
        robot.send(pack(observation()))
        assert str(robot.recv(timeout=MOST_SECONDS)).startswith(lost)
        status, text = health(serving)
        assert status == 503 and text.startswith(lost)


def test_the_server_ends_when_ray_has_ended(ray: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "LOST_NOTICE", 0.01)
    watch = Watch(at(ray), lambda: False, lambda: None)
    ends = PolicyServer(FakePolicy(), port=0, calls=lambda metrics, on_lost: Held(metrics, on_lost, watch))
    with pytest.raises(DeviceLost, match=r"Ray's cluster at .* has ended"):
        ends.serve_forever(on_ready=lambda _: ray.close())


class Resting(RemoteCalls):
    """Where requests are computed: it says that no replica runs, as long as it is told to."""

    why: str | None = None

    def __init__(self, metrics: Metrics, on_lost: Callable[[str], None]) -> None:
        super().__init__("arms", metrics, MOST_SECONDS)

    @property
    def unwell(self) -> str | None:
        return Resting.why

    async def run(self, *arguments: Any) -> Result:
        return Result(0.0, answer={"actions": [[0.0]]})


def test_without_a_replica_health_says_why_and_robots_may_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    with running(FakePolicy(), calls=Resting) as serving:
        assert health(serving) == (200, "OK\n")
        monkeypatch.setattr(Resting, "why", "no replica of the fleet 'arms' runs (UNHEALTHY): it died")
        assert health(serving) == (503, "no replica of the fleet 'arms' runs (UNHEALTHY): it died\n")
        with connect(serving.url) as robot:  # its request waits for one
            robot.recv()
            robot.send(pack(observation()))
            assert isinstance(unpack(robot.recv(timeout=MOST_SECONDS)), dict)  # type: ignore[arg-type]


def health(serving: PolicyServer) -> tuple[int, str]:
    status, _, text = asyncio.run(http_get(serving.port, "/healthz"))
    return status, text
