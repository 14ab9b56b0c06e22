"""Opening a checkpoint: find it, read its description, check its tensors, and settle its configuration."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from turbopi.checkpoint.base import Checkpoint, describe_weights, norm_stats_info
from turbopi.checkpoint.beside import notes_on_config_json, notes_on_settings
from turbopi.checkpoint.lerobot import LeRobotFolder, policy_type
from turbopi.checkpoint.lerobot_fast import FastFolder
from turbopi.checkpoint.lerobot_smolvla import SmolVLAFolder
from turbopi.checkpoint.lerobot_text import TextFolder
from turbopi.checkpoint.locate import Location, locate, tokenizer_candidates
from turbopi.checkpoint.norm_stats import asset_ids, find_norm_stats
from turbopi.checkpoint.onnx_folder import GraphSource, open_export
from turbopi.checkpoint.openpi_jax import JaxSource
from turbopi.checkpoint.other_programs import check_state, in_known_layout, statistics_folder
from turbopi.checkpoint.peft_adapter import CONFIG as ADAPTER
from turbopi.checkpoint.peft_adapter import PeftSource, base_model
from turbopi.checkpoint.quantized_folder import QuantizedSource
from turbopi.checkpoint.settings import ConfigSource, Settings, policy_config, read_settings
from turbopi.checkpoint.sizes import detect_kind, model_sizes
from turbopi.checkpoint.source import WeightSource, check_tensors
from turbopi.checkpoint.target_time import with_target_time
from turbopi.checkpoint.torch_files import TorchSource
from turbopi.config import Kind, ModelConfig, Pi0FastConfig, PolicyConfig
from turbopi.models import FAMILIES, family_of, parameter_shapes
from turbopi.support.errors import CheckpointError, ConfigError
from turbopi.support.hub_cache import hub_folder

OPENPIS_ACTION_TOKENIZER = "physical-intelligence/fast"


def open_checkpoint(path: str | Path, config: ConfigSource = "auto") -> Checkpoint:
    """Open an openpi (PyTorch or JAX) or LeRobot checkpoint, or what `turbopi export` or `convert` made of one.

    Everything is checked, nothing loaded.

    `path` is a checkpoint's folder (openpi's params/ and LeRobot's training output are understood too). `config` says
    what the folder doesn't record (docs/checkpoints.md). Sizes always come from the tensors.

    Raises CheckpointError if the folder can't be read or its tensors or statistics aren't all there, and ConfigError if
    the configuration doesn't fit or isn't known; the message lists the choices.
    """
    location = locate(path)
    settings = read_settings(config, location.folder)
    source = open_weights(location, settings)
    if location.format == "lerobot":
        return _open_lerobot(location, settings, source)
    kind, folder = detect_kind(source, location.weights), location.folder
    assets = statistics_folder(folder, source)

    def policy_of(settings: Settings) -> PolicyConfig:
        return policy_config(settings, kind, assets=asset_ids(assets / "assets"), where=folder)

    chosen = policy_of(settings)
    source, chosen = _with_target_time(source, chosen, settings, location)
    check_state(source, chosen, settings.source)
    policy = _with_sizes(chosen, source, settings, location)
    found = find_norm_stats(assets, policy.asset_id, policy.normalization)
    source.notes += found.notes
    if location.format not in ("onnx", "quantized"):
        source.notes += notes_on_config_json(folder, source, policy)
    source.notes += notes_on_settings(folder, settings, replace(policy, asset_id=found.asset_id), policy_of)
    return Checkpoint(
        path=folder,
        config=policy,
        config_source=settings.source,
        norm_stats=found.stats,
        source=source,
        asset_id=found.asset_id,
        expected_sha256=settings.weights_sha256,
        tokenizer_candidates=tuple(tokenizer_candidates(folder)),
        **_openpis_action_tokenizer(settings, policy, folder),
    )


def _openpis_action_tokenizer(settings: Settings, policy: PolicyConfig, folder: Path) -> dict[str, Any]:
    if (family := family_of(policy.model)).reader is None:
        if "action_tokenizer" in settings.values:
            raise ConfigError(f"{settings.source}: action_tokenizer can't be chosen for {family.label}")
        return {}
    cached = hub_folder(OPENPIS_ACTION_TOKENIZER)
    own = (folder / "action_tokenizer", *(() if cached is None else (cached,)))
    return {
        "action_tokenizers": _action_tokenizers(settings, own),
        "action_tokenizer_name": OPENPIS_ACTION_TOKENIZER,
    }


def inspect_checkpoint(path: str | Path, config: ConfigSource = "auto") -> dict[str, Any]:
    """`open_checkpoint(path, config).info()`; if only its configuration can't be settled, what is known without it.

    The key "config_error" then holds the ConfigError's message. CheckpointErrors are raised as ever, and so is the
    ConfigError about LoRA adapters whose alpha isn't known.
    """
    try:
        return open_checkpoint(path, config).info()
    except ConfigError as error:
        location = locate(path)
        settings = _without_policy(config, location)
        source = open_weights(location, settings)
        if location.format in ("openpi_torch", "openpi_jax"):
            source.notes += notes_on_config_json(location.folder, source, None)
        return {
            **describe_weights(source),
            "path": str(location.folder),
            "random_weights": getattr(source, "random", None) is not None,
            "kind": _kind(location, source),
            "assets": asset_ids(location.folder / "assets"),
            **(_lerobot_statistics(location, settings) if location.format == "lerobot" else {}),
            **dict(zip(("action_dim",), source.shapes.get("action_in_proj.weight", ())[1:2], strict=False)),
            "tokenizers": [str(file) for file in tokenizer_candidates(location.folder)],
            "config_error": str(error),
        }


def _without_policy(config: ConfigSource, location: Location) -> Settings:
    """Of `config`, what weights and statistics are read by: an adapter's base, and LeRobot's modes if it has others."""
    try:
        values = read_settings(config, location.folder).values
    except ConfigError:
        values = {}
    lerobot = location.format == "lerobot"
    needed = {"base_model": location.adapter, "vlm": lerobot, "normalization": lerobot}
    return Settings("none", values={key: values[key] for key in needed if needed[key] and key in values})


def _lerobot_statistics(location: Location, settings: Settings) -> dict[str, Any]:
    """As `Checkpoint.info` has them. LeRobot keeps them in the processors' files, not below assets/."""
    folder = _lerobot_folder(location)(location.folder, settings)
    return {"normalization": asdict(folder.normalization), "norm_stats": norm_stats_info(folder.stats)}


def open_weights(location: Location, settings: Settings) -> WeightSource:
    """The weights at a location, names and shapes only."""
    source = _source(location, settings)
    source.notes[:0] = location.notes
    return source


def _source(location: Location, settings: Settings) -> WeightSource:
    if location.format == "openpi_jax":
        return JaxSource(location.weights, settings.lora)
    if settings.values.keys() & {"lora_alpha", "lora_rslora"}:
        raise ConfigError(f"{settings.source}: lora_alpha and lora_rslora only apply to openpi's JAX checkpoints")
    if location.adapter:
        return _open_adapter(location, settings)
    if "base_model" in settings.values:
        raise ConfigError(f"{settings.source}: base_model only applies to adapters, and {location.weights} has weights")
    if location.format == "onnx":
        return GraphSource(open_export(location.folder))
    if location.format == "quantized":
        return QuantizedSource(location.folder)
    if location.format == "lerobot":
        source: WeightSource = _lerobot_weights(location.weights, location)
    else:
        source = in_known_layout(TorchSource(location.weights, format=location.format), location.weights)
    if (location.weights / ADAPTER).is_file():
        source.notes.append(f"{ADAPTER} isn't followed: there are whole weights, and no use_peft = true in config.json")
    return source


def _lerobot_weights(folder: Path, location: Location) -> TorchSource:
    """In `folder`, named as the type of policy at `location` names them."""
    return TorchSource(
        folder, format="lerobot", prefix="model.", names=_lerobot_folder(location).names(location.folder)
    )


def _open_adapter(location: Location, settings: Settings) -> WeightSource:
    folder = base_model(location.folder, settings.values.get("base_model"))
    base = locate(folder)
    if base.adapter or base.format == "openpi_jax":
        what = "an adapter itself: merge it" if base.adapter else "openpi's JAX format: convert it (turbopi convert)"
        raise CheckpointError(f"the base model of {location.folder} is {base.folder}, which is {what} first")
    weights = _lerobot_weights(base.weights, location)
    weights.notes[:0] = base.notes
    return PeftSource(location.folder, weights, base.folder)


_READERS: Mapping[Kind, type[LeRobotFolder]] = {  # of families whose weights have names of their own
    "smolvla": SmolVLAFolder,
    "pi0_fast": FastFolder,
}


def _lerobot_folder(location: Location) -> type[LeRobotFolder]:
    """The reader of its type of policy."""
    if policy_type(location.folder) == "pi052":
        return TextFolder
    kind = _own_kind(location)
    return LeRobotFolder if kind is None else _READERS[kind]


def _own_kind(location: Location) -> Kind | None:
    """The family of a LeRobot folder whose weights aren't named as Pi0's are, by its config.json."""
    kind = policy_type(location.folder)
    return next((one for one in _READERS if one == kind), None)


def _kind(location: Location, source: WeightSource) -> Kind:
    """The family, by the weights; where their names aren't Pi0's, by LeRobot's config.json."""
    own = _own_kind(location) if location.format == "lerobot" else None
    return own or detect_kind(source, location.weights)


def _open_lerobot(location: Location, settings: Settings, source: WeightSource) -> Checkpoint:
    untied, reader = getattr(source, "untied", False), _lerobot_folder(location)
    detected = None if reader in _READERS.values() else detect_kind(source, location.weights)  # or what they look like
    for kind, other in _READERS.items():
        if other is not reader and (keys := settings.values.keys() & other.own_settings):
            raise ConfigError(f"{settings.source}: {min(keys)} only applies to {FAMILIES[kind].label}")
    folder = reader(location.folder, settings, untied=untied)
    if detected is not None:
        _check_type(detected, folder)
    source, chosen = _with_target_time(source, folder.policy_config(), settings, location)
    policy = _with_sizes(chosen, source, settings, location)
    _check_type(policy.model.kind, folder)
    source = folder.weights(source, policy.model)
    source.notes.extend(folder.notes())
    source.notes += notes_on_settings(
        location.folder,
        settings,
        policy,
        lambda other: reader(location.folder, other, untied=untied).policy_config(),
    )
    return Checkpoint(
        path=location.folder,
        config=policy,
        config_source="LeRobot's config.json and processors" if settings.source == "auto" else settings.source,
        norm_stats=folder.norm_stats(policy.normalization),
        expected_sha256=settings.weights_sha256,
        source=source,
        tokenizer_candidates=tuple(tokenizer_candidates(location.folder)),
        named_tokenizer=folder.named_tokenizer,
        action_tokenizers=_action_tokenizers(settings, folder.action_tokenizers),
        action_tokenizer_name=folder.action_tokenizer_name,
    )


def _check_type(kind: Kind, folder: LeRobotFolder) -> None:
    if kind != folder.kind:
        raise CheckpointError(f"{folder.folder}: config.json says {folder.kind}, but these are {kind} weights")


def _action_tokenizers(settings: Settings, own: tuple[Path, ...]) -> tuple[Path, ...]:
    given = settings.values.get("action_tokenizer")
    return own if given is None else (Path(given),)


def _with_target_time(
    source: WeightSource, policy: PolicyConfig, settings: Settings, location: Location
) -> tuple[WeightSource, PolicyConfig]:
    """Weights with their target time, and the policy, then of one step."""
    s = settings.target_time
    source = with_target_time(source, s, location.weights, settings.source)
    distilled = isinstance(s, float)
    if not distilled and not policy.one_step:
        return source, policy
    if settings.values.get("num_denoising_steps", 1) != 1 or (distilled and not settings.values.get("one_step", True)):
        raise ConfigError(
            f"{settings.source}: these weights were distilled for one denoising step, so num_denoising_steps is 1 and "
            "one_step true: leave both out"
        )
    return source, replace(policy, one_step=True, num_denoising_steps=1)


def _with_sizes(policy: PolicyConfig, source: WeightSource, settings: Settings, location: Location) -> PolicyConfig:
    """`policy` with the checkpoint's sizes, after every tensor is checked against them."""
    model = policy.model
    if isinstance(model, ModelConfig | Pi0FastConfig):
        model = model_sizes(source, model, vision_heads=settings.vision_heads, where=location.weights)
    try:
        check_tensors(source, parameter_shapes(model), location.weights)
    except CheckpointError as error:
        if location.format == "lerobot" and (hint := _lerobot_folder(location).sizes_hint):
            raise CheckpointError(f"{error}. {hint}") from error
        raise
    return replace(policy, model=model)
