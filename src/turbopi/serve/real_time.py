"""Real-time execution over the wire: what a request says about its running chunk, and sessions that store the chunk.

A client may store the running chunk itself: it requests "model_actions", and sends the rows that are left as
"turbopi/previous". Or the server stores it, in a session: then the server must know how many actions the robot has
carried out since the observation of the chunk before, and how many it will until the new chunk is there.
docs/serving_sessions.md says from what; what isn't known is refused, never guessed.
"""

import math
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from turbopi.realtime import DelayEstimate
from turbopi.realtime.messages import (
    KEYS,
    PLAIN,
    PREFIX,
    SCHEDULING_KEYS,
    CallOptions,
    is_plain,
    keeps_episode,
    read_message,
)
from turbopi.realtime.queue import default_execution_horizon, longest_delay
from turbopi.realtime.running_chunk import JoinMode, RunningChunk, refuses_guidance
from turbopi.serve.metrics import Metrics
from turbopi.serve.options import ServerOptions
from turbopi.support.errors import ConfigError, ObservationError

NO_JOINING = "none"  # a mode: the session is there for the order of its requests alone
MAX_SESSIONS = 256  # named ones with a chunk; a connection's own ends with it
GENERATE = "generate"  # an argument of a call that writes a text alone: those of the policy's `generate`
IDLE_SECONDS = 300.0  # a named session that got no chunk for so long is dropped


@dataclass(frozen=True)
class _Chunk:
    """The chunk that a session's robot carries out."""

    model_actions: np.ndarray  # float32[H, A]
    anchor: np.ndarray | None
    step: int | None  # the robot's count of actions at its observation, if the client sends one
    received: float  # when the observation came, by the server's clock


@dataclass
class _Session:
    chunk: _Chunk | None = None
    used: float = 0.0  # when it got its chunk
    connection: Hashable = None  # that requested the chunk; None: it has ended
    delays: DelayEstimate = field(default_factory=DelayEstimate)
    pending: "list[Plan]" = field(default_factory=list)  # requests that aren't released yet


@dataclass
class Plan:
    """One request: what the policy is given.

    When the policy has answered, give it to `RealTime.release`; if there are actions, then to `RealTime.finish`.
    """

    observation: dict[str, Any]
    arguments: dict[str, Any] = field(default_factory=dict)  # of `policy.infer`, besides the observation
    requested: CallOptions = PLAIN
    session: _Session | None = None
    name: str | None = None  # of the session
    received: float = 0.0
    connection: Hashable = None
    about: dict[str, Any] = field(default_factory=dict)  # what the answer says of it, under "real_time"
    remembered: Any = None  # serve/memory.py's, of a policy with memory


class RealTime:
    """Plans each request for one policy, and stores the sessions' running chunks. For the event loop's thread alone.

    A session is stored only once it has a chunk. So refused requests, however many and of any name, end no
    session of others.

    waits  whether a request of the session of that name still waits for its turn: then a newer one replaces it

    Raises ConfigError as `check_execution`.
    """

    def __init__(
        self,
        metadata: Mapping[str, Any],
        options: ServerOptions,
        metrics: Metrics,
        clock: Callable[[], float] = time.monotonic,
        waits: Callable[[str], bool] = lambda name: False,
    ) -> None:
        offered = metadata.get("real_time")
        self._offered: Mapping[str, Any] = offered if isinstance(offered, Mapping) else {}
        self._modes = list(self._offered.get("modes", ()))
        self._remembers, self._writes = keeps_episode(metadata), "text" in metadata
        self._acts_on_subtasks, self._guided = "subtasks" in metadata, "guidance" in metadata
        self._options, self._metrics, self._clock, self._waits = options, metrics, clock, waits
        # Those with a chunk, the one that got its chunk last at the end, and those with only a request.
        self._named: OrderedDict[str, _Session] = OrderedDict()
        self._of_connections: dict[Hashable, _Session] = {}
        self._horizon: int | None = metadata.get("action_horizon")
        check_execution(options, self._offered, self._horizon)
        metrics.watch_sessions(lambda: sum(one.chunk is not None for one in self._all()))

    @property
    def metadata(self) -> dict[str, Any]:
        """What the greeting says besides the policy's own: {} for a policy that joins no chunks."""
        if not self._modes:
            return {}
        return {
            "real_time": {
                **self._offered,
                "keys": [PREFIX + key for key in KEYS],
                "execution": self._options.execution,
                "control_hz": self._options.control_hz,
                "sessions": {"most": MAX_SESSIONS, "idle_seconds": IDLE_SECONDS},
            }
        }

    @property
    def description(self) -> str | None:
        """How this server joins the chunks of clients that don't say how, on one line; None if it doesn't."""
        options, horizon = self._options, self._horizon
        if options.execution is None:
            return None
        carried_out = options.execution_horizon or (None if horizon is None else default_execution_horizon(horizon))
        of_chunk = "half of a chunk" if carried_out is None else f"{carried_out} of {horizon or 'a chunk'}"
        delay = f"{options.delay_steps} control steps"
        if options.delay_steps is None:
            delay = "measured here, without the network (or --delay-steps)"
        return (
            f"Joins each client's chunks by {options.execution}: robots carry out {options.control_hz:g} actions a "
            f"second (--control-hz), {of_chunk} before the next chunk takes over; the delay is {delay}. "
            f"A request's {PREFIX}step, {PREFIX}delay and {PREFIX}execution_horizon come first"
        )

    # --- requests -----------------------------------------------------------------------------------------------------

    def plan(self, received: Mapping[str, Any], connection: Hashable) -> Plan:
        """What to do with a request that has just come. Raises ObservationError."""
        if self._options.execution is None and is_plain(received):
            return Plan(dict(received))
        now = self._clock()
        mode = received.get(PREFIX + "mode")
        unconditioned = isinstance(mode, str) and mode == NO_JOINING
        if unconditioned:
            received = {key: value for key, value in received.items() if key != PREFIX + "mode"}
        observation, requested = read_message(received)
        if requested.observe and not self._remembers:
            raise ObservationError(f"{PREFIX}observe is for a policy with memory, and this server's has none")
        if requested.generate:
            return Plan(observation, {GENERATE: self._text(requested)}, requested, name=requested.session)
        if requested.subtask is not None and not self._acts_on_subtasks:
            raise ObservationError(f"{PREFIX}subtask is for a policy that acts on subtasks, and this server's doesn't")
        seeded = _of_call(requested)
        if "guidance" in seeded and not self._guided:
            raise ObservationError(
                f"{PREFIX}guidance is for a policy with a tag, and this server's has none: start it with --guidance-tag"
            )
        if self._joins_nothing(requested, unconditioned) and (self._modes or requested.seed is None):
            return Plan(observation, seeded, requested, name=requested.session)
        if not self._modes:
            raise ObservationError(
                f"this server's policy joins no chunks (its metadata offers no real-time modes): leave out "
                f"the keys that begin with {PREFIX!r}"
            )
        mode = requested.mode or self._options.execution
        if mode is not None and mode not in self._modes:
            raise ObservationError(f"{PREFIX}mode is {mode!r}, which this policy can't: it offers {self._modes}")
        if mode is not None and requested.guidance:
            named = {PREFIX + name: value for name, value in requested.guidance.items()}
            if (why := refuses_guidance(mode, named)) is not None:
                raise ObservationError(why)
        if requested.session is None and (requested.previous is not None or requested.model_actions):
            if not self._remembers and (requested.step is not None or requested.reset):
                raise ObservationError(
                    f"{PREFIX}step and {PREFIX}reset are for sessions, but here the client keeps its running chunk"
                )
            arguments = {"previous": requested.previous, "model_actions": requested.model_actions, **seeded}
            about: dict[str, Any] = {"joined": requested.previous is not None}
            if requested.previous is not None:
                about |= {"mode": requested.previous.mode, "delay": requested.previous.delay}
            return Plan(observation, arguments, requested, received=now, about=about)
        if requested.session is None and self._options.execution is None:
            raise ObservationError(
                f"the keys {_named(received)} need a session, as the server keeps no running chunk for this "
                f"connection: give {PREFIX}session, too, or start the server with --execution"
            )
        if mode is None:
            raise ObservationError(
                f"{PREFIX}session came without {PREFIX}mode; it should be one of {self._modes} "
                "(or start the server with --execution)"
            )
        return self._plan_in_session(observation, requested, mode, connection, now)

    def _text(self, requested: CallOptions) -> dict[str, Any]:
        """The arguments of the policy's `generate`. Raises ObservationError."""
        alone = CallOptions(session=requested.session, generate=requested.generate, max_tokens=requested.max_tokens)
        if requested != alone:
            raise ObservationError(
                f"{PREFIX}generate asks for a text and no actions: it goes with {PREFIX}max_tokens and "
                f"{PREFIX}session alone"
            )
        if not self._writes:
            raise ObservationError(
                f"{PREFIX}generate is for a policy that writes text (`text` in its metadata), and this server's "
                "doesn't: docs/text.md says which do"
            )
        prompt = requested.generate if isinstance(requested.generate, str) else None
        return {"prompt": prompt, "max_tokens": requested.max_tokens}

    def _joins_nothing(self, requested: CallOptions, unconditioned: bool) -> bool:
        """Whether a request needs no chunk. `unconditioned`: its mode is NO_JOINING. Raises ObservationError."""
        of_chunk = replace(requested, seed=None, observe=False, prompt_guidance=None, subtask=None)
        if self._remembers:  # these are of its history, too
            of_chunk = replace(of_chunk, reset=False, step=None)
        plain = of_chunk == CallOptions(session=requested.session)
        if requested.observe and not plain:
            raise ObservationError(
                f"{PREFIX}observe records an observation and computes no chunk: it goes with {PREFIX}session, "
                f"{PREFIX}step and {PREFIX}reset alone"
            )
        if unconditioned and (requested.session is None or not plain):
            raise ObservationError(
                f"{PREFIX}mode {NO_JOINING!r} joins nothing: it needs {PREFIX}session, and goes with no other key of "
                "real-time execution"
            )
        if requested.observe:
            return True
        if requested.session is None or self._remembers:
            return unconditioned or (plain and self._options.execution is None)
        return unconditioned or (plain and not self._modes)

    def _plan_in_session(
        self, observation: dict[str, Any], requested: CallOptions, mode: JoinMode, connection: Hashable, now: float
    ) -> Plan:
        session = self._session(requested, connection, now)
        chunk = None if requested.reset else session.chunk
        previous, about = None, {"joined": False, "mode": mode}
        if chunk is not None:
            previous, more = self._previous(session, chunk, requested, mode, now)
            about |= more
        elif requested.step is None:
            self._need_control_hz()
        arguments = {"previous": previous, "model_actions": True, **_of_call(requested)}
        plan = Plan(observation, arguments, requested, session, requested.session, now, connection, about)
        session.chunk = chunk
        session.pending.append(plan)
        if requested.session is None:
            self._of_connections[connection] = session
        else:
            self._named.setdefault(requested.session, session)
        return plan

    def finish(self, plan: Plan, result: dict[str, Any]) -> dict[str, Any]:
        """The answer to a request, of the policy's result."""
        if "previous" not in plan.arguments:  # nothing was requested of running chunks
            return result
        session, previous = plan.session, plan.arguments["previous"]
        self._metrics.joined(bool(plan.about.get("joined")))
        if session is not None:
            now = self._clock()
            model_actions = np.asarray(result["model_actions"], np.float32)
            chunk = _Chunk(model_actions, result.get("anchor"), plan.requested.step, plan.received)
            self._store(chunk, plan, session, now)
            if self._options.control_hz is not None:
                session.delays.add(math.ceil(round((now - plan.received) * self._options.control_hz, 6)))
        if previous is not None:
            self._metrics.delay_steps.observe(previous.delay)
            if "model_actions" in result and previous.delay < len(previous.left_over):
                new = np.asarray(result["model_actions"])[previous.delay]
                self._metrics.seam_gap.observe(float(np.abs(new - previous.left_over[previous.delay]).max()))
        if not plan.requested.model_actions:
            result = {key: value for key, value in result.items() if key not in ("model_actions", "anchor")}
        return {**result, "real_time": plan.about}

    def release(self, plan: Plan) -> None:
        """The session may have its next request. Without a result its robot goes on with the chunk it has."""
        session = plan.session
        if session is None:
            return
        session.pending.remove(plan)
        if session.chunk is None and not session.pending and self._named.get(plan.name or "") is session:
            del self._named[plan.name or ""]

    def closed(self, connection: Hashable) -> None:
        """A connection has ended, and its own session with it."""
        own = self._of_connections.pop(connection, None)
        if own is not None and own.chunk is not None:
            self._metrics.session_dropped("closed")
        for session in self._named.values():
            if session.connection == connection:
                session.connection = None

    # --- sessions -----------------------------------------------------------------------------------------------------

    def _all(self) -> Iterable[_Session]:
        return (*self._named.values(), *self._of_connections.values())

    def _session(self, requested: CallOptions, connection: Hashable, now: float) -> _Session:
        """The session of a request, which may be new: then it isn't stored yet."""
        self._drop_idle(now)
        if requested.session is None:
            return self._of_connections.get(connection) or _Session()
        session = self._named.get(requested.session) or _Session()
        if session.pending and not self._waits(requested.session):
            raise ObservationError(
                f"session {requested.session!r} has a request that isn't answered yet: give each robot its own session"
            )
        return session

    def _store(self, chunk: _Chunk, plan: Plan, session: _Session, now: float) -> None:
        """A session has got its chunk. A named one may have to make room for it."""
        session.chunk, session.used, session.connection = chunk, now, plan.connection
        if plan.name is None:
            return
        self._named[plan.name] = session  # again, if it was dropped meanwhile
        self._named.move_to_end(plan.name)
        others = [name for name, one in self._named.items() if one.chunk is not None and one is not session]
        if len(others) >= MAX_SESSIONS:
            self._drop(self._least_missed(others), "full")

    def _least_missed(self, names: list[str]) -> str:
        """Of those whose connection has the most sessions, the one that got its chunk longest ago.

        Sessions whose connection has ended count as those of one connection. One with a request is spared if possible.
        """
        of = Counter(self._named[name].connection for name in names)
        return min(names, key=lambda name: (bool(self._named[name].pending), -of[self._named[name].connection]))

    def _drop_idle(self, now: float) -> None:
        for name, session in tuple(self._named.items()):
            if session.chunk is not None and now - session.used <= IDLE_SECONDS:
                return
            if not session.pending:
                self._drop(name, "idle")

    def _drop(self, name: str, why: str) -> None:
        del self._named[name]
        self._metrics.session_dropped(why)

    # --- the running chunk --------------------------------------------------------------------------------------------

    def _previous(
        self, session: _Session, chunk: _Chunk, requested: CallOptions, mode: JoinMode, now: float
    ) -> tuple[RunningChunk | None, dict[str, Any]]:
        """What is left of a session's chunk (None: nothing), and what the answer says of it.

        Raises ObservationError if the request's own delay doesn't fit.
        """
        horizon = len(chunk.model_actions)
        row, by = self._carried_out(chunk, requested, now)
        about: dict[str, Any] = {"row": row, "row_by": by}
        if row >= horizon:
            return None, about
        s = self._execution_horizon(requested, horizon)
        longest = horizon - max(s, row)
        trained = int(self._offered.get("trained_max_delay") or 0)
        fits = min(longest, trained) if mode == "rtc_trained" else longest
        if requested.delay is not None and requested.delay > fits:
            why = (
                f"this checkpoint was trained with delays up to {trained}"
                if fits < longest
                else f"with chunks of H = {horizon} actions, s = {max(s, row)} carried out, H − s = {longest}"
            )
            raise ObservationError(
                f"{PREFIX}delay is {requested.delay} control steps, but {why}: at most {fits} fit. Ask earlier "
                f"(a smaller execution horizon), or lower the control rate"
            )
        wanted = self._expected_delay(session, requested)
        delay = min(wanted, fits)
        about |= {"joined": True, "delay": delay, "execution_horizon": max(s, row), "delay_cut": delay < wanted}
        left_over = chunk.model_actions[row:]
        guidance = dict(requested.guidance or {})
        return RunningChunk(left_over, delay, max(s, row), mode, chunk.anchor, **guidance), about

    def _expected_delay(self, session: _Session, requested: CallOptions) -> int:
        """Control steps from the observation to its chunk: what the request says, else the option, else measured."""
        if requested.delay is not None:
            return requested.delay
        if self._options.delay_steps is not None:
            return self._options.delay_steps
        self._need_control_hz()
        return session.delays.steps

    def _carried_out(self, chunk: _Chunk, requested: CallOptions, now: float) -> tuple[int, str]:
        """How many actions the robot has carried out since the stored chunk's observation, and how that is known."""
        if (requested.step is None) != (chunk.step is None):
            raise ObservationError(
                f"{PREFIX}step came in some requests of this session and not in others: send it always or never "
                f"({PREFIX}reset begins anew)"
            )
        if requested.step is not None and chunk.step is not None:
            if requested.step < chunk.step:
                raise ObservationError(
                    f"{PREFIX}step is {requested.step}, after {chunk.step} in the request before: it counts the "
                    f"actions that the robot has carried out in the session. For a new episode send {PREFIX}reset"
                )
            return requested.step - chunk.step, "step"
        return round((now - chunk.received) * self._need_control_hz()), "clock"

    def _need_control_hz(self) -> float:
        if self._options.control_hz is None:
            raise ObservationError(
                f"the server doesn't know how fast the robot carries out actions: send {PREFIX}step and {PREFIX}delay "
                "in every request, or start it with --control-hz"
            )
        return self._options.control_hz

    def _execution_horizon(self, requested: CallOptions, horizon: int) -> int:
        for s in (requested.execution_horizon, self._options.execution_horizon):
            if s is not None:
                if s > horizon:
                    raise ObservationError(
                        f"the execution horizon is {s}, but this policy's chunks have {horizon} actions: send "
                        f"{PREFIX}execution_horizon from 1 to {horizon}"
                    )
                return s
        return default_execution_horizon(horizon)


def check_execution(options: ServerOptions, offered: Mapping[str, Any], horizon: int | None) -> None:
    """Raise ConfigError if a policy can't do what the options request.

    offered  its metadata's "real_time"
    horizon  actions of its chunks; None: it doesn't say
    """
    execution, modes, s = options.execution, list(offered.get("modes", ())), options.execution_horizon
    if execution is not None and execution not in modes:
        what = f"it offers {modes}" if modes else "it offers none"
        if execution == "rtc_trained" and modes:
            what += (
                ". That mode is for checkpoints that were trained with simulated delays; if this one was, put "
                '{"real_time": {"trained_max_delay": …}} into a turbopi.json'
            )
        raise ConfigError(f"execution={execution!r} was asked for, which this policy can't: {what}")
    if s is not None and horizon is not None and s > horizon:
        raise ConfigError(
            f"execution_horizon={s} was asked for, but this policy's chunks have {horizon} actions: give at most that"
        )
    if options.delay_steps is not None:
        _check_delay(options, options.delay_steps, offered, horizon)


def _check_delay(options: ServerOptions, delay: int, offered: Mapping[str, Any], horizon: int | None) -> None:
    """Raise ConfigError for a delay that would be cut in every call."""
    trained = int(offered.get("trained_max_delay") or 0)
    if options.execution == "rtc_trained" and delay > trained:
        raise ConfigError(
            f"delay_steps={delay} was asked for, but this checkpoint was trained with delays up to {trained}: give at "
            "most that, or execution='rtc'"
        )
    if horizon is None:
        return
    s = options.execution_horizon or default_execution_horizon(horizon)
    if delay > (most := longest_delay(horizon, s)):
        raise ConfigError(
            f"delay_steps={delay} was asked for, but with chunks of {horizon} actions and an execution horizon of {s} "
            f"at most {most} control steps fit: give at most that, another execution_horizon=, or a lower control rate"
        )


def _of_call(requested: CallOptions) -> dict[str, Any]:
    """Arguments of `infer` that the client chose, and that have nothing to do with chunks."""
    chosen = {"seed": requested.seed, "guidance": requested.prompt_guidance, "subtask": requested.subtask}
    return {name: value for name, value in chosen.items() if value is not None}


def _named(received: Mapping[str, Any]) -> str:
    keys = [key for key in received if key.startswith(PREFIX) and key.removeprefix(PREFIX) not in SCHEDULING_KEYS]
    return ", ".join(keys)
