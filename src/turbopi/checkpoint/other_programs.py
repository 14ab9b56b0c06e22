"""Pi0 and Pi0.5 as RLinf, Dexbotic and StarVLA save them: read by the names of their tensors, or refused by name."""

from pathlib import Path

from turbopi.checkpoint.names import HEAD, DexboticNames, RenamedNames, StarVLANames
from turbopi.checkpoint.norm_stats import FILE_NAME, STARVLAS
from turbopi.checkpoint.rlinf import EMBEDDING, RLinfSource
from turbopi.checkpoint.source import WeightSource
from turbopi.checkpoint.torch_files import TorchSource
from turbopi.config import PolicyConfig
from turbopi.support.errors import CheckpointError, ConfigError

_BICUBIC = ": it resizes images bicubically, so actions are exactly its own for images of 224 × 224 alone"
_STATE = {  # what each does with a state in the prompt
    "Dexbotic": "Dexbotic never writes the state into the prompt: set it to false",
    "StarVLA": "StarVLA fills the state up to 32 numbers with -2 there, which Turbo-Pi doesn't: only its policies with "
    "discrete_state_input: false are run",
}


def in_known_layout(file: TorchSource, where: Path) -> WeightSource:
    """The same source, or another program's layout under canonical names. Raises CheckpointError for one not read."""
    shapes = file.shapes
    if EMBEDDING in shapes:
        return RLinfSource(file)
    if (found := next((name for name in shapes if name.removeprefix("model.").startswith("llm.")), None)) is not None:
        _refuse_other_dexbotic(file, where, found)
        return _renamed(file, where, DexboticNames(), prefix="model.", note=_BICUBIC)
    if any(name.startswith("action_head.gemma_expert.") for name in shapes):
        return _renamed(file, where, StarVLANames())
    if (found := next((name for name in shapes if name.startswith("qwen_vl_interface.")), None)) is not None:
        raise CheckpointError(
            f"{where} has {file.native_name(found)}: one of StarVLA's frameworks on Qwen. Turbo-Pi reads its PI05 and "
            "PI0, on PaliGemma"
        )
    return file


def _refuse_other_dexbotic(file: TorchSource, where: Path, found: str) -> None:
    names = {name.removeprefix("model.") for name in file.shapes}
    if "action_in_proj.weight" not in names:
        what = "one of Dexbotic's other models"
    elif HEAD in names and "time_mlp_in.weight" in names:
        what, found = "Dexbotic's hybrid Pi0.5, whose prompts are conversations (User: …)", HEAD
    else:
        return
    raise CheckpointError(f"{where} has {file.native_name(found)}: {what}. Turbo-Pi reads its plain Pi0.5 and Pi0")


def _renamed(file: TorchSource, where: Path, names: RenamedNames, prefix: str = "", note: str = "") -> TorchSource:
    source = TorchSource(where, format=file.format, prefix=prefix, names=names)
    source.notes.append(f"weights in {names.program}'s layout{note}")
    return source


def statistics_folder(folder: Path, source: WeightSource) -> Path:
    """Where the statistics are. StarVLA keeps them in its run's folder, and the weights one below."""
    beside = any((folder / name).exists() for name in ("assets", FILE_NAME, STARVLAS))
    above = _program(source) == StarVLANames.program and (folder.parent / "config.yaml").is_file()
    return folder.parent if above and not beside else folder


def check_state(source: WeightSource, policy: PolicyConfig, configured: str) -> None:
    """ConfigError where the program that trained these weights makes other prompts of the state than openpi."""
    program = _program(source)
    if policy.discrete_state_input and program is not None:
        raise ConfigError(f"{configured}: discrete_state_input is true, but {_STATE[program]}")


def _program(source: WeightSource) -> str | None:
    names = getattr(source, "names", None)
    return names.program if isinstance(names, RenamedNames) else None
