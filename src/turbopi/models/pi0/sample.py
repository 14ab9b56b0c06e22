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

    def timing(
        self, start: float, requested: float, infer_start: float, infer_end: float, end: float
    ) -> dict[str, float]:
        """`policy_timing` of a call, from its times in seconds: see `UnifiedPolicy.infer`."""
        return {
            "infer_ms": (infer_end - infer_start) * 1e3,
            "preprocess_ms": (requested - start) * 1e3,
            "queue_ms": (infer_start - requested) * 1e3,
            **{f"{stage}_ms": milliseconds for stage, milliseconds in self.stage_ms.items()},
            "postprocess_ms": (end - infer_end) * 1e3,
            "total_ms": (end - start) * 1e3,
        }
