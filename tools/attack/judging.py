"""Judge what a server answers, without its code: a decoder and a digest of its own.

The fake policy (fake.py) answers with the digest of the observation that reached it. Whoever sent the message decodes
it with this file, and compares: an answer to another message, a number changed on the way or a message that no decoder
should take shows as a wrong result.
"""

import hashlib
import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import msgpack
import numpy as np

DIGEST_SHAPE = (4, 8)  # the actions of the fake policy: the 32 bytes of a SHA-256, as numbers
MAX_TEXT = 4096  # characters of a refusal
TRACEBACK = "Traceback (most recent call last)"
FORBIDDEN_CODES = (1011,)  # "internal error": the server's fault, whatever the client sent
SENSIBLE_CODES = (
    1000,
    1001,
    1002,
    1003,
    1005,
    1007,
    1008,
    1009,
    1010,
    1012,
    1013,
)  # 1005: an empty close, answered alike


class Undecodable(Exception):
    """Not a message of the wire format, says the decoder of this file."""


# --- what a message holds ---------------------------------------------------------------------------------------------


def decode(data: bytes) -> Any:
    """What a message holds. Raises Undecodable. Plainer than the server's decoder: only for small messages."""
    try:
        value = msgpack.unpackb(data, strict_map_key=False, object_pairs_hook=_pairs)
        return _restored(value)
    except Undecodable:
        raise
    except Exception as error:  # whatever msgpack or NumPy dislikes
        raise Undecodable(f"{type(error).__name__}: {error}") from error


def _pairs(pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
    value = dict(pairs)
    if len(value) != len(pairs):
        raise Undecodable("a key twice")
    return value


def _restored(value: Any) -> Any:
    if isinstance(value, list):
        return [_restored(item) for item in value]
    if not isinstance(value, dict):
        return value
    if value.get(b"__ndarray__") is True:
        dtype = np.dtype(value[b"dtype"])
        return np.frombuffer(value[b"data"], dtype).reshape(value[b"shape"])
    if value.get(b"__npgeneric__") is True:
        return np.dtype(value[b"dtype"]).type(value[b"data"])
    return {key: _restored(item) for key, item in value.items()}


def digest(value: Any) -> bytes:
    """SHA-256 of a decoded value: its types, order, dtypes, shapes and every bit."""
    state = hashlib.sha256()
    for piece in _pieces(value):
        state.update(piece)
    return state.digest()


def _pieces(value: Any) -> Iterator[bytes]:
    if isinstance(value, dict):
        yield b"{%d" % len(value)
        for key, item in value.items():
            yield from _pieces(key)
            yield from _pieces(item)
    elif isinstance(value, list | tuple):
        yield b"[%d" % len(value)
        for item in value:
            yield from _pieces(item)
    elif isinstance(value, np.ndarray | np.generic):
        yield f"a{value.dtype.str}{value.shape}".encode()
        yield value.tobytes()
    elif isinstance(value, float):
        yield b"f" + (b"nan" if math.isnan(value) else struct.pack("<d", value))
    elif isinstance(value, str):
        data = value.encode("utf-8", "surrogatepass")
        yield b"s%d:" % len(data) + data
    elif isinstance(value, bytes):
        yield b"b%d:" % len(value) + value
    else:
        yield f"v{value!r}".encode()


def digest_actions(value: Any) -> np.ndarray:
    """float64 [4, 8] in 0..255: the fake policy's actions for an observation."""
    return np.frombuffer(digest(value), np.uint8).astype(np.float64).reshape(DIGEST_SHAPE)


# --- one answer -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reply:
    """What came for a message: `binary` or `text` with `data`, `closed` with a `code` (1006: none), or `silence`."""

    kind: Literal["binary", "text", "closed", "silence"]
    data: bytes = b""
    code: int = 0


@dataclass(frozen=True)
class Judged:
    """outcome: a short name for the table of outcomes. fault: what is wrong with it, or None."""

    outcome: str
    fault: str | None = None


def judge(
    message: bytes | None,
    reply: Reply,
    *,
    valid: bool,
    may_close: bool = False,
    shape: Sequence[int] | None = None,
) -> Judged:
    """Judge the `reply` to the payload `message` (None: the frame carried none that could be answered).

    valid       the message is a good observation: anything but its result is a fault (but for "busy")
    may_close   the frame breaks the websocket protocol: a close with a sensible code is right, too
    shape       of a model's actions, which are finite; without it the fake's, which are a digest of the observation
    """
    if reply.kind == "silence":
        return Judged("silence", "no answer, and no close")
    if reply.kind == "closed":
        return _judge_close(reply.code, may_close and not valid)
    if reply.kind == "text":
        return _judge_text(reply.data.decode("utf-8", "replace"), valid)
    return _judge_result(message, reply.data, shape)


def _judge_close(code: int, may_close: bool) -> Judged:
    outcome = f"closed {code}"
    if code in FORBIDDEN_CODES:
        return Judged(outcome, f"closed with {code}, the server's own fault")
    if not may_close:
        return Judged(outcome, f"closed with {code} instead of an answer")
    return Judged(outcome, None if code in SENSIBLE_CODES else f"closed with {code}, which says nothing")


def _judge_text(text: str, valid: bool) -> Judged:
    kind = text.partition(":")[0] if ":" in text[:40] else text[:40]
    outcome = f"refused: {kind}"
    if TRACEBACK in text:
        return Judged("traceback", f"a traceback: {text.strip().splitlines()[-1][:200]}")
    if not text.strip() or len(text) > MAX_TEXT:
        return Judged(outcome, f"a refusal of {len(text)} characters")
    if valid and kind not in ("busy", "the server is shutting down"):
        return Judged(outcome, f"a good observation was refused: {text[:200]}")
    return Judged(outcome)


def _judge_result(message: bytes | None, data: bytes, shape: Sequence[int] | None) -> Judged:
    try:
        actions = np.asarray(decode(data)["actions"])
    except (Undecodable, KeyError, TypeError, IndexError) as error:
        return Judged("unreadable", f"a result that can't be read: {type(error).__name__} {error}")
    if message is None:
        return Judged("wrong", "a result, where no message was complete")
    try:
        expected = digest_actions(decode(message))
    except Undecodable as error:
        return Judged("wrong", f"a result for a message that isn't one: {error}")
    if shape is not None:
        return Judged("result", shape_fault(data, shape))
    if actions.shape != DIGEST_SHAPE or not np.array_equal(actions, expected):
        return Judged("wrong", "the result belongs to another observation")
    return Judged("result")


def shape_fault(data: bytes, shape: Sequence[int] | None = None) -> str | None:
    """What is wrong with a real policy's result: `actions` must be finite float64 [H, d]; with `shape`, of that one."""
    try:
        actions = np.asarray(decode(data)["actions"])
    except (Undecodable, KeyError, TypeError, IndexError) as error:
        return f"a result that can't be read: {type(error).__name__} {error}"
    if actions.dtype != np.float64 or actions.ndim != 2 or (shape is not None and actions.shape != tuple(shape)):
        return f"actions are {actions.dtype} {list(actions.shape)}"
    return None if np.isfinite(actions).all() else "actions aren't finite"


# --- bars -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Bar:
    """One measured value and its limit. A value of None could not be measured, which breaks the bar."""

    name: str
    value: float | None
    limit: float

    @property
    def held(self) -> bool:
        return self.value is not None and self.value <= self.limit


def percentile(values: Sequence[float], share: float) -> float | None:
    """The nearest-rank percentile; None of no values."""
    if not values:
        return None
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, max(0, math.ceil(share * len(ordered)) - 1))]


def mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def ratio(undisturbed: float | None, attacked: float | None) -> float | None:
    """How many times as much `attacked` is; None if either is unknown."""
    return None if not undisturbed or attacked is None else round(attacked / undisturbed, 3)
