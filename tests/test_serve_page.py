"""The server's page and its feed: who may see them, what they say, and that robots don't notice."""

import asyncio
import base64
import contextlib
import io
import logging
import re
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from PIL import Image
from serve_fakes import FakePolicy, http_get, observation
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.typing import Subprotocol

import turbopi.serve.page
from turbopi.policy.watch import Reading, Sample
from turbopi.realtime.wire import pack, unpack
from turbopi.serve import PolicyServer, ServerOptions
from turbopi.serve.metrics import Metrics
from turbopi.serve.page import live
from turbopi.serve.page.device import memory_of
from turbopi.serve.page.live import BINS, Live, stage_times
from turbopi.serve.page.messages import Frame, Hello, Preview, clean
from turbopi.serve.page.preview import THUMBNAIL, make_preview, thumbnail
from turbopi.serve.scheduling.schedule import Schedule
from turbopi.serve.worker import Worker

HTML = (Path(turbopi.serve.page.__file__).parent / "page.html").read_text(encoding="utf-8")
FEED = msgspec.json.Decoder(Hello | Frame)


class Robotic(FakePolicy):
    """Tells what a UnifiedPolicy does, as far as the page shows it."""

    def __init__(self) -> None:
        super().__init__()
        self.metadata |= {"robot": "libero", "robot_action_dim": 7, "backend": "fake", "numpy": np.float32(2)}

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        result = super().infer(obs)
        return result | {"actions": np.linspace(-1, 1, 14).reshape(2, 7), "policy_timing": {"infer_ms": 3.0}}


def served(test: Callable[[PolicyServer], Awaitable[None]], policy: FakePolicy | None = None, **options: Any) -> None:
    async def main() -> None:
        async with PolicyServer(policy or Robotic(), port=0, **options) as server:
            await asyncio.wait_for(test(server), 150)

    asyncio.run(main())


def live_url(server: PolicyServer) -> str:
    return f"ws://127.0.0.1:{server.port}/live"


@contextlib.asynccontextmanager
async def robot(server: PolicyServer) -> AsyncIterator[ClientConnection]:
    async with connect(f"ws://127.0.0.1:{server.port}", compression=None, max_size=None) as connection:
        assert isinstance(await connection.recv(), bytes)
        yield connection


async def ask(connection: ClientConnection, prompt: str = "", /, **more: Any) -> dict[str, Any] | str:
    await connection.send(pack({**observation(prompt), **more}))
    reply = await asyncio.wait_for(connection.recv(), 60)
    return reply if isinstance(reply, str) else dict(unpack(reply))


async def message(watcher: ClientConnection) -> Hello | Frame:
    return FEED.decode(await asyncio.wait_for(watcher.recv(), 60))


async def frame(watcher: ClientConnection, wanted: Callable[[Frame], object] = lambda frame: True) -> Frame:
    """The first frame that is as wanted."""
    while True:
        got = await message(watcher)
        if isinstance(got, Frame) and wanted(got):
            return got


async def closed(watcher: ClientConnection) -> int:
    """The code that the server closes with."""
    with contextlib.suppress(ConnectionClosed):
        await frame(watcher, lambda frame: False)
    assert watcher.close_code is not None
    return watcher.close_code


async def seen(watcher: ClientConnection, connection: ClientConnection, prompt: str, **more: Any) -> Preview:
    """The preview of an answered request. Sends it again until there is one: not every call has one."""
    while True:
        assert isinstance(await ask(connection, prompt, **more), dict)
        for shown in (await frame(watcher)).robots:
            if shown.preview is not None and shown.preview.prompt == prompt:
                return shown.preview


# --- the document -----------------------------------------------------------------------------------------------------


def test_the_page_allows_itself_its_own_script_and_style_and_nothing_else() -> None:
    async def test(server: PolicyServer) -> None:
        status, headers, body = await http_get(server.port, "/?a=b")
        assert (status, headers["content-type"]) == (200, "text/html; charset=utf-8")
        policy = dict(part.strip().split(" ", 1) for part in headers["content-security-policy"].split(";"))
        assert policy.pop("default-src") == policy.pop("base-uri") == policy.pop("form-action") == "'none'"
        for tag in ("style", "script"):
            (content,) = re.findall(f"<{tag}>(.*?)</{tag}>", body, re.DOTALL)
            digest = base64.b64encode(sha256(content.encode()).digest()).decode()
            assert policy.pop(f"{tag}-src") == f"'sha256-{digest}'"
        assert policy == {"img-src": "data:", "connect-src": "'self'", "frame-ancestors": "'none'"}
        assert (headers["x-content-type-options"], headers["cache-control"]) == ("nosniff", "no-store")

    served(test)


def test_the_page_names_no_other_place_and_makes_no_markup_of_text() -> None:
    assert set(re.findall(r"https?://[^\"'\s]*", HTML)) == {"http://www.w3.org/2000/svg"}  # a name, not an address
    assert not re.findall(r"<(?:link|iframe|object|embed|base)\b|\bsrc=|@import|url\(", HTML)
    assert not re.findall(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|Function\(", HTML)
    assert not re.findall(r"<[^>]*\s(?:on\w+|style)=", HTML)  # the policy would refuse them


@pytest.mark.parametrize(
    ("host", "key", "requested", "shown"),
    [
        ("127.0.0.1", None, None, True),
        ("localhost", None, None, True),
        ("0.0.0.0", None, None, False),
        ("192.168.1.7", None, None, False),
        ("0.0.0.0", "k", None, True),
        ("0.0.0.0", None, True, True),
        ("127.0.0.1", "k", False, False),
    ],
)
def test_the_page_is_on_where_only_this_machine_or_the_keys_holder_sees_it(
    host: str, key: str | None, requested: bool | None, shown: bool
) -> None:
    assert ServerOptions(host=host, api_key=key, page=requested).has_page is shown


def test_without_a_page_robots_are_served_and_browsers_are_told() -> None:
    async def test(server: PolicyServer) -> None:
        assert (await http_get(server.port, "/"))[0::2] == (404, "The page is off; --page or an API key turns it on.\n")
        with pytest.raises(InvalidStatus) as refusal:
            await connect(live_url(server))
        assert refusal.value.response.status_code == 404
        async with robot(server) as connection:
            assert isinstance(await ask(connection), dict)

    served(test, page=False)


# --- who may watch ----------------------------------------------------------------------------------------------------


def test_a_page_of_another_origin_gets_neither_document_nor_feed() -> None:
    async def test(server: PolicyServer) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n")  # rebound: the name is not the server's
        assert b"403" in await reader.readline()
        writer.close()
        with pytest.raises(InvalidStatus) as refusal:
            await connect(live_url(server), origin="http://evil.example")  # type: ignore[arg-type]
        assert refusal.value.response.status_code == 403
        async with connect(live_url(server), origin=f"http://127.0.0.1:{server.port}") as watcher:  # type: ignore[arg-type]
            assert isinstance(await message(watcher), Hello)

    served(test)


def test_with_a_key_the_feed_needs_it_and_the_empty_page_does_not() -> None:
    key = "k3y-with/every+sign?~"

    async def status(server: PolicyServer, **how: Any) -> int:
        try:
            async with connect(live_url(server), **how) as watcher:
                assert isinstance(await message(watcher), Hello)
                assert watcher.subprotocol == ("turbopi-live" if "subprotocols" in how else None)
                return 101
        except InvalidStatus as refusal:
            return refusal.response.status_code

    def offered(key: str) -> dict[str, Any]:
        code = base64.urlsafe_b64encode(key.encode()).decode().rstrip("=")
        return {"subprotocols": [Subprotocol("turbopi-live"), Subprotocol(f"key.{code}")]}

    async def test(server: PolicyServer) -> None:
        _, _, body = await http_get(server.port, "/")
        assert 'data-key="needed"' in body and key not in body
        assert await status(server) == 401
        assert await status(server, **offered("another")) == 401
        assert await status(server, subprotocols=["turbopi-live", "key.%%%"]) == 401
        assert await status(server, subprotocols=["turbopi-live"]) == 401
        assert await status(server, **offered(key)) == 101
        assert await status(server, additional_headers={"Authorization": f"Api-Key {key}"}) == 101
        wrong = {"additional_headers": {"Authorization": "Api-Key wrong"}}
        assert await status(server, **wrong, **offered(key)) == 401
        with pytest.raises(InvalidStatus):  # the subprotocol is the feed's alone
            await connect(f"ws://127.0.0.1:{server.port}/", **offered(key))

    served(test, api_key=key)


def test_watchers_are_few_and_take_no_robots_place() -> None:
    async def test(server: PolicyServer) -> None:
        async with contextlib.AsyncExitStack() as stack:
            watchers = [await stack.enter_async_context(connect(live_url(server))) for _ in range(4)]
            with pytest.raises(InvalidStatus) as refusal:
                await connect(live_url(server))
            assert refusal.value.response.status_code == 503
            connection = await stack.enter_async_context(robot(server))
            assert isinstance(await ask(connection), dict)
            assert (await frame(watchers[3], lambda frame: frame.requests == 1)).clients == 1
            assert server.metrics.registry.get_sample_value("turbopi_clients") == 1
            await watchers[0].close()
            again = None
            while again is None:  # the server notices in its own time
                with contextlib.suppress(InvalidStatus):
                    again = await stack.enter_async_context(connect(live_url(server)))

    served(test, max_clients=1)


def test_a_watcher_has_nothing_to_say() -> None:
    async def test(server: PolicyServer) -> None:
        async with connect(live_url(server)) as watcher:
            await watcher.send(b"x" * (5 * 2**20))
            assert await closed(watcher) == 1008
        async with robot(server) as connection:
            assert isinstance(await ask(connection), dict)

    served(test)


# --- what the feed says -----------------------------------------------------------------------------------------------


def test_the_feed_tells_the_policy_then_what_robots_did() -> None:
    camera_image = np.zeros((60, 480, 3), np.uint8)
    camera_image[:, :240] = (250, 10, 10)

    async def test(server: PolicyServer) -> None:
        async with connect(live_url(server)) as watcher, robot(server) as connection:
            hello = await message(watcher)
            assert isinstance(hello, Hello)
            assert hello.policy == {**Robotic().metadata, "numpy": 2.0}
            assert [group.title for group in hello.actions] == ["translation", "rotation", "gripper"]
            shown = await seen(watcher, connection, "put <b>it</b> down", **{"observation/image": camera_image})
            assert shown.actions == np.linspace(-1, 1, 14).reshape(2, 7).tolist()
            assert shown.numbers == {"observation/state": observation()["observation/state"].tolist()}
            assert shown.timing["infer"] == 3.0 and (shown.timing["request"] or 0) > 0
            sent = shown.images["observation/image"]
            assert (sent.width, sent.height) == (480, 60)
            small = np.asarray(Image.open(io.BytesIO(sent.jpeg)))
            assert small.shape == (28, THUMBNAIL, 3)
            assert small[14, 20].tolist() == pytest.approx([250, 10, 10], abs=12) and small[14, 200].max() < 12
            stages = {stage.stage for stage in (await frame(watcher)).latency}
            assert stages == {"infer", "request"}

    served(test)


def test_a_preview_is_sent_once_to_each_watcher() -> None:
    async def test(server: PolicyServer) -> None:
        async with connect(live_url(server)) as watcher, robot(server) as connection:
            first = await seen(watcher, connection, "once")
            calls = (await frame(watcher)).robots[0].calls
            later = [await frame(watcher) for _ in range(4)]
            assert all(one.robots[0].preview is None or one.robots[0].preview.number > first.number for one in later)
            assert later[-1].robots[0].preview is None and later[-1].robots[0].calls == calls
            async with connect(live_url(server)) as other:  # who comes later is told what is known
                got = (await frame(other)).robots[0].preview
                assert got is not None and got.prompt == "once" and got.images.keys() == {"observation/image"}

    served(test)


def test_the_feed_tells_what_went_wrong() -> None:
    async def test(server: PolicyServer) -> None:
        async with connect(live_url(server)) as watcher, robot(server) as connection:
            assert isinstance(await ask(connection, "\u202enan actions"), dict)  # that prompt is another one
            assert str(await ask(connection, "nan actions")).startswith("bad actions")
            assert "Traceback" in str(await ask(connection, "crash"))
            got = await frame(watcher, lambda frame: len(frame.troubles) == 2)
            assert got.errors == {"actions": 1, "policy": 1}
            refused = "bad actions: the actions hold nan at [0, 3]"
            failed = "RuntimeError: CUDA error: invalid argument"
            assert [one.text.partition(": ")[2] for one in got.troubles] == [refused, failed]
            left = await frame(watcher, lambda frame: not frame.clients)
            assert got.lost is None and [one.refusal.text for one in left.robots if one.refusal] == [failed]
        async with connect(live_url(server)) as watcher, robot(server) as connection:
            await ask(connection, "lost")
            assert "illegal memory access" in str((await frame(watcher, lambda frame: frame.lost)).lost)

    served(test)


def test_the_feed_has_the_notes_of_each_robots_last_answer_and_the_log_of_them() -> None:
    class Noting(Robotic):
        gives_readings = True

        def infer(self, obs: dict[str, Any], readings: bool = False) -> dict[str, Any]:
            assert readings
            black = obs["prompt"] == "black"
            return super().infer(obs) | {
                "reading": Reading([0.0], images={"front": Sample((2, 2), bytes(12))} if black else {})
            }

    async def test(server: PolicyServer) -> None:
        async with connect(live_url(server)) as watcher, robot(server) as connection, robot(server) as other:
            await ask(connection, "black")
            await ask(other, "bright")
            one, two = (await frame(watcher, lambda frame: [one.calls for one in frame.robots] == [1, 1])).robots
            assert [(note.kind, note.names) for note in one.notes] == [("camera_black", ["front"])]
            assert one.notes[0].text == "camera front is black" and two.notes == []
            got = await frame(watcher)
            assert [(trouble.error, trouble.text.partition(": ")[2]) for trouble in got.troubles] == [
                ("camera_black", "camera front is black")
            ]
            await ask(connection, "bright")
            assert (await frame(watcher, lambda frame: [one.calls for one in frame.robots] == [2, 1])).robots[
                0
            ].notes == []

    served(test, Noting())


def test_a_robot_has_its_name_and_its_place_and_is_gone_since() -> None:
    named = {"turbopi/robot": "left <arm>"}

    async def test(server: PolicyServer) -> None:
        async with connect(live_url(server)) as watcher, robot(server) as other:
            await ask(other)
            async with robot(server) as connection:
                await ask(connection, **named)
                await ask(connection)  # once is enough
                one, two = (await frame(watcher, lambda frame: [one.calls for one in frame.robots] == [1, 2])).robots
                assert (one.name, two.name, two.lost) == ("", "left <arm>", None)
                assert one.address.startswith("127.0.0.1:") and two.address != one.address
            left = (await frame(watcher, lambda frame: frame.clients == 1)).robots[1]
            assert (left.id, left.name, left.calls) == (two.id, two.name, 2)
            assert left.lost is not None and left.lost >= two.connected and "it closed with 1000" in left.how
            async with robot(server) as connection, robot(server) as silent:
                await ask(connection, **named)
                back = (await frame(watcher, lambda frame: frame.robots[1].calls == 3)).robots[1]
                assert (back.id, back.lost) == (two.id, None)
                assert "turbopi/robot is 3; it should be the robot's name" in str(
                    await ask(silent, **{"turbopi/robot": 3})
                )
            kept = (await frame(watcher, lambda frame: frame.clients == 1)).robots
            assert [one.lost is None for one in kept] == [True, False, False]
            assert kept[2].refusal is not None and kept[2].refusal.kind == "observation"

    served(test)


def test_a_session_names_its_robot_and_robots_that_never_asked_leave_nothing() -> None:
    policy = Robotic()
    policy.metadata["real_time"] = {"modes": ["rtc"]}

    async def test(server: PolicyServer) -> None:
        async with connect(live_url(server)) as watcher:
            async with robot(server), robot(server) as connection:
                await ask(connection, **{"turbopi/session": "bench 3", "turbopi/mode": "none"})
                got = await frame(watcher, lambda frame: frame.requests == 1 and frame.robots[1].calls == 1)
                assert [one.name for one in got.robots] == ["", "bench 3"]
            assert [one.name for one in (await frame(watcher, lambda frame: frame.clients == 0)).robots] == ["bench 3"]

    served(test, policy)


def test_few_gone_robots_are_shown_and_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(server: PolicyServer) -> None:
        async with connect(live_url(server)) as watcher:
            for number in range(live.MAX_LOST + 2):
                async with robot(server) as connection:
                    await ask(connection, **{"turbopi/robot": f"r{number}"})
            got = await frame(watcher, lambda frame: frame.requests == live.MAX_LOST + 2 and not frame.clients)
            assert [one.name for one in got.robots] == [f"r{number}" for number in range(2, live.MAX_LOST + 2)]
            monkeypatch.setattr(live, "LOST_SECONDS", 0.0)
            assert (await frame(watcher, lambda frame: not frame.robots)).clients == 0

    served(test)


def test_each_robot_has_its_latency_against_its_deadline_and_its_batch() -> None:
    async def test(server: PolicyServer) -> None:
        async with connect(live_url(server)) as watcher, robot(server) as connection, robot(server) as other:
            await ask(connection, **{"turbopi/deadline_ms": 60_000})
            late = await ask(connection, **{"turbopi/deadline_ms": 1e-3})
            assert str(late).startswith("late")
            three = {key: np.stack([value] * 3) for key, value in observation().items() if key != "prompt"}
            assert isinstance(await ask(other, **three, **{"turbopi/batch": 3}), dict)
            one, two = (got := await frame(watcher, lambda frame: frame.requests == 3)).robots
            assert (one.deadline, one.timed, one.missed, one.rows, one.batch) == (60_000, 2, 1, None, 1)
            assert one.refusal is not None and one.refusal.kind == "late" and len(one.times) == 1 and one.times[0] > 0
            assert (two.deadline, two.timed, two.rows) == (None, 0, 3)
            assert (got.timed, got.missed, sum(got.batches.values())) == (2, 1, 2)
            await ask(connection)
            assert (await frame(watcher, lambda frame: frame.requests == 4)).robots[0].refusal is None

    served(test)


def test_a_clients_text_is_cut_and_keeps_its_direction() -> None:
    assert clean("<b>\u202eevil\x1b[0m</b>\nnext") == "<b>\\u202eevil\\x1b[0m</b>\nnext"
    assert len(clean("x" * 1000)) == 300 and clean("x" * 1000).endswith("…")


# --- what robots notice: nothing --------------------------------------------------------------------------------------


def test_no_preview_is_made_while_no_page_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    previewed: list[int] = []
    monkeypatch.setattr(live, "make_preview", lambda number, *_: previewed.append(number))

    async def test(server: PolicyServer) -> None:
        async with robot(server) as connection:
            for _ in range(5):
                assert isinstance(await ask(connection), dict)
            assert previewed == []
            async with connect(live_url(server)) as watcher:
                reported = await frame(watcher, lambda frame: frame.robots[0].calls == 5)
                assert reported.latency[0].calls == 5  # what costs nothing is known
                while not previewed:
                    await ask(connection)

    served(test)


def test_a_look_that_takes_long_holds_nobody_up_and_drops_others(monkeypatch: pytest.MonkeyPatch) -> None:
    begun, go_on, numbers = threading.Event(), threading.Event(), list[int]()

    def slow(number: int, *rest: Any) -> Preview:
        numbers.append(number)
        begun.set()
        assert go_on.wait(120)
        return make_preview(number, *rest)

    monkeypatch.setattr(live, "make_preview", slow)
    monkeypatch.setattr(live, "FRAMES_A_SECOND", 1e6)

    async def test(server: PolicyServer) -> None:
        try:
            async with connect(live_url(server)), robot(server) as connection:
                while not begun.is_set():
                    assert isinstance(await ask(connection), dict)
                for _ in range(30):
                    assert isinstance(await ask(connection), dict)
                assert len(numbers) == 1
        finally:
            go_on.set()

    served(test)


def test_a_fault_of_the_page_costs_no_robot_its_answer(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: Any) -> Preview:
        raise ZeroDivisionError

    monkeypatch.setattr(live, "make_preview", broken)

    async def test(server: PolicyServer) -> None:
        async with connect(live_url(server)) as watcher, robot(server) as connection:
            while "can't show a call" not in caplog.text:
                assert isinstance(await ask(connection), dict)
            assert (await frame(watcher, lambda frame: frame.robots)).robots[0].preview is None

    with caplog.at_level(logging.ERROR):
        served(test)


def test_a_watcher_that_never_reads_is_sent_little(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "FRAMES_A_SECOND", 1e6)
    sent = 0
    frame_of = live._frame_of

    def counted(*arguments: Any) -> str:
        nonlocal sent
        text = frame_of(*arguments) + " " * 2**18
        sent += len(text)
        return text

    monkeypatch.setattr(live, "_frame_of", counted)

    async def test(server: PolicyServer) -> None:
        async with connect(live_url(server), max_queue=1) as watcher, robot(server) as connection:
            while not sent:
                await asyncio.sleep(0.01)
            before = 0
            while sent > before:  # until the sockets are full
                before = sent
                for _ in range(20):
                    assert isinstance(await ask(connection), dict)
                await asyncio.sleep(0.2)
            assert sent < 64 * 2**20
            watcher.transport.abort()

    served(test)


def test_watchers_are_told_when_the_server_stops() -> None:
    async def main() -> None:
        server = PolicyServer(Robotic(), port=0)
        await server.start()
        watcher = await connect(live_url(server))
        await frame(watcher)
        stopping = asyncio.create_task(server.stop())
        assert await closed(watcher) == 1001
        await stopping

    asyncio.run(asyncio.wait_for(main(), 150))


# --- the parts --------------------------------------------------------------------------------------------------------


def test_stages_are_counted_in_shared_bins_and_the_slowest_call_is_in_the_last() -> None:
    timings = [{"infer": 10.0, "request": 12.0}] * 199 + [{"infer": 10.0, "request": 5000.0}, {"infer": float("nan")}]
    width, (infer, request) = stage_times(timings)
    assert width == pytest.approx(1.2 * 12 / BINS)
    assert (infer.stage, infer.calls, infer.p50, infer.p95, infer.max) == ("infer", 200, 10, 10, 10)
    assert infer.bins[int(10 / width)] == 200 == sum(infer.bins)
    assert (request.bins[int(12 / width)], request.bins[-1], request.max) == (199, 1, 5000)
    assert stage_times([])[1] == []


@pytest.mark.parametrize(
    "camera_image",
    [
        np.full((8, 8, 3), 0.5),
        np.full((8, 8, 3), np.nan, np.float32),
        np.full((1, 9000, 3), 7, np.uint8),
        np.zeros((3, 2, 3), np.uint8)[::-1, ::-1],
    ],
    ids=["float64", "nan", "a line", "backwards"],
)
def test_any_picture_becomes_a_small_jpeg(camera_image: np.ndarray) -> None:
    made = thumbnail(camera_image)
    assert (made.height, made.width) == camera_image.shape[:2]
    with Image.open(io.BytesIO(made.jpeg)) as small:
        assert max(small.size) <= THUMBNAIL


def test_a_preview_never_fails_for_what_a_robot_sends() -> None:
    strange = {
        "prompt": 3,
        "empty": np.zeros((0, 4, 3), np.uint8),
        "long": np.zeros(1000),
        "text": np.array(["a", "b"]),
        "letters": np.full((2, 2, 3), "a"),
        "flags": np.zeros((2, 2, 3), np.bool_),
        "nested": {"deep": np.zeros((3, 4, 5), np.uint8)},
        **{f"n{i}": np.array([1.5]) for i in range(20)},
    }
    for actions in (None, np.zeros(3), np.zeros((2, 2), np.int64), np.zeros((1000, 100)), np.full((1, 2), np.nan)):
        made = make_preview(1, 0.0, pack(strange), {"actions": actions}, [np.nan], {})
        assert list(made.images) == ["nested/deep"] and made.prompt == "" and len(made.numbers) == 4
        assert len(made.actions) == (1 if isinstance(actions, np.ndarray) and actions.shape == (1, 2) else 0)
        msgspec.json.encode(made)


def test_a_large_observation_is_not_stored_for_its_preview(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "MESSAGE_BYTES", 10)

    async def test(server: PolicyServer) -> None:
        async with connect(live_url(server)) as watcher, robot(server) as connection:
            made = await seen(watcher, connection, "")
            assert made.images == {} and len(made.actions) == 2 and "too large to be shown" in made.note

    served(test)


def test_memory_is_the_processs_or_what_pytorch_holds_of_the_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    assert 0 < memory_of("cpu")().used < memory_of("cpu")().total
    properties = type("Properties", (), {"total_memory": 80})
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: properties)
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: {"cuda:1": 7}[device])
    reported = memory_of("cuda:1")()
    assert (reported.used, reported.total) == (7, 80) and "GPU" in reported.what


def test_metadata_that_is_no_json_is_told_as_far_as_it_goes() -> None:
    reported = Live(Metrics(), Worker(Schedule(1)), lambda: None)
    reported.start({"a": np.arange(2), "b": Path("/x"), ("no", "key"): 1, "robot": 3}, queue_limit=16)  # type: ignore[dict-item]
    hello = FEED.decode(reported._hello)
    assert isinstance(hello, Hello) and hello.policy == {"a": [0, 1], "b": "/x", "robot": 3} and hello.actions == []
