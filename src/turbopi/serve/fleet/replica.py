"""One replica of a fleet: a policy on a GPU of its own, as Ray Serve starts it. It knows neither Ray nor robots.

The server in front of the replicas (fleet.py) has read and checked a robot's message, and knows its running chunk; a
replica gets the message as it came (channel.py), computes one chunk of actions and remembers nothing. So any replica
may answer any request, and one that ends takes nothing along but the requests that it had.
"""

import asyncio
import logging
import os
import secrets
import socket
import time
import traceback
from collections.abc import Callable, Hashable, Mapping
from functools import lru_cache, partial
from typing import Any, NamedTuple

from turbopi.realtime.messages import PREFIX
from turbopi.realtime.wire import Unpacker
from turbopi.serve.calls import Policy, PolicyCalls
from turbopi.serve.fleet.channel import READ_BYTES, Place, messages, prove, send
from turbopi.serve.metrics import Metrics
from turbopi.serve.options import ServerOptions
from turbopi.serve.requests import Result
from turbopi.serve.scheduling.schedule import Priority, Request

logger = logging.getLogger(__name__)

DEVICE_LOST = 4  # the exit code, as of `turbopi serve`
LOST_NOTICE = 0.5  # seconds from the device's loss to the end, in which the answer that tells of it is sent
MOST_UNPACKERS = 256  # of clients' messages
DRAIN_LOOKS = 0.05  # seconds between two looks at who is left
CLOSING = -1  # in place of a request's number: send no more here, and close when all is answered


class Line(NamedTuple):
    """What a replica's line goes by, of a `schedule.Request`: its times are counted from its arrival here.

    within  seconds to its deadline
    source  the client
    """

    within: float = ServerOptions.deadline_ms / 1e3
    firm: bool = False
    priority: Priority = "robot"
    source: Hashable = ""
    alone: bool = False

    @classmethod
    def of(cls, request: Request, now: float) -> "Line":
        return cls(request.deadline - now, request.firm, request.priority, request.source, request.alone)

    def request(self, now: float) -> Request:
        return Request(now, now + self.within, self.firm, self.priority, self.source, alone=self.alone)


class Answer(NamedTuple):
    """What a replica answers to one request.

    replica     host:pid of its process
    checkpoint  the name of the weights that it runs
    seconds     the request was there, waiting included
    result      of its observation
    """

    replica: str
    checkpoint: str
    seconds: float
    result: Result


def end_process() -> None:
    """A GPU that failed for good serves nobody again in this process: Ray Serve starts another one."""
    os._exit(DEVICE_LOST)


class Replica:
    """One policy, and the line in front of it.

    make_policy  called once, on this machine; what it raises, Ray Serve shows as the reason why the replica can't start
    checkpoint   the name of its weights, for people
    warm         arguments of the policy's `warmup`, which ends before the first request; None: no warm-up
    options      of these, what the line and the batches here go by
    started_with the options of its start, for the command that replaces it (cli/fleet_update.py)
    """

    async def __init__(  # type: ignore[misc]  # Ray Serve awaits it
        self,
        make_policy: Callable[[], Policy],
        checkpoint: str,
        warm: Mapping[str, Any] | None,
        options: ServerOptions,
        end: Callable[[], None] = end_process,
        started_with: Mapping[str, Any] | None = None,
    ) -> None:
        self.name = f"{socket.gethostname()}:{os.getpid()}"
        self._checkpoint, self._end, self._started_with = checkpoint, end, started_with
        self._loop = asyncio.get_running_loop()
        self._lost: str | None = None
        self._listening: asyncio.Server | None = None
        # Of each server in front, by the number that it gave them.
        self._requests: dict[asyncio.StreamWriter, dict[int, asyncio.Task[None]]] = {}
        self._unpacker_of = lru_cache(maxsize=MOST_UNPACKERS)(lambda source: Unpacker())
        self._policy = await asyncio.to_thread(make_policy)
        self._calls = PolicyCalls(self._policy, options, Metrics(), on_lost=self._lose)
        if warm is not None:
            await self._calls.warm_up(**warm)

    async def about(self) -> dict[str, Any]:
        """The policy's metadata."""
        return self._policy.metadata

    async def started_with(self) -> dict[str, Any]:
        """The options of its start; empty if they aren't known."""
        return dict(self._started_with or {})

    async def infer(
        self, observation: dict[str, Any], arguments: Mapping[str, Any], line: Line | None = None
    ) -> Answer:
        """One request; `arguments` are those of the policy's `infer` besides the observation."""
        began = time.perf_counter()
        request = (line or Line()).request(began)
        (result,) = await self._calls.submit(request, observation, arguments)
        return Answer(self.name, self._checkpoint, time.perf_counter() - began, result)

    # --- servers in front ---------------------------------------------------------------------------------------------

    async def record_replica_metadata(self) -> dict[str, Any]:
        """Ray Serve calls this once, before requests come, and tells its routers (ray_router.py): a `Place`."""
        import ray

        return (await self.listen(ray.util.get_node_ip_address()))._asdict()

    async def listen(self, host: str) -> Place:
        """Take servers' connections, at any port of that address."""
        secret = secrets.token_hex(32)
        serve = partial(self._serve, secret)
        self._listening = await asyncio.start_server(serve, host, 0, limit=READ_BYTES)
        return Place(host, self._listening.sockets[0].getsockname()[1], secret)

    def record_autoscaling_stats(self) -> dict[str, float]:
        """Ray Serve asks now and then: it doesn't see these requests."""
        return {"requests": sum(map(len, self._requests.values()))}

    def __del__(self) -> Any:
        """Ray Serve calls this before it ends the process, and awaits it."""
        return None if getattr(self, "_listening", None) is None else self.drain()

    async def drain(self) -> None:
        """Wait until each server has its answers and has left: it sends no more."""
        assert self._listening is not None
        self._listening.close()
        self._listening = None
        for server in self._requests:
            send(server, (CLOSING, None))
        while self._requests:
            await asyncio.sleep(DRAIN_LOOKS)

    async def _serve(self, secret: str, reader: asyncio.StreamReader, server: asyncio.StreamWriter) -> None:
        """One server in front. It sends a request, its arguments and its line, or the number alone to give it up."""
        requests = self._requests[server] = {}
        try:
            await prove(reader, server, secret, 1)
            async for (number, *request), message in messages(reader):
                if request:
                    task = asyncio.ensure_future(self._answer(server, number, message, *request))
                    requests[number] = task
                    task.add_done_callback(partial(_forget, requests, number))
                elif number in requests:
                    requests[number].cancel()
        except ConnectionError:
            logger.warning("somebody who isn't a server of this fleet connected")
        finally:
            server.close()
            del self._requests[server]
            for task in requests.values():
                task.cancel()

    async def _answer(
        self, server: asyncio.StreamWriter, number: int, message: bytes, arguments: Mapping[str, Any], line: Line
    ) -> None:
        began = time.perf_counter()
        try:
            received = self._unpacker_of(line.source).unpack(message, max_bytes=len(message))
            observation = {key: value for key, value in received.items() if not key.startswith(PREFIX)}
            send(server, (number, await self.infer(observation, arguments, line)))
        except Exception:  # such as an answer that can't be pickled
            seconds = time.perf_counter() - began
            failed = Result(seconds, error="policy", text=traceback.format_exc())
            send(server, (number, Answer(self.name, self._checkpoint, seconds, failed)))

    def check_health(self) -> None:
        """Ray Serve calls this now and then, and replaces the replica when this raises."""
        if self._lost is not None:
            raise RuntimeError(f"the device is lost: {self._lost}")

    def _lose(self, reason: str) -> None:
        """On the policy's thread: the device failed for good."""
        if self._lost is None:
            self._lost = reason
            logger.error("the device is lost, and this replica ends: %s", reason)
            self._loop.call_soon_threadsafe(self._loop.call_later, LOST_NOTICE, self._end)


def _forget(requests: dict[int, Any], number: int, task: object) -> None:
    del requests[number]
