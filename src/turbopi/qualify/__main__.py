"""`python -m turbopi.qualify` reads a `Request` from standard input and writes `Event`s, one a line, to standard
output. With --ahead it is the process that works ahead of another one (ahead.py).
"""

import importlib
import os
import sys

import msgspec
import torch

from turbopi.backends import qualification
from turbopi.backends.qualifying import DOUBLE_VARIABLE, Event, Request
from turbopi.models import RANDOM
from turbopi.qualify.ahead import ARGUMENT, Ahead, Answer, work
from turbopi.qualify.run import run
from turbopi.qualify.stages import Subject
from turbopi.quantization.plan import TIERS


def main() -> int:
    events = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # what libraries print is no event
    request = msgspec.json.decode(sys.stdin.buffer.readline(), type=Request)
    network = next(type(one.model) for one in RANDOM.values() if one.model.kind == request.kind)
    if double := os.environ.get(DOUBLE_VARIABLE):  # a test's
        importlib.import_module(double)

    def say(one: Event | Answer) -> None:
        events.write(msgspec.json.encode(one) + b"\n")

    works_ahead = sys.argv[1:] == [ARGUMENT]
    subject = Subject(
        msgspec.convert(request.model, network),
        request.precision,
        torch.device("cuda", request.device),
        lambda what, path, quiet: None if works_ahead else say(Event(at=what, path=path, quiet=quiet)),
        request.excluded,
        rival=None if request.precision in TIERS else "cuda_graph",
    )
    if works_ahead:
        qualification.under_test = subject.excluded
        work(subject, say, sys.stdin.buffer)
        return 0
    return 0 if run(subject, say, Ahead(request)) else 1


if __name__ == "__main__":
    sys.exit(main())
