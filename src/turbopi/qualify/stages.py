"""The stages of qualifying, each of which raises `Faulty` for what isn't right."""

import gc
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np
import torch

from turbopi import backends
from turbopi.backends.base import Sample
from turbopi.backends.qualification import DENOISE
from turbopi.bench.measure import bench_policy, measure_calls
from turbopi.bench.work import Job
from turbopi.calibrate.run import Progress, Settings, calibrate
from turbopi.checkpoint import Checkpoint, open_checkpoint
from turbopi.checkpoint.random_weights import random_checkpoint
from turbopi.config import Network, Normalization, PolicyConfig, VisionConfig
from turbopi.engine.graph import empty_cache, preparing
from turbopi.kernels.grid_barrier import barrier_us, check_barrier
from turbopi.kernels.ops import hopper_kernels
from turbopi.models import RANDOM
from turbopi.models.observation import ModelInputs, Observation
from turbopi.policy import shipped
from turbopi.preprocess.pipeline import Pipeline
from turbopi.preprocess.tokenizer import tokenizer_of
from turbopi.qualify.four_bits import OPERATIONS, check_four_bits
from turbopi.qualify.operations import AHEAD, COMPILING, At, Comparison
from turbopi.quantization.calibration_file import RANDOM_NOISE, Quantization, shapes_of
from turbopi.quantization.plan import TIERS, Precision, format_of
from turbopi.quantization.sites import Site, sites
from turbopi.support.errors import BackendUnavailable
from turbopi.support.text import significant
from turbopi.tune.race import busy, timed, winner
from turbopi.verify.check_golden import GOLDEN_METHODS
from turbopi.verify.document import Certificate
from turbopi.verify.inputs import VerifyPlan
from turbopi.verify.run import verify

LAYERS = 4  # of the model's: more than vision's head, which a graph of its own runs
OBSERVATIONS, NOISES = 4, 2
BATCH = 2
# Of a batch's actions against single calls', relative rms: either rounds by itself, to 0.02 with such weights
BATCH_BOUND, EIGHT_BITS_BATCH_BOUND, FOUR_BITS_BATCH_BOUND = 0.06, 0.12, 0.3
MARGIN = 0.01  # of the time of `cuda_graph`: less is noise
RACE_TURNS, CALLS = 5, 9  # of each backend, and calls of a turn, beside those that warm it
PARTS = ("total", "vision", "prefix", "denoise")  # of a call's time
Figures = dict[str, float]  # by what they are of
Turn = Callable[[], Figures]  # some calls; medians of each of PARTS
OF_DENOISING = ("x_t", "v_t", "actions")


class Faulty(Exception):
    """Something isn't right. path: what of `fused` to exclude for it, "" for all."""

    def __init__(self, why: str, path: str = "") -> None:
        super().__init__(why)
        self.path = path


@dataclass(frozen=True)
class Subject:
    """What is qualified. excluded: so far. rival: what `auto` takes in its place; None: nothing has the precision."""

    model: Network
    precision: Precision
    device: torch.device
    at: At
    excluded: dict[str, str]
    name: str = "fused"
    rival: str | None = "cuda_graph"

    def policy_config(self, model: Network) -> PolicyConfig:
        """As `turbopi bench` has it: nothing but the model."""
        base = next(one for one in RANDOM.values() if type(one.model) is type(model) and one.model.kind == model.kind)
        identity = Normalization("identity", "identity")
        plain = replace(base, name="qualified", model=model, robot="plain", robot_options={}, normalization=identity)
        return replace(plain, discrete_state_input=False, missing_cameras="masked", asset_id=None)

    def quantization(self, checkpoint: Checkpoint) -> Quantization | None:
        """A calibration on a few observations."""
        if self.precision not in TIERS:
            return None
        self.at("calibrating", "", COMPILING)
        format, source = format_of(self.precision), RANDOM_NOISE if checkpoint.path is None else None
        settings = Settings(
            {"device": self.device},
            source,
            count=OBSERVATIONS,
            methods=GOLDEN_METHODS[format.name],
            format=format,
        )
        return calibrate(checkpoint, settings)

    @property
    def progress(self) -> Progress:
        return Progress(lambda text, total: self.at(text, "", COMPILING), lambda: self.at("", "", 0.0))


def stretched(quantization: Quantization, checkpoint: Checkpoint) -> Quantization:
    """For all layers of a checkpoint, from the shallow model's: the last ones are alike, and so are all others."""
    model: Any = checkpoint.config.model

    def origin(site: Site) -> str:
        part = "vlm" if site.part == "prefix" else site.part
        deep, few = getattr(model, part).depth, getattr(shallow(model), part).depth
        layer = few - 1 if site.layer + 1 == deep else min(site.layer, max(few - 2, 0))
        return str(replace(site, layer=layer))

    found = {str(site): quantization.sites[origin(site)] for site in sites(model)}
    return replace(quantization, fingerprint=checkpoint.fingerprint(), shapes=shapes_of(model), sites=found)


def shallow(config: Any) -> Any:
    """The same sizes with at most LAYERS layers in each stack."""
    deepest = max(_depths(config))

    def cut(part: Any) -> Any:
        if isinstance(part, VisionConfig):
            return replace(part, depth=min(part.depth, LAYERS))
        changes: dict[str, Any] = {}
        for one in fields(part):
            value = getattr(part, one.name)
            if is_dataclass(value):
                changes[one.name] = cut(value)
            elif one.name.endswith("depth") and deepest > LAYERS:
                changes[one.name] = max(1, value * LAYERS // deepest)
        return replace(part, **changes)

    return cut(config)


def _depths(part: Any) -> Iterator[int]:
    for one in fields(part):
        value = getattr(part, one.name)
        if is_dataclass(value) and not isinstance(value, VisionConfig):
            yield from _depths(value)
        elif one.name.endswith("depth"):
            yield value


# -- the grid's barrier, each kernel -----------------------------------------------------------------------------------


def check_grid(subject: Subject) -> Figures:
    """The barrier's cost. The denoising kernel alone has one."""
    if DENOISE in subject.excluded:
        return {}
    subject.at("the grid's barrier", DENOISE, COMPILING)  # it gives up by itself
    try:
        why = check_barrier(subject.device)
    except BackendUnavailable as failure:
        why = str(failure)
    if why is not None:
        raise Faulty(f"the grid's barrier doesn't hold: {why}", DENOISE)
    return {"barrier us": round(barrier_us(subject.device) or 0.0, 3)}


def check_kernels(subject: Subject, checkpoint: Checkpoint, quantization: Quantization | None) -> Comparison:
    """Every operation of a call beside PyTorch's, then a batch beside its single calls; before them NVFP4's kernels."""
    if subject.precision == "nvfp4":
        subject.at("matmuls in NVFP4", "", COMPILING)
        why, _ = check_four_bits(subject.device)
        if why is not None:
            raise Faulty(why)
    cls = backends.class_for(subject.name, subject.model)
    compared = Comparison(subject.device, subject.at, ahead=AHEAD not in subject.excluded)

    class Compared(cls):  # type: ignore[valid-type, misc]
        def _make_ops(self) -> Any:
            return compared.around(super()._make_ops())

        def _make_denoiser(self, *given: Any, **named: Any) -> Any:
            return compared.denoiser(super()._make_denoiser, *given, **named)

    with preparing(subject.device):
        backend: Any = Compared(
            checkpoint.config.model,
            lambda to, mode: checkpoint.load(to, mode).state,
            device=subject.device,
            precision=subject.precision,
            quantization=quantization,
        )
    steps, model = checkpoint.config.num_denoising_steps, checkpoint.config.model
    inputs = [filled(checkpoint, seed) for seed in range(BATCH)]
    noise = torch.from_numpy(
        np.random.default_rng(0).standard_normal((BATCH, model.action_horizon, model.action_dim), dtype=np.float32)
    )
    alone = [backend.sample(Observation.stack([one]), noise[i : i + 1], steps) for i, one in enumerate(inputs)]
    if cls.runs_batches and not compared.failed and "batch" not in subject.excluded:
        compared.compares = False  # rows of a batch's padding may be anything
        subject.at("a batch of two", "batch", COMPILING)
        together = backend.sample(Observation.stack(inputs), noise, steps)
        _check_batch(together, alone, _batch_bound(subject.precision))
    subject.at("kernels", "", COMPILING)
    if subject.precision == "nvfp4" and (wrong := compared.failed.keys() & set(OPERATIONS)):
        raise Faulty("; ".join(f"{name}, beside PyTorch's, {compared.failed[name]}" for name in sorted(wrong)))
    return compared


def _batch_bound(precision: Precision) -> float:
    if precision == "nvfp4":
        return FOUR_BITS_BATCH_BOUND
    return EIGHT_BITS_BATCH_BOUND if precision in TIERS else BATCH_BOUND


def _check_batch(together: Sample, alone: list[Sample], bound: float) -> None:
    exact = torch.cat([one.actions for one in alone]).float()
    error = float((together.actions.float() - exact).norm() / exact.norm())
    if not error <= bound:
        raise Faulty(f"a batch's actions are off by {significant(error)}; at most {bound} is right", "batch")


def filled(checkpoint: Checkpoint, seed: int) -> ModelInputs:
    """An observation of random images whose prompt fills whole tiles: no row is padding, which may be anything."""
    config = checkpoint.config
    pipeline = Pipeline(config, checkpoint.norm_stats, tokenizer_of(checkpoint, None))
    inputs = pipeline.complete(pipeline.see(pipeline.example(seed)))
    count, longest = len(inputs.tokens) // 16 * 16 or len(inputs.tokens), len(inputs.tokens)
    tokens = np.random.default_rng(seed).integers(1, config.model.vocab_size, longest)
    valid = np.arange(longest) < count
    return replace(inputs, tokens=np.where(valid, tokens, 0), token_mask=valid)


# -- stages against float32 --------------------------------------------------------------------------------------------


def certify(subject: Subject, checkpoint: Checkpoint, quantization: Quantization | None) -> Figures:
    """The worst error of each stage over what is allowed there (`turbopi verify`)."""
    arguments = {
        "backend": subject.name,
        "precision": subject.precision,
        "device": subject.device,
        "quantization": quantization,
    }
    plan = VerifyPlan(arguments, count=OBSERVATIONS, noises=NOISES, fingerprint=False)
    certificate = verify(checkpoint, plan, subject.progress)
    judge(certificate, subject)
    worst = {"prefix": 0.0, "denoise": 0.0}
    for one in certificate.intermediates:
        if one.allowed and one.name != "actions":
            stage = "denoise" if one.name in OF_DENOISING else "prefix"
            worst[stage] = max(worst[stage], one.badness)
    limit, error = certificate.bounds.actions_relative_rms, certificate.actions.relative_rms
    figures = {f"{stage}, error over bound": round(value, 3) for stage, value in worst.items()}
    return figures | {"actions, error over bound": round((error or 0.0) / (limit or 1.0), 3)}


def judge(certificate: Certificate, subject: Subject) -> None:
    """Raise Faulty, by the first stage that is off."""
    off = [one for one in certificate.intermediates if one.above or not one.finite]
    if certificate.ok and not off:
        return
    why = certificate.verdict if not certificate.ok else f"{off[0].name} is off by {significant(off[0].relative_rms)}"
    path = DENOISE
    if any(one.name not in OF_DENOISING for one in off):
        path = "sm90" if hopper_kernels(subject.device, subject.excluded) else ""
    raise Faulty(why, "" if path in subject.excluded else path)


def golden(subject: Subject) -> Checkpoint | None:
    """The small policy that ships, if the backend runs it by the same class as the model."""
    checkpoint = open_checkpoint(shipped.SMALL_POLICY)
    same = backends.class_for(subject.name, checkpoint.config.model) is backends.class_for(subject.name, subject.model)
    return checkpoint if same else None


# -- the race ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Raced:
    """milliseconds by backend and stage, medians; memory: bytes that the subject reserved; wins: whether it is the
    faster one; note: what makes the times doubtful.
    """

    milliseconds: dict[str, dict[str, float]]
    memory: int
    wins: bool
    note: str


def race(subject: Subject, quantization: Quantization | None, warm_rival: Callable[[], Turn | None]) -> Raced:
    """Calls of the whole model with random weights, of both in turns where the memory is enough for both.

    warm_rival: the rival's turns of another process; it is made here where that has none.
    """
    times: dict[str, list[Figures]] = {}
    notes = []

    def measure(racers: dict[str, Turn], turns: int = RACE_TURNS) -> None:
        for turn in range(turns):
            for name in reversed(racers) if turn % 2 else racers:
                times.setdefault(name, []).append(racers[name]())

    free(subject.device)
    ours = turn_of(subject, subject.name, quantization)
    measure({subject.name: ours}, 1)
    memory, both = _reserved(subject.device), False
    times.clear()
    if subject.rival is not None:
        with suppress(torch.OutOfMemoryError):
            measure({subject.rival: warm_rival() or rival_turn(subject), subject.name: ours})
            both = True
    if not both:
        times.clear()
        measure({subject.name: ours})
        del ours
        free(subject.device)
        if subject.rival is not None:
            notes.append("one after the other, as the memory isn't enough for both")
            measure({subject.rival: rival_turn(subject)})
    rows = {name: timed({}, [turn["total"] for turn in turns]) for name, turns in times.items()}
    if busy(row.spread for row in rows.values()):
        notes.append("times varied by more than 15 %: was the GPU used by others?")
    medians = {
        name: {part: round(float(np.median([turn[part] for turn in turns])), 3) for part in turns[0]}
        for name, turns in times.items()
    }
    first = rows[subject.rival or subject.name]
    wins = subject.rival is None or winner({0: first, 1: rows[subject.name]}, MARGIN) is not first
    return Raced(dict(sorted(medians.items(), key=lambda one: one[0] != subject.name)), memory, wins, "; ".join(notes))


def turn_of(subject: Subject, name: str, quantization: Quantization | None) -> Turn:
    """Of a backend with the model at full size."""
    config, model = subject.policy_config(subject.model), subject.model
    checkpoint = random_checkpoint(config)
    given: Any = None if quantization is None else stretched(quantization, checkpoint)
    job = Job(2, min(48, model.max_prompt_tokens), model.action_horizon, config.num_denoising_steps)
    subject.at(f"{name} at full size", "", COMPILING)
    policy = bench_policy(checkpoint, name, subject.precision, subject.device, job, quantization=given)

    def turn() -> Figures:
        found = measure_calls(policy, job, CALLS)
        return {part: found[part].median for part in PARTS if part in found}

    return turn


def rival_turn(subject: Subject) -> Turn:
    assert subject.rival is not None
    return turn_of(subject, subject.rival, None)


def _reserved(device: torch.device) -> int:
    return torch.cuda.max_memory_reserved(device) if device.type == "cuda" else 0


def free(device: torch.device) -> None:
    """What nobody holds any more, and what was reserved at most so far."""
    gc.collect()
    if device.type == "cuda":
        empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
