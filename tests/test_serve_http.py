"""POST /v1/actions: the websocket's answers and refusals over HTTP, and broken requests that cost nobody else."""

import asyncio
import base64
import contextlib
import errno
import io
import json
import random
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image
from serve_fakes import OBSERVATION, FakePolicy, http_get
from websockets.asyncio.client import connect

from turbopi.realtime.messages import KEYS
from turbopi.realtime.shared_memory import HEADER, WANTED
from turbopi.realtime.wire import MAX_VALUES, WireError, pack, unpack
from turbopi.recordings import iter_recording
from turbopi.serve import PolicyServer
from turbopi.serve.http_api import KINDS
from turbopi.serve.json_messages import from_json, to_json
from turbopi.serve.limits import Limits
from turbopi.serve.openapi import OPTIONS, schema
from turbopi.support.errors import ObservationError

PACKED = {"Content-Type": "application/msgpack"}


def served(test: Callable[[PolicyServer, Any], Awaitable[None]], policy: Any = None, **options: Any) -> None:
    policy = FakePolicy() if policy is None else policy

    async def main() -> None:
        async with PolicyServer(policy, port=0, **options) as server:
            await test(server, policy)
            assert (await post(server, JSON_OBSERVATION, headers={"Authorization": "Bearer right"}))[
                0
            ] == 200  # whatever came before

    asyncio.run(asyncio.wait_for(main(), 60))


def data_url(image: np.ndarray, kind: str = "png") -> str:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, kind)
    return f"data:image/{kind};base64,{base64.b64encode(stream.getvalue()).decode()}"


JSON_OBSERVATION = {
    "observation/image": data_url(OBSERVATION["observation/image"]),  # type: ignore[arg-type]
    "observation/state": OBSERVATION["observation/state"].tolist(),  # type: ignore[attr-defined]
    "prompt": OBSERVATION["prompt"],
}


def wire_of(body: Any, headers: dict[str, str] | None = None, target: str = "/v1/actions") -> bytes:
    """A POST. `body`: an object to send as JSON, or bytes."""
    body = body if isinstance(body, bytes) else json.dumps(body).encode()
    fields = {"Host": "127.0.0.1", "Content-Type": "application/json", "Content-Length": str(len(body))}
    lines = [f"{name}: {value}" for name, value in {**fields, **(headers or {})}.items() if value]
    return "\r\n".join([f"POST {target} HTTP/1.1", *lines, "", ""]).encode("latin-1") + body


async def response_of(reader: asyncio.StreamReader) -> tuple[int, dict[str, str], bytes]:
    head = (await reader.readuntil(b"\r\n\r\n")).decode()
    status, *fields = head.rstrip().split("\r\n")
    headers = {name.lower(): value.strip() for name, _, value in (field.partition(":") for field in fields)}
    return int(status.split()[1]), headers, await reader.readexactly(int(headers.get("content-length", 0)))


async def exchange(server: PolicyServer, wire: bytes) -> tuple[int, dict[str, str], bytes]:
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    writer.write(wire)
    try:
        return await response_of(reader)
    finally:
        writer.close()


async def post(server: PolicyServer, body: Any, **options: Any) -> tuple[int, dict[str, Any]]:
    status, _, answer = await exchange(server, wire_of(body, **options))
    return status, json.loads(answer)


async def error_of(server: PolicyServer, body: Any, **options: Any) -> tuple[int, str, str]:
    status, answer = await post(server, body, **options)
    assert set(answer) == {"error"} and answer["error"]["kind"] in KINDS
    return status, answer["error"]["kind"], answer["error"]["text"]


# --- answers ----------------------------------------------------------------------------------------------------------


def test_json_and_msgpack_get_what_a_websocket_gets() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with connect(f"ws://127.0.0.1:{server.port}") as robot:
            await robot.recv()
            await robot.send(pack(OBSERVATION))
            expected = unpack(await robot.recv(decode=False))
        seen = policy.observations[str(OBSERVATION["prompt"])]
        status, headers, body = await exchange(server, wire_of(pack(OBSERVATION), PACKED))
        packed = unpack(body)
        assert (status, headers["content-type"]) == (200, PACKED["Content-Type"])
        status, answer = await post(server, JSON_OBSERVATION)
        assert status == 200 and answer.keys() == packed.keys() == expected.keys()
        np.testing.assert_array_equal(packed["actions"], expected["actions"])
        assert answer["actions"] == expected["actions"].tolist()
        assert answer["server_timing"].keys() == expected["server_timing"].keys()
        now = policy.observations[str(OBSERVATION["prompt"])]
        for key, value in seen.items():
            np.testing.assert_array_equal(now[key], value)
            assert getattr(now[key], "dtype", None) == getattr(value, "dtype", None)
        metrics = server.metrics.text()
        assert "turbopi_requests_total 3.0" in metrics and "turbopi_clients 0.0" in metrics

    served(test)


def test_a_post_that_asks_for_shared_memory_gets_none() -> None:
    async def test(server: PolicyServer, _: Any) -> None:
        for _ in range(2):
            status, headers, _ = await exchange(server, wire_of(pack(OBSERVATION), {**PACKED, HEADER: WANTED}))
            assert status == 200 and HEADER.lower() not in headers and server._listener._shared.slots == 0

    served(test)


def test_a_socket_is_kept_for_the_next_request_of_any_kind_in_order() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        prompts = [f"prompt {n}" for n in range(5)]
        writer.write(b"".join(wire_of({**JSON_OBSERVATION, "prompt": prompt}) for prompt in prompts))  # at once
        for prompt in prompts:
            status, headers, body = await response_of(reader)
            assert (status, json.loads(body)["prompt"], headers.get("connection")) == (200, prompt, None)
        writer.write(wire_of({**JSON_OBSERVATION, "prompt": "crash"}))
        assert (await response_of(reader))[0] == 500
        writer.write(wire_of(b"{"))
        assert (await response_of(reader))[0] == 400
        writer.write(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert (await response_of(reader))[0] == 200
        assert policy.seen == [*prompts, "crash"]
        writer.close()

    served(test)


def test_first_bytes_may_come_one_by_one_and_a_client_may_wait_for_100() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.transport.set_write_buffer_limits(0)
        head, _, body = wire_of(JSON_OBSERVATION, {"Expect": "100-continue"}).partition(b"\r\n\r\n")
        for byte in head + b"\r\n\r\n":
            writer.write(bytes([byte]))
            await asyncio.sleep(0)
        assert (await response_of(reader))[0] == 100
        writer.write(body)
        assert (await response_of(reader))[0] == 200
        writer.close()

    served(test)


def test_what_a_post_says_is_recorded_and_named(tmp_path: Any) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        assert (await post(server, {**JSON_OBSERVATION, "turbopi/robot": "left arm"}))[0] == 200
        status, answer = await post(server, {**JSON_OBSERVATION, "turbopi/deadline_ms": 0})
        assert (status, answer["error"]["kind"]) == (400, "observation") and "deadline_ms" in answer["error"]["text"]

    served(test, record_dir=tmp_path)
    (folder,) = tmp_path.iterdir()
    recorded, _ = next(iter(iter_recording(folder)))
    np.testing.assert_array_equal(recorded["observation/image"], OBSERVATION["observation/image"])


# --- refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("body", "status", "kind", "text"),
    [
        (b"", 400, "malformed", "it is empty"),
        (b"[1]", 400, "malformed", "JSON list"),
        (b'{"a": NaN}', 400, "malformed", "a is nan"),
        (b'{"a": 1, "a": 2}', 400, "malformed", "given twice"),
        (b'{"a": ' + b"[" * 5000 + b"]" * 5000 + b"}", 400, "malformed", "more than 32 deep"),
        (b'{"a": [' + b"0," * MAX_VALUES + b"0]}", 400, "malformed", f"more than {MAX_VALUES} values"),
        (b'{"a": "\xff"}', 400, "malformed", "isn't JSON"),
        ({"observation/state": [[1, 2], [3]]}, 400, "malformed", "observation/state: the rows"),
        ({"observation/state": [1, "2"]}, 400, "malformed", "int, str"),
        ({"i": "data:image/gif;base64,AA"}, 400, "malformed", "i: an image begins with"),
        ({"i": "data:image/png;base64,??"}, 400, "malformed", "i: an image's base64"),
        ({"i": "data:image/png;base64,AAAA"}, 400, "observation", "or of another format). Images are read as PNG"),
        ({"prompt": "x"}, 400, "observation", "'observation/state' is missing"),
        ({**JSON_OBSERVATION, "prompt": "nan actions"}, 500, "actions", "bad actions"),
        ({**JSON_OBSERVATION, "prompt": "crash"}, 500, "policy", "the server's log"),
        ({**JSON_OBSERVATION, "turbopi/nothing": 1}, 400, "observation", "turbopi/nothing"),
    ],
)
def test_errors_are_objects_with_a_websockets_text(body: Any, status: int, kind: str, text: str) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        found = await error_of(server, body)
        assert found[:2] == (status, kind) and text in found[2] and "Traceback" not in found[2]
        assert f'turbopi_errors_total{{kind="{kind}"}} 1.0' in server.metrics.text()

    served(test)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Content-Length": ""}, 411),
        ({"Content-Length": "", "Transfer-Encoding": "chunked"}, 411),
        ({"Transfer-Encoding": "chunked"}, 411),  # and a length: which of them a proxy went by, nobody knows
        ({"Content-Length": "1000000000"}, 413),
        ({"Content-Length": "9" * 20}, 413),
        ({"Content-Length": "-1"}, 400),
        ({"Content-Length": "5, 6"}, 400),
        ({"Content-Type": "text/plain"}, 415),  # which a page may send without asking
        ({"Content-Encoding": "gzip"}, 415),
        ({"X-A": "a" * 20_000}, 431),
        ({"X-A": "a" * 9000}, 431),
        ({"X-A": "\0"}, 400),
        ({"X-A": "\x05"}, 400),
        ({"Host": ""}, 400),
        ({"Origin": "http://evil.example"}, 403),
        ({"Host": "evil.example", "Origin": "http://evil.example"}, 403),
    ],
)
def test_broken_requests_are_refused_before_their_body(headers: dict[str, str], status: int) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        wire = wire_of(JSON_OBSERVATION, headers)
        found, fields, body = await exchange(server, wire)
        assert found == status and fields["connection"] == "close" and json.loads(body)["error"]["text"]
        assert (await exchange(server, wire.replace(b"HTTP/1.1", b"HTTP/1.0")))[0] >= 400
        assert (await exchange(server, wire.replace(b"/v1/actions", b"/v1/action")))[0] >= 400

    served(test)


def test_the_key_is_needed_as_bearer_or_as_openpi_sends_it() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        for value, status in (("Bearer right", 200), ("Api-Key right", 200), ("Bearer wrong", 401), ("", 401)):
            assert (await post(server, JSON_OBSERVATION, headers={"Authorization": value}))[0] == status
        for path in ("/v1/metadata", "/v1/openapi.json"):
            assert (await http_get(server.port, path))[0] == 401
            assert (await http_get(server.port, path, "Authorization: Api-Key right"))[0] == 200
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)  # a key is of one request alone
        writer.write(wire_of(JSON_OBSERVATION, {"Authorization": "Bearer right"}) + wire_of(JSON_OBSERVATION))
        assert [(await response_of(reader))[0] for _ in range(2)] == [200, 401]
        writer.close()

    served(test, api_key="right")


def test_a_message_and_its_images_take_no_more_memory_than_a_websockets() -> None:
    large = data_url(np.zeros((1400, 1000, 3), np.uint8))  # 4.2 MB in 10 kB

    async def small(server: PolicyServer, policy: FakePolicy) -> None:
        assert (await error_of(server, b" " * 2**20 + b"{}"))[:2] == (413, "too_large")
        few = data_url(np.zeros((512, 341, 3), np.uint8))
        assert "at most 174933 are read" in (await error_of(server, {"i": [few, large]}))[2]

    async def usual(server: PolicyServer, policy: FakePolicy) -> None:
        assert "at most 1398" in (await error_of(server, {**JSON_OBSERVATION, "i": large}))[2]
        assert (await post(server, {**JSON_OBSERVATION, "i": large, "more": " " * 4_300_000}))[0] == 200

    served(small, max_message_mb=1)
    served(usual)


def test_half_requests_are_cut_and_say_so() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        whole = wire_of(JSON_OBSERVATION)
        for half in (whole[:20], whole[:-1]):
            status, fields, _ = await exchange(server, half)
            assert status == 408 and fields["connection"] == "close"
            _, writer = await asyncio.open_connection("127.0.0.1", server.port)
            writer.write(half)
            writer.close()  # and leaves

    served(test, limits=Limits(handshake_seconds=0.2, message_seconds=0.2))


def test_a_client_that_shuts_its_sending_side_is_told_to_keep_it_open() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        for body in (JSON_OBSERVATION, {**JSON_OBSERVATION, "prompt": "hold"}):
            for wire in (wire_of(body), wire_of(body)[:-3]):
                reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
                writer.write(wire)
                writer.write_eof()
                answer = await reader.read()
                assert answer.startswith(b"HTTP/1.1 400 ") and b"keep it open until that has come" in answer, answer
                writer.close()
        policy.release.set()

    served(test)


def test_a_refused_post_is_logged_and_counted_once(caplog: pytest.LogCaptureFixture) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        wire = wire_of(JSON_OBSERVATION, target="/v1/action")
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        for part in (wire[:3], wire[3:80], wire[80:] + wire):
            writer.write(part)
            await asyncio.sleep(0.01)
        assert b" 404 " in await reader.read()
        writer.close()
        while server._listener._connected:
            await asyncio.sleep(0.01)
        assert [record.getMessage().count("alone") for record in caplog.records] == [1]
        assert server.metrics.errors_so_far() == {"malformed": 1}

    served(test)


def test_a_full_queue_is_429_and_a_client_that_leaves_takes_nothing_along() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        held = asyncio.ensure_future(post(server, {**JSON_OBSERVATION, "prompt": "hold"}))
        await asyncio.to_thread(policy.started.wait, 30)
        _, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(wire_of({**JSON_OBSERVATION, "prompt": "never"}))
        while "turbopi_queue_depth 1.0" not in server.metrics.text():
            await asyncio.sleep(0.01)
        assert (await error_of(server, JSON_OBSERVATION))[:2] == (429, "busy")
        writer.close()
        while "turbopi_queue_depth 0.0" not in server.metrics.text():
            await asyncio.sleep(0.01)
        policy.release.set()
        assert (await held)[0] == 200 and "never" not in policy.seen

    served(test, queue_limit=1)


def test_what_follows_a_request_that_is_computed_is_not_read_without_end() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(wire_of({**JSON_OBSERVATION, "prompt": "hold"}))
        await asyncio.to_thread(policy.started.wait, 30)
        writer.write(bytes(64 * 2**20))
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(writer.drain(), 0.5)
        policy.release.set()
        assert (await response_of(reader))[0] == 200
        writer.transport.abort()

    served(test)


def test_a_server_that_stops_answers_what_it_computes() -> None:
    async def main() -> None:
        policy = FakePolicy()
        server = PolicyServer(policy, port=0)
        await server.start()
        held = asyncio.ensure_future(exchange(server, wire_of({**JSON_OBSERVATION, "prompt": "hold"})))
        await asyncio.to_thread(policy.started.wait, 30)
        stopping = asyncio.ensure_future(server.stop())
        await asyncio.sleep(0)
        policy.release.set()
        status, fields, _ = await held
        assert (status, fields["connection"]) == (200, "close")
        await stopping

    asyncio.run(asyncio.wait_for(main(), 60))


def test_damaged_posts_in_pieces_end_their_own_socket_at_most(caplog: pytest.LogCaptureFixture) -> None:
    chance = random.Random(4)
    whole = [wire_of(JSON_OBSERVATION), wire_of(pack(OBSERVATION), PACKED), wire_of(b"{")]

    async def damaged(server: PolicyServer) -> None:
        wire = bytearray(b"".join(chance.choices(whole, k=chance.choice((1, 2)))))
        for _ in range(chance.choice((0, 1, 3))):
            at = chance.randrange(160 if chance.random() < 0.6 else len(wire))
            wire[at : at + chance.choice((0, 1, 20))] = chance.randbytes(chance.choice((0, 1, 5)))
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        for at in range(0, len(wire), piece := chance.choice((50, 10**6))):
            writer.write(wire[at : at + piece])
            await asyncio.sleep(0)
        if chance.random() < 0.3:
            writer.transport.abort()
        with contextlib.suppress(OSError):
            assert b"Traceback" not in await reader.read()
        writer.close()

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        await asyncio.gather(*(damaged(server) for _ in range(150)))
        assert not [record for record in caplog.records if record.levelname == "ERROR"]

    free: dict[str, Any] = {"work_burst": 1e6, "work_rate": 1e6, "work_total_rate": 1e6, "connections_rate": 1e4}
    served(test, limits=Limits(handshake_seconds=0.5, message_seconds=0.5, close_seconds=0.5, **free))


def test_a_client_that_has_left_when_it_is_refused_is_no_fault_of_the_server(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def not_connected(self: object) -> None:
        raise OSError(errno.ENOTCONN, "Transport endpoint is not connected")

    monkeypatch.setattr("asyncio.selector_events._SelectorSocketTransport.write_eof", not_connected)

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        assert (await exchange(server, wire_of(JSON_OBSERVATION)[:-1]))[0] == 408
        assert not [record for record in caplog.records if record.levelname == "ERROR"]

    served(test, limits=Limits(message_seconds=0.2))


# --- documents --------------------------------------------------------------------------------------------------------


def test_the_schema_has_the_policys_keys_and_shapes_and_fits_a_request() -> None:
    validator = pytest.importorskip("jsonschema").Draft202012Validator
    features = [{"name": "x", "unit": "m"}, {"name": "grip", "unit": ""}]
    metadata = {"action_horizon": 3, "robot_action_dim": 2, "features": {"state": features, "actions": features}}
    example = {"image": np.zeros((4, 4, 3), np.uint8), "state": np.zeros(2), "prompt": "a", "deep": {"x": np.zeros(1)}}
    made = schema(metadata, example)
    assert made["openapi"] == "3.1.0" and made["info"].keys() == {"title", "version"}
    parts = made["components"]["schemas"]
    for part in parts.values():
        validator.check_schema(part)
    request = {**from_example(example), "turbopi/deadline_ms": 100}
    assert parts["Observation"]["properties"]["state"]["description"] == "x m, grip"
    assert validator(parts["Observation"]).is_valid(request)
    assert not validator(parts["Observation"]).is_valid({**request, "state": [1.0]})
    assert validator(parts["Answer"]).is_valid({"actions": [[0.0, 1.0]] * 3, "server_timing": {"infer_ms": 1.0}})
    assert validator(parts["Error"]).is_valid({"error": {"kind": "busy", "text": "busy"}})
    references = {value for value in strings(made) if value.startswith("#/")}
    assert references == {f"#/components/schemas/{name}" for name in parts}


def test_the_schema_has_lerobots_images_as_data_urls_too() -> None:
    """Lists of 3 x 224 x 224 numbers would be more values than a body may have."""
    properties = schema({}, {"a": np.zeros((3, 224, 224), np.float32)})["components"]["schemas"]["Observation"]
    assert properties["properties"]["a"]["type"] == "string"


def from_example(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: from_example(item) for key, item in value.items()}
    if not isinstance(value, np.ndarray):
        return value
    return data_url(value) if value.ndim == 3 else value.tolist()


def strings(value: Any) -> list[str]:
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [value] if isinstance(value, str) else [text for item in items for text in strings(item)]


def test_the_schema_knows_every_key_of_a_request() -> None:
    assert set(OPTIONS) == set(KEYS)


def test_documents_are_served_to_known_hosts() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        status, headers, body = await http_get(server.port, "/v1/metadata")
        assert (status, json.loads(body)) == (200, policy.metadata)
        assert headers["content-type"] == "application/json"
        assert json.loads((await http_get(server.port, "/v1/openapi.json"))[2])["paths"].keys() >= {"/v1/actions"}
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(b"GET /v1/metadata HTTP/1.1\r\nHost: evil.example\r\n\r\n")
        assert (await response_of(reader))[0] == 403
        writer.close()

    served(test)


# --- JSON -------------------------------------------------------------------------------------------------------------


def test_json_becomes_the_message_it_means() -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 4, 3), np.uint8)
    batch = {"i": [data_url(image)] * 2, "n": [[1, 2], [3.5, 4]], "b": [True, False], "t": ["a", "b"], "x": None}
    found = unpack(from_json(json.dumps(batch).encode(), 10**6))
    np.testing.assert_array_equal(found["i"], np.stack([image] * 2))
    np.testing.assert_array_equal(found["n"], np.array([[1.0, 2.0], [3.5, 4.0]]))
    assert (found["n"].dtype, found["b"].dtype, found["t"], found["x"]) == (np.float64, np.bool_, ["a", "b"], None)
    blurred = unpack(from_json(json.dumps({"i": data_url(image, "jpeg")}).encode(), 10**6))["i"]
    assert (blurred.shape, blurred.dtype) == (image.shape, np.uint8)
    with pytest.raises(WireError, match="one size"):
        from_json(json.dumps({"i": [data_url(image), data_url(image[:2])]}).encode(), 10**6)
    with pytest.raises(ObservationError, match="at most 10 are read"):
        from_json(json.dumps({"i": data_url(image)}).encode(), 30)


def test_an_answer_that_is_no_json_becomes_some() -> None:
    answer = {"a": np.array([np.nan, 1]), "b": np.float32(2), "c": 1j, "d": float("inf")}
    assert json.loads(to_json(answer)) == {"a": [None, 1.0], "b": 2.0, "c": "1j", "d": None}


@pytest.mark.parametrize("features", ["none", {"state": {"dtype": "float32"}, "actions": [{"name": 3}]}])
def test_the_schema_of_a_policy_of_another_make_lacks_what_it_does_not_tell(features: Any) -> None:
    metadata = {"features": features, "action_horizon": "ten", "robot_action_dim": 7}
    made = schema(metadata, {"state": np.zeros(3)})
    answer = made["components"]["schemas"]["Answer"]["properties"]["actions"]
    assert "minItems" not in answer and answer["items"]["minItems"] == 7 and json.dumps(made)
