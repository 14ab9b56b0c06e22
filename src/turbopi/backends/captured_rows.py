"""A call's observations in the captured graphs of captured.py: several at once, and one by one."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from turbopi.backends.base import Sample, StageTimer
from turbopi.config import ImageResize
from turbopi.engine.plan import split
from turbopi.models.observation import Observation, Past, past_of
from turbopi.models.pi0.conditioning import Conditionings, Form, of_rows

Images = Sequence[np.ndarray]  # of one observation's valid cameras: uint8[h, w, 3], or float32 as the model reads it


@dataclass(frozen=True, eq=False)
class Turn:
    """Observations whose images `graphs` has, until others are begun."""

    graphs: Any  # captured.py's Graphs, or what a backend has in their place


class BegunRows:
    """`BegunBatch`: plain observations together, by the backend's `batch_costs`, and others one by one.

    A strict backend uses the batches that are warm. The device is at the first call's images already.

    forms  of each observation's conditioning
    """

    def __init__(
        self,
        backend: Any,  # a CapturedBackend
        images: Sequence[Images],
        resize: ImageResize,
        pasts: Sequence[Past],
        forms: Sequence[Form],
    ) -> None:
        self._backend, self._images, self._resize, self._pasts = backend, images, resize, pasts
        plain = [row for row, form in enumerate(forms) if form == "plain"]
        self._cameras, costs = max((len(images[row]) for row in plain), default=0), backend.batch_costs
        if backend.strict:
            costs = {size: cost for size, cost in costs.items() if size == 1 or backend.is_warm(self._cameras, size)}
        self._calls = [(1, [row]) for row, form in enumerate(forms) if form != "plain"]  # for how many, and which rows
        for size in split(len(plain), costs) if plain else ():
            self._calls.append((size, plain[:size]))
            plain = plain[size:]
        self._first = self._see(*self._calls[0])

    def _see(self, size: int, rows: Sequence[int]) -> tuple[Turn, StageTimer]:
        timer = StageTimer(self._backend.device)
        images, pasts = [self._images[row] for row in rows], [self._pasts[row] for row in rows]
        turn = self._backend.see(images, self._resize, pasts, None if size == 1 else (self._cameras, size))
        timer.mark("vision")
        return turn, timer

    def finish(
        self,
        tokens: Sequence[np.ndarray],
        state: np.ndarray,
        noise: np.ndarray,
        num_steps: int,
        conditioning: Conditionings = None,
    ) -> Sample:
        """See `turbopi.backends.base.BegunBatch`."""
        self._backend.check_conditioning(conditioning)
        each = of_rows(conditioning, len(tokens))
        actions, stages = torch.empty(noise.shape), []
        for number, (size, rows) in enumerate(self._calls):
            turn, timer = self._see(size, rows) if number else self._first
            one = each[rows[0]] if size == 1 else None  # several are plain
            inputs = [tokens[row] for row in rows], state[rows], noise[rows]
            made = self._backend.answer(turn, *inputs, num_steps, one, timer)
            actions[rows] = made.actions[: len(rows)].cpu()
            stages.append(timer.milliseconds())
        return Sample(actions, {name: sum(one[name] for one in stages) for name in stages[0]})


def on_host(observation: Observation) -> tuple[list[Images], list[Past], list[np.ndarray], np.ndarray]:
    """Of each observation its valid images, those before, and prompt tokens; and the states."""
    host = observation.to("cpu")
    rows = range(host.batch_size)
    images: list[Images] = [list(host.images[row][host.image_mask[row]].numpy()) for row in rows]
    pasts = [past_of(host.row(row)).of_cameras(host.image_mask[row]) for row in rows]
    return images, pasts, [host.tokens[row][host.token_mask[row]].numpy() for row in rows], host.state.numpy()
