"""The demo: real LIBERO images in, an action chunk out, and a check of it against the float32 oracle.

The oracle is the eager reference in float32, given the same weights, observations and noise. The bound is a multiple of
the control (verify/control.py), as verify/bounds.py explains.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from turbopi.backends import Precision
from turbopi.backends.pytorch import reference_model
from turbopi.policy.policy import UnifiedPolicy
from turbopi.support.errors import BackendError
from turbopi.verify.bounds import BOUND_FACTORS, TRAINED_FACTORS
from turbopi.verify.control import CONTROL_SEEDS, ROUNDING, jittered

Tick = Callable[[], None]  # called after each inference, for a progress bar


@dataclass(frozen=True)
class ExpertDistance:
    """How far a chunk is from what the expert did: over its first REPLAN actions, which are those carried out.

    position   mean absolute difference of the three position commands, in their unit (1 is 5 cm)
    scale      the same of a chunk of zeros: how large the expert's commands are
    gripper    share of actions whose gripper command has the expert's sign
    """

    position: float
    scale: float
    gripper: float


REPLAN = 5


def expert_distance(actions: np.ndarray, expert: np.ndarray) -> ExpertDistance:
    """Of LIBERO chunks [H, 7]."""
    ours, theirs = actions[:REPLAN], expert[:REPLAN]
    same_sign = np.sign(ours[:, 6]) == np.sign(theirs[:, 6])
    position = np.abs(ours[:, :3] - theirs[:, :3]).mean()
    return ExpertDistance(float(position), float(np.abs(theirs[:, :3]).mean()), float(same_sign.mean()))


@dataclass(frozen=True)
class Difference:
    """Of one action chunk from the oracle's, in units of the model's normalised actions (`action_units`)."""

    rms: float
    max: float


@dataclass(frozen=True)
class OracleCheck:
    """Backend against oracle, over all frames as the control is. `differences` has one entry a frame."""

    differences: list[Difference]
    control: float  # rms of the oracle with jittered weights, over all frames, in proportion to the precision
    factor: float
    oracle_actions: np.ndarray  # float64[F, H, d]

    @property
    def bound(self) -> float:
        return self.factor * self.control

    @property
    def all_frames(self) -> Difference:
        rms = np.sqrt(np.mean(np.square([difference.rms for difference in self.differences])))
        return Difference(float(rms), float(np.max([difference.max for difference in self.differences])))

    @property
    def ok(self) -> bool | None:
        """None where nothing can be judged: neither the backend nor jittered weights change the actions."""
        if self.control == self.all_frames.rms == 0:
            return None
        return self.all_frames.rms <= self.bound

    def as_json(self) -> dict[str, object]:
        return {
            "ok": self.ok,
            "rms": [difference.rms for difference in self.differences],
            "max": [difference.max for difference in self.differences],
            "rms_of_all": self.all_frames.rms,
            "bound": self.bound,
            "bound_factor": self.factor,
            "control_rms": self.control,
            "oracle": "pytorch, f32",
        }


def run_frames(
    policy: UnifiedPolicy, observed: Sequence[Mapping[str, object]], seed: int, tick: Tick
) -> list[dict[str, Any]]:
    """One inference for each observation, with the noise of `seed`, `seed + 1`, …"""
    results = []
    for number, observation in enumerate(observed):
        results.append(policy.infer(observation, seed=seed + number))
        tick()
    return results


def check(
    actions: Sequence[np.ndarray],
    oracle: UnifiedPolicy,
    observed: Sequence[Mapping[str, object]],
    *,
    precision: Precision,
    seed: int,
    tick: Tick = lambda: None,
) -> OracleCheck:
    """Compare a backend's chunks with those of `oracle`, a `pytorch` policy in f32; same observations and seed."""
    assert (oracle.backend.name, oracle.backend.precision) == ("pytorch", "f32")
    exact = _chunks(run_frames(oracle, observed, seed, tick))
    units = action_units(oracle, observed[0])
    model = reference_model(oracle.backend)
    moved = []
    for control_seed in CONTROL_SEEDS:
        with jittered(model, control_seed):
            chunks = _chunks(run_frames(oracle, observed, seed, tick))
        moved += [difference(chunk, truth, units).rms for chunk, truth in zip(chunks, exact, strict=True)]
    return OracleCheck(
        differences=[difference(chunk, truth, units) for chunk, truth in zip(actions, exact, strict=True)],
        control=float(np.sqrt(np.mean(np.square(moved)))) * ROUNDING[precision],
        factor=(BOUND_FACTORS if oracle.metadata["random_weights"] else TRAINED_FACTORS)[precision],
        oracle_actions=exact,
    )


def _chunks(results: Sequence[Mapping[str, Any]]) -> np.ndarray:
    return np.stack([result["actions"] for result in results])  # float64[F, H, d]


def num_oracle_runs(num_frames: int) -> int:
    """How often `check` calls its tick."""
    return num_frames * (1 + len(CONTROL_SEEDS))


def action_units(policy: UnifiedPolicy, observation: Mapping[str, object]) -> np.ndarray:
    """float64[d]: how far each of the robot's numbers moves with one unit of the model's normalised actions.

    Known from the statistics alone, so that an error means the same however many frames are shown.
    """
    model = policy.config.model
    _, state = policy.pipeline.before(observation)
    low, high = (
        policy.pipeline.after(np.full((model.action_horizon, model.action_dim), at, np.float32), state)["actions"][0]
        for at in (-0.5, 0.5)
    )
    units: np.ndarray = np.abs(high - low)
    units[units == 0] = 1
    return units


def difference(chunk: np.ndarray, truth: np.ndarray, units: np.ndarray) -> Difference:
    """Between chunks [H, d], in `units` [d]. Infinite if anything in `chunk` isn't finite."""
    if chunk.shape != truth.shape:
        raise BackendError(f"the backend's chunk has shape {list(chunk.shape)}, the oracle's {list(truth.shape)}")
    if not np.isfinite(chunk).all():
        return Difference(float("inf"), float("inf"))
    error = (chunk - truth) / units
    return Difference(float(np.sqrt(np.mean(error**2))), float(np.abs(error).max()))
