"""LeRobot's `pi052` checkpoints: a Pi0.5 that writes subtasks with its language head, and acts on them.

Source: LeRobot's open PR 4184 at f2c8867, which isn't merged: its revisions differ.
"""

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from turbopi.checkpoint.lerobot import CONFIG, LeRobotFolder
from turbopi.checkpoint.lerobot_keys import PI052, Keys
from turbopi.checkpoint.names import Names, TextNames
from turbopi.config import LIMITS, PolicyConfig, Subtasks, TextConfig
from turbopi.support.errors import CheckpointError

PROMPT = "User: {prompt}\nAssistant:"
JOINT_PROMPT = "User: {prompt}, State: {state};\nAssistant:"


class TextFolder(LeRobotFolder):
    """As `LeRobotFolder`."""

    keys: ClassVar[Keys] = PI052
    writes_text: ClassVar[bool] = True

    @classmethod
    def names(cls, folder: Path) -> Names:
        return TextNames()

    def _described(self) -> PolicyConfig:
        config, described = self.config, super()._described()
        if self.memory is not None:
            raise CheckpointError(f"{self.file} has memory (MEM) and type 'pi052'; LeRobot has memory in pi05 alone")
        joint = config.flag("joint_subtask_conditioning", False)
        if joint and not self._trains_head:
            raise CheckpointError(
                f"{self.file} has joint_subtask_conditioning = True, whose actions see a written subtask, but the "
                "language head wasn't trained (text_loss_weight, unfreeze_lm_head)"
            )
        replan = config.integer(
            "subtask_replan_steps", -(LIMITS["action_horizon"] ** 2), LIMITS["action_horizon"] ** 2, 0
        )
        executed = config.integer("n_action_steps", 1, LIMITS["action_horizon"], default=self._chunk_size)
        text = TextConfig(
            JOINT_PROMPT if joint else PROMPT,
            trained=self._trains_head,
            skipped_ids=config.integer("fast_skip_tokens", 0, LIMITS["vocab_size"], default=1152),
            subtasks=Subtasks(max(1, round(replan / executed)), joint),
        )
        # LeRobot cuts no prompt at inference, and a subtask may be as long as an answer
        longest = min(self.pipelines.max_tokens + text.max_tokens, LIMITS["max_prompt_tokens"])
        return replace(described, name="lerobot_pi052", text=text).with_model(max_prompt_tokens=longest)

    @property
    def _trains_head(self) -> bool:
        return self.config.number("text_loss_weight", default=1.0) > 0 and self.config.flag("unfreeze_lm_head", True)

    def notes(self) -> list[str]:
        if self._trains_head:
            return super().notes()
        return [
            *super().notes(),
            f"{CONFIG} says that the language head wasn't trained (text_loss_weight, unfreeze_lm_head): no subtask is "
            "written, and actions follow the prompt",
        ]
