"""The policy of the chase (turbopi.sim.chase), trained with simulated delays: data, losses, export.

    python -m turbopi_lab.small_policy chase --out work/chase --seconds 900

The expert plays under delays, with noise. A frame has the chunk that an expert would go on with: the first d actions
are those that are on their way already, from its plan of before, and the others are planned for where they lead. d is
the frame's delay in training; with 0 all of the chunk is planned now.
"""

import math
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbopi.checkpoint.norm_stats import FeatureStats, NormStats
from turbopi.config import GemmaConfig, ModelConfig, PolicyConfig, RealTime, VisionConfig
from turbopi.models.pi0.reference import Pi0Model
from turbopi.models.pi0.vision import VisionTower
from turbopi.preprocess.tokenizer import TINY_TOKENIZER, load_tokenizer
from turbopi.sim.chase import BLOB, INSTRUCTION, MAX_STEPS, POST, SPEED, VIEWS, Chase, cut
from turbopi.sim.chase_expert import choose_sides, keep_sides, plan
from turbopi_lab.small_policy.export import export
from turbopi_lab.small_policy.forward import Guide, draw_times, flow_loss, held_actions, mixed, velocity
from turbopi_lab.small_policy.start import fresh_model, trained_model

HORIZON = 16
MOST_DELAY = 6
EXECUTED = (3, 8)  # actions of a chunk that the demonstrating expert carries out
GUIDED = 8  # numbers that the guide tells from the images: target, where it was, tip, and from tip to target
GUIDE_WEIGHT = 0.5
WEIGHTS = torch.tensor([1.0, 1.0] + [0.02] * 30)  # of the loss, by dimension: the tip's, then what does nothing
_STACK = GemmaConfig(width=64, mlp_dim=128, depth=3, num_heads=4, num_kv_heads=1, head_dim=16)
CONFIG = PolicyConfig(
    "pi05_chase",
    ModelConfig(
        vision=VisionConfig(width=64, depth=1, mlp_dim=128, num_heads=4, patch_size=16, image_size=48),
        vlm=_STACK,
        expert=_STACK,
        vocab_size=1024,
        action_horizon=HORIZON,
        max_prompt_tokens=16,
    ),
    "libero",
    discrete_state_input=False,
    asset_id="turbopi/chase",
    num_denoising_steps=5,
    real_time=RealTime(trained_max_delay=MOST_DELAY),
)


@dataclass
class Settings:
    out: Path
    model: str = "pi05"  # or smolvla: chase_smolvla.py
    seconds: float = 900.0
    seed: int = 0
    workers: int = 1  # processes that make the demonstrations
    frames: int = 60_000
    batch: int = 128
    repeats: int = 3  # draws of noise and time for each frame
    learning_rate: float = 2e-3
    warmup_steps: int = 100
    ema: float = 0.995
    watch_every: float = 120.0  # seconds
    resume: Path | None = None  # a state.pt to go on from, with a clock that starts anew
    device: str = "cpu"


@dataclass
class Frames:
    """N frames of demonstrations, whose images are drawn when they are used."""

    places: Tensor  # float32[N, 3, 2]  of the target, of where it was, of the tip
    chunks: Tensor  # float32[N, H, 2]
    delays: Tensor  # int64[N]

    def __len__(self) -> int:
        return len(self.chunks)

    def to(self, device: torch.device) -> "Frames":
        return Frames(self.places.to(device), self.chunks.to(device), self.delays.to(device))

    def undelayed(self) -> "Frames":
        """Those whose chunk is planned now, for a family that holds no actions."""
        rows = self.delays == 0
        return Frames(self.places[rows], self.chunks[rows], self.delays[rows])

    def draw(self, number: int, *, mirrored: bool = True) -> "Frames":
        """As many of them, each turned around the post and, unless `mirrored` is False, half of them mirrored: it looks
        the same from everywhere.
        """
        device = self.places.device
        rows = torch.randint(len(self), (number,), device=device)
        turns = 2 * math.pi * torch.rand(number, device=device)
        mirror = torch.where(torch.rand(number, device=device) < (0.5 if mirrored else 1.0), 1.0, -1.0)
        cos, sin = turns.cos(), turns.sin()
        change = torch.stack((torch.stack((cos, sin), -1), torch.stack((-sin * mirror, cos * mirror), -1)), -2)
        return Frames(self.places[rows] @ change, self.chunks[rows] @ change, self.delays[rows])

    def camera_images(self, px: int) -> Tensor:
        """float32[N, 2, px, px, 3] in [-1, 1]: as `Chase.draw`, but for the rounding."""
        tip = self.places[:, 2]
        return torch.stack((self._view(torch.zeros_like(tip), VIEWS[0], px), self._view(tip, VIEWS[1], px)), dim=1)

    def _view(self, centre: Tensor, half_width: float, px: int) -> Tensor:
        axis = ((torch.arange(px, device=centre.device) + 0.5) / px * 2 - 1) * half_width
        at = self.places - centre[:, None]
        across = (-(((axis - at[..., :1]) / BLOB) ** 2) / 2).exp()
        down = (-(((axis + at[..., 1:]) / BLOB) ** 2) / 2).exp()
        blobs = torch.einsum("bcy,bcx->byxc", down, across)
        x, y = axis + centre[:, :1], axis - centre[:, 1:]
        post = x[:, None, :] ** 2 + y[:, :, None] ** 2 < POST**2
        return (blobs * 215 + 40 * post[..., None]) / 255 * 2 - 1

    def guided(self) -> Tensor:
        """float32[N, GUIDED]"""
        target, _, tip = self.places.unbind(1)
        return torch.cat((self.places.flatten(1), 2 * (target - tip)), dim=1)


def demonstrations(number: int, seed: int, workers: int = 1, at_once: int = 250) -> Frames:
    """Frames of episodes, none of which is one of the simulator's own. Of each frame the target's place comes first."""
    rounds = math.ceil(number / (at_once * MAX_STEPS))
    jobs = [(at_once, seed + part) for part in range(rounds)]
    if workers > 1:
        with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
            played = list(pool.map(_play, *zip(*jobs, strict=True)))
    else:
        played = [_play(*job) for job in jobs]
    places, chunks, delays = (np.concatenate(column)[:number] for column in zip(*played, strict=True))
    return Frames(torch.from_numpy(places), torch.from_numpy(chunks), torch.from_numpy(delays))


def _play(number: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`Frames`' arrays: all steps of `number` episodes at once, each with a delay and an execution horizon."""
    rng = np.random.default_rng([2**40, seed])  # the simulator's own episodes have seeds of 32 bits
    world = Chase.start([np.random.default_rng([2**40, seed, row]) for row in range(number)])
    everyone = np.arange(number)
    delay, every = rng.integers(0, MOST_DELAY + 1, number), rng.integers(EXECUTED[0], EXECUTED[1] + 1, number)
    every = np.maximum(every, delay)
    noise = rng.uniform(0, 0.4, (number, 1)) * (rng.uniform(size=(number, 1)) < 0.7)
    sides = choose_sides(world, rng)
    running = plan(world, HORIZON + MOST_DELAY, sides)  # [N, more than is ever used, 2]: what is on its way
    since = rng.integers(0, every)
    frames = []
    for _ in range(MAX_STEPS):
        ahead = np.minimum(rng.integers(0, MOST_DELAY + 1, number), MOST_DELAY)
        ahead[rng.uniform(size=number) < 0.25] = 0
        chunks, _ = _continued(world, running, ahead, sides, rng)
        frames.append((np.stack((world.target, world.before[:, 0], world.tip), axis=1), chunks, ahead))
        requested = since >= every
        if requested.any():
            rows = np.flatnonzero(requested)
            chosen, sides[rows] = _continued(world.rows(rows), running[rows], delay[rows], sides[rows], rng)
            running = running.copy()
            running[rows], since[rows] = _padded(chosen), 0
        action = running[everyone, 0] + noise * rng.normal(size=(number, 2))
        world.step(action)
        revive(world, rng)
        running = np.concatenate((running[:, 1:], running[:, -1:]), axis=1)
        since += 1
    places, chunks, ahead = (np.concatenate(column) for column in zip(*frames, strict=True))
    return places.astype(np.float32), chunks.astype(np.float32), ahead


def _continued(
    world: Chase, running: np.ndarray, delays: np.ndarray, sides: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Chunks [N, H, 2] that begin with the first of `running`, as many as `delays` [N] say; and their sides."""
    tips = [world.tip]
    for step in range(MOST_DELAY):
        tips.append(tips[-1] + SPEED * cut(running[:, step]))
    rows = np.arange(len(delays))
    later = replace(world, tip=np.stack(tips)[delays, rows], angle=world.angle + world.pace / world.orbit * delays)
    new_sides = np.where(delays > 0, keep_sides(later, sides), choose_sides(world, rng))
    planned = plan(later, HORIZON, new_sides)
    places = np.arange(HORIZON)[None] - delays[:, None]
    fresh = planned[rows[:, None], np.maximum(places, 0)]
    return np.where((places < 0)[..., None], running[:, :HORIZON], fresh), new_sides


def _padded(chunks: np.ndarray) -> np.ndarray:
    return np.concatenate((chunks, np.repeat(chunks[:, -1:], MOST_DELAY, axis=1)), axis=1)


def revive(world: Chase, rng: np.random.Generator) -> None:
    """Tips that touched the post go on from where they are pushed out: no policy learns from standing still."""
    if world.stopped.any():
        far = np.linalg.norm(world.tip, axis=1, keepdims=True)
        pushed = world.tip / far * rng.uniform(0.3, 0.9, far.shape)
        world.tip = np.where(world.stopped[:, None], pushed, world.tip)
        world.cleared()


class Trainer:
    """Learns from `Frames`, all under one prompt: token ids and mask [1, P]; None: the chase's.

    `start` is a checkpoint of the same sizes to begin with; None: fresh weights. Of a Pi0.5; another family's is
    derived from it (chase_smolvla.py).

    image_size  pixels of an image's side
    holds       learns with actions that are on their way, and may be given them
    """

    image_size = CONFIG.planned_model.vision.image_size
    holds = True

    def __init__(
        self, settings: Settings, prompted: tuple[Tensor, Tensor] | None = None, start: Path | None = None
    ) -> None:
        self.settings, self.device = settings, torch.device(settings.device)
        torch.manual_seed(settings.seed)
        self.model: Any = self.fresh() if start is None else trained_model(CONFIG.planned_model, start)
        self.model.to(self.device)
        self.average = {name: value.detach().clone() for name, value in self.model.state_dict().items()}
        self.guide = Guide(self.guide_width, GUIDED, 1, queries=3).to(self.device)
        self._parameters = [*self.model.parameters(), *self.guide.parameters()]
        self.optimizer = torch.optim.AdamW(self._parameters, settings.learning_rate, (0.9, 0.95), weight_decay=0.01)
        self.steps = 0
        self._weights = WEIGHTS.to(self.device)
        self.tokens, self.mask = (tensor.to(self.device) for tensor in prompted or prompt())

    def fresh(self) -> Any:
        """The model before training, on the CPU."""
        model = fresh_model(CONFIG.planned_model, self.settings.seed)
        see_dots(model.vision)
        return model

    @property
    def guide_width(self) -> int:
        """Numbers of a place of the prefix that `predict` gives the guide."""
        return CONFIG.planned_model.vlm.width

    def step(self, batch: Frames, progress: float) -> tuple[float, float]:
        """The losses: of the flow, and of the guide."""
        settings = self.settings
        rate = settings.learning_rate * min(1.0, (self.steps + 1) / settings.warmup_steps)
        for group in self.optimizer.param_groups:
            group["lr"] = rate * (0.5 * (1 + math.cos(math.pi * progress)) * 0.99 + 0.01)
        flow, guide = self.losses(batch)
        (flow + GUIDE_WEIGHT * guide).backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self._parameters, 1.0)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.steps += 1
        keep = min(settings.ema, (1 + self.steps) / (10 + self.steps))
        state, names = self.model.state_dict(), list(self.average)
        torch._foreach_lerp_([self.average[n] for n in names], [state[n].detach() for n in names], 1 - keep)
        return float(flow.detach()), float(guide.detach())

    def save(self, file: Path) -> None:
        parts: dict[str, Any] = {"model": self.model, "guide": self.guide, "optimizer": self.optimizer}
        torch.save({name: part.state_dict() for name, part in parts.items()} | {"average": self.average}, file)

    def load(self, file: Path) -> None:
        content = torch.load(file, map_location=self.device, weights_only=True)
        parts: dict[str, Any] = {"model": self.model, "guide": self.guide, "optimizer": self.optimizer}
        for name, part in parts.items():
            part.load_state_dict(content[name])
        self.average = content["average"]
        self.steps = self.settings.warmup_steps

    def losses(self, batch: Frames) -> tuple[Tensor, Tensor]:
        repeats = self.settings.repeats
        padded = torch.nn.functional.pad(self.scaled(batch.chunks), (0, len(WEIGHTS) - batch.chunks.shape[-1]))
        actions = padded.repeat_interleave(repeats, 0)
        held = held_actions(batch.delays.repeat_interleave(repeats, 0), HORIZON)
        noise, t = torch.randn_like(actions), draw_times(len(actions), self.device)
        predicted, hidden, mask = self.predict(batch, mixed(actions, noise, t, held), t, held)
        guessed, _ = self.guide(hidden, mask)
        guide = torch.nn.functional.smooth_l1_loss(guessed, batch.guided(), beta=0.1)
        return flow_loss(predicted, noise - actions, self._weights, held), guide

    def scaled(self, chunks: Tensor) -> Tensor:
        """Actions [N, H, 2] as the model has them."""
        return chunks

    def predict(self, batch: Frames, x: Tensor, t: Tensor, held: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The velocity at x [N * R, H, action_dim] and times t [N * R], and for the guide: the prefix [N, S, D], and
        which of its last P places are there, bool[N, P]; before them are the images' places.
        """
        tokens, mask = (tensor.expand(len(batch), -1) for tensor in (self.tokens, self.mask))
        return *velocity(self.model, batch.camera_images(self.image_size), tokens, mask, x, t, held=held), mask

    def averaged(self) -> Any:
        """The model with the averaged weights."""
        model = Pi0Model(CONFIG.planned_model).to(self.device)
        model.load_state_dict(self.average)
        return model

    def sample(self, model: Any, world: Chase, noise: Tensor, given: Tensor, delay: int) -> Tensor:
        """What `averaged` does in N episodes, float32[N, H, action_dim]: noise, and `delay` actions that are given."""
        return sample(model, torch.from_numpy(world.draw(self.image_size)).to(self.device), noise, given, delay)

    def export(self) -> None:
        """Write the averaged weights as a checkpoint."""
        state = {name: value.cpu() for name, value in self.average.items()}
        export(state, stats(), self.settings.out / "checkpoint", config=CONFIG)


def see_dots(vision: VisionTower) -> None:
    """Images are mostly dark, with small dots: begin with patches that see nothing in the dark, and dots well."""
    with torch.no_grad():
        patches = vision.patch_embedding
        patches.weight.mul_(5)
        assert patches.bias is not None
        patches.bias.copy_(patches.weight.sum(dim=(1, 2, 3)))  # black is -1


def prompt() -> tuple[Tensor, Tensor]:
    """Token ids and mask [1, P] of the one instruction, without padding."""
    tokenizer = load_tokenizer(TINY_TOKENIZER, vocab_size=CONFIG.model.vocab_size)
    ids = tokenizer.encode(INSTRUCTION)
    return torch.tensor([ids]), torch.ones(1, len(ids), dtype=torch.bool)


@torch.no_grad()
def sample(model: Pi0Model, camera_images: Tensor, noise: Tensor, given: Tensor, delay: int, steps: int = 5) -> Tensor:
    """Chunks [N, H, action_dim] whose first `delay` actions are those of `given`."""
    tokens, mask = (tensor.to(noise.device).expand(len(noise), -1) for tensor in prompt())
    held = held_actions(torch.full((len(noise),), delay, device=noise.device), HORIZON)
    x = torch.where(held[..., None], given, noise)
    for step in range(steps):
        t = torch.full((len(x),), 1 - step / steps, device=x.device)
        v, _ = velocity(model, camera_images, tokens, mask, x, t, held=held)
        x = torch.where(held[..., None], given, x - v / steps)
    return x


def stats() -> NormStats:
    """Actions as they are, from -1 to 1; the state isn't read."""

    def ones(width: int) -> FeatureStats:
        return FeatureStats(mean=np.zeros(width), std=np.ones(width), q01=-np.ones(width), q99=np.ones(width))

    return NormStats(state=ones(8), actions=ones(7))
