"""OpenTelemetry spans of served calls: `turbopi serve --traces`, with the extra `turbopi[otel]`.

Spans are made after an answer was sent, of moments noted on its way, so a call waits for nothing here. Where they go:
OpenTelemetry's own variables, as OTEL_EXPORTER_OTLP_ENDPOINT and OTEL_TRACES_SAMPLER. Without --traces none of its
packages is imported.
"""

import asyncio
import os
import threading
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

from turbopi.serve.connection import GuardedConnection
from turbopi.serve.limited_log import LimitedLog
from turbopi.serve.requests import TIMING, ClientRequest, Refusal
from turbopi.version import turbopi_version

CLOSE_SECONDS = 2.0  # for the last spans, when the server stops


class Part(NamedTuple):
    """A part of a call, in seconds of time.perf_counter()."""

    name: str
    begin: float
    end: float


def parts_of(request: ClientRequest, timing: Mapping[str, float], finished: float) -> list[Part]:
    """receive, queue, prepare, infer, answer: each begins where the one before it ends.

    Without a turn there is receive alone; of a fleet's call receive and queue, as a replica has its own clock. A batch
    message in several runs has an infer over all of them, with what lies between.

    timing    the answer's "policy_timing"
    finished  when the answer was sent
    """
    ends = [("receive", request.submitted)]
    results = request.results
    runs = [] if results is None or not results.done() or results.cancelled() else results.result()
    if runs and all(run.began for run in runs):
        began, ended = min(run.began for run in runs), max(run.began + run.seconds for run in runs)
        ends.append(("queue", began))
        if request.scheduling.batch is None and "preprocess_ms" in timing:
            ends.append(("prepare", began + timing["preprocess_ms"] / 1e3))
        ends += [("infer", ended), ("answer", finished)]
    elif runs:
        ends.append(("queue", finished))
    parts, begin = [], request.arrived
    for name, end in ends:
        parts.append(Part(name, begin, max(begin, end)))
        begin = parts[-1].end
    return parts


class Traces:
    """Hands spans to OpenTelemetry's own thread, which exports them. For the event loop's thread.

    Nothing that fails here reaches a call: it is logged.
    """

    def __init__(self, log: LimitedLog) -> None:
        from opentelemetry import trace
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
        from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

        self._trace, self._propagator, self._log = trace, TraceContextTextMapPropagator(), log
        name = os.environ.get("OTEL_SERVICE_NAME", "turbopi")
        self._provider = TracerProvider(resource=Resource.create({"service.name": name}), shutdown_on_exit=False)
        self._provider.add_span_processor(BatchSpanProcessor(make_exporter()))
        self._tracer = self._provider.get_tracer("turbopi", turbopi_version())
        self._offset = time.time_ns() - time.perf_counter_ns()

    def answered(
        self, connection: GuardedConnection, request: ClientRequest, result: Mapping[str, Any], finished: float
    ) -> None:
        """A call's answer was sent."""
        try:
            self._export(connection, request, parts_of(request, result.get(TIMING, {}), finished), finished, None)
        except Exception as error:
            self._log.warning(f"a call's trace is lost: {error}", "traces")

    def refused(
        self, connection: GuardedConnection, request: ClientRequest | None, refusal: Refusal, received: float
    ) -> None:
        """A message got a refusal; `request` if it could be read."""
        try:
            now = time.perf_counter()
            parts = [] if request is None else parts_of(request, {}, now)
            self._export(connection, request, parts, now, refusal, received)
        except Exception as error:
            self._log.warning(f"a refusal's trace is lost: {error}", "traces")

    def _export(
        self,
        connection: GuardedConnection,
        request: ClientRequest | None,
        parts: list[Part],
        finished: float,
        refusal: Refusal | None,
        received: float = 0.0,
    ) -> None:
        attributes: dict[str, Any] = {"turbopi.robot": connection.robot} if connection.robot else {}
        carrier = {} if connection.request is None else dict(_headers(connection))
        if request is not None:
            received = request.arrived
            scheduling = request.scheduling
            attributes |= {"turbopi.priority": scheduling.priority, "turbopi.batch": scheduling.batch or 1}
            if scheduling.traceparent:
                carrier = {"traceparent": scheduling.traceparent}
        if refusal is not None:
            attributes["error.type"] = refusal.kind
        context = self._propagator.extract(carrier)
        kind = self._trace.SpanKind.SERVER
        call = self._tracer.start_span("turbopi.call", context, kind, attributes, start_time=self._wall(received))
        if refusal is not None:
            call.set_status(self._trace.StatusCode.ERROR, refusal.text[:500])
        inside = self._trace.set_span_in_context(call)
        for part in parts:
            span = self._tracer.start_span(part.name, inside, start_time=self._wall(part.begin))
            span.end(self._wall(part.end))
        call.end(self._wall(finished))

    def _wall(self, seconds: float) -> int:
        return int(seconds * 1e9) + self._offset

    async def close(self) -> None:
        """Export what is left, in a few seconds at most."""
        # A thread of its own, which the process doesn't wait for: an exporter may try for a minute.
        closing = threading.Thread(target=self._provider.shutdown, daemon=True)
        closing.start()
        end = time.monotonic() + CLOSE_SECONDS
        while closing.is_alive() and time.monotonic() < end:
            await asyncio.sleep(0.01)


def _headers(connection: GuardedConnection) -> list[tuple[str, str]]:
    """Of the trace context: a POST's own; a websocket's those of its handshake."""
    assert connection.request is not None
    found = ((name, connection.request.headers.get_all(name)) for name in ("traceparent", "tracestate"))
    return [(name, ",".join(values)) for name, values in found if values]


def make_exporter() -> Any:
    from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter

    return OTLPSpanExporter()
