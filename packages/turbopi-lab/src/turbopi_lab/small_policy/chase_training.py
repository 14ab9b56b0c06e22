"""Trains the chase's policy by the clock, and watches how many practice episodes it solves."""

import csv
import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbopi.sim.chase import MAX_STEPS, Chase
from turbopi_lab.small_policy.chase import HORIZON, WEIGHTS, Settings, Trainer, demonstrations
from turbopi_lab.small_policy.chase_smolvla import SmolVLATrainer

TRAINERS: dict[str, type[Trainer]] = {"pi05": Trainer, "smolvla": SmolVLATrainer}


def watch(trainer: Trainer, model: Any, delay: int, held: bool, episodes: int = 100, every: int = 5) -> float:
    """Share of practice episodes that are solved under a delay, joining chunks or not."""
    world = Chase.start([np.random.default_rng([2**41, row]) for row in range(episodes)])
    for _ in range(10):
        world.step(np.zeros((episodes, 2)))
    world.cleared()
    noises = torch.Generator().manual_seed(0)

    def ask(given: Tensor, d: int) -> Tensor:
        noise = torch.randn(episodes, HORIZON, len(WEIGHTS), generator=noises).to(trainer.device)
        return trainer.sample(model, world, noise, given, d)

    chunk = ask(torch.zeros(episodes, HORIZON, len(WEIGHTS), device=trainer.device), 0)
    solved, place, arrives = np.zeros(episodes, np.bool_), 0, -1
    for step in range(MAX_STEPS):
        if step and step % every == 0:
            left = torch.nn.functional.pad(chunk[:, place:], (0, 0, 0, place))
            coming, arrives = ask(left, delay if held else 0), step + delay
        if step == arrives:
            chunk, place = coming, delay
        solved |= world.step(chunk[:, place, :2].cpu().double().numpy())
        place += 1
    return float(solved.mean())


def train(settings: Settings) -> None:
    """Writes checkpoint/ and curves.csv into `settings.out`."""
    if settings.model not in TRAINERS:
        raise SystemExit(f"--model is {' or '.join(TRAINERS)}; it is {settings.model}")
    kind = TRAINERS[settings.model]
    settings.out.mkdir(parents=True, exist_ok=True)
    begun = time.monotonic()
    frames = demonstrations(settings.frames, settings.seed, settings.workers)
    trainer = kind(settings)
    frames = (frames if kind.holds else frames.undelayed()).to(trainer.device)
    print(f"{len(frames)} frames in {time.monotonic() - begun:.0f} s", flush=True)
    if settings.resume is not None:
        trainer.load(settings.resume)
    started = watched = time.monotonic()
    rows: list[dict[str, float]] = []
    losses: list[tuple[float, float]] = []
    while (progress := min(1.0, (time.monotonic() - started) / settings.seconds)) < 1:
        losses.append(trainer.step(frames.draw(settings.batch), progress))
        if time.monotonic() - watched > settings.watch_every:
            watched = time.monotonic()
            trainer.save(settings.out / "state.pt")
            rows.append(_reported(trainer, losses, watched - started))
            losses.clear()
    trainer.save(settings.out / "state.pt")
    if losses:
        rows.append(_reported(trainer, losses, time.monotonic() - started))
    with (settings.out / "curves.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    trainer.export()


def _reported(trainer: Trainer, losses: list[tuple[float, float]], seconds: float) -> dict[str, float]:
    model = trainer.averaged()
    row = {"seconds": round(seconds), "step": trainer.steps, **_mean(losses)}
    for delay, held in ((0, False), (4, False), *([(4, True)] if trainer.holds else [])):
        row[f"delay {delay}{', held' if held else ''}"] = watch(trainer, model, delay, held)
    print(row, flush=True)
    return row


def _mean(losses: list[tuple[float, float]]) -> dict[str, float]:
    flow, guide = np.mean(losses, axis=0)
    return {"flow": round(float(flow), 4), "guide": round(float(guide), 5)}
