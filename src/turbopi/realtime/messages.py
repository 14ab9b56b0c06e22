"""What a message to a policy server says about real-time execution: optional keys beside the observation's own.

docs/serving_sessions.md has them as a table. Any client of openpi's protocol can send them; a server of another make
refuses or ignores them, so a client looks for "real_time" in the server's metadata first. The keys of scheduling
(SCHEDULING_KEYS) are only named here: serve/requests.py reads them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, cast, get_args

import numpy as np

from turbopi.config import LIMITS, Schedule
from turbopi.realtime.running_chunk import JoinMode, RunningChunk
from turbopi.support.errors import ObservationError

PREFIX = "turbopi/"
NOTES = PREFIX + "notes"  # of an answer: a list of {"kind", "names", "text"}
NOTE_KINDS = (  # docs/safety.md says when
    *("state_range", "action_range", "action_clipped"),
    *("camera_black", "camera_frozen", "camera_size", "camera_exchanged", "camera_channels"),
    *("camera_turned", "camera_missing", "memory"),
)
MOST_NOTES = 32  # of an answer: others aren't read
MAX_SESSION = 64  # characters
MAX_STEP = 2**53
MAX_ACTION = float(np.sqrt(np.finfo(np.float32).max))  # of a normalised one: the model's norms square it in float32
MAX_SEED = 2**64 - 1
MAX_TEXT = 2000  # characters of a text that a message gives
MAX_TOKENS = LIMITS["max_decoding_steps"]
# The last two are for people: the page and the log, and traces.
SCHEDULING_KEYS = ("deadline_ms", "control_hz", "left", "priority", "batch", "robot", "traceparent")
KEYS = (
    *("model_actions", "previous", "anchor", "delay", "execution_horizon", "mode", "schedule", "max_guidance_weight"),
    *("session", "step", "reset", "seed", "observe", "guidance", "subtask", "generate", "max_tokens"),
    *SCHEDULING_KEYS,
)


@dataclass(frozen=True)
class CallOptions:
    """What a message requests beside its observation; None and False: it doesn't say.

    previous           the running chunk, if the client stores it itself
    model_actions      the answer has "model_actions", and "anchor" for relative actions
    mode, delay, execution_horizon
                       how to join, if the server stores the running chunk; the latter two in control steps
    guidance           {"schedule": …, "max_guidance_weight": …}, those of them that were given
    session            its name; None: the connection is the session
    step               actions that the robot has carried out in this session when the observation was taken
    reset              a new episode: the session's running chunk is forgotten
    seed               draws the noise of this call, as `UnifiedPolicy.infer`'s: the same request, the same answer
    observe            a policy with memory records the observation, and computes nothing
    prompt_guidance    the key "guidance": the scale of this call, as `UnifiedPolicy.infer`'s
    subtask            what the actions are made of, of a policy that acts on subtasks
    generate           the answer is the text that the policy writes, not actions: to this prompt, or True: to the
                       observation's; of at most `max_tokens`
    """

    previous: RunningChunk | None = None
    model_actions: bool = False
    mode: JoinMode | None = None
    delay: int | None = None
    execution_horizon: int | None = None
    guidance: Mapping[str, Any] | None = None
    session: str | None = None
    step: int | None = None
    reset: bool = False
    seed: int | None = None
    observe: bool = False
    prompt_guidance: float | None = None
    subtask: str | None = None
    generate: str | bool = False
    max_tokens: int | None = None


def keeps_episode(metadata: Mapping[str, Any]) -> bool:
    """Whether a policy of this metadata goes on from a robot's earlier observations, or from a subtask."""
    return "memory" in metadata or "subtasks" in metadata


PLAIN = CallOptions()


def message(
    observation: Mapping[str, Any],
    previous: RunningChunk | None = None,
    model_actions: bool = False,
    seed: int | None = None,
) -> dict[str, Any]:
    """The message to send: the observation, and the arguments of `UnifiedPolicy.infer` under their keys.

    `read_message` is its inverse.
    """
    options: dict[str, Any] = {} if seed is None else {"seed": seed}
    if model_actions:
        options["model_actions"] = True
    if previous is not None:
        options |= {
            "previous": np.asarray(previous.left_over, np.float32),
            "delay": int(previous.delay),
            "mode": previous.mode,
        }
        if previous.schedule is not None:
            options["schedule"] = previous.schedule
        if previous.max_guidance_weight is not None:
            options["max_guidance_weight"] = float(previous.max_guidance_weight)
        if previous.execution_horizon is not None:
            options["execution_horizon"] = int(previous.execution_horizon)
        if previous.anchor is not None:
            options["anchor"] = np.asarray(previous.anchor)
    return {**observation, **{PREFIX + key: value for key, value in options.items()}}


def is_plain(received: Mapping[str, Any]) -> bool:
    """Whether a message holds the observation alone, as those of openpi's clients do."""
    return not [key for key in received if key.startswith(PREFIX)]  # half of `any`'s time


def read_message(received: Mapping[str, Any]) -> tuple[dict[str, Any], CallOptions]:
    """The observation alone, and the options beside it. Raises ObservationError for values that can't be right."""
    if is_plain(received):
        return dict(received), PLAIN
    observation = {key: value for key, value in received.items() if not key.startswith(PREFIX)}
    given = {key.removeprefix(PREFIX): value for key, value in received.items() if key.startswith(PREFIX)}
    unknown = sorted(set(given) - set(KEYS))
    if unknown:
        raise ObservationError(
            f"{PREFIX}{unknown[0]} is no key of this server; keys that begin with {PREFIX!r} are "
            + ", ".join(PREFIX + key for key in KEYS)
        )
    mode = given.get("mode")
    if mode is not None and (not isinstance(mode, str) or mode not in get_args(JoinMode)):
        raise ObservationError(
            f"{PREFIX}mode is {mode!r:.100}; it should be one of {', '.join(get_args(JoinMode))}, or none in a session "
            "that joins nothing"
        )
    delay = _whole(given, "delay", 0)
    horizon = _whole(given, "execution_horizon", 0 if mode == "rtc_identity" and "previous" in given else 1)
    guidance = _guidance(given)
    session = given.get("session")
    if session is not None:
        session = as_name("session", session)
    left_over = _left_over(given)
    anchor = _numbers(given, "anchor", np.float64) if "anchor" in given else None
    previous = None
    if left_over is not None:
        assert delay is not None  # else `_left_over` refuses
        previous = RunningChunk(left_over, delay, horizon, cast("JoinMode", mode), anchor, **guidance)
    options = CallOptions(
        previous=previous,
        model_actions=_flag(given, "model_actions"),
        mode=cast("JoinMode | None", mode),
        delay=delay,
        execution_horizon=horizon,
        guidance=guidance or None,
        session=session,
        step=_whole(given, "step", 0),
        reset=_flag(given, "reset"),
        seed=_whole(given, "seed", 0, MAX_SEED),
        observe=_flag(given, "observe"),
        prompt_guidance=_scale(given),
        subtask=None if given.get("subtask") is None else _text(given, "subtask", "a text"),
        generate=_generate(given),
        max_tokens=_whole(given, "max_tokens", 1, MAX_TOKENS),
    )
    if options.max_tokens is not None and not options.generate:
        raise ObservationError(f"{PREFIX}max_tokens came without {PREFIX}generate, whose text it limits")
    return observation, options


def _scale(given: Mapping[str, Any]) -> float | None:
    if "guidance" not in given:
        return None
    scale = as_number(given["guidance"])
    if scale is None:
        raise ObservationError(f"{PREFIX}guidance is {given['guidance']!r:.100}; it should be a number")
    return float(scale)


def _generate(given: Mapping[str, Any]) -> str | bool:
    value = given.get("generate", False)
    if isinstance(value, bool | np.bool_):
        return bool(value)
    return _text(given, "generate", "true, or the prompt as a text")


def _text(given: Mapping[str, Any], key: str, what: str) -> str:
    value = given[key]
    if not (isinstance(value, str) and value.strip() and len(value) <= MAX_TEXT):
        raise ObservationError(f"{PREFIX}{key} is {value!r:.100}; it should be {what} of 1 to {MAX_TEXT} characters")
    return value


def _left_over(given: Mapping[str, Any]) -> np.ndarray | None:
    """float32[K, A], the rows of the running chunk that the client stores; None if it stores none."""
    if "previous" not in given:
        if "anchor" in given:
            raise ObservationError(f"{PREFIX}anchor came without {PREFIX}previous, to which it belongs")
        return None
    left_over = _numbers(given, "previous")
    if left_over.ndim != 2 or not len(left_over):
        raise ObservationError(
            f"{PREFIX}previous has shape {list(left_over.shape)}; it should be float32 [K, action_dim], the "
            'rows of "model_actions" that are left when the observation is taken'
        )
    if (too_large := np.abs(left_over) > MAX_ACTION).any():
        raise ObservationError(
            f"{_first(left_over, too_large, 'previous')}, whose square isn't finite in float32, in which the model "
            'computes. It should be rows of "model_actions", which are normalised: most are from -1 to 1'
        )
    for needed in ("mode", "delay"):
        if given.get(needed) is None:
            raise ObservationError(f"{PREFIX}previous came without {PREFIX}{needed}: give both mode and delay")
    if given.get("session") is not None:
        raise ObservationError(
            f"{PREFIX}previous and {PREFIX}session were both given: either the client keeps the running chunk, or "
            "the server does"
        )
    return left_over


def _guidance(given: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of `RunningChunk` that say how guidance works, as far as they were given."""
    guidance: dict[str, Any] = {}
    if "schedule" in given:
        schedule = given["schedule"]
        if not (isinstance(schedule, str) and schedule in get_args(Schedule)):
            raise ObservationError(
                f"{PREFIX}schedule is {schedule!r:.100}; it should be one of {', '.join(get_args(Schedule))}"
            )
        guidance["schedule"] = schedule
    if "max_guidance_weight" in given:
        weight = as_number(given["max_guidance_weight"])
        if weight is None or not 0 <= weight < np.inf:
            shown = given["max_guidance_weight"]
            raise ObservationError(f"{PREFIX}max_guidance_weight is {shown!r:.100}; it should be a number from 0")
        guidance["max_guidance_weight"] = float(weight)
    return guidance


def as_name(key: str, value: object, what: str = "") -> str:
    """A message's name of a session or a robot. Raises ObservationError, which says `what` it should be."""
    if not (isinstance(value, str) and 0 < len(value) <= MAX_SESSION):
        raise ObservationError(
            f"{PREFIX}{key} is {value!r:.100}; it should be {what}text of 1 to {MAX_SESSION} characters"
        )
    return value


def as_number(value: object) -> int | float | None:
    """A message's number: Python's, NumPy's, or an array's without axes. None for all else: booleans, times."""
    if isinstance(value, np.ndarray | np.generic) and value.ndim == 0 and value.dtype.kind in "iuf":
        value = value.item()
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None


def _whole(given: Mapping[str, Any], key: str, least: int, most: int = MAX_STEP) -> int | None:
    if given.get(key) is None:
        return None
    value = as_number(given[key])
    if not isinstance(value, int) or not least <= value <= most:
        numbers = f"{least}" if most in (MAX_STEP, MAX_SEED) else f"{least} to {most}"
        raise ObservationError(f"{PREFIX}{key} is {given[key]!r:.100}; it should be a whole number from {numbers}")
    return value


def _flag(given: Mapping[str, Any], key: str) -> bool:
    value = given.get(key, False)
    if not isinstance(value, bool | np.bool_):
        raise ObservationError(f"{PREFIX}{key} is {value!r:.100}; it should be true or false")
    return bool(value)


def _numbers(given: Mapping[str, Any], key: str, dtype: type[np.floating[Any]] = np.float32) -> np.ndarray:
    value = given[key]
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        raise ObservationError(f"{PREFIX}{key} is {type(value).__name__}; it should be an array of numbers")
    with np.errstate(over="ignore"):
        array = value.astype(dtype)
    if not (finite := np.isfinite(array)).all():
        raise ObservationError(f"{_first(value, ~finite, key)}; all should be finite in {np.dtype(dtype)}")
    return array


def _first(values: np.ndarray, bad: np.ndarray, key: str) -> str:
    """The beginning of an error's text: the first `bad` value, and its place."""
    place = tuple(int(axis) for axis in np.argwhere(bad)[0])
    return f"{PREFIX}{key} has {float(values[place]):.3g} at {list(place)}"


class Note(NamedTuple):
    """A note of an answer; kinds: turbopi.policy.watch. names: of the joints or cameras that it is about."""

    kind: str
    names: tuple[str, ...]
    text: str

    @property
    def plain(self) -> dict[str, Any]:
        """As it is sent."""
        return {"kind": self.kind, "names": list(self.names), "text": self.text}


def notes_in(answer: object) -> list[Note]:
    """The notes of an answer. What isn't one is left out: the policy may be of another make."""
    notes = answer.get(NOTES) if isinstance(answer, Mapping) else None
    return [
        Note(str(one.get("kind")), tuple(map(str, one["names"])), str(one.get("text")))
        for one in (notes[:MOST_NOTES] if isinstance(notes, list) else ())
        if isinstance(one, Mapping) and isinstance(one.get("names"), list | tuple)
    ]
