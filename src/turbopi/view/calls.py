"""One call of a policy, from a recording or a live server, as it is viewed."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class EncodedImage:
    data: bytes
    media_type: str  # "image/png", "image/jpeg"


@dataclass(frozen=True)
class ViewedCall:
    """One call that got actions.

    robot     its name, or its address; "" where a recording doesn't tell
    number    of the robot's calls, from 1; of all, in a recording. Those that are missing have numbers, too
    time      when the answer was sent, in seconds since 1970
    actions   float64[H, d], in the robot's units; None if they can't be shown
    numbers   the observation's arrays of numbers, float64[n], such as its state
    timing    milliseconds of each stage
    """

    robot: str
    number: int
    time: float
    prompt: str
    actions: np.ndarray | None
    camera_images: dict[str, EncodedImage] = field(default_factory=dict)
    numbers: dict[str, np.ndarray] = field(default_factory=dict)
    timing: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ViewedTrouble:
    """Something that went wrong, at a time in seconds since 1970. `serious`: not only a gap."""

    time: float
    text: str
    serious: bool = True
