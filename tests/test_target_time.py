"""Weights distilled for one denoising step with a target time: what is read of them, and what they compute."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from checkpoint_helpers import GOLDEN, edit_tensors, jax_copy, lerobot_copy, read_tree, torch_copy, write_json
from conftest import golden_cases

from turbopi import UnifiedPolicy
from turbopi.checkpoint import Checkpoint, convert, open_checkpoint
from turbopi.models.pi0.denoise import suffix_mask, suffix_rope, time_embedding
from turbopi.models.pi0.reference import Pi0Model
from turbopi.support.errors import CheckpointError, ConfigError, ObservationError
from turbopi.verify.golden import Case

WIDTH = 32  # of the golden expert
NAMES = {
    "tether": ("target_time_embed_mlp.0", "target_time_embed_mlp.2"),
    "openpi": ("target_time_mlp_1", "target_time_mlp_2"),
    "studio": ("target_time_mlp_in", "target_time_mlp_out"),
}


def mlp(names: tuple[str, str], width: int, hidden: int = 48, prefix: str = "") -> dict[str, torch.Tensor]:
    made = torch.Generator().manual_seed(3)
    shapes = [(hidden, width), (hidden,), (width, hidden), (width,)]
    tensors = (0.3 * torch.randn(shape, generator=made) for shape in shapes)
    keys = [f"{prefix}{name}.{part}" for name in names for part in ("weight", "bias")]
    return dict(zip(keys, tensors, strict=True))


def one_step(plain: Checkpoint, s: float, layers: dict[str, torch.Tensor]) -> torch.Tensor:
    """a = noise − v(noise, t = 1, s) by the model without the MLP, and the MLP beside it, as its owners write it."""
    case, (first, first_bias, last, last_bias) = case_of(plain), layers.values()
    model = model_of(plain)
    pi05, width = model.config.kind == "pi05", model.config.expert.width
    sincos = time_embedding(np.array([s]), width)
    added = F.linear(F.silu(F.linear(sincos, first, first_bias)), last, last_bias)
    time = time_embedding(np.ones(1), width) + added
    cache, tokens = model.prefix(case.observation), case.noise.shape[1] + (not pi05)
    rope = suffix_rope(cache, tokens, model.config.expert.head_dim, model.config.rope_base)
    of_prefix = (cache.state, model.time_condition(time) if pi05 else time, cache.k, cache.v)
    mask = suffix_mask(cache, tokens, has_state_token=not pi05)
    return case.noise - model.velocity(case.noise, *of_prefix, rope, mask)[1]


def case_of(checkpoint: Checkpoint) -> Case:
    return golden_cases()["b_third_masked" if checkpoint.config.model.kind == "pi05" else "p0_pi0_state"]


def model_of(checkpoint: Checkpoint) -> Pi0Model:
    return Pi0Model.from_state(checkpoint.config.planned_model, checkpoint.load("cpu", "f32").state)


def computed(checkpoint: Checkpoint) -> torch.Tensor:
    case = case_of(checkpoint)
    return model_of(checkpoint).sample(case.observation, case.noise, 1)


def check(distilled: Path, plain: Path, s: float, layers: dict[str, torch.Tensor]) -> Checkpoint:
    opened, without = open_checkpoint(distilled), open_checkpoint(plain)
    torch.testing.assert_close(computed(opened), one_step(without, s, layers), atol=2e-5, rtol=2e-5)
    assert (computed(opened) - computed(without)).abs().max() > 1e-3, "the target time counts for nothing here"
    assert opened.config.one_step and opened.config.num_denoising_steps == 1
    assert any(f"one denoising step, to target time {s:g}" in note for note in opened.source.notes)
    return opened


@pytest.mark.parametrize(("whose", "s"), [("tether", 1.0), ("openpi", 0.0), ("studio", 0.3)])
def test_one_step_is_the_one_that_its_owners_code_takes(tmp_path: Path, whose: str, s: float) -> None:
    layers = mlp(NAMES[whose], WIDTH)
    edit_tensors(torch_copy(tmp_path / "distilled", target_time=s), **layers)
    check(tmp_path / "distilled", torch_copy(tmp_path / "plain"), s, layers)


def test_of_pi0_the_columns_of_the_time_count_and_openpis_jax_is_read(tmp_path: Path) -> None:
    layers, tree = mlp(NAMES["openpi"], WIDTH), read_tree(GOLDEN / "pi0" / "jax" / "params")
    for name, tensor in layers.items():
        layer, part = name.split(".")
        tree[f"{layer}/{'kernel' if part == 'weight' else part}"] = (
            tensor.mT.numpy().copy() if tensor.ndim == 2 else tensor.numpy()
        )
    folders = [jax_copy(tmp_path / "distilled", tree, "pi0"), GOLDEN / "pi0" / "jax"]
    settings: dict[str, Any] = {"preset": "pi0_aloha", "vision_heads": 4}
    write_json(folders[0] / "turbopi.json", settings | {"target_time": 0})
    shutil.copytree(folders[1], tmp_path / "plain")
    write_json(tmp_path / "plain" / "turbopi.json", settings)
    check(folders[0], tmp_path / "plain", 0.0, layers)


def test_lerobots_folder_as_tether_writes_it(tmp_path: Path) -> None:
    layers = mlp(NAMES["tether"], WIDTH)
    for name in ("plain", "distilled"):
        write_json(lerobot_copy(tmp_path / name) / "turbopi.json", {"vision_heads": 4})
    edit_tensors(tmp_path / "distilled", **{f"model.{name}": tensor for name, tensor in layers.items()})
    with pytest.raises(ConfigError, match=r'Put "target_time" into turbopi.json: 1 if tether made them; 0 where'):
        open_checkpoint(tmp_path / "distilled")
    write_json(tmp_path / "distilled" / "turbopi.json", {"vision_heads": 4, "target_time": 1})
    check(tmp_path / "distilled", tmp_path / "plain", 1.0, layers)


def test_tensors_that_nothing_reads_change_nothing(tmp_path: Path) -> None:
    folder, plain = torch_copy(tmp_path / "studio", target_time="unused"), torch_copy(tmp_path / "plain")
    edit_tensors(folder, **mlp(NAMES["studio"], WIDTH))
    opened = open_checkpoint(folder)
    assert torch.equal(computed(opened), computed(open_checkpoint(plain)))
    assert not opened.config.one_step and opened.config.num_denoising_steps == 10
    assert opened.fingerprint() == open_checkpoint(plain).fingerprint()


def test_what_it_becomes_in_other_formats_is_the_same_policy_of_one_step(tmp_path: Path) -> None:
    folder, layers = torch_copy(tmp_path / "distilled", target_time=1), mlp(NAMES["tether"], WIDTH)
    edit_tensors(folder, **layers)
    opened, back = open_checkpoint(folder), open_checkpoint(convert(folder, tmp_path / "plain", precision="f32"))
    assert back.config.one_step and torch.equal(computed(back), computed(opened))
    settings = {"preset": "pi05_libero", "vision_heads": 4, "target_time": 0}
    other = open_checkpoint(folder, write(tmp_path / "other.json", settings))
    assert len({one.fingerprint() for one in (opened, other, open_checkpoint(torch_copy(tmp_path / "other")))}) == 3


def test_another_number_of_steps_is_refused(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "distilled", target_time=1)
    edit_tensors(folder, **mlp(NAMES["tether"], WIDTH))
    options: dict[str, Any] = {"backend": "pytorch", "precision": "f32", "device": "cpu", "tokenizer": Bytes()}
    policy = UnifiedPolicy(folder, **options)
    assert np.isfinite(policy.infer(policy.example_observation(), seed=0, num_steps=1)["actions"]).all()
    with pytest.raises(ObservationError, match=r"10 denoising steps were asked for, .* distilled for one alone"):
        policy.infer(policy.example_observation(), num_steps=10)
    with pytest.raises(ConfigError, match="2 denoising steps were asked for"):
        UnifiedPolicy(folder, **options, time_grid=[1.0, 0.5, 0.0])
    for more in ({"num_denoising_steps": 10}, {"one_step": False}):
        settings = {"preset": "pi05_libero", "vision_heads": 4, "target_time": 1} | more
        config = write(tmp_path / "more.json", settings)
        with pytest.raises(ConfigError, match="num_denoising_steps is 1 and one_step true: leave both out"):
            open_checkpoint(folder, config)


@pytest.mark.parametrize(
    ("changes", "settings", "error", "message"),
    [
        ({}, {"target_time": 1}, ConfigError, "target_time is 1.0, but .* has no tensors of a target time"),
        ({}, {"target_time": 1.5}, ConfigError, "target_time is 1.5; expected a number from 0 to 1, or 'unused'"),
        ({"target_time_mlp.0.weight": (8, 8)}, {}, CheckpointError, "that forks add in different places"),
        ({"target_time_mlp/in/kernel": (8, 8)}, {}, CheckpointError, "that forks add in different places"),
        ({"logvar_proj.weight": (1, 8)}, {}, CheckpointError, r"logvar_proj\.weight: a decoupled mean flow \(DMF\)"),
        ({"time_proj.weight": (8, 8)}, {}, CheckpointError, r"a mean flow of two times \(SMF\)"),
        ({"target_time_mlp_1.weight": (8, 8)}, {"target_time": 0}, CheckpointError, "MLP doesn't fit the model"),
    ],
)
def test_what_is_something_else_is_refused_by_name(
    tmp_path: Path, changes: dict[str, Any], settings: dict[str, Any], error: type[Exception], message: str
) -> None:
    folder = torch_copy(tmp_path / "other", **settings)
    edit_tensors(folder, **{name: torch.ones(shape) for name, shape in changes.items()})
    with pytest.raises(error, match=message):
        open_checkpoint(folder)


def write(file: Path, content: Any) -> Path:
    write_json(file, content)
    return file


class Bytes:
    def encode(self, text: str, *, add_bos: bool) -> list[int]:
        return [1] * add_bos + [byte % 64 for byte in text.encode()]
