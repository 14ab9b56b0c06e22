"""A model server for allenai's vla-evaluation-harness: its containers run benchmarks, `turbopi serve` has the policy.

    turbopi serve checkpoints/pi05_libero --config pi05_libero --port 8001 &
    python examples/vla_eval_server.py --port 8000          # pip install vla-eval; then `vla-eval run`, in its clone

docs/evaluation.md says which benchmarks fit which checkpoints. It needs no PyTorch. Each shard of the harness has a
connection of its own to the policy's server, which computes them in batches and answers mistakes one by one.
"""

import asyncio
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from vla_eval.model_servers.base import ModelServer, SessionContext
from vla_eval.model_servers.serve import run_server
from vla_eval.specs import IMAGE_RGB, LANGUAGE, RAW, DimSpec

from turbopi import ConfigError, ObservationError, TurboPiError
from turbopi.realtime import RealTimeClient

# LIBERO, LIBERO-Plus, -Pro, -Mem and RoboCerebra: the policy's key -> where the benchmark's observation has it
KEYS = {
    "observation/image": "images/agentview",  # uint8[256, 256, 3], turned by 180 degrees already, as is the next
    "observation/wrist_image": "images/wrist",
    "observation/state": "states",  # float[8]: end effector position, axis-angle, finger positions
    "prompt": "task_description",
}
ACTIONS = {"position": "delta_xyz", "rotation": "axis_angle", "gripper": "binary_close_positive"}


class Session:
    """One shard's episode: its connection to the policy, from the first observation on, and the rest of its chunk."""

    def __init__(self) -> None:
        self.client: RealTimeClient | None = None
        self.chunk: deque[np.ndarray] = deque()


class TurboPi(ModelServer):
    """Answers each observation with one action, float32[d], of a chunk from a policy server.

    policy       the policy server's URL, turbopi's or openpi's; api_key: if it has one
    chunk_size   actions that are carried out of each chunk. 5 is openpi's for LIBERO. The next chunk starts from a new
                 observation: chunks never overlap, so there is nothing to ensemble
    keys         the policy's key -> where the benchmark's observation has it, "/" for a map in a map
    actions      what the policy's actions are, name -> a format of vla_eval.specs. The harness warns if the benchmark
                 takes others; nothing is converted here. Give yours where `keys` are yours

    Raises ConfigError for a policy that can't be evaluated like this, ServerLost if none answers.
    """

    def __init__(
        self,
        policy: str = "ws://127.0.0.1:8001",
        api_key: str | None = None,
        chunk_size: int = 5,
        keys: dict[str, str] | None = None,
        actions: dict[str, str] | None = None,
    ) -> None:
        self.policy, self.api_key, self.chunk_size = policy, api_key, chunk_size
        self.keys = KEYS if keys is None else keys
        self.actions = (ACTIONS if keys is None else {}) if actions is None else actions
        self._sessions: dict[str, Session] = {}
        with self._connect() as client:
            horizon = client.metadata.get("action_horizon", chunk_size)
            if not 1 <= chunk_size <= horizon:
                raise ConfigError(f"chunk_size is {chunk_size}; expected 1 to {horizon}, the actions of a chunk")
            if "memory" in client.metadata:
                raise ConfigError("this policy has memory: it must see every step, and here it sees only some")
            if (client.metadata.get("real_time") or {}).get("execution"):
                raise ConfigError("this server joins chunks by time, and a simulator waits: serve without --execution")

    def _connect(self) -> RealTimeClient:
        return RealTimeClient(self.policy, api_key=self.api_key, connect_s=5, answer_s=20)  # the harness waits for 30 s

    async def on_episode_start(self, config: dict[str, Any], ctx: SessionContext) -> None:
        """Raises nothing: the harness would take its error for the answer to the first observation, and so on."""
        await self.on_episode_end({}, ctx)
        self._sessions[ctx.session_id] = Session()

    async def on_episode_end(self, result: dict[str, Any], ctx: SessionContext) -> None:
        session = self._sessions.pop(ctx.session_id, None)
        if session is not None and session.client is not None:
            await asyncio.to_thread(session.client.close)

    async def on_observation(self, obs: dict[str, Any], ctx: SessionContext) -> None:
        """Sends an action. An error's text goes to the harness, which marks the episode as failed."""
        session = self._sessions.get(ctx.session_id)
        if session is None:
            raise ObservationError("an observation came before the start of an episode")
        if obs.get("episode_restart"):  # CALVIN's next instruction: what is left of the chunk follows the last one
            session.chunk.clear()
        if not session.chunk:
            named = {key: value_at(obs, source) for key, source in self.keys.items()}
            if session.client is None:
                session.client = await asyncio.to_thread(self._connect)
            answer = await asyncio.to_thread(session.client.infer, named)
            session.chunk.extend(answer["actions"][: self.chunk_size].astype(np.float32))
        await ctx.send_action({"actions": session.chunk.popleft()})

    def get_observation_params(self) -> dict[str, Any]:
        return {"send_wrist_image": True, "send_state": True}  # benchmarks leave them out unless they are requested

    def get_observation_spec(self) -> dict[str, DimSpec]:
        cameras = [source.removeprefix("images/") for source in self.keys.values() if source.startswith("images/")]
        return {**dict.fromkeys(cameras, IMAGE_RGB), "language": LANGUAGE}

    def get_action_spec(self) -> dict[str, DimSpec]:
        return {name: DimSpec(name, 0, form) for name, form in self.actions.items()} or {"actions": RAW}


def value_at(obs: Mapping[str, Any], source: str) -> Any:
    """Raises ObservationError, naming what the benchmark sent, if there is nothing at `source`."""
    value: Any = obs
    for part in source.split("/"):
        if not isinstance(value, Mapping) or part not in value:
            sent = sorted(f"{key}/{name}" for key in obs if isinstance(obs[key], Mapping) for name in obs[key])
            sent += sorted(key for key in obs if not isinstance(obs[key], Mapping))
            raise ObservationError(f"the benchmark sent no {source!r} but {sent}: give its keys with --args.keys")
        value = value[part]
    return value


if __name__ == "__main__":
    try:
        run_server(TurboPi)
    except TurboPiError as error:
        raise SystemExit(f"vla_eval_server.py: {error}") from None
