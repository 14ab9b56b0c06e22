"""SmolVLA's reference against what LeRobot's own code computed, and each trap of its arithmetic."""

import dataclasses
import json
import lzma
import math
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load

from turbopi.models.pi0.conditioning import (
    Conditioning,
    Guidance,
    TokenTimes,
    guidance_strength,
    lerobot_guidance_weights,
)
from turbopi.models.pi0.layers import apply_rope, rope_tables
from turbopi.models.smolvla import reference
from turbopi.models.smolvla.config import ElementTypes, SmolVLAConfig, from_lerobot
from turbopi.models.smolvla.names import canonical_name, parameter_dtype
from turbopi.models.smolvla.preprocess import images_of
from turbopi.models.smolvla.reference import SmolVLAInputs, SmolVLAModel
from turbopi.support.errors import ObservationError

GOLDEN = Path(__file__).parent / "golden_smolvla"
RUNS = {"base": 5, "bf16": 2, "missing_camera": 4, "rtc": 7, "special_tokens": 1}
SCHEDULES: Any = {"LINEAR": "linear", "EXP": "exponential", "ONES": "ones", "ZEROS": "zeros"}
ACTIONS, OTHERS = 2e-5, 1e-4  # relative rms in float32; seen: 3e-6 and 6e-6
BFLOAT16 = 1e-6  # the same operations in the same order; seen: 7e-9


class Case:
    """A golden case, its model in the checkpoint's own element types."""

    def __init__(self, name: str) -> None:
        folder = GOLDEN / name
        self.described = json.loads((folder / "case.json").read_text())
        self.lerobot = json.loads((folder / "checkpoint/config.json").read_text())
        vlm = json.loads((GOLDEN / "hub" / self.described["vlm"]["name"] / "config.json").read_text())
        ids = {key: self.described["vlm"][key] for key in ("image_start_token_ids", "image_end_token_ids")}
        self.config = from_lerobot(self.lerobot, vlm | ids)
        self.stored = load(lzma.decompress((folder / "model.safetensors.xz").read_bytes()))
        self.inputs = dict(np.load(folder / "inputs.npz"))
        self.expected = dict(np.load(folder / "expected.npz"))

    def model(self, config: SmolVLAConfig) -> SmolVLAModel:
        names = {name: canonical_name(name, config) for name in self.stored}
        state = {ours: self.stored[name].to(parameter_dtype(ours, config)) for name, ours in names.items() if ours}
        return SmolVLAModel.from_state(config, state)

    def observation(self, run: int) -> dict[str, np.ndarray]:
        prefix = f"{self.described['runs'][run]['observation']}/"
        return {key.removeprefix(prefix): value for key, value in self.inputs.items() if key.startswith(prefix)}

    def prepared(self, run: int) -> SmolVLAInputs:
        cameras = [name for name, one in self.lerobot["input_features"].items() if one["type"] == "VISUAL"]
        size, empty = self.lerobot["resize_imgs_with_padding"], self.lerobot["empty_cameras"]
        images, mask = images_of(self.observation(run), cameras, size, empty)
        of = run if f"{run}/tokens" in self.expected else 0
        tokens, token_mask = self.expected[f"{of}/tokens"], self.expected[f"{of}/token_mask"]
        state = self.expected[f"{of}/normalized_state"]
        state = np.pad(state, (0, self.config.state_dim - len(state)))
        rows = (torch.from_numpy(array)[None] for array in (tokens, token_mask, state))
        return SmolVLAInputs(images[None], mask[None], *rows)

    def conditioning(self, run: int) -> Conditioning | None:
        rtc = self.described["runs"][run].get("rtc")
        if rtc is None or rtc["prev_rows"] == 0:
            return None
        horizon, rows, steps = self.config.action_horizon, rtc["prev_rows"], self.config.num_steps
        left_over = self.inputs["previous"][-rows:]
        target = np.pad(left_over, ((0, horizon - rows), (0, self.config.action_dim - left_over.shape[1])))
        schedule = SCHEDULES[rtc["schedule"]]
        weights = lerobot_guidance_weights(horizon, rtc["inference_delay"], rtc["execution_horizon"], rows, schedule)
        times = np.repeat(1 - np.arange(steps)[:, None] / steps, horizon, 1)
        strength = guidance_strength(times, rtc["max_guidance_weight"])
        return Conditioning(guidance=Guidance(target, weights, strength, "identity"))

    def computed(self, run: int, config: SmolVLAConfig) -> dict[str, np.ndarray]:
        trace: reference.Trace = {}
        inputs, noise = self.prepared(run), torch.from_numpy(self.inputs["noise"])[None]
        actions = self.model(config).sample(inputs, noise, conditioning=self.conditioning(run), trace=trace)
        width = self.expected[f"{run}/normalized_actions"].shape[1]
        ours = {
            name: (value if name == "image_embeddings" else value[0]).float().numpy() for name, value in trace.items()
        }
        ours["images_sampled"] = inputs.images[0, ..., ::8, ::8].numpy()
        return ours | {"normalized_actions": actions[0, :, :width].numpy()}

    def differences(self, run: int, config: SmolVLAConfig, part: str = "") -> dict[str, float]:
        """Relative rms by name, of all that this run has and the trace does."""
        ours, begin = self.computed(run, config), f"{run}/{part}"
        theirs = {name.removeprefix(begin): value for name, value in self.expected.items() if name.startswith(begin)}
        return {name: relative(ours[name], value) for name, value in theirs.items() if name in ours}


def relative(ours: np.ndarray, theirs: np.ndarray) -> float:
    if ours.shape != theirs.shape:
        return np.inf
    exact = theirs.astype(np.float64)
    return float(np.sqrt(np.square(ours - exact).mean() / max(np.square(exact).mean(), 1e-12)))


@cache
def case(name: str) -> Case:
    return Case(name)


def beyond(differences: Mapping[str, float]) -> dict[str, float]:
    bounds = {name: ACTIONS if "actions" in name else OTHERS for name in differences}
    return {name: found for name, found in differences.items() if not found <= bounds[name]}


@pytest.mark.parametrize(("name", "run"), [(name, run) for name, runs in RUNS.items() for run in range(runs)])
def test_float32_equals_lerobot(name: str, run: int) -> None:
    one = case(name)
    if name == "bf16":
        differences = one.differences(run, dataclasses.replace(one.config, element_types=ElementTypes()), "float32/")
    else:
        differences = one.differences(run, one.config)
        assert run or differences.keys() >= {"prefix", "positions", "keys_0", "values_3", "images_sampled"}
    assert differences.keys() >= {"v_first", "v_last", "normalized_actions"}
    assert beyond(differences) == {}


@pytest.mark.parametrize("run", [0, 1])
def test_the_element_types_of_the_config_give_lerobots_own_rounding(run: int) -> None:
    one = case("bf16")
    assert max(one.differences(run, one.config).values()) <= BFLOAT16


def test_element_types_are_the_configs_and_not_the_files() -> None:
    config = case("bf16").config
    dtypes = {parameter_dtype(name, config) for name in SmolVLAModel(config).state_dict()}
    assert dtypes == {torch.float32, torch.bfloat16}
    assert parameter_dtype("expert_layers.1.self_attn.k_proj.weight", config) == torch.float32  # a cross layer's
    assert parameter_dtype("expert_layers.0.self_attn.k_proj.weight", config) == torch.bfloat16
    assert parameter_dtype("state_proj.weight", config) == torch.float32
    text_alone = from_lerobot({}, _published_vlm())
    assert text_alone.element_types == ElementTypes("float32", "bfloat16")


def test_the_published_sizes_are_the_defaults() -> None:
    config = dataclasses.replace(from_lerobot({}, _published_vlm()), element_types=ElementTypes())
    assert config == SmolVLAConfig()
    with torch.device("meta"):
        model = SmolVLAModel(config)
    numbers = sum(parameter.numel() for parameter in model.parameters())
    assert numbers == 450_046_176 - 49_280 * 960 - 960  # lm_head and the text model's final norm are unused


def _published_vlm() -> dict[str, Any]:
    text = {"hidden_size": 960, "intermediate_size": 2560, "num_attention_heads": 15, "num_key_value_heads": 5}
    vision = {"hidden_size": 768, "intermediate_size": 3072, "num_hidden_layers": 12, "num_attention_heads": 12}
    return {
        "scale_factor": 4,
        "text_config": text | {"head_dim": 64, "vocab_size": 49_280, "torch_dtype": "bfloat16"},
        "vision_config": vision | {"image_size": 512, "patch_size": 16},
    }


def _fall_into(trap: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if trap == "the text config's RoPE base":
        monkeypatch.setattr(reference, "ROPE_BASE", 100_000.0)
    elif trap == "cross keys are rotated twice":
        right = SmolVLAModel.cross_keys_values

        def rotated(self: SmolVLAModel, cache: reference.PrefixCache) -> Any:
            positions = torch.arange(cache.keys[0].shape[2])[None]
            rope = rope_tables(positions, self.config.text.head_dim, reference.ROPE_BASE)
            return right(self, dataclasses.replace(cache, keys=[apply_rope(k, *rope) for k in cache.keys]))

        monkeypatch.setattr(SmolVLAModel, "cross_keys_values", rotated)
    elif trap == "actions see later ones":
        masked = reference.attention

        def unmasked(q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
            return masked(q, k, v, mask if q.shape[2] > 10 else torch.ones_like(mask))

        monkeypatch.setattr(reference, "attention", unmasked)
    else:
        assert trap == "the prompt isn't scaled"
        monkeypatch.setattr(math, "sqrt", lambda width: 1.0)


@pytest.mark.parametrize(
    "trap",
    [
        "the text config's RoPE base",
        "cross keys are rotated twice",
        "actions see later ones",
        "the prompt isn't scaled",
    ],
)
def test_each_trap_would_be_seen(trap: str, monkeypatch: pytest.MonkeyPatch) -> None:
    _fall_into(trap, monkeypatch)
    assert "normalized_actions" in beyond(case("base").differences(0, case("base").config))


def test_padding_is_black_left_and_top() -> None:
    image = np.full((32, 64, 3), 255, np.uint8)
    images, mask = images_of({"a": image}, ["a"], (64, 64), 0)
    assert images.shape == (1, 3, 64, 64) and bool(mask.all())
    assert bool((images[0, :, :32] == -1).all()) and bool((images[0, :, 32:] == 1).all())
    tall, _ = images_of({"a": image.transpose(1, 0, 2)}, ["a"], (64, 64), 0)
    assert bool((tall[0, :, :, :32] == -1).all()) and bool((tall[0, :, :, 32:] == 1).all())


def test_cameras_behind_a_missing_one_move_and_empty_ones_come_last() -> None:
    observation = {"b": np.full((8, 8, 3), 255, np.uint8)}
    images, mask = images_of(observation, ["a", "b", "c"], (8, 8), 1)
    assert mask.tolist() == [True, False]
    assert bool((images[0] == 1).all()) and bool((images[1] == -1).all())


def test_no_camera_at_all_is_refused_by_name() -> None:
    with pytest.raises(ObservationError, match="has none of the cameras a, b"):
        images_of({}, ["a", "b"], (8, 8), 2)


def test_joining_other_than_lerobots_is_refused() -> None:
    one = case("rtc")
    inputs, noise = one.prepared(0), torch.from_numpy(one.inputs["noise"])[None]
    tokens = TokenTimes.plain(10, 10).holding(np.arange(10) < 3)
    held = Conditioning(tokens=tokens, held=np.arange(10) < 3, values=np.zeros((10, 32), np.float32))
    with pytest.raises(ObservationError, match='guidance of mode "identity" alone'):
        one.model(one.config).sample(inputs, noise, conditioning=held)


def test_names_of_compiled_models_and_old_files_are_understood() -> None:
    config, vlm = case("base").config, "model.vlm_with_expert.vlm"
    compiled = "model.vlm_with_expert._orig_mod.vlm.model.connector.modality_projection.proj.weight"
    assert canonical_name(compiled, config) == "connector.weight"
    assert canonical_name(f"{vlm}.lm_head.weight", config) is None
    assert canonical_name("normalize_inputs.buffer_observation_state.mean", config) is None
    assert canonical_name(f"{vlm}.model.text_model.layers.30.mlp.up_proj.weight", config) is None
    with pytest.raises(KeyError):
        canonical_name("model.paligemma_with_expert.x", config)
