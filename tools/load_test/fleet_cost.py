"""What a fleet's server in front costs: its CPU time for each request, with replicas that sleep like a GPU (stand_in).

    PYTHONPATH=src:tools python -m load_test.fleet_cost --clients 1 8 16

This process is the server, and starts a Ray with the replicas; clients are processes of their own. A line for each
number of clients: answers a second, the median and 99th percentile of a request in ms, and the server's CPU in ms.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from load_test.stand_in import GPUS, make_policy
from turbopi.serve import PolicyServer, running
from turbopi.serve.fleet import fleet

NAME = "stand-ins"


def answered(server: PolicyServer) -> float:
    """Requests so far."""
    samples = [sample for metric in server.metrics.request_seconds.collect() for sample in metric.samples]
    return sum(sample.value for sample in samples if sample.name.endswith("_count"))


def measure(server: PolicyServer, clients: int, load: Sequence[str]) -> str:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "load.json"
        before, used = answered(server), time.process_time()
        command = [sys.executable, "-m", "load_test", server.url, "--clients", str(clients), "--out", str(file), *load]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        used = (time.process_time() - used) / (answered(server) - before)
        said = json.loads(file.read_text())
    latency, rate = said["latency_ms"], said["answered"] / said["load"]["seconds"]
    times = f"p50 {latency['p50']:5.1f} p99 {latency['p99']:5.1f} ms"
    return f"{clients:3} clients: {rate:5.1f} a second, {times}, CPU of the server {used * 1e3:.2f} ms a request"


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m load_test.fleet_cost",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--gpu", choices=sorted(GPUS), default="h100_bf16", help="whose times")
    parser.add_argument("--replicas", type=int, default=2)
    parser.add_argument("--clients", type=int, nargs="+", default=[8, 16])
    given, load = parser.parse_known_args()  # the others are load_test's
    fleet.connect()
    options = fleet.FleetOptions(NAME, NAME, replicas=given.replicas, cpus=0.25, use_gpus=False)
    fleet.deploy(fleet.replicas(partial(make_policy, given.gpu), options, warm={}), NAME, report=print)
    policies = fleet.Fleet.attach(NAME)
    with running(policies, calls=policies.calls) as server:
        for clients in given.clients:
            print(measure(server, clients, load), flush=True)
    fleet.delete(NAME)
    fleet.disconnect()


if __name__ == "__main__":
    main()
