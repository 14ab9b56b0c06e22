"""Training by the clock: workers collect while the GPU learns, from the expert at first, then from its own states too.

The whole run is one process and its workers, and takes a fixed number of seconds: warm-up, a cosine down to zero, and
the result is the average of the weights along the way (EMA). It can be cut into several runs: --resume goes on from the
last checkpoint, whose clock it takes over (frames are collected anew).
"""

import csv
import dataclasses
import json
import math
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbopi.checkpoint.norm_stats import load_norm_stats
from turbopi.config import RealTime
from turbopi.preprocess.normalize import Normalizer
from turbopi.preprocess.tokenizer import TINY_TOKENIZER, load_tokenizer
from turbopi_lab.small_policy.actor import Actor
from turbopi_lab.small_policy.augment import augment
from turbopi_lab.small_policy.collect import Mix
from turbopi_lab.small_policy.episodes import AUX_DIM, HORIZON, Record, Tape, load_tapes
from turbopi_lab.small_policy.expert import PHASES
from turbopi_lab.small_policy.export import CONFIG, export
from turbopi_lab.small_policy.fleet import Fleet
from turbopi_lab.small_policy.forward import (
    Guide,
    Regions,
    draw_delays,
    draw_times,
    flow_loss,
    guide_loss,
    held_actions,
    mixed,
    velocity,
)
from turbopi_lab.small_policy.memory import Batch, Memory
from turbopi_lab.small_policy.scenes import INSTRUCTIONS, NUM_TASKS, Setting
from turbopi_lab.small_policy.start import fresh_model, trained_model

PROMPT_TOKENS = 24  # the longest instruction has 21; a multiple of 8 with the cameras' 512, as attention kernels like
GUIDE_VALUES = AUX_DIM + 3  # and from the hand to the bowl
CLIP = 1.0
DIMENSION_WEIGHTS = (1.0, 1.0, 1.0, 0.15, 0.15, 0.5, 1.0)  # of the loss: roll and pitch are corrections, mostly noise
PADDED_WEIGHT = 0.02


@dataclass
class Settings:
    """Everything that decides about a run; saved beside its results."""

    out: Path
    stats: Path
    seconds: float = 420.0
    workers: int = 16
    seed: int = 0
    batch: int = 256
    repeats: int = 6  # draws of noise and time for each observation
    learning_rate: float = 1e-3
    warmup_steps: int = 150
    weight_decay: float = 0.02
    ema: float = 0.998
    guide_weight: float = 0.5
    capacity: int = 120_000
    first_frames: int = 3000  # before the first step
    demonstration_seconds: float = 90.0  # by when the learner takes part, unless the frames are there before
    demonstration_frames: int = 25_000
    dagger: float = 0.75
    trial: float = 0.15
    save_every: float = 100.0
    compile: bool = True
    resume: bool = False
    start: Path | None = None  # a checkpoint whose weights to start from, instead of fresh ones
    tapes: Path | None = None  # a folder of episodes that were played before, whose images are drawn at first
    delayed: float = 0.5  # share of DAgger episodes in which the learner's chunks come late; with max_delay
    max_delay: int = 0  # control steps of delay that are simulated, for real-time execution; 0: none
    device: str = "cuda"
    draw_gpus: str = ""  # numbers of the GPUs that draw images, as 1,2: beside the one that learns, if there are any


@dataclass
class Clock:
    """Where the run is: seconds of learning so far, in all of its parts."""

    total: float
    before: float = 0.0
    started: float = field(default_factory=time.monotonic)

    @property
    def seconds(self) -> float:
        return self.before + time.monotonic() - self.started

    @property
    def progress(self) -> float:
        return min(1.0, self.seconds / self.total)


class Trainer:
    """The model and everything around one step; `memory` and `fleet` feed it."""

    def __init__(self, settings: Settings) -> None:
        self.settings, self.device = settings, torch.device(settings.device)
        torch.manual_seed(settings.seed)
        torch.backends.cuda.matmul.allow_tf32 = True
        self.stats = load_norm_stats(settings.stats)
        self.scale = Normalizer("quantile", self.stats.actions, "actions")
        first = (
            fresh_model(CONFIG.planned_model, settings.seed)
            if settings.start is None
            else trained_model(CONFIG.planned_model, settings.start)
        )
        self.model = first.to(self.device)
        self.guide = Guide(CONFIG.planned_model.vlm.width, GUIDE_VALUES, len(PHASES)).to(self.device)
        self.tokens, self.token_mask = (tensor.to(self.device) for tensor in prompt_table())
        self.average = {name: value.detach().clone() for name, value in self.model.state_dict().items()}
        self.optimizer = self._make_optimizer()
        self.regions = Regions.compiled(dynamic=False) if settings.compile else Regions()
        self.steps = 0
        weights = torch.full((CONFIG.model.action_dim,), PADDED_WEIGHT)
        weights[: len(DIMENSION_WEIGHTS)] = torch.tensor(DIMENSION_WEIGHTS)
        self._weights = weights.to(self.device)
        assert self.stats.actions is not None and self.stats.actions.q01 is not None
        assert self.stats.actions.q99 is not None
        self._low = torch.tensor(self.stats.actions.q01, dtype=torch.float32, device=self.device)
        self._range = torch.tensor(self.stats.actions.q99, dtype=torch.float32, device=self.device) - self._low + 1e-6

    def _make_optimizer(self) -> torch.optim.Optimizer:
        named = [*self.model.named_parameters(), *self.guide.named_parameters()]
        matrices = [p for name, p in named if p.ndim >= 2 and "embed" not in name]
        others = [p for name, p in named if not (p.ndim >= 2 and "embed" not in name)]
        groups: list[dict[str, Any]] = [
            {"params": matrices, "weight_decay": self.settings.weight_decay},
            {"params": others, "weight_decay": 0.0},
        ]
        fused = self.device.type == "cuda"
        return torch.optim.AdamW(groups, lr=self.settings.learning_rate, betas=(0.9, 0.95), fused=fused)

    def step(self, batch: Batch, progress: float) -> dict[str, Tensor]:
        """One update; returns losses on the device."""
        rate = self.settings.learning_rate * min(1.0, (self.steps + 1) / self.settings.warmup_steps)
        rate *= 0.5 * (1 + math.cos(math.pi * progress)) * 0.99 + 0.01
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        losses = self.losses(batch)
        total = losses["flow"] + self.settings.guide_weight * losses["guide"]
        total.backward()  # type: ignore[no-untyped-call]
        parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        norm = torch.nn.utils.clip_grad_norm_(parameters, CLIP)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.steps += 1
        self._update_average()
        return {**{name: loss.detach() for name, loss in losses.items()}, "gradient": norm.detach()}

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        camera_images = augment(batch.camera_images)
        tokens, mask = self.tokens[batch.prompts], self.token_mask[batch.prompts]
        repeats, most = self.settings.repeats, self.settings.max_delay
        actions = self.normalized(batch.chunks).repeat_interleave(repeats, 0)
        noise = torch.randn_like(actions)
        t, held = draw_times(len(actions), self.device), None
        if most:
            held = held_actions(draw_delays(batch.leads.repeat_interleave(repeats, 0), most), HORIZON)
            executed = self.normalized(batch.executed).repeat_interleave(repeats, 0)
            actions = torch.where(held[..., None], executed, actions)
        x = mixed(actions, noise, t, held)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.device.type == "cuda"):
            predicted, hidden = velocity(self.model, camera_images, tokens, mask, x, t, self.regions, held)
        values, logits = self.guide(hidden, mask)
        return {
            "flow": flow_loss(predicted, noise - actions, self._weights, held),
            "guide": guide_loss(values, logits, guide_targets(batch.aux), batch.phases),
        }

    def normalized(self, chunks: Tensor) -> Tensor:
        """The robot's actions [B, H, 7] as the model has them: float32[B, H, action_dim]."""
        scaled = (chunks - self._low) / self._range * 2 - 1
        return torch.nn.functional.pad(scaled, (0, CONFIG.model.action_dim - chunks.shape[-1]))

    def _update_average(self) -> None:
        keep = min(self.settings.ema, (1 + self.steps) / (10 + self.steps))
        state = self.model.state_dict()
        names = list(self.average)
        torch._foreach_lerp_([self.average[n] for n in names], [state[n].detach() for n in names], 1 - keep)

    # --- files --------------------------------------------------------------------------------------------------------

    def save(self, file: Path, clock: Clock) -> None:
        """Everything to go on with, in under 60 MB: averages and moments are kept in bfloat16."""

        def half(value: Any) -> Any:
            return value.bfloat16() if isinstance(value, Tensor) and value.ndim else value

        moments = {
            key: {name: half(value) for name, value in moment.items()}
            for key, moment in self.optimizer.state_dict()["state"].items()
        }
        content = {
            "model": self.model.state_dict(),
            "guide": self.guide.state_dict(),
            "average": {name: half(value) for name, value in self.average.items()},
            "moments": moments,
            "steps": self.steps,
            "seconds": clock.seconds,
        }
        part = file.with_suffix(".part")
        torch.save(content, part)
        part.replace(file)

    def load(self, file: Path) -> float:
        """Returns the seconds of learning behind it."""
        content = torch.load(file, map_location=self.device, weights_only=True)
        self.model.load_state_dict(content["model"])
        self.guide.load_state_dict(content["guide"])
        for name, value in content["average"].items():
            self.average[name].copy_(value)
        state = self.optimizer.state_dict()
        state["state"] = {
            key: {name: value.float() for name, value in moment.items()} for key, moment in content["moments"].items()
        }
        self.optimizer.load_state_dict(state)
        self.steps = content["steps"]
        return float(content["seconds"])


def guide_targets(aux: Tensor) -> Tensor:
    """What the guide predicts, brought to about unit size: positions in decimetres from the table's middle."""
    middle = torch.tensor([0.0, 0.0, 1.0], device=aux.device)
    hand, bowl, plate = ((aux[:, i : i + 3] - middle) * 10 for i in (0, 3, 6))
    return torch.cat((hand, bowl, plate, aux[:, 9:10] * 10, aux[:, 10:11], (bowl - hand) * 2), dim=1)


def prompt_table() -> tuple[Tensor, Tensor]:
    """Token ids and masks of the suite's instructions: int64 and bool [10, PROMPT_TOKENS]."""
    tokenizer = load_tokenizer(TINY_TOKENIZER, vocab_size=CONFIG.model.vocab_size)
    rows = [tokenizer.tokenize(instruction, max_tokens=PROMPT_TOKENS) for instruction in INSTRUCTIONS]
    assert len(rows) == NUM_TASKS and not any(mask.all() for _, mask in rows)
    return tuple(torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True))  # type: ignore[return-value]


def toy_memory(capacity: int, device: torch.device, seed: int = 0) -> Memory:
    """A memory of noise, to try a step with."""
    memory, rng = Memory(capacity, device), np.random.default_rng(seed)
    record = Record(
        "demonstration",
        Setting(0, 0),
        True,
        100,
        0,
        rng.uniform(-1, 1, (capacity, HORIZON, 7)).astype(np.float32),
        rng.uniform(-1, 1, (capacity, HORIZON, 7)).astype(np.float32),
        np.zeros(capacity, np.int64),
        rng.uniform(0, 1, (capacity, AUX_DIM)).astype(np.float32),
        rng.integers(0, len(PHASES), capacity),
        np.zeros((capacity, 8), np.float32),
    )
    memory.add(record, rng.integers(0, 256, (capacity, 2, 224, 224, 3), np.uint8))
    return memory


def train(settings: Settings) -> None:
    """The whole run: see the module. Writes checkpoints, curves.csv and episodes.jsonl into `settings.out`."""
    out = settings.out
    out.mkdir(parents=True, exist_ok=True)
    (out / "settings.json").write_text(json.dumps({k: str(v) for k, v in asdict(settings).items()}, indent=2) + "\n")
    trainer = Trainer(settings)
    before = trainer.load(out / "state.pt") if settings.resume else 0.0
    memory = Memory(settings.capacity, trainer.device)
    rows = min(32, settings.workers)
    actor = Actor(CONFIG.planned_model, rows, *prompt_table(), trainer.device)
    actor.take(trainer.average)
    tapes = _tapes(settings)
    fleet = Fleet(
        settings.workers,
        settings.seed,
        memory,
        actor,
        trainer.scale,
        out / "episodes.jsonl",
        out / "workers.log",
        tapes,
        [int(gpu) for gpu in settings.draw_gpus.split(",") if gpu],
    )
    actor.capture()  # while simulators start
    fleet.start()
    if settings.compile:
        _compile(trainer)
    try:
        _loop(settings, trainer, memory, fleet, before)
    finally:
        fleet.stop()


def _tapes(settings: Settings) -> list[Tape]:
    """Frames that need longer delays than are trained can't be learned from."""
    if settings.tapes is None:
        return []
    files = sorted(settings.tapes.glob("*.npz"))
    if not files:
        raise FileNotFoundError(
            f"{settings.tapes} has no tapes (*.npz); `python -m turbopi_lab.small_policy play` makes them"
        )
    return [tape for tape in load_tapes(files) if tape.record.leads.max(initial=0) <= settings.max_delay]


def _compile(trainer: Trainer) -> None:
    """Forward and backward once, without an update: compiling takes its time, and simulators are starting anyway."""
    memory = toy_memory(64, trainer.device)
    start = time.monotonic()
    batch = memory.batch(torch.randint(64, (trainer.settings.batch,), device=trainer.device))
    sum(trainer.losses(batch).values()).backward()  # type: ignore[union-attr]
    trainer.optimizer.zero_grad(set_to_none=True)
    print(f"compiled in {time.monotonic() - start:.1f} s", flush=True)


def _loop(settings: Settings, trainer: Trainer, memory: Memory, fleet: Fleet, before: float) -> None:
    waiting = time.monotonic()
    while memory.count < settings.first_frames:
        if fleet.error or not fleet.is_alive() or time.monotonic() - waiting > 300:
            raise RuntimeError(f"no frames came: {fleet.error}, {dict(fleet.counts)}, {fleet.ready} workers ready")
        time.sleep(0.2)
    print(f"first frames after {time.monotonic() - waiting:.1f} s, {fleet.ready} workers", flush=True)
    clock = Clock(settings.seconds, before)
    curves = _Curves(settings.out / "curves.csv", clock)
    delays = Mix(most_lead=settings.max_delay, delayed=settings.delayed if settings.max_delay else 0.0)
    saved, switched, dagger = clock.seconds, False, replace(delays, dagger=settings.dagger, trial=settings.trial)
    while clock.progress < 1:
        clock.total = _seconds(settings)
        indices = memory.draw(settings.batch * 25)
        for part in torch.split(indices, settings.batch):
            losses = trainer.step(memory.batch(part), clock.progress)
            if trainer.steps % 10 == 0:
                fleet.give(trainer.average)
        curves.add(trainer, losses, memory, fleet)
        collected = memory.count >= settings.demonstration_frames or clock.seconds > settings.demonstration_seconds
        if not switched and collected:
            fleet.set_mix(dagger)
            switched = True
        if clock.seconds - saved > settings.save_every:
            saved = clock.seconds
            trainer.save(settings.out / "state.pt", clock)
            _export(trainer, settings.out / f"checkpoint_{round(saved)}s")
    fleet.stopping = True
    trainer.save(settings.out / "state.pt", clock)
    _export(trainer, settings.out / "checkpoint")
    print(f"done: {trainer.steps} steps, {memory.count} frames, {dict(fleet.counts)}", flush=True)


def _seconds(settings: Settings) -> float:
    """How long to learn: a file `seconds` in the run's folder changes it on the way."""
    file = settings.out / "seconds"
    return float(file.read_text()) if file.exists() else settings.seconds


def _export(trainer: Trainer, folder: Path) -> None:
    if folder.exists():
        folder.rename(folder.with_name(f"{folder.name}.{time.time_ns()}"))
    delays = dataclasses.replace(CONFIG, real_time=RealTime(trained_max_delay=trainer.settings.max_delay))
    export({name: value.cpu() for name, value in trainer.average.items()}, trainer.stats, folder, config=delays)


class _Curves:
    """One line of curves.csv, and of the log, every few steps."""

    def __init__(self, file: Path, clock: Clock) -> None:
        self._file, self._clock, self._last = file, clock, (clock.seconds, 0)

    def add(self, trainer: Trainer, losses: dict[str, Tensor], memory: Memory, fleet: Fleet) -> None:
        values = {name: float(value) for name, value in losses.items()}  # waits for the GPU
        now, steps = self._clock.seconds, trainer.steps
        speed = (steps - self._last[1]) * trainer.settings.batch / max(1e-6, now - self._last[0])
        self._last = (now, steps)
        trials = [success for recent in fleet.trials.values() for success in recent]
        row = {
            "seconds": round(now, 1),
            "step": steps,
            **{name: round(value, 5) for name, value in values.items()},
            "rate": trainer.optimizer.param_groups[0]["lr"],
            "samples_per_s": round(speed),
            "frames": memory.count,
            **{name: fleet.counts[name] for name in ("demonstration", "demonstration solved", "dagger", "trial")},
            "dagger_frames": fleet.counts["dagger frames"],
            "recent_trials": len(trials),
            "recent_trials_solved": sum(trials),
            "lost_workers": fleet.counts["lost workers"],
        }
        fresh = not self._file.exists()
        with self._file.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(row))
            if fresh:
                writer.writeheader()
            writer.writerow(row)
        by_task = " ".join(f"{t}:{sum(r)}/{len(r)}" for t, r in sorted(fleet.trials.items()))
        print(" ".join(f"{name}={value}" for name, value in row.items()), "|", by_task, flush=True)
