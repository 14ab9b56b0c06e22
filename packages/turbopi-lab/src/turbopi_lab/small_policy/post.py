"""Two policies that differ in their demonstrations alone, for studies of few denoising steps (studies/post.py).

    python -m turbopi_lab.small_policy post --out work/one_way --ways 1
    python -m turbopi_lab.small_policy post --out work/two_ways --ways 2

They begin with the shipped chase policy's weights, which know what the images show. The expert passes the post on one
side, always the same, or on one drawn for each episode. Everything else is equal: the model and its size (the chase's),
the number of frames, the seed, the training. Seven minutes each on a CPU core.
"""

import dataclasses
import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from turbopi.config import PolicyConfig, RealTime
from turbopi.policy import shipped
from turbopi.preprocess.tokenizer import TINY_TOKENIZER, load_tokenizer
from turbopi.sim.chase_expert import plan
from turbopi_lab.small_policy.chase import CONFIG as CHASE
from turbopi_lab.small_policy.chase import HORIZON, Frames, Trainer, revive, stats
from turbopi_lab.small_policy.chase import Settings as ChaseSettings
from turbopi_lab.small_policy.export import export
from turbopi_lab.studies.post import INSTRUCTION, ONE_WAY, TWO_WAYS, Ways, start

STEPS = 36  # of a demonstration: it is at the target after some 25
AT_ONCE = 250  # episodes
CONFIG: PolicyConfig = dataclasses.replace(CHASE, name="pi05_post", asset_id="turbopi/post", real_time=RealTime())


@dataclass
class Settings:
    out: Path
    ways: int = 2  # that demonstrations take around the post: 1 or 2
    steps: int = 2500
    seed: int = 0
    frames: int = 60_000
    batch: int = 64
    learning_rate: float = 1e-3
    device: str = "cpu"


def demonstrations(ways: Ways, number: int, seed: int) -> Frames:
    """Frames of episodes, none of which is one of the study's own: their seeds are of 41 bits."""
    rounds = math.ceil(number / (AT_ONCE * STEPS))
    played = [_play(ways, seed + part) for part in range(rounds)]
    places, chunks = (torch.from_numpy(np.concatenate(column)[:number]) for column in zip(*played, strict=True))
    return Frames(places, chunks, torch.zeros(len(chunks), dtype=torch.int64))


def _play(ways: Ways, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Places float32[N, 3, 2] and chunks float32[N, H, 2] of AT_ONCE episodes, each with a side of its own."""
    rng = np.random.default_rng([2**40, seed])
    world = start([(2**40, seed, row) for row in range(AT_ONCE)])
    sides = rng.choice(ways, AT_ONCE)
    noise = rng.uniform(0, 0.4, (AT_ONCE, 1)) * (rng.uniform(size=(AT_ONCE, 1)) < 0.7)
    frames = []
    for _ in range(STEPS):
        chunks = plan(world, HORIZON, sides)
        frames.append((np.stack((world.target, world.before[:, 0], world.tip), axis=1), chunks))
        world.step(chunks[:, 0] + noise * rng.normal(size=(AT_ONCE, 2)))
        revive(world, rng)
    places, planned = (np.concatenate(column).astype(np.float32) for column in zip(*frames, strict=True))
    return places, planned


def train(settings: Settings) -> None:
    """Writes checkpoint/ and state.pt into `settings.out`."""
    if settings.ways not in (1, 2):
        raise SystemExit(f"--ways is 1 or 2; it is {settings.ways}")
    settings.out.mkdir(parents=True, exist_ok=True)
    frames = demonstrations(ONE_WAY if settings.ways == 1 else TWO_WAYS, settings.frames, settings.seed)
    chase = ChaseSettings(settings.out, seed=settings.seed, batch=settings.batch, device=settings.device)
    chase.learning_rate = settings.learning_rate
    trainer = Trainer(chase, prompt(INSTRUCTION), start=shipped.CHASE_POLICY)
    frames = frames.to(trainer.device)
    started, losses = time.monotonic(), []
    for step in range(settings.steps):  # by steps, not by the clock: both policies learn as much on a busy machine
        # turned, never mirrored: a mirrored demonstration passes the post on the other side
        losses.append(trainer.step(frames.draw(settings.batch, mirrored=False), step / settings.steps))
        if len(losses) == 250:
            flow, guide = np.mean(losses, axis=0)
            print(f"{time.monotonic() - started:.0f} s, step {trainer.steps}: {flow:.4f} {guide:.5f}", flush=True)
            losses.clear()
    trainer.save(settings.out / "state.pt")
    averages = {name: value.cpu() for name, value in trainer.average.items()}
    export(averages, stats(), settings.out / "checkpoint", config=CONFIG)


def prompt(instruction: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Token ids and mask [1, P], without padding."""
    tokenizer = load_tokenizer(TINY_TOKENIZER, vocab_size=CONFIG.model.vocab_size)
    ids = tokenizer.encode(instruction)
    return torch.tensor([ids]), torch.ones(1, len(ids), dtype=torch.bool)
