"""What a load test writes: one JSON document, and its table."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct, field
from rich.table import Table

from load_test.schedule import Arrivals, Request
from turbopi.support.errors import ConfigError
from turbopi.support.provenance import Provenance
from turbopi.support.reading import read_document

COLUMNS = 80  # that the table fits into
MAX_BYTES = 16 * 2**20
Count = Annotated[int, Meta(ge=0)]


class Spread(Struct, frozen=True):
    """Milliseconds."""

    mean: float
    min: float
    p50: float
    p90: float
    p95: float
    p99: float
    max: float

    @classmethod
    def of(cls, milliseconds: Sequence[float]) -> "Spread | None":
        """None of nothing."""
        if not milliseconds:
            return None
        values = np.asarray(milliseconds)
        p50, p90, p95, p99 = (float(np.percentile(values, p)) for p in (50, 90, 95, 99))
        return cls(float(values.mean()), float(values.min()), p50, p90, p95, p99, float(values.max()))


class Load(Struct, frozen=True, kw_only=True):
    """What was asked for.

    client      "turbopi": turbopi.realtime.client.RealTimeClient; "openpi": openpi-client; "bare": sends prepared bytes
    rate        requests a second of all clients together; None in a closed loop
    seconds     that were measured, after `warmup_seconds` that weren't
    robot       whose observations were sent, or the file of one
    images    the shapes of the images in one of them
    message_bytes  of one
    """

    url: str
    client: Literal["turbopi", "openpi", "bare"]
    arrivals: Arrivals
    clients: Annotated[int, Meta(ge=1)]
    processes: Annotated[int, Meta(ge=1)]
    rate: Annotated[float, Meta(gt=0)] | None
    seconds: Annotated[float, Meta(gt=0)]
    warmup_seconds: Annotated[float, Meta(ge=0)]
    seed: int
    robot: str
    camera_images: list[tuple[int, int, int]] = field(name="pictures")
    message_bytes: int


class ProcessUse(Struct, frozen=True):
    """How busy a process of clients was: 1.0 is a whole CPU. Page faults of all its requests; 0 where unknown."""

    cpu_share: float
    page_faults: Count


class Clients(Struct, frozen=True, kw_only=True):
    """How much the clients themselves may have distorted the result.

    load_average  of the last minute, before and after; None where the system doesn't say
    """

    processes: list[ProcessUse]
    cpus: int
    load_average: tuple[float, float] | None


class OneClient(Struct, frozen=True):
    answered: Count
    latency_ms: Spread | None


class LoadDocument(Struct, frozen=True, kw_only=True):
    """A load test. Only requests that were due after the warm-up count.

    kind        tells these documents from others
    provenance  of the clients' machine
    server      the metadata that it sends; says its backend, precision, device
    requests    that were due
    answered    those that got actions; the spreads are theirs, but for `unsent`
    errors      the others', by kind
    unsent      due, but the end came while their connection still waited for the answer before: the server doesn't
                keep up with the rate. In `latency_ms` they count with the time that they had waited
    answers_per_second
    latency_ms  at the client, from when a request was due to when its answer was unpacked. In a closed loop it is due
                when the client begins with it
    infer_ms    of the server's `server_timing`: in the policy
    overhead_ms latency - infer_ms, request by request. With one closed-loop client it is the cost of being served;
                with more, and in an open loop, waiting for others is in it
    sent_late_ms  in an open loop, from when a request could have been sent to when it was: the clients' own fault
    """

    kind: Literal["turbopi-load"]
    provenance: Provenance
    command: list[str]
    load: Load
    server: Mapping[str, object]
    requests: Count
    answered: Count
    errors: dict[str, int]
    unsent: Count
    answers_per_second: float
    latency_ms: Spread | None
    infer_ms: Spread | None
    overhead_ms: Spread | None
    sent_late_ms: Spread | None
    by_client: list[OneClient]
    clients: Clients


def latency(request: Request) -> float:
    """Milliseconds; of one that was never sent those that it had waited by then."""
    return ((request.free if request.ended is None else request.ended) - request.due) * 1e3


def summary(by_client: Sequence[Sequence[Request]], load: Load) -> dict[str, object]:
    """What became of the requests of each client, as the document's fields of these names."""
    kept = [[request for request in requests if request.due >= load.warmup_seconds] for requests in by_client]
    every = [request for requests in kept for request in requests]
    sent = [request for request in every if request.sent is not None]
    good = [request for request in sent if request.error is None]
    errors: dict[str, int] = {}
    for request in sent:
        if request.error is not None:
            errors[request.error] = errors.get(request.error, 0) + 1
    end = load.warmup_seconds + load.seconds
    in_time = sum(request.ended is not None and request.ended <= end for request in good)
    timed = [(latency(request), request.infer_ms) for request in good if request.infer_ms is not None]
    late = [(request.sent - request.free) * 1e3 for request in sent if request.sent is not None]
    return {
        "requests": len(every),
        "answered": len(good),
        "errors": dict(sorted(errors.items())),
        "unsent": len(every) - len(sent),
        "answers_per_second": in_time / load.seconds,
        "latency_ms": Spread.of([latency(request) for request in every if request.error is None]),
        "infer_ms": Spread.of([infer for _, infer in timed]),
        "overhead_ms": Spread.of([whole - infer for whole, infer in timed]),
        "sent_late_ms": None if load.rate is None else Spread.of(late),
        "by_client": [
            OneClient(sum(r.sent is not None for r in own), Spread.of([latency(request) for request in own]))
            for own in ([request for request in requests if request.error is None] for requests in kept)
        ],
    }


def read_load(file: Path) -> LoadDocument:
    """Raises ConfigError for another file."""
    return read_document(file, LoadDocument, ConfigError, limit=MAX_BYTES)


def tables(document: LoadDocument) -> list[Table | str]:
    """For people: what was asked for, the spreads, and what to know before believing them."""
    load = document.load
    rate = "closed loop" if load.rate is None else f"{load.rate:g} a second, {load.arrivals}"
    images = ", ".join("x".join(map(str, shape)) for shape in load.camera_images) or "none"
    title = f"{load.clients} {load.client} client{'s' * (load.clients > 1)}, {rate}, {load.seconds:g} s"
    table = Table("ms", "min", "p50", "p90", "p95", "p99", "max", title=title, caption=f"images: {images}")
    for column in table.columns[1:]:
        column.justify = "right"
    rows = {
        "latency": document.latency_ms,
        "infer_ms": document.infer_ms,
        "overhead": document.overhead_ms,
        "sent late": document.sent_late_ms,
    }
    for name, spread in rows.items():
        if spread is not None:
            numbers = (spread.min, spread.p50, spread.p90, spread.p95, spread.p99, spread.max)
            table.add_row(name, *(f"{number:.2f}" if number < 1000 else f"{number:.0f}" for number in numbers))
    lines = [
        f"{document.answers_per_second:.1f} answers a second; {document.answered} of {document.requests} requests "
        "answered"
    ]
    if not document.requests:
        lines.append("No request was due after the warm-up: test for more --seconds.")
    lines += [f"errors: {count} {kind}" for kind, count in document.errors.items()]
    if document.unsent:
        lines.append(f"{document.unsent} requests were never sent: the server doesn't keep up with the rate.")
    shares = [use.cpu_share for use in document.clients.processes]
    lines.append(f"the clients' processes used {max(shares):.0%} of a CPU at most, {sum(shares):.1f} CPUs together")
    if sum(shares) > document.clients.cpus / 2 or max(shares) > 0.9:
        lines.append("The clients were so busy that their own work is in the latency: use another machine for them.")
    return [*([table] if table.row_count else []), *lines]
