"""What this host alone takes to carry a request and its answer between two processes: a bare TCP socket, no Turbo-Pi.

    PYTHONPATH=src:tools python -m load_test.loopback --request 301500 --answer 3200 --work 7

The server reads all bytes of a request, sleeps `--work` milliseconds in the place of a model, and answers. What is left
of the latency is the host's own: sockets, wake-ups of two processes, and how late its timer is. No server can be
faster on this host, so it stands beside the overhead that `python -m load_test` finds.
"""

import argparse
import multiprocessing
import socket
import sys
import time
from collections.abc import Sequence

WARM_UP = 20  # round trips that aren't counted


def _read(connection: socket.socket, buffer: memoryview) -> bool:
    """Fill the buffer; False if the other side has ended the connection."""
    filled = 0
    while filled < len(buffer):
        if not (count := connection.recv_into(buffer[filled:])):
            return False
        filled += count
    return True


def serve(listener: socket.socket, request: int, answer: int, work_s: float) -> None:
    """Answer one connection until it ends."""
    connection, _ = listener.accept()
    with connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        buffer, reply = memoryview(bytearray(request)), bytes(answer)
        while _read(connection, buffer):
            if work_s:
                time.sleep(work_s)
            connection.sendall(reply)


def round_trips(request: int, answer: int, work_s: float, count: int) -> list[float]:
    """Seconds of `count` round trips less the work, behind WARM_UP others. request, answer: bytes, at least 1."""
    found = []
    with socket.create_server(("127.0.0.1", 0)) as listener:  # then the other process alone has it, and may end it
        context = multiprocessing.get_context("spawn")
        server = context.Process(target=serve, args=(listener, request, answer, work_s), daemon=True)
        server.start()
        connection = socket.create_connection(listener.getsockname()[:2])
    with connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        requested, buffer = bytes(request), memoryview(bytearray(answer))
        for i in range(WARM_UP + count):
            start = time.perf_counter()
            connection.sendall(requested)
            if not _read(connection, buffer):
                raise ConnectionError(f"the other process ended after {i} round trips")
            if i >= WARM_UP:
                found.append(time.perf_counter() - start - work_s)
    server.join()
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m load_test.loopback", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--request", type=int, default=301500, metavar="BYTES", help="default: two 224 x 224 images")
    parser.add_argument("--answer", type=int, default=3200, metavar="BYTES", help="default: ten actions")
    parser.add_argument("--work", type=float, default=0.0, metavar="MS", help="that the server sleeps for each request")
    parser.add_argument("--count", type=int, default=1000, metavar="N")
    given = parser.parse_args(arguments)
    if min(given.request, given.answer, given.count) < 1 or given.work < 0:
        parser.error("--request, --answer and --count must be at least 1, --work at least 0")
    from load_test.document import Spread  # not above: the other process needs nothing of it

    found = Spread.of([1e3 * one for one in round_trips(given.request, given.answer, given.work / 1e3, given.count)])
    assert found is not None, "at least one was counted"
    print(f"{given.count} round trips: median {found.p50:.3f} ms, p99 {found.p99:.3f} ms beside the work")
    return 0


if __name__ == "__main__":
    sys.exit(main())
