"""A robot's side: actions at the control rate while a policy computes, without PyTorch.

    with RealTimeExecutor(policy, control_hz=50, execution="rtc") as executor:
        executor.warm_up(robot.observation())
        while robot.running():                             # at 50 Hz
            executor.observe(robot.observation())          # from any thread
            command = executor.next_action()               # never waits for the policy
            if command.action is not None:
                robot.send(command.action)
    executor.report(plot="run.png")

`RealTimeClient` is a policy behind `turbopi serve`. Below both, without threads or clocks, `ChunkQueue` joins chunks:

    queue = ChunkQueue("rtc", execution_horizon=5, delay=2)
    for every control step:
        if the policy has answered:
            queue.arrive(result)
        if queue.wants_observation:
            request = queue.observe()                              # the observation is taken now
            begin policy.infer(observation, **request.arguments)   # with a delay of 0, its result arrives here
        action = queue.next_action()                               # None: there is none, the robot holds

All counts are control steps. docs/real_time.md says when to take which way. Needs NumPy, matplotlib for the plot, and
websockets and msgpack for the client: each name is imported when it is used.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from turbopi.realtime.client import RealTimeClient, ServerLost, ServerRefused
    from turbopi.realtime.delays import DelayEstimate
    from turbopi.realtime.executor import RealTimeExecutor
    from turbopi.realtime.journal import Command, Inferred, OutOfActions
    from turbopi.realtime.queue import Action, ChunkQueue, Request, Seam
    from turbopi.realtime.running_chunk import RunningChunk
    from turbopi.realtime.ways import WAYS, Execution, Way, way_named

__all__ = [
    "WAYS",
    "Action",
    "ChunkQueue",
    "Command",
    "DelayEstimate",
    "Execution",
    "Inferred",
    "OutOfActions",
    "RealTimeClient",
    "RealTimeExecutor",
    "Request",
    "RunningChunk",
    "Seam",
    "ServerLost",
    "ServerRefused",
    "Way",
    "way_named",
]

_MODULES = {
    **dict.fromkeys(("RealTimeClient", "ServerLost", "ServerRefused"), "client"),
    "DelayEstimate": "delays",
    "RealTimeExecutor": "executor",
    **dict.fromkeys(("Command", "Inferred", "OutOfActions"), "journal"),
    **dict.fromkeys(("Action", "ChunkQueue", "Request", "Seam"), "queue"),
    "RunningChunk": "running_chunk",
    **dict.fromkeys(("WAYS", "Execution", "Way", "way_named"), "ways"),
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found: object = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    return found
