"""Who gets in: hosts and origins, API keys, and nobody once the device is lost."""

import asyncio
import logging
import os
import re
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from attack import doors
from cli_helpers import refusal, text_of, turbopi
from serve_fakes import FakePolicy, http_get, observation
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from turbopi.realtime.wire import pack
from turbopi.serve import PolicyServer
from turbopi.serve.hosts import AllowedHosts
from turbopi.serve.limited_log import LimitedLog
from turbopi.serve.limits import Limits
from turbopi.support.errors import ConfigError

REASON = "CUDA error: an illegal memory access was encountered"


def served(test: Callable[[PolicyServer], Awaitable[None]], **options: Any) -> None:
    async def main() -> None:
        async with PolicyServer(FakePolicy(), port=0, **options) as server:
            await test(server)

    asyncio.run(asyncio.wait_for(main(), 60))


async def upgrade(server: PolicyServer, host: str, *headers: str) -> int:
    """The status of a websocket handshake that says Host: `host`."""
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="
    usual = ("Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Version: 13", key)
    writer.write("\r\n".join(["GET / HTTP/1.1", f"Host: {host}", *usual, *headers, "", ""]).encode())
    line = await asyncio.wait_for(reader.readline(), 120)
    writer.close()
    return int(line.split()[1])


# --- hosts and origins ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example:8000",
        "http://127.0.0.1.evil.example:8000",
        "http://localhost.evil.example:1",
        "http://[::1",
        "http://]",
        "null",
        "",
        "chrome-extension://127.0.0.1",
        "//127.0.0.1",
    ],
)
@pytest.mark.parametrize("rebound", [True, False], ids=["its own host", "this host"])
def test_a_page_from_elsewhere_is_forbidden_whatever_host_it_says(origin: str, rebound: bool) -> None:
    async def test(server: PolicyServer) -> None:
        host = origin.partition("//")[2] if rebound and "//" in origin else f"127.0.0.1:{server.port}"
        if origin == "//127.0.0.1":
            host = "127.0.0.1"
        assert await upgrade(server, host, f"Origin: {origin}") == 403
        assert await upgrade(server, f"127.0.0.1:{server.port}") == 101  # and the server goes on

    served(test)


def test_a_rebound_name_is_forbidden_although_origin_and_host_are_equal() -> None:
    async def test(server: PolicyServer) -> None:
        host = f"evil.example:{server.port}"
        assert await upgrade(server, host, f"Origin: http://{host}") == 403
        for good in (f"localhost:{server.port}", f"127.0.0.1:{server.port}", f"[::1]:{server.port}", "127.0.0.2"):
            assert await upgrade(server, good, f"Origin: http://{good}") == 101

    served(test)


def test_several_origins_or_hosts_are_forbidden() -> None:
    async def test(server: PolicyServer) -> None:
        here = f"localhost:{server.port}"
        assert await upgrade(server, here, f"Origin: http://{here}", "Origin: http://evil.example") == 403
        assert await upgrade(server, here, "Host: evil.example", f"Origin: http://{here}") == 400
        assert await upgrade(server, here, "Host: evil.example") == 400

    served(test)


def test_robots_send_no_origin_and_may_use_any_name() -> None:
    async def test(server: PolicyServer) -> None:
        for host in ("gpu-box.lab:8000", "policy", "10.1.2.3:80"):
            assert await upgrade(server, host) == 101

    served(test)


CLIENTS_OWN = "gpu-box.lab:8000"
BROWSERS = {  # what they add to a websocket's handshake, and a page can't leave out
    "Chrome": (
        *("Pragma: no-cache", "Cache-Control: no-cache", "User-Agent: Mozilla/5.0 (X11; Linux x86_64) Chrome/141.0"),
        *("Accept-Encoding: gzip, deflate, br, zstd", "Accept-Language: en-US,en;q=0.9"),
        "Sec-WebSocket-Extensions: permessage-deflate; client_max_window_bits",
    ),
    "Firefox": (
        *("User-Agent: Mozilla/5.0 (X11; Linux x86_64; rv:144.0) Gecko/20100101 Firefox/144.0", "Accept: */*"),
        *("Accept-Language: en-US,en;q=0.5", "Accept-Encoding: gzip, deflate, br, zstd"),
        *("Sec-WebSocket-Extensions: permessage-deflate", "Pragma: no-cache", "Cache-Control: no-cache"),
        *("Sec-Fetch-Dest: empty", "Sec-Fetch-Mode: websocket", "Sec-Fetch-Site: same-origin"),
    ),
}


def test_a_client_that_is_no_browser_may_name_itself_as_its_origin() -> None:
    """PyPI's websocket-client sends these headers alone; the names are of a LAN's DNS and of a Compose service."""

    async def test(server: PolicyServer) -> None:
        for name in ("policy-server:8000", CLIENTS_OWN, "policy.example"):
            for scheme in ("http", "https"):
                assert await upgrade(server, name, f"Origin: {scheme}://{name}") == 101
        assert await upgrade(server, CLIENTS_OWN, f"Origin: http://{CLIENTS_OWN}", "Authorization: Api-Key k") == 101
        for origin in ("http://other.lab:8000", "http://gpu-box.lab", "null", "file://gpu-box.lab:8000"):
            assert await upgrade(server, CLIENTS_OWN, f"Origin: {origin}") == 403

    served(test, host="0.0.0.0")


@pytest.mark.parametrize("browser", BROWSERS)
def test_a_rebound_name_in_a_browser_is_forbidden_by_each_header_that_only_browsers_send(browser: str) -> None:
    async def test(server: PolicyServer) -> None:
        here, origin = f"127.0.0.1:{server.port}", f"Origin: http://{CLIENTS_OWN}"
        for headers in (BROWSERS[browser], *((header,) for header in BROWSERS[browser])):
            assert await upgrade(server, CLIENTS_OWN, origin, *headers) == 403, headers
            assert await upgrade(server, here, f"Origin: http://{here}", *headers) == 101  # the server's own page
        assert await upgrade(server, CLIENTS_OWN, origin, "Cookie: a=b") == 403

    served(test, host="0.0.0.0")


def test_who_is_forbidden_reads_what_to_set() -> None:
    async def test(server: PolicyServer) -> None:
        upgrading = ("Upgrade: websocket", "Origin: http://evil.example")
        status, _, body = await http_get(server.port, "/robot", *upgrading)
        assert status == 403
        for words in ("'http://evil.example'", "--allowed-hosts NAME", "allowed_hosts=", "leave Origin out"):
            assert words in body

    served(test)


# --- methods ----------------------------------------------------------------------------------------------------------

UPGRADE = (
    *("Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Version: 13"),
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
)


async def said(server: PolicyServer, line: str, *headers: str) -> tuple[int, bytes]:
    """Status and answer of a request that begins with `line`. What the library can't read is a 400: so is what isn't
    GET of HTTP/1.1, with websockets before 17.
    """
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    writer.write("\r\n".join([line, f"Host: 127.0.0.1:{server.port}", *headers, "", ""]).encode())
    answer = await asyncio.wait_for(reader.read(), 120)
    writer.close()
    return int(answer.split()[1]), answer


@pytest.mark.parametrize("path", ["/", "/metrics", "/healthz", "/live"])
def test_nothing_but_get_is_answered(path: str) -> None:
    async def test(server: PolicyServer) -> None:
        for method in (
            "POST",
            "PUT",
            "DELETE",
            "CONNECT",
            "TRACE",
            "OPTIONS",
            "HEAD",
            "PATCH",
            "get",
            "Get",
            "X" * 200,
        ):
            for headers in ((), UPGRADE):
                status, answer = await said(server, f"{method} {path} HTTP/1.1", *headers)
                if method == "POST":
                    assert status == 404 and b"POST goes to /v1/actions alone" in answer, headers
                    continue
                assert status in (405, 400), (method, headers)
                assert status == 400 or b"\r\nAllow: GET\r\n" in answer
                assert status == 400 or method != "HEAD" or not answer.partition(b"\r\n\r\n")[2]
        assert (await said(server, "GET /healthz HTTP/1.1"))[0] == 200
        status, answer = await said(server, "GET /v1/actions HTTP/1.1")
        assert status == 405 and b"\r\nAllow: POST\r\n" in answer and b"POST an observation to /v1/actions" in answer

    served(test)


@pytest.mark.parametrize(
    "line", ["PUT /v1/actions HTTP/1.1", "GET /healthz HTTP/1.1", "post /v1/actions HTTP/1.1", "hello"]
)
def test_what_is_no_request_for_this_server_gets_a_400(line: str) -> None:
    """The websockets library ends the connection without a word where a body comes, or a line that it can't read."""

    async def test(server: PolicyServer) -> None:
        status, answer = await said(server, line, "Content-Length: 3", "", "abc")
        assert status == 400 and answer.endswith(b"and POST /v1/actions\n") and answer.count(b"HTTP/1.1 400") == 1
        assert server.metrics.errors_so_far() == {"malformed": 1}

    served(test)


@pytest.mark.parametrize("line", ["PUT /v1/actions HTTP/1.1", "hello"])
def test_a_client_that_sends_on_reads_its_400_and_its_connection_ends_when_it_leaves(line: str) -> None:
    """A socket that is closed before all of it is read is reset, and the client may lose what it was sent."""

    async def test(server: PolicyServer) -> None:
        def send_all_and_read() -> bytes:
            with socket.create_connection(("127.0.0.1", server.port)) as client:
                client.sendall(f"{line}\r\nHost: a\r\nContent-Length: {8 << 20}\r\n\r\n".encode() + bytes(8 << 20))
                return b"".join(iter(lambda: client.recv(65536), b""))

        answer = await asyncio.to_thread(send_all_and_read)
        assert answer.startswith(b"HTTP/1.1 400 ") and answer.endswith(b"and POST /v1/actions\n")
        while server._listener._connected:
            await asyncio.sleep(0.01)

    served(test, limits=Limits(close_seconds=1000.0))


def test_what_follows_a_refused_request_is_thrown_away() -> None:
    async def test(server: PolicyServer) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(b"GET /healthz HTTP/1.1\r\nHost: a\r\n\r\n" + bytes(1 << 20))
        assert (await asyncio.wait_for(reader.read(), 120)).endswith(b"OK\n")
        writer.close()
        while server._listener._connected:
            await asyncio.sleep(0.01)

    served(test, limits=Limits(close_seconds=1000.0))


@pytest.mark.parametrize("version", ["HTTP/1.0", "HTTP/2.0", "HTTP/9", "http/1.1", ""])
def test_another_version_of_http_is_refused(version: str) -> None:
    async def test(server: PolicyServer) -> None:
        for path in ("/", "/metrics", "/healthz"):
            for headers in ((), UPGRADE):
                assert (await said(server, f"GET {path} {version}", *headers))[0] in (505, 400)

    served(test)


@pytest.mark.slow
def test_whatever_knocks_is_answered_as_the_attack_on_the_doors_expects() -> None:
    """With each version of the websockets library: some of it is that library's doing."""

    async def test(server: PolicyServer) -> None:
        knocks = [knock for knock in doors.knocks(server.port) if knock.name != "TLS"]  # waits for the handshake's end
        statuses = await asyncio.gather(*(doors.status_of(server.port, knock) for knock in knocks))
        wrong = {
            knock.name: status
            for knock, status in zip(knocks, statuses, strict=True)
            if knock.statuses and status not in knock.statuses
        }
        assert not wrong

    served(test, api_key=doors.KEY)


def test_metrics_are_for_known_hosts_and_health_is_for_all() -> None:
    async def status(server: PolicyServer, path: str, *headers: str) -> int:
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write("\r\n".join([f"GET {path} HTTP/1.1", *headers, "", ""]).encode())
        line = await asyncio.wait_for(reader.readline(), 120)
        writer.close()
        return int(line.split()[1])

    async def without_key(server: PolicyServer) -> None:
        assert await status(server, "/metrics", "Host: evil.example:8000") == 403
        assert await status(server, "/metrics", "Host: 127.0.0.1") == 200
        assert await status(server, "/healthz", "Host: evil.example:8000") == 200

    async def with_key(server: PolicyServer) -> None:  # which no page has
        assert await status(server, "/metrics", "Host: policy.lab", "Authorization: Api-Key k") == 200

    served(without_key)
    served(with_key, api_key="k")


@pytest.mark.parametrize(
    ("listens", "more", "host", "allowed"),
    [
        ("127.0.0.1", [], "localhost:8000", True),
        ("127.0.0.1", [], "LOCALHOST.", True),
        ("127.0.0.1", [], "[::1]:8000", True),
        ("127.0.0.1", [], "192.168.1.7:8000", True),
        ("127.0.0.1", [], "this-machine", False),
        ("0.0.0.0", [], "this-machine:8000", True),
        ("0.0.0.0", [], "this-machine.local", True),
        ("0.0.0.0", [], "this-machine.evil.example", False),
        ("::", [], "THIS-MACHINE", True),
        ("robot.lab", [], "robot.lab:8000", True),
        ("127.0.0.1", ["robot.lab"], "robot.lab:8000", True),
        ("127.0.0.1", ["robot.lab"], "xrobot.lab", False),
        ("127.0.0.1", ["*"], "anything.example", True),
        ("127.0.0.1", [], "", False),
        ("127.0.0.1", [], "[::1", False),
        ("127.0.0.1", [], "localhost@evil.example", False),
        ("127.0.0.1", [], "evil.example@localhost", False),
        ("127.0.0.1", [], "localhost/..", False),
        ("127.0.0.1", [], "1.evil.example", False),
        ("127.0.0.1", [], "0x7f.1.example", False),
    ],
)
def test_the_servers_names_are_known(
    listens: str, more: list[str], host: str, allowed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: "this-machine")
    assert AllowedHosts(listens, more).has(host) is allowed


def test_a_named_page_may_use_the_server_from_another_host() -> None:
    hosts = AllowedHosts("127.0.0.1", ["dashboard.lab"])
    assert hosts.has_page("https://dashboard.lab:3000", "127.0.0.1:8000")
    assert not hosts.has_page("https://dashboard.lab:3000", "evil.example")
    assert not hosts.has_page("http://localhost:3000", "localhost:8000")  # another program's page


@pytest.mark.parametrize("name", ["", "http://robot.lab", "robot.lab:8000", "a b", "[::1]", "a/b"])
def test_what_is_no_name_is_refused_as_an_allowed_host(name: str) -> None:
    with pytest.raises(ConfigError, match="is no name") as error:
        AllowedHosts("127.0.0.1", [name])
    assert repr(name) in str(error.value)


# --- API keys ---------------------------------------------------------------------------------------------------------


def test_refused_keys_are_logged_with_the_peer_and_without_the_key(caplog: pytest.LogCaptureFixture) -> None:
    async def test(server: PolicyServer) -> None:
        with caplog.at_level(logging.WARNING, "turbopi.serve.gate"):
            for _ in range(40):
                assert await upgrade(server, "localhost", "Authorization: Api-Key hunter2") == 401
            assert (await http_get(server.port, "/metrics"))[0] == 401

    served(test, api_key="secret")
    lines = [record.getMessage() for record in caplog.records if record.name == "turbopi.serve.gate"]
    assert re.fullmatch(r"127\.0\.0\.1:\d+ refused: it sent a wrong API key", lines[0])
    assert len(lines) <= 20, "the log of refused keys has no limit"
    assert not any("hunter2" in line or "secret" in line for line in lines)
    assert re.fullmatch(r"\d+ lines were left out", lines[-1]), "the server's end says what the limit left out"


def test_a_limited_log_says_how_much_it_left_out(caplog: pytest.LogCaptureFixture) -> None:
    now = [0.0]
    log = LimitedLog(logging.getLogger("limited"), lines=2, seconds=10, clock=lambda: now[0])
    for number in range(5):
        log.warning(f"line {number}")
    now[0] = 10.0
    log.warning("later\x1b[31m")
    log.warning("last")
    assert caplog.messages == ["line 0", "line 1", "later\\x1b[31m (3 lines like this were left out)", "last"]


def test_help_shows_no_key_on_a_command_line() -> None:
    help = text_of(turbopi("serve", "--help-all").stdout)
    assert "--api-key-file" in help
    assert "TURBOPI_API_KEY" in help
    assert "--api-key " not in help


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "No such file"),
        (b"", "is empty; it should hold the API key"),
        (b"\n", "is empty"),
        ("schlüssel".encode(), "should be one line of printable ASCII"),
        (b"two lines\nof it", "the API key must be printable ASCII without spaces"),
    ],
)
def test_a_file_without_a_key_is_refused(content: bytes | None, message: str, tmp_path: Path) -> None:
    file = tmp_path / "key"
    if content is not None:
        file.write_bytes(content)
    assert message in refusal(turbopi("serve", "--random-weights", "pi05_tiny", "--api-key-file", file))


def test_a_key_is_read_from_a_file_and_given_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    served_with: dict[str, Any] = {}
    monkeypatch.setattr("turbopi.serve.run", lambda policy, options, **_: served_with.update(asdict(options)))
    (tmp_path / "key").write_text("s3cret\n")
    tiny = ("serve", "--random-weights", "pi05_tiny", "--port", 0, "--api-key-file", tmp_path / "key")
    assert turbopi(*tiny, "--allowed-hosts", "robot.lab, x").exit_code == 0
    assert (served_with["api_key"], served_with["allowed_hosts"]) == ("s3cret", ["robot.lab", "x"])
    assert "hides it" in turbopi(*tiny[:-2], "--api-key", "seen").stdout
    assert "--api-key-file was given, and a key besides it" in refusal(turbopi(*tiny, "--api-key", "other"))


# --- a lost device ----------------------------------------------------------------------------------------------------


def test_health_and_new_clients_get_503_with_the_reason_once_the_device_is_lost() -> None:
    async def test(server: PolicyServer) -> None:
        async with connect(server.url) as client:
            await client.recv()
            assert (await http_get(server.port, "/healthz"))[0] == 200
            await client.send(pack(observation("lost")))
            assert REASON in str(await client.recv())
        status, _, body = await http_get(server.port, "/healthz")
        assert (status, body) == (503, f"the device is lost: {REASON}\n")
        with pytest.raises(InvalidStatus) as refused:
            await connect(server.url)
        assert refused.value.response.status_code == 503
        assert REASON in (refused.value.response.body or b"").decode()
        assert (await http_get(server.port, "/metrics"))[0] == 200

    served(test)


PROGRAM = """
import sys
from serve_fakes import FakePolicy
from turbopi.cli.options import PolicyOptions
PolicyOptions.make_policy = lambda *_, **options: FakePolicy()
import turbopi.serve.server
turbopi.serve.server.LOST_NOTICE = 600  # a busy machine may take its time to ask
from turbopi.__main__ import main
sys.argv = ["turbopi", "serve", "--random-weights", "pi05_tiny", "--port", "0", "--no-warmup"]
main()
"""


@pytest.mark.slow
def test_a_server_whose_device_is_lost_says_503_and_then_exits_with_4() -> None:
    async def lose(url: str) -> None:
        async with connect(url) as client:
            await client.recv()
            await client.send(pack(observation("lost")))
            assert REASON in str(await client.recv())

    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        try:
            assert process.stdout is not None
            while "Serving at" not in (line := process.stdout.readline()):
                assert line, process.communicate()[1]
            url = next(word for word in line.split() if word.startswith("ws://"))
            asyncio.run(lose(url))
            with pytest.raises(urllib.error.HTTPError) as unhealthy:
                urllib.request.urlopen(url.replace("ws://", "http://") + "/healthz", timeout=120)
            assert unhealthy.value.code == 503
            unhealthy.value.close()
            process.terminate()  # which ends the notice
            _, errors = process.communicate(timeout=200)
        finally:
            process.kill()
    assert process.returncode == 4
    assert errors.splitlines()[-1] == f"error: {REASON}"
    assert "Traceback" not in errors
    stamp = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}[+-]\d\d:\d\d"
    logged = [line for line in errors.splitlines() if "the device is lost" in line]
    assert re.match(rf"{stamp} error: the device is lost", logged[0]), errors
    assert abs(time.time() - datetime.fromisoformat(logged[0].partition(" ")[0]).timestamp()) < 3600
