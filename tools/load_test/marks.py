"""One process of a timeline: the client, or the server. `timeline.py` starts it; it imports little.

It wraps the functions that a served call passes through, so that each notes when it begins or ends, and writes what was
noted as JSON. `time.perf_counter` is one clock for all processes of a Linux host.
"""

import functools
import importlib
import json
import runpy
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple


class Mark(NamedTuple):
    """The moment at which `function` begins (or ends) in a process; `item` is what passes since the mark before."""

    name: str
    process: Literal["client", "server"]
    function: str  # module:name
    begins: bool
    item: str


# In the order in which one call passes them. A call without one of them leaves it out.
MARKS = (
    Mark("begin", "client", "load_test.marks:infer", True, ""),
    Mark("packed", "client", "websockets.sync.connection:Connection.send", True, "pack"),
    Mark("packed", "client", "turbopi.realtime.policy_socket:PolicySocket.ask", True, "pack"),
    Mark("written", "client", "turbopi.realtime.policy_socket:_Stream.send", True, "write into shared memory"),
    Mark("written", "client", "turbopi.realtime.policy_socket:_Stream.ring", True, "write into shared memory"),
    Mark("masked", "client", "websockets.frames:apply_mask", False, "mask"),
    Mark("masked", "client", "turbopi.realtime.policy_socket:binary_head", False, "mask"),
    Mark("woken", "server", "turbopi.serve.connection:GuardedConnection.buffer_updated", True, "wake the server"),
    Mark("received", "server", "websockets.frames:apply_mask", True, "receive"),
    Mark("unmasked", "server", "websockets.frames:apply_mask", False, "unmask"),
    Mark("copied", "server", "turbopi.realtime.shared_memory:SharedSlots.message", False, "out of shared memory"),
    Mark("taken", "server", "turbopi.serve.requests:RequestHandler.begin", True, "event loop, to the request"),
    Mark("decoded", "server", "turbopi.serve.requests:decode", False, "parse"),
    Mark("submitted", "server", "turbopi.serve.worker:Worker._put", True, "read, schedule"),
    Mark("turn", "server", "turbopi.serve.calls:PolicyCalls._run_turn", True, "hand over to the policy's thread"),
    Mark("asked", "server", "turbopi.serve.calls:PolicyCalls._result", True, "begin the turn"),
    Mark("launch", "server", "turbopi.engine.graph:Graph.launch", True, "infer: to the first launch"),
    Mark("model", "server", "turbopi.policy.model_call:ModelCall.run", False, "infer: to the model's end"),
    Mark("inferred", "server", "turbopi.serve.calls:PolicyCalls._result", False, "infer: to its end"),
    Mark("answered", "server", "turbopi.serve.requests:RequestHandler._answer", True, "hand over, to the answer"),
    Mark("made", "server", "turbopi.serve.requests:pack", False, "answer, pack"),
    Mark("made", "server", "turbopi.serve.server:pack", False, "answer, pack"),
    Mark("heard", "client", "websockets.sync.connection:Connection.process_event", True, "send, wake the client"),
    Mark("heard", "client", "websockets.protocol:Protocol.receive_data", True, "send, wake the client"),
    Mark("heard", "client", "turbopi.realtime.policy_socket:binary_message", True, "send, wake the client"),
    Mark("given", "client", "turbopi.realtime.policy_socket:PolicySocket.ask", False, "hand over to the caller"),
    Mark("given", "client", "websockets.sync.connection:Connection.recv", False, "hand over to the caller"),
    Mark("end", "client", "load_test.marks:infer", False, "unpack"),
)
Noted = dict[str, list[float]]  # moments by a mark's name


def infer(connection: Any, observation: Mapping[str, Any]) -> Mapping[str, Any]:
    """A call. Here so that it has its marks."""
    answer: Mapping[str, Any] = connection.infer(observation)
    return answer


def install(process: str) -> Noted:
    """Wrap the functions of a process's marks, before anything imports them; what they note from here on."""
    noted: Noted = {mark.name: [] for mark in MARKS if mark.process == process}
    functions = {mark.function for mark in MARKS if mark.process == process}
    for function in sorted(functions, key=lambda one: (not one.startswith("websockets"), one)):  # others import of it
        module, _, name = function.partition(":")
        try:
            owner: Any = importlib.import_module(module)
        except ImportError:  # the other client's, or no PyTorch
            continue
        *path, name = name.split(".")
        for part in path:
            owner = getattr(owner, part)
        own = [mark for mark in MARKS if mark.process == process and mark.function == function]
        begins, ends = ([noted[mark.name] for mark in own if mark.begins is when] for when in (True, False))
        setattr(owner, name, _noting(getattr(owner, name), begins, ends))
    return noted


def _noting(function: Callable[..., Any], begins: Sequence[list[float]], ends: Sequence[list[float]]) -> Any:
    @functools.wraps(function)
    def noting(*args: Any, **options: Any) -> Any:
        for moments in begins:
            moments.append(time.perf_counter())
        try:
            return function(*args, **options)
        finally:
            for moments in ends:
                moments.append(time.perf_counter())

    return noting


class NoTime:
    """A policy that takes no time, or sleeps for a model's."""

    reads_in_place = True

    def __init__(self, work_s: float) -> None:
        self.metadata: dict[str, Any] = {"policy": "no time", "robot": "libero", "action_horizon": 10}
        self._work_s = work_s

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        import numpy as np

        if self._work_s:
            time.sleep(self._work_s)
        return {"actions": np.zeros((10, 7)), "policy_timing": {"infer_ms": 0.0}}


def serve(port: int, words: Sequence[str], work_s: float) -> None:
    """A policy of no time, or what the words of a module and its arguments serve."""
    if words:
        sys.argv = [*words, "--port", str(port)]
        runpy.run_module(words[0], run_name="__main__", alter_sys=True)
        return
    from turbopi import serve

    serve.run(NoTime(work_s), port=port)


def call(job: Mapping[str, Any]) -> list[float]:
    """Calls, one after the other; the seconds in the policy of each that is counted, as the server says."""
    from load_test.connections import connect, read_observation

    connection = connect(job["kind"], job["url"], job["api_key"], 60.0)
    observations = [read_observation(job["kind"], Path(file)) for file in job["observations"]]
    found, here = [], sys.modules["load_test.marks"]
    for count in range(job["calls"]):
        answer = here.infer(connection, observations[count % len(observations)])
        found.append(float(answer["server_timing"]["infer_ms"]) / 1e3)
    connection.close()
    return found


def main() -> None:
    process, job = sys.argv[1], json.loads(sys.argv[2])
    importlib.import_module("load_test.marks")  # whose `infer` is wrapped, not that of __main__
    noted, inferred = install(process), list[float]()
    try:
        if process == "server":
            serve(job["port"], job["words"], job["work_s"])
        else:
            inferred = call(job)
    finally:
        Path(job["out"]).write_text(json.dumps({"noted": noted, "infer_s": inferred}))


if __name__ == "__main__":
    main()
