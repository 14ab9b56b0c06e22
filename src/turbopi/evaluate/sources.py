"""Where actions come from: a policy in this process, or an openpi websocket server."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any
from typing import Protocol as Interface

import numpy as np
import torch

from turbopi.policy.call_options import MAX_BATCH
from turbopi.policy.history import refuse_memory
from turbopi.quantization.formats import named_by
from turbopi.realtime.messages import PREFIX, message
from turbopi.realtime.queue import of_batch
from turbopi.realtime.running_chunk import JoinMode
from turbopi.realtime.wire import WireError, pack_parts, unpack
from turbopi.support.errors import ActionError, ConfigError, TurboPiError
from turbopi.support.reading import is_finite, shown
from turbopi.support.text import denoising, kind_of

CONNECT_S = 10.0
ANSWER_S = 600.0  # a server's first call may compile
BAD_ACTIONS = "bad actions: "  # begins a Turbo-Pi server's answer where the model computed NaN or infinity
MAX_MS = 1e12
MAX_REPORTED = 10_000  # numbers of an array in a server's metadata


class PolicyLost(TurboPiError):
    """The policy server can't be reached, or went away."""


class PolicyRefused(TurboPiError):
    """The policy answered with something else than actions: an error, or what isn't openpi's protocol."""


@dataclass(frozen=True)
class Answer:
    """actions float64[H, d]; infer_ms: the model alone, as the policy itself measured it, if it did.

    problem   why the actions can't be used, if the policy found that itself: they weren't finite, and aren't given
    for_next  what the next chunk is told of this one, if that was asked for: "model_actions", and "anchor"
    """

    actions: np.ndarray
    infer_ms: float | None
    problem: str | None = None
    for_next: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def unusable(cls, problem: str) -> "Answer":
        return cls(np.zeros((0, 0)), None, problem)


class PolicySource(Interface):
    """Gives action chunks for observations.

    max_batch   how many it computes together; None: any number
    identity    plain values that make it the same policy when a run is continued
    about       plain values for the report
    real_time   what it offers for chunks that join: its metadata's "real_time"; empty if it offers nothing
    """

    max_batch: int | None
    label: str
    identity: dict[str, object]
    about: dict[str, object]
    real_time: Mapping[str, Any]

    def infer(
        self,
        observations: Sequence[Mapping[str, object]],
        seeds: Sequence[int],
        arguments: Sequence[Mapping[str, Any]] | None = None,
    ) -> list[Answer]:
        """One answer for each observation; `seeds` draw the noise, where the source lets them.

        Observations may have keys of `turbopi.realtime.messages`, too, for a server that keeps the running chunk.

        arguments   what each request tells the policy of the running chunk (turbopi.realtime). None: nothing
        """

    def warm_up(self, most: int, mode: JoinMode | None, tell: Callable[[str], None]) -> None:
        """Prepare for a run that gives up to `most` observations at once and joins chunks in this mode, if in any.

        tell   is given a line before what takes long, and one after it
        """

    def close(self) -> None:
        """Let go of it."""


class LocalPolicy:
    """A UnifiedPolicy, or whatever has its `infer_batch` and `metadata`; with `runs_batches`, its `warmup`, too."""

    max_batch: int | None = None

    def __init__(self, policy: Any, weights: str | None = None, label: str | None = None) -> None:
        """`weights`: the checkpoint's fingerprint, which tells policies apart when a run is continued."""
        about: dict[str, object] = dict(policy.metadata)
        refuse_memory(about, "an evaluation")
        names = ("config", "backend", "precision", "num_denoising_steps", "robot", "device")
        self._policy, self.about = policy, about
        self.real_time = offered(about)
        self.identity: dict[str, object] = {"weights": weights, "calibration": calibration_of(about)}
        self.identity |= {name: about.get(name) for name in names}
        # what isn't told, as by runs from before it was an option, is openpi's
        openpis = {"solver": "euler", "time_grid": "uniform", "guidance": None, "guidance_tag": None}
        self.identity |= {name: about[name] for name, usual in openpis.items() if about.get(name, usual) != usual}
        default = f"{about.get('backend')} {about.get('precision')} {denoising(about)}"
        self.label = label or default

    def infer(
        self,
        observations: Sequence[Mapping[str, object]],
        seeds: Sequence[int],
        arguments: Sequence[Mapping[str, Any]] | None = None,
    ) -> list[Answer]:
        reported = [{}] * len(observations) if arguments is None else arguments
        try:
            results = self._policy.infer_batch(list(observations), seed=list(seeds), **of_batch(reported))
        except ActionError as error:
            if len(observations) == 1:
                return [Answer.unusable(str(error))]
            each = zip(observations, seeds, reported, strict=True)  # the others' actions are good
            return [self.infer([observation], [seed], [more])[0] for observation, seed, more in each]
        return [replace(_answer(result, "policy_timing"), for_next=_for_next(result)) for result in results]

    def warm_up(self, most: int, mode: JoinMode | None, tell: Callable[[str], None]) -> None:
        """Only where the policy runs observations together; single ones without a running chunk are warm already."""
        if not getattr(self._policy, "runs_batches", False):
            return
        arguments: dict[str, Any] = {}
        if most > 1:  # any number of them may wait together
            arguments["batches"] = list(range(2, min(most, MAX_BATCH) + 1))
        if mode is not None:
            arguments["real_time"] = mode
        if not arguments:
            return
        requested = ([] if most == 1 else [f"batches of up to {most}"]) + ([] if mode is None else [f"mode {mode}"])
        tell(f"Warming up {', '.join(requested)} …")
        try:
            seconds = self._policy.warmup(**arguments)
        except torch.OutOfMemoryError as error:
            if most == 1:
                raise
            raise ConfigError(
                f"warm-up of {', '.join(requested)} takes more than the GPU's memory: {error}. Give a smaller "
                "--max-batch, or fewer --workers"
            ) from error
        tell(f"warm-up: {seconds:.2f} s")

    def close(self) -> None:
        self._policy = None


def calibration_of(metadata: Mapping[str, object]) -> str | None:
    """Which calibration a policy runs with (`Quantization.identity`), where its metadata tells; None: it has none."""
    identity = (named_by(metadata.get("backend_details")) or {}).get("identity")
    return identity if isinstance(identity, str) else None


def offered(metadata: Mapping[str, Any]) -> Mapping[str, Any]:
    """What a policy's metadata says of chunks that join; empty if it says nothing."""
    reported = metadata.get("real_time")
    return reported if isinstance(reported, Mapping) else {}


class RemotePolicy:
    """A server that speaks openpi's websocket protocol: Turbo-Pi's or openpi's own.

    It draws its own noise, unless it takes seeds: `turbopi/seed` is one of the keys that its metadata lists.
    """

    max_batch: int | None = 1

    def __init__(self, host: str, port: int | None = None, api_key: str | None = None) -> None:
        """Connects. `host` may be a URL, ws:// or wss://, as openpi's client has it. Raises PolicyLost if nobody
        answers there, ConfigError for a key that isn't the server's.
        """
        from websockets.exceptions import InvalidStatus, InvalidURI, WebSocketException

        from turbopi.realtime.policy_socket import PolicySocket

        if host.startswith(("ws://", "wss://")):
            url = host if port is None else f"{host}:{port}"
        else:
            port = 8000 if port is None else port
            url = f"ws://{f'[{host}]' if ':' in host else host}:{port}"
        self._where = url.removeprefix("ws://")
        try:
            self._socket = PolicySocket(url, api_key, CONNECT_S)
        except (InvalidURI, ValueError) as error:
            raise ConfigError(f"{url} is no address of a server: {error}") from error
        except (OSError, WebSocketException) as error:
            if isinstance(error, InvalidStatus) and error.response.status_code in (401, 403):
                raise ConfigError(f"{url} wants its API key: --api-key-file FILE, or TURBOPI_API_KEY") from error
            chosen = "" if port is None else f" --port {port}"
            raise PolicyLost(
                f"no policy server at {url}: {_reason(error)}. Start one (turbopi serve CHECKPOINT{chosen}), "
                "then give the same command again: finished episodes are kept"
            ) from error
        try:
            metadata = _reported(_unpacked(self._socket.greeting, self._where), self._where)
        except PolicyRefused:
            self.close()
            raise
        refuse_memory(metadata, "an evaluation")
        volatile = ("load_seconds", "backend_details", "backend_reason")
        self.about: dict[str, object] = {"server": self._where, "metadata": metadata}
        self.real_time = offered(metadata)
        keys = self.real_time.get("keys")
        self.takes_seeds = isinstance(keys, list) and f"{PREFIX}seed" in keys
        server = {name: value for name, value in metadata.items() if name not in volatile}
        self.identity: dict[str, object] = {"server": server, "calibration": calibration_of(metadata)}
        names = [name for name in ("config", "backend", "precision") if name in metadata]
        described = " ".join(_printable(str(metadata[name])[:80]) for name in names)
        self.label = f"{self._where} {described}".strip()

    def infer(
        self,
        observations: Sequence[Mapping[str, object]],
        seeds: Sequence[int],
        arguments: Sequence[Mapping[str, Any]] | None = None,
    ) -> list[Answer]:
        reported = arguments if arguments is not None else [{}] * len(observations)
        return [
            self._one(message(observation, **more, seed=seed if self.takes_seeds else None))
            for observation, seed, more in zip(observations, seeds, reported, strict=True)
        ]

    def warm_up(self, most: int, mode: JoinMode | None, tell: Callable[[str], None]) -> None:
        """Nothing: a server has warmed itself up."""

    def close(self) -> None:
        self._socket.close()

    def _one(self, requested: dict[str, Any]) -> Answer:
        from websockets.exceptions import WebSocketException

        try:
            reply = self._socket.ask(pack_parts(requested), ANSWER_S)
        except (OSError, WebSocketException) as error:
            raise PolicyLost(
                f"the policy server at {self._where} went away: {_reason(error)}. What was finished is kept: start the "
                "server again and give the same command to continue"
            ) from error
        if isinstance(reply, str):
            if reply.startswith(BAD_ACTIONS):
                return Answer.unusable(_printable(reply.removeprefix(BAD_ACTIONS)))
            lines = reply.strip().splitlines() or ["nothing"]
            raise PolicyRefused(f"the policy server at {self._where} sent no actions but: {_printable(lines[-1])}")
        result = _unpacked(reply, self._where)
        return replace(_answer(result, "policy_timing", "server_timing"), for_next=_for_next(result))


def _for_next(result: Mapping[str, object]) -> dict[str, np.ndarray]:
    """What the next chunk is told of this one, where the policy was asked for it. Raises PolicyRefused."""
    found = {name: np.asarray(result[name]) for name in ("model_actions", "anchor") if result.get(name) is not None}
    for name, value in found.items():
        if value.dtype.kind not in "fiu":
            raise PolicyRefused(f"the policy's {name} aren't numbers but {shown(result[name])}")
    return found


def _answer(result: object, *timings: str) -> Answer:
    """The actions, which may still be NaN, and the time. Raises PolicyRefused for whatever else this is."""
    if not isinstance(result, Mapping) or "actions" not in result:
        found = f"the keys {shown(list(result))}" if isinstance(result, Mapping) else kind_of(result)
        raise PolicyRefused(f"the policy's answer has no actions but {found}")
    try:
        actions = np.asarray(result["actions"])
    except (TypeError, ValueError, OverflowError) as error:  # lists of different lengths
        raise PolicyRefused(f"the policy's actions aren't numbers: {error}") from error
    if actions.dtype.kind not in "fiu":
        raise PolicyRefused(f"the policy's actions aren't numbers but {actions.dtype}: {shown(result['actions'])}")
    if actions.ndim != 2 or not actions.size:
        raise PolicyRefused(f"the policy's actions have shape {list(actions.shape)}; expected [horizon, width]")
    infer_ms = next((ms for ms in (_milliseconds(result, timing) for timing in timings) if ms is not None), None)
    return Answer(actions.astype(np.float64), infer_ms)


def _milliseconds(result: Mapping[str, object], timing: str) -> float | None:
    """How long the model took, as a part of the answer tells it; None if it doesn't."""
    reported = result.get(timing)
    if reported is None or not isinstance(reported, Mapping) or reported.get("infer_ms") is None:
        return None
    value = reported["infer_ms"].item() if isinstance(reported["infer_ms"], np.generic) else reported["infer_ms"]
    if not is_finite(value) or not 0 <= value <= MAX_MS:
        raise PolicyRefused(f"the policy's {timing} says infer_ms = {shown(value)}; expected milliseconds")
    return float(value)


def _reported(value: Any, where: str, key: str = "metadata") -> Any:
    """What a server tells of itself, as JSON has it. Raises PolicyRefused, with the key, for what JSON hasn't."""
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "fiubU" and value.size <= MAX_REPORTED:
        value = value.tolist()
    if isinstance(value, Mapping) and all(isinstance(name, str) for name in value):
        return {name: _reported(item, where, f"{key}.{name}") for name, item in value.items()}
    if isinstance(value, list):
        return [_reported(item, where, key) for item in value]
    if value is None or isinstance(value, str | bool) or is_finite(value):
        return value
    raise PolicyRefused(
        f"the server at {where} tells {key} = {shown(value)}; expected text, finite numbers, lists and maps of them"
    )


def _unpacked(data: str | bytes, where: str) -> dict[str, object]:
    if isinstance(data, str):
        raise PolicyRefused(f"the server at {where} sent text where a message should be: {_printable(data.strip())}")
    try:
        message = unpack(data)
    except WireError as error:
        raise PolicyRefused(f"the server at {where} doesn't speak openpi's protocol: {error}") from error
    if not isinstance(message, dict):
        raise PolicyRefused(f"the server at {where} sent {kind_of(message)} where a map should be")
    return message


def _printable(text: str) -> str:
    """The end of a text on one line, without what would move a terminal's cursor."""
    return "".join(c if c.isprintable() else " " for c in text[-500:])


def _reason(error: BaseException) -> str:
    return str(error) or type(error).__name__
