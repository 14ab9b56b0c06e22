"""What `GET /metrics` tells Prometheus."""

from collections.abc import Callable

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_LATEST

from turbopi.realtime.messages import NOTE_KINDS
from turbopi.serve.scheduling.schedule import PRIORITIES

CONTENT_TYPE = CONTENT_TYPE_LATEST

# Kinds of `turbopi_errors_total`. Those to "origin" are the client's, and so are "late" and "replaced"; "policy",
# "actions", "lost" and "replica" are ours; the last two are nobody's.
ERROR_KINDS = (
    "malformed",
    "observation",
    "busy",
    "late",
    "replaced",
    "too_large",
    "slow",
    "flood",
    "full",
    "unauthorized",
    "origin",
    "policy",
    "actions",
    "lost",
    "replica",
    "disconnected",
    "stopping",
)
REFUSALS = ("busy", "late", "replaced")  # of the scheduler
DROPPED_SESSIONS = ("closed", "idle", "full")
RECORD_OUTCOMES = ("written", "dropped", "failed", "removed")

# Seconds. A policy takes 10 ms to 1 s; a control loop cares about every 5 ms of it.
BUCKETS = (0.005, 0.01, 0.015, 0.02, 0.025, 0.03, 0.04, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0)
_SLACKS = (-1.0, -0.3, -0.1, -0.05, -0.02, -0.01, 0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0)


class Metrics:
    """The server's counters, in a registry of their own, so that several servers fit into one process."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()

        def histogram(name: str, text: str) -> Histogram:
            return Histogram(name, text, buckets=BUCKETS, registry=self.registry)

        self.requests = Counter("turbopi_requests", "Messages received, good or bad", registry=self.registry)
        self.request_seconds = histogram(
            "turbopi_request_seconds", "From a whole observation received to its actions sent"
        )
        self.queue_seconds = histogram("turbopi_queue_seconds", "Waiting for the policy")
        self.inference_seconds = histogram("turbopi_inference_seconds", "In the policy, successful or not")
        self.clients = Gauge("turbopi_clients", "Clients connected now", registry=self.registry)
        self._errors = Counter("turbopi_errors", "Requests that got no actions", ["kind"], registry=self.registry)
        self._recorded = Counter(
            "turbopi_recorded_calls", "Calls recorded, or not", ["outcome"], registry=self.registry
        )
        self._joined = Counter(
            "turbopi_real_time_requests",
            "Requests that joined a running chunk, or had none",
            ["joined"],
            registry=self.registry,
        )
        self.delay_steps = Histogram(
            "turbopi_real_time_delay_steps",
            "Control steps of delay that the policy was given",
            buckets=(0, 1, 2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 50),
            registry=self.registry,
        )
        self.seam_gap = Histogram(
            "turbopi_real_time_seam_gap",
            "Largest normalised distance of the new chunk from the running one where it takes over",
            buckets=(0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0),
            registry=self.registry,
        )
        self._notes = Counter(
            "turbopi_notes", "Notes on states, actions and cameras, in answers", ["kind"], registry=self.registry
        )
        self._sessions_dropped = Counter(
            "turbopi_real_time_sessions_dropped", "Sessions that ended", ["reason"], registry=self.registry
        )
        self._add_scheduling()
        for kind in NOTE_KINDS:
            self._notes.labels(kind)
        for joined in ("yes", "no"):
            self._joined.labels(joined)
        for reason in DROPPED_SESSIONS:
            self._sessions_dropped.labels(reason)
        for kind in ERROR_KINDS:  # so that each is there from the start, at 0
            self._errors.labels(kind)
        for outcome in RECORD_OUTCOMES:
            self._recorded.labels(outcome)

    def _add_scheduling(self) -> None:
        self.batch_size = Histogram(
            "turbopi_batch_size",
            "Observations in a run of the policy",
            buckets=(1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64),
            registry=self.registry,
        )
        self._scheduled = Counter(
            "turbopi_scheduled_requests", "Requests for the policy", ["priority"], registry=self.registry
        )
        self._refused = Counter(
            "turbopi_refused_requests",
            "Requests that got no turn",
            ["kind", "priority"],
            registry=self.registry,
        )
        self._misses = Counter(
            "turbopi_deadline_misses",
            "Answers that were sent after the deadline that their requests gave",
            ["priority"],
            registry=self.registry,
        )
        self._slack = Histogram(
            "turbopi_slack_seconds",
            "From an answer sent to the deadline that its request gave; below 0: missed",
            ["priority"],
            buckets=_SLACKS,
            registry=self.registry,
        )
        for priority in PRIORITIES:
            self._scheduled.labels(priority)
            self._misses.labels(priority)
            self._slack.labels(priority)
            for kind in REFUSALS:
                self._refused.labels(kind, priority)

    def scheduled(self, priority: str, error: str | None) -> None:
        """A request for the policy has its actions, or an `error`."""
        self._scheduled.labels(priority).inc()
        if error in REFUSALS:
            self._refused.labels(error, priority).inc()

    def slack(self, seconds: float, priority: str) -> None:
        """An answer was sent `seconds` before its request's deadline; below 0: after it, a miss."""
        self._slack.labels(priority).observe(seconds)
        if seconds < 0:
            self._misses.labels(priority).inc()

    def error(self, kind: str) -> None:
        assert kind in ERROR_KINDS, kind
        self._errors.labels(kind).inc()

    def recorded(self, outcome: str) -> None:
        assert outcome in RECORD_OUTCOMES, outcome
        self._recorded.labels(outcome).inc()

    def joined(self, joined: bool) -> None:
        self._joined.labels("yes" if joined else "no").inc()

    def note(self, kind: str) -> None:
        self._notes.labels(kind).inc()

    def session_dropped(self, reason: str) -> None:
        assert reason in DROPPED_SESSIONS, reason
        self._sessions_dropped.labels(reason).inc()

    def watch_sessions(self, count: Callable[[], int]) -> None:
        """Read the number of sessions from `count` at each scrape."""
        sessions = Gauge("turbopi_real_time_sessions", "Sessions with a running chunk", registry=self.registry)
        sessions.set_function(count)

    def watch(self, waiting: Callable[[], int], running: Callable[[], bool]) -> None:
        """Read the queue's state from `waiting` and `running` at each scrape."""
        depth = Gauge("turbopi_queue_depth", "Requests waiting for the policy", registry=self.registry)
        depth.set_function(waiting)
        busy = Gauge("turbopi_inference_in_progress", "1 while the policy runs", registry=self.registry)
        busy.set_function(running)

    def requests_so_far(self) -> int:
        return int(sum(_totals(self.requests).values()))

    def errors_so_far(self) -> dict[str, int]:
        """How many of each kind that there were."""
        return {kind: int(count) for kind, count in _totals(self._errors).items() if count}

    def text(self) -> str:
        """Prometheus' text format."""
        return generate_latest(self.registry).decode()


def _totals(counter: Counter) -> dict[str, float]:
    """A counter's values by label; its only one under ""."""
    samples = (sample for family in counter.collect() for sample in family.samples)
    return {"".join(s.labels.values()): s.value for s in samples if s.name.endswith("_total")}
