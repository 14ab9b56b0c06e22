"""Fleets on a real Ray, on CPUs: replicas that are killed, replaced, lost and slow. Skipped without Ray.

One Ray, with two replicas of a fake policy, runs in a process of its own (fleet_process.py) for all tests of this file.
Nothing here depends on how fast the machine is: what takes its time is waited for, up to MOST_SECONDS.
"""

import asyncio
import contextlib
import importlib.util
import itertools
import json
import os
import re
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from serve_fakes import http_get, wait_for
from test_cli_serve import serving
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from turbopi.policy.shipped import load_frames
from turbopi.realtime.wire import pack, unpack
from turbopi.serve.fleet.session_affinity import SOON_SECONDS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs Ray Serve: pip install -e '.[ray]'"),
]

MOST_SECONDS = 120.0
TOKEN = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}  # else Ray writes one into the home folder


class FleetProcess:
    """The process of fleet_process.py."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process
        self.addresses = self._said()

    def _said(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("@"):
                said: dict[str, Any] = json.loads(line[1:])
                return said
        raise AssertionError("the fleet's process ended")

    def do(self, do: str, **given: Any) -> dict[str, Any]:
        assert self._process.stdin is not None
        print(json.dumps({"do": do, **given}), file=self._process.stdin, flush=True)
        return self._said()

    def end(self) -> None:
        """End it, and its Ray; more than once is once."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        assert self._process.wait(MOST_SECONDS) == 0

    @contextlib.contextmanager
    def robot(self) -> Iterator["Robot"]:
        with connect(self.addresses["url"], compression=None, open_timeout=MOST_SECONDS) as connection:
            yield Robot(connection)


class Robot:
    """A client of openpi's protocol that never reconnects."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.metadata = unpack(self._received())

    def _received(self) -> Any:
        return self.connection.recv(timeout=MOST_SECONDS)

    def send(self, prompt: str = "") -> None:
        self.connection.send(pack({"observation/state": np.arange(8.0), "prompt": prompt}))

    def answer(self) -> dict[str, Any] | str:
        received = self._received()
        return received if isinstance(received, str) else unpack(received)

    def ask(self, prompt: str = "") -> dict[str, Any] | str:
        self.send(prompt)
        return self.answer()

    def actions(self) -> dict[str, Any]:
        answer = self.ask()
        assert isinstance(answer, dict), answer
        return answer


class Load(threading.Thread):
    """Robots that ask one after the other until they are told to stop; what they were answered."""

    def __init__(self, fleet: FleetProcess) -> None:
        super().__init__(daemon=True)
        self._fleet, self._enough = fleet, threading.Event()
        self.answers: list[dict[str, Any] | str] = []
        self.failure: BaseException | None = None

    def run(self) -> None:
        try:
            with self._fleet.robot() as robot:
                while not self._enough.is_set():
                    self.answers.append(robot.ask())
        except BaseException as failure:
            self.failure = failure

    def wait_for_more(self, than: int) -> None:
        wait_for(lambda: self.failure or len(self.answers) > than)

    def end(self) -> None:
        self._enough.set()
        self.join(MOST_SECONDS)
        assert not self.is_alive() and self.failure is None, self.failure


@contextlib.contextmanager
def load(fleet: FleetProcess, robots: int) -> Iterator[list[Load]]:
    loads = [Load(fleet) for _ in range(robots)]
    for one in loads:
        one.start()
    yield loads
    for one in loads:
        one.end()


@pytest.fixture(scope="module")
def fleet() -> Iterator[FleetProcess]:
    with fleet_of_its_own() as process:
        with process.robot() as robot:
            processes(robot)
        yield process


def join(fleet: FleetProcess, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands join the cluster of that process."""
    for name, value in {**TOKEN, "RAY_ADDRESS": fleet.addresses["cluster"]}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))


@contextlib.contextmanager
def fleet_of_its_own() -> Iterator[FleetProcess]:
    with subprocess.Popen(
        [sys.executable, str(Path(__file__).parent / "fleet_process.py")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | TOKEN | {"PYTHONPATH": os.pathsep.join(sys.path)},
        start_new_session=True,
    ) as process:
        try:
            fleet = FleetProcess(process)
            yield fleet
            fleet.end()
        finally:
            with contextlib.suppress(ProcessLookupError):  # with all of Ray's
                os.killpg(process.pid, signal.SIGKILL)


def held_by(name: Path) -> int:
    """The process that computes a request "hold NAME"."""
    return int(wait_for(lambda: name.exists() and name.read_text()))


def processes(
    robot: Robot, apart_from: int | None = None, *, generation: int | None = None, one_ends: bool = False
) -> set[int]:
    """The two replicas' processes, once both answer. one_ends: a request may still meet one that does."""
    seen: set[int] = set()

    def all_of_them() -> bool:
        time.sleep(SOON_SECONDS)  # who asks again sooner stays where it is
        answer = robot.ask()
        if one_ends and isinstance(answer, str) and answer.startswith("the replica is lost: "):
            return False  # "ask again", it says
        assert isinstance(answer, dict), answer
        if answer["pid"] != apart_from and generation in (None, answer["generation"]):
            seen.add(answer["pid"])
        return len(seen) == 2

    wait_for(all_of_them)
    return seen


def test_the_greeting_and_errors_are_the_servers(fleet: FleetProcess) -> None:
    with fleet.robot() as robot:
        assert (robot.metadata["policy"], robot.metadata["fleet"]) == ("fake", "fakes")
        robot.connection.send(pack({"prompt": ""}))
        assert robot.answer() == "bad observation: the key 'observation/state' is missing"
        robot.connection.send(b"\xc1")
        assert str(robot.answer()).startswith("bad request: ")
        np.testing.assert_array_equal(robot.actions()["actions"][0], np.arange(8.0))


def test_a_robot_that_asks_again_at_once_stays_at_its_replica(fleet: FleetProcess) -> None:
    """Judged by the requests that came at once by the robot's own clock, whatever else the machine does."""
    moves: list[bool] = []  # of each such request, whether another replica answered it than the one before

    with fleet.robot() as robot:

        def requested_often() -> bool:
            requested = [(time.monotonic(), robot.actions()["pid"], time.monotonic()) for _ in range(41)]
            for (sent, before, _), (_, after, answered) in itertools.pairwise(requested):
                if answered - sent < SOON_SECONDS:  # so the answer before it was younger still
                    moves.append(before != after)
            return len(moves) >= 40

        wait_for(requested_often)
        assert sum(moves) < len(moves) / 4, f"{sum(moves)} of {len(moves)}: at random it would be half"
        assert len(processes(robot)) == 2, "one that takes its time goes to either"


def test_a_request_that_takes_long_holds_up_its_own_replica_alone(fleet: FleetProcess, tmp_path: Path) -> None:
    with fleet.robot() as slow, fleet.robot() as other, fleet.robot() as unfinished:
        slow.send(f"hold {tmp_path / 'a'}")
        held = held_by(tmp_path / "a")
        unfinished.connection.socket.sendall(b"\x82\xfe\xff")  # the beginning of a frame, and no more
        assert {other.actions()["pid"] for _ in range(20)}.isdisjoint({held})
        (tmp_path / "a.go").touch()
        answer = slow.answer()
        assert isinstance(answer, dict) and answer["pid"] == held
        unfinished.connection.socket.shutdown(socket.SHUT_RDWR)  # it could not be closed as others are


def test_a_killed_replica_costs_the_request_that_it_had_and_comes_back(fleet: FleetProcess, tmp_path: Path) -> None:
    with fleet.robot() as unlucky, fleet.robot() as other:
        unlucky.send(f"hold {tmp_path / 'a'}")
        killed = held_by(tmp_path / "a")
        other.actions()
        os.kill(killed, signal.SIGKILL)
        text = unlucky.answer()
        assert isinstance(text, str) and text.startswith("the replica is lost: ") and "ask again" in text
        for robot in (unlucky, other):  # over the same connections
            assert robot.actions()["pid"] != killed
        assert len(processes(other, killed)) == 2


def test_a_session_outlives_the_replica_that_computed_its_chunk(fleet: FleetProcess) -> None:
    def ask(robot: Robot, step: int) -> dict[str, Any] | str:
        keys = {"session": "arm", "mode": "rtc", "step": step, "delay": 1}
        observation = {"observation/state": np.arange(8.0), **{f"turbopi/{key}": value for key, value in keys.items()}}
        robot.connection.send(pack(observation))
        return robot.answer()

    with fleet.robot() as robot, fleet.robot() as same_arm:
        first = ask(robot, 0)
        assert isinstance(first, dict) and not first["real_time"]["joined"]
        os.kill(first["pid"], signal.SIGKILL)
        second = wait_for(lambda: isinstance(answer := ask(same_arm, 2), dict) and answer)
        assert second["pid"] != first["pid"]
        assert second["real_time"]["joined"] and second["left_over"] == 10 - 2
        processes(robot, first["pid"])


def test_under_load_a_killed_replica_costs_each_robot_one_request_at_most(fleet: FleetProcess) -> None:
    with load(fleet, 4) as robots, fleet.robot() as watcher:
        before = processes(watcher)
        counts = [len(robot.answers) for robot in robots]
        killed = before.pop()
        os.kill(killed, signal.SIGKILL)
        processes(watcher, killed)
        for robot, count in zip(robots, counts, strict=True):
            robot.wait_for_more(count + 3)
    for robot in robots:
        refused = [answer for answer in robot.answers if isinstance(answer, str)]
        assert len(refused) <= 1 and all(text.startswith("the replica is lost: ") for text in refused)


def test_a_rolling_update_fails_no_request_and_closes_no_connection(fleet: FleetProcess) -> None:
    with load(fleet, 3) as robots:
        for robot in robots:
            robot.wait_for_more(0)
        assert fleet.do("deploy", generation=2) == {}
        counts = [len(robot.answers) for robot in robots]
        for robot, count in zip(robots, counts, strict=True):
            robot.wait_for_more(count)
    for robot in robots:
        generations = [answer["generation"] for answer in robot.answers if isinstance(answer, dict)]
        assert len(generations) == len(robot.answers)
        assert generations[0] == 1 and generations[-1] == 2


def test_an_update_that_cannot_start_says_why_and_leaves_a_replica_serving(fleet: FleetProcess) -> None:
    said = fleet.do("deploy", generation=None)
    assert said["error"] == "BackendError"
    assert "the weights are damaged: nothing to be done" in said["text"] and "\n" not in said["text"]
    with fleet.robot() as robot:
        assert robot.actions()["generation"] == 2
    said = fleet.do("deploy", generation=3, autoscaling={"min_replicas": 3, "max_replicas": 1})
    assert said["error"] == "ConfigError" and "Ray Serve refuses the fleet's options" in said["text"]
    assert fleet.do("deploy", generation=3, autoscaling={"min_replicas": 2, "max_replicas": 3}) == {}


def test_a_fleet_grows_by_requests_that_ray_serve_does_not_see(fleet: FleetProcess, tmp_path: Path) -> None:
    often = {"target_ongoing_requests": 1, "upscale_delay_s": 0.5, "metrics_interval_s": 0.5, "look_back_period_s": 1.0}
    assert fleet.do("deploy", generation=4, autoscaling={"min_replicas": 2, "max_replicas": 3, **often}) == {}
    names = [tmp_path / "a", tmp_path / "b"]
    with contextlib.ExitStack() as stack:
        for name in names:
            stack.callback(name.with_suffix(".go").touch)  # whatever fails: a replica that is held holds up all tests
        busy = [stack.enter_context(fleet.robot()) for _ in range(4)]
        processes(busy[0], generation=4)  # one that the server has not reached yet would leave both to the other
        for robot, name in zip(busy, names, strict=False):
            robot.send(f"hold {name}")
        held = {held_by(name) for name in names}
        assert len(held) == 2
        for robot in busy[2:]:
            robot.send()  # each behind one of these

        def answered_elsewhere() -> bool:
            with fleet.robot() as new, contextlib.suppress(TimeoutError):
                new.send()
                return unpack(new.connection.recv(timeout=1.0))["pid"] not in held  # type: ignore[arg-type]
            return False  # it was behind one of these, too, and left

        wait_for(answered_elsewhere)
        for name in names:
            name.with_suffix(".go").touch()
        assert all(isinstance(answer := robot.answer(), dict) and answer["pid"] in held for robot in busy)
    assert fleet.do("deploy", generation=5) == {}


def test_a_fleet_of_no_replica_starts_one_for_a_request(fleet: FleetProcess) -> None:
    none = {"min_replicas": 0, "max_replicas": 1, "upscale_delay_s": 0.5, "metrics_interval_s": 0.5}
    assert fleet.do("deploy", generation=6, autoscaling=none) == {}
    with fleet.robot() as robot:
        assert wait_for(lambda: isinstance(answer := robot.ask(), dict) and answer["generation"] == 6)
    assert fleet.do("deploy", generation=5) == {}


def test_a_lost_device_ends_its_replica_alone(fleet: FleetProcess) -> None:
    with fleet.robot() as robot:
        before = processes(robot, generation=5)
        assert robot.ask("lost") == "the device is lost: CUDA error: an illegal memory access was encountered"
        wait_for(lambda: len(before & processes(robot, one_ends=True)) == 1)


def test_gpus_that_the_cluster_has_not_are_refused_at_once(fleet: FleetProcess) -> None:
    said = fleet.do("room", replicas=2)
    assert said["error"] == "BackendUnavailable"
    assert said["text"].startswith("2 replicas don't fit: Ray's cluster has no GPU.")


def test_metrics_are_by_replica(fleet: FleetProcess) -> None:
    with fleet.robot() as robot:
        pids = processes(robot)
    _, _, text = asyncio.run(http_get(fleet.addresses["port"], "/metrics"))
    for pid in pids:
        assert f':{pid}"' in text
    assert 'turbopi_replica_inference_seconds_count{checkpoint="fake",replica=' in text


def test_serve_run_speaks_the_same_protocol_behind_rays_proxy(fleet: FleetProcess, tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_text("k3y\n")
    arguments = {"random_weights": "pi05_tiny", "steps": "1", "cpus": "0.25", "warmup": "false"}
    assert fleet.do("build", arguments={**arguments, "api_key_file": str(key)}) == {}
    url, http = fleet.addresses["proxy"], fleet.addresses["http"]
    with pytest.raises(InvalidStatus, match="401"):
        connect(url, compression=None)
    assert asyncio.run(http_get(http, "/healthz", "Connection: close"))[::2] == (200, "OK\n")
    assert asyncio.run(http_get(http, "/metrics", "Connection: close"))[0] == 401
    headers = {"Authorization": "Api-Key k3y"}
    frame = load_frames()[0]
    observation = {"observation/image": frame.base, "observation/wrist_image": frame.wrist, "prompt": "pick it up"}
    with connect(url, compression=None, additional_headers=headers, max_size=None) as connection:
        robot = Robot(connection)
        assert robot.metadata["config"] == "pi05_tiny" and robot.metadata["fleet"] == "whole"
        connection.send(pack(observation))
        assert str(robot.answer()).startswith("bad observation: ")
        connection.send(pack({**observation, "observation/state": frame.state}))
        answer = robot.answer()
        assert isinstance(answer, dict) and answer["actions"].shape == (10, 7)
        with contextlib.suppress(ConnectionClosedError):
            connection.send(bytes(17 * 2**20))
        with pytest.raises(ConnectionClosedError) as closed:
            connection.recv(timeout=MOST_SECONDS)
        assert closed.value.rcvd is None or closed.value.rcvd.code == 1009
    metrics = asyncio.run(http_get(http, "/metrics", "Connection: close", "Authorization: Api-Key k3y"))
    assert metrics[0] == 200 and 'turbopi_replica_inference_seconds_count{checkpoint="pi05_tiny"' in metrics[2]


def test_the_command_serves_and_updates_a_fleet_of_a_cluster(
    fleet: FleetProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    join(fleet, monkeypatch)
    frame = load_frames()[0]
    observation = {"observation/image": frame.base, "observation/wrist_image": frame.wrist, "prompt": "pick it up"}
    with serving("--ray", "--replicas", "1", "--no-warmup", "--steps", "1") as (process, url, printed):
        assert "Fleet pi05_tiny: 1 replica of pi05_tiny, on CPUs; loading and warming up …\n" in printed
        assert re.search(
            rf"error: a fleet 'pi05_tiny' runs already \(its server is process {process.pid} on .*\): --fleet NAME "
            "starts another one, --update --fleet pi05_tiny replaces its weights",
            turbopi_serve("--random-weights", "pi05_tiny", "--ray", "--port", "0").stderr,
        )
        with connect(url, compression=None, open_timeout=MOST_SECONDS) as connection:
            robot = Robot(connection)
            connection.send(pack({**observation, "observation/state": frame.state}))
            before = robot.answer()
            said = updated("pi05_tiny").stdout
            assert "\nsteps: 1 -> 2\nFleet pi05_tiny: 1 replica of pi05_tiny" in said
            assert said.endswith("Updated: 1 of 1 replicas run pi05_tiny.\n")
            assert (
                "\nAs in the running fleet: --steps 2, --no-warmup.\n"
                in updated("pi05_tiny", "--weights-seed", "1").stdout
            )
            connection.send(pack({**observation, "observation/state": frame.state}))
            after = robot.answer()
        assert isinstance(before, dict) and isinstance(after, dict)
        assert not np.array_equal(before["actions"], after["actions"])
        process.kill()  # its replicas stay
        process.wait(MOST_SECONDS)
    droid = turbopi_serve("--random-weights", "pi05_tiny", "--robot", "droid", "--ray", "--port", "0")
    assert "error: the running fleet is for the robot libero, this checkpoint for droid: start another" in droid.stderr
    with serving("--ray", "--replicas", "1", "--no-warmup") as (process, url, printed):
        assert any(line.startswith("The fleet pi05_tiny is there without a server") for line in printed)
        with connect(url, compression=None, open_timeout=MOST_SECONDS) as connection:
            robot = Robot(connection)
            connection.send(pack({**observation, "observation/state": frame.state}))
            assert isinstance(robot.answer(), dict)
        process.send_signal(signal.SIGINT)
        assert process.wait(MOST_SECONDS) == 0


def test_an_application_of_serve_run_is_no_fleet(fleet: FleetProcess, monkeypatch: pytest.MonkeyPatch) -> None:
    join(fleet, monkeypatch)
    assert fleet.do("build", arguments={"random_weights": "pi05_tiny", "cpus": "0.25", "warmup": "false"}) == {}
    for options in (("--port", "0"), ("--update",)):
        said = turbopi_serve("--random-weights", "pi05_tiny", "--ray", "--fleet", "whole", *options).stderr
        assert (
            "an application 'whole' that `turbopi serve --ray` didn't start, with the deployments ingress, pol" in said
        )


def test_a_server_whose_ray_has_ended_says_so_and_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    with contextlib.ExitStack() as stack:
        fleet = stack.enter_context(fleet_of_its_own())
        join(fleet, monkeypatch)
        process, url, _ = stack.enter_context(serving("--ray", "--replicas", "1", "--no-warmup"))
        connection = stack.enter_context(connect(url, compression=None, open_timeout=MOST_SECONDS))
        robot = Robot(connection)
        fleet.end()

        def said() -> str:
            time.sleep(0.1)
            answer = robot.ask()
            return answer if isinstance(answer, str) else ""

        lost = wait_for(lambda: (text := said()).startswith("the device is lost: ") and text)
        assert "Ray's cluster at" in lost and "has ended, and all replicas with it" in lost
        assert asyncio.run(http_get(int(url.rpartition(":")[2]), "/healthz"))[::2] == (503, f"{lost}\n")
        assert process.wait(MOST_SECONDS) == 4
        assert process.stderr is not None and "error: Ray's cluster at" in process.stderr.read()


def updated(name: str, *options: str) -> "subprocess.CompletedProcess[str]":
    """`turbopi serve --update` with other weights than the tests' own."""
    options = options or ("--weights-seed", "1", "--steps", "2", "--no-warmup")
    return turbopi_serve("--random-weights", "pi05_tiny", *options, "--ray", "--update", "--fleet", name)


def turbopi_serve(*options: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "turbopi.cli", "serve", *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=MOST_SECONDS, check=False)
