"""Named intermediates of one call, cut at layers and steps, and what two backends' differ by.

A `Place` is one tensor in the order in which data flows: the prefix, keys and values layer by layer, then step by step.
Only the slots that something attends to are kept; the others needn't match and aren't the same in every backend.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from turbopi.models.observation import ModelInputs
from turbopi.models.pi0.reference import Trace
from turbopi.support.text import significant
from turbopi.verify.document import ErrorsDocument, finite

_PREFIX = ("prefix_pad_mask", "prefix_positions", "vision_last_hidden", "prefix_embs")
BY_LAYER = ("kv_k", "kv_v")
_BY_STEP = ("cond", "x_t", "expert_hidden_step0", "suffix_out", "v_t", "logits")  # in a step, in this order
_PER_OBSERVATION = (*_PREFIX, *BY_LAYER)  # the noise doesn't enter these
_AXIS = {name: "layer" if name in (*BY_LAYER, "expert_hidden_step0") else "step" for name in (*BY_LAYER, *_BY_STEP)}


class Place(NamedTuple):
    """An intermediate's name, and its layer or step where it has one."""

    name: str
    at: int | None = None

    def __str__(self) -> str:
        return self.name if self.at is None else f"{self.name} {_AXIS[self.name]} {self.at}"

    @property
    def order(self) -> tuple[int, int, int, int]:
        """Where it stands in the flow of data."""
        index = self.at or 0
        if self.name in _PREFIX:
            return (0, _PREFIX.index(self.name), 0, 0)
        if self.name in BY_LAYER:
            return (1, index, BY_LAYER.index(self.name), 0)
        if self.name == "times":
            return (2, -1, 0, 0)
        if self.name == "expert_hidden_step0":
            return (2, 0, _BY_STEP.index(self.name), index)
        if self.name in _BY_STEP:
            return (2, index, _BY_STEP.index(self.name), 0)
        return (3, 0, 0, 0)  # actions


Tensors = dict[Place, np.ndarray]


def tensors_of(trace: Trace, inputs: ModelInputs, *, with_prefix: bool) -> Tensors:
    """A trace of one observation (B = 1) on the host, as float32 (times: float64), without slots nobody attends to.

    with_prefix=False leaves out what doesn't depend on the noise. `actions` is left out: a policy takes them from
    `sample`.
    """
    out: Tensors = {}
    for name, tensor in trace.items():
        if name == "actions" or (name in _PER_OBSERVATION and not with_prefix):
            continue
        values = _attended(name, _on_host(tensor), inputs)
        if name in _AXIS:
            out |= {Place(name, index): value for index, value in enumerate(values)}
        elif name in _PREFIX or name == "times":
            out[Place(name)] = values
    return out


def _on_host(tensor: Tensor) -> np.ndarray:
    """A copy: the tensor may be a buffer that the next call writes to."""
    values = tensor.detach() if tensor.dtype == torch.float64 else tensor.detach().float()
    return values.cpu().numpy().copy()


def _attended(name: str, values: np.ndarray, inputs: ModelInputs) -> np.ndarray:
    cameras, tokens = inputs.image_mask, inputs.token_mask
    if name == "vision_last_hidden":  # [C, 1, 256, W]
        return values[cameras]
    if name not in _PER_OBSERVATION or name == "prefix_pad_mask":
        return values
    axis = 2 if name in BY_LAYER else 1  # [L, 1, S, G, K], else [1, S, …]
    states = np.zeros(0, np.bool_) if inputs.past is None or inputs.past.state_mask is None else inputs.past.state_mask
    per_image = (values.shape[axis] - len(states) - len(tokens)) // len(cameras)
    valid = np.concatenate((cameras.repeat(per_image), states, tokens))
    return np.compress(valid, values, axis=axis)


@dataclass
class Errors:
    """What was added up of one tensor over many calls. All of it is pooled: large values weigh more than small ones."""

    calls: int = 0
    finite: bool = True
    max: float = 0.0
    _count: int = 0
    _difference: float = 0.0  # sums of squares
    _ours: float = 0.0
    _exact: float = 0.0
    _product: float = 0.0

    def add(self, ours: np.ndarray, exact: np.ndarray) -> None:
        self.calls += 1
        if not np.isfinite(ours).all():
            self.finite = False
            return
        a, b = ours.astype(np.float64).ravel(), exact.astype(np.float64).ravel()
        difference = a - b
        self.max = max(self.max, float(np.abs(difference).max(initial=0.0)))
        self._count += a.size
        self._difference += float(difference @ difference)
        self._ours += float(a @ a)
        self._exact += float(b @ b)
        self._product += float(a @ b)

    @property
    def rms(self) -> float:
        if not self.finite:
            return float("inf")
        return float(np.sqrt(self._difference / self._count)) if self._count else 0.0

    @property
    def relative_rms(self) -> float:
        """rms of the difference over the exact tensor's rms; where that is all zero, the rms itself."""
        if not self.finite:
            return float("inf")
        return float(np.sqrt(self._difference / self._exact)) if self._exact else self.rms

    @property
    def cosine(self) -> float:
        if not self.finite or not self._exact:  # of nothing but zeros there is none
            return float("nan")
        if self._difference == 0:
            return 1.0
        norm = float(np.sqrt(self._ours * self._exact))
        return self._product / norm if norm else 0.0

    @property
    def document(self) -> ErrorsDocument:
        return ErrorsDocument(
            relative_rms=finite(self.relative_rms),
            cosine=finite(self.cosine),
            rms=finite(self.rms),
            max=self.max if self.finite else None,
            finite=self.finite,
        )


ErrorsBy = dict[Place, Errors]


def in_order(places: Iterable[Place]) -> list[Place]:
    return sorted(places, key=lambda place: place.order)


@dataclass(frozen=True)
class Suspect:
    """The first intermediate that is further off than its inputs and rounding explain."""

    place: Place
    relative_rms: float
    control: float
    why: str

    def __str__(self) -> str:
        return f"{self.place} ({self.why})"


def first_suspect(errors: ErrorsBy, control: ErrorsBy, allowed: dict[Place, float], jump: float) -> Suspect | None:
    """The first intermediate, in the flow of data, whose relative rms

    - isn't finite, or
    - exceeds what is `allowed` there, or
    - is more than `jump` times that of the layer or step before, where the control's grows less than a third as much
      and a third of what is allowed is exceeded.
    """
    for place in in_order(errors):
        error, limit = errors[place].relative_rms, allowed[place]
        plain = control[place].relative_rms if place in control else 0.0
        before = Place(place.name, place.at - 1) if place.at else None
        if not errors[place].finite:
            return Suspect(place, error, plain, "not finite")
        if error > limit:
            return Suspect(place, error, plain, f"relative rms {significant(error)}, more than {significant(limit)}")
        previous = errors[before].relative_rms if before in errors else 0.0
        if before is not None and previous > 0 and error > jump * previous and error > limit / 3:
            grown = control[before].relative_rms if before in control else 0.0
            if not grown or error / previous > 3 * plain / grown:
                return Suspect(
                    place, error, plain, f"relative rms {significant(error)}, {error / previous:.0f} x that before"
                )
    return None
