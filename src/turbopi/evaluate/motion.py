"""How smoothly the robot was commanded in an episode."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from turbopi.realtime import Seam

_Count = Annotated[int, Meta(ge=0, le=10**9)]
_Length = Annotated[float, Meta(ge=0, le=1e12)]


class Motion(Struct, frozen=True):
    """Lengths are of vectors of the dimensions that move the robot, in the command's own unit.

    seams       chunks that took over from another one
    seam_jump   mean over the seams: the first action less the command before it; None without a seam
    seam_gap    mean over the seams where the running chunk had an action left: the first action less that one
    step_jump   mean change of the command in all other steps
    jerk        mean second difference of the commands: the jerk, where they are velocities or small steps
    standing    control steps in which the robot had no action and stood still
    dropped     chunks that were never carried out
    """

    seams: _Count
    seam_jump: _Length | None
    seam_gap: _Length | None
    step_jump: _Length | None
    jerk: _Length | None
    standing: _Count
    dropped: _Count


@dataclass
class Commands:
    """What was commanded, control step by control step."""

    values: list[np.ndarray] = field(default_factory=list)  # float64[d] each
    seams: list[int] = field(default_factory=list)  # steps whose action is the first of a chunk, but for the first one

    def motion(self, dims: int, seams: Sequence[Seam], *, standing: int, dropped: int) -> Motion:
        """Of the first `dims` dimensions. `seams`: as the queue saw them, which knows what the running chunk had."""
        path = np.array([value[:dims] for value in self.values]).reshape(len(self.values), dims)
        changes = np.linalg.norm(np.diff(path, axis=0), axis=1) if len(path) > 1 else np.zeros(0)
        at_seam = np.zeros(len(changes), np.bool_)
        at_seam[[step - 1 for step in self.seams]] = True
        gaps = [float(np.linalg.norm(seam.gap[:dims])) for seam in seams if seam.gap is not None]
        second = np.linalg.norm(np.diff(path, n=2, axis=0), axis=1) if len(path) > 2 else np.zeros(0)
        return Motion(
            seams=len(self.seams),
            seam_jump=_mean(changes[at_seam]),
            seam_gap=_mean(gaps),
            step_jump=_mean(changes[~at_seam]),
            jerk=_mean(second),
            standing=standing,
            dropped=dropped,
        )


def _mean(values: Sequence[float] | np.ndarray) -> float | None:
    return round(float(np.mean(values)), 6) if len(values) else None
