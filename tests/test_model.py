"""What the reference promises beyond the golden cases: compaction, batches, cameras, horizons, determinism."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import golden_cases, golden_model
from torch import Tensor

import turbopi
from turbopi.config import GemmaConfig, Kind, ModelConfig
from turbopi.models import parameter_shapes
from turbopi.models.observation import Observation
from turbopi.models.pi0.denoise import time_embedding, time_grid
from turbopi.models.pi0.layers import attention
from turbopi.models.pi0.reference import FloatPrecision, Pi0Model, parameter_dtype
from turbopi.support.errors import ConfigError, ObservationError

STEPS = 3


def test_nothing_outside_the_models_tests_for_a_family_by_name() -> None:
    package = Path(turbopi.__file__).parent
    by_name = re.compile(r"""(==|!=|\bin)\s*[(\[{]?\s*["']pi0(5)?["']""")
    files = [file for file in package.rglob("*.py") if package / "models" not in file.parents]
    assert not [str(file) for file in files if by_name.search(file.read_text(encoding="utf-8"))]
    assert by_name.search('if config.kind == "pi0":') and by_name.search('kind in ("pi05", "pi0")')


def random_observation(seed: int, *, cameras: int = 3, prompt: int = 20, slots: int = 40) -> Observation:
    generator = torch.Generator().manual_seed(seed)
    return Observation(
        images=torch.randint(0, 256, (1, cameras, 224, 224, 3), generator=generator, dtype=torch.uint8),
        image_mask=torch.ones(1, cameras, dtype=torch.bool),
        tokens=torch.randint(0, 512, (1, slots), generator=generator),
        token_mask=(torch.arange(slots) < prompt)[None],
        state=torch.randn(1, 32, generator=generator),
    )


def noise(seed: int, batch: int = 1, horizon: int = 10) -> Tensor:
    return torch.randn(batch, horizon, 32, generator=torch.Generator().manual_seed(seed))


def stack(*observations: Observation) -> Observation:
    fields = (field.name for field in dataclasses.fields(Observation))
    return Observation(**{name: torch.cat([getattr(o, name) for o in observations]) for name in fields})


@pytest.mark.parametrize("case", ["a_three_cams", "b_third_masked", "p0_pi0_state"])
@pytest.mark.parametrize("precision", ["f32", "bf16"])
def test_compaction_is_exact(case: str, precision: FloatPrecision) -> None:
    one = golden_cases()[case]
    model = golden_model(one.kind, precision)
    padded = model.sample(one.observation, one.noise, 10, compact=False)
    compacted = model.sample(one.observation, one.noise, 10)
    relative = float((padded - compacted).square().mean().sqrt() / padded.square().mean().sqrt())
    # the same mathematics in another order of summation: float32 rounding, or bfloat16's own
    assert relative < (2e-6 if precision == "f32" else 5e-3)


def test_compaction_computes_valid_tokens_only() -> None:
    one = golden_cases()["b_third_masked"]
    model = golden_model("pi05")
    assert model.prefix(one.observation).k.shape[3] == 2 * 256 + 17
    assert model.prefix(one.observation).mask is None
    assert model.prefix(one.observation, compact=False).k.shape[3] == 3 * 256 + 200


@pytest.mark.parametrize("compact", [True, False])
def test_masked_camera_and_padding_change_nothing(compact: bool) -> None:
    model = golden_model("pi05")
    plain = random_observation(0)
    masked = dataclasses.replace(plain, image_mask=torch.tensor([[True, False, True]]))
    images, tokens = masked.images.clone(), masked.tokens.clone()
    images[:, 1] = 255 - images[:, 1]
    tokens[:, 20:] = 7
    other = dataclasses.replace(masked, images=images, tokens=tokens)
    assert torch.equal(
        model.sample(masked, noise(0), STEPS, compact=compact), model.sample(other, noise(0), STEPS, compact=compact)
    )
    assert not torch.equal(model.sample(masked, noise(0), STEPS), model.sample(plain, noise(0), STEPS))


@pytest.mark.parametrize("kind", ["pi05", "pi0"])
def test_a_batch_of_unequal_rows_equals_its_rows(kind: Kind) -> None:
    model = golden_model(kind)
    rows = [random_observation(1, prompt=5), random_observation(2, prompt=31), random_observation(3, prompt=40)]
    rows[1] = dataclasses.replace(rows[1], image_mask=torch.tensor([[True, True, False]]))
    rows[2] = dataclasses.replace(rows[2], image_mask=torch.tensor([[False, True, False]]))
    start = noise(5, batch=3)
    together = model.sample(stack(*rows), start, STEPS)
    for i, row in enumerate(rows):
        torch.testing.assert_close(together[i : i + 1], model.sample(row, start[i : i + 1], STEPS), rtol=0, atol=5e-6)


def test_a_batch_of_equal_masks_needs_no_mask() -> None:
    cache = golden_model("pi05").prefix(stack(random_observation(1), random_observation(2)))
    assert cache.mask is None
    assert cache.k.shape[1] == 2


@pytest.mark.parametrize("cameras", [1, 2, 4])
def test_any_number_of_cameras(cameras: int) -> None:
    model = golden_model("pi05")
    observation = random_observation(4, cameras=cameras)
    compacted = model.sample(observation, noise(1), STEPS)
    torch.testing.assert_close(compacted, model.sample(observation, noise(1), STEPS, compact=False), rtol=0, atol=5e-6)
    assert model.prefix(observation).k.shape[3] == cameras * 256 + 20


@pytest.mark.parametrize("compact", [True, False])
def test_a_prompt_alone_is_enough(compact: bool) -> None:
    blind = dataclasses.replace(random_observation(0), image_mask=torch.zeros(1, 3, dtype=torch.bool))
    model = golden_model("pi05")
    assert model.prefix(blind).k.shape[3] == 20
    padded = model.sample(blind, noise(0), STEPS, compact=False)
    torch.testing.assert_close(model.sample(blind, noise(0), STEPS, compact=compact), padded, rtol=0, atol=5e-6)


@pytest.mark.parametrize("horizon", [1, 7, 50])
@pytest.mark.parametrize("num_steps", [1, 2])
def test_any_horizon_and_number_of_steps(horizon: int, num_steps: int) -> None:
    actions = golden_model("pi05").sample(random_observation(0), noise(0, horizon=horizon), num_steps)
    assert actions.shape == (1, horizon, 32)
    assert actions.dtype == torch.float32
    assert bool(actions.isfinite().all())


def test_the_same_noise_gives_the_same_actions() -> None:
    model, observation = golden_model("pi05"), random_observation(0)
    first = model.sample(observation, noise(0), STEPS)
    assert torch.equal(first, model.sample(observation, noise(0), STEPS))
    assert not torch.equal(first, model.sample(observation, noise(1), STEPS))


def test_uint8_pictures_equal_their_float_form() -> None:
    observation = random_observation(0)
    as_float = dataclasses.replace(observation, images=observation.images.float() / 255 * 2 - 1)
    model = golden_model("pi05")
    assert torch.equal(model.sample(observation, noise(0), 1), model.sample(as_float, noise(0), 1))


def test_an_observation_of_nothing_is_refused() -> None:
    empty = dataclasses.replace(
        random_observation(0), image_mask=torch.zeros(1, 3, dtype=torch.bool), token_mask=torch.zeros(1, 40).bool()
    )
    with pytest.raises(ObservationError, match="without any valid camera or prompt token"):
        golden_model("pi05").prefix(empty)


def test_time_grid_equals_openpis(golden: Path) -> None:
    grids = json.loads((golden / "time/time_grid.json").read_text())
    assert len(grids) >= 25
    for num_steps, expected in grids.items():
        np.testing.assert_array_equal(time_grid(int(num_steps)), np.asarray(expected, dtype=np.float32))


def test_time_embedding_equals_openpis_float64(golden: Path) -> None:
    with np.load(golden / "time/time_embedding.npz") as stored:
        for which in ("nominal", "accumulated"):
            ours = time_embedding(stored[f"t_{which}"], 32)
            np.testing.assert_allclose(ours, stored[f"torch_fp64/sincos32_{which}"], rtol=0, atol=6e-8)
            model = golden_model("pi05")
            np.testing.assert_allclose(
                model.time_condition(ours), stored[f"torch_fp32/cond_{which}"], rtol=0, atol=1e-6
            )
        wide = time_embedding(stored["t_accumulated"], 1024)
        np.testing.assert_allclose(wide, stored["torch_fp32/sincos1024_accumulated"], rtol=0, atol=6e-8)


def test_lerobots_time_grid_multiplies() -> None:
    grid = time_grid(10, "multiplied")
    np.testing.assert_allclose(grid, 1 - np.arange(10) / 10, atol=1e-7)
    assert grid[3] == np.float32(0.7)


def test_attention_folds_heads_like_separate_heads() -> None:
    generator = torch.Generator().manual_seed(0)
    q = torch.randn(2, 8, 5, 16, generator=generator)
    k, v = (torch.randn(2, 2, 9, 16, generator=generator) for _ in range(2))
    mask = torch.rand(2, 1, 5, 9, generator=generator) > 0.3
    mask[..., 0] = True
    expected = torch.nn.functional.scaled_dot_product_attention(
        q, k.repeat_interleave(4, 1), v.repeat_interleave(4, 1), attn_mask=mask
    )
    torch.testing.assert_close(attention(q, k, v, mask), expected, rtol=0, atol=2e-6)
    half = attention(q.bfloat16(), k.bfloat16(), v.bfloat16(), mask).float()
    torch.testing.assert_close(half, expected, rtol=0.02, atol=0.03)


def test_the_full_size_has_openpis_parameter_count() -> None:
    """3.617 B with the expert's unused lm_head [257152, 1024], 3.353 B without."""
    count = sum(int(np.prod(shape)) for shape in parameter_shapes(ModelConfig()).values())
    assert count == pytest.approx(3.353e9, rel=2e-4)
    assert count + 257_152 * 1024 == pytest.approx(3.617e9, rel=2e-4)


def test_parameter_dtypes_follow_openpi() -> None:
    bf16 = {name: parameter_dtype(name, "bf16") for name in parameter_shapes(ModelConfig())}
    float32 = {name for name, dtype in bf16.items() if dtype == torch.float32}
    assert "vision.patch_embedding.weight" in float32
    assert "expert.layers.3.input_layernorm.dense.weight" in float32
    assert "expert.norm.dense.bias" in float32
    assert "action_in_proj.weight" in float32
    assert "vision.layers.0.layer_norm1.weight" not in float32
    assert "vlm.layers.0.self_attn.q_proj.weight" not in float32
    assert "vlm.embed_tokens.weight" not in float32
    assert all(parameter_dtype(name, "f32") == torch.float32 for name in bf16)


def test_two_stacks_that_cannot_share_attention_are_refused() -> None:
    with pytest.raises(ConfigError, match="share one attention, but depth is 18 and 17"):
        ModelConfig(expert=GemmaConfig(width=1024, mlp_dim=4096, depth=17))


def test_a_state_with_a_wrong_name_is_refused() -> None:
    model = golden_model("pi05")
    state = dict(model.state_dict())
    state["surplus"] = state.pop("projector.bias")
    with pytest.raises(RuntimeError, match=r"projector\.bias"):
        Pi0Model.from_state(model.config, state)
