"""Where actions come from: a policy in this process, or an openpi websocket server."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from turbopi.errors import ConfigError, ObservationError, TurboPiError
from turbopi.serve.wire import WireError, pack, unpack
from turbopi.sim import SimSettings, Simulator

CONNECT_S = 10.0
ANSWER_S = 600.0  # a server's first call may compile


class PolicyLost(TurboPiError):
    """The policy server can't be reached, or went away."""


class PolicyRefused(TurboPiError):
    """The policy server answered with an error instead of actions."""


@dataclass(frozen=True)
class Answer:
    """actions float64[H, d]; infer_ms: the model alone, as the policy itself measured it, if it did."""

    actions: np.ndarray
    infer_ms: float | None


class PolicySource(Protocol):
    """Gives action chunks for observations.

    max_batch   how many it computes together; None: any number
    identity    plain values that make it the same policy when a run is continued
    about       plain values for the report
    """

    max_batch: int | None
    label: str
    identity: dict[str, Any]
    about: dict[str, Any]

    def infer(self, observations: Sequence[Mapping[str, Any]], seeds: Sequence[int]) -> list[Answer]:
        """One answer for each observation; `seeds` draw the noise, where the source lets them."""

    def close(self) -> None:
        """Let go of it."""


class LocalPolicy:
    """A UnifiedPolicy, or whatever has its `infer_batch` and `metadata`."""

    max_batch: int | None = None

    def __init__(self, policy: Any, weights: str | None = None, label: str | None = None) -> None:
        """`weights`: the checkpoint's fingerprint, which tells policies apart when a run is continued."""
        about = dict(policy.metadata)
        names = ("config", "backend", "precision", "num_denoising_steps", "robot", "device")
        self._policy, self.about = policy, about
        self.identity = {"weights": weights, "calibration": calibration_of(about)}
        self.identity |= {name: about.get(name) for name in names}
        default = f"{about.get('backend')} {about.get('precision')} {about.get('num_denoising_steps')} steps"
        self.label = label or default

    def infer(self, observations: Sequence[Mapping[str, Any]], seeds: Sequence[int]) -> list[Answer]:
        results = self._policy.infer_batch(list(observations), seed=list(seeds))
        return [_answer(result, "policy_timing") for result in results]

    def close(self) -> None:
        self._policy = None


def calibration_of(metadata: Mapping[str, Any]) -> str | None:
    """Which calibration a policy runs with (`Quantization.identity`), where its metadata tells; None: not in FP8."""
    details = metadata.get("backend_details")
    fp8 = details.get("fp8") if isinstance(details, Mapping) else None
    return fp8.get("identity") if isinstance(fp8, Mapping) else None


class RemotePolicy:
    """A server that speaks openpi's websocket protocol: Turbo-Pi's or openpi's own. It draws its own noise."""

    max_batch: int | None = 1

    def __init__(self, host: str, port: int | None = None, api_key: str | None = None) -> None:
        """Connects. `host` may be a URL, ws:// or wss://, as openpi's client has it. Raises PolicyLost if nobody
        answers there, ConfigError for a key that isn't the server's.
        """
        from websockets.exceptions import InvalidStatus, InvalidURI, WebSocketException
        from websockets.sync.client import connect

        if host.startswith(("ws://", "wss://")):
            url = host if port is None else f"{host}:{port}"
        else:
            port = 8000 if port is None else port
            url = f"ws://{f'[{host}]' if ':' in host else host}:{port}"
        self._where = url.removeprefix("ws://")
        self._open = contextlib.ExitStack()
        headers = {"Authorization": f"Api-Key {api_key}"} if api_key else None
        try:
            self._socket = self._open.enter_context(
                connect(
                    url,
                    additional_headers=headers,
                    compression=None,
                    max_size=None,
                    open_timeout=CONNECT_S,
                    ping_interval=None,  # openpi's server answers no ping while it computes
                )
            )
            greeting = self._socket.recv(timeout=CONNECT_S)
        except (InvalidURI, ValueError) as error:
            raise ConfigError(f"{url} is no address of a server: {error}") from error
        except (OSError, TimeoutError, WebSocketException) as error:
            if isinstance(error, InvalidStatus) and error.response.status_code in (401, 403):
                raise ConfigError(f"{url} wants its API key: --api-key KEY, or TURBOPI_API_KEY") from error
            chosen = "" if port is None else f" --port {port}"
            raise PolicyLost(
                f"no policy server at {url}: {_reason(error)}. Start one (turbopi serve CHECKPOINT{chosen}), "
                "then give the same command again: finished episodes are kept"
            ) from error
        metadata = _unpacked(greeting, self._where)
        volatile = ("load_seconds", "backend_details", "backend_reason")
        self.about = {"server": self._where, "metadata": metadata}
        server = {name: value for name, value in metadata.items() if name not in volatile}
        self.identity = {"server": server, "calibration": calibration_of(metadata)}
        described = " ".join(str(metadata[name]) for name in ("config", "backend", "precision") if name in metadata)
        self.label = f"{self._where} {described}".strip()

    def infer(self, observations: Sequence[Mapping[str, Any]], seeds: Sequence[int]) -> list[Answer]:
        return [self._one(observation) for observation in observations]

    def close(self) -> None:
        with contextlib.suppress(Exception):  # it may be gone already
            self._open.close()

    def _one(self, observation: Mapping[str, Any]) -> Answer:
        from websockets.exceptions import WebSocketException

        try:
            self._socket.send(pack(dict(observation)))
            reply = self._socket.recv(timeout=ANSWER_S)
        except (OSError, TimeoutError, WebSocketException) as error:
            raise PolicyLost(
                f"the policy server at {self._where} went away: {_reason(error)}. What was finished is kept: start the "
                "server again and give the same command to continue"
            ) from error
        if isinstance(reply, str):
            last = reply.strip().splitlines()[-1] if reply.strip() else "nothing"
            raise PolicyRefused(f"the policy server at {self._where} sent no actions but: {last}")
        return _answer(_unpacked(reply, self._where), "policy_timing", "server_timing")


def check_fit(source: PolicySource, simulator: Simulator, settings: SimSettings, image_px: int, replan: int) -> Answer:
    """Ask once, with an example. Raises ConfigError for a policy that can't act in this simulator."""
    from turbopi.images import resize_with_pad

    example = simulator.example(settings)
    example |= {key: resize_with_pad(example[key], image_px, image_px) for key in simulator.image_keys}
    robot = f"use one for the robot {simulator.robot}, such as config pi05_{simulator.robot}"
    try:
        answer = source.infer([example], [0])[0]
    except (ObservationError, PolicyRefused) as error:
        raise ConfigError(f"the policy doesn't take the observations of {simulator.name}: {error}; {robot}") from error
    horizon, width = answer.actions.shape
    if width != simulator.action_dim:
        raise ConfigError(
            f"the policy's actions have {width} numbers, but {simulator.name} needs {simulator.action_dim}; {robot}"
        )
    if horizon < replan:
        raise ConfigError(
            f"the policy's chunks have {horizon} actions, so it can't act {replan} steps before it is asked again: "
            f"give --replan {horizon} or less"
        )
    return answer


def _answer(result: Any, *timings: str) -> Answer:
    if not isinstance(result, Mapping) or "actions" not in result:
        found = f"the keys {sorted(map(str, result))}" if isinstance(result, Mapping) else f"a {type(result).__name__}"
        raise PolicyRefused(f"the policy's answer has no actions but {found}")
    try:
        actions = np.asarray(result["actions"], np.float64)
    except (TypeError, ValueError) as error:
        raise PolicyRefused(f"the policy's actions aren't numbers: {error}") from error
    if actions.ndim != 2:
        raise PolicyRefused(f"the policy's actions have shape {list(actions.shape)}; expected [horizon, width]")
    found_ms = [result[timing].get("infer_ms") for timing in timings if isinstance(result.get(timing), Mapping)]
    infer_ms = next((float(ms) for ms in found_ms if ms is not None), None)
    return Answer(actions, infer_ms)


def _unpacked(data: Any, where: str) -> dict[str, Any]:
    if isinstance(data, str):
        raise PolicyRefused(f"the server at {where} sent text where a message should be: {data.strip()[-300:]}")
    try:
        message = unpack(data)
    except WireError as error:
        raise PolicyRefused(f"the server at {where} doesn't speak openpi's protocol: {error}") from error
    if not isinstance(message, dict):
        raise PolicyRefused(f"the server at {where} sent a {type(message).__name__} where a map should be")
    return message


def _reason(error: BaseException) -> str:
    return str(error) or type(error).__name__
