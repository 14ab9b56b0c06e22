"""A robot's side of `turbopi serve`, with websockets, msgpack and NumPy alone: no PyTorch on the robot's computer.

    from turbopi.client import RealTimeClient

    with RealTimeClient("gpu-machine", 8000) as policy:
        actions = policy.infer(observation)["actions"]

It also is a policy for `turbopi.realtime.RealTimeExecutor`, in every way to run that the server offers. It speaks to
openpi's own server, too, which offers none of the "rtc" ways.
"""

import contextlib
import ipaddress
import threading
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Any, NoReturn

from websockets.exceptions import InvalidStatus, InvalidURI, WebSocketException
from websockets.sync.client import ClientConnection, connect

from turbopi.errors import ActionError, ConfigError, DeviceLost, ObservationError, TurboPiError
from turbopi.execution.messages import message
from turbopi.running_chunk import RunningChunk
from turbopi.wire import MAX_BYTES, WireError, pack, unpack

_REFUSALS: dict[str, type[TurboPiError]] = {
    "bad request: ": ObservationError,
    "bad observation: ": ObservationError,
    "bad actions: ": ActionError,
    "the device is lost: ": DeviceLost,
}
_KEEPS_CONNECTION = ("busy: ", "late: ", "replaced: ", "the replica is lost: ")  # as do _REFUSALS
_KEPT_BYTES = 8 * 2**20


class ServerLost(TurboPiError):
    """The server can't be reached, went away, or took too long. The next call connects anew."""


class ServerRefused(TurboPiError):
    """The server answered with something else than actions."""


class RealTimeClient:
    """A policy on another machine. Calls of several threads take turns.

    host, port      the server's, 8000 unless given; `host` may be a URL, ws:// or wss://, that has the port in it
    api_key         if the server has one
    connect_s       seconds in which the server must take the connection and send its metadata
    answer_s        seconds after which a call gives up (ServerLost): the robot doesn't wait for a dead server for ever

    Raises ServerLost if nobody answers, ConfigError for an address that can't be one and a wrong key.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int | None = None,
        *,
        api_key: str | None = None,
        connect_s: float = 10.0,
        answer_s: float = 30.0,
    ) -> None:
        self.url = _url(host, port)
        self._headers = {"Authorization": f"Api-Key {api_key}"} if api_key else None
        self._connect_s, self._answer_s = connect_s, answer_s
        self._lock = threading.Lock()
        self._socket: ClientConnection | None = None
        self._open = contextlib.ExitStack()
        _keep_freed_memory()
        with self._lock:
            self.metadata = self._connect()

    def infer(
        self,
        obs: Mapping[str, Any],
        *,
        previous: RunningChunk | None = None,
        model_actions: bool = False,
        seed: int | None = None,
    ) -> dict[str, Any]:
        """The server's answer: {"actions": float64[H, d], …}; the other arguments as for UnifiedPolicy.

        Raises ObservationError, ActionError, DeviceLost for what the server says of this call, ObservationError for
        what can't be sent (such as a tensor), ConfigError if the server doesn't offer what is asked, ServerRefused for
        other answers, and ServerLost.
        """
        with self._lock:
            if self._socket is None:
                self.metadata = self._connect()
            if previous is not None and not isinstance(previous, RunningChunk):
                raise ObservationError(
                    f"previous is a {type(previous).__name__}; it should be a turbopi.running_chunk.RunningChunk"
                )
            if previous is not None or model_actions or seed is not None:
                self._check_offered(None if previous is None else previous.mode)
            packed = _packed(message(obs, previous, model_actions, seed))
            assert self._socket is not None
            try:
                with self._dropped_on_error():  # a late answer must not be taken for the next call's
                    self._socket.send(packed)
                    reply = self._socket.recv(timeout=self._answer_s)
            except (OSError, TimeoutError, WebSocketException) as error:
                raise ServerLost(
                    f"the policy server at {self.url} gave no answer within {self._answer_s:g} s"
                    if isinstance(error, TimeoutError)
                    else f"the policy server at {self.url} went away: {_reason(error)}"
                ) from error
            if isinstance(reply, str):
                self._raise(reply)
            return self._unpacked(reply)

    def _raise(self, text: str) -> NoReturn:
        """What the server says instead of actions."""
        for beginning, kind in _REFUSALS.items():
            if text.startswith(beginning):
                raise kind(_printable(text.removeprefix(beginning)))
        if not text.startswith(_KEEPS_CONNECTION):
            self._drop()  # a server that stops or sends a traceback closes the connection
        last = (text.strip().splitlines() or ["nothing"])[-1]
        raise ServerRefused(f"the policy server at {self.url} sent no actions but: {_printable(last)}")

    def close(self) -> None:
        """Close the connection, after the call of another thread that is running."""
        with self._lock:
            self._drop()

    def __enter__(self) -> "RealTimeClient":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _check_offered(self, mode: str | None) -> None:
        offered = self.metadata.get("real_time")
        if not isinstance(offered, Mapping):
            raise ConfigError(
                f'the policy server at {self.url} offers no real-time modes (its metadata has no "real_time"): '
                "use execution 'sync', 'async' or 'ensemble', or serve with a Turbo-Pi that has them"
            )
        modes = list(offered.get("modes", ()))
        if mode is not None and mode not in modes:
            raise ConfigError(f"the policy server at {self.url} doesn't offer {mode!r}; it offers {modes}")

    def _connect(self) -> dict[str, Any]:
        """Connect; the server's metadata."""
        try:
            with self._dropped_on_error():
                connecting = connect(
                    self.url,
                    additional_headers=self._headers,
                    compression=None,
                    max_size=MAX_BYTES,
                    open_timeout=self._connect_s,
                    close_timeout=1.0,  # a server that hangs says no goodbye
                    ping_interval=None,  # openpi's server answers no ping while it computes
                )
                self._socket = self._open.enter_context(connecting)
                return self._unpacked(self._socket.recv(timeout=self._connect_s))
        except (InvalidURI, ValueError) as error:
            raise ConfigError(f"{self.url} is no address of a server: {error}") from error
        except (OSError, TimeoutError, WebSocketException) as error:
            if isinstance(error, InvalidStatus) and error.response.status_code in (401, 403):
                raise ConfigError(f"the policy server at {self.url} wants its API key: give api_key") from error
            hint = (
                ". Is it running? It takes connections once it is warm"
                if isinstance(error, ConnectionRefusedError)
                else ""
            )
            raise ServerLost(f"no policy server at {self.url}: {_reason(error)}{hint}") from error

    def _unpacked(self, data: str | bytes) -> dict[str, Any]:
        try:
            if isinstance(data, str):
                raise WireError("a text frame where a message should be")
            unpacked = unpack(data)
            if not isinstance(unpacked, dict):
                raise WireError(f"a {type(unpacked).__name__} where a map should be")
        except WireError as error:
            raise ServerRefused(f"the server at {self.url} doesn't speak openpi's protocol: {error}") from error
        return unpacked

    @contextlib.contextmanager
    def _dropped_on_error(self) -> Iterator[None]:
        """Drop the connection if anything interrupts what waits for the server: Ctrl-C, too."""
        try:
            yield
        except BaseException:
            self._drop()
            raise

    def _drop(self) -> None:
        self._socket = None
        with contextlib.suppress(Exception):  # it may be gone already
            self._open.close()


def _url(host: str, port: int | None) -> str:
    """Raises ConfigError for a host that is something else: another program's URL, a host with its port."""
    if host.startswith(("ws://", "wss://")):
        if port is None:
            return host
        url = host.rstrip("/")
        if "/" in url.partition("://")[2]:
            raise ConfigError(f"the host is {host!r}, a URL with a path: give the port in it, and not beside it")
        return f"{url}:{port}"
    if "://" in host:
        raise ConfigError(f"the host is {host!r}; give a name, or a URL that begins with ws:// or wss://")
    if ":" not in host:
        return f"ws://{host}:{8000 if port is None else port}"
    try:
        ipaddress.IPv6Address(host.partition("%")[0])  # what follows is the interface
    except ValueError:
        raise ConfigError(f"the host is {host!r}; give its name, and the port beside it as a number") from None
    return f"ws://[{host}]:{8000 if port is None else port}"


def _packed(sent: Mapping[str, Any]) -> bytes:
    """The message. Raises WireError, an ObservationError, that names the key of what can't be sent."""
    try:
        return pack(sent)
    except WireError as error:
        for key, value in sent.items():
            try:
                pack(value)
            except WireError as its_own:
                raise WireError(f"{key}: {its_own}") from None
        raise error  # of a key


def _keep_freed_memory() -> None:
    """Have the C library keep up to twice _KEPT_BYTES of freed memory, which it would return to the system.

    An observation is copied a few times on its way out. glibc returns such blocks when they are freed, and fresh memory
    costs more than the copies (docs/dev/log.md). It stops to return blocks of a size once it has returned one of that
    size (mallopt(3), M_MMAP_THRESHOLD). This one is never written to, so it takes no memory.
    """
    bytearray(_KEPT_BYTES)


def _printable(text: str) -> str:
    """The end of a text on one line, without what would move a terminal's cursor."""
    return "".join(c if c.isprintable() else " " for c in text[-1000:])


def _reason(error: BaseException) -> str:
    reason = str(error) or type(error).__name__
    if isinstance(error, InvalidStatus) and error.response.body:
        reason += f" ({_printable(error.response.body.decode(errors='replace').strip())})"
    return reason
