"""Episodes for later: played on any machine, without a GPU, and kept without images.

Most of the time of collecting goes into the simulator's physics, which need no GPU. So processes can play for hours on
CPUs, and `train --tapes` draws the images, several hundred a second, on the machine that trains.
"""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from turbopi.checkpoint import open_checkpoint
from turbopi.preprocess.normalize import Normalizer
from turbopi_lab.small_policy.actor import Actor
from turbopi_lab.small_policy.collect import Mix, Player
from turbopi_lab.small_policy.episodes import Tape, save_tapes
from turbopi_lab.small_policy.export import CONFIG
from turbopi_lab.small_policy.scenes import NUM_TASKS
from turbopi_lab.small_policy.train import prompt_table

EPISODES = 6  # of a scene, before the next one is opened; a file each
Learner = Callable[[np.ndarray, int, np.ndarray], np.ndarray]


def learner_of(folder: Path) -> Learner:
    """A checkpoint at the wheel, in float32 on the CPU: see `collect.Player`."""
    checkpoint, device = open_checkpoint(folder), torch.device("cpu")
    assert checkpoint.norm_stats is not None and checkpoint.norm_stats.actions is not None
    scale = Normalizer("quantile", checkpoint.norm_stats.actions, "actions")
    actor = Actor(CONFIG.planned_model, 1, *prompt_table(), device)
    actor.take(checkpoint.load(device, "f32").state)

    def ask(camera_images: np.ndarray, prompt: int, held: np.ndarray) -> np.ndarray:
        return actor.chunks(scale, camera_images[None], [prompt], [held])[0]

    return ask


def play(out: Path, seconds: float, seed: int, learner: Learner | None, most_lead: int) -> None:
    """Write one file after the other into `out` until the time is over; the scenes take turns.

    Without a learner all episodes are the expert's; with one, half of them are shared, and half of these are delayed.
    """
    out.mkdir(parents=True, exist_ok=True)
    mix = Mix(dagger=0.5 if learner else 0.0, most_lead=most_lead, delayed=0.5)
    ends, number = time.monotonic() + seconds, 0
    order = np.random.default_rng(seed).permutation(NUM_TASKS)
    while time.monotonic() < ends:
        scene = int(order[number % NUM_TASKS])
        player = Player(scene, seed * 1000 + number, learner, draws=False)
        tapes: list[Tape] = []
        while len(tapes) < EPISODES and time.monotonic() < ends:
            kind, episode = player.play(mix)
            tapes.append(episode.tape(kind, player.world.bodies()))
        player.world.close()
        if any(len(tape.joints) for tape in tapes):
            save_tapes(out / f"seed{seed}_{number:04d}_scene{scene}.npz", tapes)
        frames, solved = sum(len(tape.joints) for tape in tapes), sum(tape.record.success for tape in tapes)
        print(f"scene {scene}: {len(tapes)} episodes, {solved} solved, {frames} frames", flush=True)
        number += 1
