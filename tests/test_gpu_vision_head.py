"""Vision of full size, captured as two graphs and as one, on a real GPU. Run by scripts/gpu_check."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from turbopi import UnifiedPolicy
from turbopi.backends import Precision
from turbopi.checkpoint import random_checkpoint
from turbopi.engine import forward
from turbopi.quantization.calibration_file import Quantization

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(
        not torch.cuda.is_available() or torch.cuda.get_device_capability() != (9, 0),
        reason="needs an NVIDIA GPU of compute capability 9.0",
    ),
]
CALIBRATION = Path(__file__).parents[1] / "benchmarks/results/h200_2026-11-26_pi05_libero/calibrate.json"


@pytest.mark.parametrize("precision", ["bf16", "fp8"])
def test_vision_in_two_graphs_gives_what_it_gives_in_one(precision: Precision, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit: the second one's first norm takes the sums that the first one's last product has left."""
    checkpoint, quantization = random_checkpoint("pi05_libero"), None
    if precision == "fp8":
        quantization = Quantization.load(CALIBRATION)
        checkpoint.__dict__["_fingerprint"] = quantization.fingerprint  # to hash all weights takes a minute
    policy = UnifiedPolicy(checkpoint, backend="fused", precision=precision, device="cuda:0", quantization=quantization)
    runner: Any = policy.backend
    pictures = list(np.random.default_rng(0).integers(0, 256, (2, 224, 224, 3), dtype=np.uint8))
    found = []
    for layers, parts in ((forward.HEAD_LAYERS, 2), (None, 1)):
        monkeypatch.setattr(forward, "HEAD_LAYERS", layers)
        runner._graphs.clear()
        runner.begin(pictures)
        torch.cuda.synchronize()
        (graph,) = runner._graphs.values()
        assert len(graph._parts) == parts
        found.append(runner._pictures[2, False].embs[: 2 * 256].clone())
    assert bool(found[0].isfinite().all()) and torch.equal(*found)
