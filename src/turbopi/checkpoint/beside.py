"""Files beside the weights that say something about the policy and aren't read: notes where they say otherwise.

config.json    openpi's converter and other tools write it beside openpi's weights. openpi itself never reads it.
turbopi.json   `config=` replaces it.
"""

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

from turbopi.checkpoint.settings import ABOUT_WEIGHTS, FILE_NAME, Settings, read_settings, values_of
from turbopi.checkpoint.sizes import VARIANTS
from turbopi.checkpoint.source import WeightSource, listing
from turbopi.config import GemmaConfig, PolicyConfig, RealTime
from turbopi.models import family_of
from turbopi.support.errors import CheckpointError, ConfigError
from turbopi.support.reading import read_json, shown

CONFIG = "config.json"
_DTYPES = {"bfloat16": "BF16", "bf16": "BF16", "float32": "F32", "fp32": "F32", "float16": "F16", "fp16": "F16"}


def notes_on_config_json(folder: Path, source: WeightSource, policy: PolicyConfig | None) -> list[str]:
    """Where the config.json of an openpi folder says otherwise than weights and policy (None: it isn't known yet)."""
    file = folder / CONFIG
    if not file.is_file():
        return []
    try:
        said = {key: value for key, value in read_json(file).items() if value is not None}
    except CheckpointError as error:
        return [f"openpi doesn't read {CONFIG}, nor does Turbo-Pi: {error}"]
    facts: dict[str, object] = {
        "precision": " and ".join(sorted(set(source.dtypes.values()))),
        "action_horizon": "the configuration's",
    }
    if policy is not None:
        facts |= {
            "action_dim": policy.model.action_dim,
            "action_horizon": policy.model.action_horizon,
            "chunk_size": policy.model.action_horizon,  # Dexbotic's
            "max_token_len": policy.model.max_prompt_tokens,
            "discrete_state_input": policy.discrete_state_input,
            "pi05": family_of(policy.model).modulated,
        }
        stacks = {"paligemma_variant": "vlm", "action_expert_variant": "expert"}
        facts |= {key: getattr(policy.model, name) for key, name in stacks.items() if hasattr(policy.model, name)}
    others = [
        f"{key} = {shown(said[key])} (used: {_readable(fact)})"
        for key, fact in facts.items()
        if key in said and not _agrees(said[key], fact)
    ]
    return [f"{file} isn't read, nor does openpi read it. It says {', '.join(others)}"] if others else []


def _agrees(said: object, fact: object) -> bool:
    if isinstance(fact, GemmaConfig):  # a name that openpi hasn't is a fork's
        return isinstance(said, str) and VARIANTS.get(said.removesuffix("_lora"), fact) == fact
    if isinstance(fact, str):
        return _DTYPES.get(str(said)) == fact
    return type(said) is type(fact) and said == fact


def _readable(fact: object) -> str:
    if isinstance(fact, GemmaConfig):
        return f"{fact.width} wide, {fact.depth} layers, an MLP of {fact.mlp_dim}"
    return str(fact)


def notes_on_settings(
    folder: Path, given: Settings, policy: PolicyConfig, policy_of: Callable[[Settings], PolicyConfig]
) -> list[str]:
    """Where a turbopi.json says otherwise than the `config=` that replaces it; `policy_of` makes its policy."""
    file = folder / FILE_NAME
    if given.source == "auto" or not file.is_file() or file.resolve() == Path(given.source).resolve():
        return []
    unread = f"{file} isn't read: {given.source} replaces it"
    try:
        beside = read_settings("auto", folder)
        theirs = values_of(policy_of(beside))
    except (CheckpointError, ConfigError) as error:
        return [f"{unread}. By itself it is refused: {error}"]
    ours = values_of(policy)
    others = [
        f"{name} = {shown(value)} (used: {shown(used)})"
        for key, all_of_it in theirs.items()
        if key != "name"
        for name, value, used in _differing(key, all_of_it, ours[key])
    ]
    heads = {"vision_heads": policy.model.vision.num_heads}
    others += [
        f"{key} = {shown(value)}"
        for key, value in beside.values.items()
        if key in {*ABOUT_WEIGHTS, *heads} and value != given.values.get(key, heads.get(key))
    ]
    return [f"{unread}. With it: {listing(others, 20)}"] if others else []


def _differing(key: str, theirs: object, ours: object) -> list[tuple[str, object, object]]:
    """A value that differs, or the fields of it that do: name, theirs, ours."""
    if isinstance(theirs, RealTime) and isinstance(ours, RealTime):
        pairs = [(f"{key}.{one.name}", getattr(theirs, one.name), getattr(ours, one.name)) for one in fields(theirs)]
    else:
        pairs = [(key, theirs, ours)]
    return [pair for pair in pairs if pair[1] != pair[2]]
