"""`turbopi serve --traces`: what of a call goes to OpenTelemetry, and that nothing there reaches a call."""

import asyncio
import sys
from collections.abc import Awaitable, Callable
from typing import Any, cast

import pytest
from serve_fakes import FakePolicy, observation
from test_serve_http import JSON_OBSERVATION, post
from websockets.asyncio.client import ClientConnection, connect

from turbopi.realtime.wire import pack, unpack
from turbopi.serve import PolicyServer, options, traces
from turbopi.serve.options import ServerOptions
from turbopi.serve.requests import ClientRequest, Result, SchedulingOptions
from turbopi.serve.traces import parts_of
from turbopi.support.errors import ConfigError

CLIENTS = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
TRACE, SPAN = (int(part, 16) for part in CLIENTS.split("-")[1:3])
Test = Callable[[PolicyServer, ClientConnection], Awaitable[None]]


class Done:
    """Results that are there."""

    def __init__(self, *results: Result) -> None:
        self.result = lambda: list(results)

    done, cancelled = (lambda self: True), (lambda self: False)


def request_of(*results: Result, batch: int | None = None) -> ClientRequest:
    scheduling, nothing = SchedulingOptions(1.0, batch=batch), cast(Any, None)
    done = cast(Any, Done(*results)) if results else None
    return ClientRequest(nothing, scheduling, nothing, 10.0, done, submitted=10.1)


@pytest.mark.parametrize(
    ("results", "batch", "timing", "ends"),
    [
        (
            [Result(0.3, {}, began=10.2)],
            None,
            {"preprocess_ms": 100.0},
            {"receive": 10.1, "queue": 10.2, "prepare": 10.3, "infer": 10.5, "answer": 11.0},
        ),
        ([Result(0.3, {}, began=10.2)], None, {}, {"receive": 10.1, "queue": 10.2, "infer": 10.5, "answer": 11.0}),
        (  # a batch message in two runs
            [Result(0.3, {}, began=10.2), Result(0.1, {}, began=10.6)],
            2,
            {"preprocess_ms": 100.0},
            {"receive": 10.1, "queue": 10.2, "infer": 10.7, "answer": 11.0},
        ),
        ([Result(0.3, {})], None, {}, {"receive": 10.1, "queue": 11.0}),  # a fleet's: the clock of another machine
        ([], None, {}, {"receive": 10.1}),  # refused at once
    ],
)
def test_a_calls_parts_follow_each_other(
    results: list[Result], batch: int | None, timing: dict[str, float], ends: dict[str, float]
) -> None:
    parts = parts_of(request_of(*results, batch=batch), timing, 11.0)
    assert {part.name: part.end for part in parts} == pytest.approx(ends)
    begins = [10.0, *(part.end for part in parts[:-1])]
    assert [part.begin for part in parts] == begins


def test_without_the_packages_traces_are_refused_and_all_else_works(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "opentelemetry"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "opentelemetry", None)  # its import fails
    served(good_call, traces=False)
    with pytest.raises(ConfigError, match=r"opentelemetry.sdk isn't installed: pip install 'turbopi\[otel\]'"):
        ServerOptions(traces=True)


async def good_call(server: PolicyServer, client: ClientConnection) -> None:
    await client.send(pack(observation()))
    assert b"actions" in await client.recv(decode=False)


def served(test: Test, headers: dict[str, str] | None = None, traces: bool = True) -> None:
    async def main() -> None:
        async with (
            PolicyServer(FakePolicy(), port=0, traces=traces) as server,
            connect(server.url, additional_headers=headers) as client,
        ):
            await client.recv()
            await test(server, client)

    asyncio.run(asyncio.wait_for(main(), 60))


@pytest.mark.parametrize("value", [7, "", "now", CLIENTS.upper(), CLIENTS + "-x"])
def test_a_traceparent_that_cant_be_one_is_refused(value: object) -> None:
    async def test(server: PolicyServer, client: ClientConnection) -> None:
        await client.send(pack({**observation(), "turbopi/traceparent": value}))
        assert f"bad observation: turbopi/traceparent is {value!r}" in str(await client.recv())

    served(test, traces=False)


# --- with OpenTelemetry -----------------------------------------------------------------------------------------------


@pytest.fixture
def exported(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The exporter in memory, which has all spans once the server has stopped."""
    module = pytest.importorskip("opentelemetry.sdk.trace.export.in_memory_span_exporter")
    exporter = module.InMemorySpanExporter()
    monkeypatch.setattr(traces, "make_exporter", lambda: exporter)
    monkeypatch.setattr(options, "OPENTELEMETRY", ())  # its own exporter may be missing here
    return exporter


@pytest.mark.slow
@pytest.mark.parametrize("by", ["nothing", "key", "handshake", "POST"])
def test_a_call_is_a_span_in_the_clients_trace(exported: Any, by: str) -> None:
    async def test(server: PolicyServer, client: ClientConnection) -> None:
        if by == "POST":
            assert (await post(server, JSON_OBSERVATION, headers={"traceparent": CLIENTS}))[0] == 200
            return
        await client.send(pack({**observation(), **({"turbopi/traceparent": CLIENTS} if by == "key" else {})}))
        assert "actions" in unpack(await client.recv(decode=False))

    served(test, {"traceparent": CLIENTS} if by == "handshake" else None)
    *parts, call = exported.get_finished_spans()
    assert (call.name, [part.name for part in parts]) == ("turbopi.call", ["receive", "queue", "infer", "answer"])
    assert call.resource.attributes["service.name"] == "turbopi"
    assert call.attributes["turbopi.priority"] == "robot" and "error.type" not in call.attributes
    if by == "nothing":
        assert call.parent is None
    else:
        assert (call.context.trace_id, call.parent.span_id) == (TRACE, SPAN)
    assert {(part.context.trace_id, part.parent.span_id) for part in parts} == {
        (call.context.trace_id, call.context.span_id)
    }
    times = [call.start_time, *(part.end_time for part in parts)]
    assert times == sorted(times) and times[-1] == call.end_time
    assert [part.start_time for part in parts] == times[:-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("message", "kind"),
    [(pack(observation("crash")), "policy"), (pack({"a": 1}), "observation"), (b"\xc1", "malformed")],
)
def test_a_refusal_and_a_failure_are_errors(exported: Any, message: bytes, kind: str) -> None:
    async def test(server: PolicyServer, client: ClientConnection) -> None:
        await client.send(message)
        assert isinstance(await client.recv(), str)

    served(test)
    call = exported.get_finished_spans()[-1]
    assert call.attributes["error.type"] == kind and call.status.is_ok is False and call.status.description


@pytest.mark.slow
def test_an_exporter_that_fails_or_hangs_touches_no_call(
    exported: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("no collector")

    monkeypatch.setattr(exported, "export", fail)
    served(good_call)
    monkeypatch.setattr(traces, "parts_of", fail)
    served(good_call)
    assert "a call's trace is lost: no collector" in caplog.text
    hung = asyncio.Event()
    monkeypatch.setattr(exported, "shutdown", lambda: asyncio.run(hung.wait()))
    monkeypatch.setattr(traces, "CLOSE_SECONDS", 0.05)
    served(good_call)  # it stops all the same
