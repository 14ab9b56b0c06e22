"""HTTP: who is let in, and what broken requests get."""

import asyncio
import contextlib
import re
from collections.abc import Iterator
from dataclasses import dataclass

from attack.arena import Arena
from attack.websocket import post, request

KEY = "attack-key"
PATIENCE_S = 30.0
IN, OUT = (101,), (400, 401, 403, 404, 405, 408, 413, 414, 421, 426, 429, 431, 501, 503, 505)
AUTHORIZED = f"Authorization: Api-Key {KEY}"


@dataclass(frozen=True)
class Knock:
    """A request and the HTTP statuses that are right for it; 0 is a close without an answer."""

    name: str
    wire: bytes
    statuses: tuple[int, ...]


def knocks(port: int) -> Iterator[Knock]:
    """Every request, for a server whose API key is KEY."""
    here = f"127.0.0.1:{port}"

    def origin(name: str, statuses: tuple[int, ...], *headers: str, host: str | None = None) -> Knock:
        wire = request(port, AUTHORIZED, *headers)
        if host is not None:
            wire = wire.replace(f"Host: {here}\r\n".encode(), host.encode())
        return Knock(name, wire, statuses)

    yield origin("no origin", IN)
    yield origin("own origin", IN, f"Origin: http://{here}")
    for value in (
        "http://evil.example",
        "null",
        "http://[::1",
        "http://127.0.0.1:1",
        "file://",
        "",
        "http://[",
        "é",
    ):
        yield origin(f"Origin: {value!r}", OUT, f"Origin: {value}")
    yield origin("Origin: a control character", (*OUT, 0), "Origin: \x7f")
    yield origin("long origin", (*OUT, 0), f"Origin: http://{'a' * 7000}")
    yield origin("two origins", OUT, f"Origin: http://{here}", "Origin: http://evil.example")
    for host in ("evil.example", f"evil.example:{port}", "[::1", "127.0.0.1.evil.example"):
        same = (f"Origin: http://{host}",)
        yield origin(f"rebound: Host and Origin {host}", OUT, *same, host=f"Host: {host}\r\n")
    yield origin("two hosts", OUT, host=f"Host: {here}\r\nHost: evil.example\r\n")
    yield origin("no host", (*IN, *OUT), host="")
    for name, headers in {
        "no key": (),
        "wrong key": ("Authorization: Api-Key attack-kex",),
        "beginning of the key": (f"Authorization: Api-Key {KEY[:-1]}",),
        "another scheme": (f"Authorization: Bearer {KEY}",),
        "key twice": (AUTHORIZED, AUTHORIZED),
        "key and another": (AUTHORIZED, "Authorization: Api-Key x"),
        "empty key": ("Authorization: Api-Key ",),
        "key with bytes": ("Authorization: Api-Key \xff\xfe",),
    }.items():
        yield Knock(name, request(port, *headers), (400, 401))
        plain = f"GET /metrics HTTP/1.1\r\nHost: {here}\r\n" + "".join(f"{line}\r\n" for line in headers) + "\r\n"
        yield Knock(f"/metrics, {name}", plain.encode("latin-1"), (400, 401))
    yield Knock("/metrics", f"GET /metrics HTTP/1.1\r\nHost: {here}\r\n{AUTHORIZED}\r\n\r\n".encode(), (200,))
    yield Knock("/healthz", f"GET /healthz HTTP/1.1\r\nHost: {here}\r\n\r\n".encode(), (200,))
    yield Knock("/healthz?x", f"GET /healthz?{'x' * 500} HTTP/1.1\r\nHost: {here}\r\n\r\n".encode(), (200,))
    yield Knock("long path", f"GET /{'x' * 9000} HTTP/1.1\r\nHost: {here}\r\n{AUTHORIZED}\r\n\r\n".encode(), (*OUT, 0))
    for method in ("POST", "PUT", "HEAD", "CONNECT", "TRACE", "OPTIONS", "get", "X" * 300):
        refused = (404,) if method == "POST" else (405, 400)
        for path in ("/", "/healthz"):
            wire = f"{method} {path} HTTP/1.1\r\nHost: {here}\r\n\r\n".encode()
            yield Knock(f"method {method[:10]} of {path}", wire, refused)
        wire = request(port, AUTHORIZED).replace(b"GET ", f"{method} ".encode(), 1)
        yield Knock(f"method {method[:10]} that upgrades", wire, refused)
    for version in ("HTTP/1.0", "HTTP/2.0", "HTTP/9", "http/1.1", ""):
        yield Knock(f"version {version!r}", f"GET / {version}\r\nHost: {here}\r\n\r\n".encode(), OUT)
        yield Knock(f"version {version!r} that upgrades", request(port).replace(b"HTTP/1.1", version.encode()), OUT)
    yield Knock(
        "body", f"GET /healthz HTTP/1.1\r\nHost: {here}\r\nContent-Length: 5\r\n\r\nhello".encode(), (200, *OUT)
    )
    yield Knock(
        "chunked", f"GET / HTTP/1.1\r\nHost: {here}\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n".encode(), OUT
    )
    yield Knock("a huge header", request(port, AUTHORIZED, "X-A: " + "a" * 200_000), (*OUT, 0))
    yield Knock("many headers", request(port, AUTHORIZED, *(f"X-{n}: a" for n in range(5000))), (*OUT, 0))
    yield Knock("a folded header", request(port, AUTHORIZED, "X-A: a\r\n b"), (*OUT, 0))
    yield Knock("a header without a colon", request(port, AUTHORIZED, "X-A"), (*OUT, 0))
    yield Knock("null bytes", request(port, AUTHORIZED, "X-A: \0\0"), (*OUT, 0))
    yield Knock("line feeds alone", request(port, AUTHORIZED).replace(b"\r\n", b"\n"), (*IN, *OUT, 0))
    yield Knock("TLS", bytes.fromhex("16030100a5010000a10303") + bytes(160), (*OUT, 0))
    yield Knock("noise", b"\xff\xfe\x00\r\n\r\n", (*OUT, 0))
    yield Knock(
        "a short websocket key", request(port, AUTHORIZED).replace(b"dGhlIHNhbXBsZSBub25jZQ==", b"eA=="), (400,)
    )
    yield Knock("no websocket key", re.sub(rb"Sec-WebSocket-Key.*\r\n", b"", request(port, AUTHORIZED)), (400, 426))
    yield Knock("websocket version 8", request(port, AUTHORIZED).replace(b"Version: 13", b"Version: 8"), (400, 426))
    yield Knock("extensions", request(port, AUTHORIZED, "Sec-WebSocket-Extensions: permessage-deflate; x=1"), IN)
    yield Knock("strange extensions", request(port, AUTHORIZED, "Sec-WebSocket-Extensions: ;;;,,="), (*IN, *OUT))
    body = b'{"observation/state": [0.5]}'
    for name, status, headers in (
        ("no key", 401, ()),
        ("wrong key", 401, ("Authorization: Bearer x",)),
        ("key", 200, (f"Authorization: Bearer {KEY}",)),
        ("evil origin", 403, (AUTHORIZED, "Origin: http://evil.example")),
        ("chunks", 411, (AUTHORIZED, "Transfer-Encoding: chunked")),
        ("a huge header", 431, (AUTHORIZED, "X-A: " + "a" * 200_000)),
        ("an upgrade", 200, (AUTHORIZED, "Connection: Upgrade", "Upgrade: websocket")),
    ):
        yield Knock(f"POST, {name}", post(port, "application/json", body, *headers), (status,))
    long = post(port, "application/json", b"", AUTHORIZED).replace(b"Length: 0", b"Length: 1000000000")
    yield Knock("POST of a gigabyte", long, (413,))
    yield Knock("POST elsewhere", post(port, "application/json", b"{}", AUTHORIZED, path="/v1/x"), (404,))
    yield Knock("half a POST", post(port, "application/json", b"{}", AUTHORIZED)[:-1], ())
    yield Knock("half a request line", b"GET / HT", ())
    yield Knock("half a header", request(port, AUTHORIZED)[:-10], ())
    yield Knock("nothing", b"", ())


async def doors(arena: Arena) -> None:
    """Each knock `arena.count` times; an empty tuple of statuses: the sender leaves without waiting."""
    everything = [knock for _ in range(arena.count) for knock in knocks(arena.port)]
    arena.random.shuffle(everything)
    for number, knock in enumerate(everything):
        status = await status_of(arena.port, knock)
        arena.found.count += 1
        if knock.statuses:
            arena.found.outcomes["silence" if status is None else f"HTTP {status}" if status else "closed"] += 1
            if status not in knock.statuses:
                said = "no answer" if status is None else f"HTTP {status}" if status else "closed without an answer"
                arena.found.violate(f"{knock.name}: {said}, expected {_said(knock.statuses)}", repr(knock.wire[:300]))
        else:
            arena.found.outcomes["left"] += 1
        arena.tick((number + 1) / len(everything))


def _said(statuses: tuple[int, ...]) -> str:
    return "a refusal" if len(statuses) > 4 else " or ".join(map(str, statuses))


async def status_of(port: int, knock: Knock) -> int | None:
    """The status that answers a knock; 0 for a close without one, None for silence."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        with contextlib.suppress(OSError):
            writer.write(knock.wire)
            if not knock.statuses:
                return 0
            line = await asyncio.wait_for(reader.readline(), PATIENCE_S)
            found = re.match(rb"HTTP/1\.1 (\d{3})", line)
            return int(found[1]) if found else 0
        return 0
    except asyncio.TimeoutError:
        return None
    finally:
        writer.transport.abort()
