"""The chase's SmolVLA: what is trained is what the reference samples, and the folder is what was trained."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from turbopi.models.smolvla.reference import SmolVLAModel, Trace
from turbopi.policy.policy import UnifiedPolicy
from turbopi.sim import SimSettings, create
from turbopi.sim.chase import Chase
from turbopi_lab.small_policy.chase import HORIZON, Frames, Settings, demonstrations
from turbopi_lab.small_policy.chase_smolvla import NETWORK, SPREAD, SmolVLATrainer, fresh_model, observed, velocity
from turbopi_lab.small_policy.chase_training import train

pytest.importorskip("tokenizers", reason="SmolVLA's prompts need the extra `smolvla`")


@pytest.fixture(scope="module")
def frames() -> Frames:
    return demonstrations(900, seed=0, at_once=15).undelayed()


def lively_model() -> SmolVLAModel:
    model = fresh_model(0).requires_grad_(False)
    model.action_out_proj.weight.normal_(0, 0.1)
    return model


def test_the_velocity_that_is_trained_is_the_one_that_is_sampled_at_all_times(frames: Frames) -> None:
    """Two draws an observation, each at times of its own: as the reference's own steps of its loop are."""
    torch.manual_seed(0)
    model, few = lively_model(), frames.draw(3)
    observation, trace = observed(few.camera_images(48), few.places[:, 2]), Trace()
    model.sample(observation, torch.randn(3, HORIZON, NETWORK.action_dim), 4, trace=trace)
    for first, second in ((0, 3), (2, 1)):
        x = torch.stack((trace["x_t"][first], trace["x_t"][second]), 1).flatten(0, 1)
        found, hidden, there = velocity(model, observation, x, torch.tensor([1 - first / 4, 1 - second / 4]).repeat(3))
        expected = torch.stack((trace["v_t"][first], trace["v_t"][second]), 1).flatten(0, 1)
        assert expected.std() > 0.1
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)
    assert hidden.shape[:2] == (3, 2 * 4 + there.shape[1]) and there.all()


def test_the_loss_is_zero_for_the_velocity_that_leads_to_the_actions(
    frames: Frames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer, few = SmolVLATrainer(Settings(tmp_path, repeats=2)), frames.draw(8)
    actions = torch.zeros(16, HORIZON, NETWORK.action_dim)
    actions[..., :2] = few.chunks.repeat_interleave(2, 0) / torch.tensor(SPREAD["action"][:2])
    hidden, there = torch.zeros(8, 12, trainer.guide_width), torch.ones(8, 4, dtype=torch.bool)

    def leading(batch: Frames, x: Tensor, t: Tensor, held: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        assert not held.any()
        return (x - actions) / t[:, None, None], hidden, there

    monkeypatch.setattr(trainer, "predict", leading)
    assert trainer.losses(few)[0] < 1e-6
    times = [1.0, 0.75, 0.5, 0.25]  # of the reference's loop, from noise to actions
    monkeypatch.setattr(trainer.model, "velocity", lambda x, time, *rest: (x, (x - actions) / times.pop(0)))
    made = trainer.model.sample(observed(*_twice(few)), torch.randn_like(actions), 4)
    torch.testing.assert_close(made, actions, rtol=0, atol=1e-5)


def _twice(few: Frames) -> tuple[Tensor, Tensor]:
    return few.camera_images(48).repeat_interleave(2, 0), few.places[:, 2].repeat_interleave(2, 0)


def test_steps_lower_the_loss_and_the_folder_that_is_opened_without_options_is_what_was_trained(
    frames: Frames, tmp_path: Path
) -> None:
    trainer, few = SmolVLATrainer(Settings(tmp_path, warmup_steps=1)), frames.draw(16)
    losses = []
    for _ in range(8):
        torch.manual_seed(1)
        losses.append(trainer.step(few, 0.0)[0])
    assert losses[-1] < 0.9 * losses[0]
    trainer.export()
    policy = UnifiedPolicy(tmp_path / "checkpoint", precision="f32", device="cpu")
    assert policy.metadata["model"] == "smolvla"
    environment = create("chase").open("chase_post", 0, SimSettings(camera_px=48))
    environment.reset(3)
    world: Chase = environment.world  # type: ignore[attr-defined]
    noise = torch.randn(1, HORIZON, NETWORK.action_dim)
    expected = trainer.sample(trainer.averaged(), world, noise, noise, 0)[0, :, :7]
    found = policy.infer(environment.observation(), noise=noise[0].numpy())["actions"]
    np.testing.assert_allclose(found, expected.numpy(), rtol=0, atol=1e-5)


def test_a_model_that_there_is_not_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="--model is pi05 or smolvla; it is pi0"):
        train(Settings(tmp_path, model="pi0"))
