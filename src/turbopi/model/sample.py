"""What a way to run the model answers."""

from dataclasses import dataclass, field

from torch import Tensor


@dataclass(frozen=True)
class Sample:
    """One answer of a backend."""

    actions: Tensor  # float32[B, H, action_dim], on the host
    # milliseconds of "vision", "prefix", "denoise", measured on the device; a stage it can't tell apart is absent
    stage_ms: dict[str, float] = field(default_factory=dict)
    queue_ms: float = 0.0  # of a `submit`: how long it waited for a free place before it began
