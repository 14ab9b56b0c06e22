"""From the server in front to its replicas and back, without Ray: messages as they came, faults, and strangers."""

import asyncio
import contextlib
import pickle
import random
import socket
import threading
import uuid
from collections.abc import Callable, Coroutine, Iterator, Mapping
from typing import Any, cast

import numpy as np
import pytest
from serve_fakes import OBSERVATION, FakePolicy, http_get, observation, wait_for
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from turbopi.realtime.running_chunk import RunningChunk
from turbopi.realtime.wire import pack, unpack
from turbopi.serve import PolicyServer, running
from turbopi.serve.calls import Policy
from turbopi.serve.fleet import remote_calls
from turbopi.serve.fleet.channel import PLACES, SIZES, Place, messages, prove, send
from turbopi.serve.fleet.channel import connect as connect_to
from turbopi.serve.fleet.remote_calls import RemoteCalls
from turbopi.serve.fleet.replica import Replica
from turbopi.serve.options import ServerOptions

MOST_SECONDS = 60.0


class Fleet:
    """Replicas in this process, on an event loop of their own, and what Ray Serve would say of them."""

    def __init__(self) -> None:
        self.name, self.loop = f"fleet-{uuid.uuid4()}", asyncio.new_event_loop()
        self.replicas: dict[str, Replica] = {}
        self._thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self._thread.start()
        PLACES[self.name] = {}

    def do(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(MOST_SECONDS)

    def start(self, name: str, policy: Policy, **options: Any) -> Replica:
        async def start() -> Place:
            replica = self.replicas[name] = Replica.__new__(Replica)  # as Ray Serve makes one
            made: Any = replica.__init__(lambda: policy, name, None, ServerOptions(**options))  # type: ignore[misc]
            await made
            return await replica.listen("127.0.0.1")

        self.announce(**{name: self.do(start())})
        return self.replicas[name]

    def announce(self, **more: Place) -> None:
        PLACES[self.name] = {**PLACES[self.name], **more}

    def kill(self, name: str) -> None:
        """What the end of a process is for others."""

        async def kill() -> None:
            replica = self.replicas.pop(name)
            if replica._listening is not None:
                replica._listening.close()
                replica._listening = None
            for server in tuple(replica._requests):
                server.transport.abort()

        self.do(kill())

    def server(self, answer_seconds: float = MOST_SECONDS) -> Any:
        def calls(metrics: Any, on_lost: Callable[[str], None]) -> RemoteCalls:
            return RemoteCalls(self.name, metrics, answer_seconds, on_lost=on_lost)

        return running(FakePolicy(), calls=calls)

    def end(self) -> None:
        for name in tuple(self.replicas):
            self.kill(name)
        self.do(asyncio.sleep(0))
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    made = Fleet()
    yield made
    made.end()


def received(connection: ClientConnection) -> Any:
    answer = connection.recv(timeout=MOST_SECONDS)
    return answer if isinstance(answer, str) else unpack(answer)


@contextlib.contextmanager
def robot(server: PolicyServer) -> Iterator[Callable[[Any], Any]]:
    with connect(server.url, compression=None, max_size=None) as connection:
        connection.recv()

        def ask(message: Any) -> Any:
            connection.send(message if isinstance(message, bytes | str) else pack(message))
            return received(connection)

        ask.send = lambda message: connection.send(pack(message))  # type: ignore[attr-defined]
        ask.received = lambda: received(connection)  # type: ignore[attr-defined]
        yield ask


class Reported(FakePolicy):
    """Keeps the arguments of its calls."""

    def __init__(self) -> None:
        super().__init__()
        self.metadata["real_time"] = {"modes": ["rtc"], "trained_max_delay": 0, "execution_horizon": None}
        self.arguments: list[Mapping[str, Any]] = []

    def infer(self, obs: dict[str, Any], **arguments: Any) -> dict[str, Any]:
        self.arguments.append(arguments)
        return {**super().infer(obs), "model_actions": np.ones((2, 8), np.float32)}


# --- messages ---------------------------------------------------------------------------------------------------------


def test_a_message_reaches_the_replica_as_it_came(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    policy = FakePolicy()
    fleet.start("left", policy)
    monkeypatch.setattr(remote_calls, "pack", None)
    image = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    with fleet.server() as server, robot(server) as ask:
        for size in (image[:1], image, image[:, :1], image):
            sent = {**observation("look"), "observation/image": size, "nested": {"more": [1, "two", None]}}
            answer = ask(sent)
            np.testing.assert_array_equal(answer["actions"][1], OBSERVATION["observation/state"])
            assert {"infer_ms"} <= answer["server_timing"].keys()
            came = policy.observations["look"]
            assert came.keys() == sent.keys() and came["nested"] == sent["nested"]
            np.testing.assert_array_equal(came["observation/image"], size)
            assert not came["observation/image"].flags.writeable


def test_what_a_request_says_besides_reaches_the_policy_too(fleet: Fleet) -> None:
    policy = Reported()
    fleet.start("left", policy)
    calls: Any = lambda metrics, on_lost: RemoteCalls(fleet.name, metrics, MOST_SECONDS)  # noqa: E731
    with running(Reported(), calls=calls) as server, robot(server) as ask:
        left_over = np.full((2, 8), 0.5, np.float32)
        keys = {"previous": left_over, "delay": 1, "mode": "rtc", "seed": 7, "model_actions": True}
        answer = ask({**observation(), **{f"turbopi/{key}": value for key, value in keys.items()}})
        assert answer["real_time"]["joined"] and answer["model_actions"].shape == (2, 8)
        (reported,) = policy.arguments
        previous = reported["previous"]
        assert isinstance(previous, RunningChunk) and (previous.delay, previous.mode) == (1, "rtc")
        np.testing.assert_array_equal(previous.left_over, left_over)
        assert reported["seed"] == 7 and reported["model_actions"] is True
        assert policy.observations[""].keys() == OBSERVATION.keys()


def test_the_rows_of_a_batch_message_are_requests_of_their_own(fleet: Fleet) -> None:
    fleet.start("left", FakePolicy())
    rows = {
        "observation/state": np.arange(24.0).reshape(3, 8),
        "observation/image": np.zeros((3, 2, 2, 3), np.uint8),
        "prompt": ["a", "b", "c"],
        "turbopi/batch": 3,
    }
    with fleet.server() as server, robot(server) as ask:
        answer = ask(rows)
        assert answer["prompt"] == ["a", "b", "c"]
        np.testing.assert_array_equal(answer["actions"][:, 0], rows["observation/state"])


def mistakes() -> Iterator[bytes | str]:
    """Messages that are wrong, in ways that a walk over good ones finds, and some that aren't."""
    good = {**observation("left"), "observation/image": np.arange(4800, dtype=np.uint8).reshape(40, 40, 3)}
    packed, drawn = pack(good), random.Random(0)
    yield from ("text", b"", b"\xc1", packed + b"\x00", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff" + bytes(9))
    yield from (b"\x81\xa1a\xc7\x01\x00\x00", pack([1]), pack({b"bytes": 1}), pack({"prompt": ""}))
    values: tuple[Any, ...] = (1, "x", None, [], {}, np.zeros(8, np.int32), np.full(8, np.nan), b"\x00")
    for value in values:
        yield pack({**good, "observation/state": value})
    for key, value in {"sessoin": "a", "batch": 3, "deadline_ms": -1, "priority": "king", "session": 3}.items():
        yield pack({**good, f"turbopi/{key}": value})
    for _ in range(12):
        yield packed[: drawn.randrange(len(packed))]
    for _ in range(24):
        changed = bytearray(packed)
        changed[drawn.choice((drawn.randrange(200), drawn.randrange(len(packed))))] = drawn.randrange(256)
        yield bytes(changed)


def test_mistakes_are_answered_in_the_same_words_as_without_a_fleet_and_harm_no_one_else(fleet: Fleet) -> None:
    fleet.start("left", FakePolicy())
    with (
        running(FakePolicy()) as alone,
        fleet.server() as server,
        robot(alone) as ask_alone,
        robot(server) as ask,
        robot(server) as other,
    ):
        for number, message in enumerate(mistakes()):
            expected, answer = ask_alone(message), ask(message)
            if isinstance(expected, str):
                assert answer == expected
            else:
                np.testing.assert_array_equal(answer["actions"], expected["actions"])
            assert other(observation(f"fine {number}"))["prompt"] == f"fine {number}"
        assert server.metrics.errors_so_far() == alone.metrics.errors_so_far()


@pytest.mark.parametrize("prompt", ["crash", "exit", "unpicklable"])
def test_a_policy_that_fails_closes_its_client_alone_with_the_traceback(fleet: Fleet, prompt: str) -> None:
    class Policy(FakePolicy):
        def _infer(self, obs: dict[str, Any]) -> dict[str, Any]:
            answer = super()._infer(obs)
            return {**answer, "more": lambda: None} if obs["prompt"] == "unpicklable" else answer

    fleet.start("left", Policy())
    with fleet.server() as server, robot(server) as ask, robot(server) as other:
        assert "Traceback" in ask(observation(prompt))
        with pytest.raises(ConnectionClosed, match="1011"):
            ask.received()  # type: ignore[attr-defined]
        assert other(observation("well"))["prompt"] == "well"


# --- faults -----------------------------------------------------------------------------------------------------------


def two(fleet: Fleet) -> tuple[FakePolicy, FakePolicy]:
    policies = FakePolicy(), FakePolicy()
    for name, policy in zip(("left", "right"), policies, strict=True):
        fleet.start(name, policy)
    return policies


def held(policies: tuple[FakePolicy, FakePolicy]) -> str:
    """The replica that computes the request that is held."""
    wait_for(lambda: any(policy.started.is_set() for policy in policies))
    return "left" if policies[0].started.is_set() else "right"


def test_a_killed_replica_costs_the_request_that_it_had(fleet: Fleet) -> None:
    policies = two(fleet)
    with fleet.server() as server, robot(server) as unlucky, robot(server) as other:
        unlucky.send(observation("hold"))  # type: ignore[attr-defined]
        fleet.kill(held(policies))
        text = "the replica is lost: its process ended, or can't be reached, during this request; ask again"
        assert unlucky.received() == text  # type: ignore[attr-defined]
        for ask in (unlucky, other, unlucky):
            assert ask(observation("on"))["prompt"] == "on"
        for policy in policies:
            policy.release.set()


def test_a_replica_that_is_to_end_answers_what_it_has_and_gets_no_more(fleet: Fleet) -> None:
    policies = two(fleet)
    with fleet.server() as server, robot(server) as slow, robot(server) as other:
        slow.send(observation("hold"))  # type: ignore[attr-defined]
        name = held(policies)
        drained = asyncio.run_coroutine_threadsafe(cast(Any, fleet.replicas[name].__del__()), fleet.loop)
        ends, stays = policies if name == "left" else policies[::-1]
        for _ in range(20):
            other(observation("other"))
        assert not drained.done() and ends.seen == ["hold"]
        ends.release.set()
        assert slow.received()["prompt"] == "hold"  # type: ignore[attr-defined]
        drained.result(MOST_SECONDS)
        assert slow(observation("next"))["prompt"] == "next" and stays.seen[-1] == "next"


def test_one_that_is_announced_no_more_gets_no_more_and_a_new_one_does(fleet: Fleet) -> None:
    policies = two(fleet)
    with fleet.server() as server, robot(server) as ask:
        del PLACES[fleet.name]["right"]
        wait_for(lambda: not fleet.replicas["right"]._requests)
        seen = len(policies[1].seen)
        for _ in range(10):
            ask(observation("more"))
        assert len(policies[1].seen) == seen
        newest = FakePolicy()
        fleet.start("newest", newest)
        fleet.kill("left")
        wait_for(lambda: isinstance(ask(observation("newest")), dict))
        assert newest.seen


def test_requests_wait_for_a_replica_up_to_a_number_or_their_time(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote_calls, "MOST_WAITING", 1)
    with fleet.server() as server, robot(server) as first, robot(server) as second:
        first.send(observation("waits"))  # type: ignore[attr-defined]
        wait_for(lambda: server._calls._without)
        assert second(observation("too many")) == "busy: 1 requests wait for a replica; try again"
        fleet.start("left", FakePolicy())
        assert first.received()["prompt"] == "waits"  # type: ignore[attr-defined]
    fleet.kill("left")
    del PLACES[fleet.name]["left"]
    with fleet.server(answer_seconds=0.1) as server, robot(server) as ask:
        assert ask(observation()) == "the replica is lost: no replica answered within 0.1 s; ask again"


def test_a_policy_that_hangs_costs_its_robots_their_time_and_no_more(fleet: Fleet) -> None:
    policy = FakePolicy()
    fleet.start("left", policy)
    with fleet.server(answer_seconds=0.2) as server, robot(server) as ask:
        assert ask(observation("hold")) == "the replica is lost: no replica answered within 0.2 s; ask again"
        policy.release.set()
        wait_for(lambda: isinstance(ask(observation("again")), dict))


def wait_behind_one(ask: Any, other: Any, policy: FakePolicy, replica: Replica) -> None:
    """`ask` has a request at the policy, which holds it, and `other` one in the line behind it."""
    ask.send(observation("hold"))
    wait_for(policy.started.is_set)
    other.send(observation("waits"))
    wait_for(lambda: replica.record_autoscaling_stats() == {"requests": 2})


def test_the_request_of_a_client_that_left_never_runs(fleet: Fleet) -> None:
    policy = FakePolicy()
    replica = fleet.start("left", policy)
    with fleet.server() as server, robot(server) as ask:
        with robot(server) as leaves:
            wait_behind_one(ask, leaves, policy, replica)
        wait_for(lambda: replica.record_autoscaling_stats() == {"requests": 1})
        policy.release.set()
        ask.received()  # type: ignore[attr-defined]
        ask(observation("next"))
        assert policy.seen == ["hold", "next"]


def test_a_server_that_ended_leaves_nothing_at_its_replicas(fleet: Fleet) -> None:
    policy = FakePolicy()
    replica = fleet.start("left", policy)
    with fleet.server() as server, robot(server) as ask, robot(server) as waits:
        wait_behind_one(ask, waits, policy, replica)
        (front,) = replica._requests
        fleet.loop.call_soon_threadsafe(front.transport.abort)
        wait_for(lambda: front not in replica._requests)
        policy.release.set()
        assert waits.received().startswith("the replica is lost: ")  # type: ignore[attr-defined]
    assert policy.seen == ["hold"]


# --- strangers --------------------------------------------------------------------------------------------------------


class Bomb:
    def __reduce__(self) -> Any:
        return Bomb.goes_off, ()

    @staticmethod
    def goes_off() -> None:
        Bomb.went_off = True

    went_off = False


def test_who_does_not_know_the_secret_is_cut_off_and_nothing_of_it_is_unpickled(fleet: Fleet) -> None:
    fleet.start("left", FakePolicy())
    place = PLACES[fleet.name]["left"]
    bomb = pickle.dumps((1, Bomb()))
    for reply in (lambda nonce: bytes(32), lambda nonce: nonce):  # no proof, and what came, sent back
        with socket.create_connection(place[:2], MOST_SECONDS) as stranger:
            nonce = stranger.recv(32, socket.MSG_WAITALL)
            stranger.sendall(nonce)
            proof = stranger.recv(32, socket.MSG_WAITALL)
            with contextlib.suppress(OSError):
                stranger.sendall(reply(proof) + SIZES.pack(len(bomb), 0) + bomb)
                assert stranger.recv(1) == b""
    assert not Bomb.went_off


def test_who_has_taken_a_replicas_port_gets_no_request_and_health_says_so(fleet: Fleet) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        came: list[bytes] = []

        def echo() -> None:
            with contextlib.suppress(OSError):
                while True:
                    taken, _ = listening.accept()
                    with taken, contextlib.suppress(OSError):
                        while data := taken.recv(4096):
                            came.append(data)
                            taken.sendall(data)

        threading.Thread(target=echo, daemon=True).start()
        fleet.announce(left=Place("127.0.0.1", port, "00" * 32))
        with fleet.server() as server:
            status, _, text = asyncio.run(http_get(server.port, "/healthz"))
            assert status == 503
            why = f"the replica at 127.0.0.1:{port} can't be reached: it doesn't prove that it is the fleet's"
            assert text.strip() == why
        assert came and all(len(data) <= 64 for data in came)
        listening.shutdown(socket.SHUT_RDWR)


def test_messages_of_all_sizes_come_whole_and_in_order_both_ways() -> None:
    async def main() -> None:
        secret = "ab" * 32

        async def back(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await prove(reader, writer, secret, 1)
            async for head, body in messages(reader):
                send(writer, head, body)
            writer.close()

        server = await asyncio.start_server(back, "127.0.0.1", 0)
        reader, writer = await connect_to(Place("127.0.0.1", server.sockets[0].getsockname()[1], secret))
        drawn = random.Random(1)
        bodies = [drawn.randbytes(size) for size in (0, 1, 11, 12, 65535, 300_000, 3_000_000, 0, 5)]
        for number, body in enumerate(bodies):
            send(writer, {"number": number}, body)
        came = messages(reader)
        for number, body in enumerate(bodies):
            assert await anext(came) == ({"number": number}, body)
        writer.close()
        assert [one async for one in came] == []
        server.close()

    asyncio.run(asyncio.wait_for(main(), MOST_SECONDS))
