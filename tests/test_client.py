"""turbopi.realtime.client: no answer is taken for another call's, no call waits for ever, only chunks get through."""

import base64
import hashlib
import os
import select
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
import pytest
import websockets.sync.server
from serve_fakes import NO_CHUNKS, wait_for
from websockets.exceptions import ConnectionClosed
from websockets.frames import Frame, Opcode

from turbopi.evaluate.sources import RemotePolicy
from turbopi.realtime import policy_socket
from turbopi.realtime.client import RealTimeClient, ServerLost, ServerRefused
from turbopi.realtime.frames import binary_head, binary_message
from turbopi.realtime.policy_socket import _Awake
from turbopi.realtime.running_chunk import RunningChunk
from turbopi.realtime.wire import pack, unpack
from turbopi.serve import running
from turbopi.support.errors import ActionError, ConfigError, ObservationError
from turbopi.view.live import LiveServer


class Echo:
    """Answers with what it was sent."""

    def __init__(self) -> None:
        self.metadata: dict[str, Any] = {}

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        return {"actions": np.full((1, 1), float(obs["place"]))}


@contextmanager
def _instead_of_receiving(monkeypatch: pytest.MonkeyPatch, what: Any) -> Iterator[None]:
    with monkeypatch.context() as patch:
        patch.setattr("turbopi.realtime.policy_socket._Stream.receive", what)
        yield


def _interrupted(*_: Any, **__: Any) -> Any:
    raise KeyboardInterrupt


def test_after_ctrl_c_the_next_call_gets_its_own_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    with running(Echo()) as server, RealTimeClient("127.0.0.1", server.port) as client:
        with _instead_of_receiving(monkeypatch, _interrupted), pytest.raises(KeyboardInterrupt):
            client.infer({"place": 1})
        assert client.infer({"place": 2})["actions"] == 2
        assert client.infer({"place": 3})["actions"] == 3


def test_ctrl_c_while_it_connects_anew_leaves_no_greeting_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    with running(Echo()) as server, RealTimeClient("127.0.0.1", server.port) as client:
        client.close()
        with _instead_of_receiving(monkeypatch, _interrupted), pytest.raises(KeyboardInterrupt):
            client.infer({"place": 1})
        assert client.infer({"place": 2})["actions"] == 2


@pytest.mark.parametrize("greeting", ["traceback", b"\xc1", pack([1])])
def test_a_server_that_greets_with_nonsense_is_not_kept(greeting: str | bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    with running(Echo()) as server, RealTimeClient("127.0.0.1", server.port) as client:
        client.close()
        with (
            _instead_of_receiving(monkeypatch, lambda *_, **__: greeting),
            pytest.raises(ServerRefused, match="doesn't speak openpi's protocol"),
        ):
            client.infer({"place": 1})
        assert client.infer({"place": 2})["actions"] == 2


@pytest.mark.parametrize(
    ("host", "text"),
    [
        ("http://localhost:8000", "the host is 'http://localhost:8000'; give a name, or a URL that begins with ws://"),
        ("localhost:8000", "the host is 'localhost:8000'; give its name, and the port beside it"),
    ],
)
def test_a_host_that_is_no_name_is_refused_in_words(host: str, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        RealTimeClient(host)


@pytest.mark.parametrize("host", ["::1", "ws://[::1]"])
def test_without_a_server_the_error_says_where_and_that_it_may_not_be_warm(host: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]  # free when it is closed
    with pytest.raises(ServerLost, match=rf"no policy server at ws://127\.0\.0\.1:{port}: .*once it is warm"):
        RealTimeClient("127.0.0.1", port)
    with pytest.raises(ServerLost, match=rf"no policy server at ws://\[::1\]:{port}: "):
        RealTimeClient(host, port)


def test_a_port_beside_a_url_is_the_urls() -> None:
    with running(Echo()) as server:
        for host in ("ws://127.0.0.1", "ws://127.0.0.1/"):
            with RealTimeClient(host, server.port) as client:
                assert client.infer({"place": 2})["actions"] == 2
    with pytest.raises(ConfigError, match=r"'ws://gpu/robot', a URL with a path: give the port in it"):
        RealTimeClient("ws://gpu/robot", 8000)


def test_a_server_that_lets_nobody_in_says_why() -> None:
    with (
        running(Echo(), max_clients=1) as server,
        RealTimeClient("127.0.0.1", server.port),
        pytest.raises(ServerLost, match=r"HTTP 503 .*1 clients, its limit \(--max-clients\); try again later"),
    ):
        RealTimeClient("127.0.0.1", server.port)


@pytest.mark.parametrize("value", [object(), np.array([None]), 2**70])
def test_what_cannot_be_sent_is_named_by_its_key_and_the_connection_stays(value: object) -> None:
    with running(Echo()) as server, RealTimeClient("127.0.0.1", server.port) as client:
        with pytest.raises(ObservationError, match="wrist: can't send "):
            client.infer({"place": 1, "wrist": value})
        with pytest.raises(ObservationError, match="wrist: can't send "):
            client.infer({"place": 1, "wrist": [{"inner": value}]})
        assert client.infer({"place": 2})["actions"] == 2


@pytest.mark.parametrize("length", [0, 1, 125, 126, 2**16 - 1, 2**16])
def test_a_frame_made_or_read_here_is_the_librarys(length: int, monkeypatch: pytest.MonkeyPatch) -> None:
    message = bytes(length)
    ours = Frame(Opcode.BINARY, message).serialize(mask=False)
    assert binary_head(length) + message == ours and binary_message(ours) == message
    assert binary_message(ours[:-1]) is binary_message(ours + b"x") is None
    for other in (Frame(Opcode.TEXT, message), Frame(Opcode.BINARY, message, fin=False)):
        assert binary_message(other.serialize(mask=False)) is None
    monkeypatch.setattr("secrets.token_bytes", bytes)
    masked = Frame(Opcode.BINARY, message).serialize(mask=True)
    assert binary_head(length, masked=True) + message == masked and binary_message(masked) is None


class Pieces:
    """A socket that gives what came in these pieces."""

    def __init__(self, pieces: list[bytes]) -> None:
        self.pieces, self.sent = pieces, b""

    def recv(self, _: int) -> bytes:
        return self.pieces.pop(0)

    def sendall(self, data: bytes) -> None:
        self.sent += data


def test_messages_are_the_same_however_the_socket_cuts_them_and_pings_are_answered() -> None:
    said: list[Frame] = [
        Frame(Opcode.BINARY, b"\x82\x01a"),
        Frame(Opcode.PING, b"\x82\x02is"),
        Frame(Opcode.TEXT, b"no"),
    ]
    said += [Frame(Opcode.BINARY, bytes(130)), Frame(Opcode.BINARY, b"ha", fin=False), Frame(Opcode.CONT, b"lf")]
    whole = b"".join(frame.serialize(mask=False) for frame in said)
    ends = list(accumulate(len(frame.serialize(mask=False)) for frame in said))
    cuts = [[place] for place in range(1, len(whole))] + [list(range(1, len(whole))), ends[:-1]]
    with running(Echo()) as server, RealTimeClient("127.0.0.1", server.port) as client:
        assert client._socket is not None
        stream, real = client._socket._stream, client._socket.socket
        for cut in cuts:
            pieces = Pieces([whole[begin:end] for begin, end in pairwise([0, *cut, len(whole)])])
            with stream.using:
                stream.socket = pieces  # type: ignore[assignment]
                try:
                    assert [stream.receive() for _ in range(4)] == [b"\x82\x01a", "no", bytes(130), b"half"]
                finally:
                    stream.socket = real
            assert pieces.sent[:1] == b"\x8a" and not pieces.pieces and not stream._begun


@pytest.mark.parametrize("seconds", [0.0, 0.002])
def test_who_is_awake_for_the_answer_gets_it_sooner_or_later_than_it_is_due(
    seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("turbopi.realtime.policy_socket.PROCESSORS", 1)
    policy = Echo()
    with running(policy) as server, RealTimeClient("127.0.0.1", server.port) as client:
        assert client._socket is not None
        awake = client._socket._awake
        assert isinstance(awake, _Awake) or not hasattr(os, "memfd_create")
        for number in range(20):
            if isinstance(awake, _Awake):
                awake._took.append(seconds * (number % 3))
            assert client.infer({"place": number})["actions"] == number


def test_a_request_that_came_too_late_costs_no_connection() -> None:
    """With the connection its session would end, and so the running chunk that the server keeps."""
    with running(Echo()) as server, RealTimeClient("127.0.0.1", server.port) as client:
        socket = client._socket
        with pytest.raises(ServerRefused, match="sent no actions but: late: "):
            client.infer({"place": 1, "turbopi/deadline_ms": 1e-6})
        assert client.infer({"place": 2})["actions"] == 2
        assert client._socket is socket


def test_a_running_chunk_of_another_kind_is_refused() -> None:
    with running(Echo()) as server, RealTimeClient("127.0.0.1", server.port) as client:
        left_over: Any = np.zeros((3, 32), np.float32)
        with pytest.raises(ObservationError, match=r"previous is an ndarray; .* turbopi\.realtime\.RunningChunk"):
            client.infer({"place": 1}, previous=left_over)


# --- no call waits for ever -------------------------------------------------------------------------------------------


@contextmanager
def deaf_server(*, greets: bool = True) -> Iterator[int]:
    """The port of a server that greets each client, unless told otherwise, and never reads what it is sent."""
    clients: list[socket.socket] = []

    def serve() -> None:
        with suppress(OSError):  # the end
            while True:
                client, _ = listening.accept()
                clients.append(client)
                head = b""
                while b"\r\n\r\n" not in head:
                    head += client.recv(4096)
                (key,) = (line[19:] for line in head.split(b"\r\n") if line.lower().startswith(b"sec-websocket-key: "))
                accept = base64.b64encode(hashlib.sha1(key + b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11").digest())
                upgrade = b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: " + accept
                greeting = pack({"policy": "deaf"})
                client.sendall(b"HTTP/1.1 101 Switching Protocols\r\n" + upgrade + b"\r\n\r\n")
                if greets:
                    client.sendall(bytes([0x82, len(greeting)]) + greeting)

    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield listening.getsockname()[1]
        finally:
            listening.shutdown(socket.SHUT_RDWR)
            thread.join()
            for client in clients:
                client.close()


def ends(call: Callable[[], Any]) -> BaseException | None:
    """What a call raises, which must not take for ever."""
    raised: list[BaseException] = []

    def run() -> None:
        try:
            call()
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(60)
    assert not thread.is_alive(), "it waits for ever"
    return raised[0] if raised else None


@pytest.mark.parametrize("size", [10, 30_000_000], ids=["waits for its answer", "sends more than the sockets hold"])
def test_a_call_gives_up_at_its_deadline_though_the_server_reads_nothing(
    size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("turbopi.realtime.policy_socket.CLOSE_S", 3600.0)  # closing is within the deadline, too
    with deaf_server() as port:
        client = RealTimeClient("127.0.0.1", port, answer_s=0.2)
        lost = ends(lambda: client.infer({"image": np.zeros(size, np.uint8)}))
        assert isinstance(lost, ServerLost) and "gave no answer within 0.2 s" in str(lost)
        assert client._socket is None
        assert ends(client.close) is None


def test_connecting_gives_up_at_its_deadline_whatever_it_waits_for(monkeypatch: pytest.MonkeyPatch) -> None:
    with deaf_server(greets=False) as port:
        lost = ends(lambda: RealTimeClient("127.0.0.1", port, connect_s=0.2))
        assert isinstance(lost, ServerLost) and "nothing came within 0.2 s" in str(lost)
    released = threading.Event()

    def hangs(*_: Any, **__: Any) -> Any:
        assert released.wait(60)
        raise socket.gaierror("no such host")

    with monkeypatch.context() as patch:
        patch.setattr(socket, "getaddrinfo", hangs)
        lost = ends(lambda: RealTimeClient("gpu-machine", connect_s=0.2))
        assert isinstance(lost, ServerLost) and "nothing came within 0.2 s" in str(lost)
        released.set()


@pytest.mark.parametrize(
    "connect",
    [
        lambda port: RealTimeClient("127.0.0.1", port),
        lambda port: RemotePolicy("127.0.0.1", port),
        lambda port: LiveServer(f"http://127.0.0.1:{port}"),
    ],
    ids=["RealTimeClient", "eval", "view"],
)
@pytest.mark.parametrize("variable", ["http_proxy", "https_proxy"])
def test_a_proxy_in_the_environment_is_not_asked(
    variable: str, connect: Callable[[int], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("no_proxy", raising=False)
    monkeypatch.delenv("NO_PROXY", raising=False)
    monkeypatch.setenv(variable, "http://127.0.0.1:9")  # where nobody listens
    with running(Echo()) as server:
        connect(server.port).close()


def test_a_client_that_does_not_call_answers_pings_and_the_servers_goodbye() -> None:
    ponged, left = threading.Event(), threading.Event()

    def handle(connection: Any) -> None:
        connection.send(pack({}))
        if connection.ping().wait(60):
            ponged.set()
        connection.send(pack({"actions": np.ones((1, 1))}))
        connection.close()  # waits for the client's
        left.set()

    with client_of(handle, close_timeout=600) as client:
        assert ponged.wait(60) and left.wait(60)
        with pytest.raises(ServerLost, match="went away"):
            client.infer({})


def test_the_threads_of_a_client_end_with_it() -> None:
    def threads() -> list[threading.Thread]:
        return [one for one in threading.enumerate() if one.name == "turbopi-deadline" and one not in before]

    before = threading.enumerate()
    with running(Echo()) as server:
        clients = [RealTimeClient("127.0.0.1", server.port) for _ in range(3)]
        for client in clients:
            client.infer({"place": 1})
        assert len(threads()) == 3
        clients[0].close()
        wait_for(lambda: len(threads()) == 2)
    wait_for(lambda: not threads())  # the server has closed the others
    with pytest.raises(ServerLost, match="went away"):
        clients[1].infer({"place": 1})


# --- answers ----------------------------------------------------------------------------------------------------------


@contextmanager
def client_of(handle: Callable[[Any], None], **options: Any) -> Iterator[RealTimeClient]:
    """A client of a server that does this with each connection."""
    with websockets.sync.server.serve(handle, "127.0.0.1", 0, compression=None, **options) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            with RealTimeClient("127.0.0.1", server.socket.getsockname()[1]) as client:
                yield client
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def foreign(metadata: dict[str, Any], *answers: Any) -> Iterator[tuple[RealTimeClient, list[dict[str, Any]]]]:
    """A client of a server that gives these answers whatever it is sent, and the messages that it got."""
    received: list[dict[str, Any]] = []

    def handle(connection: Any) -> None:
        with suppress(ConnectionClosed):
            connection.send(pack(metadata))
            for answer in answers:
                received.append(unpack(connection.recv()))
                connection.send(answer if isinstance(answer, str) else pack(answer))
            connection.recv()

    with client_of(handle) as client:
        yield client, received


def test_what_another_server_answers_gets_through_as_a_chunk_of_finite_numbers_alone() -> None:
    sendable = {name: answer for name, answer in NO_CHUNKS.items() if name not in ("objects", "complex")}
    answers = [answer for answer in sendable.values() if isinstance(answer, dict)]
    with foreign({}, *answers, {"actions": np.zeros((4, 7))}) as (client, _):
        for _ in answers:
            with pytest.raises(ActionError):
                client.infer({})
        assert client.infer({})["actions"].shape == (4, 7)  # on the same connection


@pytest.mark.parametrize("idle", [False, True])
def test_an_answer_that_nobody_asked_for_is_not_the_next_calls(idle: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    came = threading.Event()
    monkeypatch.setattr(policy_socket, "IDLE_S", policy_socket.IDLE_S if idle else 1e6)

    def handle(connection: Any) -> None:
        with suppress(ConnectionClosed):
            connection.send(pack({}))
            place = unpack(connection.recv())["place"]
            connection.send(pack({"actions": [[place]]}))
            connection.send(pack({"actions": [[-place]]}))
            if idle and place == 1 and connection.ping().wait(60):  # the client has read on
                came.set()
            connection.recv()

    with client_of(handle) as client:
        assert client.infer({"place": 1.0})["actions"] == 1
        assert client._socket is not None
        stream = client._socket._stream
        # Both answers may have come as one.
        assert (
            came.wait(60) if idle else wait_for(lambda: stream._events or select.select([stream.socket], [], [], 0)[0])
        )
        with pytest.raises(ServerLost, match="an answer that nobody asked for"):
            client.infer({"place": 2.0})
        assert client.infer({"place": 3.0})["actions"] == 3


def test_the_chunks_of_a_batch_message_are_each_checked() -> None:
    chunks = np.zeros((3, 4, 7))
    bad = chunks.copy()
    bad[2, 1, 0] = np.nan
    with foreign({}, {"actions": chunks}, {"actions": [chunks[0], chunks[1, :2]]}, {"actions": bad}) as (client, _):
        assert client.infer({"turbopi/batch": 3})["actions"].shape == (3, 4, 7)
        assert [len(chunk) for chunk in client.infer({"turbopi/batch": 2})["actions"]] == [4, 2]
        with pytest.raises(ActionError, match="nan"):
            client.infer({"turbopi/batch": 3})


def test_the_arrays_of_an_answer_may_be_written_to() -> None:
    answer = {"actions": np.zeros((4, 7)), "named": {"arm": np.zeros(4)}, "more": [np.zeros(2)]}
    with foreign({}, answer) as (client, _):
        got = client.infer({})
        for array in (got["actions"], got["named"]["arm"], got["more"][0]):
            array[0] = 1.0


# --- as openpi's own clients are used ---------------------------------------------------------------------------------

ACTIONS = {"actions": np.zeros((4, 7)), "model_actions": np.zeros((4, 32), np.float32)}
MODES = ["rtc"]


def test_openpis_name_for_the_metadata_works() -> None:
    with running(Echo()) as server, RealTimeClient("127.0.0.1", server.port) as client:
        assert client.get_server_metadata() == client.metadata


def test_a_reset_is_told_once_to_a_server_that_keeps_the_running_chunk() -> None:
    metadata = {"real_time": {"modes": MODES, "execution": "rtc"}}
    with foreign(metadata, *[ACTIONS] * 2, "late: 3 ms", *[ACTIONS] * 2) as (client, received):
        client.infer({})
        client.reset()
        client.infer({}, previous=RunningChunk(np.zeros((2, 32), np.float32), 1), model_actions=True)  # keeps it itself
        with pytest.raises(ServerRefused, match="late"):
            client.infer({})
        client.infer({})
        client.infer({})
    assert [message.get("turbopi/reset") for message in received] == [None, None, True, True, None]


@pytest.mark.parametrize(
    ("execution", "keys", "reported"),
    [
        (None, {}, False),
        (None, {"turbopi/session": "a", "turbopi/mode": "rtc"}, True),
        ("rtc", {"turbopi/session": "a"}, True),
        ("rtc", {"turbopi/session": "a", "turbopi/mode": "none"}, False),
        ("rtc", {"turbopi/reset": False}, True),
        ("rtc", {"turbopi/batch": 1}, False),
    ],
)
def test_a_reset_is_told_where_there_is_something_to_forget(
    execution: str | None, keys: dict[str, Any], reported: bool
) -> None:
    answer = {"actions": np.zeros((1, 4, 7))} if "turbopi/batch" in keys else ACTIONS
    with foreign({"real_time": {"modes": MODES, "execution": execution}}, answer) as (client, received):
        client.reset()
        client.infer(keys)
        assert received == [{**keys, "turbopi/reset": True} if reported else keys]
