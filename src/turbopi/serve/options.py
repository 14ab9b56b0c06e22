"""A server's options: defined once, for `turbopi serve`, `serve.run`, `serve.running` and PolicyServer."""

import importlib.util
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from turbopi.serve.hosts import LOOPBACK, AllowedHosts
from turbopi.serve.limits import Limits
from turbopi.support.errors import ConfigError

if TYPE_CHECKING:  # `turbopi --help` needs no NumPy
    from turbopi.realtime.running_chunk import JoinMode
    from turbopi.recordings.format import RecordImages

MAX_BATCH = 64
MAX_DEADLINE_MS = 60_000.0  # of options and requests, so that nobody waits behind others for ever
MAX_CONTROL_HZ = 10_000.0
OPENTELEMETRY = ("opentelemetry.sdk", "opentelemetry.exporter.otlp.proto.http")  # of the extra `otel`
JOINING = ("rtc", "rtc_identity", "rtc_trained", "warm_start", "paint")


@dataclass(frozen=True)
class ServerOptions:
    """Raises ConfigError for options that can't be right.

    host, port      where to listen; port 0 takes a free one
    api_key         if given, every client must send `Authorization: Api-Key <api_key>`, for /metrics too
    max_message_mb  larger messages end the connection with close code 1009
    queue_limit     requests that may wait while another one runs; more get a text frame "busy: ..."
    max_batch       observations that may run together, at most, where that is sooner. None: up to 8, as far as the
                    warm-up can measure them in seconds; 1: never
    deadline_ms     from a request's arrival to its answer, for requests that don't say their own: for the order alone
    record_dir      if given, every observation and its actions are written below this folder
    record_limit    "20GB", "7d" or "20GB,7d": the oldest calls below it are removed. None: everything stays
    record_images   how images are written there: "exact", "png" (exact, too) or "jpeg"
    allowed_hosts   names, besides its own, by which web pages may address this server (`hosts.AllowedHosts`)
    max_clients     connected at once; more are refused with HTTP 503
    page            the server's own page and its feed. None: on if only this machine or who has the key can see it
    execution       join each client's chunks here, in a session of each connection: "rtc", "rtc_identity",
                    "rtc_trained", "warm_start" or "paint". None: only for clients that request it
                    (docs/serving_sessions.md)
    control_hz      actions that robots carry out in a second; needed with `execution`
    execution_horizon
                    s, actions of a chunk that robots carry out before the next takes over. None: half of a chunk
    delay_steps     control steps from an observation to its chunk at the robot. None: measured here, network apart
    traces          spans of each call to OpenTelemetry (traces.py)
    """

    host: str = "127.0.0.1"
    port: int = 8000
    api_key: str | None = field(default=None, repr=False)
    max_message_mb: float = 64
    queue_limit: int = 16
    max_batch: int | None = None
    deadline_ms: float = 1000.0
    record_dir: str | Path | None = None
    record_limit: str | None = None
    record_images: "RecordImages" = "exact"
    allowed_hosts: Sequence[str] = ()
    max_clients: int = Limits.clients
    page: bool | None = None
    execution: "JoinMode | None" = None
    control_hz: float | None = None
    execution_horizon: int | None = None
    delay_steps: int | None = None
    traces: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ConfigError(f"port={self.port} should be from 0 to 65535")
        if not 0 < self.max_message_mb < math.inf:
            raise ConfigError(f"max_message_mb={self.max_message_mb:g} should be more than 0 and finite")
        if self.queue_limit < 0:
            raise ConfigError(f"queue_limit={self.queue_limit} should be 0 or more")
        if self.max_batch is not None and not 1 <= self.max_batch <= MAX_BATCH:
            raise ConfigError(f"max_batch={self.max_batch} should be from 1 to {MAX_BATCH}")
        if not 0 < self.deadline_ms <= MAX_DEADLINE_MS:
            raise ConfigError(f"deadline_ms={self.deadline_ms:g} should be more than 0 and at most {MAX_DEADLINE_MS:g}")
        if self.max_clients < 1:
            raise ConfigError(f"max_clients={self.max_clients} should be 1 or more")
        if self.execution is not None and self.execution not in JOINING:
            raise ConfigError(
                f"execution={self.execution!r} isn't a server's: it joins chunks by {', '.join(JOINING)}. Other "
                "ways to run need nothing of it"
            )
        if self.execution is not None and self.control_hz is None:
            raise ConfigError(f"execution={self.execution!r} needs the robots' control rate, too: give control_hz=")
        if self.control_hz is not None and not 0 < self.control_hz <= MAX_CONTROL_HZ:
            raise ConfigError(f"control_hz={self.control_hz:g} should be more than 0 and at most {MAX_CONTROL_HZ:g}")
        if self.execution_horizon is not None and self.execution_horizon < 1:
            raise ConfigError(f"execution_horizon={self.execution_horizon} should be 1 or more")
        if self.delay_steps is not None and self.delay_steps < 0:
            raise ConfigError(f"delay_steps={self.delay_steps} should be 0 or more")
        if self.record_dir is None and (self.record_limit is not None or self.record_images != "exact"):
            raise ConfigError("record_limit= and record_images= are of a recording: give record_dir=, too")
        if self.record_dir is not None:
            self._check_recording()
        if self.traces:
            _check_traces()
        check_key(self.api_key)
        AllowedHosts(self.host, self.allowed_hosts)

    def _check_recording(self) -> None:
        from turbopi.recordings.format import RECORD_IMAGES
        from turbopi.recordings.limit import RecordLimit

        if self.record_limit is not None:
            RecordLimit.of(self.record_limit)
        if self.record_images not in RECORD_IMAGES:
            raise ConfigError(f"record_images={self.record_images!r} should be one of {', '.join(RECORD_IMAGES)}")

    @property
    def has_page(self) -> bool:
        """Whether the page is on."""
        return self.page if self.page is not None else self.host in LOOPBACK or self.api_key is not None


def _check_traces() -> None:
    """Raise ConfigError if a package that traces need is missing: before a policy is loaded, not after."""
    for name in OPENTELEMETRY:
        try:
            found = importlib.util.find_spec(name)
        except ModuleNotFoundError:
            found = None
        if found is None:
            raise ConfigError(f"traces need OpenTelemetry, and {name} isn't installed: pip install 'turbopi[otel]'")


def check_key(api_key: str | None) -> None:
    """Raise ConfigError for a key that no header can carry."""
    if api_key is not None and not (api_key and api_key.isascii() and api_key.isprintable() and " " not in api_key):
        raise ConfigError("the API key must be printable ASCII without spaces, and not empty")


def key_in(file: Path) -> str:
    """The API key that a file holds: its one line. Raises ConfigError."""
    try:
        key = file.read_bytes()[:10_000].decode("ascii").strip()
    except OSError as error:
        raise ConfigError(f"the API key can't be read from {file}: {error.strerror}") from error
    except UnicodeDecodeError:
        raise ConfigError(f"{file} holds no API key: it should be one line of printable ASCII") from None
    if not key:
        raise ConfigError(f"{file} is empty; it should hold the API key")
    return key
