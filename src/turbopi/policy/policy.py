"""The whole policy on one screen: preprocess → backend → postprocess."""

import copy
import dataclasses
import logging
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import torch

from turbopi import backends
from turbopi.backends import Precision
from turbopi.backends.device_lost import Guard
from turbopi.checkpoint import Checkpoint, open_checkpoint
from turbopi.checkpoint.base import Room
from turbopi.checkpoint.calibration import for_policy
from turbopi.checkpoint.quantized_folder import precision_kept
from turbopi.checkpoint.source import unreported_notes
from turbopi.config import PolicyConfig, Solver, TimeGrid, memory_of
from turbopi.models.observation import ModelInputs, Observation, with_cameras
from turbopi.models.pi0.conditioning import Conditioning
from turbopi.models.pi0.reference import FloatPrecision
from turbopi.policy.call_options import (
    Denoising,
    Numbers,
    checked_batch,
    checked_cameras,
    checked_horizon,
    checked_steps,
    checked_tokens,
    noise_for,
    several,
    warm_loops,
)
from turbopi.policy.chunk_conditioning import ChunkConditioning, flags, of_each
from turbopi.policy.history import History, ObservationHistory
from turbopi.policy.kept_precision import check_backend
from turbopi.policy.known_cameras import KnownCameras
from turbopi.policy.model_call import ModelCall
from turbopi.policy.readings import Checks, OutOfRange
from turbopi.policy.text import SubtaskHistory, checked_text
from turbopi.policy.watch import PolicyWatch
from turbopi.preprocess.answers import reader_of
from turbopi.preprocess.pipeline import Pipeline
from turbopi.preprocess.tokenizer import tokenizer_of
from turbopi.quantization.calibration_file import Quantization
from turbopi.realtime.running_chunk import JoinMode, RunningChunk
from turbopi.robots import Robot
from turbopi.support.errors import ActionError, ConfigError, ObservationError

logger = logging.getLogger(__name__)


class UnifiedPolicy:
    """A policy over any backend: observation in, action chunk out, as its owner's code computes it.

    Pi0.5, Pi0 and Pi0-FAST as openpi and LeRobot, SmolVLA as LeRobot.

        policy = UnifiedPolicy("checkpoints/pi05_libero", config="pi05_libero")
        actions = policy.infer(observation)["actions"]  # float64[H, d], in the robot's units

    Args:
        checkpoint_dir: an openpi (PyTorch or JAX) or LeRobot checkpoint folder, or an open `Checkpoint`.
        config: what no checkpoint records: a preset's name, a .json, a PolicyConfig, or "auto" for LeRobot's own config
            or the `turbopi.json` beside the weights.
        backend: a name from `turbopi doctor`; "auto" takes the fastest one available (see `metadata`), and
            qualifies a GPU that it doesn't know, once, in at most a minute (docs/gpus.md).
        precision: "bf16", "f32", "int8-weights" for Pi0-FAST, or with a calibration "fp8", "fp8-mlp", "fp8-f16sums",
            "int8" or "nvfp4" (docs/quantization.md). None: what the folder keeps its weights in, else bf16.
        quantization: the file that `turbopi calibrate` wrote. None: the one beside the weights.
        num_denoising_steps: evaluations of the action expert in a call. None: the config's.
        solver: "euler", "midpoint", "heun", "ab2" or "exponential" (docs/performance.md). None: the config's.
        time_grid: "uniform", "shifted_to_noise", "shifted_to_actions", or times that fall strictly from 1 (noise) to 0,
            which determine the number of steps. None: the config's.
        guidance_tag: for policies that were trained with and without it (RECAP): the text that training put behind the
            prompt, such as "Advantage: positive". It goes behind the prompt on a line of its own, and both through the
            prompt's own clean-up.
        guidance: scale of classifier-free guidance towards the tag. None: 1, the prompt with the tag alone. 0 is the
            prompt alone, and any other number up to 100 takes both prompts: docs/performance.md.
        device: "auto", "cpu", "cuda" or "cuda:N".
        tokenizer: a SentencePiece model's path, or an object with `encode(text, add_bos) -> list[int]`. None: found in
            the checkpoint folder or in openpi's cache; SmolVLA's in the folder or the Hub's cache (tokenizer.json).
        default_prompt: for observations without a prompt.
        robot: instead of the config's: a name, the path of a robot's .json, or your own `Robot` (docs/robots.md).
        progress: show a bar while the weights load.
        out_of_range: what becomes of actions far outside the training range: "warn", "clip" or "refuse", with an
            ActionError (docs/safety.md).
        known_cameras: the cameras.npz that `turbopi replay` wrote: exchanged, BGR or turned cameras are then noted
            from the first call on.
        strict: refuse calls that `warmup` didn't cover, with an ObservationError, instead of compiling while a robot
            moves.

    Raises ConfigError, CheckpointError, CalibrationError, TokenizerError or BackendUnavailable, each with what to do.
    Calls from several threads take turns.
    """

    def __init__(
        self,
        checkpoint_dir: str | Path | Checkpoint,
        *,
        config: str | Path | PolicyConfig = "auto",
        backend: str = "auto",
        precision: Precision | None = None,
        quantization: str | Path | Quantization | None = None,
        num_denoising_steps: int | None = None,
        solver: Solver | None = None,
        time_grid: TimeGrid | None = None,
        guidance: float | None = None,
        guidance_tag: str | None = None,
        device: str | torch.device = "auto",
        tokenizer: Any = None,
        default_prompt: str | None = None,
        robot: str | Robot | None = None,
        progress: bool = False,
        strict: bool = False,
        out_of_range: OutOfRange = "warn",
        known_cameras: str | Path | None = None,
    ) -> None:
        if num_denoising_steps is not None:
            checked_steps(num_denoising_steps, ConfigError)  # before anything is opened
        known = None if known_cameras is None else KnownCameras.load(known_cameras)
        checkpoint = (
            checkpoint_dir if isinstance(checkpoint_dir, Checkpoint) else open_checkpoint(checkpoint_dir, config)
        )
        kept = precision_kept(checkpoint)
        precision = precision or kept or "bf16"
        self._device = backends.resolve_device(device)
        name, why = backends.choose(self._device, precision) if backend == "auto" else (backend, "chosen")
        check_backend(name, self._device, precision, checkpoint)  # before a calibration and weights are read
        self.config, model = checkpoint.config, checkpoint.config.model
        flow = num_denoising_steps, solver, time_grid, guidance, guidance_tag
        self._denoising = Denoising.of(self.config, *flow)
        prompt_tokenizer = tokenizer_of(checkpoint, tokenizer)
        reader = reader_of(checkpoint, prompt_tokenizer)
        edges = checkpoint.config, checkpoint.norm_stats, prompt_tokenizer, default_prompt, robot, guidance_tag
        self._pipeline = Pipeline(*edges)
        self._checks = Checks(
            self._pipeline,
            checkpoint.norm_stats,
            out_of_range,
            judges_ranges=checkpoint.format != "random",
            known_cameras=known,
        )
        self._watch = PolicyWatch()
        of_weights = [] if checkpoint.format == "random" else unreported_notes(checkpoint.source)
        for note in (*of_weights, *self._pipeline.notes):
            logger.warning("%s", note)
        self._loading: dict[str, Any] = {}

        def load(to: torch.device | Room, in_precision: FloatPrecision) -> dict[str, torch.Tensor]:
            loaded = checkpoint.load(to, in_precision, progress=progress)
            self._loading = {"load_seconds": round(loaded.seconds, 3), "weight_bytes": loaded.bytes}
            return loaded.state

        calibration = for_policy(quantization, precision, checkpoint)
        self._calibration = None if calibration is None else f"{calibration.source} ({calibration.identity[:12]})"
        text, writes = self.config.text, self.config.writes_subtasks
        if backend == "auto":  # when all that was given is known to be good
            backends.qualified(self._device, precision, model, bar=progress, writes=writes, kept=kept is not None)
            name, why = backends.choose(self._device, precision, model, writes=writes)
        self._guard = Guard(self._device)
        with self._guard:
            self.backend = backends.create(
                name, model, load, device=self._device, precision=precision, quantization=calibration, writes=writes
            )
            if text is not None and text.trained and self.backend.writes:
                head = checkpoint.load_head(self._device, "bf16" if precision == "bf16" else "f32")
                self.backend.prepare_text(text, head)
        self.backend.strict, self.backend.reader = strict, reader
        self._strict = strict
        own = self._denoising.integration, self._denoising.two_prompts
        self._conditioning = ChunkConditioning(self.config, self._pipeline, self.backend, *own)
        self._call = ModelCall(self._pipeline, self._conditioning, self.backend, self._guard, self._checks)
        self._memory = memory_of(model)
        self._acts_on_subtasks = text is not None and text.subtasks is not None
        self._history = self._make_history()
        self._generator = np.random.default_rng()
        self._backend_reason = why
        self._checkpoint = checkpoint

    def infer(
        self,
        obs: Mapping[str, Any],
        *,
        noise: np.ndarray | None = None,
        seed: int | None = None,
        num_steps: int | None = None,
        solver: Solver | None = None,
        time_grid: TimeGrid | None = None,
        guidance: float | None = None,
        horizon: int | None = None,
        conditioning: Conditioning | None = None,
        previous: RunningChunk | None = None,
        model_actions: bool = False,
        history: History | None = None,
        subtask: str | None = None,
        readings: bool = False,
    ) -> dict[str, Any]:
        """One observation to one action chunk.

        Args:
            obs: the observation under the robot's own keys (docs/robots.md), on the host, without a batch axis.
            noise: float32[H, action_dim] or [1, H, action_dim], x at t = 1. With noise or a seed the result is
                deterministic.
            seed: of the noise, by `numpy.random.default_rng(seed)`. Without both: fresh noise every call.
            num_steps, solver, time_grid, guidance: for this call only.
            horizon: actions of the chunk, H, for this call only. None: the config's, which the weights are trained for.
                A shorter chunk isn't the beginning of a longer one. Engines for one horizon refuse others.
            previous: the previous chunk, which this one continues (docs/real_time.md); modes: `metadata["real_time"]`.
            conditioning: instead of `previous`, exact instructions to the denoising loop (models/pi0/conditioning.py).
                One with its own times or solver determines the number of steps.
            model_actions: also return what the next call's `previous` needs.
            history: where memory records `obs` (docs/lerobot.md), or a subtask is kept. None: the policy's own.
            subtask: what the actions are made of, if the policy acts on subtasks (docs/text.md). None: it writes one.
            readings: for a server: what notes are made of, under "reading", instead of them.

        Returns {"actions": float64[H, d], "policy_timing": {...}}, in milliseconds:

            preprocess_ms    reading, resizing, tokenising
            queue_ms         waiting for calls of other threads
            infer_ms         the model alone, from inputs on the host to actions on the host, as in openpi
            vision_ms, prefix_ms, denoise_ms
                             stages of infer_ms on the device, where the backend can separate them
            postprocess_ms   un-normalising and the robot's own outputs
            total_ms         preprocess_ms + queue_ms + infer_ms + postprocess_ms: the whole call

        If there is something to say, also "turbopi/notes" (docs/safety.md), a list of {"kind", "names", "text"}.

        A policy that acts on subtasks adds "subtask", the text that the actions are made of, and `text_ms`.

        With `model_actions` also "model_actions": float32[H, action_dim], normalised, and for relative actions
        "anchor": float64[d], the state that they are relative to.

        Raises ObservationError for wrong arguments, ActionError if an action is NaN, infinite or refused, DeviceLost
        once the GPU has failed for good (`lost`).
        """
        noises = None if noise is None else [noise]
        own = of_each("conditioning", [conditioning], 1, Conditioning)
        joined = of_each("previous", [previous], 1, RunningChunk)
        requested = self._denoising.of_call(num_steps, solver, time_grid, conditioning, guidance)
        histories = self._histories([self._history if history is None else history])
        row = (
            [obs],
            noises,
            seed,
            requested,
            horizon,
            own,
            joined,
            [model_actions],
            histories,
            self._subtasks([subtask]),
        )
        return self._infer(*row, hand_over=readings, one_robot=True)[0]

    def infer_batch(
        self,
        observations: Sequence[Mapping[str, Any]],
        *,
        noise: Sequence[np.ndarray] | np.ndarray | None = None,
        seed: int | Sequence[int] | None = None,
        num_steps: int | None = None,
        solver: Solver | None = None,
        time_grid: TimeGrid | None = None,
        guidance: float | None = None,
        horizon: int | None = None,
        conditioning: Sequence[Conditioning | None] | None = None,
        previous: Sequence[RunningChunk | None] | None = None,
        model_actions: bool | Sequence[bool] = False,
        histories: Sequence[History] | None = None,
        subtasks: Sequence[str | None] | None = None,
        readings: bool = False,
    ) -> list[dict[str, Any]]:
        """Several observations in one run of the model: `infer` for each, with the times of the whole batch.

        `noise` is [B, H, action_dim]; `seed` is the first row's, the next row has the next number, or one for each row.
        `conditioning` and `previous` have one entry for each row, None for an unconditioned one; `model_actions` is one
        flag or one for each row. All rows take the same number of denoising steps. Memory needs one of
        `histories` for each row, and so does acting on subtasks; `subtasks` may give some. Errors name the row.

        If `runs_batches`, the backend computes 1, 2, 4, 8 or 16 observations together and splits other numbers; else
        one by one, as with another solver than Euler's. Cameras and prompts may differ. Where `batch_modes` has them,
        rows with fixed actions, identity guidance or their own times run together with plain ones, rows guided by the
        true Jacobian with each other; elsewhere they run one by one.
        Actions differ from those of `infer` by rounding (docs/performance.md).
        """
        rows = len(observations)
        own = of_each("conditioning", conditioning, rows, Conditioning)
        bringing = next((one for one in own if one is not None and one.brings_steps), None)
        requested = self._denoising.of_call(num_steps, solver, time_grid, bringing, guidance)
        joined, reported = (
            of_each("previous", previous, rows, RunningChunk),
            flags("model_actions", model_actions, rows),
        )
        kept = self._histories(histories, rows), self._subtasks([None] * rows if subtasks is None else subtasks, rows)
        several = observations, noise, seed, requested, horizon, own, joined, reported, *kept
        return self._infer(*several, hand_over=readings, one_robot=False)

    def _infer(
        self,
        observations: Sequence[Mapping[str, Any]],
        noise: Sequence[np.ndarray] | np.ndarray | None,
        seed: int | Sequence[int] | None,
        denoising: Denoising,
        horizon: int | None,
        conditionings: Sequence[Conditioning | None],
        previous: Sequence[RunningChunk | None],
        model_actions: Sequence[bool],
        histories: Sequence[History],
        subtasks: Sequence[str | None],
        *,
        hand_over: bool,
        one_robot: bool,
    ) -> list[dict[str, Any]]:
        """`infer_batch`; the last five before the flags have one for each observation. Flags: `PolicyWatch.report`."""
        start = time.perf_counter()
        self._guard.refuse_if_lost()
        if not observations:
            raise ObservationError("infer_batch was given no observation")
        rows, steps, actions = len(observations), denoising.steps, self._horizon(horizon)
        how = denoising.integration, denoising.guidance
        joins = self._conditioning.checked(conditionings, previous, steps, actions, *how)
        ran = self._call.run(observations, joins, lambda: self._noise(rows, actions, noise, seed), histories, subtasks)
        chunks, readings = self._checks.judge(ran.sample.actions.numpy(), ran.readings)
        results = self._pipeline.after_all(chunks, ran.states)
        self._watch.report(results, readings, hand_over=hand_over, one_robot=one_robot)
        for row, result in enumerate(results):
            if model_actions[row]:
                result["model_actions"] = chunks[row].copy()
                if (anchor := self._pipeline.anchor(ran.states[row])) is not None:
                    result["anchor"] = anchor
        for result, text in zip(results, ran.subtasks, strict=False):
            result["subtask"] = text
        timing = ran.sample.timing(start, ran.requested, ran.infer_start, ran.infer_end, time.perf_counter())
        return [result | {"policy_timing": dict(timing)} for result in results]

    def generate(self, obs: Mapping[str, Any], *, prompt: str | None = None, max_tokens: int | None = None) -> str:
        """The text that the policy's language head writes to an observation, greedily; "" if that is nothing.

            policy.generate(observation)  # "pick up the cup"

        prompt      in place of the observation's: what fills the {prompt} of the policy's template
        max_tokens  where an answer is cut that isn't over: 1 to the policy's own limit, which is the default

        Actions have none of it, and nothing is kept. Raises ObservationError for wrong arguments, and for a policy
        that writes no text: where that is known from, docs/text.md says.
        """
        self._guard.refuse_if_lost()
        if max_tokens is not None and self.config.text is not None:
            checked_tokens(max_tokens, self.config.text.max_tokens)
        return self._call.write(obs, checked_text("prompt", prompt), max_tokens)

    def submit(
        self,
        obs: Mapping[str, Any],
        *,
        noise: np.ndarray | None = None,
        seed: int | None = None,
        num_steps: int | None = None,
        horizon: int | None = None,
        serially: bool = False,
        readings: bool = False,
    ) -> "Future[dict[str, Any]]":
        """`infer` that returns at once, with a Future of what `infer` returns; several may be in flight.

        For pipelined backends, which encode one observation while another is denoised. Other backends raise
        ConfigError, or with `serially` run the call before they return.
        """
        if serially and not self.pipelined:
            done: Future[dict[str, Any]] = Future()
            arguments: dict[str, Any] = {"noise": noise, "seed": seed, "num_steps": num_steps, "horizon": horizon}
            done.set_result(self.infer(obs, **arguments, readings=readings))
            return done
        start = time.perf_counter()
        self._guard.refuse_if_lost()
        if self._acts_on_subtasks:
            raise ObservationError(f"{self.config.name} acts on subtasks, which `submit` doesn't take: call `infer`")
        actions, steps = self._horizon(horizon), self._denoising.of_call(num_steps).steps
        seen = self._pipeline.see(obs, guidance=self._denoising.guidance or 0.0)
        inputs, reading = self._pipeline.complete(seen), self._checks.reading(seen)
        x_1 = torch.from_numpy(self._noise(1, actions, None if noise is None else [noise], seed))
        requested = time.perf_counter()
        with self._guard:
            running = self.backend.submit(Observation.stack([inputs]), x_1, steps)
        answer: Future[dict[str, Any]] = Future()

        def finish(ran: "Future[backends.Sample]") -> None:
            try:
                try:
                    sample = ran.result()
                except Exception as error:
                    self._guard.examine(error)
                    raise
                infer_end = time.perf_counter()
                chunks, judged = self._checks.judge(sample.actions.numpy(), [reading])
                (result,) = results = self._pipeline.after_all(chunks, [seen.state])
                self._watch.report(results, judged, hand_over=readings, one_robot=True)
                infer_start = requested + sample.queue_ms / 1e3
                timing = sample.timing(start, requested, infer_start, infer_end, time.perf_counter())
                answer.set_result(result | {"policy_timing": timing})
            except BaseException as error:
                answer.set_exception(error)

        running.add_done_callback(finish)
        return answer

    def writing(self, tokens: int) -> "UnifiedPolicy":
        """The same policy with another limit on an answer's tokens, at most the config's."""
        other = copy.copy(self)
        other._denoising = dataclasses.replace(self._denoising, steps=tokens)
        return other

    def reset(self) -> None:
        """A new episode, as openpi's `BasePolicy.reset`: notes compare it with nothing before, memory is empty, and the
        next chunk has a new subtask.
        """
        self._watch.reset()
        if self._history is not None:
            self._history.reset()

    def observe(self, obs: Mapping[str, Any], *, history: History | None = None) -> None:
        """Record an observation, as `infer` does, without computing. Raises ObservationError without memory."""
        if self._memory is None:
            raise ObservationError(f"{self.config.name} has no memory: it sees the observation of `infer` alone")
        (into,) = self._histories([self._history if history is None else history])
        frames = self._call.see(obs)
        if len(frames) > 1:
            raise ObservationError("this observation brings its past frames, so it is recorded nowhere: give one frame")
        with self._call.lock:
            self._call.recorded(frames, into)

    def new_history(self) -> History:
        """Of another robot. Raises ObservationError for a policy without memory that acts on no subtasks."""
        if (made := self._make_history()) is None:
            raise ObservationError(f"{self.config.name} has no memory, so it takes no history")
        return made

    def _make_history(self) -> History | None:
        if self._memory is not None:
            return ObservationHistory(self._memory)
        return SubtaskHistory() if self._acts_on_subtasks else None

    def _histories(self, given: Sequence[History | None] | None, rows: int = 1) -> Sequence[History]:
        """One for each row of a policy that keeps something of an episode, none for others. Raises ObservationError."""
        each = [] if given is None else [one for one in given if one is not None]
        if self._history is None:
            if each:
                raise ObservationError(f"history was given, but {self.config.name} has no memory: leave it out")
            return []
        if not all(isinstance(one, type(self._history)) for one in each) or len({id(one) for one in each}) != rows:
            raise ObservationError(
                f"a policy with memory needs a history for each of {rows} robots, a different one: give `histories`, "
                "made by `new_history`"
            )
        return each

    def _subtasks(self, given: Sequence[str | None], rows: int = 1) -> Sequence[str | None]:
        """One, or None, for each row of a policy that acts on subtasks, nothing for others. Raises ObservationError."""
        if not self._acts_on_subtasks:
            if any(one is not None for one in given):
                raise ObservationError(f"subtask was given, but {self.config.name} acts on none: leave it out")
            return ()
        if isinstance(given, str) or len(given) != rows:
            raise ObservationError(f"subtasks has {len(given)} entries for {rows} observations: give one for each")
        return [checked_text("subtask", one) for one in given]

    def warmup(
        self,
        *,
        cameras: Numbers = None,
        horizons: Numbers = None,
        steps: Numbers = None,
        batches: Numbers = None,
        real_time: JoinMode | Sequence[JoinMode] = (),
        conditioning: Sequence[Conditioning] = (),
    ) -> float:
        """Make the first real call as fast as later ones: compile, allocate, capture. Returns the seconds it took.

        Covers every prompt length, for all combinations of these, each a number or several:

            cameras     numbers of cameras. None: all that the robot may send (`Robot.camera_counts`), but only engines
                        that are built already
            horizons    action horizons. None: the config's
            steps       numbers of denoising steps. None: the policy's
            batches     sizes of batches for `infer_batch`. None: single observations only
            real_time   modes of `RunningChunk`, besides calls without one
            conditioning
                        examples of other conditionings, each for its own steps and horizon; only form and times count

        What earlier calls covered stays covered, up to the graph cache's size. Raises ConfigError for impossible
        values, and for more loops than the cache keeps.
        """
        start = time.perf_counter()
        self._guard.refuse_if_lost()
        example = self.example_observation()
        inputs = self.prepare(example)
        own = int(inputs.image_mask.sum())
        sent = [own]  # the example's first
        if self.config.missing_cameras == "masked":
            sent += getattr(self._pipeline.robot, "camera_counts", None) or ()
        counts = several("cameras", cameras, sent, lambda n, error: n if n == own else checked_cameras(n, error))
        sizes = several("batches", 1 if batches is None else batches, [], checked_batch)
        loops = warm_loops(
            several("steps", steps, [self._denoising.steps], checked_steps),
            several("horizons", horizons, [self.config.model.action_horizon], self._checked_horizon),
        )
        of_steps = {n: self._denoising.changed(n, None, None, ConfigError).integration for n, _ in loops}
        requested = self._conditioning.to_warm(loops, real_time, conditioning, self._denoising.steps, of_steps.get)
        plan = [(count, *one) for count in counts for one in requested]
        with self._call.lock, self._guard:
            for i, (count, num_steps, horizon, one) in enumerate(plan):
                seen = inputs if count == own else with_cameras(inputs, count)
                self.backend.warmup(
                    Observation.stack([seen]),
                    num_steps,
                    horizon,
                    required=cameras is not None or count == own,
                    last=i + 1 == len(plan),
                    conditioning=one,
                )
                if sizes:
                    self.backend.warmup_batches(Observation.stack([seen]), num_steps, horizon, sizes, one)
        if own in counts:
            self._whole_call(example, *loops[0])
        return time.perf_counter() - start

    def _whole_call(self, example: Mapping[str, Any], num_steps: int, horizon: int) -> None:
        try:
            subtask = "warm up" if self._acts_on_subtasks else None
            if self.backend.writer is not None:
                self.generate(example, max_tokens=2)
            self.infer(
                example,
                seed=0,
                num_steps=num_steps,
                horizon=horizon,
                history=self._make_history(),
                subtask=subtask,
            )
        except ActionError as error:  # of a random observation: whether the weights are at fault, real ones show
            logger.warning("warm-up: %s", error)

    def prepare(self, obs: Mapping[str, Any]) -> ModelInputs:
        """The model's inputs for an episode's first observation. Raises ObservationError if it can't be used."""
        frames = self._call.see(obs, self._denoising.guidance or 0.0)
        return self._call.recorded(frames, None if self._memory is None else self.new_history())

    def example_observation(self, seed: int = 0) -> dict[str, Any]:
        """A random observation in this robot's keys, shapes and dtypes."""
        return self._pipeline.example(seed)

    @property
    def lost(self) -> str | None:
        """Why the GPU failed for good; None while it works. Every later call raises DeviceLost with this reason."""
        return self._guard.lost

    @property
    def runs_batches(self) -> bool:
        """Whether `infer_batch` runs observations together, and `warmup` prepares `batches` of them."""
        return self.backend.runs_batches and self._denoising.runs_together

    @property
    def batch_modes(self) -> tuple[JoinMode, ...]:
        """Modes of `RunningChunk`s with which `infer_batch` runs observations together."""
        return self._conditioning.batch_modes if self.runs_batches else ()

    @property
    def loop_arguments(self) -> dict[str, Any]:
        """This policy's solver and time grid, as arguments of the backend's own methods; empty for openpi's."""
        requested = self._denoising.integration
        return {} if requested is None else {"conditioning": Conditioning(integration=requested)}

    gives_readings = True  # to the server: `infer`, `infer_batch` and `submit` take `readings`

    @property
    def reads_in_place(self) -> bool:
        """To the server: whether images are copied by the end of a call, and none is kept, as of an episode."""
        return self._history is None

    @property
    def pipelined(self) -> bool:
        """Whether `submit` overlaps observations; the server uses it then."""
        return self.backend.submits

    @property
    def pipeline(self) -> Pipeline:
        """What happens before and after the model."""
        return self._pipeline

    @property
    def metadata(self) -> dict[str, Any]:
        """Description of this policy, plain values only; the server sends it to every client."""
        model = self.config.model
        return {
            "config": self.config.name,
            "model": model.kind,
            "action_horizon": model.action_horizon,
            **self._denoising.metadata,
            "backend": self.backend.name,
            "backend_reason": self._backend_reason,
            "backend_details": self.backend.describe(),
            "precision": self.backend.precision,
            "strict": self._strict,
            "device": str(self._device),
            "device_name": torch.cuda.get_device_name(self._device) if self._device.type == "cuda" else "CPU",
            "checkpoint_format": self._checkpoint.format,
            "random_weights": self._checkpoint.random is not None,
            "checkpoint_path": None if self._checkpoint.path is None else str(self._checkpoint.path),
            "weights": self._checkpoint.short_hash,
            "calibration": self._calibration,
            "out_of_range": self._checks.out_of_range,
            "tokenizer": self._pipeline.tokenizer.source,
            "torch": torch.__version__,
            "real_time": {"modes": list(self._conditioning.modes), **dataclasses.asdict(self.config.real_time)},
            **(
                {"memory": self._history.describe(self._pipeline)}
                if isinstance(self._history, ObservationHistory)
                else {}
            ),
            **self._about_text,
            **self._loading,
            **self._pipeline.metadata,
            "features": self._checks.features,
        }

    @property
    def _about_text(self) -> dict[str, Any]:
        """Only of a policy that writes text, or acts on subtasks."""
        text = self.config.text
        if text is None:
            return {}
        about: dict[str, Any] = {}
        if self.backend.writer is not None:
            about["text"] = {"template": text.template, "max_tokens": text.max_tokens}
        if text.subtasks is not None:
            about["subtasks"] = dataclasses.asdict(text.subtasks) | {"written": self.backend.writer is not None}
        return about

    def _horizon(self, horizon: int | None) -> int:
        """A call's. Raises ObservationError."""
        own = self.config.model.action_horizon
        return own if horizon is None else self._checked_horizon(horizon, ObservationError)

    def _checked_horizon(self, horizon: int, error: type[ConfigError] | type[ObservationError]) -> int:
        if (why := self.backend.refuses_horizon(checked_horizon(horizon, error))) is not None:
            raise error(why)
        return int(horizon)

    def _noise(self, batch: int, horizon: int, noise: Any, seed: int | Sequence[int] | None) -> np.ndarray:
        """float32[B, H, action_dim], given or drawn; zeros where nothing is made of noise."""
        if (why := self._denoising.refused) is not None:
            if noise is not None:
                raise ObservationError(why)
            return np.zeros((batch, horizon, self.config.model.action_dim), np.float32)
        return noise_for((batch, horizon, self.config.model.action_dim), noise, seed, self._generator)
