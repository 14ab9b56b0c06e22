"""The rules a backend is held to, and the verdict on what was measured. docs/verify.md has the reasons at length."""

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np

from turbopi.errors import BackendError, ConfigError
from turbopi.examples import NoisyExample
from turbopi.plots import action_groups
from turbopi.quantization.plan import TIERS
from turbopi.verify.bounds import (
    BF16_FACTOR,
    BOUND_FACTORS,
    F32_BOUND,
    FLOAT32_ROUNDING,
    FP8_BOUND,
    FP8_COSINE,
    FP8_STEP,
    JUMP,
    SUSPECT_FACTOR,
    TRAINED_FACTORS,
)
from turbopi.verify.intermediates import Errors, ErrorsBy, Place, Suspect, Tensors, first_suspect, in_order
from turbopi.wording import significant

ACTIONS = Place("actions")
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
        if precision in TIERS:
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
        if precision in TIERS:
            return max(FP8_STEP * control, FLOAT32_ROUNDING)
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
        of_call = Errors()
        of_call.add(tensors[ACTIONS], exact[ACTIONS])
        self.by_call.append((call, of_call))
        noise = call.noise[0].numpy()
        self.deltas.add(tensors[ACTIONS] - noise, exact[ACTIONS] - noise)
        self.by_dimension = self.by_dimension or [Errors() for _ in range(robot.shape[1])]
        for index, errors in enumerate(self.by_dimension):
            errors.add(robot[:, index], exact_robot[:, index])

    @property
    def actions(self) -> Errors:
        return self.by_place[ACTIONS]

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
) -> dict[str, Any]:
    """Checks, verdict, errors and their controls, as plain values."""
    plain = control.by_place
    allowed = {
        place: rule.allowed(precision, plain[place].relative_rms if place in plain else 0.0)
        for place in compared.by_place
    }
    limit = rule.limit(control.actions.relative_rms)
    allowed[ACTIONS] = limit
    suspect = first_suspect(compared.by_place, plain, allowed, JUMP)
    checks = _checks(rule, limit, compared, control, repetition)
    failed = [check for check in checks if not check["ok"]]
    verdict = "; ".join(str(check["text"]) for check in failed or checks[:1])
    if failed and suspect is not None:
        verdict += f"; first off: {suspect}"
    return {
        "ok": not failed,
        "verdict": f"{'FAIL' if failed else 'PASS'}: {verdict}",
        "checks": checks,
        "bounds": {
            "actions_relative_rms": limit,
            "factor_of_control": None if rule.bound is not None else rule.factor,
            "reason": rule.reason,
            "deltas_cosine": rule.cosine,
            "overridden": rule.overridden,
            "suspect_factor": None if precision == "f32" else FP8_STEP if precision in TIERS else rule.suspect_factor,
            "jump": JUMP,
        },
        "first_off": None if suspect is None else _suspect_json(suspect),
        "actions": _actions(robot, compared, control),
        "intermediates": [
            {
                "name": place.name,
                "index": place.at,
                **compared.by_place[place].as_json(),
                "allowed": allowed[place],
                "control": plain[place].as_json() if place in plain else None,
            }
            for place in in_order(compared.by_place)
        ],
        "determinism": {name: value for name, value in asdict(repetition).items() if name != "milliseconds"},
    }


def _checks(
    rule: Rule, limit: float, compared: Compared, control: Compared, repetition: Repetition
) -> list[dict[str, Any]]:
    """What decides, the actions first."""
    error, plain = compared.actions.relative_rms, control.actions.relative_rms
    stated = "the bound that was given" if rule.overridden else "the stated bound"
    origin = f"{rule.factor:g} x the control's {significant(plain)}" if rule.bound is None else stated
    ok = bool(error <= limit)
    relation = "within" if ok else "not within"
    if compared.actions.finite:
        text = f"actions' relative rms {significant(error)} is {relation} {significant(limit)} ({origin})"
    else:
        text = "the actions aren't finite"
    wrong = [place for place in in_order(compared.by_place) if not compared.by_place[place].finite]
    same = repetition.identical == repetition.calls
    cosine = compared.deltas.cosine
    of_deltas = {
        "name": "deltas",
        "ok": bool(cosine >= (rule.cosine or 0.0)),
        "value": cosine,
        "bound": rule.cosine,
        "text": f"cosine of what denoising did is {cosine:.5f}, at least {rule.cosine} is stated",
    }
    return [
        {"name": "actions", "ok": ok, "value": error, "bound": limit, "text": text},
        *([] if rule.cosine is None else [of_deltas]),
        {
            "name": "finite",
            "ok": not wrong,
            "value": len(wrong),
            "bound": 0,
            "text": f"values that aren't finite in {len(wrong)} intermediates" if wrong else "everything is finite",
        },
        {
            "name": "determinism",
            "ok": same,
            "value": repetition.calls - repetition.identical,
            "bound": 0,
            "text": f"{repetition.identical} of {repetition.calls} repeated calls were bit-identical"
            + ("" if same else f" (off by up to {significant(repetition.max)})"),
        },
    ]


def _actions(robot: str, compared: Compared, control: Compared) -> dict[str, Any]:
    call, errors = compared.worst
    groups = action_groups(robot, len(compared.by_dimension))
    labels = {
        index: (name if name == group.title or name.startswith("dim ") else f"{group.title} {name}", group.unit)
        for group in groups
        for index, name in group.names.items()
    }
    return {
        **compared.actions.as_json(),
        "deltas": {"cosine": compared.deltas.cosine, "relative_rms": compared.deltas.relative_rms},
        "control": control.actions.as_json() | {"deltas_cosine": control.deltas.cosine},
        "worst": {"observation": call.example.source, "seed": call.seed, **errors.as_json()},
        "dimensions": [
            {
                "index": index,
                "name": labels[index][0],
                "unit": labels[index][1],
                "rms": one.rms,
                "max": one.as_json()["max"],
                "control_rms": plain.rms,
                "control_max": plain.as_json()["max"],
            }
            for index, (one, plain) in enumerate(zip(compared.by_dimension, control.by_dimension, strict=True))
        ],
    }


def _suspect_json(suspect: Suspect) -> dict[str, Any]:
    return {
        "name": suspect.place.name,
        "index": suspect.place.at,
        "relative_rms": suspect.relative_rms,
        "control_relative_rms": suspect.control,
        "why": suspect.why,
        "text": str(suspect),
    }
