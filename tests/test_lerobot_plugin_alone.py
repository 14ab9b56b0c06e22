"""The LeRobot plugin without LeRobot: options, chunks and queues, refusals. Inside LeRobot: test_lerobot_plugin.py."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lerobot_fakes
import pytest
import torch
from lerobot_golden import GOLDEN, GoldenCase

from turbopi.support.errors import ActionError, CheckpointError, ConfigError, ObservationError

TOP, WRIST = "observation.images.top", "observation.images.wrist"
H, D = 10, 32


@pytest.fixture
def modeling(monkeypatch: pytest.MonkeyPatch) -> Any:
    return lerobot_fakes.install(monkeypatch)


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    return GoldenCase(GOLDEN / "mean_std").assemble(tmp_path)


class Model:
    """A policy's model that answers with the noise plus a number that counts its calls."""

    def __init__(self, kind: str = "pi05") -> None:
        self.config = SimpleNamespace(model=SimpleNamespace(kind=kind))
        self.seen: list[tuple[Any, int]] = []
        self.backend = self

    def sample(self, inputs: Any, noise: torch.Tensor, num_steps: int) -> Any:
        self.seen.append((inputs, num_steps))
        return SimpleNamespace(actions=noise + len(self.seen))


def batch(rows: int = 1, /, **changed: Any) -> dict[str, torch.Tensor]:
    mask = torch.zeros(rows, 20, dtype=torch.int64)
    mask[:, :5] = 1
    made: dict[str, Any] = {
        TOP: torch.rand(rows, 3, 224, 224),
        WRIST: torch.rand(rows, 3, 224, 224),
        "observation.state": torch.arange(8.0).expand(rows, 8),
        "observation.language.tokens": torch.arange(20).expand(rows, 20),
        "observation.language.attention_mask": mask,
    }
    return {key: value for key, value in (made | changed).items() if value is not None}


def made(modeling: Any, checkpoint: Path, model: Any = None, **options: Any) -> tuple[Any, Any]:
    model = model or Model()
    config = modeling.TurboPiConfig(checkpoint=str(checkpoint), warmup=False, **options)
    return modeling.TurboPiPolicy(config, turbopi=model), model


def test_the_package_has_the_name_that_lerobot_looks_for() -> None:
    found = re.search(r'^name = "(\w+)"', (lerobot_fakes.PLUGIN.parent / "pyproject.toml").read_text(), re.MULTILINE)
    assert found is not None
    name = found[1]
    assert name.startswith("lerobot_policy_") and (lerobot_fakes.PLUGIN / name / "__init__.py").is_file()


def test_lerobot_finds_policy_and_processors_by_their_names(modeling: Any) -> None:
    """LeRobot's rule: configuration_x.XConfig, modeling_x.XPolicy, processor_x.make_{type}_pre_post_processors."""
    config = modeling.TurboPiConfig
    assert lerobot_fakes.PreTrainedConfig.types["turbopi"].__name__ == config.__name__ == "TurboPiConfig"
    assert config.__module__.replace("configuration_", "modeling_") == modeling.TurboPiPolicy.__module__
    processors = lerobot_fakes.PLUGIN / "lerobot_policy_turbopi" / "processor_turbopi.py"
    assert "def make_turbopi_pre_post_processors(" in processors.read_text()


def test_what_no_option_says_is_the_checkpoints(modeling: Any, checkpoint: Path) -> None:
    config = modeling.TurboPiConfig(checkpoint=str(checkpoint))
    described = json.loads((checkpoint / "config.json").read_text())
    assert (config.chunk_size, config.n_action_steps) == (described["chunk_size"], described["n_action_steps"])
    assert config.num_inference_steps == described["num_inference_steps"]
    assert list(config.image_features) == [TOP, WRIST] and config.output_features["action"].shape == (7,)
    assert config.pretrained_path == checkpoint
    given = modeling.TurboPiConfig(checkpoint=str(checkpoint), n_action_steps=3, num_inference_steps=2)
    assert (given.n_action_steps, given.num_inference_steps) == (3, 2)


def test_a_chunk_is_the_models_answer_as_wide_as_the_robots_actions(modeling: Any, checkpoint: Path) -> None:
    policy, model = made(modeling, checkpoint)
    given, noise = batch(), torch.randn(1, H, D)
    chunk = policy.predict_action_chunk(given, noise=noise, num_steps=4)
    torch.testing.assert_close(chunk, noise[..., :7] + 1)
    inputs, steps = model.seen[0]
    assert steps == 4
    torch.testing.assert_close(inputs.images[0, 1], given[WRIST][0].permute(1, 2, 0) * 2 - 1)
    assert inputs.image_mask.tolist() == [[True, True]] and inputs.token_mask.sum() == 5
    assert not inputs.state.any()  # Pi0.5 has it in the prompt


def test_pi0_reads_the_padded_state(modeling: Any, checkpoint: Path) -> None:
    policy, model = made(modeling, checkpoint, Model("pi0"))
    policy.predict_action_chunk(batch())
    assert model.seen[0][0].state[0].tolist() == [*range(8), *[0.0] * 24]


def test_a_missing_camera_is_left_out(modeling: Any, checkpoint: Path) -> None:
    policy, model = made(modeling, checkpoint)
    policy.predict_action_chunk(batch(1, **{TOP: None}))
    assert model.seen[0][0].images.shape == (1, 1, 224, 224, 3)


def test_the_same_seed_of_pytorch_gives_the_same_noise(modeling: Any, checkpoint: Path) -> None:
    chunks, given = [], batch()
    for _ in range(2):
        policy, _ = made(modeling, checkpoint)
        torch.manual_seed(5)
        chunks.append(policy.predict_action_chunk(given))
    assert torch.equal(*chunks)
    torch.manual_seed(5)
    assert torch.equal(chunks[0], torch.normal(0.0, 1.0, (1, H, D))[..., :7] + 1)


def test_actions_come_one_by_one_until_n_action_steps_are_used(modeling: Any, checkpoint: Path) -> None:
    policy, model = made(modeling, checkpoint, n_action_steps=3)
    noise = torch.randn(2, H, D)
    actions = [policy.select_action(batch(2), noise=noise) for _ in range(7)]
    torch.testing.assert_close(torch.stack(actions[:3]), noise[:, :3, :7].transpose(0, 1) + 1)
    torch.testing.assert_close(actions[3], noise[:, 0, :7] + 2)
    assert len(model.seen) == 3
    policy.reset()
    torch.testing.assert_close(policy.select_action(batch(2), noise=noise), noise[:, 0, :7] + 4)


def test_dropping_queued_actions_looks_at_the_next_observation(modeling: Any, checkpoint: Path) -> None:
    """LeRobot's main branch calls it when the task changes within an episode."""
    policy, model = made(modeling, checkpoint, n_action_steps=3)
    policy.select_action(batch())
    policy.drop_queued_actions()
    policy.select_action(batch())
    assert len(model.seen) == 2


def test_what_is_saved_has_all_that_the_processors_name(modeling: Any, checkpoint: Path, tmp_path: Path) -> None:
    (checkpoint / "tokenizer").mkdir()
    (checkpoint / "tokenizer" / "tokenizer.json").write_text("{}")
    file = checkpoint / "policy_preprocessor.json"
    content = json.loads(file.read_text())
    content["steps"][-1]["artifacts"] = {"tokenizer_name": "tokenizer"}
    file.write_text(json.dumps(content))
    policy, _ = made(modeling, checkpoint)
    (tmp_path / "saved").mkdir()
    policy._save_pretrained(tmp_path / "saved")
    policy._save_pretrained(tmp_path / "saved")  # over what is there
    assert (tmp_path / "saved" / "tokenizer" / "tokenizer.json").read_text() == "{}"
    assert (tmp_path / "saved" / "policy_postprocessor.json").is_file()
    content["steps"][-1]["artifacts"] = {"tokenizer_name": "../tokenizer"}
    file.write_text(json.dumps(content))
    with pytest.raises(CheckpointError, match="which isn't in"):
        policy._save_pretrained(tmp_path / "saved")


def test_training_is_refused(modeling: Any, checkpoint: Path) -> None:
    policy, _ = made(modeling, checkpoint)
    for call in (lambda: policy.forward(batch()), policy.get_optim_params, policy.config.get_optimizer_preset):
        with pytest.raises(NotImplementedError, match=r"train with --policy\.type=pi05"):
            call()


def test_bad_batches_are_refused_by_what_they_lack(modeling: Any, checkpoint: Path) -> None:
    policy, _ = made(modeling, checkpoint)
    with pytest.raises(ObservationError, match=r"none of the checkpoint's cameras, observation\.images\.top"):
        policy.predict_action_chunk(batch(1, **{TOP: None, WRIST: None}))
    with pytest.raises(ObservationError, match=r"no 'observation\.language\.tokens'.*Preprocess it first"):
        policy.predict_action_chunk(batch(1, **{"observation.language.tokens": None}))


def test_actions_that_are_not_finite_are_refused(modeling: Any, checkpoint: Path) -> None:
    policy, _ = made(modeling, checkpoint)
    with pytest.raises(ActionError, match="aren't finite"):
        policy.predict_action_chunk(batch(), noise=torch.full((1, H, D), torch.nan))


def test_checkpoints_and_options_that_cannot_be_are_refused(modeling: Any, checkpoint: Path) -> None:
    config = modeling.TurboPiConfig
    with pytest.raises(ConfigError, match=r"needs --policy\.checkpoint"):
        modeling.TurboPiPolicy(config())
    with pytest.raises(ConfigError, match="n_action_steps is 11; it should be from 1 to the chunk's 10"):
        config(checkpoint=str(checkpoint), n_action_steps=11)
    with pytest.raises(ConfigError, match="n_action_steps is 0"):
        config(checkpoint=str(checkpoint), n_action_steps=0)
    described = json.loads((checkpoint / "config.json").read_text())
    (checkpoint / "config.json").write_text(json.dumps(described | {"type": "act"}))
    with pytest.raises(CheckpointError, match="type 'act'; Turbo-Pi runs 'pi05' and 'pi0'"):
        config(checkpoint=str(checkpoint))
    with pytest.raises(CheckpointError, match="neither a folder nor a name on the hub"):
        modeling.local_folder(SimpleNamespace(checkpoint="/no/such/folder", pretrained_revision=None))


def test_turbopi_itself_runs_behind_it(modeling: Any, checkpoint: Path) -> None:
    """A loaded and warm policy, and the model's own refusal of noise of another shape."""
    config = modeling.TurboPiConfig(checkpoint=str(checkpoint), backend="pytorch", precision="f32")
    policy = modeling.TurboPiPolicy(config)
    assert policy.predict_action_chunk(batch(2)).shape == (2, H, 7)
    with pytest.raises(ObservationError, match=r"noise has shape \[1, 10, 7\], but .* \[1, 10, 32\]"):
        policy.predict_action_chunk(batch(), noise=torch.zeros(1, H, 7))
    with pytest.raises(ObservationError, match="number of denoising steps is 0"):
        policy.predict_action_chunk(batch(), num_steps=0)
