"""Messages through shared memory, of a client on the server's host: as through the socket, whatever goes wrong."""

import fcntl
import mmap
import os
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from serve_fakes import FakePolicy, wait_for
from websockets.sync.client import connect

from turbopi.realtime.client import RealTimeClient, ServerLost
from turbopi.realtime.shared_memory import BEGIN, HEADER, MIN_BYTES, SLOTS, WANTED, SharedSlots, SharedWriter, writer
from turbopi.realtime.wire import pack, unpack
from turbopi.recordings import iter_recording
from turbopi.serve import running
from turbopi.serve.limits import Limits

pytestmark = pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="shared memory needs Linux")


def observation(prompt: str, seed: int = 0, pixels: int = 100) -> dict[str, Any]:
    image = np.random.default_rng(seed).integers(0, 256, (pixels, pixels, 3), dtype=np.uint8)
    return {"observation/image": image, "observation/state": np.linspace(-1, 1, 8), "prompt": prompt}


class InPlace(FakePolicy):
    """Keeps no image: `saw` is a copy of the last one, after `before`."""

    reads_in_place = True

    def __init__(self) -> None:
        super().__init__()
        self.before: Callable[[], object] = lambda: None
        self.saw = np.zeros(0)

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        self.before()
        self.saw = obs["observation/image"].copy()
        answer = super().infer(obs)
        self.observations = {prompt: {**kept, "observation/image": None} for prompt, kept in self.observations.items()}
        return answer


def shares(client: RealTimeClient) -> bool:
    return client._socket is not None and client._socket._memory is not None


def files() -> int:
    """Descriptors and mappings of such memory in this process, which is the client and the server."""
    names = []
    for link in Path("/proc/self/fd").iterdir():
        try:
            names.append(os.readlink(link))
        except OSError:  # closed meanwhile
            continue
    return sum("turbopi-messages" in name for name in names) + Path("/proc/self/maps").read_text().count("turbopi-mess")


def test_what_comes_through_memory_is_what_was_sent_and_is_recorded(tmp_path: Path) -> None:
    policy = FakePolicy()
    with running(policy, record_dir=tmp_path) as server, RealTimeClient("127.0.0.1", server.port) as client:
        assert shares(client) and "shared_memory" not in client.metadata
        for number in range(5):
            actions = client.infer(observation(f"{number}", number))["actions"]
            assert np.array_equal(actions[0], np.linspace(-1, 1, 8))
    for number, (recorded, _) in enumerate(iter_recording(tmp_path)):
        for received in (policy.observations[f"{number}"], recorded):
            assert np.array_equal(received["observation/image"], observation("", number)["observation/image"])


@pytest.mark.parametrize("pixels", [2, 73, 74, 600, 1182, 1183], ids=lambda n: f"{n * n * 3} bytes")
def test_a_message_of_any_size_arrives_in_memory_or_not(pixels: int) -> None:
    policy = FakePolicy()
    with running(policy) as server, RealTimeClient("127.0.0.1", server.port) as client:
        sent = observation("one", 1, pixels)
        client.infer(sent)
        assert np.array_equal(policy.observations["one"]["observation/image"], sent["observation/image"])
        assert client._socket is not None and client._socket._memory is not None
        fits = MIN_BYTES <= len(pack(sent)) <= 4 * 2**20
        assert (client._socket._memory._slot != 0) is fits


def test_a_slot_that_is_overwritten_while_the_policy_runs_changes_nothing() -> None:
    policy = FakePolicy()
    with running(policy) as server, RealTimeClient("127.0.0.1", server.port) as client:
        assert client._socket is not None and client._socket._memory is not None
        memory = client._socket._memory._memory
        original = policy.infer

        def overwritten(obs: dict[str, Any]) -> dict[str, Any]:
            memory[BEGIN:] = b"\xff" * (len(memory) - BEGIN)
            return original(obs)

        policy.infer = overwritten  # type: ignore[method-assign]
        client.infer(observation("one"))
        assert np.array_equal(policy.observations["one"]["observation/image"], observation("one")["observation/image"])


@pytest.mark.parametrize("recorded", [False, True])
def test_a_policy_that_keeps_no_image_reads_them_where_they_lie_but_for_a_recording(
    recorded: bool, tmp_path: Path
) -> None:
    policy = InPlace()
    with (
        running(policy, record_dir=tmp_path if recorded else None) as server,
        RealTimeClient("127.0.0.1", server.port) as client,
    ):
        for seed in (2, 3):  # from the third on, messages look like one before
            client.infer(observation("six", seed))
        assert client._socket is not None and client._socket._memory is not None
        memory = client._socket._memory._memory
        policy.before = lambda: memory.__setitem__(slice(BEGIN, None), bytes(len(memory) - BEGIN))
        wait_for(lambda: bool(server._idle))  # a request that comes sooner is copied
        client.infer(observation("six", 1))
    image = observation("six", 1)["observation/image"]
    assert np.array_equal(policy.saw, image if recorded else 0 * image)
    kept = policy.observations["six"]  # nothing but the image changes with the memory
    assert np.array_equal(kept["observation/state"], np.linspace(-1, 1, 8)) and kept["prompt"] == "six"


def refuse(*_: Any, **__: Any) -> Any:
    raise PermissionError(13, "Permission denied")


def other_file(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in another container, where the server's number is another process's."""
    monkeypatch.setattr(os, "readlink", lambda *_: "/dev/null")


def other_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SharedSlots, "offer", property(lambda self: f"{os.getpid()} {self._file} 4096 {'00' * 16}"))


FAULTS: dict[str, Callable[[pytest.MonkeyPatch], None]] = {
    "no memfd": lambda patch: patch.delattr(os, "memfd_create"),
    "no memory": lambda patch: patch.setattr(os, "memfd_create", refuse),
    "no seals": lambda patch: patch.setattr(fcntl, "fcntl", refuse),
    "no mapping": lambda patch: patch.setattr(mmap, "mmap", refuse),
    "another user's": lambda patch: patch.setattr(os, "readlink", refuse),
    "another container's": other_file,
    "another connection's": other_memory,
    "nonsense": lambda patch: patch.setattr(SharedSlots, "offer", "1 2 x"),
    "an end": lambda patch: patch.setattr(SharedSlots, "offer", "1"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_without_shared_memory_messages_take_the_socket(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, before = FakePolicy(), files()
    with running(policy) as server, monkeypatch.context() as patch:
        FAULTS[fault](patch)
        with RealTimeClient("127.0.0.1", server.port) as client:
            assert not shares(client)
            client.infer(observation("one"))
    assert "one" in policy.observations
    wait_for(lambda: files() == before)


def test_the_server_shares_with_so_many_clients_and_whose_place_is_free_gets_it() -> None:
    with running(FakePolicy(), limits=Limits(shared_memory=1)) as server:
        with RealTimeClient("127.0.0.1", server.port) as first, RealTimeClient("127.0.0.1", server.port) as second:
            assert shares(first) and not shares(second)
            assert second.infer(observation("one"))["prompt"] == "one"

        def shared() -> bool:
            with RealTimeClient("127.0.0.1", server.port) as client:
                return shares(client)

        wait_for(shared)


def test_a_slot_is_no_longer_than_a_message_may_be() -> None:
    with running(FakePolicy(), max_message_mb=0.1) as server, RealTimeClient("127.0.0.1", server.port) as client:
        assert client.infer(observation("fits"))["prompt"] == "fits"
        with pytest.raises(ServerLost, match="1009"):
            client.infer(observation("too long", pixels=200))


@pytest.mark.parametrize("make", [FakePolicy, InPlace])
def test_a_client_that_leaves_leaves_nothing_behind(make: Callable[[], FakePolicy]) -> None:
    before, policy = files(), make()
    with running(policy) as server:
        for leaves in ("at once", "in its request"):
            client = RealTimeClient("127.0.0.1", server.port)
            policy.release.set()
            for _ in range(2):  # from the third on, messages look like one before
                client.infer(observation("hold"))
            policy.release.clear()
            policy.started.clear()
            wait_for(lambda: bool(server._idle))
            assert client._socket is not None and client._socket._memory is not None
            if leaves == "in its request":
                message = client._socket._memory.put([pack(observation("hold"))])
                assert message is not None
                client._socket._stream.send(message)
                assert policy.started.wait(60)
            client._socket._cutter.cut()
            client._socket._memory.close()
            policy.release.set()
        wait_for(lambda: files() == before)


def test_after_a_restart_the_client_shares_the_new_servers_memory() -> None:
    policy = FakePolicy()
    with running(policy) as server:
        port = server.port
        client = RealTimeClient("127.0.0.1", port)
        client.infer(observation("before"))
    with pytest.raises(ServerLost):
        client.infer(observation("between"))
    with running(policy, port=port), client:
        client.infer(observation("after"))
        assert shares(client)
    assert policy.seen == ["before", "after"]


def slots_message(slots: SharedSlots, slot: int, length: int) -> bytes | None:
    return message_in(slots, struct.pack(">BBI", 0xC1, slot, length))


def message_in(slots: SharedSlots, bell: bytes | None) -> bytes | None:
    message = slots.message(bell or b"")
    return None if message is None else bytes(message)


def test_only_what_lies_in_a_slot_is_read_from_it() -> None:
    slots = SharedSlots(8192)
    assert slots_message(slots, 1, 8192) == bytes(8192)
    assert slots_message(slots, SLOTS, 1) is None
    assert slots_message(slots, 0, 8193) is None
    assert slots.message(b"") is None and slots.message(pack([1])) is None and slots.message(b"\xc1" * 7) is None
    slots.close()


@pytest.mark.parametrize("slot", [0, SLOTS, 255])
def test_a_wrong_slot_is_a_bad_request_and_the_connection_stays(slot: int) -> None:
    with (
        running(FakePolicy()) as server,
        connect(server.url, additional_headers={HEADER: WANTED}, compression=None) as connection,
    ):
        connection.recv()
        connection.send(struct.pack(">BBI", 0xC1, slot, 20_000))
        refusal = connection.recv()
        assert isinstance(refusal, str) and refusal.startswith("bad request: not a msgpack message: ")
        connection.send(pack(observation("one")))
        assert unpack(bytes(connection.recv()))["prompt"] == "one"  # type: ignore[arg-type]


def test_who_did_not_ask_for_memory_has_none() -> None:
    with running(FakePolicy()) as server, connect(server.url, compression=None) as connection:
        assert connection.response is not None and HEADER not in connection.response.headers
        connection.recv()
        connection.send(struct.pack(">BBI", 0xC1, 0, 20_000))
        assert "0xc1, which begins no value" in str(connection.recv())


def test_a_client_cannot_change_the_size_under_the_server() -> None:
    slots = SharedSlots(8192)
    pid, file, *_ = slots.offer.split(" ")
    with open(f"/proc/{pid}/fd/{file}", "r+b") as opened:
        for size in (0, 2**20):
            with pytest.raises(PermissionError):
                os.ftruncate(opened.fileno(), size)
    slots.close()


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="only root may become another user")
def test_another_users_process_cannot_open_it() -> None:
    slots = SharedSlots(8192)
    code = (
        "import os, sys; from turbopi.realtime.shared_memory import SharedWriter; os.setuid(65534)\n"
        "try: SharedWriter(sys.argv[1])\nexcept PermissionError: sys.exit(7)"
    )
    assert subprocess.run([sys.executable, "-c", code, slots.offer], check=False).returncode == 7
    slots.close()


def test_a_slot_is_used_again_two_messages_later() -> None:
    slots = SharedSlots(40_000)
    client = writer(slots.offer)
    assert isinstance(client, SharedWriter)
    sent = [bytes([number]) * (MIN_BYTES + number) for number in range(5)]
    bells = [client.put([message[:100], memoryview(message)[100:]]) for message in sent[:2]]
    assert [message_in(slots, bell) for bell in bells] == sent[:2]
    assert client.put([bytes(MIN_BYTES - 1)]) is None and client.put([bytes(40_001)]) is None
    for message in sent[2:]:
        assert message_in(slots, client.put([message])) == message
    client.close()
    slots.close()
