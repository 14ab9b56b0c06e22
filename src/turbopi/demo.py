"""The demo: real LIBERO pictures in, an action chunk out, and a check of it against the float32 oracle.

The check. The oracle is the eager reference in float32, given the same weights, observations and noise. How far a
bfloat16 run may be from it depends on the model, so the bound is measured on the model itself: a *control* runs the
oracle again with each weight that bfloat16 would round moved at random by up to half a bfloat16 step (2^-9 of its
value), in float32 arithmetic: that is how much this model makes of rounding. A bfloat16 run rounds its activations,
too, and lands at 0.7 to 3.2 times the control (66 chunks of `pytorch` and `pytorch_compile`; random pi05_tiny of four
seeds, openpi's golden Pi0.5 and Pi0; 1, 3 and 10 steps). The bound is 5 times the control. On pi05_tiny one wrong
prompt token lands at 8 times, swapped cameras at 16, and attended padding, a lost camera mask or BGR beyond 75.

Trained weights make more of rounded activations, beside rounded weights: the small policy lands at 1.2 to 5.5 times its
control (18 chunks), so for them the bound is 10 times. Of its chunks, one wrong word moves the worst to 73 times,
swapped cameras or BGR every one beyond 130.

Float32 rounds 2^16 times finer, and so is its control. Compiled float32 lands at 5 to 10 times that; the bound is 30,
since every way of adding up differs, and bugs are as much further off.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from turbopi.backends import Tier
from turbopi.checkpoint import Checkpoint, load_norm_stats
from turbopi.errors import BackendError, TurboPiError
from turbopi.model.reference import Pi0Model, parameter_dtype
from turbopi.policy import UnifiedPolicy
from turbopi.reading.pictures import read_picture

CONTROL_SEEDS = (1, 2)
BOUND_FACTORS: dict[Tier, float] = {"bf16": 5.0, "f32": 30.0, "fp8": 5.0, "fp8-mlp": 5.0}
TRAINED_FACTORS: dict[Tier, float] = BOUND_FACTORS | {"bf16": 10.0}
# in proportion to bfloat16's
ROUNDING: dict[Tier, float] = {"bf16": 1.0, "f32": 2.0**-16, "fp8": 2.0**5, "fp8-mlp": 2.0**5}
_HALF_BF16_STEP = 2.0**-9

Tick = Callable[[], None]  # called after each inference, for a progress bar


@dataclass(frozen=True)
class Frame:
    """One moment of a LIBERO episode.

    base, wrist   uint8[256, 256, 3]  RGB, turned as the policy expects them
    state         float64[8]
    expert        float64[10, 7]      what the scripted expert did next, that the small policy learned from
    """

    prompt: str
    base: np.ndarray
    wrist: np.ndarray
    state: np.ndarray
    step: int | None = None
    expert: np.ndarray | None = None


FRAMES = Path(__file__).parent / "data" / "libero"
SMALL_POLICY = Path(__file__).parent / "data" / "small_policy"  # trained; MODEL_CARD.md in it says how


def load_frames(folder: Path = FRAMES) -> list[Frame]:
    """The pictures that come with Turbo-Pi, or those of another folder of the same form (frames.json names them)."""
    try:
        listed = json.loads((folder / "frames.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise TurboPiError(f"{folder} has no frames.json: the installation lacks the demo's pictures") from None
    return [
        Frame(
            prompt=entry["prompt"],
            base=read_picture(folder / entry["image"]),
            wrist=read_picture(folder / entry["wrist_image"]),
            state=np.array(entry["state"], np.float64),
            step=entry.get("step"),
            expert=np.array(entry["expert"], np.float64) if "expert" in entry else None,
        )
        for entry in listed
    ]


def with_libero_stats(checkpoint: Checkpoint) -> Checkpoint:
    """Random weights for LIBERO with the statistics of real episodes, so that states and actions have its scale."""
    if checkpoint.format != "random" or checkpoint.config.robot != "libero":
        return checkpoint
    return replace(checkpoint, norm_stats=load_norm_stats(FRAMES / "norm_stats.json"))


def observations(policy: UnifiedPolicy, frames: Sequence[Frame]) -> list[dict[str, Any]]:
    """The frames in the keys of the policy's robot.

    For another robot than LIBERO's they are its example observations, with these pictures in place of its cameras'.
    """
    if policy.metadata["robot"] == "libero":
        return [
            {
                "observation/image": frame.base,
                "observation/wrist_image": frame.wrist,
                "observation/state": frame.state,
                "prompt": frame.prompt,
            }
            for frame in frames
        ]
    return [_with_pictures(policy.example_observation(seed), frame) for seed, frame in enumerate(frames)]


def _with_pictures(observation: Mapping[str, Any], frame: Frame) -> dict[str, Any]:
    """`observation` with each of its pictures replaced: the first by the base camera's, the others by the wrist's."""
    pictures = iter([frame.base])

    def replaced(key: str, value: Any) -> Any:
        if isinstance(value, Mapping):
            return {inner: replaced(inner, item) for inner, item in value.items()}
        if isinstance(value, np.ndarray) and value.ndim == 3:
            return _like(next(pictures, frame.wrist), value)
        return frame.prompt if key in ("prompt", "task") else value

    return {key: replaced(key, value) for key, value in observation.items()}


def _like(picture: np.ndarray, other: np.ndarray) -> np.ndarray:
    """`picture` in the layout and range of `other`: HWC or CHW, uint8 or float in [0, 1]."""
    if np.issubdtype(other.dtype, np.floating):
        picture = (picture / 255).astype(other.dtype)
    return np.ascontiguousarray(picture.transpose(2, 0, 1)) if other.shape[0] == 3 else picture


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


# -- the check ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Difference:
    """Of one action chunk from the oracle's, in units of the model's normalised actions (`action_units`)."""

    rms: float
    max: float


@dataclass(frozen=True)
class OracleCheck:
    """Backend against oracle. `differences` has one entry a frame; each one's rms must be within the bound."""

    differences: list[Difference]
    control: float  # rms of the oracle with jittered weights, over all frames, in proportion to the precision
    factor: float
    oracle_actions: np.ndarray  # float64[F, H, d]

    @property
    def bound(self) -> float:
        return self.factor * self.control

    @property
    def worst(self) -> Difference:
        return max(self.differences, key=lambda difference: difference.rms)

    @property
    def ok(self) -> bool:
        return all(difference.rms <= self.bound for difference in self.differences)

    def as_json(self) -> dict[str, Any]:
        return {
            "ok": self.ok,
            "rms": [difference.rms for difference in self.differences],
            "max": [difference.max for difference in self.differences],
            "bound": self.bound,
            "bound_factor": self.factor,
            "control_rms": self.control,
            "oracle": "pytorch, f32",
        }


def run_frames(
    policy: UnifiedPolicy, observed: Sequence[Mapping[str, Any]], seed: int, tick: Tick
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
    observed: Sequence[Mapping[str, Any]],
    *,
    precision: Tier,
    seed: int,
    tick: Tick = lambda: None,
) -> OracleCheck:
    """Compare a backend's chunks with those of `oracle`, a `pytorch` policy in f32; same observations and seed."""
    assert (oracle.backend.name, oracle.backend.precision) == ("pytorch", "f32")
    exact = _chunks(run_frames(oracle, observed, seed, tick))
    units = action_units(oracle, observed[0])
    model: Pi0Model = oracle.backend.model  # type: ignore[attr-defined]
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


def action_units(policy: UnifiedPolicy, observation: Mapping[str, Any]) -> np.ndarray:
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


@contextmanager
def jittered(model: Pi0Model, seed: int) -> Iterator[None]:
    """For a while, each weight that is bfloat16 in the bf16 mode is moved by up to half a bfloat16 step."""
    try:
        _scale_weights(model, seed, torch.Tensor.mul_)
        yield
    finally:
        _scale_weights(model, seed, torch.Tensor.div_)


def _scale_weights(model: Pi0Model, seed: int, apply: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> None:
    generator = torch.Generator(model.device).manual_seed(seed)
    for name, parameter in model.named_parameters():
        if parameter_dtype(name, "bf16") == torch.bfloat16:
            uniform = torch.rand(parameter.shape, generator=generator, device=parameter.device)
            apply(parameter.data, uniform.mul_(2).sub_(1).mul_(_HALF_BF16_STEP).add_(1))
