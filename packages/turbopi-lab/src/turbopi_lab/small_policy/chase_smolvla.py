"""A SmolVLA of the chase: chase.py's data and training, the reference's own modules, and a folder in LeRobot's layout.

    python -m turbopi_lab.small_policy chase --model smolvla --out work/smolvla

Its loss is LeRobot's: x at time t is t * noise + (1 - t) * actions, t is 1 at noise and Beta(1.5, 1), the velocity is
noise - actions, and state and actions are scaled by mean and deviation, zeros up to 32 numbers. As in chase.py the
dimensions that do nothing weigh less. It holds no actions: LeRobot has no SmolVLA trained with delays.
"""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from turbopi.models.observation import Observation
from turbopi.models.smolvla.config import from_lerobot
from turbopi.models.smolvla.names import native_name
from turbopi.models.smolvla.reference import EmbeddedPrefix, SmolVLAModel
from turbopi.sim.chase import INSTRUCTION, Chase
from turbopi_lab.small_policy.chase import HORIZON, Frames, Trainer, see_dots
from turbopi_lab.small_policy.start import initial

_PX = 48
_WORDS = ("<unknown>", *INSTRUCTION.split())
SPREAD = {"observation.state": (0.38, 0.38, *[1.0] * 6), "action": (0.52, 0.52, *[1.0] * 5)}  # deviations; means are 0
CONFIG: dict[str, Any] = {
    "type": "smolvla",
    "input_features": {
        **{f"observation.images.{name}": {"type": "VISUAL", "shape": [3, _PX, _PX]} for name in ("image", "wrist")},
        "observation.state": {"type": "STATE", "shape": [8]},
    },
    "output_features": {"action": {"type": "ACTION", "shape": [7]}},
    "normalization_mapping": {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"},
    "chunk_size": HORIZON,
    "n_action_steps": 5,
    "resize_imgs_with_padding": [_PX, _PX],
    "tokenizer_max_length": 16,
    "num_steps": 10,
    "vlm_model_name": "vlm",  # a folder beside it
    "num_vlm_layers": 3,
    "expert_width_multiplier": 1.0,
    "rtc_config": {  # LeRobot's defaults
        "enabled": True,
        "prefix_attention_schedule": "LINEAR",
        "max_guidance_weight": 10.0,
        "execution_horizon": 10,
    },
}
VLM: dict[str, Any] = {
    "scale_factor": 3,
    "text_config": {
        "hidden_size": 64,
        "intermediate_size": 128,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "head_dim": 16,
        "vocab_size": len(_WORDS),
        "torch_dtype": "float32",
    },
    "vision_config": {
        "hidden_size": 48,
        "intermediate_size": 96,
        "num_hidden_layers": 1,
        "num_attention_heads": 3,
        "image_size": _PX,
        "patch_size": 8,
    },
}
NETWORK = from_lerobot(CONFIG, VLM)
TOKENIZER = {
    "version": "1.0",
    "added_tokens": [],
    "pre_tokenizer": {"type": "WhitespaceSplit"},
    "model": {"type": "WordLevel", "vocab": {word: at for at, word in enumerate(_WORDS)}, "unk_token": _WORDS[0]},
}


class SmolVLATrainer(Trainer):
    """As `Trainer`. The guide reads the values of all text layers: what the expert gets of the prefix."""

    image_size = _PX
    holds = False

    def fresh(self) -> SmolVLAModel:
        return fresh_model(self.settings.seed)

    @property
    def guide_width(self) -> int:
        return NETWORK.text.depth * NETWORK.text.num_kv_heads * NETWORK.text.head_dim

    def scaled(self, chunks: Tensor) -> Tensor:
        return chunks / chunks.new_tensor(SPREAD["action"][: chunks.shape[-1]])

    def predict(self, batch: Frames, x: Tensor, t: Tensor, held: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        images = batch.camera_images(_PX)
        return velocity(self.model, observed(images, batch.places[:, 2]), x, t)

    def averaged(self) -> SmolVLAModel:
        return SmolVLAModel.from_state(NETWORK, dict(self.average))

    def sample(self, model: Any, world: Chase, noise: Tensor, given: Tensor, delay: int) -> Tensor:
        images, tips = (torch.from_numpy(one).to(self.device) for one in (world.draw(_PX), world.tip))
        actions: Tensor = model.sample(observed(images, tips.float()), noise, CONFIG["num_steps"])
        actions[..., :7] *= actions.new_tensor(SPREAD["action"])
        return actions

    def export(self) -> None:
        folder = self.settings.out / "checkpoint"
        _write(folder / "config.json", CONFIG)
        _write(folder / CONFIG["vlm_model_name"] / "config.json", VLM)
        _write(folder / "tokenizer/tokenizer.json", TOKENIZER)
        _write(folder / "turbopi.json", {"robot": "libero"})
        statistics = {f"{key}.std": torch.tensor(one) for key, one in SPREAD.items()}
        statistics |= {f"{key}.mean": torch.zeros(len(one)) for key, one in SPREAD.items()}
        for stem, steps in _pipelines().items():
            _write(folder / f"{stem}.json", {"name": stem, "steps": steps})
            for file in (step["state_file"] for step in steps if "state_file" in step):
                save_file(statistics, folder / file)
        weights = {f"model.{native_name(name)}": one.cpu().contiguous() for name, one in self.average.items()}
        save_file(weights, folder / "model.safetensors")


def fresh_model(seed: int) -> SmolVLAModel:
    """A model to train, float32 on the CPU, as `start.fresh_model`; images weigh as much as words in the prefix."""
    generator = torch.Generator().manual_seed(seed)
    model = SmolVLAModel(NETWORK)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if parameter.ndim == 1 and "norm" in name and name.endswith("weight"):
                parameter.fill_(1)
            else:
                parameter.copy_(initial(name, parameter, NETWORK.vision, NETWORK.text.depth, generator))
        model.projector.weight /= NETWORK.text.width**0.5
    see_dots(model.vision)
    return model.requires_grad_(True)


def observed(images: Tensor, tips: Tensor) -> Observation:
    """Images (uint8|float32)[N, 2, px, px, 3] and tips float32[N, 2], with the instruction."""
    tokens = torch.arange(1, len(_WORDS), device=images.device).expand(len(images), -1)
    state = torch.zeros(len(images), NETWORK.state_dim, device=images.device)
    state[:, :2] = tips / tips.new_tensor(SPREAD["observation.state"][:2])
    there = tokens.new_ones(images.shape[:2], dtype=torch.bool)
    return Observation(images, there, tokens, torch.ones_like(tokens, dtype=torch.bool), state)


def velocity(model: SmolVLAModel, observation: Observation, x: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """As `Trainer.predict`, by the reference's parts, with gradients; R draws of noise and time an observation."""
    embedded = model.embed_prefix(observation)
    k, v, _ = model.encode_prefix(embedded)
    repeats = len(x) // len(observation.state)
    rows = (one.repeat_interleave(repeats, 0) for one in (embedded.embs, embedded.valid, embedded.block))
    cache = model.cache_of(EmbeddedPrefix(*rows), *(one.repeat_interleave(repeats, 1) for one in (k, v)))
    times = model.embed_times(t.cpu().numpy())[:, None].to(x.device)
    _, predicted = model.velocity(x, times, cache, model.cross_keys_values(cache))
    behind = observation.tokens.shape[1] + 1  # the state is behind the prompt
    return predicted, v.permute(1, 3, 0, 2, 4).flatten(2), embedded.valid[:, -behind:]


def _pipelines() -> dict[str, list[dict[str, Any]]]:
    """The steps of both processors, as LeRobot's main saves them."""
    features = {**CONFIG["input_features"], **CONFIG["output_features"]}

    def scaling(name: str, of: dict[str, Any], file: str) -> dict[str, Any]:
        settings = {"eps": 1e-8, "features": of, "norm_map": CONFIG["normalization_mapping"]}
        return {"registry_name": name, "config": settings, "state_file": f"{file}_{name}.safetensors"}

    named = {"tokenizer_name": "tokenizer"}
    reading = {"max_length": CONFIG["tokenizer_max_length"], "padding_side": "right", "padding": "longest", **named}
    before = [
        {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}},
        {"registry_name": "to_batch_processor", "config": {}},
        {"registry_name": "smolvla_new_line_processor", "config": {}},
        {"registry_name": "tokenizer_processor", "config": reading, "artifacts": named},
        {"registry_name": "device_processor", "config": {"device": "cpu"}},
        scaling("normalizer_processor", features, "policy_preprocessor_step_5"),
    ]
    after = [
        scaling("unnormalizer_processor", CONFIG["output_features"], "policy_postprocessor_step_0"),
        {"registry_name": "device_processor", "config": {"device": "cpu"}},
    ]
    return {"policy_preprocessor": before, "policy_postprocessor": after}


def _write(file: Path, content: dict[str, Any]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
