"""Random weights: the same from the same seed, of sensible scale, and never mistaken for trained ones."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from turbopi.checkpoint import Checkpoint, open_checkpoint, random_checkpoint
from turbopi.checkpoint.convert import write_random
from turbopi.checkpoint.random_weights import _BLOCK, _fill
from turbopi.config import PRESETS
from turbopi.models import parameter_shapes
from turbopi.models.observation import Observation
from turbopi.models.pi0.reference import Pi0Model, parameter_dtype
from turbopi.support.errors import ConfigError

PRESET = PRESETS["pi05_tiny"]
SMALL = PRESET.with_model(vocab_size=64, vision=replace(PRESET.planned_model.vision, depth=1))


@pytest.fixture(scope="module")
def tiny() -> Checkpoint:
    return random_checkpoint(SMALL)


def test_a_seed_determines_every_value(tiny: Checkpoint) -> None:
    first, second = (random_checkpoint(SMALL, seed).load("cpu", "f32").state for seed in (0, 1))
    again = tiny.load("cpu", "f32").state
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not any(torch.equal(first[name], second[name]) for name in first)


def test_values_depend_on_the_name_and_not_on_the_order_or_the_size_of_pieces(
    tiny: Checkpoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = tiny.load("cpu", "f32").state
    monkeypatch.setattr("turbopi.checkpoint.source.row_ranges.__defaults__", (7777,))
    monkeypatch.setitem(_BLOCK, "cpu", 1001)
    cut = tiny.load("cpu", "f32").state
    assert all(torch.equal(whole[name], cut[name]) for name in whole)
    alike = [f"vlm.layers.{i}.mlp.up_proj.weight" for i in range(6)]
    assert len({whole[name].sum().item() for name in alike}) == 6


def test_values_are_those_of_plain_integer_arithmetic() -> None:
    """So that they are the same on every device."""

    def mix(x: int) -> int:
        for _ in range(2):
            x ^= x >> 16
            x = x * 0x45D9F3B & 0xFFFFFFFF
        return x ^ x >> 16

    first, keys = 2**29, (0x89ABCDEF, 0xFEDCBA98)
    values = torch.empty(1000)
    _fill(values, first, keys, 0.0, 3**-0.5)
    hashes = [mix(mix(index ^ keys[0]) ^ keys[1]) for index in range(first, first + len(values))]
    assert values.tolist() == [(x >> 8) * 2.0**-23 - 1 for x in hashes]


def test_the_hash_looks_uniform() -> None:
    values = torch.empty(2**18)
    _fill(values, 12_345, (0xDEADBEEF, 0x12345678), 0.0, 3**-0.5)  # uniform in [-1, 1)
    assert values.min() >= -1
    assert values.max() < 1
    assert abs(values.mean().item()) < 0.01
    assert abs(values.square().mean().item() - 1 / 3) < 0.01
    for lag in (1, 2, 64, 1024):
        assert abs((values[:-lag] * values[lag:]).mean().item()) < 0.01
    counts = torch.histc(values, bins=64, min=-1, max=1)
    assert (counts - 2**12).abs().max() < 6 * 2**6  # 6 standard deviations


def test_bf16_is_the_rounded_f32(tiny: Checkpoint) -> None:
    exact, rounded = tiny.load("cpu", "f32").state, tiny.load("cpu", "bf16").state
    for name, tensor in rounded.items():
        assert tensor.dtype == parameter_dtype(name, "bf16")
        assert torch.equal(tensor, exact[name].to(tensor.dtype))


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_has_its_shapes_and_statistics_of_its_robot(preset: str) -> None:
    checkpoint = random_checkpoint(preset)
    assert checkpoint.source.shapes == parameter_shapes(PRESETS[preset].model)
    state, actions = checkpoint.norm_stats.state, checkpoint.norm_stats.actions
    assert state is not None
    assert actions is not None
    expected = {"libero": (8, 7), "droid": (8, 8), "aloha": (14, 14), "plain": (32, 32)}[PRESETS[preset].robot]
    assert (state.dim, actions.dim) == expected
    checkpoint.norm_stats.check(PRESETS[preset].normalization, preset)


def test_it_says_what_it_is(tiny: Checkpoint) -> None:
    info = tiny.info()
    assert info["format"] == "random"
    assert info["random_weights"] is True
    assert info["path"] is None
    assert "random weights, seed 0" in info["notes"][0]
    assert random_checkpoint("pi05_tiny", 7).info()["config_source"] == "random weights, preset pi05_tiny, seed 7"


def test_fingerprints_tell_seeds_and_sizes_apart(tiny: Checkpoint) -> None:
    assert tiny.fingerprint() == random_checkpoint(SMALL, 0).fingerprint()
    assert tiny.fingerprint() != random_checkpoint(SMALL, 1).fingerprint()
    assert tiny.fingerprint() != random_checkpoint(SMALL.with_model(vocab_size=512)).fingerprint()


def test_the_short_hash_is_made_at_once_only_of_small_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_random(SMALL, tmp_path / "small")
    for file in folder.rglob("*"):
        os.utime(file, (1.0, 1.0))  # settled, so that hashes are remembered
    with monkeypatch.context() as large:
        large.setattr("turbopi.checkpoint.base.SMALL_BYTES", 0)
        assert open_checkpoint(folder).short_hash is None
        whole = open_checkpoint(folder).fingerprint()
        assert open_checkpoint(folder).short_hash == whole[:12]
    os.utime(folder / "model.safetensors", (2.0, 2.0))
    assert open_checkpoint(folder).short_hash == whole[:12]


@pytest.mark.parametrize("seed", [-1, 2**32, 1.0, True, "0"])
def test_seeds_that_are_none_are_refused(seed: object) -> None:
    with pytest.raises(ConfigError, match="expected a whole number in"):
        random_checkpoint("pi05_tiny", seed)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="unknown preset 'pi05_huge'"):
        random_checkpoint("pi05_huge")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pi05", "pi0"])
def test_activations_stay_healthy_and_the_observation_matters(kind: str) -> None:
    config = PRESET.with_model(kind=kind)
    model = Pi0Model.from_state(config.planned_model, random_checkpoint(config).load("cpu", "f32").state)
    generator = torch.Generator().manual_seed(0)

    def observation(seed: int) -> Observation:
        generator.manual_seed(seed)
        return Observation(
            images=torch.randint(0, 256, (1, 2, 224, 224, 3), dtype=torch.uint8, generator=generator),
            image_mask=torch.ones(1, 2, dtype=torch.bool),
            tokens=torch.randint(0, 1024, (1, 16), generator=generator),
            token_mask=torch.ones(1, 16, dtype=torch.bool),
            state=torch.randn(1, 32, generator=generator),
        )

    noise = torch.randn(1, 10, 32, generator=generator)
    trace: dict[str, torch.Tensor] = {}
    actions = model.sample(observation(1), noise, 4, trace=trace)
    for name in ("prefix_embs", "kv_k", "kv_v", "v_t", "actions", "suffix_out"):
        assert 0.1 < trace[name].float().square().mean().sqrt() < 10, name
    moved = (model.sample(observation(2), noise, 4) - actions).square().mean().sqrt()
    assert moved > 0.05 * actions.square().mean().sqrt()
