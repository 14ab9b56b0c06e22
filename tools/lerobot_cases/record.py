"""One case: its checkpoint as LeRobot saves it, and what LeRobot computes once it has loaded that again."""

import hashlib
import json
import lzma
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import peft
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.utils import prepare_observation_for_inference

from lerobot_cases.cases import Case
from lerobot_cases.small import VISION_HEADS, fill, shrink

CONFIGS = {"pi0": PI0Config, "pi05": PI05Config}
BASE = Path("lerobot") / "base"  # what an adapter calls the model that it is for
WEIGHTS = "model.safetensors"
PRESET = lzma.PRESET_EXTREME | 9

shrink()
torch.use_deterministic_algorithms(True)


def record(folder: Path, case: Case) -> None:
    """Make `case` anew in `folder`."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    described: dict[str, Any] = {"kind": case.kind, "vision_heads": VISION_HEADS}
    with _inside(folder):  # an adapter records its base's path as it was given
        config = _config(case)
        checkpoint = Path("checkpoint")
        if case.adapter is None:
            _save_model(case, config, checkpoint)
        else:
            _save_adapter(case, case.adapter, config, checkpoint)
        _save_processors(case, config, checkpoint)
        observations = [observation.made(case.seed + index) for index, observation in enumerate(case.observations)]
        noise = np.random.default_rng(case.seed).standard_normal((config.chunk_size, config.max_action_dim))
        inputs: dict[str, Any] = {"noise": noise.astype(np.float32)}
        for index, observation in enumerate(observations):
            inputs |= {f"{index}/{key}": value for key, value in observation.items()}
        np.savez_compressed("inputs.npz", **inputs)
        runs = case.runs or [{"observation": index, "call": {}} for index in range(len(observations))]
        expected: dict[str, Any] = _expected(checkpoint, observations, inputs["noise"], runs)
        np.savez_compressed("expected.npz", **expected)
        if case.adapter is None:
            described["weights"] = _pack(checkpoint)
        else:
            described["base_weights"] = _pack(BASE)
            BASE.rename("base")
            BASE.parent.rmdir()
        (checkpoint / "README.md").unlink(missing_ok=True)  # the adapter library's empty model card
    described |= {"runs": runs, "config": case.config, "versions": _versions()}
    (folder / "case.json").write_text(json.dumps(described, indent=1) + "\n")


# -- the checkpoint ----------------------------------------------------------------------------------------------------


def _config(case: Case) -> PreTrainedConfig:
    camera_images = {
        f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, 480, 640)) for name in case.cameras
    }
    state_dim = case.config_state_dim or case.state_dim
    config = CONFIGS[case.kind](
        device="cpu",
        input_features=camera_images | {"observation.state": PolicyFeature(FeatureType.STATE, (state_dim,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (case.action_dim,))},
        **({"chunk_size": 10, "n_action_steps": 10} | case.config),
    )
    config.validate_features()
    return config


def _save_model(case: Case, config: PreTrainedConfig, folder: Path) -> None:
    policy = get_policy_class(case.kind)(config)
    fill(policy.named_parameters(), case.weights_seed)
    if case.trained is not None:
        _train(case, case.trained, policy)
    policy.save_pretrained(folder)


def _train(case: Case, pattern: str, policy: Any) -> None:
    """Three steps of AdamW with LeRobot's loss."""
    for name, parameter in policy.named_parameters():
        parameter.requires_grad_(re.search(pattern, name) is not None)
    parameters = [parameter for parameter in policy.parameters() if parameter.requires_grad]
    pre, _ = make_pre_post_processors(policy.config, dataset_stats=case.statistics())
    generator = torch.manual_seed(case.seed)  # the loss draws its noise and times from it, too
    actions = torch.rand(1, policy.config.chunk_size, case.action_dim, generator=generator)
    optimizer = torch.optim.AdamW(parameters, lr=1e-2, weight_decay=0.1)
    for _ in range(3):
        batch = pre(_request(case.observations[0].made(case.seed)) | {"action": actions.clone()})
        loss, _ = policy.forward(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def _save_adapter(case: Case, adapter: dict[str, Any], config: PreTrainedConfig, folder: Path) -> None:
    """As lerobot-train with --peft leaves one: the adapter, and the policy's config.json beside it."""
    _save_model(case, config, BASE)
    policy = get_policy_class(case.kind).from_pretrained(BASE)
    policy.config.pretrained_path = BASE
    wrapped = policy.wrap_with_peft(peft_config=peft.LoraConfig(**adapter))
    trained = [(name, value) for name, value in wrapped.named_parameters() if value.requires_grad]
    fill(trained, case.seed + 1)
    wrapped.save_pretrained(folder)
    policy.config.save_pretrained(folder)


def _save_processors(case: Case, config: PreTrainedConfig, folder: Path) -> None:
    pre, post = make_pre_post_processors(config, dataset_stats=case.statistics())
    if case.rename_map:
        renaming = next(step for step in pre.steps if type(step).__name__ == "RenameObservationsProcessorStep")
        renaming.rename_map = case.rename_map
    pre.save_pretrained(folder)
    post.save_pretrained(folder)


def _pack(folder: Path) -> str:
    """Move a folder's weights to where cases share them; their name there."""
    file = folder / WEIGHTS
    content = file.read_bytes()
    packed = Path("..") / "weights" / f"{hashlib.sha256(content).hexdigest()[:12]}.safetensors.xz"
    packed.parent.mkdir(exist_ok=True)
    packed.write_bytes(lzma.compress(content, preset=PRESET))
    file.unlink()
    return packed.name


# -- what LeRobot computes ---------------------------------------------------------------------------------------------


def _load(folder: Path) -> tuple[Any, Any, Any]:
    """The policy and its pipelines, from disk, as LeRobot's own commands load them."""
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    policy_class = get_policy_class(config.type)
    if config.use_peft:
        adapter = peft.PeftConfig.from_pretrained(str(folder))
        policy = policy_class.from_pretrained(adapter.base_model_name_or_path, config=config)
        policy = peft.PeftModel.from_pretrained(policy, str(folder), config=adapter)
    else:
        policy = policy_class.from_pretrained(folder, config=config)
    policy.eval()
    pre, post = make_pre_post_processors(config, pretrained_path=str(folder))
    return policy, pre, post


def _expected(
    folder: Path, observations: list[dict[str, np.ndarray]], noise: np.ndarray, runs: list[dict[str, Any]]
) -> dict[str, np.ndarray]:
    policy, pre, post = _load(folder)
    inner = policy.get_base_model().model if isinstance(policy, peft.PeftModel) else policy.model
    given = torch.from_numpy(noise)[None]
    inner.sample_noise = lambda shape, device: given.to(device)
    found: dict[str, np.ndarray] = {}
    with torch.no_grad():
        for index, run in enumerate(runs):
            batch = pre(_request(observations[run["observation"]]))
            images, masks = policy._preprocess_images(batch)
            with _seen(inner) as seen:
                normalized = policy.predict_action_chunk(batch, **run["call"])
            ours = {
                "tokens": batch["observation.language.tokens"][0],
                "token_mask": batch["observation.language.attention_mask"][0],
                "normalized_state": batch["observation.state"][0],
                "images": torch.stack([image[0].permute(1, 2, 0)[::8, ::8] for image in images]),
                "image_mask": torch.stack([mask[0] for mask in masks]),
                "keys": seen["keys"],
                "values": seen["values"],
                "v_1": seen["v_1"],
                "normalized_actions": normalized[0],
                "actions": post(normalized)[0],
            }
            found |= {f"{index}/{name}": _array(value) for name, value in ours.items()}
        policy.reset()
        steps = range(policy.config.n_action_steps)
        selected = [post(policy.select_action(pre(_request(observations[0])))) for _ in steps]
        found["selected_actions"] = _array(torch.cat(selected))
    return found


def _request(observation: dict[str, np.ndarray]) -> dict[str, Any]:
    arrays = {key: value for key, value in observation.items() if key != "task"}
    return prepare_observation_for_inference(dict(arrays), torch.device("cpu"), task=str(observation["task"][0]))


@contextmanager
def _seen(model: Any) -> Iterator[dict[str, torch.Tensor]]:
    """The prefix's keys and values [layers, tokens / 16, head_dim] and the first velocity, of what runs inside."""
    seen: dict[str, torch.Tensor] = {}
    inner, denoise, forward = model.paligemma_with_expert, model.denoise_step, model.paligemma_with_expert.forward

    def watched_forward(*args: Any, **kwargs: Any) -> Any:
        outputs, cache = forward(*args, **kwargs)
        if kwargs["inputs_embeds"][1] is None:
            layers = [entry[:2] for entry in cache]
            seen["keys"], seen["values"] = (torch.stack([layer[i][0, 0, ::16] for layer in layers]) for i in (0, 1))
        return outputs, cache

    def watched_denoise(*args: Any, **kwargs: Any) -> torch.Tensor:
        velocity: torch.Tensor = denoise(*args, **kwargs)
        seen.setdefault("v_1", velocity[0])
        return velocity

    inner.forward, model.denoise_step = watched_forward, watched_denoise
    try:
        yield seen
    finally:
        inner.forward, model.denoise_step = forward, denoise


def _array(value: torch.Tensor) -> np.ndarray:
    value = value.detach().cpu()
    return value.float().numpy() if value.is_floating_point() else value.numpy()


def _versions() -> dict[str, str]:
    return {name: version(name) for name in ("lerobot", "transformers", "torch", "peft")}


@contextmanager
def _inside(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)
