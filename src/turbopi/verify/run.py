"""A certificate for a backend, on the user's own weights and observations.

Every named intermediate and the actions against the float32 reference, beside what plain bfloat16 does to the same
inputs. The oracle runs first and its tensors stay on the host; then the control, then the backend, so that only one of
them holds weights at a time. What the noise doesn't enter is compared once an observation.
"""

import gc
import hashlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from msgspec.structs import asdict

from turbopi import backends
from turbopi.backends.pytorch import reference_model
from turbopi.calibrate.run import Progress
from turbopi.checkpoint import Checkpoint
from turbopi.checkpoint.calibration import calibration_of
from turbopi.engine.graph import empty_cache
from turbopi.models import family_of
from turbopi.models.pi0 import exact
from turbopi.policy import shipped
from turbopi.policy.examples import NoisyExample
from turbopi.policy.kept_precision import check_backend
from turbopi.policy.policy import UnifiedPolicy
from turbopi.quantization.calibration_file import Quantization
from turbopi.support.errors import BackendError, CheckpointError
from turbopi.support.provenance import provenance
from turbopi.verify import control
from turbopi.verify.document import Certificate, Latencies, Latency, ObservationsDocument, WeightsDocument
from turbopi.verify.inputs import VerifyPlan, check_observations, make_calls, read_examples
from turbopi.verify.intermediates import Tensors, in_order, tensors_of
from turbopi.verify.verdict import ACTIONS, Compared, Repetition, Rule, judge

_DEMANDED = ("kv_k", "kv_v", "actions")  # by the Backend protocol, and one of _OUTPUTS
_OUTPUTS = {"v_t", "logits"}  # of a flow's evaluations; of tokens


# -- the run -----------------------------------------------------------------------------------------------------------


def verify(checkpoint: Checkpoint, plan: VerifyPlan, progress: Progress | None = None) -> Certificate:
    """The whole verdict (docs/verify.md).

    Raises ConfigError or BackendUnavailable before anything is loaded, ObservationError naming the observation that
    can't be used, CheckpointError where the reference itself gives values that aren't finite.
    """
    progress = progress or Progress()
    arguments = dict(plan.arguments)
    device = backends.resolve_device(arguments["device"])
    precision = arguments["precision"]
    name = arguments["backend"]
    if name == "auto":
        name, _ = backends.choose(device, precision, checkpoint.config.model)
    check_backend(name, device, precision, checkpoint)  # before minutes of the reference
    rule = Rule.of(name, precision, plan.bound, plan.factor, trained=checkpoint.format != "random")
    check_observations(plan)
    quantization = calibration_of(arguments.get("quantization"), precision, checkpoint)
    if checkpoint.format != "random" and family_of(checkpoint.config.model).reader is not None:
        config = checkpoint.config.with_model(broken_answers="owners")  # it judges numbers, and no robot gets them
        checkpoint = replace(checkpoint, config=config)
    if arguments.get("robot") is None:
        checkpoint = shipped.with_libero_stats(checkpoint)
    if quantization is not None:
        made_on = quantization.report["observations"].get("calibration", {})
        plan = replace(plan, calibrated=frozenset(made_on.values()))
    arguments |= {"backend": name, "device": device, "quantization": None}  # of reference and control

    reference = _Reference(checkpoint, arguments, plan, progress)
    control = reference.control(rule, checkpoint, arguments, progress)
    steps, calls = reference.steps, reference.calls
    reference.release()
    # before the policy is made: its calibration is then checked against what was read
    fingerprint = checkpoint.fingerprint() if plan.fingerprint else None
    subject = UnifiedPolicy(checkpoint, **arguments | {"quantization": quantization})
    progress.begin(f"{name} {precision}", 3 * len(calls))
    warmup = subject.warmup()
    compared = reference.compare(subject, progress)
    repetition = _repeat(subject, calls, steps, progress)
    memory = torch.cuda.memory_allocated(device) if device.type == "cuda" else None
    about = provenance(device)  # clocks while the GPU is warm
    details = subject.metadata
    del subject
    _free(device)

    judged = judge(rule, precision, details["robot"], compared, control, repetition)
    exposed = {place.name for place in compared.by_place}
    path = None if checkpoint.path is None else str(checkpoint.path)
    return Certificate(
        **asdict(judged),
        model=checkpoint.config.name,
        backend=name,
        precision=precision,
        steps=steps,
        oracle="pytorch f32",
        oracle_float32=exact.certificate(),
        control=rule.control_says,
        not_exposed=sorted(reference.names - exposed),
        latency_ms=Latencies(_latency(repetition.milliseconds), _latency(reference.milliseconds)),
        warmup_seconds=round(warmup, 3),
        gpu_bytes=memory,
        observations=reference.describe(plan, quantization),
        weights=WeightsDocument(path, checkpoint.format, checkpoint.random is not None, fingerprint),
        policy=details,
        provenance=about,
    )


class _Reference:
    """The oracle's answers to all calls, kept on the host."""

    def __init__(
        self, checkpoint: Checkpoint, arguments: Mapping[str, Any], plan: VerifyPlan, progress: Progress
    ) -> None:
        self._policy: UnifiedPolicy | None = UnifiedPolicy(
            checkpoint, **(dict(arguments) | {"backend": "pytorch", "precision": "f32"})
        )
        policy, self.device = self._policy, arguments["device"]
        self.steps = int(policy.metadata.get("max_decoding_steps") or policy.metadata["num_denoising_steps"])
        self._pipeline = policy.pipeline
        self.examples = list(read_examples(policy, plan))
        self.calls = make_calls(policy, self.examples, plan)
        self.milliseconds: list[float] = []
        self._exact: list[Tensors] = []
        self._robot: list[np.ndarray] = []
        progress.begin("float32 reference", len(self.calls))
        policy.warmup()
        for call in self.calls:
            tensors = _run(policy, call, self.steps)
            self.milliseconds.append(_sample(policy, call, self.steps)[1])
            for place in in_order(tensors):
                if not np.isfinite(tensors[place]).all():
                    raise CheckpointError(
                        f"the float32 reference itself gives values that aren't finite: {place}, on "
                        f"{call.example.source}; these weights or statistics are damaged"
                    )
            self._exact.append(tensors)
            self._robot.append(self._robot_units(tensors, call))
            progress.advance()

    @property
    def names(self) -> set[str]:
        return {place.name for place in self._exact[0]}

    def compare(self, policy: UnifiedPolicy, progress: Progress, into: Compared | None = None) -> Compared:
        """A policy on all calls against these answers, added to `into`."""
        compared = Compared() if into is None else into
        for call in self.calls:
            tensors = _run(policy, call, self.steps)
            robot = self._robot_units(tensors, call)
            compared.add(call, tensors, self._exact[call.number], robot, self._robot[call.number])
            progress.advance()
        return compared

    def control(self, rule: Rule, checkpoint: Checkpoint, arguments: Mapping[str, Any], progress: Progress) -> Compared:
        """What rounding alone does. Changes the reference's weights in their last bit: nothing exact comes after it."""
        assert self._policy is not None
        runs = len(control.CONTROL_SEEDS) if rule.control == "jitter" else 1
        progress.begin("control", runs * len(self.calls))
        if rule.control == "bf16":
            self.release()
            policy = UnifiedPolicy(checkpoint, **(dict(arguments) | {"backend": "pytorch", "precision": "bf16"}))
            compared = self.compare(policy, progress)
            del policy
            _free(self.device)
            return compared
        compared = Compared()
        model = reference_model(self._policy.backend)
        for seed in control.CONTROL_SEEDS:
            with control.jittered(model, seed):
                self.compare(self._policy, progress, compared)
        return compared

    def release(self) -> None:
        """Let go of the weights."""
        self._policy = None
        _free(self.device)

    def _robot_units(self, tensors: Tensors, call: NoisyExample) -> np.ndarray:
        chunk = tensors[ACTIONS]
        if not np.isfinite(chunk).all():  # the robot's edge needn't cope with these
            shape = self._robot[0].shape if self._robot else chunk.shape
            return np.full(shape, np.nan)
        return self._pipeline.after(chunk, call.example.state)["actions"]

    def describe(self, plan: VerifyPlan, quantization: Quantization | None) -> ObservationsDocument:
        """What it was run on, with a hash of all of the model's inputs."""
        digest, calibrated = hashlib.sha256(), 0
        for example in self.examples:
            inputs = example.bytes()
            digest.update(inputs)
            calibrated += hashlib.sha256(inputs).hexdigest() in plan.calibrated
        return ObservationsDocument(
            calibrated_on=None if quantization is None else calibrated,
            path=None if plan.observations is None else str(plan.observations),
            count=len(self.examples),
            names=[example.source for example in self.examples],
            sha256=digest.hexdigest(),
            noises=plan.noises,
            seed=plan.seed,
        )


def _run(policy: UnifiedPolicy, call: NoisyExample, steps: int) -> Tensors:
    """One call's intermediates on the host, with the actions that `sample` gives."""
    observation = call.observation
    trace = policy.backend.intermediates(observation, call.noise, steps, **policy.loop_arguments)
    missing = [name for name in _DEMANDED if name not in trace]
    missing += [] if trace.keys() & _OUTPUTS else sorted(_OUTPUTS, reverse=True)[:1]
    if missing:
        raise BackendError(f"backend {policy.backend.name!r} doesn't expose {', '.join(missing)}; it can't be verified")
    tensors = tensors_of(trace, call.example.inputs, with_prefix=call.first)
    tensors[ACTIONS] = _sample(policy, call, steps)[0][0]
    return tensors


def _sample(policy: UnifiedPolicy, call: NoisyExample, steps: int) -> tuple[np.ndarray, float]:
    """Actions float32[1, H, action_dim], a copy, and the milliseconds they took from host to host."""
    observation = call.observation
    start = time.perf_counter()
    actions = policy.backend.sample(observation, call.noise, steps, **policy.loop_arguments).actions
    milliseconds = (time.perf_counter() - start) * 1e3
    return actions.float().cpu().numpy().copy(), milliseconds


def _repeat(policy: UnifiedPolicy, calls: Sequence[NoisyExample], steps: int, progress: Progress) -> Repetition:
    result = Repetition()
    first: dict[int, np.ndarray] = {}
    for call in [*calls, *reversed(calls)]:
        chunk, milliseconds = _sample(policy, call, steps)
        result.milliseconds.append(milliseconds)
        progress.advance()
        if call.number not in first:
            first[call.number] = chunk
            continue
        before = first[call.number]
        result.calls += 1
        if chunk.tobytes() == before.tobytes():
            result.identical += 1
            continue
        result.differing = result.differing or call.example.source
        both = np.isfinite(chunk) & np.isfinite(before)
        result.max = max(result.max, float(np.abs(chunk[both] - before[both]).max(initial=0.0)))
    return result


def _latency(milliseconds: Sequence[float]) -> Latency:
    median, high = np.percentile(milliseconds, (50, 95))
    return Latency(len(milliseconds), float(median), float(high))


def _free(device: torch.device) -> None:
    gc.collect()
    if device.type == "cuda":
        empty_cache()
