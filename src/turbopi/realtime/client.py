"""A robot's side of `turbopi serve`, with websockets, msgpack and NumPy alone: no PyTorch on the robot's computer.

    from turbopi.realtime.client import RealTimeClient

    with RealTimeClient("gpu-machine", 8000) as policy:
        actions = policy.infer(observation)["actions"]

It also is a policy for `turbopi.realtime.RealTimeExecutor`, in every way to run that the server offers. It speaks to
openpi's own server, too, which offers none of the "rtc" ways.
"""

import ipaddress
import logging
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from types import TracebackType
from typing import Any, NoReturn

import numpy as np
from websockets.exceptions import InvalidStatus, InvalidURI, WebSocketException

from turbopi.realtime.chunk import checked_answer
from turbopi.realtime.messages import PREFIX, keeps_episode, message
from turbopi.realtime.policy_socket import PolicySocket
from turbopi.realtime.running_chunk import RunningChunk
from turbopi.realtime.shared_memory import Parts
from turbopi.realtime.wire import Unpacker, WireError, pack, pack_parts
from turbopi.support.errors import ActionError, ConfigError, DeviceLost, ObservationError, TurboPiError
from turbopi.support.text import kind_of

logger = logging.getLogger(__name__)
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
    answer_s        seconds after which a call gives up (ServerLost), whatever it waits for: a connection, a server that
                    doesn't read, its answer. The robot doesn't wait for a dead server for ever

    It connects to the server itself: proxies that the environment names (http_proxy) aren't used.

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
        self._api_key = api_key
        self._connect_s, self._answer_s = connect_s, answer_s
        self._lock = threading.Lock()
        self._unpacker = Unpacker()
        self._socket: PolicySocket | None = None
        self._episode = self._reported = (
            0  # the one now, and the one that a server which keeps the running chunk knows of
        )
        self._recorded = 0  # observations of this episode, by the last answer of a policy with memory
        _keep_freed_memory()
        with self._lock:
            self.metadata = self._connect(connect_s)

    def infer(
        self,
        obs: Mapping[str, Any],
        *,
        previous: RunningChunk | None = None,
        model_actions: bool = False,
        seed: int | None = None,
    ) -> dict[str, Any]:
        """The server's answer: {"actions": float64[H, d], …}; the other arguments as for UnifiedPolicy.

        Its arrays are the caller's own and may be written to. Raises ObservationError, ActionError, DeviceLost for what
        the server says of this call, ActionError for an answer that no robot may get (NaN, no chunk), ObservationError
        for what can't be sent (such as a tensor), ConfigError if the server doesn't offer what is requested,
        ServerRefused for other answers, and ServerLost.
        """
        if previous is not None and not isinstance(previous, RunningChunk):
            raise ObservationError(f"previous is {kind_of(previous)}; it should be a turbopi.realtime.RunningChunk")
        mode = None if previous is None else previous.mode
        asks = previous is not None or model_actions or seed is not None
        check = partial(self._check_offered, mode) if asks else None
        answer = self._answer(message(obs, previous, model_actions, seed), check)
        return checked_answer(_writable(answer), model_actions=model_actions, batch=f"{PREFIX}batch" in obs)

    def _answer(self, sent: dict[str, Any], check: Callable[[], None] | None) -> dict[str, Any]:
        """The server's answer to a message. check: of what it offers, once it is connected."""
        with self._lock:
            deadline = time.monotonic() + self._answer_s
            if self._socket is None:
                self.metadata = self._connect(min(self._connect_s, self._answer_s))
            if check is not None:
                check()
            reported = self._reported
            if reported != self._episode and (self._keeps_chunk(sent) or keeps_episode(self.metadata)):
                sent[f"{PREFIX}reset"], reported = True, self._episode
            packed = _packed(sent)
            assert self._socket is not None
            try:
                reply = self._socket.ask(packed, deadline - time.monotonic())
            except BaseException as error:
                self._socket = None
                if not isinstance(error, OSError | WebSocketException):
                    raise  # Ctrl-C
                raise ServerLost(
                    f"the policy server at {self.url} gave no answer within {self._answer_s:g} s"
                    if isinstance(error, TimeoutError)
                    else f"the policy server at {self.url} went away: {_reason(error)}"
                ) from error
            if isinstance(reply, str):
                self._raise(reply)
            answer, self._reported = self._unpacked(reply), reported
            self._watch_memory(answer, begins=bool(sent.get(f"{PREFIX}reset")))
        return answer

    def _watch_memory(self, answer: Mapping[str, Any], begins: bool) -> None:
        """Warn if the server's history of this robot began anew within an episode, as after a lost connection."""
        memory = answer.get("memory")
        if not isinstance(memory, dict) or not isinstance(recorded := memory.get("observations"), int):
            return
        if not begins and recorded <= self._recorded:
            logger.warning(
                "the policy server at %s has forgotten this episode's %d observations: its history began anew",
                self.url,
                self._recorded,
            )
        self._recorded = recorded

    def observe(self, obs: Mapping[str, Any]) -> dict[str, Any]:
        """Have the server's policy with memory record an observation: {"observations": of this episode, "missed": …}.

        Raises as `infer`, and ConfigError for a policy without memory.
        """
        answer = self._answer({**obs, f"{PREFIX}observe": True}, self._check_remembers)
        memory = answer.get("memory")
        if not isinstance(memory, dict):
            raise ServerRefused(f'the policy server at {self.url} answered an observation without "memory"')
        return memory

    def generate(self, obs: Mapping[str, Any], *, prompt: str | None = None, max_tokens: int | None = None) -> str:
        """What the server's policy says to an observation, as `UnifiedPolicy.generate`.

        Raises as `infer`, and ConfigError for a policy that writes no text.
        """
        options = {"generate": True if prompt is None else prompt, "max_tokens": max_tokens}
        sent = {PREFIX + key: value for key, value in options.items() if value is not None}
        text = self._answer({**obs, **sent}, self._check_writes).get("text")
        if not isinstance(text, str):
            raise ServerRefused(f'the policy server at {self.url} answered without a "text"')
        return text

    def reset(self) -> None:
        """A new episode, as openpi's `BasePolicy.reset`: the next chunk joins none of the last one's, and a policy with
        memory remembers nothing.

        Sends nothing. A server that keeps the running chunk of this client (`turbopi serve --execution`, a session) is
        told with the next request; otherwise there is nothing to forget.
        """
        self._episode += 1

    def get_server_metadata(self) -> dict[str, Any]:
        """`metadata`, by the name that openpi's WebsocketClientPolicy has for it."""
        return self.metadata

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
        """Close the connection, within a second, after the call of another thread that is running."""
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

    def _check_remembers(self) -> None:
        if "memory" not in self.metadata:
            raise ConfigError(f"the policy server at {self.url} has no policy with memory: there is nothing to record")

    def _check_writes(self) -> None:
        if "text" not in self.metadata:
            raise ConfigError(f'the policy server at {self.url} writes no text (its metadata has no "text")')

    def _keeps_chunk(self, sent: Mapping[str, Any]) -> bool:
        """Whether the server keeps the chunk that this request joins, in a session."""
        own = {key.removeprefix(PREFIX) for key in sent if key.startswith(PREFIX)}
        if "batch" in own or sent.get(f"{PREFIX}mode") == "none":
            return False  # joins nothing
        if "session" in own:
            return "mode" in own or self._execution is not None
        return self._execution is not None and not own & {"previous", "model_actions"}

    @property
    def _execution(self) -> Any:
        """The mode in which the server itself joins chunks; None if it doesn't."""
        offered = self.metadata.get("real_time")
        return offered.get("execution") if isinstance(offered, Mapping) else None

    def _connect(self, seconds: float) -> dict[str, Any]:
        """Connect; the server's metadata."""
        try:
            connected = PolicySocket(self.url, self._api_key, seconds)
        except (InvalidURI, ValueError) as error:
            raise ConfigError(f"{self.url} is no address of a server: {error}") from error
        except (OSError, WebSocketException) as error:
            if isinstance(error, InvalidStatus) and error.response.status_code in (401, 403):
                raise ConfigError(f"the policy server at {self.url} wants its API key: give api_key") from error
            hint = (
                ". Is it running? It takes connections once it is warm"
                if isinstance(error, ConnectionRefusedError)
                else ""
            )
            raise ServerLost(f"no policy server at {self.url}: {_reason(error)}{hint}") from error
        try:
            metadata = self._unpacked(connected.greeting)
        except ServerRefused:
            connected.close()
            raise
        self._socket = connected
        return metadata

    def _unpacked(self, data: str | bytes) -> dict[str, Any]:
        try:
            if isinstance(data, str):
                raise WireError("a text frame where a message should be")
            unpacked = self._unpacker.unpack(data)
            if not isinstance(unpacked, dict):
                raise WireError(f"{kind_of(unpacked)} where a map should be")
        except WireError as error:
            raise ServerRefused(f"the server at {self.url} doesn't speak openpi's protocol: {error}") from error
        return unpacked

    def _drop(self) -> None:
        dropped, self._socket = self._socket, None
        if dropped is not None:
            dropped.close()


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


def _packed(sent: Mapping[str, Any]) -> Parts:
    """The message's parts. Raises WireError, an ObservationError, that names the key of what can't be sent."""
    try:
        return pack_parts(sent)
    except WireError as error:
        for key, value in sent.items():
            try:
                pack(value)
            except WireError as its_own:
                raise WireError(f"{key}: {its_own}") from None
        raise error  # of a key


def _writable(value: Any) -> Any:
    """The same with arrays that may be written to: those of a message are views of it, or of read-only bytes."""
    kind = type(value)
    if kind is dict:
        return {key: _writable(item) if type(item) in _HOLD_ARRAYS else item for key, item in value.items()}
    if kind is list:
        return [_writable(item) if type(item) in _HOLD_ARRAYS else item for item in value]
    return value.copy() if kind is np.ndarray else value


_HOLD_ARRAYS = frozenset((dict, list, np.ndarray))


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
