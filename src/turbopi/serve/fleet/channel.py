"""A request's way from the server in front to a replica, and its answer's way back: one TCP connection between them.

Ray Serve's own way costs the server 1.3 ms of CPU a request (docs/dev/log/serving.md). So Ray Serve only says which
replicas there are, and where each listens. A message is a head, pickled, and a body: bytes as they came from a robot.
Both ends first prove that they know the replica's secret; nothing is unpickled before.
"""

import asyncio
import hmac
import pickle
import secrets
import socket
import struct
from collections.abc import AsyncIterator
from typing import Any, NamedTuple

SIZES = struct.Struct(">IQ")  # bytes of the head, bytes of the body
PROOF_BYTES = 32
PROOF_SECONDS = 3.0  # to connect and to prove oneself
READ_BYTES = 2**22  # that may come before they are used
SILENCE = {
    "TCP_KEEPIDLE": 2,
    "TCP_KEEPINTVL": 2,
    "TCP_KEEPCNT": 3,
    "TCP_USER_TIMEOUT": 8000,
}  # of a machine that's gone
ROLES = (b"server", b"replica")


class Place(NamedTuple):
    """Where a replica listens."""

    host: str
    port: int
    secret: str


# Of each fleet's replicas, by Ray Serve's names, as its router in this process has them (ray_router.py).
PLACES: dict[str, dict[str, Place]] = {}


async def connect(place: Place) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """To a replica. Raises ConnectionError."""
    try:
        connecting = asyncio.open_connection(place.host, place.port, limit=READ_BYTES)
        reader, writer = await asyncio.wait_for(connecting, PROOF_SECONDS)
        await prove(reader, writer, place.secret, 0)
    except (OSError, asyncio.TimeoutError) as error:
        why = str(error) or f"no answer within {PROOF_SECONDS:g} s"
        raise ConnectionError(f"the replica at {place.host}:{place.port} can't be reached: {why}") from error
    return reader, writer


async def prove(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, secret: str, role: int) -> None:
    """Prove that this end, of ROLES, knows the secret, and see that the other one does. Else raises ConnectionError."""
    sock = writer.get_extra_info("socket")
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in SILENCE.items():
        if hasattr(socket, name):  # Linux's
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

    def proof(role: int, own: bytes, other: bytes) -> bytes:
        return hmac.digest(bytes.fromhex(secret), ROLES[role] + own + other, "sha256")

    own = secrets.token_bytes(PROOF_BYTES)
    writer.write(own)
    try:
        other = await asyncio.wait_for(reader.readexactly(PROOF_BYTES), PROOF_SECONDS)
        writer.write(proof(role, own, other))
        proved = await asyncio.wait_for(reader.readexactly(PROOF_BYTES), PROOF_SECONDS)
    except (OSError, EOFError, asyncio.TimeoutError):
        proved = b""
    if not hmac.compare_digest(proved, proof(1 - role, other, own) if proved else b"-"):
        writer.close()
        raise ConnectionError("it doesn't prove that it is the fleet's")


def send(writer: asyncio.StreamWriter, head: object, body: bytes = b"") -> None:
    """Send a message; after the end it is dropped. Raises what pickling raises."""
    packed = pickle.dumps(head, pickle.HIGHEST_PROTOCOL)
    if not writer.is_closing():
        writer.writelines((SIZES.pack(len(packed), len(body)) + packed, body))


async def messages(reader: asyncio.StreamReader) -> AsyncIterator[tuple[Any, bytes]]:
    """Head and body of each message, until the end."""
    try:
        while True:
            head, body = SIZES.unpack(await reader.readexactly(SIZES.size))
            yield pickle.loads(await reader.readexactly(head)), await reader.readexactly(body)
    except (OSError, EOFError):
        return
