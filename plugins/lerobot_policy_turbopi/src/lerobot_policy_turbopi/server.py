"""A policy behind `turbopi serve`, as LeRobot's policy: the robot's computer has LeRobot, the server the model.

The server does all that the checkpoint's processors do. So LeRobot's own pipelines here (remote/*.json) change no
number: observations go out as the robot gives them, and actions come back in the robot's units.
"""

import os
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_policy_turbopi.real_time import Join
from turbopi.realtime.client import RealTimeClient
from turbopi.realtime.running_chunk import JoinMode, RunningChunk
from turbopi.support.errors import ConfigError, ObservationError

PROCESSORS = Path(__file__).with_name("remote")
_ANSWERS = 8  # kept: LeRobot drops some chunks, so its left-over may be of an earlier one


def connect(url: str) -> RealTimeClient:
    """With the key that TURBOPI_API_KEY names. Raises as RealTimeClient, and ConfigError for a server of other keys."""
    client = RealTimeClient(url, api_key=os.environ.get("TURBOPI_API_KEY"))
    described = client.metadata
    if described.get("robot") != "lerobot" or "robot_cameras" not in described:
        client.close()
        raise ConfigError(
            f"the server at {client.url} expects observations of robot {described.get('robot')!r}; --policy.server "
            "needs one that serves a LeRobot checkpoint in its own keys: `turbopi serve CHECKPOINT`, without --robot"
        )
    return client


class ServedModel:
    """The chunks of a server, for `TurboPiPolicy`."""

    def __init__(self, url: str) -> None:
        self._client = connect(url)
        self._answers: deque[tuple[np.ndarray, np.ndarray, np.ndarray | None]] = deque(maxlen=_ANSWERS)

    @property
    def modes(self) -> list[str]:
        """The ways to join chunks that the server offers."""
        return list(self._client.metadata["real_time"]["modes"])

    def warm_up(self, mode: JoinMode) -> None:
        """Call the server until a call that joins chunks is warm there: `turbopi serve` warms up plain calls alone."""
        described = self._client.metadata
        black = np.zeros((3, 480, 640), np.uint8)
        observation: dict[str, Any] = dict.fromkeys(described["robot_cameras"], black)
        observation |= {"observation.state": np.zeros(described["robot_state_dim"], np.float32), "task": "warm up"}
        answer = self._client.infer(observation, model_actions=True)
        left_over = answer["model_actions"][1:]
        if len(left_over):
            previous = RunningChunk(left_over, 1, mode=mode, anchor=answer.get("anchor"))
            self._client.infer(observation, previous=previous, model_actions=True)
        self._client.reset()

    def chunk(self, batch: Mapping[str, Any], rows: int, join: Join | None) -> Tensor:
        """float32[B, H, d] in the robot's units, on the CPU. Raises what `RealTimeClient.infer` raises."""
        previous = None if join is None else self._running(join)
        if self.remembers and rows > 1:
            raise ObservationError(
                f"a server's policy with memory takes one robot's observations, but {rows} rows came"
            )
        chunks = []
        for row in range(rows):
            # with model_actions a server that joins chunks of its own leaves that to this client
            answer = self._client.infer(_observation(batch, row), previous=previous, model_actions=True)
            actions = answer["actions"].astype(np.float32)
            self._answers.append((actions, answer["model_actions"], answer.get("anchor")))
            chunks.append(torch.from_numpy(actions))
        return torch.stack(chunks)

    @property
    def remembers(self) -> bool:
        """Whether the server's policy has memory."""
        return "memory" in self._client.metadata

    def observe(self, batch: Mapping[str, Any]) -> None:
        """Have a policy with memory record an observation whose chunk isn't needed; others aren't sent any."""
        if self.remembers:
            self._client.observe(_observation(batch, 0))

    def reset(self) -> None:
        """A new episode."""
        self._answers.clear()
        self._client.reset()

    def _running(self, join: Join) -> RunningChunk:
        """The left-over as the server knows it: of the answer whose rows it is, the rows in the model's space.

        What these have beyond the robot's actions is zero, as in LeRobot. Rows that LeRobot has padded aren't sent:
        guidance ends before them.
        """
        if len(join.left_over) != 1:
            raise ObservationError(f"RTC with a server takes one observation at a time, but {len(join.left_over)} came")
        rows = join.left_over[0]
        for actions, model_actions, anchor in reversed(list(self._answers)):  # another thread may reset
            for first in np.flatnonzero((actions[:, : rows.shape[1]] == rows[0]).all(1)):
                left = min(len(rows), len(actions) - first)
                padding = rows[left:]
                if np.array_equal(actions[first : first + left], rows[:left]) and (
                    not padding.any() or (padding == rows[left - 1]).all()
                ):
                    end = min(join.end, left)
                    known = model_actions[first : first + left].copy()
                    known[:, actions.shape[1] :] = 0
                    if join.mode == "rtc_trained":
                        return RunningChunk(known, min(join.delay, left), None, join.mode, anchor)
                    guidance = join.schedule, join.max_guidance_weight
                    s = len(actions) - end
                    return RunningChunk(known, min(join.delay, end), s, join.mode, anchor, *guidance)
        raise ObservationError(
            "prev_chunk_left_over has rows that the server's last answers don't have: give rows of what "
            "predict_action_chunk returned, as they are"
        )


def _observation(batch: Mapping[str, Any], row: int) -> dict[str, Any]:
    """One observation of LeRobot's batch, as a robot's client sends it."""
    observation: dict[str, Any] = {}
    for key, value in batch.items():
        if key.startswith("observation.") and isinstance(value, Tensor):
            array = value[row].detach().cpu().numpy()
            observation[key] = _bytes(array) if key.startswith("observation.images.") else array
    if "task" in batch:
        task = batch["task"]
        observation["task"] = task if isinstance(task, str) else task[row]
    return observation


def _bytes(image: np.ndarray) -> np.ndarray:
    """float32[3, h, w] that LeRobot made of bytes, as these bytes; any other image as it is."""
    scaled = image * np.float32(255)
    whole = np.rint(scaled).clip(0, 255)
    return whole.astype(np.uint8) if np.abs(scaled - whole).max(initial=0) < 1e-3 else image
