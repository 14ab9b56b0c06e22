"""A batch of SmolVLA in one run of the graphs is its observations alone: prompts, cameras and noise may differ.

Without a GPU: graphs run again on a CPU in float32, kernels by Triton's interpreter.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import gpu_or_interpreter
from replayed_graphs import Replayed, replay_on_cpu
from smolvla_golden import GoldenRuns, make_checkpoint, make_hub, relative
from test_engine_smolvla import model

from turbopi import UnifiedPolicy
from turbopi.backends import fused_smolvla
from turbopi.backends.captured import CapturedBackend
from turbopi.backends.fused_smolvla import FusedSmolVLABackend
from turbopi.backends.qualification import DENOISE
from turbopi.backends.tuned_tiles import BY_MODEL, Tiles
from turbopi.engine.smolvla import Expert, Prefix
from turbopi.engine.smolvla_batch import ExpertByOps
from turbopi.kernels.plain import PLAIN
from turbopi.kernels.portable.ops import portable_ops
from turbopi.kernels.tile_table import NO_TILES
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning
from turbopi.models.smolvla.reference import SmolVLAModel
from turbopi.support.errors import ObservationError

pytest.importorskip("triton", reason="Triton isn't installed")
pytestmark = [
    pytest.mark.skipif(torch.cuda.is_available(), reason="tests/test_gpu_smolvla.py has it there"),
    *gpu_or_interpreter(),
]
CPU, STEPS, H = torch.device("cpu"), 3, 5
SIZES: Any = {
    "cross": {"expert_depth": 4},
    "special": {"expert_depth": 2, "image_start": (3, 4), "image_end": (5,), "self_every": 3},
    "self": {"expert_depth": 4, "self_every": None},
}


def of_three(seed: int = 2) -> tuple[Observation, torch.Tensor]:
    """Of two, one and two cameras, the first missing in the second; prompts of 3, 7 and 1 tokens."""
    generator = torch.Generator().manual_seed(seed)
    cameras = torch.tensor([[True, True], [False, True], [True, True]])
    prompt = torch.arange(7)[None] < torch.tensor([[3], [7], [1]])
    images = torch.rand(3, 2, 16, 16, 3, generator=generator) * 2 - 1
    tokens = torch.randint(20, (3, 7), generator=generator) * prompt
    made = Observation(images, cameras, tokens, prompt, torch.randn(3, 32, generator=generator))
    return made, torch.randn(3, H, 32, generator=generator)


def alone(made: SmolVLAModel, observation: Observation, noise: torch.Tensor) -> np.ndarray:
    rows = range(observation.batch_size)
    return np.concatenate([made.sample(observation.row(i), noise[i : i + 1], STEPS).numpy() for i in rows])


def backend_of(cls: type[CapturedBackend], made: SmolVLAModel) -> CapturedBackend:
    state = dict(made.state_dict())
    return cls(made.config, lambda to, precision: state, device=CPU, precision="f32")


class FusedOnCpu(FusedSmolVLABackend):
    """In float32, by Triton's interpreter, and one observation's steps by the reference."""

    precisions = ("bf16", "f32")
    _dtype = torch.float32

    def _make_ops(self) -> Any:
        return replace(portable_ops(), linear_gelu=PLAIN.linear_gelu)  # the library's GELU is another one on a CPU


@pytest.fixture
def on_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    replay_on_cpu(monkeypatch)
    monkeypatch.setattr(fused_smolvla, "Graph", Replayed)
    monkeypatch.setattr(fused_smolvla, "tiles_of", lambda device: Tiles(NO_TILES, BY_MODEL))
    monkeypatch.setattr(fused_smolvla, "excluded", lambda *given: {DENOISE: "it isn't for CPUs"})
    monkeypatch.setattr(Replayed, "launches", 0)


@pytest.mark.parametrize("which", SIZES)
def test_captured_batches_are_the_reference_alone(which: str, on_cpu: None) -> None:
    made, (observation, noise) = model(**SIZES[which]).cpu(), of_three()
    backend = backend_of(CapturedBackend, made)
    exact = alone(made, observation, noise)
    assert relative(backend.sample(observation, noise, STEPS).actions.numpy(), exact) <= 2e-6
    assert {batch for _, batch in backend._graphs} == {4}
    assert Replayed.launches == 2 + 2 + STEPS  # a capture launches vision and prefix; the call these and steps, once


def test_what_was_in_empty_places_is_nothing_to_the_next_batch(on_cpu: None) -> None:
    made, (observation, noise) = model(**SIZES["cross"]).cpu(), of_three()
    backend = backend_of(CapturedBackend, made)
    nothing = observation.each(lambda part: torch.full_like(part, torch.nan) if part.is_floating_point() else part)
    every = replace(nothing, image_mask=torch.ones_like(nothing.image_mask))
    assert not backend.sample(every, noise, STEPS).actions.isfinite().any()
    exact = alone(made, observation, noise)
    assert relative(backend.sample(observation, noise, STEPS).actions.numpy(), exact) <= 2e-6


def test_conditioned_rows_run_alone_and_others_together(on_cpu: None) -> None:
    made, (observation, noise) = model(**SIZES["cross"]).cpu(), of_three()
    held = Conditioning(held=np.arange(H) < 2, values=np.full((H, 32), 0.5, np.float32))
    given = [None, held, None]
    backend = backend_of(CapturedBackend, made)
    exact = made.sample(observation, noise, STEPS, conditioning=given).numpy()
    sample = backend.sample(observation, noise, STEPS, conditioning=given)
    assert relative(sample.actions.numpy(), exact) <= 2e-6
    assert sorted(backend._graphs) == [(1, 1), (2, 2)]
    assert backend.describe()["batches"] == ["2 observations with up to 2 cameras"]


def test_a_strict_backend_runs_the_batches_that_are_warm(on_cpu: None) -> None:
    made, (observation, noise) = model(**SIZES["cross"]).cpu(), of_three()
    backend = backend_of(CapturedBackend, made)
    backend.warmup(observation.row(0), STEPS, H)
    backend.warmup_batches(observation.row(0), STEPS, H, [2])
    backend.strict = True
    two = replace(observation, image_mask=torch.ones_like(observation.image_mask))
    assert relative(backend.sample(two, noise, STEPS).actions.numpy(), alone(made, two, noise)) <= 2e-6
    assert sorted(backend._graphs) == [(2, 1), (2, 2)]
    with pytest.raises(ObservationError, match=r"1 cameras, .*Warm is: 2 cameras, H=5; 2 observations, 2 cameras"):
        backend.sample(observation.each(lambda part: part[1:2]), noise[:1], STEPS)
    with pytest.raises(ObservationError, match=r"2 observations, 2 cameras, H=4.*batches=2"):
        backend.sample(two.each(lambda part: part[:2]), noise[:2, :4], STEPS)


def test_a_policy_runs_observations_of_other_prompts_and_cameras_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_cpu: None
) -> None:
    pytest.importorskip("tokenizers", reason="SmolVLA's prompts need the extra `smolvla`")
    monkeypatch.setenv("HF_HUB_CACHE", str(make_hub(tmp_path / "hub")))
    for name in ("missing_camera", "special_tokens"):
        folder, golden = make_checkpoint(name, tmp_path / name), GoldenRuns(name)
        policy = UnifiedPolicy(folder, precision="f32", backend="cuda_graph", device="cpu")
        assert policy.runs_batches and policy.batch_modes == ()
        several = [{**golden.observation(run), "task": "put it there " * run} for run in range(len(golden))] * 2
        launched = Replayed.launches
        together = policy.infer_batch(several, seed=1)
        per_call = 4 + policy.metadata["num_denoising_steps"]
        assert Replayed.launches - launched <= per_call * (1 + len(several) // 8), name
        exact = UnifiedPolicy(folder, precision="f32", backend="pytorch")
        for row, one in enumerate(several):
            expected = exact.infer(one, seed=1 + row)["actions"]
            assert relative(together[row]["actions"], expected) <= 2e-5, (name, row)


# -- fused -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("which", SIZES)
def test_operations_of_several_are_the_reference_alone(which: str) -> None:
    made, (observation, noise) = model(**SIZES[which]), of_three()
    ops = replace(portable_ops(), linear_gelu=PLAIN.linear_gelu)
    prefix = Prefix.pack(made, ops, torch.float32)
    embedded = made.embed_images(observation.images.flatten(0, 1))
    x, lengths = prefix.embed_several(embedded, observation)
    expected = observation.image_mask.sum(1) * prefix.before_prompt(1) + observation.token_mask.sum(1) + 1
    assert torch.equal(lengths, expected)
    keys, values = prefix.of_expert(prefix.keys_values(x, lengths))
    behind = torch.arange(keys.shape[2]) % (len(x) // 3) >= lengths.repeat_interleave(len(x) // 3)
    keys, values = (one.masked_fill(behind[:, None], torch.nan) for one in (keys, values))  # nobody reads it
    x_t, v_t = torch.full((STEPS + 1, 3, H, 32), torch.nan), torch.full((STEPS, 3, H, 32), torch.nan)
    expert = Expert.pack(made)
    by = ExpertByOps.pack(expert, ops, torch.float32)
    by.run(by.constants(STEPS, 3, H, len(x) // 3), keys, values, lengths, noise, x_t, v_t)
    assert torch.equal(x_t[0], noise) and v_t.isfinite().all()
    assert relative(x_t[-1].numpy(), alone(made, observation, noise)) <= 1e-5


@pytest.mark.slow
def test_fused_batches_are_its_observations_alone(on_cpu: None) -> None:
    made, (observation, noise) = model(**SIZES["special"]), of_three()
    backend = backend_of(FusedOnCpu, made)
    together = backend.sample(observation, noise, STEPS).actions.numpy()
    single = [backend.sample(observation.row(i), noise[i : i + 1], STEPS).actions.numpy() for i in range(3)]
    assert relative(together, np.concatenate(single)) <= 1e-5
    assert relative(together, alone(made, observation, noise)) <= 1e-5
    assert backend.describe()["denoising"]["operations"] == ["calls of several observations"]
