"""A Ray of its own with a fleet of fake policies, as a process that tests command: a line in, a line out, both JSON.

    {"do": "deploy", "generation": 2}     replace the replicas by those of another generation
    {"do": "deploy", "generation": null}  by some that can't start
                                          (with "autoscaling": as many as Ray Serve thinks right)
    {"do": "room", "replicas": 2}         whether that many GPUs are free
    {"do": "build", "arguments": {…}}     the application of `serve run`, behind Ray Serve's proxy

The answer has "error" and its "text" if something was raised. The first line out has the addresses.
"""

import json
import os
import socket
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from turbopi.realtime.running_chunk import RunningChunk
from turbopi.serve import running
from turbopi.serve.fleet import fleet
from turbopi.serve.fleet.ray_app import build
from turbopi.support.errors import CheckpointError, DeviceLost, ObservationError, TurboPiError

NAME, HORIZON = "fakes", 10


class FakePolicy:
    """Says which process answered. The prompt "hold FILE" waits until FILE.go is there, once it has made FILE."""

    def __init__(self, generation: int | None) -> None:
        if generation is None:
            raise CheckpointError("the weights are damaged: nothing to be done")
        self.generation = generation
        real_time = {"modes": ["rtc"], "trained_max_delay": 0, "execution_horizon": None}
        self.metadata: dict[str, Any] = {"policy": "fake", "action_horizon": HORIZON, "real_time": real_time}

    def infer(
        self, obs: dict[str, Any], *, previous: RunningChunk | None = None, model_actions: bool = False
    ) -> dict[str, Any]:
        if "observation/state" not in obs:
            raise ObservationError("the key 'observation/state' is missing")
        what, _, name = str(obs.get("prompt", "")).partition(" ")
        if what == "hold":
            Path(name).write_text(str(os.getpid()))
            while not Path(f"{name}.go").exists():
                time.sleep(0.02)
        if what == "lost":
            raise DeviceLost("CUDA error: an illegal memory access was encountered")
        actions = np.tile(np.asarray(obs["observation/state"]), (HORIZON, 1))
        result = {"actions": actions, "pid": os.getpid(), "generation": self.generation}
        result["left_over"] = 0 if previous is None else len(previous.left_over)
        return result | ({"model_actions": actions.astype(np.float32)} if model_actions else {})


def deploy(generation: int | None, autoscaling: dict[str, Any] | None = None) -> None:
    replicas = 2 if autoscaling is None else None
    options = fleet.FleetOptions(NAME, "fake", replicas=replicas, cpus=0.25, autoscaling=autoscaling)
    fleet.deploy(fleet.replicas(partial(FakePolicy, generation), options, warm=None), NAME, report=lambda text: None)


def command(do: str, **given: Any) -> dict[str, Any]:
    if do == "deploy":
        deploy(**given)
    elif do == "room":
        fleet.check_capacity(fleet.FleetOptions("gpus", "gpus", replicas=given["replicas"], use_gpus=True))
    else:
        assert do == "build"
        fleet.import_ray()[1].run(build(given["arguments"]), name="whole", route_prefix="/")
    return {}


def say(**fields: Any) -> None:
    print(f"@{json.dumps(fields)}", flush=True)  # Ray writes here, too


def main() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        http = free.getsockname()[1]
    ray, serve = fleet.import_ray()
    os.environ.update(fleet.STARTED_HERE)
    ray.init(address="local", num_cpus=4, include_dashboard=False, object_store_memory=fleet.OBJECT_STORE_BYTES)
    assert not fleet.connect()
    serve.start(proxy_location="HeadOnly", http_options={"port": http}, logging_config=fleet.QUIET)
    deploy(1)
    policies = fleet.Fleet.attach(NAME)
    with running(policies, calls=policies.calls) as server:
        cluster = ray.get_runtime_context().gcs_address
        say(url=server.url, proxy=f"ws://127.0.0.1:{http}", port=server.port, http=http, cluster=cluster)
        for line in sys.stdin:
            try:
                say(**command(**json.loads(line)))
            except TurboPiError as error:
                say(error=type(error).__name__, text=str(error))
    ray.shutdown()


if __name__ == "__main__":
    main()
