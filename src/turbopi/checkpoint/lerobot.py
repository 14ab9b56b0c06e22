"""LeRobot's `pi05` and `pi0` checkpoints: `config.json` and the two processor pipelines, which describe a policy fully.

Facts from LeRobot 0.6: the processors' files decide over config.json; their tensors are found by `state_file`;
QUANTILES and MIN_MAX replace a zero range by 1e-8, MEAN_STD adds 1e-8; the normalised state is always written into the
prompt; cameras that aren't there come last; t is 1 + step * dt. What 0.4 did otherwise is in lerobot_versions.py, what
the processors' steps may be in lerobot_pipeline.py.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from turbopi.checkpoint import lerobot_versions as versions
from turbopi.checkpoint.lerobot_keys import PI, Keys
from turbopi.checkpoint.lerobot_pipeline import (
    ACTION,
    NORMALIZER,
    POSTPROCESSOR,
    PREPROCESSOR,
    STATE,
    UNNORMALIZER,
    Pipelines,
)
from turbopi.checkpoint.names import Names, PiNames
from turbopi.checkpoint.norm_stats import STATISTICS, FeatureStats, NormStats, feature_stats
from turbopi.checkpoint.settings import Settings, with_values
from turbopi.checkpoint.source import WeightSource
from turbopi.config import (
    LIMITS,
    MOST_REMEMBERED,
    WITH_MEMORY,
    Kind,
    MemoryConfig,
    ModelConfig,
    Network,
    Normalization,
    NormMode,
    PolicyConfig,
    RealTime,
    Schedule,
)
from turbopi.models import FAMILIES, Family
from turbopi.support.errors import CheckpointError, ConfigError
from turbopi.support.reading import Fields, file_inside, one_line, read_json, shown

CONFIG, EMPTY_CAMERA = "config.json", "observation.images.empty_camera_"
_EMPTY_CAMERA = re.compile(re.escape(EMPTY_CAMERA) + "[0-9]+")

_MODES: dict[str, NormMode] = {
    "QUANTILES": "lerobot_quantile",
    "QUANTILE10": "lerobot_quantile10",
    "MEAN_STD": "lerobot_zscore",
    "MIN_MAX": "lerobot_min_max",
    "IDENTITY": "identity",
}
SCHEDULES: dict[str, Schedule] = {"EXP": "exponential", "LINEAR": "linear", "ONES": "ones", "ZEROS": "zeros"}
_EPS = 1e-8
USE_LEROBOT = "Run this checkpoint with LeRobot's own policy"
_FEATURE_TYPES = ("STATE", "VISUAL", "ENV", "ACTION", "REWARD", "LANGUAGE")
_VARIANTS = ("gemma_300m", "gemma_2b")
_CHOICES = {  # LeRobot refuses any other value of these; what counts here are the tensors' sizes and dtypes
    "paligemma_variant": _VARIANTS,
    "action_expert_variant": _VARIANTS,
    "dtype": ("bfloat16", "float32"),
}


class LeRobotFolder:
    """The description in a LeRobot folder; the weights are read by TorchSource.

    settings  what a turbopi.json puts over it
    untied    whether the weights hold lm_head beside the embedding, see lerobot_versions.py

    Of Pi0.5 and Pi0; another type's is derived from it (`lerobot_smolvla.py`). Raises CheckpointError for what is of no
    type that is read, is incomplete, or asks for what Turbo-Pi doesn't compute.
    """

    keys: ClassVar[Keys] = PI
    own_settings: ClassVar[frozenset[str]] = frozenset()  # keys of a turbopi.json that are for this type alone
    writes_text: ClassVar[bool] = False
    sizes_hint: ClassVar[str] = ""  # what to do about weights of other sizes

    def __init__(self, folder: Path, settings: Settings, *, untied: bool = False) -> None:
        self.folder, self.settings, self.file = folder, settings, folder / CONFIG
        self.config = Fields(_read_config(folder), self.file)
        self.kind = self._check_config()
        versions.check_migrated(folder, folder / PREPROCESSOR)
        self.memory = self._memory()
        # LeRobot trains it without the state in the prompt, and doesn't save that: a folder that it loads has it again
        state_tokens = self.memory is not None and self.memory.proprioceptive
        self.pipelines = Pipelines(folder, self.kind, state_tokens=state_tokens, text=self.writes_text)
        self.stats, self._stats_files = self._read_stats()
        self.action_dim = self._width("output_features", ACTION, "max_action_dim")
        self.described_state_dim = self._width("input_features", STATE, "max_state_dim")
        # LeRobot scales by the statistics, whatever config.json says: a fine-tune keeps its base's input_features
        self.state_dim = self.described_state_dim if self.stats.state is None else self.stats.state.dim
        self.written_by = versions.detect(self.config.values, untied=untied)
        chosen = settings.values.get("lerobot_semantics", "auto")
        self.semantics: versions.Semantics = (self.written_by or "0.6") if chosen == "auto" else chosen

    @classmethod
    def names(cls, folder: Path) -> Names:
        """How the weights of such a folder are named."""
        return PiNames()

    @property
    def named_tokenizer(self) -> Path | None:
        """The folder of the tokenizer that the processors name; None: it is PaliGemma's, by its name."""
        return self.pipelines.tokenizer

    def policy_config(self) -> PolicyConfig:
        """What the folder says, with a turbopi.json's values over it. A preset would be a second description."""
        settings = self.settings
        if settings.policy is not None:
            return settings.policy
        if "preset" in settings.values:
            raise ConfigError(
                f"{self.folder} is a LeRobot checkpoint, which describes itself, so {settings.source} doesn't fit: use "
                'config="auto", and put single differences, such as {"robot": "libero"}, into a turbopi.json there'
            )
        described = self._described()
        config = with_values(described, settings)
        if config.robot == described.robot:
            self._check_actions(config.normalization)
        return config

    def _described(self) -> PolicyConfig:
        old, family = self.semantics == "0.4", FAMILIES[self.kind]
        summed = old and versions.sums_up_time(self.config.values)
        network = ModelConfig(
            kind=family.kind,  # type: ignore[arg-type]  # of this class
            action_horizon=self._chunk_size,
            max_prompt_tokens=self.pipelines.max_tokens,
            time_grid="accumulated" if summed else "multiplied",
            memory=self.memory,
        )
        return PolicyConfig(
            name=f"lerobot_{self.kind}",
            model=network,
            robot="lerobot",
            normalization=self.normalization,
            robot_options=self._robot_options(),
            discrete_state_input=self.pipelines.state_in_prompt,
            image_resize="lerobot_0.4" if old else "lerobot",
            prompt_state_dim=self.pipelines.prompt_width or None if old else None,
            prompt_as_is=not family.state_in_prompt,
            prompt_labels=family.state_in_prompt and not self.pipelines.state_in_prompt,
            num_denoising_steps=self._steps("num_inference_steps"),
            real_time=self._real_time(),
        )

    def _steps(self, key: str) -> int:
        return self.config.integer(key, 1, LIMITS["num_denoising_steps"], default=10)

    def norm_stats(self, normalization: Normalization) -> NormStats:
        """The statistics that the processors load. CheckpointError if `normalization` needs others."""
        self.stats.check(normalization, self._stats_files)
        return self.stats

    def notes(self) -> list[str]:
        """Where the files say two things or what isn't done, and what is done then; keys that nobody here knows."""
        notes = []
        if unknown := self.keys.unknown(self.config.values):
            notes.append(f"{CONFIG} has keys that Turbo-Pi doesn't know or follow: {', '.join(unknown)}")
        notes += self._notes_on_rtc()
        notes += self.pipelines.notes
        if self.settings.policy is not None:
            return notes
        notes += self._notes_on_version()
        if self.described_state_dim != self.state_dim:
            notes.append(
                f"{CONFIG} says {self.described_state_dim} values of state, but the statistics have {self.state_dim}: "
                f"observations have {self.state_dim}, as LeRobot runs it"
            )
        tokens = self.config.integer(
            "tokenizer_max_length", 1, LIMITS["max_prompt_tokens"], default=FAMILIES[self.kind].prompt_tokens
        )
        if tokens != self.pipelines.max_tokens:
            notes.append(
                f"{CONFIG} says {tokens} tokens of prompt, but {PREPROCESSOR} {self.pipelines.max_tokens}: so many "
                "are read, as LeRobot runs it"
            )
        made_absolute = self.pipelines.relative_mask(self.action_dim) is not None
        if self.pipelines.leaves_actions_relative:
            notes.append(f"answers are relative to the state: {POSTPROCESSOR} doesn't add it, nor does LeRobot")
        elif self.config.flag("use_relative_actions", made_absolute) != made_absolute:
            notes.append(
                f"{CONFIG} says use_relative_actions = {str(not made_absolute).lower()}, but the processors' steps "
                "otherwise: they are followed, as by LeRobot"
            )
        return notes

    def _notes_on_rtc(self) -> list[str]:
        if self._rtc_config is None:
            return []
        what = "enables rtc_config: `infer(previous=…)` takes its schedule, weight and horizon where it has none"
        if self._rtc_config.choice("mode", ("guided", "trained"), default="guided") == "trained":
            what = 'says mode "trained": give `infer` a running chunk of mode "rtc_trained"'
        return [f"{CONFIG} {what} (docs/real_time.md); a call without one is an ordinary one"]

    @property
    def action_tokenizers(self) -> tuple[Path, ...]:
        """Folders that the tokenizer of answers may be in, if answers are read with one."""
        return ()

    @property
    def action_tokenizer_name(self) -> str | None:
        return None

    def _notes_on_version(self) -> list[str]:
        chosen = self.settings.values.get("lerobot_semantics", "auto") != "auto"
        if chosen or self.written_by == "0.6":
            return []
        return [versions.note(self.semantics, self.written_by, self.pipelines.prompt_width)]

    def _check_config(self) -> Kind:
        kind = self.config.values.get("type")
        if self.writes_text and kind == "pi052":
            kind = "pi05"
        if not isinstance(kind, str) or kind not in FAMILIES:
            raise CheckpointError(
                f"{self.folder} is a LeRobot checkpoint of type {shown(kind)}; Turbo-Pi reads LeRobot's "
                f"{' and '.join(map(repr, (*FAMILIES, 'pi052')))} (and openpi's own checkpoints of Pi0 and Pi0.5)"
            )
        family = FAMILIES[kind]
        self._check_family(family)
        if (refused := self.keys.refused(self.config.values)) is not None:
            key, meaning = refused
            raise CheckpointError(
                f"{self.file} has {key} = {shown(self.config.values[key])}, which Turbo-Pi doesn't compute; it does "
                f"{meaning}. {USE_LEROBOT}"
            )
        return family.kind

    def weights(self, source: WeightSource, network: Network) -> WeightSource:
        """`source`, or one that reads it as turbopi.json says."""
        return source

    def _check_family(self, family: Family) -> None:
        if "resize_imgs_with_padding" in self.config.values:
            raise CheckpointError(
                f"{self.file} is of a LeRobot before 0.4, whose Pi0 had other tensors and no processors; Turbo-Pi "
                "reads what 0.4 and later ones save"
            )
        state, action = (
            self.config.integer(f"max_{name}_dim", 1, LIMITS["action_dim"], 32) for name in ("state", "action")
        )
        if family.state_token and state != action:
            raise CheckpointError(
                f"{self.file} has max_state_dim = {state} and max_action_dim = {action}; Turbo-Pi's {family.label} has "
                f"one width for both. {USE_LEROBOT}"
            )
        for key, choices in _CHOICES.items():
            if self.config.values.get(key) is not None:
                self.config.choice(key, choices)

    def _memory(self) -> MemoryConfig | None:
        """MEM's settings; None without memory."""
        visual = self.config.flag("use_visual_memory", False)
        proprioceptive = self.config.flag("use_proprioceptive_memory", False)
        frames = self.config.integer("memory_frames", 1, LIMITS["frames"], default=6)
        stride = self.config.integer("memory_stride", 1, LIMITS["stride"], default=30)
        every = self.config.integer("memory_temporal_attention_every", 1, LIMITS["temporal_every"], default=4)
        if not visual and not proprioceptive:
            return None
        if self.kind not in WITH_MEMORY:
            key = f"use_{'visual' if visual else 'proprioceptive'}_memory"
            raise CheckpointError(
                f"{self.file} has {key} = True and type {self.kind!r}; LeRobot has memory in pi05 alone"
            )
        width = self.config.integer("max_state_dim", 1, LIMITS["action_dim"], 32)
        memory = MemoryConfig(visual, proprioceptive, frames, stride, every, width)
        if memory.length > MOST_REMEMBERED:
            raise CheckpointError(
                f"{self.file} has memory_frames = {frames} and memory_stride = {stride}: the last {memory.length} "
                f"observations, and Turbo-Pi keeps at most {MOST_REMEMBERED}"
            )
        return memory

    @property
    def _chunk_size(self) -> int:
        return self.config.integer("chunk_size", 1, LIMITS["action_horizon"], default=50)

    # -- real-time execution -------------------------------------------------------------------------------------------

    @property
    def _rtc_config(self) -> Fields | None:
        """config.json's rtc_config, if it is enabled."""
        if self.config.values.get("rtc_config") is None:
            return None
        rtc = self.config.object("rtc_config")
        return rtc if rtc.flag("enabled", False) else None

    def _real_time(self) -> RealTime:
        """LeRobot's execution horizon is where its mask ends, e; ours is what is carried out, s = H − e.

        A mask as long as the chunk or longer says nothing: it ends where the left-over does.
        """
        trained = self.config.integer("rtc_training_max_delay", 0, LIMITS["action_horizon"] - 1, default=0)
        horizon = self.settings.values.get("action_horizon", self._chunk_size)
        trained = min(trained, horizon - 1)  # a longer delay leaves nothing of a chunk to compute
        if (rtc := self._rtc_config) is None:
            return RealTime(trained_max_delay=trained)
        end = rtc.integer("execution_horizon", 1, LIMITS["action_horizon"], default=10)
        return RealTime(
            trained_max_delay=trained,
            execution_horizon=horizon - end if end < horizon else None,
            schedule=SCHEDULES[rtc.choice("prefix_attention_schedule", tuple(SCHEDULES), default="LINEAR")],
            max_guidance_weight=rtc.number("max_guidance_weight", 0, 1e6, default=10.0),
        )

    # -- scaling -------------------------------------------------------------------------------------------------------

    @property
    def normalization(self) -> Normalization:
        """A turbopi.json's, or the processors' modes: CheckpointError unless config.json agrees with them."""
        chosen: Normalization | None = self.settings.values.get("normalization")
        return chosen or Normalization(
            self._mode(PREPROCESSOR, NORMALIZER, "STATE"), self._mode(POSTPROCESSOR, UNNORMALIZER, "ACTION")
        )

    def _mode(self, file_name: str, name: str, kind: str) -> NormMode:
        file, step = self.folder / file_name, self.pipelines.steps.get(name)
        mapping = {} if step is None else step.config.object("norm_map", {}).values
        if step is not None and kind == "STATE":  # LeRobot goes by the type that the step itself gives the state
            kind = str(step.config.object("features", {}).object(STATE, {}).values.get("type", kind))
        mode = mapping.get(kind, "IDENTITY")
        claimed = self.config.object("normalization_mapping", {}).values.get(kind, mode)
        if not isinstance(mode, str) or mode not in _MODES:
            raise CheckpointError(
                f"{file} normalises {kind} by {_bare(mode)}; Turbo-Pi knows {', '.join(_MODES)}. {USE_LEROBOT}"
            )
        if mode != claimed:
            raise CheckpointError(
                f"{file} normalises {kind} by {mode}, but {CONFIG} says {_bare(claimed)}. LeRobot itself follows the "
                'processor; if that is right, correct config.json, or say {"normalization": ...} in turbopi.json'
            )
        if mapping.get("VISUAL", "IDENTITY") != "IDENTITY":
            raise CheckpointError(
                f"{file} normalises images by {_bare(mapping['VISUAL'])}; expected IDENTITY. {USE_LEROBOT}"
            )
        if step is not None and step.config.number("eps", default=_EPS) != _EPS:
            raise CheckpointError(f"{file}: {name} has eps {step.config.values['eps']}; Turbo-Pi computes with {_EPS}")
        return _MODES[mode]

    def _read_stats(self) -> tuple[NormStats, str]:
        """The statistics, and where they are or should be."""
        state, state_file = self._feature_stats(PREPROCESSOR, NORMALIZER, STATE)
        actions, actions_file = self._feature_stats(POSTPROCESSOR, UNNORMALIZER, ACTION)
        return NormStats(state, actions), " and ".join(dict.fromkeys((state_file, actions_file)))

    def _feature_stats(self, file_name: str, name: str, feature: str) -> tuple[FeatureStats | None, str]:
        where, step = self.folder / file_name, self.pipelines.steps.get(name)
        if step is None or step.state_file is None:
            return None, f"{where} (its {name} has no state_file)"
        file = file_inside(self.folder, step.state_file, where)
        if not file.is_file():
            raise CheckpointError(f"norm stats are missing: {where} names {step.state_file}, which isn't there")
        try:
            tensors = load_file(file)
        except (SafetensorError, OSError) as error:
            raise CheckpointError(f"{file} can't be read as safetensors ({one_line(error)})") from error
        selected = step.config.values.get("normalize_observation_keys")
        if not isinstance(selected, list | None):
            step.config.refuse("normalize_observation_keys", "a list of keys or null")
        applied = feature in step.config.object("features", {}).values and (selected is None or feature in selected)
        if feature == STATE and not applied:  # LeRobot then passes the state through, whatever statistics there are
            return None, f"{file} (the {name}'s features leave out {STATE})"
        found = {key: tensors[f"{feature}.{key}"] for key in STATISTICS if f"{feature}.{key}" in tensors}
        return (self._spread(found, feature, file) if found else None), str(file)

    def _spread(self, found: Mapping[str, Tensor], feature: str, file: Path) -> FeatureStats:
        """Statistics of any dtype, as wide as their feature: LeRobot makes all of them float32 and broadcasts them."""
        where = f"{file}: {feature}"
        rows: dict[str, np.ndarray] = {}
        for name, tensor in found.items():
            if tensor.dtype == torch.bool or tensor.is_complex() or any(size != 1 for size in tensor.shape[:-1]):
                raise CheckpointError(
                    f"{where}: {name} is {str(tensor.dtype).removeprefix('torch.')}{list(tensor.shape)}; expected "
                    "numbers, one for each value of the feature"
                )
            rows[name] = tensor.to(torch.float64).reshape(-1).numpy()
        width = max(len(row) for row in rows.values())
        if width == 1:  # one number for all of the feature
            features = {STATE: ("input_features", "max_state_dim"), ACTION: ("output_features", "max_action_dim")}
            listed, otherwise = features[feature]
            width = self._width(listed, feature, otherwise)
        spread = {name: np.repeat(row, width) if len(row) == 1 else row for name, row in rows.items()}
        return feature_stats(spread, where)

    # -- the robot -----------------------------------------------------------------------------------------------------

    def _robot_options(self) -> dict[str, object]:
        """Cameras in the model's order and names, what observations call them, and the widths of state and actions."""
        inputs = self._features("input_features")
        for key, feature in inputs.items():
            if feature.get("type") not in _FEATURE_TYPES:
                raise CheckpointError(
                    f"{self.file}: {key} has type {shown(feature.get('type'))}; expected one of "
                    f"{', '.join(_FEATURE_TYPES)}"
                )
        visual = [key for key, feature in inputs.items() if feature["type"] == "VISUAL"]
        cameras = [key for key in visual if not _EMPTY_CAMERA.fullmatch(key)]
        if not cameras:
            raise CheckpointError(f"{self.file} lists no camera among its input_features")
        added = (f"{EMPTY_CAMERA}{index}" for index in range(self.config.integer("empty_cameras", 0, 64, default=0)))
        order = [*visual, *(key for key in added if key not in visual)]
        spare = len(order) - len(cameras)
        mask = self.pipelines.relative_mask(self.action_dim)
        if mask is not None and self.state_dim < self.action_dim:
            raise CheckpointError(
                f"{self.folder / POSTPROCESSOR} adds the state to {self.action_dim} relative actions, but the state "
                f"has {self.state_dim} values; LeRobot fails there, or adds its only value to every action"
            )
        options: dict[str, object] = {
            "image_keys": cameras,
            "num_missing_cameras": spare,
            "state_dim": self.state_dim,
            "action_dim": self.action_dim,
        }
        if order != [*cameras, *(f"{EMPTY_CAMERA}{index}" for index in range(spare))]:
            options["camera_order"] = order
        if self.pipelines.rename_map:
            options["rename_map"] = self.pipelines.rename_map
        if (names := self._action_names()) is not None:
            options["action_names"] = names
        return options if mask is None else options | {"relative_dims": mask}

    def _action_names(self) -> list[str] | None:
        """The recording robot's, where the file has one for each action; LeRobot doesn't read others either."""
        names = self.config.values.get("action_feature_names")
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            return None
        return names if len(set(names)) == len(names) == self.action_dim else None

    def _check_actions(self, normalization: Normalization) -> None:
        width = self.action_dim if self.stats.actions is None else self.stats.actions.dim
        if normalization.actions != "identity" and width != self.action_dim:
            raise CheckpointError(
                f"{self.file} says {self.action_dim} values of action, but the statistics have {width}; LeRobot can't "
                "run it either"
            )

    def _features(self, key: str) -> dict[str, dict[str, object]]:
        found = self.config.values.get(key) or {}
        if not isinstance(found, dict) or not all(isinstance(feature, dict) for feature in found.values()):
            self.config.refuse(key, "features with type and shape")
        return found

    def _width(self, features: str, key: str, otherwise: str) -> int:
        """A feature's width; one that isn't listed is as wide as the model, by LeRobot."""
        shape = (
            self._features(features)
            .get(key, {})
            .get("shape", [self.config.integer(otherwise, 1, LIMITS["action_dim"], 32)])
        )
        if not isinstance(shape, list) or len(shape) != 1 or not isinstance(shape[0], int) or shape[0] < 1:
            raise CheckpointError(f"{self.file}: {key} has shape {shown(shape)}; expected one dimension, not empty")
        return shape[0]


def is_lerobot(folder: Path) -> bool:
    """LeRobot's config.json has a `type`; openpi's has none."""
    return (folder / CONFIG).is_file() and "type" in _read_config(folder)


def policy_type(folder: Path) -> str:
    """What LeRobot calls the kind of policy; "" if that is no text."""
    found = _read_config(folder).get("type")
    return found if isinstance(found, str) else ""


def _bare(value: object) -> str:
    return shown(value).strip("'")


def _read_config(folder: Path) -> Mapping[str, object]:
    return read_json(folder / CONFIG, hint="; is the download complete?")
