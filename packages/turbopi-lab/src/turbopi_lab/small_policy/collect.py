"""A worker process: plays episodes in one scene and sends what a learner should have done in them.

Whenever a frame is labelled, the expert drives the steps that follow; the learner drives in between and leads into
states of its own making (DAgger), at times with the delays of a slow machine. Besides, the expert is pushed aside now
and then, and its actions are carried out with noise; labels have none.

Messages to the trainer   ("ready",)
                          ("look", images uint8[2, 224, 224, 3], prompt, held float[d, 7])
                              answered with a chunk float[H, 7] that begins with `held`, or None
                          ("frames", Record, images as bytes)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from turbopi.preprocess.images import resize_with_pad
from turbopi.sim.libero import CAMERAS, openpi_state
from turbopi_lab.small_policy.episodes import HORIZON, IMAGE_PX, Episode, Frame, Kind, Record, Tape
from turbopi_lab.small_policy.expert import Expert, Sight
from turbopi_lab.small_policy.scenes import (
    MAX_STEPS,
    TRAINING_STATES,
    VALIDATION_STATES,
    PracticeScene,
    Setting,
)

REPLAN = 5  # steps from one chunk to the next when the learner drives
DEMONSTRATION_STEPS = 190  # a demonstration that takes longer isn't kept


@dataclass(frozen=True)
class Mix:
    """How episodes are drawn; the trainer changes it by pipe as training goes on."""

    dagger: float = 0.0  # share of episodes in which the learner drives, too
    trial: float = 0.0  # share in which it drives alone, from validation states: nothing is learned from them
    other_bowl: float = 0.3
    moved: float = 0.5
    most_lead: int = (
        0  # of a frame: first actions that may be the learner's, as long as delays are trained that hold them
    )
    delayed: float = 0.0  # share of DAgger episodes in which each chunk takes over 1 to REPLAN - 1 steps late


class Player:
    """Plays one scene's episodes; `ask(images, prompt, held)` gives the learner's chunk, or None to stop.

    draws   keep frames with their images; otherwise cameras are drawn for the learner alone
    """

    def __init__(self, scene: int, seed: int, ask: Any, *, draws: bool = True) -> None:
        self.scene, self.ask, self.draws = scene, ask, draws
        self.rng = np.random.default_rng([seed, scene])
        self.world = PracticeScene(scene)

    def play(self, mix: Mix) -> tuple[Kind, Episode]:
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
            self._take_turns(mix)
        return kind, self.episode

    def draw(self, tape: Tape) -> np.ndarray:
        """The images of a tape's frames: uint8[n, 2, 224, 224, 3]."""
        self.world.place_bodies(tape.bodies)
        drawn = []
        for joints in tape.joints:
            self.world.place_joints(joints)
            self._draw()
            drawn.append(self._images())
        return np.array(drawn, np.uint8).reshape(-1, 2, IMAGE_PX, IMAGE_PX, 3)

    def _setting(self, kind: Kind, mix: Mix) -> Setting:
        rng = self.rng
        if kind == "trial":
            return Setting(self.scene, int(rng.choice(VALIDATION_STATES)))
        moved = int(rng.integers(2**31)) if rng.random() < mix.moved else None
        return Setting(self.scene, int(rng.choice(TRAINING_STATES)), bool(rng.random() < mix.other_bowl), moved)

    # --- who drives ---------------------------------------------------------------------------------------------------

    def _take_turns(self, mix: Mix) -> None:
        rng = self.rng
        delay = int(rng.integers(1, REPLAN)) if rng.random() < mix.delayed else 0
        while not self._over():
            steps, lead = REPLAN * int(rng.integers(1, 11)), int(rng.integers(mix.most_lead + 1))
            self._let_learner(steps, delay, lead=min(lead, steps))
            if not self._over():
                self._demonstrate(HORIZON + int(rng.integers(2, 13)), noise=0.0)

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
            if step >= next_frame:
                self._keep_frame(sight)
                next_frame = step + self._pause()
            executed = label.copy()
            if pushed_for == 0 and pushes and rng.random() < 0.015:
                pushed_for, push = int(rng.integers(3, 9)), rng.uniform(-1, 1, 6) * [1, 1, 1, 0.2, 0.2, 0.3]
            if pushed_for:
                pushed_for -= 1
                executed[:6] = push
            executed[:6] = np.clip(executed[:6] + rng.normal(0, level, 6) * [1, 1, 1, 0.3, 0.3, 0.3], -1, 1)
            self._step(executed, label, by_expert=True, look=self.draws and step + 1 >= next_frame)

    def _pause(self) -> int:
        """Steps to the next frame: fewer where precision counts."""
        if self.expert.phase in ("descend", "close"):
            return int(self.rng.integers(1, 3))
        return int(self.rng.integers(2, 6))

    def _let_learner(self, steps: int, delay: int = 0, lead: int = 0) -> None:
        """The learner drives, with a new chunk every REPLAN steps, which takes over `delay` steps after its images.

        A frame is kept `lead` steps before the end, unless that is 0.
        """
        assert delay < REPLAN
        began = len(self.episode.labels)
        until, filmed = began + steps, began + steps - lead
        ahead: np.ndarray = np.zeros((0, 7))  # of the running chunk, from the present step on
        fresh: np.ndarray | None = None
        takes_over = began
        self._draw_if_needed()
        while len(self.episode.labels) < until and not self._over():
            step, sight = len(self.episode.labels), self.expert.look()
            label = self.expert.act(sight)  # keeps its phase up to date, too
            if lead and step == filmed:
                self._keep_frame(sight, lead)
            if (step - began) % REPLAN == 0:
                held = ahead[:delay]  # nothing at first: there is no chunk yet, and the world waits
                fresh, takes_over = self.ask(self._images(), self.episode.setting.prompt, held), step + len(held)
                if fresh is None:
                    raise EOFError
                since = step
            if fresh is not None and step == takes_over:
                ahead, fresh = fresh[step - since :], None
            asks, videos = (step + 1 - began) % REPLAN == 0, self.draws and lead > 0 and step + 1 == filmed
            self._step(ahead[0], label, by_expert=False, look=asks or videos)
            ahead = ahead[1:]

    # --- steps --------------------------------------------------------------------------------------------------------

    def _step(self, action: np.ndarray, label: np.ndarray, *, by_expert: bool, look: bool) -> None:
        episode = self.episode
        success = self.world.step(action, look=look)
        episode.labels.append(label)
        episode.executed.append(np.array(action))
        episode.by_expert.append(by_expert)
        episode.success = self.world.solved(episode.setting) if episode.setting.other_bowl else success

    def _over(self) -> bool:
        return self.episode.success or len(self.episode.labels) >= MAX_STEPS

    def _draw_if_needed(self) -> None:
        """When the expert hands over between frames: what the cameras see now, without a step."""
        if not self.world._images:
            self._draw()

    def _draw(self) -> None:
        self.world._images = dict(zip(CAMERAS, self.world.draw(), strict=True))

    def _images(self) -> np.ndarray:
        return np.stack([resize_with_pad(self.world._images[key], IMAGE_PX, IMAGE_PX) for key in CAMERAS])

    def _keep_frame(self, sight: Sight, lead: int = 0) -> None:
        """Before the step that it is for. Without images there is no frame, where they are kept."""
        if self.draws and not self.world._images:
            return
        camera_images = self._images() if self.draws else None
        step, state = len(self.episode.labels), openpi_state(self.world._obs)
        frame = Frame(step, lead, camera_images, sight, self.expert.phase, state, self.world.joints())
        self.episode.frames.append(frame)


def run_worker(connection: Connection, scene: int, seed: int, tapes: Sequence[Tape] = ()) -> None:
    """The process's main: draws the tapes' frames, then plays until the pipe closes.

    The trainer's ("mix", Mix) may come in between.
    """
    mix = Mix()

    def ask(camera_images: np.ndarray, prompt: int, held: np.ndarray) -> np.ndarray | None:
        nonlocal mix
        connection.send(("look", camera_images, prompt, held))
        while True:
            answer = connection.recv()
            if answer[0] == "mix":
                mix = answer[1]
            else:
                return answer[1] if answer[0] == "chunk" else None

    def send(record: Record, camera_images: np.ndarray) -> None:
        connection.send(("frames", record))
        connection.send_bytes(camera_images.reshape(-1).data if camera_images.size else b"")

    try:
        player = Player(scene, seed, ask)
        connection.send(("ready",))
        for tape in tapes:
            send(tape.record, player.draw(tape))
        while True:
            while connection.poll():
                answer = connection.recv()
                if answer[0] == "stop":
                    return
                mix = answer[1]
            kind, episode = player.play(mix)
            send(episode.record(kind), episode.camera_images())
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
