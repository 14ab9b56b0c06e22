"""Writing checkpoints in openpi's PyTorch layout, from any format, without holding the weights in memory.

    model.safetensors                  openpi's names; the tied embedding once, as lm_head; all in one dtype, as by
                                       openpi's own converter (whose bf16 also rounds what is served in float32)
    config.json                        what openpi's converter records
    assets/<asset id>/norm_stats.json
    turbopi.json                       what the layout can't record: robot, horizon, prompt, normalisation, vision heads
    *.model                            the source folder's SentencePiece tokenizer, if it has one

openpi insists on `gemma_expert.lm_head.weight`, which nothing reads: it is written as zeros, as a hole in the file.
Everything is written into a temporary folder beside the target and renamed at the end, so a failure leaves nothing.
"""

import json
import os
import shutil
from dataclasses import asdict, fields
from pathlib import Path

import torch

from turbopi.checkpoint.base import Checkpoint, progress_bar
from turbopi.checkpoint.names import EMBEDDING, TIED_EMBEDDING, TIED_HEAD, UNUSED_HEAD, to_openpi
from turbopi.checkpoint.norm_stats import FILE_NAME as NORM_STATS
from turbopi.checkpoint.norm_stats import dump_norm_stats
from turbopi.checkpoint.opening import open_checkpoint
from turbopi.checkpoint.random_weights import random_checkpoint
from turbopi.checkpoint.settings import FILE_NAME as SETTINGS
from turbopi.checkpoint.settings import ConfigSource, Settings, parse_values, policy_config
from turbopi.checkpoint.sizes import VARIANTS
from turbopi.checkpoint.source import RANDOM_KEY, check_finite
from turbopi.checkpoint.tensor_file import TensorFile
from turbopi.checkpoint.torch_files import WEIGHTS
from turbopi.config import PRESETS, GemmaConfig, ModelConfig, PolicyConfig, RealTime
from turbopi.models.pi0.reference import FloatPrecision
from turbopi.support.errors import CheckpointError, ConfigError
from turbopi.support.files import new_folder

DTYPES: dict[FloatPrecision, tuple[str, torch.dtype]] = {
    "bf16": ("BF16", torch.bfloat16),
    "f32": ("F32", torch.float32),
}


def convert(
    src: str | Path | Checkpoint,
    dst: str | Path,
    *,
    precision: FloatPrecision,
    config: ConfigSource = "auto",
    progress: bool = False,
) -> Path:
    """Write the checkpoint `src` to the folder `dst` in openpi's PyTorch layout; returns `dst`.

    Weights become bfloat16 ("bf16", rounded to nearest even) or float32 ("f32"). Statistics are written as they are;
    LeRobot's way of applying them is recorded in turbopi.json, since its epsilons aren't openpi's.

    Raises CheckpointError if `dst` exists and isn't an empty folder, and whatever `open_checkpoint` raises.
    """
    if precision not in DTYPES:
        raise ConfigError(f"precision is {precision!r}; expected one of {', '.join(DTYPES)}")
    dst = check_new(dst)
    checkpoint = src if isinstance(src, Checkpoint) else open_checkpoint(src, config)
    with new_folder(dst) as folder:
        write_beside(checkpoint, folder)
        _write_json(folder / "config.json", _openpi_config(checkpoint.config.planned_model, precision))
        _write_weights(checkpoint, folder / WEIGHTS, precision, progress)
    return dst


def check_new(folder: str | Path) -> Path:
    """The path of a folder that is to be written. Raises CheckpointError if it exists and isn't an empty folder."""
    folder = Path(folder).expanduser()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise CheckpointError(f"{folder} exists and isn't an empty folder; give a new one")
    return folder


def write_random(
    preset: str | PolicyConfig,
    dst: str | Path,
    *,
    precision: FloatPrecision = "bf16",
    seed: int = 0,
    progress: bool = False,
) -> Path:
    """Write random weights of a preset as a checkpoint folder; see `random_checkpoint` and `convert`."""
    return convert(random_checkpoint(preset, seed), dst, precision=precision, progress=progress)


# -- the weights -------------------------------------------------------------------------------------------------------


def _write_weights(checkpoint: Checkpoint, file: Path, precision: FloatPrecision, progress: bool) -> None:
    """Header first, then every piece at its place."""
    stored, dtype = DTYPES[precision]
    tensors = {to_openpi(name): (stored, shape) for name, shape in checkpoint.source.shapes.items()}
    model = checkpoint.config.planned_model
    tensors[UNUSED_HEAD] = (stored, (model.vocab_size, model.expert.width))
    about = {TIED_EMBEDDING: TIED_HEAD}  # openpi's files record the tie like this
    if checkpoint.random is not None:
        about[RANDOM_KEY] = checkpoint.random
    with (
        file.open("wb") as out,
        progress_bar(progress, f"writing {file.name}", checkpoint.stored_bytes) as advance,
    ):
        written = TensorFile(out, tensors, about)
        for piece in checkpoint.source.pieces(torch.device("cpu")):
            values = piece.values.to(dtype)
            check_finite(values, checkpoint.source.native_name(piece.name), checkpoint.path)
            written.write(to_openpi(piece.name), values, piece.start)
            advance.update(piece.values.numel() * piece.values.element_size())
        out.flush()
        os.fsync(out.fileno())


# -- what goes beside them ---------------------------------------------------------------------------------------------


def write_beside(checkpoint: Checkpoint, folder: Path) -> None:
    """Write what a checkpoint is besides its weights: turbopi.json, the robot's file, statistics and tokenizer.

    Raises ConfigError if some value of a hand-made PolicyConfig has no place in turbopi.json.
    """
    asset_id = checkpoint.asset_id or ("lerobot" if checkpoint.format == "lerobot" else "own")
    settings, robot_file = _settings(checkpoint.config, asset_id)
    _write_json(folder / SETTINGS, settings)
    if robot_file is not None:
        shutil.copyfile(robot_file, folder / robot_file.name)
    for file in checkpoint.tokenizer_candidates:
        copy = folder / (file.relative_to(checkpoint.path) if checkpoint.path else file.name)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, copy)
    if checkpoint.named_tokenizer is not None:
        (folder / "tokenizer").mkdir(exist_ok=True)
        for name in ("tokenizer.json", "tokenizer_config.json", "tokenizer.model"):
            if (checkpoint.named_tokenizer / name).is_file():
                shutil.copyfile(checkpoint.named_tokenizer / name, folder / "tokenizer" / name)
    if checkpoint.norm_stats.state is not None or checkpoint.norm_stats.actions is not None:
        file = folder / "assets" / asset_id / NORM_STATS
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(dump_norm_stats(checkpoint.norm_stats))


def _openpi_config(model: ModelConfig, precision: FloatPrecision) -> dict[str, object]:
    return {
        "action_dim": model.action_dim,
        "action_horizon": model.action_horizon,
        "paligemma_variant": _variant(model.vlm),
        "action_expert_variant": _variant(model.expert),
        "precision": "bfloat16" if precision == "bf16" else "float32",
    }


def _variant(sizes: GemmaConfig) -> str:
    return next((name for name, known in VARIANTS.items() if known == sizes), "custom")


def _settings(config: PolicyConfig, asset_id: str) -> tuple[dict[str, object], Path | None]:
    """The turbopi.json that brings `config` back, and the robot's own file if it has one.

    Raises ConfigError if some value of a hand-made PolicyConfig has no place in it.
    """
    robot = Path(config.robot) if config.robot.endswith(".json") else None
    preset = config.name if _is_preset(config) else f"{config.planned_model.kind}_base"
    values = {
        "preset": preset,
        "name": config.name,
        "robot": robot.name if robot else config.robot,
        "robot_options": dict(config.robot_options),
        "normalization": asdict(config.normalization),
        "discrete_state_input": config.discrete_state_input,
        "action_horizon": config.model.action_horizon,
        "max_prompt_tokens": config.model.max_prompt_tokens,
        "asset_id": asset_id,
        "default_prompt": config.default_prompt,
        "image_resize": config.image_resize,
        "prompt_state_dim": config.prompt_state_dim,
        "prompt_as_is": config.prompt_as_is,
        "time_grid": config.model.time_grid,
        "num_denoising_steps": config.num_denoising_steps,
        "vision_heads": config.planned_model.vision.num_heads,
    }
    if config.one_step:
        values["one_step"] = True
    if config.prompt_labels:
        values["prompt_labels"] = True
    if config.real_time != RealTime():
        values["real_time"] = asdict(config.real_time)
    if config.solver != "euler":
        values["solver"] = config.solver
    if config.solver_grid != "uniform":
        values["solver_grid"] = config.solver_grid if isinstance(config.solver_grid, str) else [*config.solver_grid]
    for name in ("default_prompt", "prompt_state_dim"):  # null says nothing where the preset has none either
        if values[name] is None and getattr(PRESETS[preset], name) is None:
            del values[name]
    parsed = Settings(SETTINGS, values=parse_values(json.loads(json.dumps(values)), SETTINGS))
    back = policy_config(parsed, config.planned_model.kind, assets=[], where=Path(SETTINGS))
    lost = [
        f"{owner}.{item.name}"
        for owner, ours, theirs in (
            ("config", config, back),
            ("config.model", config.model, back.model),
            ("config.planned_model.vision", config.planned_model.vision, back.planned_model.vision),
        )
        for item in fields(ours)
        if item.name not in _ELSEWHERE and getattr(ours, item.name) != getattr(theirs, item.name)
    ]
    if lost:
        raise ConfigError(f"{SETTINGS} has no place for {', '.join(lost)}, so this config can't be converted")
    return values, robot


# compared on their own, read from the tensors, or changed on purpose
_ELSEWHERE = {"model", "vision", "vlm", "expert", "robot", "asset_id", "vocab_size", "action_dim"} | {
    "width",
    "depth",
    "mlp_dim",
    "num_heads",
    "patch_size",
    "image_size",
}


def _is_preset(config: PolicyConfig) -> bool:
    return config.name in PRESETS and PRESETS[config.name].model.kind == config.model.kind


def _write_json(file: Path, content: dict[str, object]) -> None:
    file.write_text(json.dumps(content, indent=2) + "\n")


assert to_openpi(EMBEDDING) == TIED_HEAD
