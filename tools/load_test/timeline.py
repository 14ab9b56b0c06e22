"""Where the time of a served call goes, in client and server, both on this host. From the repository:

    export PYTHONPATH=src:tools
    python -m load_test.timeline --out no_time.json                          a policy that takes no time
    python -m load_test.timeline --work 7 --client openpi --python .venv-openpi-client/bin/python
    python -m load_test.timeline -- turbopi serve --random-weights pi05_libero --backend fused --precision bf16

It starts the server (the words behind `--` are a module and its arguments, to which it adds --port) and one client in a
closed loop. Functions of both note when they begin and end (marks.py); an item is what passes between two marks. Noting
itself takes some 10 us of a call. Items are medians of their own, so their sum is not exactly the latency.
"""

import argparse
import json
import math
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from msgspec import Struct
from rich.console import Console
from rich.table import Table

from load_test.document import COLUMNS, Spread
from load_test.marks import MARKS, Noted
from load_test.observations import image_size, observations
from load_test.run import HERE
from turbopi.realtime.client import RealTimeClient, ServerLost
from turbopi.realtime.wire import pack
from turbopi.support.errors import ConfigError, TurboPiError
from turbopi.support.files import write_whole
from turbopi.support.provenance import Provenance, provenance
from turbopi.support.reading import plain_document

WARM_UP = 50  # calls that aren't counted
START_S = 900.0  # until the server takes connections


class Item(Struct, frozen=True):
    """What passes up to a mark, in microseconds. calls: that passed it, of all."""

    name: str
    process: Literal["client", "server"]
    p50: float
    p90: float
    calls: int


class TimelineDocument(Struct, frozen=True, kw_only=True):
    """A timeline; milliseconds but for the items. beside_ms: latency without `infer_ms`, call by call."""

    kind: Literal["turbopi-timeline"]
    provenance: Provenance
    command: list[str]
    client: Literal["turbopi", "openpi"]
    calls: int
    message_bytes: int
    latency_ms: Spread
    infer_ms: Spread
    beside_ms: Spread
    items: list[Item]


def items(client: Noted, server: Noted) -> list[Item]:
    """The items of the calls that the client made, one at a time; the first WARM_UP aren't counted."""
    marks = {mark.name: mark for mark in MARKS[1:]}
    spans: dict[str, list[float]] = {name: [] for name in marks}
    moments = {"client": client, "server": server}
    for begin, end in list(zip(client["begin"], client["end"], strict=True))[WARM_UP:]:
        before, left = begin, list(marks.values())
        while left:
            nexts = [_next(moments[mark.process].get(mark.name, []), before, end) for mark in left]
            first = min(range(len(left)), key=nexts.__getitem__)  # those in front of it aren't on this call's way
            spans[left[first].name].append(1e6 * (nexts[first] - before))
            before, left = nexts[first], left[first + 1 :]
    found = [(mark, Spread.of(spans[name]), len(spans[name])) for name, mark in marks.items()]
    return [
        Item(mark.item, mark.process, round(spread.p50, 1), round(spread.p90, 1), calls)
        for mark, spread, calls in found
        if spread is not None
    ]


def _next(moments: Sequence[float], before: float, end: float) -> float:
    """The first of the moments from `before` on; infinite if there is none up to the end."""
    place = bisect_left(moments, before)
    return moments[place] if place < len(moments) and moments[place] <= end else math.inf


def run(given: argparse.Namespace, command: Sequence[str]) -> TimelineDocument:
    """Raises ConfigError for a server or a client that ends too soon."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    url = f"ws://127.0.0.1:{port}"
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        out = {process: folder / f"{process}.json" for process in ("client", "server")}
        job = {"port": port, "words": given.server, "work_s": given.work / 1e3, "out": str(out["server"])}
        server = _start(sys.executable, "server", job)
        try:
            metadata = _metadata(url, server)
            robot = given.robot or metadata.get("robot")
            if not isinstance(robot, str):
                raise ConfigError("the server's metadata names no robot: say with --robot what to send")
            made = observations(robot, None, given.camera_images, 1, 0)[1][0]
            files = [folder / f"{number}.msgpack" for number in range(len(made))]
            for file, observation in zip(files, made, strict=True):
                file.write_bytes(pack(observation))
            wanted = {"kind": given.client, "url": url, "api_key": None, "observations": [str(file) for file in files]}
            wanted |= {"calls": WARM_UP + given.calls, "out": str(out["client"])}
            if _start(given.python or sys.executable, "client", wanted).wait() != 0:
                raise ConfigError("the client failed: see above")
        finally:
            server.send_signal(signal.SIGTERM)
            server.wait()
        noted = {process: json.loads(file.read_text()) for process, file in out.items()}
    moments = noted["client"]["noted"]
    latency = [1e3 * (end - begin) for begin, end in zip(moments["begin"], moments["end"], strict=True)][WARM_UP:]
    infer = [1e3 * one for one in noted["client"]["infer_s"]][WARM_UP:]
    beside = [whole - policy for whole, policy in zip(latency, infer, strict=True)]
    return TimelineDocument(
        kind="turbopi-timeline",
        provenance=provenance(torch.device("cuda" if torch.cuda.is_available() else "cpu")),
        command=list(command),
        client=given.client,
        calls=given.calls,
        message_bytes=len(pack(made[0])),
        latency_ms=_rounded(latency),
        infer_ms=_rounded(infer),
        beside_ms=_rounded(beside),
        items=items(moments, noted["server"]["noted"]),
    )


def _rounded(milliseconds: Sequence[float]) -> Spread:
    spread = Spread.of(milliseconds)
    assert spread is not None
    return Spread(*(round(getattr(spread, name), 4) for name in spread.__struct_fields__))


def _start(python: str, process: str, job: Mapping[str, Any]) -> "subprocess.Popen[bytes]":
    path = os.pathsep.join((str(HERE / "tools"), str(HERE / "src"), os.environ.get("PYTHONPATH", "")))
    words = [python, "-m", "load_test.marks", process, json.dumps(job)]
    return subprocess.Popen(words, env={**os.environ, "PYTHONPATH": path.rstrip(os.pathsep)}, stdout=2)  # to stderr


def _metadata(url: str, server: "subprocess.Popen[bytes]") -> Mapping[str, Any]:
    """The server's, once it takes connections."""
    for _ in range(int(START_S / 0.5)):
        if server.poll() is not None:
            break
        try:
            with RealTimeClient(url) as probe:
                return probe.metadata
        except ServerLost:
            time.sleep(0.5)
    raise ConfigError("the server didn't take connections: see above")


def table(document: TimelineDocument) -> Table:
    """For people: an item a line."""
    about = f"{document.client} client, {document.calls} calls, {document.message_bytes} bytes"
    shown = Table("us", "where", "p50", "p90", title=about)
    for column in shown.columns[2:]:
        column.justify = "right"
    for item in document.items:
        shown.add_row(item.name, item.process, f"{item.p50:.0f}", f"{item.p90:.0f}")
    for name in ("latency", "infer", "beside"):
        spread: Spread = getattr(document, f"{name}_ms")
        shown.add_row(f"{name}, ms (p99 {spread.p99:.2f})", "", f"{spread.p50:.3f}", f"{spread.p90:.3f}")
    return shown


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m load_test.timeline", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("server", nargs="*", metavar="-- MODULE WORD …", help="default: a policy of no time")
    parser.add_argument("--client", choices=("turbopi", "openpi"), default="turbopi")
    parser.add_argument("--python", metavar="FILE", help="the client's interpreter, such as one with openpi-client")
    parser.add_argument("--calls", type=int, default=1000, metavar="N", help=f"that are counted, behind {WARM_UP}")
    parser.add_argument("--work", type=float, default=0.0, metavar="MS", help="that the policy of no time sleeps")
    parser.add_argument("--robot", help="whose observations; default: as the server's metadata says")
    parser.add_argument("--images", dest="camera_images", type=image_size, metavar="WxH", help="default: 224x224")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the timeline here (JSON)")
    given = parser.parse_args(arguments)
    try:
        command = ["python", "-m", "load_test.timeline", *(sys.argv[1:] if arguments is None else arguments)]
        document = run(given, command)
        if given.out is not None:
            write_whole(given.out, (json.dumps(plain_document(document)) + "\n").encode())
    except TurboPiError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    Console(width=COLUMNS).print(table(document), markup=False, highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
