"""Closed loop on the toy tasks, all episodes at once, with the float32 reference and whatever a study puts into it.

Episodes are numbered; episode n begins alike and is given the same noise in every cell, so that cells are paired.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from turbopi.checkpoint import open_checkpoint
from turbopi.config import PolicyConfig
from turbopi.evaluate.statistics import Paired, Rate
from turbopi.models.observation import Observation
from turbopi.models.pi0.reference import Pi0Model
from turbopi.policy import shipped
from turbopi.preprocess.tokenizer import TINY_TOKENIZER, load_tokenizer
from turbopi.sim import chase
from turbopi.sim.chase import Chase
from turbopi_lab.studies import post

REPLAN = 5  # actions that are carried out of a chunk
WAIT = 10  # steps in which the tip stands still before an episode of the chase begins, as in its environment
POST_STEPS = 45  # of an episode of the post; its experts need some 25


@dataclass(frozen=True)
class Toy:
    """A task: how its episodes begin, its instruction, its limit of steps."""

    name: str
    instruction: str
    max_steps: int
    start: Callable[[Sequence[Sequence[int]]], Chase]


def _start_chase(seeds: Sequence[Sequence[int]]) -> Chase:
    world = Chase.start([np.random.default_rng(list(seed)) for seed in seeds])
    for _ in range(WAIT):
        world.step(np.zeros((len(seeds), 2)))
    return world.cleared()


CHASE = Toy("chase", chase.INSTRUCTION, chase.MAX_STEPS, _start_chase)
POST = Toy("post", post.INSTRUCTION, POST_STEPS, post.start)


@dataclass(frozen=True)
class ToyPolicy:
    """A policy of a toy task, in float32."""

    name: str
    toy: Toy
    model: Pi0Model
    config: PolicyConfig
    tokens: Tensor  # int64[1, P]: the instruction, without padding

    def observe(self, world: Chase) -> Observation:
        """What all episodes see now."""
        camera_images = torch.from_numpy(world.draw(self.config.planned_model.vision.image_size))
        batch, cameras = camera_images.shape[:2]
        tokens = self.tokens.expand(batch, -1)
        there = torch.ones(batch, cameras, dtype=torch.bool)
        state = torch.zeros(batch, self.config.model.action_dim)  # none of these policies reads it
        return Observation(camera_images, there, tokens, torch.ones_like(tokens, dtype=torch.bool), state)

    def noise(self, episodes: Sequence[int], call: int) -> Tensor:
        """float32[N, H, action_dim] of every episode's call."""
        shape = (self.config.model.action_horizon, self.config.model.action_dim)
        drawn = [np.random.default_rng([call, n]).standard_normal(shape, dtype=np.float32) for n in episodes]
        return torch.from_numpy(np.stack(drawn))


def open_policy(name: str, folder: Path = shipped.CHASE_POLICY) -> ToyPolicy:
    """The policy in a checkpoint's folder; its asset says which task it is for."""
    checkpoint = open_checkpoint(folder)
    config = checkpoint.config
    toy = POST if config.asset_id == "turbopi/post" else CHASE
    tokenizer = load_tokenizer(TINY_TOKENIZER, vocab_size=config.model.vocab_size)
    model = Pi0Model.from_state(config.planned_model, checkpoint.load(torch.device("cpu"), "f32").state)
    return ToyPolicy(name, toy, model, config, torch.tensor([tokenizer.encode(toy.instruction)]))


@dataclass
class Call:
    """One question to the policy, of all episodes at once."""

    number: int
    episodes: Sequence[int]
    observation: Observation
    noise: Tensor
    previous: Tensor | None  # the chunks of the call before [N, H, A], from the next action on; None at first


Actor = Callable[[Call], Tensor]  # -> chunks float32[N, H, A]


@dataclass
class Played:
    """What came of a cell's episodes."""

    solved: np.ndarray  # bool[N]
    touched: np.ndarray  # bool[N]: the tip touched the post before the task was solved
    paths: np.ndarray = field(repr=False)  # float64[steps + 1, N, 2]: where the tips were, while they mattered

    @property
    def rate(self) -> Rate:
        return Rate(int(self.solved.sum()), len(self.solved))

    def against(self, baseline: "Played") -> Paired:
        """This cell less the baseline."""
        return Paired.of(list(zip(baseline.solved.tolist(), self.solved.tolist(), strict=True)))


def sampled(model: Pi0Model, steps: int) -> Actor:
    """The reference as it is."""
    return lambda call: model.sample(call.observation, call.noise, steps)


def met(policy: ToyPolicy, episodes: Sequence[int], actor: Actor, calls: int = 4) -> tuple[Observation, Tensor]:
    """What the policy meets in the first calls of some episodes, and its noise, as one batch."""
    seen: list[Observation] = []
    noises: list[Tensor] = []

    def keeping(call: Call) -> Tensor:
        if call.number < calls:
            seen.append(call.observation)
            noises.append(call.noise)
        return actor(call)

    play(policy, episodes, keeping)
    return Observation.joined(seen), torch.cat(noises)


def seeds_of(episodes: Sequence[int]) -> list[tuple[int, int]]:
    """Of the worlds; training's are of 41 bits."""
    return [(7, n) for n in episodes]


def play(
    policy: ToyPolicy, episodes: Sequence[int], actor: Actor, replan: int = REPLAN, *, everyone: bool = False
) -> Played:
    """The episodes from their start to the task's limit; nothing is delayed.

    The policy isn't asked any more for episodes that are decided: solved, or lost at the post. `everyone`: it is.
    """
    world = policy.toy.start(seeds_of(episodes))
    solved, touched = (np.zeros(len(episodes), np.bool_) for _ in range(2))
    config = policy.config.model
    chunk = torch.zeros(len(episodes), config.action_horizon, config.action_dim)
    paths = [world.tip]
    for step in range(policy.toy.max_steps):
        if step % replan == 0:
            rows = np.flatnonzero(everyone | ~(solved | world.stopped))
            if not len(rows):
                break
            call, numbers = step // replan, [episodes[row] for row in rows]
            previous = None if step == 0 else rest(chunk[rows], replan)
            seen, noise = policy.observe(world.rows(rows)), policy.noise(numbers, call)
            chunk[rows] = actor(Call(call, numbers, seen, noise, previous))
        solved |= world.step(chunk[:, step % replan, :2].double().numpy())
        touched |= world.stopped & ~solved
        paths.append(world.tip)
    return Played(solved, touched, np.stack(paths))


def rest(chunk: Tensor, done: int) -> Tensor:
    """A chunk from its action `done` on, its last action repeated."""
    return torch.cat((chunk[:, done:], chunk[:, -1:].expand(-1, done, -1)), dim=1)
