"""A student that solves in one denoising step what its teacher solves in ten: consistency distillation of a toy policy.

    python -m turbopi_lab.small_policy distill --start work/two_ways/checkpoint --out work/two_ways_consistency
    python -m turbopi_lab.small_policy distill --start work/two_ways/checkpoint --out work/two_ways_mean --recipe mean

The teacher integrates many noises, ten Euler steps each, for observations of demonstrations; their actions aren't read.
The student begins with the teacher's weights. It learns, at noise (t = 1) and at other points of the teacher's ways,
where the way ends: x − t v(x, t) = a. So the data are pairs of a noise and the actions that the teacher makes of this
very noise. Only the action expert and its projections learn: keys and values of the prefix stay the teacher's. Recipes:

    consistency  the above
    shuffled     control: the same data and training, but each noise has the actions that the teacher made of another
                 noise, of the same observation. What is left to learn is the mean of all ways
    mean         control: regression on the mean of the teacher's actions for the observation

Some four minutes on a CPU core. What comes out is an ordinary checkpoint; its turbopi.json says one denoising step. It
wasn't trained with held actions, so it doesn't say that it was.
"""

import dataclasses
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from turbopi.checkpoint import open_checkpoint
from turbopi.config import RealTime
from turbopi.models.observation import Observation
from turbopi.models.pi0.reference import Pi0Model, Trace
from turbopi_lab.small_policy import chase, post
from turbopi_lab.small_policy.chase import WEIGHTS, Frames, stats
from turbopi_lab.small_policy.export import export
from turbopi_lab.small_policy.forward import suffix_velocity
from turbopi_lab.small_policy.start import trained_model
from turbopi_lab.studies.post import INSTRUCTION, TWO_WAYS

Recipe = Literal["consistency", "shuffled", "mean"]
TEACHER_STEPS = 10
AT_ONCE = 512  # observations that the teacher is asked at a time


@dataclass
class Settings:
    start: Path
    out: Path
    recipe: Recipe = "consistency"
    steps: int = 1500
    seed: int = 0
    observations: int = 4096
    noises: int = 4  # of each observation
    batch: int = 128
    learning_rate: float = 1e-3
    warmup_steps: int = 100
    ema: float = 0.995


@dataclass
class Ways:
    """What the teacher did: of N observations, from M noises each."""

    k: Tensor  # float32[layers, N, heads, S, K]: keys of the prefix
    v: Tensor
    noise: Tensor  # float32[N, M, H, A]
    between: Tensor  # float32[N, M, H, A]: a point of the way from it
    t: Tensor  # float32[N, M]: its time
    actions: Tensor  # float32[N, M, H, A]: where the way ends


def train(settings: Settings) -> None:
    """Writes checkpoint/ into `settings.out`."""
    if settings.recipe not in get_args(Recipe):
        raise SystemExit(f"--recipe is {settings.recipe}; choose of {', '.join(get_args(Recipe))}")
    settings.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(settings.seed)
    config = open_checkpoint(settings.start).config
    teacher = trained_model(config.planned_model, settings.start).requires_grad_(False)
    started = time.monotonic()
    with torch.no_grad():
        ways = teach(teacher, settings, of_post=config.asset_id == "turbopi/post")
    print(f"{ways.noise.shape[0] * ways.noise.shape[1]} ways in {time.monotonic() - started:.0f} s", flush=True)
    student = Student(trained_model(config.planned_model, settings.start), settings)
    losses = []
    for step in range(settings.steps):
        losses.append(student.step(ways, step / settings.steps))
        if len(losses) == 250:
            print(f"{time.monotonic() - started:.0f} s, step {step + 1}: {np.mean(losses):.5f}", flush=True)
            losses.clear()
    known = dataclasses.replace(config, num_denoising_steps=1, one_step=True, real_time=RealTime())
    export(student.state(), stats(), settings.out / "checkpoint", config=known)


def teach(teacher: Pi0Model, settings: Settings, *, of_post: bool) -> Ways:
    """The teacher's ways from noise to actions."""
    most = 4 * settings.observations
    if of_post:
        frames, tokens = post.demonstrations(TWO_WAYS, most, settings.seed), post.prompt(INSTRUCTION)
    else:
        frames, tokens = chase.demonstrations(most, settings.seed), chase.prompt()
    chosen = frames.draw(settings.observations, mirrored=not of_post)
    parts = [
        _ways(teacher, Frames(*(column[at : at + AT_ONCE] for column in _columns(chosen))), tokens, settings.noises)
        for at in range(0, settings.observations, AT_ONCE)
    ]
    names = [field.name for field in dataclasses.fields(Ways)]
    return Ways(*(torch.cat([getattr(part, name) for part in parts], dim=int(name in "kv")) for name in names))


def _columns(frames: Frames) -> tuple[Tensor, Tensor, Tensor]:
    return frames.places, frames.chunks, frames.delays


def _ways(teacher: Pi0Model, frames: Frames, prompt: tuple[Tensor, Tensor], noises: int) -> Ways:
    config, count = teacher.config, len(frames)
    camera_images = frames.camera_images(config.vision.image_size)
    tokens, mask = (tensor.expand(count, -1) for tensor in prompt)
    there, state = torch.ones(count, camera_images.shape[1], dtype=torch.bool), torch.zeros(count, config.action_dim)
    cache = teacher.prefix(Observation(camera_images, there, tokens, mask, state))
    points = []
    for _ in range(noises):
        trace: Trace = {}
        noise = torch.randn(count, config.action_horizon, config.action_dim)
        teacher.denoise(cache, noise, TEACHER_STEPS, trace=trace)
        at = torch.randint(1, TEACHER_STEPS, (count,))
        x_t, t = trace["x_t"], trace["times"][at]
        points.append((noise, x_t[at, torch.arange(count)], t, trace["actions"]))
    return Ways(cache.k, cache.v, *(torch.stack(column, dim=1) for column in zip(*points, strict=True)))


class Student:
    """A model that learns from `Ways`."""

    def __init__(self, model: Pi0Model, settings: Settings) -> None:
        self.model, self.settings = model, settings
        self._learning = {name: one for name, one in model.named_parameters() if _learns(name)}
        for name, parameter in model.named_parameters():
            parameter.requires_grad_(name in self._learning)
        self._average = {name: one.detach().clone() for name, one in self._learning.items()}
        learning, rate = list(self._learning.values()), settings.learning_rate
        self._optimizer = torch.optim.AdamW(learning, rate, (0.9, 0.95), weight_decay=0)
        self._steps = 0

    def step(self, ways: Ways, progress: float) -> float:
        """The loss of a batch: half of it at noise, half on the way."""
        settings, (count, noises) = self.settings, ways.t.shape
        rows, which = (torch.randint(most, (settings.batch,)) for most in (count, noises))
        at_noise = torch.arange(settings.batch) < settings.batch // 2
        noise, between = ways.noise[rows, which], ways.between[rows, which]
        x = torch.where(at_noise[:, None, None], noise, between)
        t = torch.where(at_noise, torch.ones(()), ways.t[rows, which])
        actions = ways.actions[rows, which]
        if settings.recipe == "shuffled":
            other = (which + torch.randint(1, noises, which.shape)) % noises
            actions = torch.where(at_noise[:, None, None], ways.actions[rows, other], actions)
        elif settings.recipe == "mean":
            actions = torch.where(at_noise[:, None, None], ways.actions[rows].mean(1), actions)
        velocity = suffix_velocity(self.model, ways.k[:, rows], ways.v[:, rows], x, t)
        reached = x - t[:, None, None] * velocity
        loss = ((reached - actions).square() * WEIGHTS).sum(-1).mean() / WEIGHTS.sum()
        self._learn(loss, progress)
        return float(loss.detach())

    def _learn(self, loss: Tensor, progress: float) -> None:
        settings = self.settings
        rate = settings.learning_rate * min(1.0, (self._steps + 1) / settings.warmup_steps)
        for group in self._optimizer.param_groups:
            group["lr"] = rate * (0.5 * (1 + math.cos(math.pi * progress)) * 0.99 + 0.01)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(list(self._learning.values()), 1.0)
        self._optimizer.step()
        self._optimizer.zero_grad(set_to_none=True)
        self._steps += 1
        keep = min(settings.ema, (1 + self._steps) / (10 + self._steps))
        torch._foreach_lerp_(list(self._average.values()), [one.detach() for one in self._learning.values()], 1 - keep)

    def state(self) -> dict[str, Tensor]:
        """Averaged weights; the prefix's are the teacher's."""
        return {name: one.detach() for name, one in self.model.state_dict().items()} | self._average


def _learns(name: str) -> bool:
    return name.startswith(("expert.", "action_", "time_mlp_"))
