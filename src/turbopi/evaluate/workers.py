"""Worker processes: each holds one simulator. A crash of one, even of its whole process, costs one episode."""

import contextlib
import multiprocessing
import os
import signal
import sys
import time
import traceback
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from turbopi.evaluate.plan import Job
from turbopi.evaluate.real_time import Unfit
from turbopi.evaluate.worker import Stopped, Worker, WorkerSetup
from turbopi.sim import SimulatorUnavailable

LOG = "workers.log"
_CLOSE_S = 5.0  # for a worker to end by itself


class WorkerHandle:
    """The scheduler's end of one worker."""

    def __init__(self, setup: WorkerSetup) -> None:
        context = multiprocessing.get_context("spawn")  # OpenGL and CUDA survive no fork
        self.connection, child = context.Pipe()
        self.process = context.Process(target=_main, args=(child, setup), daemon=True)
        with _ctrl_c_ignored():  # the child inherits it: Ctrl-C is the scheduler's business
            self.process.start()
        child.close()
        self.job: Job | None = None
        self.task: int | None = None  # whose environment it holds
        self.started = self.heard = time.monotonic()

    def begin(self, job: Job) -> None:
        self.job, self.task = job, job.task.index
        self.started = self.heard = time.monotonic()
        with contextlib.suppress(OSError):  # it died meanwhile; that is the next thing to `receive` from it
            self.connection.send(("episode", job))

    def receive(self) -> tuple[Any, ...]:
        """The next message; ("died", exit code) if the process is gone."""
        try:
            message: tuple[Any, ...] = self.connection.recv()
        except (EOFError, OSError):
            self.process.join(_CLOSE_S)
            return ("died", self.process.exitcode)
        self.heard = time.monotonic()
        return message

    def kill(self) -> None:
        self.process.kill()
        self.process.join()
        self.connection.close()

    def close(self) -> None:
        """End it: politely, then not."""
        with contextlib.suppress(OSError):
            self.connection.send(("stop",))
        self.process.join(_CLOSE_S)
        if self.process.is_alive():
            self.kill()
        else:
            self.connection.close()


def _main(connection: Connection, setup: WorkerSetup) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _write_output_to(Path(setup.folder) / LOG)
    worker = Worker(connection, setup)
    with contextlib.suppress(EOFError, BrokenPipeError, Stopped):  # the scheduler has gone, or wants no more
        while (message := connection.recv())[0] == "episode":
            _run(worker, connection, message[1])
    with contextlib.suppress(Exception):  # nothing depends on it any more
        worker.forget()


def _run(worker: Worker, connection: Connection, job: Job) -> None:
    start = time.perf_counter()
    try:
        worker.run(job)
    except (Stopped, EOFError, BrokenPipeError):
        raise
    except SimulatorUnavailable as error:
        connection.send(("unavailable", str(error)))
    except Unfit as unfit:
        connection.send(("unfit", str(unfit)))
    except Exception:
        text = traceback.format_exc()
        print(text, file=sys.stderr, flush=True)
        connection.send(("crashed", text, time.perf_counter() - start))
        try:
            worker.forget()
        except Exception:
            traceback.print_exc()  # into the log; the environment is dropped all the same


def _write_output_to(log: Path) -> None:
    """Simulators print, and their C libraries too: all of it goes to a file, not through the progress bar."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, "ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)


@contextlib.contextmanager
def _ctrl_c_ignored() -> Iterator[None]:
    try:
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    except ValueError:  # not in the main thread, where signals don't arrive anyway
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
