"""The rules a backend is held to, and the verdict on what was measured. docs/dev/verify.md has the reasons."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from msgspec.structs import asdict

from turbopi.engine.emulate import NO_SIGNAL, has_signal
from turbopi.policy.examples import NoisyExample
from turbopi.quantization.plan import ROUNDED
from turbopi.support.action_groups import action_groups
from turbopi.support.errors import BackendError, ConfigError
from turbopi.support.text import significant
from turbopi.verify.bounds import (
    BF16_FACTOR,
    BOUND_FACTORS,
    F32_BOUND,
    FLOAT32_ROUNDING,
    FP8_BOUND,
    FP8_COSINE,
    JUMP,
    STEPS,
    SUSPECT_FACTOR,
    TRAINED_FACTORS,
)
from turbopi.verify.document import (
    ActionsControl,
    ActionsDocument,
    Bounds,
    Check,
    Deltas,
    Determinism,
    Dimension,
    IntermediateDocument,
    Judged,
    SuspectDocument,
    WorstCall,
    finite,
)
from turbopi.verify.intermediates import Errors, ErrorsBy, Place, Suspect, Tensors, first_suspect, in_order

ACTIONS, LOGITS = Place("actions"), "logits"
Control = Literal["bf16", "jitter"]


@dataclass(frozen=True)
class Rule:
    """What actions are held to: `bound` on their relative rms, or else `factor` times the control's."""

    control: Control
    bound: float | None
    factor: float | None
    reason: str
    overridden: bool = False
    cosine: float | None = None  # the least cosine of what denoising did (actions less noise); None: no bound on it

    @classmethod
    def of(
        cls,
        backend: str,
        precision: str,
        bound: float | None = None,
        factor: float | None = None,
        *,
        trained: bool = False,
    ) -> "Rule":
        """The stated rule, or the user's own. Raises ConfigError for bounds that make no sense."""
        if bound is not None and factor is not None:
            raise ConfigError("--bound and --factor were both given; give one of them")
        for name, value in (("--bound", bound), ("--factor", factor)):
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ConfigError(f"{name} is {value}; expected a number above 0")
        control: Control = "jitter" if (backend, precision) == ("pytorch", "bf16") else "bf16"
        if bound is not None or factor is not None:
            return cls(control, bound, factor, "given by the user", overridden=True)
        if precision == "f32":
            return cls(control, F32_BOUND, None, "two float32 implementations differ by less, TF32 by more")
        if precision in ROUNDED:
            reason = "a cosine of 0.9975 to float32, what calibration aims at"
            return cls(control, FP8_BOUND, None, reason, cosine=FP8_COSINE)
        if control == "jitter":
            factors, seen = (TRAINED_FACTORS, "5.5") if trained else (BOUND_FACTORS, "3.2")
            reason = f"rounding activations besides weights was seen to cost up to {seen} times rounding weights alone"
            return cls(control, None, factors["bf16"], reason)
        return cls(control, None, BF16_FACTOR, "no worse than PyTorch's own bfloat16, with room for chance")

    def limit(self, control: float) -> float:
        """The bound on the actions' relative rms, given the control's."""
        return self.bound if self.bound is not None else (self.factor or 0.0) * control

    def allowed(self, precision: str, control: float) -> float:
        """What an intermediate may be off before it is suspect."""
        if precision == "f32":
            return F32_BOUND if self.bound is None else self.bound
        if precision in ROUNDED:
            return max(STEPS[precision] * control, FLOAT32_ROUNDING)
        return max(self.suspect_factor * control, FLOAT32_ROUNDING)

    @property
    def suspect_factor(self) -> float:
        return BOUND_FACTORS["bf16"] if self.control == "jitter" else SUSPECT_FACTOR

    @property
    def control_says(self) -> str:
        if self.control == "bf16":
            return "pytorch bf16"
        return "pytorch f32 with every weight that bf16 rounds moved by up to half a bf16 step"


@dataclass
class Compared:
    """Errors of one policy against the oracle."""

    by_place: ErrorsBy = field(default_factory=dict)
    by_dimension: list[Errors] = field(default_factory=list)  # robot units
    by_call: list[tuple[NoisyExample, Errors]] = field(default_factory=list)  # actions
    deltas: Errors = field(default_factory=Errors)  # what denoising did: actions less noise
    exact: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)  # the reference's actions, the noise
    logits: Errors = field(default_factory=Errors)  # of all steps, of models that write their actions as tokens
    spread: float = 0.0  # of the reference's logits, over their rms

    def add(
        self, call: NoisyExample, tensors: Tensors, exact: Tensors, robot: np.ndarray, exact_robot: np.ndarray
    ) -> None:
        """One call's tensors, and its actions [H, d] in the robot's units."""
        for place in tensors.keys() & exact.keys():
            ours, theirs = tensors[place], exact[place]
            if ours.shape != theirs.shape:
                raise BackendError(
                    f"{place} has shape {list(ours.shape)}, the reference's {list(theirs.shape)}: can't be compared"
                )
            self.by_place.setdefault(place, Errors()).add(ours, theirs)
            if place.name == LOGITS:
                self.logits.add(ours, theirs)
                self.spread = max(self.spread, float(theirs.std() / (np.sqrt(np.square(theirs).mean()) or 1.0)))
        of_call = Errors()
        of_call.add(tensors[ACTIONS], exact[ACTIONS])
        self.by_call.append((call, of_call))
        noise = call.noise[0].numpy()
        self.deltas.add(tensors[ACTIONS] - noise, exact[ACTIONS] - noise)
        self.exact.append((exact[ACTIONS], noise))
        self.by_dimension = self.by_dimension or [Errors() for _ in range(robot.shape[1])]
        for index, errors in enumerate(self.by_dimension):
            errors.add(robot[:, index], exact_robot[:, index])

    @property
    def actions(self) -> Errors:
        return self.by_place[ACTIONS]

    @property
    def decides(self) -> str:
        """What is held to the bound. A token is chosen or isn't: its logits say how near that was."""
        return LOGITS if self.logits.calls else "actions"

    @property
    def deciding(self) -> Errors:
        return self.logits if self.logits.calls else self.actions

    @property
    def has_signal(self) -> bool:
        """Whether the reference's numbers that decide can tell a right backend from a wrong one."""
        if self.logits.calls:
            return self.spread > 1e-6
        actions, noise = (np.concatenate(some) for some in zip(*self.exact, strict=True))
        return has_signal(actions, noise)

    @property
    def worst(self) -> tuple[NoisyExample, Errors]:
        return max(self.by_call, key=lambda one: one[1].relative_rms)


@dataclass
class Repetition:
    """Every call again, and again in reverse order, so that what a call leaves behind for the next would show."""

    calls: int = 0
    identical: int = 0
    max: float = 0.0
    differing: str | None = None  # the first observation that differed
    milliseconds: list[float] = field(default_factory=list)


def judge(
    rule: Rule, precision: str, robot: str, compared: Compared, control: Compared, repetition: Repetition
) -> Judged:
    """Checks, verdict, errors and their controls."""
    plain = control.by_place
    allowed = {
        place: rule.allowed(precision, plain[place].relative_rms if place in plain else 0.0)
        for place in compared.by_place
    }
    limit = rule.limit(control.deciding.relative_rms)
    allowed[ACTIONS] = limit if compared.decides == "actions" else np.inf
    suspect = first_suspect(compared.by_place, plain, allowed, JUMP)
    checks = _checks(rule, limit, compared, control, repetition)
    failed = [check for check in checks if not check.ok]
    verdict = "; ".join(check.text for check in failed or checks[:1])
    if failed and suspect is not None:
        verdict += f"; first off: {suspect}"
    return Judged(
        ok=not failed,
        decides=compared.decides,
        verdict=f"{'FAIL' if failed else 'PASS'}: {verdict}",
        checks=checks,
        bounds=Bounds(
            actions_relative_rms=finite(limit),
            factor_of_control=None if rule.bound is not None else rule.factor,
            reason=rule.reason,
            deltas_cosine=rule.cosine,
            overridden=rule.overridden,
            suspect_factor=None if precision == "f32" else STEPS.get(precision, rule.suspect_factor),
            jump=JUMP,
        ),
        first_off=None if suspect is None else _suspect(suspect),
        actions=_actions(robot, compared, control),
        intermediates=[
            IntermediateDocument(
                name=place.name,
                index=place.at,
                **asdict(compared.by_place[place].document),
                allowed=finite(allowed[place]),
                control=plain[place].document if place in plain else None,
            )
            for place in in_order(compared.by_place)
        ],
        determinism=Determinism(repetition.calls, repetition.identical, repetition.max, repetition.differing),
    )


def _checks(rule: Rule, limit: float, compared: Compared, control: Compared, repetition: Repetition) -> list[Check]:
    """What decides, the actions first."""
    error, plain, what = compared.deciding.relative_rms, control.deciding.relative_rms, compared.decides
    stated = "the bound that was given" if rule.overridden else "the stated bound"
    origin = f"{rule.factor:g} x the control's {significant(plain)}" if rule.bound is None else stated
    ok = bool(error <= limit)
    relation = "within" if ok else "not within"
    if compared.deciding.finite:
        text = f"{what}' relative rms {significant(error)} is {relation} {significant(limit)} ({origin})"
    else:
        text = f"the {what} aren't finite"
    wrong = [place for place in in_order(compared.by_place) if not compared.by_place[place].finite]
    judged = _signal(rule, limit, compared, control)
    same = repetition.identical == repetition.calls
    cosine = compared.deltas.cosine
    did = f"cosine of what denoising did is {cosine:.5f}, at least {rule.cosine} is stated"
    of_deltas = Check("deltas", bool(cosine >= (rule.cosine or 0.0)), finite(cosine), rule.cosine, did)
    values = f"values that aren't finite in {len(wrong)} intermediates" if wrong else "everything is finite"
    repeated = f"{repetition.identical} of {repetition.calls} repeated calls were bit-identical"
    repeated += "" if same else f" (off by up to {significant(repetition.max)})"
    return [
        *([] if judged.ok else [judged]),
        Check(what, ok, finite(error), finite(limit), text),
        *([] if what == "actions" else [_answers(compared)]),
        *([] if rule.cosine is None else [of_deltas]),
        Check("finite", not wrong, len(wrong), 0, values),
        Check("determinism", same, repetition.calls - repetition.identical, 0, repeated),
        *([judged] if judged.ok else []),
    ]


def _answers(compared: Compared) -> Check:
    """Informs: where two ids are near each other, rounding may choose the other one."""
    same, calls = sum(errors.max == 0 for _, errors in compared.by_call), len(compared.by_call)
    return Check("answers", True, same, calls, f"{same} of {calls} answers give the reference's actions exactly")


def _signal(rule: Rule, limit: float, compared: Compared, control: Compared) -> Check:
    """Whether there is anything that could fail: a reference that varies, and a control that gives a bound."""
    why = ""
    if not compared.has_signal:
        why = NO_SIGNAL
    elif rule.bound is None and not control.deciding.finite:
        why = f"the control's {control.decides} aren't finite, so there is no bound"
    elif rule.bound is None and not limit > 0:
        why = "the control has no error, so there is no bound"
    varies = f"the reference's {compared.decides} vary"
    return Check("signal", not why, None, None, f"nothing to judge: {why}" if why else varies)


def _actions(robot: str, compared: Compared, control: Compared) -> ActionsDocument:
    call, errors = compared.worst
    groups = action_groups(robot, len(compared.by_dimension))
    labels = {index: (group.label(index), group.unit) for group in groups for index in group.names}
    own, plain = ([errors.document for errors in some.by_dimension] for some in (compared, control))
    return ActionsDocument(
        **asdict(compared.actions.document),
        deltas=Deltas(finite(compared.deltas.cosine), finite(compared.deltas.relative_rms)),
        control=ActionsControl(**asdict(control.actions.document), deltas_cosine=finite(control.deltas.cosine)),
        worst=WorstCall(observation=call.example.source, seed=call.seed, **asdict(errors.document)),
        dimensions=[
            Dimension(index, *labels[index], one.rms, one.max, other.rms, other.max)
            for index, (one, other) in enumerate(zip(own, plain, strict=True))
        ],
    )


def _suspect(suspect: Suspect) -> SuspectDocument:
    place, errors = suspect.place, (finite(suspect.relative_rms), finite(suspect.control))
    return SuspectDocument(place.name, place.at, *errors, suspect.why, str(suspect))
