"""Messages to a server on the same host through memory that both have open, instead of through the socket.

    client   asks for it with a header of its websocket's HTTP request
    server   makes a file without a name (memfd_create) of SLOTS slots, and answers with a header that says where it is
    client   opens /proc/<pid>/fd/<descriptor>; writes each message into the next slot, and sends which one and how long
    server   copies the message out of the slot, but for images where the policy copies these itself and keeps none:
             from there on it is as if it had come through the socket

The kernel lets only processes of the server's user open the descriptor. What the client can't open, because it is on
another host, in another container or another user's, it does without: messages go through the socket, as they do for
what is larger than a slot. The file has no name, so a process that dies leaves nothing behind. Its size is sealed: a
client that cut it would end the server by a signal.

A slot is used again two messages later, when the server has answered the message in it.
"""

import contextlib
import mmap
import os
import secrets
import struct
from collections.abc import Sequence

HEADER, WANTED = "Turbopi-Shared-Memory", "wanted"  # of the HTTP request; of its response with "pid file bytes token"
SLOTS = 2
BEGIN = 4096  # of the first slot; the token is in front
MIN_BYTES = 16384  # of a message: smaller ones go through the socket
_NAME = "turbopi-messages"
_TOKEN = 16
_DOORBELL = struct.Struct(">BBI")  # _BELL, slot, bytes of the message
DOORBELL_BYTES = _DOORBELL.size
_BELL = 0xC1  # begins no msgpack value

Parts = Sequence[bytes | memoryview]


class SharedSlots:
    """The server's side, of one connection. `slot_bytes`: the longest message.

    Raises OSError where there is none: another system than Linux, no memory, no descriptors.
    """

    def __init__(self, slot_bytes: int) -> None:
        self._slot_bytes, self._token = slot_bytes, secrets.token_bytes(_TOKEN)
        if not hasattr(os, "memfd_create"):
            raise OSError("this system has no memfd_create")
        import fcntl

        self._file = os.memfd_create(_NAME, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.ftruncate(self._file, BEGIN + SLOTS * slot_bytes)  # takes memory only where something is written
            fcntl.fcntl(self._file, fcntl.F_ADD_SEALS, fcntl.F_SEAL_GROW | fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_SEAL)
            os.pwrite(self._file, self._token, 0)
            self._memory = mmap.mmap(self._file, 0, prot=mmap.PROT_READ)
        except BaseException:
            os.close(self._file)
            raise

    @property
    def offer(self) -> str:
        """The response's header."""
        return f"{os.getpid()} {self._file} {self._slot_bytes} {self._token.hex()}"

    def message(self, received: bytes) -> memoryview | None:
        """The message that `received` says is in a slot, and that the client may change there at any time.

        None: it says no such thing, and is a message itself.
        """
        if len(received) != _DOORBELL.size or received[0] != _BELL:
            return None
        _, slot, length = _DOORBELL.unpack(received)
        if slot >= SLOTS or length > self._slot_bytes:
            return None
        begin = BEGIN + slot * self._slot_bytes
        return memoryview(self._memory)[begin : begin + length]

    def close(self) -> None:
        """Free the memory, once the client has closed it, too, and the call that reads an image in it has ended."""
        with contextlib.suppress(BufferError):
            self._memory.close()
        os.close(self._file)


class SharedWriter:
    """The client's side. Raises OSError or ValueError if the offer isn't one that this process can use."""

    def __init__(self, offer: str) -> None:
        pid, file, slot_bytes = map(int, offer.split(" ")[:3])
        token = bytes.fromhex(offer.rpartition(" ")[2])
        place = f"/proc/{pid}/fd/{file}"
        if _NAME not in os.readlink(place):  # another container's process, whose file may be anything
            raise ValueError(f"{place} isn't the server's memory")
        file = os.open(place, os.O_RDWR | os.O_CLOEXEC)
        try:
            self._memory = mmap.mmap(file, BEGIN + SLOTS * slot_bytes)
        finally:
            os.close(file)
        self._slot_bytes, self._slot = slot_bytes, 0
        if self._memory[:_TOKEN] != token:
            self.close()
            raise ValueError(f"{place} is another connection's memory")

    def put(self, parts: Parts) -> bytes | None:
        """What to send instead of a message of these parts; None if it must be sent itself."""
        length = sum(map(len, parts))
        if not MIN_BYTES <= length <= self._slot_bytes:
            return None
        self._slot = (self._slot + 1) % SLOTS
        at = BEGIN + self._slot * self._slot_bytes
        for part in parts:
            self._memory[at : at + len(part)] = part
            at += len(part)
        return _DOORBELL.pack(_BELL, self._slot, length)

    def close(self) -> None:
        self._memory.close()


def writer(offer: str | None) -> SharedWriter | None:
    """For what a server offers, if it does and this process can use it."""
    with contextlib.suppress(OSError, ValueError):
        return None if offer is None else SharedWriter(offer)
    return None
