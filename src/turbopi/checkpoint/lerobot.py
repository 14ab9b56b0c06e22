"""LeRobot's `pi05` checkpoints: `config.json` and the two processor pipelines, which describe a policy fully.

Facts from LeRobot 0.6: the processors' files decide over config.json, steps are found by `registry_name` and their
tensors by `state_file`; QUANTILES and MIN_MAX replace a zero range by 1e-8, MEAN_STD adds 1e-8; the normalised state
is always written into the prompt; cameras that aren't there come last; t is 1 + step * dt.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.numpy import load_file

from turbopi.checkpoint.norm_stats import STATISTICS, FeatureStats, NormStats, feature_stats
from turbopi.checkpoint.settings import Settings, with_values
from turbopi.config import ModelConfig, Normalization, NormMode, PolicyConfig
from turbopi.errors import CheckpointError, ConfigError

CONFIG, PREPROCESSOR, POSTPROCESSOR = "config.json", "policy_preprocessor.json", "policy_postprocessor.json"
STATE, ACTION, EMPTY_CAMERA = "observation.state", "action", "observation.images.empty_camera_"

_MODES: dict[str, NormMode] = {
    "QUANTILES": "lerobot_quantile",
    "MEAN_STD": "lerobot_zscore",
    "MIN_MAX": "lerobot_min_max",
    "IDENTITY": "identity",
}
_EPS = 1e-8
_FEATURE_TYPES = ("STATE", "VISUAL", "ENV", "ACTION", "REWARD", "LANGUAGE")
_TOKENIZER = "google/paligemma-3b-pt-224"
_STEPS = {
    PREPROCESSOR: (
        "rename_observations_processor",
        "to_batch_processor",
        "relative_actions_processor",
        "normalizer_processor",
        "pi05_prepare_state_tokenizer_processor_step",
        "tokenizer_processor",
        "device_processor",
    ),
    POSTPROCESSOR: ("unnormalizer_processor", "absolute_actions_processor", "device_processor"),
}
# values of config.json that change what the model computes, and the only ones that Turbo-Pi computes
_FIXED = {
    "n_obs_steps": (1, "one observation a step"),
    "image_resolution": ([224, 224], "224 x 224 pictures"),
    "min_period": (4e-3, "the time embedding's shortest period 0.004"),
    "max_period": (4.0, "the time embedding's longest period 4.0"),
    "use_relative_actions": (False, "absolute actions"),
}
# the rest of LeRobot 0.6's keys: read here, or about training and the hub
_KNOWN = set(_FIXED) | {
    *("type", "chunk_size", "n_action_steps", "max_state_dim", "max_action_dim", "num_inference_steps"),
    *("input_features", "output_features", "normalization_mapping", "empty_cameras", "tokenizer_max_length"),
    *("paligemma_variant", "action_expert_variant", "dtype", "device", "use_amp", "compile_model", "compile_mode"),
    *("time_sampling_beta_alpha", "time_sampling_beta_beta", "time_sampling_scale", "time_sampling_offset"),
    *("relative_exclude_joints", "action_feature_names", "rtc_config", "gradient_checkpointing", "use_peft"),
    *("freeze_vision_encoder", "train_expert_only", "push_to_hub", "repo_id", "private", "tags", "license"),
    *("pretrained_path", "pretrained_revision", "optimizer_lr", "optimizer_betas", "optimizer_eps"),
    *("optimizer_weight_decay", "optimizer_grad_clip_norm", "optimizer_fused"),
    *("scheduler_warmup_steps", "scheduler_decay_steps", "scheduler_decay_lr"),
}


class LeRobotFolder:
    """The description in a LeRobot folder; the weights are read by TorchSource.

    Raises CheckpointError for what isn't Pi0.5, is incomplete, or asks for what Turbo-Pi doesn't compute.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.config = _read_json(folder / CONFIG)
        self._check_config()
        self.steps = {name: self._read_steps(name) for name in (PREPROCESSOR, POSTPROCESSOR)}

    def notes(self) -> list[str]:
        """What config.json asks for and Turbo-Pi doesn't do; keys that LeRobot's Pi0.5 doesn't have, from which another
        program may compute something.
        """
        unknown = sorted(self.config.keys() - _KNOWN)
        notes = [f"config.json has keys that Turbo-Pi doesn't know or follow: {', '.join(unknown)}"] if unknown else []
        rtc = self.config.get("rtc_config")
        if isinstance(rtc, dict) and rtc.get("enabled"):
            notes.append("config.json enables rtc_config: Turbo-Pi answers each observation with a chunk of its own")
        return notes

    def policy_config(self, settings: Settings) -> PolicyConfig:
        """What the folder says, with a turbopi.json's values over it. A preset would be a second description."""
        if settings.policy is not None:
            return settings.policy
        if "preset" in settings.values:
            raise ConfigError(
                f"{self.folder} is a LeRobot checkpoint, which describes itself, so {settings.source} doesn't fit: use "
                'config="auto", and put single differences, such as {"robot": "libero"}, into a turbopi.json there'
            )
        model = ModelConfig(
            action_horizon=self._count("chunk_size", None),
            max_prompt_tokens=self._prompt_tokens(),
            time_grid="multiplied",
        )
        described = PolicyConfig(
            name="lerobot_pi05",
            model=model,
            robot="lerobot",
            normalization=Normalization("identity", "identity"),  # until the next line
            robot_options=self._robot_options(),
            image_resize="lerobot",
            num_denoising_steps=self._count("num_inference_steps", 10),
        )
        if "normalization" not in settings.values:
            described = with_values(described, Settings("", values={"normalization": self._normalization()}))
        return with_values(described, settings)

    def norm_stats(self, normalization: Normalization) -> NormStats:
        """The statistics that the processors load. CheckpointError if `normalization` needs others."""
        state, state_file = self._stats(PREPROCESSOR, "normalizer_processor", STATE)
        actions, actions_file = self._stats(POSTPROCESSOR, "unnormalizer_processor", ACTION)
        stats = NormStats(state, actions)
        stats.check(normalization, " and ".join(dict.fromkeys((state_file, actions_file))))
        return stats

    def _check_config(self) -> None:
        kind = self.config.get("type")
        if kind != "pi05":
            raise CheckpointError(
                f"{self.folder} is a LeRobot checkpoint of type {kind!r}; Turbo-Pi reads LeRobot's 'pi05' "
                "(and openpi's own checkpoints of Pi0 and Pi0.5)"
            )
        for key, (expected, meaning) in _FIXED.items():
            value = self.config.get(key, expected)
            if value != expected:
                raise CheckpointError(
                    f"{self.folder / CONFIG} has {key} = {value!r}, which Turbo-Pi doesn't compute; it does {meaning}"
                )

    def _read_steps(self, file_name: str) -> dict[str, dict[str, Any]]:
        """Registry name -> entry of one pipeline."""
        file = self.folder / file_name
        entries = _read_json(file).get("steps")
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise CheckpointError(f"{file} has no list of steps; is it a LeRobot processor?")
        found: dict[str, dict[str, Any]] = {}
        for entry in entries:
            name = entry.get("registry_name", entry.get("class"))
            if name not in _STEPS[file_name] or name in found:
                raise CheckpointError(
                    f"{file} has a step {name!r} that Turbo-Pi doesn't know; known are {', '.join(_STEPS[file_name])}"
                )
            found[name] = entry
            if _object(entry, "config", file).get("enabled") is True:
                raise CheckpointError(f"{file}: {name} is enabled; Turbo-Pi doesn't do LeRobot's relative actions")
        return found

    def _normalization(self) -> Normalization:
        """The processors' modes; config.json must agree."""
        modes = {}
        for key, file_name, step in (
            ("STATE", PREPROCESSOR, "normalizer_processor"),
            ("ACTION", POSTPROCESSOR, "unnormalizer_processor"),
        ):
            file = self.folder / file_name
            config = _object(self.steps[file_name].get(step, {}), "config", file)
            mapping = _object(config, "norm_map", file)
            mode = mapping.get(key, "IDENTITY")
            claimed = _object(self.config, "normalization_mapping", self.folder / CONFIG).get(key, mode)
            if mode not in list(_MODES):  # a list: it may be anything, hashable or not
                raise CheckpointError(f"{file} normalises {key} by {mode}; Turbo-Pi knows {', '.join(_MODES)}")
            if mode != claimed:
                raise CheckpointError(
                    f"{file} normalises {key} by {mode}, but {CONFIG} says {claimed}. LeRobot itself follows the "
                    'processor; if that is right, correct config.json, or say {"normalization": ...} in turbopi.json'
                )
            if mapping.get("VISUAL", "IDENTITY") != "IDENTITY":
                raise CheckpointError(f"{file} normalises pictures by {mapping['VISUAL']}; expected IDENTITY")
            if config.get("eps", _EPS) != _EPS:
                raise CheckpointError(f"{file}: {step} has eps {config['eps']}; Turbo-Pi computes with {_EPS}")
            modes[key] = _MODES[mode]
        return Normalization(modes["STATE"], modes["ACTION"])

    def _stats(self, file_name: str, step: str, feature: str) -> tuple[FeatureStats | None, str]:
        """A feature's statistics and where they are, or should be."""
        entry = self.steps[file_name].get(step)
        where = str(self.folder / file_name)
        if entry is None or "state_file" not in entry:
            return None, f"{where} (its {step} has no state_file)"
        file = self.folder / str(entry["state_file"])
        if file.parent != self.folder or not file.is_file():
            raise CheckpointError(f"norm stats are missing: {where} names {entry['state_file']}, which isn't there")
        try:
            tensors = load_file(file)
        except (SafetensorError, OSError) as error:
            raise CheckpointError(f"{file} can't be read as safetensors ({error})") from error
        config = _object(entry, "config", Path(where))
        selected = config.get("normalize_observation_keys")
        if not isinstance(selected, list | None):
            raise CheckpointError(
                f"{where}: normalize_observation_keys is {selected!r}; expected a list of keys or null"
            )
        applied = feature in _object(config, "features", Path(where)) and (selected is None or feature in selected)
        if feature == STATE and not applied:  # LeRobot then passes the state through, whatever statistics there are
            return None, f"{file} (the {step}'s features leave out {STATE})"
        values = {name: tensors[f"{feature}.{name}"] for name in STATISTICS if f"{feature}.{name}" in tensors}
        return (feature_stats(values, f"{file}: {feature}") if values else None), str(file)

    def _prompt_tokens(self) -> int:
        step = _object(self.steps[PREPROCESSOR].get("tokenizer_processor", {}), "config", self.folder / PREPROCESSOR)
        claimed = self._count("tokenizer_max_length", 200)
        length = step.get("max_length", claimed)
        if length != claimed:
            raise CheckpointError(
                f"{self.folder}: prompts have {length} tokens in {PREPROCESSOR} but {claimed} in {CONFIG}; correct one"
            )
        name = str(step.get("tokenizer_name", _TOKENIZER))
        if "paligemma" not in name.lower():
            raise CheckpointError(f"{self.folder / PREPROCESSOR} tokenises with {name}; expected {_TOKENIZER}")
        return claimed

    def _count(self, key: str, default: int | None, least: int = 1) -> int:
        value = self.config.get(key, default)
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise CheckpointError(f"{self.folder / CONFIG}: {key} is {value!r}; expected a whole number from {least}")
        return value

    def _features(self, key: str) -> dict[str, dict[str, Any]]:
        found = self.config.get(key) or {}
        if not isinstance(found, dict) or not all(isinstance(feature, dict) for feature in found.values()):
            raise CheckpointError(f"{self.folder / CONFIG}: {key} is {found!r}; expected features with type and shape")
        return found

    def _robot_options(self) -> dict[str, Any]:
        """Cameras in the model's order, by the keys that observations use, and the widths of state and actions."""
        inputs, outputs = self._features("input_features"), self._features("output_features")
        rename_step = self.steps[PREPROCESSOR].get("rename_observations_processor", {})
        file = self.folder / PREPROCESSOR
        renames = _object(_object(rename_step, "config", file), "rename_map", file)
        if not all(isinstance(new, str) for new in renames.values()):
            raise CheckpointError(f"{file}: rename_map is {renames!r}; expected a new name for each key")
        original = {new: old for old, new in renames.items()}  # what the observation calls a feature of the policy
        if STATE in original:
            raise CheckpointError(f"{self.folder}: observations call the state {original[STATE]!r}; expected {STATE}")
        for key, feature in inputs.items():
            if feature.get("type") not in _FEATURE_TYPES:
                raise CheckpointError(
                    f"{self.folder / CONFIG}: {key} has type {feature.get('type')!r}; expected one of "
                    f"{', '.join(_FEATURE_TYPES)}"
                )
        visual = [key for key, feature in inputs.items() if feature["type"] == "VISUAL"]
        cameras = [original.get(key, key) for key in visual if not key.startswith(EMPTY_CAMERA)]
        if not cameras:
            raise CheckpointError(f"{self.folder / CONFIG} lists no camera among its input_features")
        empty = {key for key in visual if key.startswith(EMPTY_CAMERA)}
        empty |= {f"{EMPTY_CAMERA}{index}" for index in range(self._count("empty_cameras", 0, least=0))}
        return {
            "image_keys": cameras,
            "num_missing_cameras": len(empty),
            "state_dim": _width(inputs, STATE, self._count("max_state_dim", 32)),
            "action_dim": _width(outputs, ACTION, self._count("max_action_dim", 32)),
        }


def is_lerobot(folder: Path) -> bool:
    """LeRobot's config.json has a `type`; openpi's has none."""
    file = folder / CONFIG
    return file.is_file() and "type" in _read_json(file)


def _object(owner: Mapping[str, Any], key: str, file: Path) -> dict[str, Any]:
    """The object at `key`, {} if there is none. CheckpointError for anything else, null too."""
    found = owner.get(key, {})
    if not isinstance(found, dict):
        raise CheckpointError(f"{file}: {key} is {found!r}; expected an object")
    return found


def _width(features: Mapping[str, Any], key: str, default: int) -> int:
    shape = features.get(key, {}).get("shape", [default])
    if not isinstance(shape, list) or len(shape) != 1 or not isinstance(shape[0], int):
        raise CheckpointError(f"{CONFIG}: {key} has shape {shape}; expected one dimension")
    return shape[0]


def _read_json(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text())
    except OSError as error:
        raise CheckpointError(f"{file} can't be read: {error.strerror}; is the download complete?") from error
    except ValueError as error:
        raise CheckpointError(f"{file} isn't JSON: {error}") from error
    if not isinstance(content, dict):
        raise CheckpointError(f"{file} is a {type(content).__name__}; expected an object")
    return content
