"""Backend `tensorrt_fp8`: `tensorrt` whose prefix MLPs multiply in E4M3, with scales measured on real observations."""

from collections.abc import Sequence
from typing import Any, ClassVar

import torch

from turbopi.backends.tensorrt.backend import TensorRTBackend
from turbopi.backends.tensorrt.cache import default_folder
from turbopi.backends.tensorrt.calibrate import Calibration
from turbopi.backends.tensorrt.networks import Fp8Scales
from turbopi.support.errors import BackendUnavailable


class TensorRTFp8Backend(TensorRTBackend):
    """Takes its scales from the engine cache, where `turbopi build --precision fp8` puts them; never makes them up."""

    name: ClassVar[str] = "tensorrt_fp8"
    calibration: Calibration | None = None

    @classmethod
    def unavailable(cls, device: torch.device) -> str | None:
        reason = super().unavailable(device)
        if reason is None and (capability := torch.cuda.get_device_capability(device)) < (8, 9):
            major, minor = capability
            return f"E4M3 matmuls need compute capability 8.9 or newer, this GPU has {major}.{minor}; use 'tensorrt'"
        return reason

    def describe(self) -> dict[str, Any]:
        about = None if self.calibration is None else self.calibration.about()
        return {**super().describe(), "calibration": about}

    def _precisions(self) -> dict[str, str]:
        return {**super()._precisions(), "prefix MLPs": "fp8 (E4M3)"}

    def _scales(self) -> Sequence[Fp8Scales | None]:
        if self.calibration is None:
            found = Calibration.find(default_folder() / self._weights_hash)
            if found is None:
                raise BackendUnavailable(
                    f"{self.name} has no calibration for these weights; make one with `turbopi build --precision fp8`"
                )
            self.calibration = found
        return self.calibration.scales
