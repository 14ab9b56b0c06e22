"""The tool that made the small policy: it trains the model that is run, and exports what it trained."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_policy.collect import HORIZON, Episode, _Frame
from small_policy.expert import rotation_between
from small_policy.export import CONFIG, export
from small_policy.forward import Guide, draw_times, flow_loss, time_embedding, velocity
from small_policy.scenes import INSTRUCTIONS, OTHER_PROMPT, TRAINING_STATES, VALIDATION_STATES, Setting
from small_policy.start import fresh_model
from small_policy.train import Settings, Trainer, prompt_table, toy_memory
from torch import Tensor

from turbopi.backends.pytorch import reference_model
from turbopi.model import denoise
from turbopi.model.reference import Pi0Model
from turbopi.observation import Observation
from turbopi.policy import UnifiedPolicy
from turbopi.shipped import SMALL_POLICY

STATS = SMALL_POLICY / "assets" / "turbopi" / "libero_spatial" / "norm_stats.json"


def inputs(batch: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rng = np.random.default_rng(0)
    images = torch.from_numpy(rng.integers(0, 256, (batch, 2, 224, 224, 3), np.uint8))
    tokens, masks = prompt_table()
    return images, tokens[[2, 4, 0][:batch]], masks[[2, 4, 0][:batch]], torch.randn(batch, HORIZON, 32)


def lively_model() -> Pi0Model:
    """Fresh weights, but none of those that start at zero."""
    model = fresh_model(CONFIG.model, 0).requires_grad_(False)
    for name, parameter in model.named_parameters():
        if name.startswith("action_out_proj") or ".dense." in name:
            parameter.normal_(0, 0.1)
    return model


def reference_velocity(model: Pi0Model, observation: Observation, x_t: Tensor, t: float) -> Tensor:
    cache = model.prefix(observation)
    rope = denoise.suffix_rope(cache, HORIZON, model.config.expert.head_dim, model.config.rope_base)
    mask = denoise.suffix_mask(cache, HORIZON, False)
    cond = model.time_condition(denoise.time_embedding(np.array([t], np.float32), model.config.expert.width))
    return model.velocity(x_t, cache.state, cond, cache.k, cache.v, rope, mask)[1]


def test_the_training_forward_is_the_reference_and_so_is_each_repeated_draw() -> None:
    torch.manual_seed(0)
    model, (images, tokens, masks, x_t) = lively_model(), inputs(3)
    observation = Observation(images, torch.ones(3, 2, dtype=torch.bool), tokens, masks, torch.zeros(3, 32))
    expected = reference_velocity(model, observation, x_t, 0.7)
    assert expected.std() > 0.1
    found, hidden = velocity(model, images, tokens, masks, x_t, torch.full((3,), 0.7))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-4)
    assert hidden.shape == (3, 512 + tokens.shape[1], CONFIG.model.vlm.width)
    others = torch.randn_like(x_t)
    both = torch.stack((x_t, others), dim=1).flatten(0, 1)
    times = torch.tensor([0.7, 0.2]).repeat(3)
    repeated, _ = velocity(model, images, tokens, masks, both, times)
    torch.testing.assert_close(repeated[::2], expected, rtol=0, atol=1e-4)
    torch.testing.assert_close(repeated[1::2], reference_velocity(model, observation, others, 0.2), rtol=0, atol=1e-4)


def test_the_time_embedding_is_the_models() -> None:
    times = np.array([0.001, 0.3, 1.0], np.float32)
    torch.testing.assert_close(
        time_embedding(torch.from_numpy(times), 128), denoise.time_embedding(times, 128), rtol=0, atol=1e-6
    )


def test_times_are_beta_distributed() -> None:
    times = draw_times(200_000, "cpu", torch.Generator().manual_seed(0))
    assert times.min() >= 0.001
    assert times.max() <= 1
    unscaled = (times - 0.001) / 0.999
    assert unscaled.mean().item() == pytest.approx(1.5 / 2.5, abs=0.003)  # Beta(a, 1): a / (a + 1)
    assert unscaled.var().item() == pytest.approx(1.5 / (2.5**2 * 3.5), abs=0.002)


def test_the_loss_weighs_dimensions() -> None:
    weights = torch.tensor([1.0, 0.0, 3.0])
    error = torch.tensor([[[2.0, 100.0, 1.0]]])
    assert flow_loss(error, torch.zeros_like(error), weights).item() == pytest.approx((4 + 3) / 4)


@pytest.fixture(scope="module")
def trainer(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    folder = tmp_path_factory.mktemp("run")
    settings = Settings(folder, STATS, device="cpu", compile=False, batch=4, repeats=2, warmup_steps=1)
    return Trainer(dataclasses.replace(settings, learning_rate=3e-3))


def test_a_few_steps_on_a_few_frames_lower_the_loss_and_the_export_is_what_was_trained(
    trainer: Trainer, tmp_path: Path
) -> None:
    memory = toy_memory(2, trainer.device)
    batch = memory.batch(torch.arange(2))
    losses = []
    for _ in range(12):
        torch.manual_seed(1)  # the same noise, times and changes of the pictures: only learning is left
        losses.append(float(trainer.step(batch, 0.0)["flow"]))
    assert losses[-1] < 0.9 * losses[0]

    state = {name: value.detach() for name, value in trainer.model.state_dict().items()}
    folder = export(state, trainer.stats, tmp_path / "checkpoint", "f32")
    policy = UnifiedPolicy(folder, backend="pytorch", precision="f32", device="cpu")
    example = policy.example_observation() | {"prompt": INSTRUCTIONS[4]}
    prepared = policy.prepare(example)
    observation = Observation.stack([prepared])
    torch.manual_seed(2)
    x_t = torch.randn(1, HORIZON, 32)
    tokens, masks = prompt_table()
    with torch.no_grad():
        trained, _ = velocity(
            trainer.model, observation.images[:, :2], tokens[4:5], masks[4:5], x_t, torch.tensor([0.5])
        )
    loaded = reference_velocity(reference_model(policy.backend), observation, x_t, 0.5)
    torch.testing.assert_close(loaded, trained, rtol=0, atol=1e-4)
    assert json.loads((folder / "turbopi.json").read_text())["discrete_state_input"] is False


def test_the_guide_reads_the_prefix_and_not_the_padding() -> None:
    torch.manual_seed(0)
    guide, hidden = Guide(192, 14, 7), torch.randn(2, 512 + 24, 192)
    mask = torch.zeros(2, 24, dtype=torch.bool)
    mask[:, :16] = True
    values, logits = guide(hidden, mask)
    assert (values.shape, logits.shape) == ((2, 14), (2, 7))
    hidden[:, 512 + 16 :] = 1e3
    torch.testing.assert_close(guide(hidden, mask)[0], values)
    hidden[:, 100] += 1
    assert not torch.allclose(guide(hidden, mask)[0], values)


def episode(by_expert: str, success: bool) -> Episode:
    """One character a step: e for the expert, l for the learner; a frame at every step; labels count up."""
    made: Any = Episode(Setting(0, 0))
    made.labels = [np.full(7, float(step)) for step in range(len(by_expert))]
    made.by_expert = [who == "e" for who in by_expert]
    made.success = success
    made.frames = [_Frame(step, np.zeros(0), None, "reach", np.zeros(8)) for step in range(len(by_expert))]  # type: ignore[arg-type]
    return made


def test_only_what_the_expert_followed_up_itself_is_labelled() -> None:
    turns = episode("llll" + "e" * 12 + "ll" + "e" * 3, success=False)
    assert [step for step in range(21) if turns._followed(step)] == [4, 5, 6]
    solved = episode("l" + "e" * 12, success=True)
    assert [step for step in range(13) if solved._followed(step)] == list(range(1, 13))
    np.testing.assert_array_equal(solved._chunk(9)[:, 0], [9, 10, 11, 12, 12, 12, 12, 12, 12, 12])
    assert not episode("e" * 160, success=False).useful


def test_the_states_that_results_are_measured_on_are_never_trained_on() -> None:
    assert not set(TRAINING_STATES) & set(range(25, 50))
    assert not set(VALIDATION_STATES) & set(range(30, 50))


def test_the_other_bowl_has_another_tasks_prompt() -> None:
    assert Setting(0, 0).prompt == 0
    assert Setting(0, 0, other_bowl=True).prompt == 1
    assert all(scene != prompt for scene, prompt in OTHER_PROMPT.items())
    assert len(OTHER_PROMPT) == len(INSTRUCTIONS) == 10


def test_a_rotation_takes_one_orientation_to_the_other() -> None:
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(rotation_between(np.eye(3), quarter), [0, 0, np.pi / 2], atol=1e-12)
    np.testing.assert_array_equal(rotation_between(quarter, quarter), np.zeros(3))
