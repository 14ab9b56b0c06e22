"""Timing a policy's calls: every call a fresh observation, prompt and noise, from host to host."""

import copy
import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from turbopi.backends import Precision
from turbopi.bench.document import PolicyError, Times
from turbopi.bench.work import MODEL_SIZE, Job
from turbopi.checkpoint import Checkpoint
from turbopi.config import CAMERAS, Normalization, PolicyConfig, Solver, TimeGrid
from turbopi.models import family_of
from turbopi.models.pi0.conditioning import Conditioning, Guidance, TokenTimes, guidance_strength, guidance_weights
from turbopi.models.pi0.noise_choice import NoiseChoice
from turbopi.policy.policy import UnifiedPolicy
from turbopi.preprocess.pipeline import Pipeline
from turbopi.preprocess.tokenizer import tokenizer_of
from turbopi.quantization.plan import TIERS
from turbopi.robots import Plain, Robot
from turbopi.support.errors import ConfigError

_WORDS = "pick up the red black white bowl mug plate and place put it on in left right drawer stove open a to of"
WORDS = _WORDS.split()
PROMPTS = 16  # different ones, taken in turn
PERCENTILES = (5, 50, 95, 99)
WARMING = 3  # calls before those that count
FEWEST = 20  # calls that a measurement has, however slow they are


def bench_policy(
    checkpoint: Checkpoint,
    backend: str,
    precision: Precision,
    device: torch.device,
    job: Job,
    *,
    tokenizer: object = None,
    quantization: str | None = None,
    robot: str | Robot | None = None,
    solver: Solver | None = None,
    time_grid: TimeGrid | None = None,
    most_steps: int | None = None,
) -> UnifiedPolicy:
    """The checkpoint's policy for a job: its model with the `plain` robot, so that cameras and prompt can be chosen.

    The state stays out of the prompt and nothing is normalised: actions are the model's own. With a `robot` all of
    that is the robot's, and the job has to have its cameras (`robots_job`). Where the model writes its actions as
    tokens, a job's steps are tokens of each answer, whatever it says: at most `most_steps` of all jobs.
    """
    config = checkpoint.config
    if robot is None:
        identity = Normalization("identity", "identity")
        config = dataclasses.replace(
            config,
            robot="plain",
            robot_options={},
            discrete_state_input=False,
            normalization=identity,
            missing_cameras="masked",
        )
    config = config.with_model(action_horizon=job.horizon)
    if tokens := writes_tokens(config):
        config = config.with_model(broken_answers="unread", max_decoding_steps=most_steps or job.steps)
    return UnifiedPolicy(
        dataclasses.replace(checkpoint, config=config),
        backend=backend,
        precision=precision,
        num_denoising_steps=None if tokens else job.steps,
        solver=solver,
        time_grid=time_grid,
        device=device,
        tokenizer=tokenizer,
        quantization=quantization if precision in TIERS else None,
        robot=robot,
    )


def robots_job(checkpoint: Checkpoint, robot: str | Robot, tokenizer: str | None = None) -> Job:
    """The robot's example: its cameras, prompt tokens and first image's size. The checkpoint's horizon and steps."""
    found = tokenizer_of(checkpoint, tokenizer)
    pipeline = Pipeline(checkpoint.config, checkpoint.norm_stats, found, robot=robot)
    one, config = pipeline.see(pipeline.example(), resize=False), checkpoint.config
    pipeline.read(one)
    width, height = one.camera_images[0].shape[1::-1] if one.camera_images else MODEL_SIZE
    tokens = int(one.token_mask.sum())
    return Job(
        int(one.image_mask.sum()), tokens, config.model.action_horizon, config.num_denoising_steps, width, height
    )


def for_job(policy: UnifiedPolicy, job: Job) -> UnifiedPolicy:
    """The same policy, weights and captured graphs with the job's number of actions in a chunk; of a model that writes
    its actions as tokens, with its number of tokens.
    """
    if writes_tokens(policy.config):
        return policy.writing(job.steps)
    other = copy.copy(policy)
    other.config = policy.config.with_model(action_horizon=job.horizon)
    return other


def writes_tokens(config: PolicyConfig) -> bool:
    return family_of(config.model).reader is not None


def conditioning(policy: UnifiedPolicy, job: Job) -> Conditioning | None:
    """What joins a job's chunks to a random one, as after a delay of a quarter of a chunk."""
    if job.join == "none":
        return None
    horizon, delay = job.horizon, job.horizon // 4
    model = policy.config.model
    target = np.random.default_rng(0).standard_normal((horizon, model.action_dim), dtype=np.float32)
    if job.join == "held":
        return Conditioning(held=np.arange(horizon) < delay, values=target)
    if job.join == "paint":
        return Conditioning(noise=NoiseChoice(np.arange(horizon) < delay, target))
    times = TokenTimes.plain(job.steps, horizon, model.time_grid).times
    weights = guidance_weights(horizon, delay, delay)
    return Conditioning(guidance=Guidance(target, weights, guidance_strength(times, 5.0), job.join))


class Observations:
    """Random observations of a job: another image, state and prompt each time, the same ones for the same seed.

    For a robot other than `plain` they are that robot's examples, which all have its one prompt.
    """

    def __init__(self, policy: UnifiedPolicy, job: Job, seed: int = 0) -> None:
        if not 1 <= job.cameras <= len(CAMERAS):
            raise ConfigError(f"a job has 1 to {len(CAMERAS)} cameras, not {job.cameras}")
        self._own = None if isinstance(policy.pipeline.robot, Plain) else 10**6 * seed  # of the next example
        most = policy.config.model.max_prompt_tokens
        if not 1 <= job.prompt_tokens <= most:
            raise ConfigError(
                f"this model reads 1 to {most} prompt tokens; a job can't have {job.prompt_tokens}: give "
                "--prompt-tokens"
            )
        self._rng = np.random.default_rng(seed)
        self._cameras, self._size = CAMERAS[: job.cameras], (job.image_height, job.image_width, 3)
        self._policy = policy
        self._prompts = [self._prompt(job.prompt_tokens) for _ in range(PROMPTS)] if self._own is None else []
        self._next = 0

    def __next__(self) -> dict[str, Any]:
        self._next += 1
        if self._own is not None:
            return self._policy.example_observation(self._own + self._next)
        return self._observation(self._prompts[self._next % PROMPTS])

    def _observation(self, prompt: str) -> dict[str, Any]:
        camera_images = {camera: self._rng.integers(0, 256, self._size, dtype=np.uint8) for camera in self._cameras}
        return {"images": camera_images, "state": self._rng.uniform(-1, 1, 7), "prompt": prompt}

    def _prompt(self, tokens: int) -> str:
        """A random prompt of exactly that many tokens; `bench_policy` keeps the state out of it."""
        pipeline = self._policy.pipeline
        for _ in range(100):
            words: list[str] = []
            while (count := len(pipeline.tokenizer.encode(" ".join(words), write=pipeline.write))) < tokens:
                more = max(1, (tokens - count) // 8)  # a word takes fewer than eight tokens, or the next try finds one
                words += map(str, self._rng.choice(WORDS, more))
            if count == tokens:
                return " ".join(words)
        raise ConfigError(f"found no prompt of exactly {tokens} tokens with this tokenizer; try another number")


@dataclass(frozen=True)
class Latency:
    """Milliseconds over the calls of one measurement."""

    calls: int
    mean: float
    percentiles: dict[int, float]

    @classmethod
    def of(cls, values: list[float]) -> "Latency":
        return cls(len(values), float(np.mean(values)), {p: float(np.percentile(values, p)) for p in PERCENTILES})

    @property
    def median(self) -> float:
        return self.percentiles[50]

    @property
    def times(self) -> Times:
        p5, p50, p95, p99 = (self.percentiles[p] for p in PERCENTILES)
        return Times(mean=self.mean, p5=p5, p50=p50, p95=p95, p99=p99)


def call(
    policy: UnifiedPolicy, job: Job, observations: Observations, requested: Conditioning | None = None
) -> dict[str, float]:
    """The times of one call with new observations: of a batch all of it. `asked` is `conditioning(policy, job)`."""
    if requested is None:
        requested = conditioning(policy, job)
    if job.batch > 1:
        batch = [next(observations) for _ in range(job.batch)]
        joins = None if requested is None else [requested] * job.batch
        return dict(policy.infer_batch(batch, num_steps=job.steps, conditioning=joins)[0]["policy_timing"])
    return dict(policy.infer(next(observations), num_steps=job.steps, conditioning=requested)["policy_timing"])


def measure_calls(
    policy: UnifiedPolicy,
    job: Job,
    calls: int,
    *,
    seed: int = 0,
    seconds: float = float("inf"),
    advance: Callable[[], None] = lambda: None,
) -> dict[str, Latency]:
    """Latency of "total", "infer", the stages, and "device", their sum, over `calls` calls after three for warm-up.

    Ends early after `seconds`, though not before 20 calls.
    """
    observations = Observations(policy, job, seed)
    timings: dict[str, list[float]] = {}
    requested = conditioning(policy, job)
    for _ in range(WARMING):
        call(policy, job, observations, requested)
        advance()
    end = time.perf_counter() + seconds
    for i in range(calls):
        if i >= FEWEST and time.perf_counter() > end:
            break
        timing = call(policy, job, observations, requested)
        stages = [timing[f"{stage}_ms"] for stage in ("vision", "prefix", "denoise") if f"{stage}_ms" in timing]
        if stages:
            timing["device_ms"] = sum(stages)
        for name, milliseconds in timing.items():
            timings.setdefault(name.removesuffix("_ms"), []).append(milliseconds)
        advance()
    return {name: Latency.of(values) for name, values in timings.items()}


def answers(policy: UnifiedPolicy, job: Job, *, observations: int = 4) -> np.ndarray:
    """float64[observations, H, action_dim]: actions on observations and noise that are the same for every policy."""
    source = Observations(policy, job, seed=1)
    shape = (job.horizon, policy.config.model.action_dim)
    chunks = []
    for seed in range(observations):
        noise = np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)
        requested = conditioning(policy, job)
        given: dict[str, Any] = {} if writes_tokens(policy.config) else {"noise": noise}
        answer = policy.infer(next(source), num_steps=job.steps, conditioning=requested, **given)
        chunks.append(answer["actions"])
    return np.stack(chunks)


def error_against(ours: np.ndarray, exact: np.ndarray) -> PolicyError:
    """The error of a policy's `answers` against the float32 reference's."""
    difference = ours - exact
    relative_rms = float(np.sqrt(np.mean(difference**2) / np.mean(exact**2)))
    return PolicyError(relative_rms, float(np.abs(difference).max()), len(exact))
