"""LeRobot's `pi0_fast` checkpoints: config.json and the processors, and which action tokenizer reads the answers."""

from pathlib import Path
from typing import ClassVar

from turbopi.checkpoint.lerobot import CONFIG, LeRobotFolder
from turbopi.checkpoint.lerobot_keys import PI0_FAST, Keys
from turbopi.checkpoint.lerobot_pipeline import ACTION_TOKENIZER
from turbopi.checkpoint.names import FastNames, Names
from turbopi.checkpoint.peft_adapter import is_adapter
from turbopi.config import LIMITS, Pi0FastConfig, PolicyConfig
from turbopi.models import FAMILIES
from turbopi.support.hub_cache import hub_folder
from turbopi.support.reading import file_inside

_NAME = "lerobot/fast-action-tokenizer"


class FastFolder(LeRobotFolder):
    """As `LeRobotFolder`."""

    keys: ClassVar[Keys] = PI0_FAST
    own_settings: ClassVar[frozenset[str]] = frozenset({"action_tokenizer"})

    @classmethod
    def names(cls, folder: Path) -> Names:
        return FastNames(apart=is_adapter(folder))

    def _described(self) -> PolicyConfig:
        config = self.config
        network = Pi0FastConfig(
            owner="lerobot",
            action_dim=self.action_dim,
            action_horizon=self._chunk_size,
            max_prompt_tokens=self.pipelines.max_tokens,
            max_decoding_steps=config.integer("max_decoding_steps", 1, LIMITS["max_decoding_steps"], default=256),
            skipped_ids=config.integer("fast_skip_tokens", 0, LIMITS["vocab_size"], default=128),
            checks_prefix=config.flag("validate_action_token_prefix", True),
        )
        return PolicyConfig(
            name=f"lerobot_{self.kind}",
            model=network,
            robot="lerobot",
            normalization=self.normalization,
            robot_options=self._robot_options(),
            image_resize="lerobot",
        )

    def notes(self) -> list[str]:
        notes, executed = super().notes(), self.config.values.get("n_action_steps")
        if isinstance(executed, int) and executed != self._chunk_size:
            notes.append(
                f"{CONFIG} has n_action_steps = {executed}, and LeRobot reads answers as so many actions; the model "
                f"writes chunk_size = {self._chunk_size}, and so many are read here"
            )
        return notes

    def _notes_on_rtc(self) -> list[str]:
        if self._rtc_config is None:
            return []
        return [f"{CONFIG} enables rtc_config, but chunks of {FAMILIES[self.kind].label} can't be joined"]

    def _notes_on_version(self) -> list[str]:
        return []  # the same in all of them

    @property
    def action_tokenizers(self) -> tuple[Path, ...]:
        """LeRobot decodes with the one that config.json names; what training used may lie in the folder."""
        name = self.action_tokenizer_name
        found = [self.folder / name] if ".." not in Path(name).parts else []
        if (cached := hub_folder(name)) is not None:
            found.append(cached)
        step = self.pipelines.steps.get(ACTION_TOKENIZER)
        if step is not None and "action_tokenizer_name" in step.artifacts.values:
            found.append(file_inside(self.folder, step.artifacts.values["action_tokenizer_name"], step.file))
        return tuple(found)

    @property
    def action_tokenizer_name(self) -> str:
        return self.config.text("action_tokenizer_name", _NAME)
