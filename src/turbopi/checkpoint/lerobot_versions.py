"""Which LeRobot wrote a checkpoint of Pi0.5 or Pi0: 0.4 computed other things than 0.5 and 0.6 do, from the same files.

    version         prompt                              letterbox    t
    0.4.0 - 0.4.2   the state, and zeros up to 32       -3           summed up in float32
    0.4.3, 0.4.4    the state, and zeros up to 32       -3           1 + step * dt
    0.5.0 - 0.6.1   the state as wide as it is          -1           1 + step * dt

The prompt of Pi0 has no state in any of them, the rest is as Pi0.5's. SmolVLA's t alone differs, as theirs.

No file holds a version. But LeRobot writes every field of its config, and has added some: `freeze_vision_encoder` in
0.4.3, `use_relative_actions` in 0.5.1. The config of 0.5.0 is that of 0.4.4, but 0.4 ties lm_head to the embedding and
stores one of them, 0.5 stores both. Sources: LeRobot's `policies/pi0` and `policies/pi05` of each version.
"""

from collections.abc import Collection
from pathlib import Path
from typing import Literal

from turbopi.checkpoint.torch_files import WEIGHTS, read_header
from turbopi.support.errors import CheckpointError

Semantics = Literal["0.4", "0.6"]  # 0.6 is 0.5, too

_STATISTICS = ("normalize_inputs.", "normalize_targets.", "unnormalize_outputs.")
# what 0.4.0 writes into config.json, and every later one: of any policy, and of Pi0 and Pi0.5
_OF_ANY = {
    *("type", "n_obs_steps", "input_features", "output_features", "device", "use_amp", "push_to_hub", "repo_id"),
    *("private", "tags", "license", "pretrained_path"),
}
FIRST_KEYS = frozenset(
    {
        *_OF_ANY,
        *("paligemma_variant", "action_expert_variant", "dtype"),
        *("chunk_size", "n_action_steps", "max_state_dim", "max_action_dim", "num_inference_steps"),
        *("time_sampling_beta_alpha", "time_sampling_beta_beta", "time_sampling_scale", "time_sampling_offset"),
        *("min_period", "max_period", "image_resolution", "empty_cameras", "tokenizer_max_length"),
        *("normalization_mapping", "gradient_checkpointing", "compile_model", "compile_mode", "optimizer_lr"),
        *("optimizer_betas", "optimizer_eps", "optimizer_weight_decay", "optimizer_grad_clip_norm"),
        *("scheduler_warmup_steps", "scheduler_decay_steps", "scheduler_decay_lr"),
    }
)


def detect(keys: Collection[str], *, untied: bool) -> Semantics | None:
    """What the files say: `keys` of config.json, and whether the weights hold lm_head and the embedding.

    None: a config.json that no LeRobot has written as it is.
    """
    if "use_relative_actions" in keys:
        return "0.6"
    if not set(keys) >= FIRST_KEYS:
        return None
    return "0.6" if untied and "freeze_vision_encoder" in keys else "0.4"


def sums_up_time(keys: Collection[str]) -> bool:
    """Whether it was 0.4.0 to 0.4.2."""
    return set(keys) >= FIRST_KEYS and "freeze_vision_encoder" not in keys


def smolvla_sums_up_time(keys: Collection[str]) -> bool:
    """Whether a SmolVLA is of 0.4.0 to 0.4.2: `use_peft` is of 0.4.3."""
    return set(keys) >= _OF_ANY and "use_peft" not in keys


def may_have_shifted_positions(keys: Collection[str]) -> bool:
    """Whether a SmolVLA may be of 0.4, see vision_positions.py: no key is of 0.5, `pretrained_revision` is of 0.6."""
    return "pretrained_revision" not in keys


def check_migrated(folder: Path, preprocessor: Path) -> None:
    """CheckpointError for a folder of before 0.4, whose statistics are among the weights."""
    weights = folder / WEIGHTS
    if preprocessor.exists() or not weights.is_file():
        return
    if any(stored.key.startswith(_STATISTICS) for stored in read_header(weights)):
        raise CheckpointError(
            f"{folder} is of a LeRobot before 0.4: its statistics are among the weights, and it has no processors. "
            "LeRobot 0.4 and later don't read it either. Once, in LeRobot's environment: python -m "
            f"lerobot.processor.migrate_policy_normalization --pretrained-path {folder}. Then give the folder that "
            "this writes, whose name ends in _migrated"
        )


def note(done: Semantics, written_by: Semantics | None, prompt_width: int) -> str:
    """What `inspect` should say where LeRobot's versions differ about a checkpoint, and nobody has chosen."""
    computes = {"0.4": "images padded with -3", "0.6": "images padded with -1"}
    if prompt_width:
        computes["0.4"] = f"at least {prompt_width} numbers of state in the prompt, {computes['0.4']}"
        computes["0.6"] = f"the robot's own numbers of state in the prompt, {computes['0.6']}"
    other: Semantics = "0.6" if done == "0.4" else "0.4"
    who = f"LeRobot {written_by} wrote this checkpoint" if written_by else "no file tells which LeRobot wrote this"
    return (
        f"{who}: what LeRobot {done} computes is done ({computes[done]}). LeRobot {other} computes something else from "
        f'the same files ({computes[other]}): {{"lerobot_semantics": "{other}"}} in a turbopi.json does that'
    )
