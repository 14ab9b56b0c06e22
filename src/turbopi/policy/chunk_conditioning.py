"""What a policy's calls may join, checked and turned into what the denoising loop is asked for (docs/real_time.md)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from turbopi.backends import Backend
from turbopi.config import Network, PolicyConfig
from turbopi.engine.loops import batch_form
from turbopi.models.pi0.conditioning import (
    Conditioning,
    Conditionings,
    Form,
    Guidance,
    PromptGuidance,
    TokenTimes,
    guidance_strength,
    row_named,
)
from turbopi.models.pi0.noise_choice import NoiseChoice
from turbopi.models.pi0.solvers import Integration
from turbopi.preprocess.pipeline import Pipeline
from turbopi.realtime.running_chunk import FORMS, WARM_START, JoinMode, RunningChunk
from turbopi.support.errors import ConfigError, ObservationError

Loop = tuple[int, int]  # denoising steps, action horizon
Row = tuple[Conditioning | None, RunningChunk | None]  # of one observation, checked: at most one of the two
T = TypeVar("T")


@dataclass(frozen=True)
class Joins:
    """What the observations of a call are to join, checked, and how the call denoises."""

    rows: Sequence[Row]
    steps: int
    horizon: int
    integration: Integration | None = None
    guidance: float = 0.0  # as `Incoming`'s

    @property
    def two_prompts(self) -> bool:
        return self.guidance not in (0, 1)

    @property
    def forms(self) -> list[Form]:
        """What each observation's denoising loop must be able to do, as far as a batch is concerned."""
        return ["two_prompts"] * len(self.rows) if self.two_prompts else [self._form(*row) for row in self.rows]

    def _form(self, conditioning: Conditioning | None, chunk: RunningChunk | None) -> Form:
        if chunk is None:
            return batch_form(conditioning)
        if chunk.mode in ("rtc_trained", "paint") and chunk.delay == 0:  # nothing is held or chosen
            return batch_form(integrated(None, self.integration))
        if chunk.mode == "warm_start":
            return batch_form(Conditioning(integration=warmed(self.integration, self.steps)))
        return FORMS[chunk.mode]


class ChunkConditioning:
    """Of one policy; `backend` is its own or its class, `integration` how it denoises unless a call says otherwise.

    Raises ConfigError for an integration that the backend doesn't have.
    """

    def __init__(
        self,
        config: PolicyConfig,
        pipeline: Pipeline,
        backend: Backend | type[Backend],
        integration: Integration | None = None,
        two_prompts: bool = False,
    ) -> None:
        self._config, self._model, self._pipeline, self._backend = config, config.model, pipeline, backend
        self._integration, self._two_prompts = integration, two_prompts
        needed: dict[Form, bool] = {"solver": integration is not None, "two_prompts": two_prompts}
        for form, wanted in needed.items():
            if wanted and (why := backend.refuses_form(form)) is not None:
                raise ConfigError(why)

    @property
    def modes(self) -> tuple[JoinMode, ...]:
        """What `RunningChunk`s may ask of this policy."""
        able, trained = set(self._backend.forms), self._config.real_time.trained_max_delay > 0
        if self._two_prompts and "two_prompts_jacobian" not in able:
            able.discard("jacobian")
        if self._two_prompts:
            able.discard("noise")
        if self._integration is not None and not self._integration.is_euler:
            able &= {"solver"}  # see `Conditioning`
        lacking = {"rtc_trained": not trained, "warm_start": self._config.one_step}
        return tuple(mode for mode, form in FORMS.items() if form in able and not lacking.get(mode, False))

    @property
    def batch_modes(self) -> tuple[JoinMode, ...]:
        """Those of which several observations run together, on a backend that runs batches."""
        return tuple(mode for mode in self.modes if FORMS[mode] in self._backend.batch_forms)

    def checked(
        self,
        conditionings: Sequence[Conditioning | None],
        previous: Sequence[RunningChunk | None],
        steps: int,
        horizon: int,
        integration: Integration | None = None,
        guidance: float | None = None,
    ) -> Joins:
        """What each observation of a call is to join, and how it is integrated.

        Raises ObservationError; of several observations it names the row.
        """
        joins = Joins([], steps, horizon, integration, guidance or 0.0)
        if joins.two_prompts:
            self._check_form("two_prompts")
        rows = [self._checked(None, None, steps, horizon, integration)] * len(conditionings)
        for i, (conditioning, chunk) in enumerate(zip(conditionings, previous, strict=True)):
            if conditioning is not None or chunk is not None:
                with row_named(i, len(conditionings)):
                    rows[i] = self._checked(conditioning, chunk, steps, horizon, integration)
                    if joins.two_prompts and conditioning is not None and conditioning.prompt is not None:
                        raise ObservationError("guidance was given twice, by the conditioning and by a scale: give one")
                    form = joins._form(*rows[i]) if joins.two_prompts else "plain"
                    self._check_form("two_prompts_jacobian" if form == "jacobian" else "plain")
                    if form == "noise":
                        raise ObservationError(
                            "mode paint chooses noise for one prompt, but guidance takes two: take another mode, or "
                            "guidance 0 or 1"
                        )
        return replace(joins, rows=rows)

    def _checked(
        self,
        conditioning: Conditioning | None,
        previous: RunningChunk | None,
        steps: int,
        horizon: int,
        integration: Integration | None = None,
    ) -> Row:
        if conditioning is not None and previous is not None:
            raise ObservationError("conditioning and previous were both given; give one of them")
        if previous is None:
            conditioning = integrated(conditioning, integration)
        elif integration is not None and not integration.is_euler and previous.mode != "warm_start":
            raise ObservationError(
                f"a running chunk and solver {integration.solver!r} were both given: chunks join by Euler's steps, so "
                "take solver 'euler', whose time grid may be any, mode warm_start, or leave out previous"
            )
        if conditioning is not None:
            conditioning.check(steps, horizon, self._model.action_dim)
            self._check_form(conditioning.form)
        if previous is not None:
            relative, options = self._pipeline.robot.delta_mask is not None, self._config.real_time
            if previous.mode == "rtc_identity" and options.execution_horizon is not None:
                end = self._model.action_horizon - options.execution_horizon  # LeRobot's, whatever the call's horizon
                options = replace(options, execution_horizon=horizon - end if end < horizon else None)
            previous = previous.completed(horizon, self._model.action_dim, relative=relative, options=options)
            self._check_form(FORMS[previous.mode])
            if previous.mode == "warm_start" and self._config.one_step:
                raise ObservationError(
                    "these weights were distilled for one step from noise alone, so they have no warm start: take "
                    "another mode, or leave out previous"
                )
        return conditioning, previous

    def conditioning(
        self, joins: Joins, states: Sequence[np.ndarray], tagged: Sequence[np.ndarray | None]
    ) -> Conditionings:
        """What the backend is given beside the noise, once the new states are known. Raises ObservationError.

        tagged  of each the second prompt, as `Incoming`'s

        None for an ordinary call, else one for all observations, or a list with one for each.
        """
        rows: list[Conditioning | None] = []
        for i, ((one, chunk), state, tokens) in enumerate(zip(joins.rows, states, tagged, strict=True)):
            if chunk is not None:
                with row_named(i, len(states)):
                    one = self._of_chunk(chunk, state, joins)
            if tokens is not None:
                one = replace(one or Conditioning(), prompt=PromptGuidance(tokens, joins.guidance))
            rows.append(None if one is None or one.form == "plain" else one)
        return rows[0] if all(one is rows[0] for one in rows) else rows

    def started(self, joins: Joins, states: Sequence[np.ndarray], noise: np.ndarray) -> np.ndarray:
        """float32[B, H, action_dim]: what the backend is given as noise. Rows with a warm start begin elsewhere."""
        for row, ((_, chunk), state) in enumerate(zip(joins.rows, states, strict=True)):
            if chunk is not None and chunk.mode == "warm_start":
                left_over = self._pipeline.reanchored(chunk.left_over, chunk.anchor, state)
                noise = noise.copy()
                noise[row] = chunk.begun(left_over, noise[row])
        return noise

    def _of_chunk(self, chunk: RunningChunk, state: np.ndarray, joins: Joins) -> Conditioning:
        steps, horizon, integration = joins.steps, joins.horizon, joins.integration
        if chunk.mode == "warm_start":
            return Conditioning(integration=warmed(integration, steps))
        left_over = self._pipeline.reanchored(chunk.left_over, chunk.anchor, state)
        conditioning = chunk.conditioning(left_over, steps, horizon, self._model.time_grid)
        if integration is not None:
            conditioning = replace(conditioning, integration=integration)
            if (pull := conditioning.guidance) is not None and chunk.max_guidance_weight is not None:
                times = TokenTimes.integrated(integration, horizon).times
                strength = guidance_strength(times, chunk.max_guidance_weight)
                conditioning = replace(conditioning, guidance=replace(pull, strength=strength))
        return conditioning

    def to_warm(
        self,
        loops: Sequence[Loop],
        modes: JoinMode | Sequence[JoinMode],
        others: Sequence[Conditioning],
        num_steps: int,
        integrations: Callable[[int], Integration | None],
    ) -> list[tuple[int, int, Conditioning | None]]:
        """Steps, horizon and an example of every loop that a warm-up is to cover, or None. Raises ConfigError.

        num_steps     of those of `others` that don't say
        integrations  of so many steps
        """
        requested: list[tuple[int, int, Conditioning | None]] = [
            (*loop, integrated(None, integrations(loop[0]))) for loop in loops
        ]
        for mode in [modes] if isinstance(modes, str) else modes:
            if mode not in self.modes:
                raise ConfigError(
                    f"warm-up was asked for real-time mode {mode!r}; this policy has {', '.join(self.modes) or 'none'}"
                )
            for loop in loops:
                own = integrations(loop[0])
                if mode == "warm_start":
                    requested.append((*loop, Conditioning(integration=warmed(own, loop[0]))))
                else:
                    requested.append((*loop, integrated(_example(FORMS[mode], *loop, self._model), own)))
        for one in others:
            steps, horizon = one.size(num_steps, self._model.action_horizon)
            try:
                if one.tokens is None and one.integration is None:
                    one = integrated(one, integrations(steps)) or one
                one.check(steps, horizon, self._model.action_dim)
                self._check_form(one.form)
            except ObservationError as error:
                raise ConfigError(f"warm-up: {error}") from None
            requested.append((steps, horizon, one))
        if not self._two_prompts:
            return requested
        example = PromptGuidance(np.zeros(1, np.int64), 2.0)
        return [(*loop, replace(one or Conditioning(), prompt=example)) for *loop, one in requested]  # type: ignore[misc]

    def _check_form(self, form: Form) -> None:
        if (why := self._backend.refuses_form(form)) is not None:
            raise ObservationError(why)


def warmed(integration: Integration | None, steps: int) -> Integration:
    """As an integration, or so many equal Euler steps, from where a warm start begins."""
    if integration is None:
        return Integration("euler", tuple(WARM_START * (1 - i / steps) for i in range(steps + 1)))
    times = tuple(WARM_START * t for t in integration.times)
    return Integration(integration.solver, times, integration.evaluations)


def integrated(conditioning: Conditioning | None, integration: Integration | None) -> Conditioning | None:
    """A conditioning, or none, with how it is integrated. Raises ObservationError for two that say so."""
    if integration is None:
        return conditioning
    if conditioning is None:
        return Conditioning(integration=integration)
    if conditioning.tokens is not None or conditioning.integration is not None:
        raise ObservationError(
            f"the conditioning has times of its own, and this call's solver and time grid say {integration}: leave out "
            "one of them, or give solver 'euler' and time grid 'uniform' for this call"
        )
    return replace(conditioning, integration=integration)


def of_each(what: str, given: Sequence[T | None] | None, rows: int, kind: type[T]) -> list[T | None]:
    """An argument of a batch: one for each observation, or None. Raises ObservationError for anything else."""
    if given is None:
        return [None] * rows
    if not isinstance(given, Sequence) or isinstance(given, str | Mapping):
        raise ObservationError(
            f"{what} is of type {type(given).__name__}; for a batch it should be a list of a {kind.__name__}, or None, "
            "for each observation"
        )
    if len(given) != rows:
        raise ObservationError(
            f"{what} has {len(given)} entries for {rows} observations; it should have one for each: a "
            f"{kind.__name__}, or None"
        )
    for row, one in enumerate(given):
        if one is not None and not isinstance(one, kind):
            with row_named(row, rows):
                raise ObservationError(
                    f"its {what} is of type {type(one).__name__}; it should be a {kind.__name__}, or None"
                )
    return list(given)


def flags(what: str, given: bool | Sequence[bool], rows: int) -> list[bool]:
    """An argument of a batch: for all of its observations, or for each. Raises ObservationError."""
    each: Any = [given] * rows if isinstance(given, bool) else given
    if not isinstance(each, Sequence) or len(each) != rows or not all(isinstance(one, bool) for one in each):
        raise ObservationError(f"{what} is {given!r:.100}; it should be true or false, or a list of {rows} of these")
    return list(each)


def _example(form: Form, num_steps: int, horizon: int, model: Network) -> Conditioning:
    """A conditioning of a form, for a warm-up."""
    nothing = np.zeros((horizon, model.action_dim), np.float32)
    if form == "tokens":
        return Conditioning(held=np.arange(horizon) < 1, values=nothing)
    if form == "noise":
        return Conditioning(noise=NoiseChoice(np.arange(horizon) < 1, nothing))
    weights, strength = np.zeros(horizon, np.float32), np.zeros((num_steps, horizon), np.float32)
    return Conditioning(guidance=Guidance(nothing, weights, strength))
