"""`config=`: what no tensor records about a policy, and where it is taken from.

`open_checkpoint(path, config=...)` takes a preset's name, a path to a .json, a PolicyConfig, or "auto": the file
`turbopi.json` beside the weights, or LeRobot's own files. A .json is an object with these keys, all but `preset`
optional; `preset` names what the rest starts from, and has no place beside a LeRobot checkpoint, which describes
itself.

    preset                a name of turbopi.config.PRESETS, of the same kind (Pi0, Pi0.5, Pi0-FAST) as the weights
    name                  what the policy is called
    robot                 "libero", "droid", ... or a robot's .json, relative to this file
    robot_options         object, passed to the robot in place of the preset's, which are for the preset's robot alone
    normalization         a mode ("quantile", "zscore", ...) or {"state": mode, "actions": mode}
    discrete_state_input  true if the state is written into the prompt (Pi0.5 only)
    action_horizon        H, the number of actions in a chunk: 1 to 1000
    max_prompt_tokens     1 to 8192
    asset_id              folder of norm_stats.json below assets/; null for the only one there
    default_prompt        text or null
    image_resize          "openpi", "lerobot", "lerobot_0.4", which pads images with -3 instead of -1, or
                          "lerobot_smolvla", which pads left and top alone
    prompt_state_dim      zeros fill the state up to so many numbers in the prompt (LeRobot 0.4: 32); null: nothing does
    prompt_as_is          true if Pi0's prompts keep their blanks, underscores and newlines, as in LeRobot
    prompt_labels         true if Pi0.5's prompts without a state keep "Task: " and "Action: ", as in LeRobot
    lerobot_semantics     of LeRobot's checkpoints alone: "0.4", "0.6" (0.5, too), or "auto" for the one that wrote it
    time_grid             "accumulated" (openpi) or "multiplied" (LeRobot)
    num_denoising_steps   1 to 1000, unless whoever runs it says otherwise; else LeRobot's num_inference_steps, or 10
    solver, solver_grid   of a call, unless whoever runs it says otherwise: as UnifiedPolicy's `solver` and `time_grid`
    real_time             object of trained_max_delay (delays that training simulated, control steps),
                          execution_horizon, schedule, max_guidance_weight: see turbopi.config.RealTime. The delay is
                          below the action horizon, the execution horizon at most as long
    text                  object of template, with {prompt} in it, and max_tokens, 1 to 1000: the language head was
                          trained to continue the template (Pi0.5 only). pi052 describes itself
    vision_heads          attention heads of a vision tower of a non-standard width
    lora_alpha            number, or {"vlm": number, "expert": number}: see openpi_lora.py
    lora_rslora           true if adapters were trained rank-stabilised
    base_model            folder of the weights that a peft adapter is for, relative to this file
    target_time           of weights distilled for one denoising step: 0 to 1, or "unused": see target_time.py
    one_step              true if weights were distilled for one denoising step: other numbers are refused
    missing_cameras       "masked", or "black": seen as black images, as by openpi's Pi0-FAST
    action_tokenizer, max_decoding_steps, broken_answers
                          of Pi0-FAST alone: folder of the action tokenizer, relative to this file; tokens of an answer,
                          1 to 1000; "refuse", or "owners" for what the owner's code makes of an answer that is broken
    vlm                   of SmolVLA alone: folder of the vision-language model's config.json, relative to this file
    vision_positions      of SmolVLA alone: "exact", or "shifted" as by transformers 4.55 to 4.57: vision_positions.py
    weights_sha256        what `turbopi inspect --hash` shows of these weights: others are refused at loading

Unknown keys, wrong types and numbers beyond turbopi.config.LIMITS are errors. `config=` replaces a turbopi.json beside
the weights as a whole.

The horizon: the .json's, else the preset's; never config.json's, which openpi doesn't read. A PolicyConfig is taken at
its word, except for sizes, which always come from the tensors. Other files that say otherwise are in the notes.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, get_args

from turbopi.checkpoint.openpi_lora import LoraScale
from turbopi.checkpoint.target_time import UNUSED, TargetTime
from turbopi.config import (
    LIMITS,
    PRESETS,
    WITH_TEXT,
    ImageResize,
    Kind,
    Normalization,
    NormMode,
    PolicyConfig,
    RealTime,
    TextConfig,
    TimeGrid,
    memory_of,
)
from turbopi.models import family_of
from turbopi.models.pi0.solvers import GRIDS, SOLVERS, checked_grid
from turbopi.support.errors import ConfigError
from turbopi.support.reading import is_finite, is_integer, read_json, shown
from turbopi.support.text import did_you_mean, names_known

FILE_NAME = "turbopi.json"
ABOUT_WEIGHTS = {
    "lora_alpha",
    "lora_rslora",
    "base_model",
    "vlm",
    "action_tokenizer",
    "weights_sha256",
    "lerobot_semantics",
    "target_time",
    "vision_positions",
}  # keys of a .json
ConfigSource = str | Path | PolicyConfig


@dataclass(frozen=True)
class Settings:
    """A parsed `config=`: a PolicyConfig, or values to put over a preset or over LeRobot's description."""

    source: str  # for messages and `inspect`: "preset pi05_libero", a path, ...
    policy: PolicyConfig | None = None
    values: Mapping[str, Any] = field(default_factory=dict)

    @property
    def lora(self) -> LoraScale:
        return LoraScale(self.values.get("lora_alpha"), bool(self.values.get("lora_rslora", False)))

    @property
    def weights_sha256(self) -> str | None:
        expected: str | None = self.values.get("weights_sha256")
        return expected

    @property
    def target_time(self) -> TargetTime | None:
        s: TargetTime | None = self.values.get("target_time")
        return s

    @property
    def vision_heads(self) -> int | None:
        heads: int | None = self.values.get("vision_heads")
        return heads


def read_settings(config: ConfigSource, folder: Path) -> Settings:
    """Parse `config=` for the checkpoint in `folder`. Raises ConfigError for whatever can't be right about it."""
    if isinstance(config, PolicyConfig):
        check_real_time(config, f"PolicyConfig {config.name}")
        return Settings(f"PolicyConfig {config.name}", policy=config)
    if isinstance(config, str) and config == "auto":
        file = folder / FILE_NAME
        return _read_file(file) if file.is_file() else Settings("auto")
    if isinstance(config, str) and config in PRESETS:
        return Settings(f"preset {config}", values={"preset": config})
    if isinstance(config, str | Path) and str(config).endswith(".json"):
        return _read_file(Path(config))
    raise ConfigError(
        f"config={str(config)!r} is neither a preset, nor 'auto', nor a path to a .json; "
        + names_known(str(config), "presets are", PRESETS)
    )


def policy_config(settings: Settings, kind: Kind, *, assets: list[str], where: Path) -> PolicyConfig:
    """The policy of an openpi checkpoint, sizes still the preset's.

    `assets` are the asset ids it has. Raises ConfigError, listing the presets that fit, if nothing says which robot it
    is for.
    """
    if settings.policy is not None:
        _check_kind(settings.policy, kind, settings.source, where)
        return settings.policy
    fitting = [name for name, preset in PRESETS.items() if preset.model.kind == kind and not name.endswith("_tiny")]
    if "preset" not in settings.values:
        raise ConfigError(_undetectable(fitting, kind, assets, where, settings))
    if "lerobot_semantics" in settings.values:
        raise ConfigError(
            f"{settings.source}: lerobot_semantics only applies to LeRobot's own checkpoints; {where} isn't"
        )
    preset = PRESETS[settings.values["preset"]]
    _check_kind(preset, kind, settings.source, where)
    return with_values(preset, settings)


_OF_POLICY = (
    "name",
    "robot",
    "robot_options",
    "normalization",
    "discrete_state_input",
    "asset_id",
    "default_prompt",
    "image_resize",
    "prompt_state_dim",
    "prompt_as_is",
    "prompt_labels",
    "missing_cameras",
    "num_denoising_steps",
    "one_step",
    "solver",
    "solver_grid",
    "real_time",
)
_OF_MODEL = ("action_horizon", "max_prompt_tokens", "time_grid", "max_decoding_steps", "broken_answers")


def values_of(config: PolicyConfig) -> dict[str, object]:
    """What a .json may say of a policy, and this one has."""
    return {
        **{key: getattr(config, key) for key in _OF_POLICY},
        **{key: getattr(config.model, key) for key in _OF_MODEL if hasattr(config.model, key)},
    }


def with_values(config: PolicyConfig, settings: Settings) -> PolicyConfig:
    """`config` with the values of a .json over it."""
    values = settings.values
    if values.get("robot", config.robot) != config.robot:  # the options were the other robot's
        config = replace(config, robot_options={})
    config = replace(config, **{key: values[key] for key in _OF_POLICY if key in values})
    of_model = {key: values[key] for key in _OF_MODEL if key in values}
    for key in of_model.keys() - {one.name for one in fields(config.model)}:
        raise ConfigError(f"{settings.source}: {key} can't be chosen for {family_of(config.model).label}")
    config = config.with_model(**of_model)
    if "text" in values:
        _check_text(config, settings.source)
        config = replace(config, text=values["text"])
    check_real_time(config, settings.source)
    if config.discrete_state_input and not (family := family_of(config.model)).state_in_prompt:
        raise ConfigError(
            f"{settings.source}: discrete_state_input is true, but {family.label} reads its state as a number token"
        )
    return config


def _check_text(config: PolicyConfig, source: str) -> None:
    if config.model.kind not in WITH_TEXT or memory_of(config.model) is not None:
        raise ConfigError(f"{source}: text can't be chosen for {family_of(config.model).label}; it is for Pi0.5")
    if config.text is not None:
        raise ConfigError(f"{source}: text can't be chosen for LeRobot's pi052, whose config.json describes it")


def check_real_time(config: PolicyConfig, source: str) -> None:
    """ConfigError for control steps that no chunk has: calls would cut them in silence, or never reach them."""
    horizon, options = config.model.action_horizon, config.real_time
    for name, value, most in (
        ("execution_horizon", options.execution_horizon, horizon),
        ("trained_max_delay", options.trained_max_delay, horizon - 1),
    ):
        if value is not None and value > most:
            raise ConfigError(
                f"{source}: real_time has {name} = {value}, but a chunk has {horizon} actions; expected at most {most}"
            )


def _check_kind(config: PolicyConfig, kind: Kind, source: str, where: Path) -> None:
    if config.model.kind != kind:
        fitting = [name for name, preset in PRESETS.items() if preset.model.kind == kind]
        raise ConfigError(
            f"{source} is for {config.model.kind}, but {where} holds {kind} weights; presets that fit: "
            f"{', '.join(fitting)}"
        )


def _undetectable(fitting: list[str], kind: Kind, assets: list[str], where: Path, settings: Settings) -> str:
    """openpi's checkpoints never record their robot, so "auto" can only list the choices."""
    found = f"{settings.source} has no preset" if settings.values else f"{where} has no {FILE_NAME}"
    suggested = [name for name in fitting if PRESETS[name].asset_id in assets]
    hint = f"; its statistics ({', '.join(assets)}) suggest {' or '.join(suggested)}" if suggested else ""
    return (
        f"{found}, and an openpi checkpoint doesn't record its robot, its horizon, or whether the state goes into the "
        f"prompt. These are {kind} weights{hint}. Choose with config= one of {', '.join(fitting)}, or put a "
        f'{FILE_NAME} beside the weights, such as {{"preset": "{(suggested or fitting)[0]}"}}'
    )


# -- the .json ---------------------------------------------------------------------------------------------------------


def _read_file(file: Path) -> Settings:
    parsed = parse_values(read_json(file, ConfigError), str(file))
    for folder in parsed.keys() & {"base_model", "vlm", "action_tokenizer"}:
        parsed[folder] = str((file.parent / Path(parsed[folder]).expanduser()).resolve())
    robot = parsed.get("robot")
    if robot is not None and robot.endswith(".json"):
        path = file.parent / robot
        if not path.is_file():
            raise ConfigError(f"{file}: robot is {robot!r}, but there is no file {path}")
        parsed["robot"] = str(path.resolve())
    return Settings(str(file), values=parsed)


def parse_values(values: Mapping[str, object], where: str) -> dict[str, Any]:
    """Check a settings object and bring it into PolicyConfig's types. ConfigError names the key and what it may be."""
    unknown = [key for key in values if key not in _SCHEMA]
    if unknown:
        requested = [
            shown(key) + (f" ({meant})" if (meant := did_you_mean(key, _SCHEMA)) else "") for key in unknown[:5]
        ]
        raise ConfigError(f"{where}: unknown keys {', '.join(requested)}; known are {', '.join(_SCHEMA)}")
    parsed = {}
    for key, value in values.items():
        expected, parse = _SCHEMA[key]
        try:
            parsed[key] = parse(value)
        except (TypeError, ValueError, KeyError):
            raise ConfigError(f"{where}: {key} is {shown(value)}; expected {expected}") from None
    return parsed


def _require(condition: bool) -> None:
    if not condition:
        raise ValueError


def _text(value: object) -> str:
    _require(isinstance(value, str) and bool(value.strip()))
    return str(value)


def _text_or_null(value: object) -> str | None:
    return None if value is None else _text(value)


def _name(value: object) -> str:
    _require(isinstance(value, str) and value.isprintable() and len(value) < 1000)
    return _text(value)


def _name_or_null(value: object) -> str | None:
    return None if value is None else _name(value)


def _flag(value: object) -> bool:
    _require(isinstance(value, bool))
    return bool(value)


def _count(limit: int) -> tuple[str, Callable[[object], int]]:
    """What is expected, and the parser of it."""

    def parse(value: object) -> int:
        if not is_integer(value) or not 1 <= value <= limit:
            raise ValueError
        return value

    return f"a whole number from 1 to {limit}", parse


def _count_or_null(limit: int) -> tuple[str, Callable[[object], int | None]]:
    expected, parse = _count(limit)
    return f"{expected}, or null", lambda value: None if value is None else parse(value)


def _sha256(value: object) -> str:
    _require(isinstance(value, str) and re.fullmatch(r"[0-9a-f]{64}", value) is not None)
    return str(value)


def _object(value: object) -> dict[str, object]:
    if not isinstance(value, dict):
        raise ValueError
    return dict(value)


def _choice(*choices: str) -> Callable[[object], str]:
    def parse(value: object) -> str:
        _require(isinstance(value, str) and value in choices)
        return str(value)

    return parse


_MODES = get_args(NormMode)


def _normalization(value: object) -> Normalization:
    mode = _choice(*_MODES)
    if isinstance(value, str):
        return Normalization(mode(value), mode(value))  # type: ignore[arg-type]
    if not isinstance(value, dict) or set(value) != {"state", "actions"}:
        raise ValueError
    return Normalization(mode(value["state"]), mode(value["actions"]))  # type: ignore[arg-type]


def _real_time(value: object) -> RealTime:
    options = _object(value)
    _require(set(options) <= {item.name for item in fields(RealTime)})
    return RealTime(**options)  # type: ignore[arg-type]  # which checks; its ConfigError is a ValueError


def _text_config(value: object) -> TextConfig:
    options = _object(value)
    _require(set(options) <= {"template", "max_tokens"} and isinstance(options.get("template"), str))
    return TextConfig(**options)  # type: ignore[arg-type]  # which checks; its ConfigError is a ValueError


def _solver_grid(value: object) -> TimeGrid:
    if not isinstance(value, str | list):
        raise ValueError
    return checked_grid(value)  # type: ignore[arg-type]  # its ObservationError is a ValueError


_ALPHAS = (1e-6, 1e6)  # in use are 8 to 128


def _number(value: object) -> float:
    if not is_finite(value) or not _ALPHAS[0] <= value <= _ALPHAS[1]:
        raise ValueError
    return float(value)


def _target_time(value: object) -> TargetTime:
    if value == UNUSED:
        return UNUSED
    if not is_finite(value) or not 0 <= value <= 1:
        raise ValueError
    return float(value)


def _lora_alpha(value: object) -> dict[str, float]:
    if not isinstance(value, dict):
        return {"vlm": _number(value), "expert": _number(value)}
    _require(bool(value) and set(value) <= {"vlm", "expert"})
    return {key: _number(alpha) for key, alpha in value.items()}


_SCHEMA: dict[str, tuple[str, Callable[[object], object]]] = {
    "preset": (f"one of {', '.join(PRESETS)}", _choice(*PRESETS)),
    "name": ("a text on one line", _name),
    "robot": ("a robot's name or a path to its .json", _name),
    "robot_options": ("an object", _object),
    "normalization": (f"one of {', '.join(_MODES)}, or {{'state': ..., 'actions': ...}} of them", _normalization),
    "discrete_state_input": ("true or false", _flag),
    "action_horizon": _count(LIMITS["action_horizon"]),
    "max_prompt_tokens": _count(LIMITS["max_prompt_tokens"]),
    "asset_id": ("a folder's name below assets/, or null", _name_or_null),
    "default_prompt": ("a text or null", _text_or_null),
    "image_resize": (f"one of {', '.join(get_args(ImageResize))}", _choice(*get_args(ImageResize))),
    "prompt_state_dim": _count_or_null(LIMITS["action_dim"]),
    "prompt_as_is": ("true or false", _flag),
    "prompt_labels": ("true or false", _flag),
    "lerobot_semantics": ("'0.4', '0.6' or 'auto'", _choice("0.4", "0.6", "auto")),
    "time_grid": ("'accumulated' or 'multiplied'", _choice("accumulated", "multiplied")),
    "num_denoising_steps": _count(LIMITS["num_denoising_steps"]),
    "solver": (f"one of {', '.join(SOLVERS)}", _choice(*SOLVERS)),
    "solver_grid": (f"one of {', '.join(GRIDS)}, or times that fall strictly from 1 to 0", _solver_grid),
    "real_time": (
        "an object with trained_max_delay, execution_horizon (whole numbers of control steps), schedule (exponential, "
        "linear, ones or zeros) or max_guidance_weight (a number from 0)",
        _real_time,
    ),
    "text": (
        "an object with template, a text with {prompt} in it, and perhaps max_tokens, a whole number from 1 to 1000",
        _text_config,
    ),
    "vision_heads": _count(LIMITS["num_heads"]),
    "lora_alpha": ("a number from 1e-6 to 1e6, or an object with vlm and expert", _lora_alpha),
    "lora_rslora": ("true or false", _flag),
    "base_model": ("a folder", _text),
    "vlm": ("a folder", _text),
    "vision_positions": ("'exact' or 'shifted'", _choice("exact", "shifted")),
    "action_tokenizer": ("a folder", _text),
    "max_decoding_steps": _count(LIMITS["max_decoding_steps"]),
    "broken_answers": ("'refuse' or 'owners'", _choice("refuse", "owners")),
    "missing_cameras": ("'masked' or 'black'", _choice("masked", "black")),
    "target_time": (f"a number from 0 to 1, or {UNUSED!r}", _target_time),
    "one_step": ("true or false", _flag),
    "weights_sha256": ("64 digits, 0 to 9 and a to f, as `turbopi inspect --hash` shows them", _sha256),
}
