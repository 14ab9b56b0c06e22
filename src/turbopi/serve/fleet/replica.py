"""One replica of a fleet: a policy on a GPU of its own, as Ray Serve starts it. It knows neither Ray nor robots.

The server in front of the replicas (fleet.py) has read and checked a robot's message, and knows its running chunk; a
replica computes one chunk of actions and remembers nothing. So any replica may answer any request, and one that ends
takes nothing along but the requests that it had.
"""

import asyncio
import logging
import os
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from turbopi.serve.calls import Policy, PolicyCalls
from turbopi.serve.metrics import Metrics
from turbopi.serve.options import ServerOptions
from turbopi.serve.requests import Result
from turbopi.serve.scheduling.schedule import Priority, Request

logger = logging.getLogger(__name__)

DEVICE_LOST = 4  # the exit code, as of `turbopi serve`
LOST_NOTICE = 0.5  # seconds from the device's loss to the end, in which the answer that tells of it is sent


@dataclass(frozen=True)
class Line:
    """What a replica's line goes by, of a `schedule.Request`: its times are counted from its arrival here.

    within  seconds to its deadline
    source  the client
    """

    within: float = ServerOptions.deadline_ms / 1e3
    firm: bool = False
    priority: Priority = "robot"
    source: str = ""
    alone: bool = False

    @classmethod
    def of(cls, request: Request, now: float) -> "Line":
        return cls(request.deadline - now, request.firm, request.priority, str(request.source), request.alone)

    def request(self, now: float) -> Request:
        return Request(now, now + self.within, self.firm, self.priority, self.source, alone=self.alone)


@dataclass(frozen=True)
class Answer:
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
