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
from smolvla_golden import relative

from turbopi.config import FloatPrecision
from turbopi.models.observation import ModelInputs, Observation
from turbopi.models.pi0.conditioning import (
    Conditioning,
    Guidance,
    TokenTimes,
    guidance_strength,
    lerobot_guidance_weights,
)
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.layers import apply_rope, rope_tables
from turbopi.models.smolvla import reference
from turbopi.models.smolvla.config import PUBLISHED, ElementTypes, SmolVLAConfig, from_lerobot
from turbopi.models.smolvla.names import canonical_name, parameter_dtype
from turbopi.models.smolvla.reference import SmolVLAModel
from turbopi.preprocess.images import fitted
from turbopi.support.errors import ObservationError

GOLDEN = Path(__file__).parent / "golden_smolvla"
RUNS = {"base": 5, "bf16": 2, "missing_camera": 4, "rtc": 7, "special_tokens": 1}
SCHEDULES: Any = {"LINEAR": "linear", "EXP": "exponential", "ONES": "ones", "ZEROS": "zeros"}
_PUBLISHED = PUBLISHED["HuggingFaceTB/SmolVLM2-500M-Video-Instruct"]
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
        self.steps: int = self.lerobot["num_steps"]
        self.stored = load(lzma.decompress((folder / "model.safetensors.xz").read_bytes()))
        self.inputs = dict(np.load(folder / "inputs.npz"))
        self.expected = dict(np.load(folder / "expected.npz"))

    def model(self, config: SmolVLAConfig, precision: FloatPrecision) -> SmolVLAModel:
        names = {name: canonical_name(name, config.text.depth) for name in self.stored}
        stored = {ours: self.stored[name] for name, ours in names.items() if ours}
        state = {name: tensor.to(parameter_dtype(name, precision, config)) for name, tensor in stored.items()}
        return SmolVLAModel.from_state(config, state)

    def observation(self, run: int) -> dict[str, np.ndarray]:
        prefix = f"{self.described['runs'][run]['observation']}/"
        return {key.removeprefix(prefix): value for key, value in self.inputs.items() if key.startswith(prefix)}

    def prepared(self, run: int) -> Observation:
        cameras = [name for name, one in self.lerobot["input_features"].items() if one["type"] == "VISUAL"]
        observation, size = self.observation(run), self.config.image_size
        present = [fitted(observation[name], size, "lerobot_smolvla") for name in cameras if name in observation]
        missing = min(len(cameras) - len(present), self.lerobot["empty_cameras"])
        images = np.stack(present + [np.full_like(present[-1], -1)] * missing)
        of = run if f"{run}/tokens" in self.expected else 0
        tokens, token_mask = self.expected[f"{of}/tokens"], self.expected[f"{of}/token_mask"]
        state = self.expected[f"{of}/normalized_state"]
        state = np.pad(state, (0, self.config.state_dim - len(state)))
        mask = np.arange(len(images)) < len(present)
        return Observation.stack([ModelInputs(images, mask, tokens.astype(np.int64), token_mask, state)])

    def conditioning(self, run: int) -> Conditioning | None:
        rtc = self.described["runs"][run].get("rtc")
        if rtc is None or rtc["prev_rows"] == 0:
            return None
        horizon, rows, steps = self.config.action_horizon, rtc["prev_rows"], self.steps
        left_over = self.inputs["previous"][-rows:]
        target = np.pad(left_over, ((0, horizon - rows), (0, self.config.action_dim - left_over.shape[1])))
        schedule = SCHEDULES[rtc["schedule"]]
        weights = lerobot_guidance_weights(horizon, rtc["inference_delay"], rtc["execution_horizon"], rows, schedule)
        times = np.repeat(1 - np.arange(steps)[:, None] / steps, horizon, 1)
        strength = guidance_strength(times, rtc["max_guidance_weight"])
        return Conditioning(guidance=Guidance(target, weights, strength, "identity"))

    def computed(self, run: int, config: SmolVLAConfig, precision: FloatPrecision) -> dict[str, np.ndarray]:
        trace: reference.Trace = {}
        observation, noise = self.prepared(run), torch.from_numpy(self.inputs["noise"])[None]
        actions = self.model(config, precision).sample(
            observation, noise, self.steps, compact=False, conditioning=self.conditioning(run), trace=trace
        )
        width = self.expected[f"{run}/normalized_actions"].shape[1]
        for name in ("keys", "values"):
            trace |= {f"{name}_{layer}": rows for layer, rows in enumerate(trace.pop(f"kv_{name[0]}"))}
        del trace["actions"]  # normalised: `normalized_actions`
        if self.conditioning(run) is not None:  # LeRobot's are those before the pull
            del trace["v_t"]
        else:
            trace |= {"v_first": trace["v_t"][0], "v_last": trace.pop("v_t")[-1]}
        ours = {
            name: (value if name == "image_embeddings" else value[0]).float().numpy() for name, value in trace.items()
        }
        ours["images_sampled"] = observation.images[0, :, ::8, ::8].permute(0, 3, 1, 2).numpy()
        return ours | {"normalized_actions": actions[0, :, :width].numpy()}

    def differences(self, run: int, precision: FloatPrecision = "f32", part: str = "") -> dict[str, float]:
        """Relative rms by name, of all that this run has and the trace does."""
        ours, begin = self.computed(run, self.config, precision), f"{run}/{part}"
        theirs = {name.removeprefix(begin): value for name, value in self.expected.items() if name.startswith(begin)}
        return {name: relative(ours[name], value) for name, value in theirs.items() if name in ours}


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
        differences = one.differences(run, part="float32/")
    else:
        differences = one.differences(run)
        assert run or differences.keys() >= {"prefix", "positions", "keys_0", "values_3", "images_sampled"}
    assert "normalized_actions" in differences
    assert beyond(differences) == {}


@pytest.mark.parametrize("run", [0, 1])
def test_the_element_types_of_the_config_give_lerobots_own_rounding(run: int) -> None:
    one = case("bf16")
    assert max(one.differences(run, "bf16").values()) <= BFLOAT16


def test_element_types_are_the_configs_and_not_the_files() -> None:
    config = case("bf16").config
    dtypes = {parameter_dtype(name, "bf16", config) for name in SmolVLAModel(config).state_dict()}
    assert dtypes == {torch.float32, torch.bfloat16}
    cross, own = (f"expert.layers.{layer}.self_attn.k_proj.weight" for layer in (1, 0))
    assert parameter_dtype(cross, "bf16", config) == torch.float32
    assert parameter_dtype(own, "bf16", config) == torch.bfloat16
    assert parameter_dtype("state_proj.weight", "bf16", config) == torch.float32
    of_float32 = case("base").config  # of which else nothing would be
    assert parameter_dtype("vision.layers.0.mlp.fc1.weight", "bf16", of_float32) == torch.bfloat16
    text_alone = from_lerobot({}, _PUBLISHED)
    assert text_alone.element_types == ElementTypes("float32", "bfloat16")


def test_the_published_sizes_are_the_defaults() -> None:
    config = dataclasses.replace(from_lerobot({}, _PUBLISHED), element_types=ElementTypes())
    assert config == SmolVLAConfig()
    with torch.device("meta"):
        model = SmolVLAModel(config)
    numbers = sum(parameter.numel() for parameter in model.parameters())
    assert numbers == 450_046_176 - 49_280 * 960 - 960  # lm_head and the text model's final norm are unused


def _fall_into(trap: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if trap == "the text config's RoPE base":
        monkeypatch.setattr(reference, "ROPE_BASE", 100_000.0)
    elif trap == "cross keys are rotated twice":
        right = SmolVLAModel.cross_keys_values

        def rotated(self: SmolVLAModel, cache: KVCache) -> Any:
            positions = torch.arange(cache.k.shape[3])[None]
            rope = rope_tables(positions, self.config.text.head_dim, reference.ROPE_BASE)
            return right(self, dataclasses.replace(cache, k=torch.stack([apply_rope(k, *rope) for k in cache.k])))

        monkeypatch.setattr(SmolVLAModel, "cross_keys_values", rotated)
    elif trap == "actions see later ones":
        masked = reference.attention  # which a model takes when it is made

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
    assert "normalized_actions" in beyond(case("base").differences(0))


def test_padding_is_black_left_and_top() -> None:
    image = np.full((32, 64, 3), 255, np.uint8)
    wide, tall = (fitted(one, 64, "lerobot_smolvla") for one in (image, image.transpose(1, 0, 2)))
    assert (wide[:32] == -1).all() and (wide[32:] == 1).all()
    assert (tall[:, :32] == -1).all() and (tall[:, 32:] == 1).all()


@pytest.mark.parametrize(("name", "run"), [("base", 0), ("missing_camera", 1)])
def test_leaving_out_what_is_masked_changes_nothing(name: str, run: int) -> None:
    one = case(name)
    model, noise = one.model(one.config, "f32"), torch.from_numpy(one.inputs["noise"])[None]
    whole, compact = (model.sample(one.prepared(run), noise, one.steps, compact=compact) for compact in (False, True))
    assert relative(compact.numpy(), whole.numpy()) <= 1e-6


def test_an_observation_without_any_camera_is_refused() -> None:
    one = case("base")
    blind = dataclasses.replace(one.prepared(0), image_mask=torch.zeros(1, 2, dtype=torch.bool))
    with pytest.raises(ObservationError, match="an image of one camera at least"):
        one.model(one.config, "f32").prefix(blind)


def test_held_actions_stay_and_the_true_jacobian_pulls() -> None:
    """What the loop of every family can do beside LeRobot's own joining."""
    one = case("rtc")
    model, noise = one.model(one.config, "f32"), torch.from_numpy(one.inputs["noise"])[None]
    held, values = np.arange(10) < 3, np.full((10, 32), 0.5, np.float32)
    kept = Conditioning(tokens=TokenTimes.plain(10, 10).holding(held), held=held, values=values)
    actions = model.sample(one.prepared(0), noise, 10, conditioning=kept).numpy()
    assert (actions[0, :3] == 0.5).all() and not (actions[0, 3:] == 0.5).any()
    strength = np.ones((10, 10), np.float32)
    pulled = [
        model.sample(
            one.prepared(0),
            noise,
            10,
            conditioning=Conditioning(guidance=Guidance(values, np.ones(10, np.float32), strength, mode)),
        ).numpy()
        for mode in ("jacobian", "identity")
    ]
    plain = model.sample(one.prepared(0), noise, 10).numpy()
    assert all(np.abs(one - 0.5).mean() < np.abs(plain - 0.5).mean() for one in pulled)
    assert relative(*pulled) > 1e-3


def test_names_of_compiled_models_and_old_files_are_understood() -> None:
    config, vlm = case("base").config, "model.vlm_with_expert.vlm"
    compiled = "model.vlm_with_expert._orig_mod.vlm.model.connector.modality_projection.proj.weight"
    assert canonical_name(compiled, config.text.depth) == "projector.weight"
    assert canonical_name(f"{vlm}.lm_head.weight", config.text.depth) is None
    assert canonical_name("normalize_inputs.buffer_observation_state.mean", config.text.depth) is None
    assert canonical_name(f"{vlm}.model.text_model.layers.30.mlp.up_proj.weight", config.text.depth) is None
    assert canonical_name("model.other.x", config.text.depth) == "model.other.x"
