"""What is done beside the stages, in a second process: the rival, made and warm.

Compiling it takes as long as all stages before the race. Where the second process can't, for whatever reason, the first
one makes the rival when it comes to it, and finds the reason.
"""

import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import IO, Final

import msgspec
import torch
from msgspec import Struct

from turbopi.backends.qualifying import Request
from turbopi.qualify.stages import Figures, Subject, Turn, rival_turn

ARGUMENT: Final = "--ahead"  # of `python -m turbopi.qualify`
PATIENCE = 30.0  # seconds at most that the first process waits for the second


def _command() -> list[str]:
    return [sys.executable, "-m", "turbopi.qualify", ARGUMENT]


class Answer(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A line of what the second process says: first that the rival is warm, then a turn for each line that it reads."""

    turn: Figures | None = None


class Ahead:
    """The second process, as the first one sees it. It ends when its input does."""

    def __init__(self, request: Request) -> None:
        self._answers: SimpleQueue[bytes | None] = SimpleQueue()
        self._warm = False
        pipe = subprocess.PIPE
        self._process: subprocess.Popen[bytes] | None = subprocess.Popen(_command(), stdin=pipe, stdout=pipe)
        threading.Thread(target=self._listen, args=(self._process.stdout,), daemon=True).start()
        self._write(msgspec.json.encode(request))

    def rival(self) -> Turn | None:
        """What measures a turn of the rival; None: it has to be made here."""
        self._warm = self._warm or self._next() is not None
        return self._turn if self._warm and self._process is not None else None

    def stop(self) -> bool:
        """End it, which frees its memory. Whether there was one."""
        process, self._process = self._process, None
        if process is None:
            return False
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout):
            with suppress(OSError):
                assert stream is not None
                stream.close()
        return True

    def _turn(self) -> Figures:
        self._write(b"turn")
        answer = self._next()
        if answer is None or answer.turn is None:  # as processes do for want of memory
            raise torch.OutOfMemoryError("the other backend's process ended")
        return answer.turn

    def _next(self) -> Answer | None:
        """None: it ended, or is ended as it says nothing."""
        with suppress(Empty):
            line = self._answers.get(timeout=PATIENCE if self._process is not None else 0.0)
            if line is not None:
                return msgspec.json.decode(line, type=Answer)
        self.stop()
        return None

    def _write(self, line: bytes) -> None:
        if self._process is None or self._process.stdin is None:
            return
        with suppress(OSError):  # then it says nothing, either
            self._process.stdin.write(line + b"\n")
            self._process.stdin.flush()

    def _listen(self, stream: IO[bytes]) -> None:
        with suppress(OSError, ValueError):
            for line in stream:
                self._answers.put(line)
        self._answers.put(None)


def work(subject: Subject, say: Callable[[Answer], None], requests: IO[bytes]) -> None:
    """What the second process does, until nobody wants more."""
    if subject.rival is None:
        return
    turn = rival_turn(subject)
    turn()
    say(Answer())
    for _ in requests:
        say(Answer(turn=turn()))
