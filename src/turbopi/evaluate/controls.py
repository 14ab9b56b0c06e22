"""Controls: a policy that is given the wrong prompt, or the wrong images, should fail.

If it doesn't, its success doesn't come from what it was told, or from what it saw.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from turbopi.evaluate.sources import Answer, PolicySource
from turbopi.realtime.running_chunk import JoinMode
from turbopi.support.errors import ConfigError

Control = Literal["prompt", "pictures"]
CONTROLS: tuple[Control, ...] = ("prompt", "pictures")
_GRAY = 128


def check_control(control: str | None) -> None:
    """Raise ConfigError for a name that isn't one."""
    if control is not None and control not in CONTROLS:
        raise ConfigError(f"the control is {control!r}; choose one of {', '.join(CONTROLS)}")


class Controlled:
    """A policy source that hands wrong observations on to another one.

    prompt     the instruction of the task after this one (and the first's for the last)
    pictures   what was seen last in the next task that has been seen at all, gray until there is one. They depend on
               which episodes run side by side, so with several workers a run doesn't repeat exactly.

    instructions   of the tasks that are evaluated, in order. Of one alone the images are always gray; raises
                   ConfigError for its prompt.
    """

    def __init__(
        self, source: PolicySource, control: Control, instructions: Sequence[str], image_keys: Sequence[str]
    ) -> None:
        check_control(control)
        self._order = list(dict.fromkeys(instructions))
        alone = len(self._order) < 2
        if alone and control == "prompt":
            raise ConfigError(
                "the control 'prompt' takes another task's, but only one is evaluated: give more tasks, or the control "
                "'pictures'"
            )
        self._source, self._control, self._image_keys = source, control, tuple(image_keys)
        self._seen: dict[str, dict[str, np.ndarray]] = {}
        self.max_batch, self.real_time = source.max_batch, source.real_time
        self.label = f"{source.label}, {'gray images' if alone else f'{control} of another task'}"
        self.identity = source.identity | {"control": control}
        self.about = source.about | {"control": control}

    def infer(
        self,
        observations: Sequence[Mapping[str, Any]],
        seeds: Sequence[int],
        arguments: Sequence[Mapping[str, Any]] | None = None,
    ) -> list[Answer]:
        for observation in observations:
            self._seen[observation["prompt"]] = {key: observation[key] for key in self._image_keys}
        wrong = [self._wrong(observation) for observation in observations]
        return self._source.infer(wrong, seeds) if arguments is None else self._source.infer(wrong, seeds, arguments)

    def warm_up(self, most: int, mode: JoinMode | None, tell: Callable[[str], None]) -> None:
        self._source.warm_up(most, mode, tell)

    def close(self) -> None:
        self._source.close()

    def _wrong(self, observation: Mapping[str, object]) -> dict[str, object]:
        prompt = observation["prompt"]
        if prompt not in self._order:  # the example that is asked before the run
            return dict(observation)
        at = self._order.index(prompt)
        others = self._order[at + 1 :] + self._order[:at]
        if self._control == "prompt":
            return {**observation, "prompt": others[0]}
        seen = next((self._seen[other] for other in others if other in self._seen), None)
        return {**observation, **(seen or {key: np.full_like(observation[key], _GRAY) for key in self._image_keys})}
