"""The policy server: openpi's websocket protocol around one policy. requests.py handles each message.

    client                          server
      ── GET, Upgrade ────────────▶   /healthz and /metrics are answered as plain HTTP
      ◀────────────── metadata ────   binary frame, msgpack map
      ── observation ─────────────▶   binary frame, msgpack map
      ◀─────────────── actions ────   binary frame: the policy's result and "server_timing"
      ◀─────────────── message ────   or a text frame, when the observation was bad: the connection stays open
      ◀─── traceback, close 1011 ──   or, when the policy failed

The event loop only moves and decodes bytes; the policy runs on the worker's thread, so health checks, pings and other
clients are served while it does. listener.py lets clients in, connection.py reads what they send no faster than they
may send it. See docs/serving_security.md for the limits, docs/serving_protocol.md for what differs from openpi's
own server.
"""

import asyncio
import contextlib
import gc
import logging
import sys
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode

from turbopi.realtime.messages import keeps_episode
from turbopi.realtime.wire import pack, unpack
from turbopi.recordings import Recorder
from turbopi.recordings.limit import RecordLimit
from turbopi.serve.calls import Policy, PolicyCalls
from turbopi.serve.connection import GuardedConnection, Shared
from turbopi.serve.gate import Gate
from turbopi.serve.hosts import AllowedHosts
from turbopi.serve.limited_log import LimitedLog, peer
from turbopi.serve.limits import Limits, limits_for
from turbopi.serve.listener import Listener
from turbopi.serve.memory import Histories
from turbopi.serve.metrics import Metrics
from turbopi.serve.openapi import documents
from turbopi.serve.options import ServerOptions
from turbopi.serve.page.http import is_feed
from turbopi.serve.page.live import Live
from turbopi.serve.real_time import RealTime
from turbopi.serve.requests import (
    Begun,
    Calls,
    ClientLeft,
    ClientRequest,
    PolicyFailed,
    Refusal,
    Reply,
    RequestHandler,
    batch_row,
)
from turbopi.serve.signals import stop_signals
from turbopi.serve.traces import Traces
from turbopi.support.errors import ConfigError, DeviceLost

logger = logging.getLogger(__name__)

LOST_NOTICE = 5.0  # seconds from the device's loss to the end, in which /healthz says 503: load balancers check seldom
# Seconds after which a thread that computes lets another one go on that waits to. Python's 5 ms are long for answers
# that wait while the policy's thread reads a batch, and for that thread while the event loop reads what comes.
SWITCH_SECONDS = 0.0005
# After an answer, until it is counted, shown and recorded. By then a client that goes on at once has its next turn, and
# so has a batch of them: it needn't wait for that.
COUNT_SECONDS = 0.005
MAX_TEXT = 4000  # characters of an error message; one that quotes its input shouldn't send it all back


class PolicyServer:
    """Serves one policy over openpi's websocket protocol. Good for one start.

    options  `given` are ServerOptions' fields, instead of its own
    limits   what else a client may cost; its `clients` and `message_bytes` are those of the options
    calls    makes what runs the requests, if not the policy in this process, of which then the metadata alone is used;
             called with the metrics, and with what to call with the reason when no request can be run any more

    `host` and `port` are where it listens; port 0 becomes the free one that it took, once started. Raises ConfigError
    for options that can't be right.
    """

    def __init__(
        self,
        policy: Policy,
        options: ServerOptions | None = None,
        *,
        limits: Limits | None = None,
        calls: Callable[[Metrics, Callable[[str], None]], Calls] | None = None,
        **given: Any,
    ) -> None:
        self.options = options = replace(options or ServerOptions(), **given)
        self.host, self.port = options.host, options.port
        self.metrics = Metrics()
        self._policy = policy
        self._limits = limits_for(options.max_message_mb, options.max_clients, limits)
        self._log = LimitedLog(logger)
        hosts = AllowedHosts(options.host, options.allowed_hosts)
        # Why no request can be served any more: the device failed for good. None as long as it works.
        self.lost: str | None = None
        troubles = (lambda: self.lost, lambda: self._calls.unwell)
        self._gate = Gate(options.api_key, self.metrics, hosts, *troubles, has_page=options.has_page)
        in_place = calls is None and options.record_dir is None and getattr(policy, "reads_in_place", False)
        shared = Shared(self._limits, self.metrics, self._log, in_place=in_place)
        self._listener = Listener(self._gate, self._handle, shared)
        self._record_dir = None if options.record_dir is None else Path(options.record_dir)
        self._recorder: Recorder | None = None
        self._calls: Calls = (
            PolicyCalls(policy, options, self.metrics, self._lose) if calls is None else calls(self.metrics, self._lose)
        )
        self._real_time = RealTime(policy.metadata, options, self.metrics, waits=self._calls.waits)
        self._histories = None
        if keeps_episode(policy.metadata):
            if calls is not None:
                raise ConfigError(
                    "this policy has memory, and the replicas of a fleet keep no robot's history: take `turbopi serve`"
                )
            size = policy.metadata.get("memory", {}).get("bytes")
            self._histories = Histories(policy.new_history, size)  # type: ignore[attr-defined]
        self._lost: Future[None] = Future()  # done when `lost` is there: from the worker's thread
        self._requests = RequestHandler(
            self._calls,
            self._real_time,
            self.metrics,
            options,
            self._limits.message_bytes,
            histories=self._histories,
            strict=bool(policy.metadata.get("strict")),
            why_lost=lambda: self.lost,
        )
        self.metrics.watch(lambda: self._calls.waiting, lambda: self._calls.running)
        self._live = Live(self.metrics, self._calls, lambda: self.lost) if options.has_page else None
        self._traces: Traces | None = None
        self._started = False
        self._idle: set[GuardedConnection] = set()  # connections that wait for a request
        self._uncounted: list[Callable[[], None]] = []
        self._stopping = False
        self._greeting = b""

    # --- lifecycle ----------------------------------------------------------------------------------------------------

    @property
    def url(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"ws://{host}:{self.port}"

    def _lose(self, reason: str) -> None:
        if self.lost is None:
            logger.error("the device is lost, and every request is refused from here on: %s", reason)
            self.lost = reason
            self._lost.set_result(None)

    @property
    def recording(self) -> Path | None:
        """The folder that this run's recording goes to; None if nothing is recorded."""
        return None if self._recorder is None else self._recorder.folder

    @property
    def joins(self) -> str | None:
        """How it joins the chunks of clients that don't say how, on one line; None if it doesn't."""
        return self._real_time.description

    async def start(self) -> None:
        """Take the port, warm the policy up on its thread, start recording, then let clients in.

        Raises ConfigError if the port or the recording's folder can't be had, and whatever the warm-up raises.
        """
        if self._started:
            raise RuntimeError("a PolicyServer starts once: make a new one")
        self._started = True
        if self.options.traces:
            self._traces = Traces(self._log)
        try:
            self.port = await self._listener.bind(self.host, self.port)
        except (OSError, UnicodeError) as error:  # UnicodeError: a host that can't be a name
            raise self._cannot_listen(error) from error
        try:
            execution = self.options.execution
            await self._calls.warm_up(**({} if execution is None else {"real_time": execution}))
            metadata = {**self._policy.metadata, **self._real_time.metadata}
            self._greeting = pack(metadata)
            self._gate.documents = documents(metadata, self._policy)
            if self._record_dir is not None:
                keeps = self.options.record_limit
                self._recorder = Recorder(
                    self._record_dir,
                    metadata,
                    count=self.metrics.recorded,
                    limit=None if keeps is None else RecordLimit.of(keeps),
                    images=self.options.record_images,
                )
            if self._live is not None:
                self._live.start(metadata, self.options.queue_limit)
            try:
                self._listener.start()
            except OSError as error:  # two may bind a port on Linux: the one that was warm first has it
                raise self._cannot_listen(error) from error
        except BaseException:
            self._listener.close()
            self._calls.close()
            if self._recorder is not None:
                self._recorder.close()
            if self._traces is not None:
                await self._traces.close()
            raise

    def _cannot_listen(self, error: Exception) -> ConfigError:
        return ConfigError(f"can't listen on {self.url}: {error}. Choose another --host or --port.")

    async def stop(self) -> None:
        """Stop gracefully: refuse new clients, finish the running inference and send its actions, close with 1001.

        Takes as long as that inference and a few seconds, whatever the clients do.
        """
        assert self._started, "start() first"
        self._stopping = True
        self._calls.stop()
        self._listener.close()
        if self._live is not None:
            self._live.begin_stop()
        goodbyes = [asyncio.create_task(self._say_goodbye(connection)) for connection in tuple(self._idle)]
        await self._calls.drain()
        await self._listener.ended(self._limits.close_seconds)
        await asyncio.gather(*goodbyes)
        self._count()
        self._calls.close()
        if self._live is not None:
            await self._live.close()
        self._requests.close()
        self._log.flush()
        self._gate.flush_log()
        if self._recorder is not None:
            await asyncio.to_thread(self._recorder.close)
        if self._traces is not None:
            await self._traces.close()

    async def __aenter__(self) -> "PolicyServer":
        await self.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.stop()

    def serve_forever(
        self,
        on_ready: Callable[["PolicyServer"], None] = lambda server: None,
        on_stopping: Callable[["PolicyServer"], None] = lambda server: None,
    ) -> None:
        """Serve until SIGINT or SIGTERM, then stop gracefully. A second signal kills the process.

        `on_ready` is called once clients can connect, `on_stopping` when the first signal has come. When the device has
        failed for good, all requests are refused and /healthz answers 503 for LOST_NOTICE seconds; then it stops and
        raises DeviceLost, so that a supervisor can start the process again.
        """

        async def main() -> None:
            with stop_signals() as stop:  # from here on: a warm-up may take minutes
                starting, stopped = asyncio.ensure_future(self.start()), asyncio.ensure_future(stop.wait())
                try:
                    await asyncio.wait((starting, stopped), return_when=asyncio.FIRST_COMPLETED)
                    early = not starting.done()
                    if early:
                        on_stopping(self)
                    await starting
                    try:
                        if not early:
                            _set_aside_what_stays()
                            on_ready(self)
                            lost = asyncio.wrap_future(self._lost)
                            await asyncio.wait((stopped, lost), return_when=asyncio.FIRST_COMPLETED)
                            if lost.done():
                                await asyncio.wait((stopped,), timeout=LOST_NOTICE)
                            else:
                                on_stopping(self)
                    finally:
                        await self.stop()
                finally:
                    stopped.cancel()

        usual, frozen = sys.getswitchinterval(), gc.get_freeze_count()
        sys.setswitchinterval(min(usual, SWITCH_SECONDS))
        try:
            asyncio.run(main())
        finally:
            sys.setswitchinterval(usual)
            if not frozen:  # else unfreezing would undo what the program around has frozen
                gc.unfreeze()
        if self.lost is not None:
            raise DeviceLost(self.lost)

    # --- the protocol -------------------------------------------------------------------------------------------------

    async def _handle(self, connection: GuardedConnection) -> None:
        """One client, from its metadata to its close; or one who watches."""
        if self._live is not None:
            if is_feed(connection.request):
                self._count()  # all that was answered is there in the first frame
                self._log.info(f"{peer(connection)} watches", "connections")
                return await self._live.watch(connection)
            self._live.connected(connection)
        how = ""
        self.metrics.clients.inc()
        self._came_or_went(connection, "connected")
        try:
            await connection.send(self._greeting)
            await self._converse(connection)
        except ClientLeft:
            self.metrics.error("disconnected")
            how = "it left during its request"
            self._came_or_went(connection, how.removeprefix("it "))
        except ConnectionClosed as closed:
            if closed.sent is not None and closed.sent.code == CloseCode.MESSAGE_TOO_BIG:
                self.metrics.error("too_large")
            how = _said(closed)
            self._came_or_went(connection, f"disconnected{how and f': {how}'}")
        except PolicyFailed as failure:
            await self._fail(connection, str(failure))
        except Exception:  # a fault of this server must cost one client, not all
            logger.exception("%s: the server failed", peer(connection))
            await self._fail(connection, traceback.format_exc())
        finally:
            self._count()
            self._idle.discard(connection)
            self._real_time.closed(connection)
            if self._histories is not None:
                self._histories.closed(connection)
            self.metrics.clients.dec()
            if self._live is not None:
                self._live.disconnected(connection, how)

    def _came_or_went(self, connection: GuardedConnection, how: str) -> None:
        if not connection.posted:  # each POST would
            self._log.info(f"{peer(connection)} {how}", "connections")

    async def _fail(self, connection: GuardedConnection, text: str) -> None:
        """Send a traceback and close, as openpi does."""
        self._count()  # in the order in which it happened
        self.metrics.error("policy")
        if self._live is not None:
            self._live.refused(connection, "policy", _raised(text))
        with contextlib.suppress(ConnectionClosed):
            await connection.send(text)
            await connection.close(CloseCode.INTERNAL_ERROR, "internal server error: the last frame has the traceback")

    async def _say_goodbye(self, connection: GuardedConnection) -> None:
        await connection.close(CloseCode.GOING_AWAY, "the server is shutting down")

    async def _converse(self, connection: GuardedConnection) -> None:
        """One response for every request, until the client leaves or the server stops."""
        while not self._stopping:
            started = time.perf_counter()
            message, received, begun = await self._next(connection)
            try:
                reply = begun if isinstance(begun, Refusal) else await self._requests.finish(begun)
            except PolicyFailed as failure:
                self._trace_refusal(connection, begun, Refusal("policy", _raised(str(failure))), received)
                raise
            if isinstance(reply, Refusal):
                await self._refuse(connection, reply)
                self._trace_refusal(connection, begun, reply, received)
                continue
            if reply.sent is None:
                await connection.send(pack(reply.result))
                finished = time.perf_counter()
            else:
                with contextlib.suppress(OSError):  # its client has left, which the next message says
                    await connection.drain()
                finished = reply.sent
            connection.cycle_s = finished - started  # with the wait for the request, as openpi counts it
            assert isinstance(begun, ClientRequest) and not isinstance(message, str)
            if self._live is not None and self._live.watched:
                message = bytes(message)  # now: what comes next may be written over it
            self._count_later(partial(self._count_answer, connection, message, begun, reply, finished), len(message))
            del message, begun, reply  # a connection that waits must not hold them in memory
            connection.answered("good")
        await self._say_goodbye(connection)

    def _count_later(self, count: Callable[[], None], size: int) -> None:
        """Count an answer after COUNT_SECONDS, or now if its message of so many bytes takes much memory."""
        self._uncounted.append(count)
        if size > self._limits.free_bytes:
            self._count()
        elif len(self._uncounted) == 1:
            asyncio.get_running_loop().call_later(COUNT_SECONDS, self._count)

    def _count(self) -> None:
        """Count all answers that aren't counted yet."""
        uncounted, self._uncounted = self._uncounted, []
        for count in uncounted:
            try:
                count()
            except Exception:  # a fault of this server must cost no client
                logger.exception("an answer wasn't counted, shown or recorded")

    def _count_answer(
        self,
        connection: GuardedConnection,
        message: bytes | memoryview,
        request: ClientRequest,
        reply: Reply,
        finished: float,
    ) -> None:
        scheduling, seconds = reply.scheduling, finished - request.arrived
        self.metrics.request_seconds.observe(seconds)
        if self._traces is not None:
            self._traces.answered(connection, request, reply.result, finished)
        if scheduling.firm:
            self.metrics.slack(scheduling.deadline - seconds, scheduling.priority)
        for note in reply.notes:
            self._log.warning(f"{peer(connection)}: {note.text}", note.kind)
            if self._live is not None:
                self._live.noted(connection, note.kind, note.text)
        if "actions" not in reply.result:  # a policy with memory has recorded the observation alone
            return
        if self._live is not None:
            self._live.answered(connection, message, reply, seconds)
        if self._recorder is not None:
            self._record(bytes(message), reply.result, scheduling.batch)

    async def _next(self, connection: GuardedConnection) -> tuple[str | bytes | memoryview, float, Begun]:
        """The next message, when it came, and its request, which is submitted by the callback that receives it.

        Raises ClientLeft if the client leaves meanwhile.
        """
        begun: list[tuple[float, Begun | Exception]] = []

        def begin(message: bytes | memoryview) -> "asyncio.Future[Any] | None":
            self._idle.discard(connection)
            received = time.perf_counter()
            try:
                request = self._requests.begin(connection, message, received)
            except Exception as error:  # not asyncio's to log: a fault of this server must cost one client
                begun.append((received, error))
                return None
            self.metrics.requests.inc()
            begun.append((received, request))
            return None if isinstance(request, Refusal) or self._calls.waiting else request.results

        self._idle.add(connection)
        try:
            message = await connection.recv_taken(begin)
        except BaseException as error:
            for _, one in begun:
                if isinstance(one, ClientRequest):
                    self._requests.drop(one)
                    if isinstance(error, ConnectionClosed):
                        raise ClientLeft from None
            raise
        self._idle.discard(connection)
        if not begun:
            received = time.perf_counter()
            self.metrics.requests.inc()
            return message, received, await self._requests.take(connection, message, received)
        ((received, request),) = begun
        if isinstance(request, Exception):
            raise request
        return message, received, request

    async def _refuse(self, connection: GuardedConnection, refusal: Refusal) -> None:
        """Send the refusal; close with 1008 after many bad requests in a row: such a client doesn't read answers."""
        kind, text = refusal
        text = text if len(text) <= MAX_TEXT else text[: MAX_TEXT - 1] + "…"
        self._count()  # in the order in which it happened
        self.metrics.error(kind)
        self._log.warning(f"{peer(connection)}: {text}", kind)
        if self._live is not None:
            self._live.refused(connection, kind, text)
        await connection.send(text)
        connection.answered("bad" if kind in ("malformed", "observation") else "neither")
        if connection.bad_in_a_row >= self._limits.bad_messages:
            self.metrics.error("flood")
            reason = f"{connection.bad_in_a_row} bad requests in a row"
            self._log.warning(f"{peer(connection)}: {reason}, the last one: {text}", "flood")
            await connection.close(CloseCode.POLICY_VIOLATION, f"{reason}: the text frames say what is wrong")

    def _trace_refusal(self, connection: GuardedConnection, begun: Begun, refusal: Refusal, received: float) -> None:
        if self._traces is not None:
            request = begun if isinstance(begun, ClientRequest) else None
            self._traces.refused(connection, request, refusal, received)

    def _record(self, message: bytes, result: dict[str, object], batch: int | None) -> None:
        """Record a call; of a batch message each row, as a call of its own."""
        assert self._recorder is not None
        observation = unpack(message, max_bytes=self._limits.message_bytes)  # the policy may have changed what it got
        if batch is None:
            self._recorder.put(observation, result, size=len(message))
            return
        for index in range(batch):
            self._recorder.put(batch_row(observation, index), batch_row(result, index), size=len(message) // batch)


def _raised(text: str) -> str:
    """What was raised, of a traceback."""
    return text.strip().rpartition("\n")[2]


def _set_aside_what_stays() -> None:
    """Let the garbage collector leave alone what was made up to here.

    Libraries and the policy are hundreds of thousands of objects: a full collection among requests delayed all of them
    by 160 ms in a fleet's server.
    """
    gc.collect()
    gc.freeze()


def _said(closed: ConnectionClosed) -> str:
    """What the end of a connection said of itself, "" for nothing, as of a client that only ends: openpi's does."""
    frame = closed.rcvd if closed.rcvd_then_sent or closed.sent is None else closed.sent
    if frame is None:
        return ""
    return f"{'it' if frame is closed.rcvd else 'the server'} closed with {frame}"
