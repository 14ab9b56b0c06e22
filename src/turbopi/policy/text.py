"""Text that a policy writes, and the subtasks that its actions are made of: LeRobot's pi052 (docs/text.md).

A chunk's images are embedded once, for the subtask and for the actions behind it. Rows of a batch run one by one.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from turbopi import backends
from turbopi.backends.base import StageTimer, TextWriting
from turbopi.config import PolicyConfig
from turbopi.models.observation import ModelInputs, Observation, SeenObservation
from turbopi.models.pi0.conditioning import Conditionings, of_rows
from turbopi.models.pi0.sample import Sample
from turbopi.policy.history import History
from turbopi.preprocess.pipeline import Incoming, Pipeline
from turbopi.preprocess.text_prompts import joint_ids, text_ids, text_of
from turbopi.quantization.plan import ROUNDED
from turbopi.realtime.messages import MAX_TEXT
from turbopi.support.errors import ObservationError


class SubtaskHistory(History):
    """Of a policy that acts on subtasks; its observations are those that chunks were made of."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        super().reset()
        self.subtask, self._written = "", ""

    def holds(self, chunks: int) -> bool:
        """Whether the next chunk goes on with the last one's subtask."""
        return bool(self.subtask) and self.observations % chunks != 0

    def record(self, written: str, prompt: str) -> None:
        """The next chunk's subtask: what was written; if that is nothing, what was written last; else the prompt."""
        self._written = written or self._written
        self.subtask = self._written or prompt


def checked_text(name: str, text: str | None) -> str | None:
    """A text that a call gives, or None. Raises ObservationError."""
    if text is None or (isinstance(text, str) and text.strip() and len(text) <= MAX_TEXT):
        return text
    raise ObservationError(f"{name} is {text!r:.100}; it should be a text of 1 to {MAX_TEXT} characters")


def refuse_text(config: PolicyConfig) -> str:
    """Why a policy of this configuration writes none, and what to do."""
    if config.text is not None:
        return (
            f"{config.name} writes no text: its config.json says that its language head wasn't trained "
            "(text_loss_weight, unfreeze_lm_head)"
        )
    return (
        f"{config.name} writes no text: no file says that its language head was trained, as LeRobot's type pi052 does. "
        "If it was, say in a turbopi.json what it continues: "
        '{"text": {"template": "User: {prompt}\\nAssistant:"}} (docs/text.md)'
    )


class TextCalls:
    """Of one policy. The caller holds the policy's lock.

    acts    whether its actions are made of subtasks
    writes  whether its backend writes them
    """

    def __init__(self, pipeline: Pipeline, backend: backends.Backend) -> None:
        config = pipeline.config.text
        assert config is not None
        self._config, self._pipeline, self._backend = config, pipeline, backend
        self.acts, self.writes = config.subtasks is not None, config.trained and backend.writer is not None

    def check(self, given: Sequence[str | None]) -> None:
        """Raise ObservationError for a chunk whose subtask nobody can tell."""
        if self.writes:
            return
        if self._config.trained and any(one is None for one in given):
            raise ObservationError(
                f"backend {self._backend.name!r} writes no subtasks, and this policy acts on them: give `subtask`, or "
                f"take backend 'auto'{self._in_bf16}"
            )
        if self._config.subtasks is not None and self._config.subtasks.joint:
            raise ObservationError(
                f"backend {self._backend.name!r} has no causal prompts, in which this policy reads its subtasks "
                f"(joint_subtask_conditioning): take backend 'auto'{self._in_bf16}"
            )

    @property
    def _in_bf16(self) -> str:
        """What else is to be given where no backend that writes has the precision."""
        return " with precision 'bf16'" * (self._backend.precision in ROUNDED)

    def write(self, seen: Incoming, inputs: ModelInputs, prompt: str | None, most: int | None) -> str:
        """What it says to one observation. prompt: in place of the observation's."""
        observation = self._writer.see(Observation.stack([inputs]))
        return self._written(seen, observation, prompt, self._config.max_tokens if most is None else most)

    def sample(
        self,
        each: Sequence[Incoming],
        inputs: Sequence[ModelInputs],
        given: Sequence[str | None],
        histories: Sequence[SubtaskHistory],
        noise: Tensor,
        num_steps: int,
        conditioning: Conditionings,
    ) -> tuple[Sample, list[str]]:
        """The actions of all rows, and the subtasks that they are made of."""
        samples, subtasks = [], []
        of_each = zip(each, inputs, given, histories, of_rows(conditioning, len(each)), strict=True)
        for row, (seen, its, own, history, one) in enumerate(of_each):
            timer = StageTimer(self._backend.device)
            observation = self._writer.see(Observation.stack([its]))
            timer.mark("vision")
            subtask = self._next(seen, observation, history) if own is None else own
            timer.mark("text")
            x_1, before = noise[row : row + 1], timer.milliseconds()
            done = self._backend.sample(self._acting(seen, its, observation, subtask), x_1, num_steps, conditioning=one)
            stages = before | {name: before.get(name, 0.0) + ms for name, ms in done.stage_ms.items()}
            samples.append(replace(done, stage_ms=stages))
            subtasks.append(subtask)
        if len(samples) == 1:
            return samples[0], subtasks
        names = dict.fromkeys(name for one in samples for name in one.stage_ms)
        together = {name: sum(one.stage_ms[name] for one in samples) for name in names}
        return Sample(torch.cat([one.actions for one in samples]), together), subtasks

    def directed(self, seen: Incoming, subtask: str) -> ModelInputs:
        """The inputs of actions that are made of a subtask alone."""
        prompt, seen.prompt = seen.prompt, subtask
        inputs = self._pipeline.complete(seen)
        seen.prompt = prompt
        return inputs

    @property
    def _writer(self) -> TextWriting:
        assert self._backend.writer is not None
        return self._backend.writer

    def _next(self, seen: Incoming, observation: SeenObservation, history: SubtaskHistory) -> str:
        assert self._config.subtasks is not None
        if not history.holds(self._config.subtasks.chunks):
            written = self._written(seen, observation, None, self._config.max_tokens) if seen.prompt else ""
            history.record(written, seen.prompt)
        history.observations += 1
        return history.subtask

    def _written(self, seen: Incoming, observation: SeenObservation, prompt: str | None, most: int) -> str:
        text = seen.prompt if prompt is None else prompt
        ids = text_ids(self._pipeline.tokenizer, self._config, text, seen.prompt_state)
        written, _ = self._writer.write(self._with_prompt(observation, ids), most)
        return text_of(self._pipeline.tokenizer, written)

    def _acting(
        self, seen: Incoming, inputs: ModelInputs, observation: SeenObservation, subtask: str
    ) -> SeenObservation:
        assert self._config.subtasks is not None
        if not self._config.subtasks.joint:
            inputs = self.directed(seen, subtask)
            return self._with_prompt(observation, inputs.tokens[inputs.token_mask])
        ids, causal = joint_ids(self._pipeline.tokenizer, self._config, seen.prompt, seen.prompt_state, subtask)
        return self._with_prompt(observation, ids, causal)

    def _with_prompt(
        self, observation: SeenObservation, ids: Sequence[int] | np.ndarray, causal: Sequence[bool] | None = None
    ) -> SeenObservation:
        limit = self._pipeline.config.model.max_prompt_tokens
        if len(ids) > limit:
            raise ObservationError(f"the prompt takes {len(ids)} tokens; expected at most {limit} (max_prompt_tokens)")
        tokens = torch.tensor(ids)[None]
        return replace(
            observation,
            tokens=tokens,
            token_mask=torch.ones_like(tokens, dtype=torch.bool),
            causal=None if causal is None else torch.tensor(causal)[None],
        )
