"""Everything around the engines: shapes, buffers, coverage, the pipeline. The engines are their PyTorch twins."""

import dataclasses
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from conftest import golden_cases, golden_folder, golden_model
from tensorrt_fakes import golden_backend

from turbopi import backends
from turbopi.backends.tensorrt.backend import TensorRTBackend
from turbopi.backends.tensorrt.parts import EngineShape
from turbopi.backends.tensorrt.pipelined import TensorRTPipelinedBackend
from turbopi.models.observation import Observation
from turbopi.support.errors import BackendError
from turbopi.support.installation import install_command
from turbopi.verify.check_golden import check_case

H = golden_folder().checkpoint("pi05").config.model.action_horizon
CASES = ["a_three_cams", "b_third_masked", "e_horizon50", "p0_pi0_state"]
BOTH = (TensorRTBackend, TensorRTPipelinedBackend)


@pytest.mark.slow
@pytest.mark.parametrize("cls", BOTH)
@pytest.mark.parametrize("case", CASES)
def test_float32_twins_are_openpi_within_rounding(cls: type[TensorRTBackend], case: str, tmp_path: Path) -> None:
    one = golden_cases()[case]
    comparisons = check_case(one, golden_backend(cls, one.kind, tmp_path))
    assert {"v_t", "actions"} <= {c.tensor for c in comparisons}
    assert [c for c in comparisons if not c.ok] == []


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_half_precision_twins_are_within_openpis_own_error(case: str, tmp_path: Path) -> None:
    one = golden_cases()[case]
    comparisons = check_case(one, golden_backend(TensorRTBackend, one.kind, tmp_path, half=True))
    assert [(c.tensor, c.num_steps) for c in comparisons if c.ok is False] == []


def test_each_layer_has_an_engine_of_its_own_and_all_run(tmp_path: Path) -> None:
    one, backend = golden_cases()["a_three_cams"], golden_backend(TensorRTBackend, "pi05", tmp_path)
    backend.sample(one.observation, one.noise, 3)
    runs = backend.describe()["engine_runs_while_capturing"]
    rows = one.observation.batch_size
    depth = backend.config.vlm.depth
    mlps = {name: count for name, count in runs.items() if name.startswith("feed_forward-")}
    times = rows + 1  # each row, and the capture
    assert mlps == dict.fromkeys(mlps, times) and len(mlps) == depth - 1
    assert {count for name, count in runs.items() if name.startswith("vision")} == {times}
    assert {count for name, count in runs.items() if name.startswith("denoise_step")} == {3 * times}


def test_denoising_a_cache_is_what_the_reference_does_with_it(tmp_path: Path) -> None:
    """Also behind a longer observation, whose rows are still in the buffers."""
    one, backend = golden_cases()["a_three_cams"], golden_backend(TensorRTBackend, "pi05", tmp_path)
    backend.sample(one.observation, one.noise, 2)
    for call in backend._calls.values():
        call.cache_k.fill_(torch.nan)
        call.cache_v.fill_(torch.nan)
    observation, model = one.observation.row(0), golden_model("pi05")
    cache = model.prefix(observation)
    expected = model.denoise(cache, one.noise[:1], 2)
    torch.testing.assert_close(backend.denoise(cache, one.noise[:1], 2), expected, atol=1e-5, rtol=1e-5)
    own = backend.prefix(observation)
    torch.testing.assert_close(own.k, cache.k, atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(backend.denoise(own, one.noise[:1], 2), expected, atol=2e-5, rtol=1e-4)


def test_a_layer_that_is_computed_elsewhere_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if a fallback took one layer's MLP."""
    one, backend = golden_cases()["a_three_cams"], golden_backend(TensorRTBackend, "pi05", tmp_path)
    parts = backend._engines.parts(EngineShape(3, 208, one.noise.shape[1]))
    elsewhere = SimpleNamespace(run=parts.feed_forwards[0].run, calls=0)  # computes, but never counts
    mixed = dataclasses.replace(parts, feed_forwards=[elsewhere, *parts.feed_forwards[1:]])
    monkeypatch.setattr(backend._engines, "parts", lambda shape: mixed)
    with pytest.raises(
        BackendError, match=r"vision and MLPs ran \[1, 0, 1\] times .* something was computed elsewhere"
    ):
        backend.sample(one.observation, one.noise, 2)


def test_an_observation_without_engine_is_an_error_after_warmup(tmp_path: Path) -> None:
    one, backend = golden_cases()["a_three_cams"], golden_backend(TensorRTBackend, "pi05", tmp_path)
    backend.warmup(one.observation, 2)
    two_cameras = dataclasses.replace(one.observation, image_mask=torch.tensor([[True, True, False]] * len(one.noise)))
    with pytest.raises(BackendError, match=r"engines for 3 cameras, up to .* and none for 2 cameras, .*`turbopi build"):
        backend.sample(two_cameras, torch.zeros(len(one.noise), H, 32), 2)
    assert backend.describe()["observations_without_engine"] == 1
    assert len(backend.describe()["engines_for"]) == 1


def test_weights_inside_engines_are_let_go_after_warmup(tmp_path: Path) -> None:
    one, backend = golden_cases()["a_three_cams"], golden_backend(TensorRTBackend, "pi05", tmp_path)
    noise = torch.randn(len(one.noise), H, 32)
    expected = backend.sample(one.observation, noise, 2).actions
    backend.warmup(one.observation, 2)
    assert torch.equal(backend.sample(one.observation, noise, 2).actions, expected)
    weights = backend._weights
    assert weights.vision == [] and weights.expert == [] and all(layer.gate_up.numel() == 0 for layer in weights.vlm)


def test_engines_for_a_shorter_prompt_are_taken_from_the_cache(tmp_path: Path) -> None:
    one, backend = golden_cases()["a_three_cams"], golden_backend(TensorRTBackend, "pi05", tmp_path)
    longest = int(one.observation.token_mask.sum(1).max())
    shape = EngineShape(3, -(-longest // 16) * 16, one.noise.shape[1])
    assert shape.prompt_slots < backend.config.max_prompt_tokens
    backend._engines.prepare(shape)
    expected = golden_model("pi05").sample(one.observation, one.noise, 2)
    again = golden_backend(TensorRTBackend, "pi05", tmp_path)
    torch.testing.assert_close(again.sample(one.observation, one.noise, 2).actions, expected, atol=1e-5, rtol=1e-5)
    assert again.describe()["engines_for"] == [str(shape)] and again.built == []
    assert set(again.describe()["engines"].values()) == {"cached"}


def test_warmup_loads_every_cached_set_and_calls_take_the_smallest_that_fits(tmp_path: Path) -> None:
    one, backend = golden_cases()["a_three_cams"], golden_backend(TensorRTBackend, "pi05", tmp_path)
    short, long = EngineShape(3, 64, H), EngineShape(3, 208, H)
    for shape in (short, long):
        backend._engines.prepare(shape)
    observation = one.observation.row(0)
    backend.warmup(observation, 2)
    assert backend.describe()["engines_for"] == [str(short), str(long)]
    tokens = torch.ones_like(observation.token_mask)
    for mask, shape in ((observation.token_mask, short), (tokens, long)):
        for call in backend._calls.values():
            call.x_t.zero_()
        backend.sample(dataclasses.replace(observation, token_mask=mask), torch.randn(1, H, 32), 2)
        assert [key.shape for key, call in backend._calls.items() if bool(call.x_t.any())] == [shape]


# -- the pipeline ------------------------------------------------------------------------------------------------------


def test_pipelined_answers_are_the_unpipelined_ones_in_order(tmp_path: Path) -> None:
    one = golden_cases()["a_three_cams"]
    plain, pipelined = (golden_backend(cls, "pi05", tmp_path) for cls in BOTH)
    observation = one.observation.row(0)
    noises = [torch.randn(one.noise[:1].shape, generator=torch.Generator().manual_seed(i)) for i in range(5)]
    futures = [pipelined.submit(observation, noise, 2) for noise in noises]
    for noise, future in zip(noises, futures, strict=True):
        sample = future.result(timeout=60)
        assert torch.equal(sample.actions, plain.sample(observation, noise, 2).actions)
        assert list(sample.stage_ms) == ["vision", "prefix", "denoise"]


def test_an_answer_isnt_overwritten_by_later_ones(tmp_path: Path) -> None:
    one, backend = golden_cases()["a_three_cams"], golden_backend(TensorRTPipelinedBackend, "pi05", tmp_path)
    observation = one.observation.row(0)
    answer = backend.submit(observation, one.noise[:1], 2).result(timeout=60).actions
    kept = answer.clone()
    for _ in range(3):
        backend.submit(observation, -one.noise[:1], 2).result(timeout=60)
    assert torch.equal(answer, kept)


def test_a_failing_observation_frees_its_buffers(tmp_path: Path) -> None:
    one, backend = golden_cases()["a_three_cams"], golden_backend(TensorRTPipelinedBackend, "pi05", tmp_path)
    observation = one.observation.row(0)
    backend.warmup(observation, 2)
    none = dataclasses.replace(observation, image_mask=torch.tensor([[True, False, False]]))
    for _ in range(3):
        with pytest.raises(BackendError, match="none for 1 cameras"):
            backend.submit(none, torch.zeros(1, H, 32), 2)
    assert backend.submit(observation, torch.zeros(1, H, 32), 2).result(timeout=60).actions.isfinite().all()


def test_waiting_for_free_buffers_is_told_apart_from_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, backend = golden_cases()["a_three_cams"], golden_backend(TensorRTPipelinedBackend, "pi05", tmp_path)
    now = [10.0]
    monkeypatch.setattr("turbopi.backends.tensorrt.pipelined.time", SimpleNamespace(perf_counter=lambda: now[0]))

    class Busy(threading.Semaphore):
        def acquire(self, *arguments: Any) -> bool:
            now[0] += 1.5
            return super().acquire(*arguments)

    backend._slots[1].free = Busy(1)
    submitted = [backend.submit(one.observation.row(0), torch.zeros(1, H, 32), 2) for _ in range(3)]
    assert [future.result(timeout=60).queue_ms for future in submitted] == [0, 1500, 0]


def test_submit_takes_one_observation() -> None:
    one = golden_cases()["e_horizon50"] if golden_cases()["e_horizon50"].observation.batch_size > 1 else None
    batch = one or golden_cases()["a_three_cams"]
    doubled = Observation.joined([batch.observation] * 2)
    backend = TensorRTPipelinedBackend.__new__(TensorRTPipelinedBackend)
    with pytest.raises(BackendError, match="submit takes one observation at a time, not"):
        backend.submit(doubled, batch.noise, 2)


# -- what can't run ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["tensorrt", "tensorrt_pipelined", "tensorrt_fp8"])
def test_a_machine_without_the_library_is_told_what_to_install(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("turbopi.backends.tensorrt.importlib.util.find_spec", lambda name: None)
    reason = backends.availability(name, torch.device("cpu"))
    assert reason is not None and "neither tensorrt_rtx nor tensorrt is installed; " in reason
    assert install_command("tensorrt") in reason
