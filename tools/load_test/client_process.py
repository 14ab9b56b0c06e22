"""A process of clients, a thread each. `run.py` starts it, maybe with another interpreter, so it imports little.

It gets a job (JSON) as its argument's file, says "ready" when its clients are connected, begins when a line comes, and
writes what became of the requests to the job's `out`.
"""

import json
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from load_test.connections import Kind, connect, read_observation
from load_test.schedule import Arrivals, Clock, Request, closed_loop, due_times, open_loop

BEGIN_S = 0.2  # from the line to the beginning: by then all processes have theirs


@dataclass(frozen=True)
class Job:
    """What the clients of one process do.

    clients     their numbers, of `of` in all
    rate        requests a second of all `of` clients together; nothing in a closed loop
    until_s     from the beginning; requests that are due then are still sent up to `end_s`
    observations  files, several a client
    """

    url: str
    kind: Kind
    answer_s: float
    arrivals: Arrivals
    clients: list[int]
    of: int
    rate: float
    until_s: float
    end_s: float
    seed: int
    observations: dict[str, list[str]]  # by client
    out: str

    def text(self) -> str:
        return json.dumps(asdict(self))


def page_faults() -> int:
    """Of this process so far; 0 where the system doesn't say."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt


def main() -> None:
    job = Job(**json.loads(Path(sys.argv[1]).read_text()))
    key = json.loads(sys.stdin.readline())  # not on the command line, nor in a file
    connections = {client: connect(job.kind, job.url, key, job.answer_s) for client in job.clients}
    observations = {
        client: [read_observation(job.kind, Path(file)) for file in job.observations[str(client)]]
        for client in job.clients
    }
    requests: dict[int, list[Request]] = {client: [] for client in job.clients}
    print("ready", flush=True)
    sys.stdin.readline()
    begin = time.perf_counter() + BEGIN_S
    clock = Clock(lambda: time.perf_counter() - begin, time.sleep)

    def drive(client: int) -> None:
        connection, given = connections[client], observations[client]
        clock.sleep(max(0.0, -clock.now()))
        made: Iterator[Request]
        if job.arrivals == "closed":
            made = closed_loop(connection, given, job.until_s, clock)
        else:
            due = due_times(job.arrivals, job.rate, job.until_s, client, job.of, job.seed)
            made = open_loop(connection, given, due, job.end_s, clock)
        requests[client].extend(made)

    threads = [threading.Thread(target=drive, args=(client,)) for client in job.clients]
    used, faults = time.process_time(), page_faults()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    wall = max(clock.now(), 1e-9) + BEGIN_S
    use = {"cpu_share": (time.process_time() - used) / wall, "page_faults": page_faults() - faults}
    Path(job.out).write_text(json.dumps({"use": use, "requests": {str(c): made for c, made in requests.items()}}))
    for connection in connections.values():
        connection.close()


if __name__ == "__main__":
    main()
