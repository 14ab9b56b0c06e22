"""A worker process: plays episodes in one scene and sends what a learner should have done in them.

An expert's chunk is only right if the expert goes on to act as it says. So whenever a frame is labelled, the expert
drives the next HORIZON steps; the learner drives in between and leads into states of its own making (DAgger). Besides,
the expert is pushed aside now and then, and its actions are carried out with noise; labels have none.

Messages to the trainer   ("ready",)
                          ("look", pictures uint8[2, 224, 224, 3], prompt)    answered with a chunk float[H, 7], or None
                          ("frames", Record, pictures as bytes)
"""

from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any, Literal

import numpy as np

from small_policy.expert import PHASES, Expert, Sight
from small_policy.scenes import (
    MAX_STEPS,
    TRAINING_STATES,
    VALIDATION_STATES,
    PracticeScene,
    Setting,
)
from turbopi.preprocess.images import resize_with_pad
from turbopi.sim.libero import CAMERAS

HORIZON, REPLAN = 16, 5  # 16: so that delays of 6 fit beside an execution horizon of up to 10
IMAGE_PX = 224
DEMONSTRATION_STEPS = 190  # a demonstration that takes longer isn't kept
HOPELESS = 150  # steps of the expert without success: it is stuck, and its labels with it
AUX_DIM = 11  # hand 3, bowl 3, plate 3, opening, held
Kind = Literal["demonstration", "dagger", "trial"]


@dataclass
class Record:
    """One episode as it is sent: `n` labelled frames, without their pictures.

    chunks float32[n, H, 7]   aux float32[n, AUX_DIM]   phases int64[n]   states float32[n, 8]
    """

    kind: Kind
    setting: Setting
    success: bool
    steps: int
    learner_steps: int
    chunks: np.ndarray
    aux: np.ndarray
    phases: np.ndarray
    states: np.ndarray


@dataclass(frozen=True)
class Mix:
    """How episodes are drawn; the trainer changes it by pipe as training goes on."""

    dagger: float = 0.0  # share of episodes in which the learner drives, too
    trial: float = 0.0  # share in which it drives alone, from validation states: nothing is learned from them
    other_bowl: float = 0.3
    moved: float = 0.5


@dataclass
class _Frame:
    step: int
    pictures: np.ndarray
    sight: Sight
    phase: str
    state: np.ndarray


@dataclass
class Episode:
    """The expert's action at each step, and frames at some, of which those are labelled that it followed up itself."""

    setting: Setting
    labels: list[np.ndarray] = field(default_factory=list)
    by_expert: list[bool] = field(default_factory=list)
    frames: list[_Frame] = field(default_factory=list)
    success: bool = False

    @property
    def useful(self) -> bool:
        """Whether the expert knew what it did: it got there, and soon, or has hardly driven."""
        return self.success or sum(self.by_expert) < HOPELESS

    def record(self, kind: Kind) -> tuple[Record, np.ndarray]:
        labelled = [frame for frame in self.frames if self.useful and self._followed(frame.step)]
        chunks = np.array([self._chunk(frame.step) for frame in labelled], np.float32).reshape(-1, HORIZON, 7)
        aux = np.array([auxiliary(frame.sight) for frame in labelled], np.float32).reshape(-1, AUX_DIM)
        phases = np.array([PHASES.index(frame.phase) for frame in labelled], np.int64)
        states = np.array([frame.state for frame in labelled], np.float32).reshape(-1, 8)
        pictures = np.array([frame.pictures for frame in labelled], np.uint8).reshape(-1, 2, IMAGE_PX, IMAGE_PX, 3)
        learner_steps = len(self.by_expert) - sum(self.by_expert)
        record = Record(kind, self.setting, self.success, len(self.labels), learner_steps, chunks, aux, phases, states)
        return record, pictures

    def _followed(self, step: int) -> bool:
        """Whether the expert drove on for a whole chunk, or into success."""
        end = step + HORIZON
        if end > len(self.labels):
            return self.success and all(self.by_expert[step:])
        return all(self.by_expert[step:end])

    def _chunk(self, step: int) -> np.ndarray:
        chunk = self.labels[step : step + HORIZON]
        return np.array(chunk + [chunk[-1]] * (HORIZON - len(chunk)))


def auxiliary(sight: Sight) -> np.ndarray:
    return np.concatenate([sight.hand, sight.bowl, sight.plate, [sight.opening, float(sight.held)]])


class Player:
    """Plays one scene's episodes; `ask` gives the learner's chunk for pictures and a prompt, or None to stop."""

    def __init__(self, scene: int, seed: int, ask: Any) -> None:
        self.scene, self.ask = scene, ask
        self.rng = np.random.default_rng([seed, scene])
        self.world = PracticeScene(scene)

    def play(self, mix: Mix) -> tuple[Record, np.ndarray]:
        drawn = self.rng.random()
        kind: Kind = "trial" if drawn < mix.trial else "dagger" if drawn < mix.trial + mix.dagger else "demonstration"
        setting = self._setting(kind, mix)
        self.world.begin(setting)
        self.expert = Expert(self.world.domain, setting.bowl)
        self.episode = Episode(setting)
        if kind == "demonstration":
            self._demonstrate(DEMONSTRATION_STEPS)
        elif kind == "trial":
            self._let_learner(MAX_STEPS)
        else:
            self._take_turns()
        return self.episode.record(kind)

    def _setting(self, kind: Kind, mix: Mix) -> Setting:
        rng = self.rng
        if kind == "trial":
            return Setting(self.scene, int(rng.choice(VALIDATION_STATES)))
        moved = int(rng.integers(2**31)) if rng.random() < mix.moved else None
        return Setting(self.scene, int(rng.choice(TRAINING_STATES)), bool(rng.random() < mix.other_bowl), moved)

    # --- who drives ---------------------------------------------------------------------------------------------------

    def _take_turns(self) -> None:
        while not self._over():
            self._let_learner(REPLAN * int(self.rng.integers(1, 11)))
            if not self._over():
                self._demonstrate(HORIZON + int(self.rng.integers(2, 13)), noise=0.0)
        # what the expert hasn't followed up isn't labelled

    def _demonstrate(self, steps: int, noise: float | None = None) -> None:
        """The expert drives; with noise, and pushed aside for a few steps now and then, unless noise is 0."""
        rng = self.rng
        level = float(rng.choice([0.0, 0.1, 0.2, 0.35])) if noise is None else noise
        pushes = level > 0 or noise is None
        until = len(self.episode.labels) + steps
        next_frame, push, pushed_for = len(self.episode.labels), np.zeros(6), 0
        while len(self.episode.labels) < until and not self._over():
            sight = self.expert.look()
            label = self.expert.act(sight)
            step = len(self.episode.labels)
            if step >= next_frame and self.world._pictures:
                self._keep_frame(sight)
                next_frame = step + self._pause()
            executed = label.copy()
            if pushed_for == 0 and pushes and rng.random() < 0.015:
                pushed_for, push = int(rng.integers(3, 9)), rng.uniform(-1, 1, 6) * [1, 1, 1, 0.2, 0.2, 0.3]
            if pushed_for:
                pushed_for -= 1
                executed[:6] = push
            executed[:6] = np.clip(executed[:6] + rng.normal(0, level, 6) * [1, 1, 1, 0.3, 0.3, 0.3], -1, 1)
            self._step(executed, label, by_expert=True, look=step + 1 >= next_frame)

    def _pause(self) -> int:
        """Steps to the next frame: fewer where precision counts."""
        if self.expert.phase in ("descend", "close"):
            return int(self.rng.integers(1, 3))
        return int(self.rng.integers(2, 6))

    def _let_learner(self, steps: int) -> None:
        until = len(self.episode.labels) + steps
        self._draw_if_needed()
        while len(self.episode.labels) < until and not self._over():
            chunk = self.ask(self._pictures(), self.episode.setting.prompt)
            if chunk is None:
                raise EOFError
            for number, action in enumerate(chunk[:REPLAN], start=1):
                label = self.expert.act()  # keeps its phase up to date, too
                self._step(action, label, by_expert=False, look=number == REPLAN)
                if self._over():
                    break

    # --- steps --------------------------------------------------------------------------------------------------------

    def _step(self, action: np.ndarray, label: np.ndarray, *, by_expert: bool, look: bool) -> None:
        episode = self.episode
        success = self.world.step(action, look=look)
        episode.labels.append(label)
        episode.by_expert.append(by_expert)
        episode.success = self.world.solved(episode.setting) if episode.setting.other_bowl else success

    def _over(self) -> bool:
        return self.episode.success or len(self.episode.labels) >= MAX_STEPS

    def _draw_if_needed(self) -> None:
        """When the expert hands over between frames: what the cameras see now, without a step."""
        if not self.world._pictures:
            drawn = self.world.draw()
            self.world._pictures = dict(zip(CAMERAS, drawn, strict=True))

    def _pictures(self) -> np.ndarray:
        return np.stack([resize_with_pad(self.world._pictures[key], IMAGE_PX, IMAGE_PX) for key in CAMERAS])

    def _keep_frame(self, sight: Sight) -> None:
        state = self.world.observation()["observation/state"]
        step = len(self.episode.labels)
        self.episode.frames.append(_Frame(step, self._pictures(), sight, self.expert.phase, state))


def run_worker(connection: Connection, scene: int, seed: int) -> None:
    """The process's main: plays until the pipe closes. The trainer's ("mix", Mix) may come in between."""
    mix = Mix()

    def ask(pictures: np.ndarray, prompt: int) -> np.ndarray | None:
        nonlocal mix
        connection.send(("look", pictures, prompt))
        while True:
            answer = connection.recv()
            if answer[0] == "mix":
                mix = answer[1]
            else:
                return answer[1] if answer[0] == "chunk" else None

    try:
        player = Player(scene, seed, ask)
        connection.send(("ready",))
        while True:
            while connection.poll():
                answer = connection.recv()
                if answer[0] == "stop":
                    return
                mix = answer[1]
            record, pictures = player.play(mix)
            connection.send(("frames", record))
            connection.send_bytes(pictures.reshape(-1).data if pictures.size else b"")
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
