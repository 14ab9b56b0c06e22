"""Vision of full size, captured in one graph, in two, and with a head for each part of the images, on a real GPU.

Run by scripts/gpu_check.
"""

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from turbopi import UnifiedPolicy
from turbopi.backends import Precision
from turbopi.checkpoint import random_checkpoint
from turbopi.engine import call, forward
from turbopi.engine.call import Images
from turbopi.preprocess.images import fitted
from turbopi.quantization.calibration_file import Quantization

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(
        not torch.cuda.is_available() or torch.cuda.get_device_capability() != (9, 0),
        reason="needs an NVIDIA GPU of compute capability 9.0",
    ),
]
CALIBRATION = Path(__file__).parents[1] / "benchmarks/results/h200_2026-11-26_pi05_libero/calibrate.json"


@lru_cache
def runner_of(precision: Precision) -> Any:
    checkpoint, quantization = random_checkpoint("pi05_libero"), None
    if precision == "fp8":
        quantization = Quantization.load(CALIBRATION)
        checkpoint.__dict__["_fingerprint"] = quantization.fingerprint  # to hash all weights takes a minute
    policy = UnifiedPolicy(checkpoint, backend="fused", precision=precision, device="cuda:0", quantization=quantization)
    return policy.backend


@pytest.mark.parametrize("precision", ["bf16", "fp8"])
def test_vision_in_two_graphs_gives_what_it_gives_in_one(precision: Precision, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit: the second one's first norm takes the sums that the first one's last product has left."""
    runner = runner_of(precision)
    camera_images = list(np.random.default_rng(0).integers(0, 256, (2, 224, 224, 3), dtype=np.uint8))
    found = []
    for layers, parts in ((forward.HEAD_LAYERS, 2), (None, 1)):
        monkeypatch.setattr(forward, "HEAD_LAYERS", layers)
        runner._graphs.entries.clear()
        runner.begin(camera_images)
        torch.cuda.synchronize()
        ((graph, images),) = runner._graphs.entries.values()
        assert len(graph._parts) == parts
        found.append(images.embs[: 2 * 256].clone())
    assert bool(found[0].isfinite().all()) and torch.equal(*found)


@pytest.mark.parametrize("precision", ["bf16", "fp8"])
def test_pictures_in_three_parts_give_what_they_give_in_one(
    precision: Precision, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within what sums in another order make of the numbers, as they do where eight images are a call of their own.

    Between a part's head and the rest a norm stands by itself, and products of other rows have other tiles.
    """
    runner = runner_of(precision)
    shown = list(np.random.default_rng(1).integers(0, 256, (24, 224, 224, 3), dtype=np.uint8))

    def tokens(part: int, given: list[np.ndarray], graphs: int) -> torch.Tensor:
        monkeypatch.setattr(call, "PART", part)
        camera_images = Images(runner.config, runner._weights, runner._ops, len(given), False, 0)
        graph = runner._capture(camera_images.run, None)
        assert len(graph._parts) == graphs, "one for each head, and one for the rest"
        found = []
        for these in (given[::-1], given, given):  # the last two alike, whatever came before
            graph.launch(*camera_images.uploads(these, None, False))
            torch.cuda.synchronize()
            assert graph.stage_ms()["vision"] > 0
            found.append(camera_images.embs.float())
        assert bool(found[1].isfinite().all()) and torch.equal(found[1], found[2])
        assert not torch.equal(found[0], found[1])
        return found[1].view(len(given), -1)

    together, parts = tokens(24, shown, 2), tokens(8, shown, 4)
    alone = torch.cat([tokens(8, shown[first : first + 8], 2) for first in (0, 8, 16)])
    far, control = ((one - together).norm(dim=1) / together.norm(dim=1) for one in (parts, alone))
    print(f"{precision}: parts {far.max():.4f}, alone {control.max():.4f} of one part")
    # numbers that are rounded to E4M3 differ by more; another image's tokens are as far as the tokens are large
    assert float(far.max()) < 2 * float(control.max()) + (0.03 if precision == "bf16" else 0.1)


def test_pictures_of_any_size_in_parts_give_what_they_give_resized_on_the_host() -> None:
    """Bit for bit; the second part's all have the model's size, so that nothing is resized there."""
    runner, rng = runner_of("bf16"), np.random.default_rng(2)
    sizes = [(480, 640), (224, 224), (360, 480)]
    chosen = [(224, 224) if 8 <= i < 16 else sizes[i % 3] for i in range(20)]
    shown = [rng.integers(0, 256, (*size, 3), dtype=np.uint8) for size in chosen]
    camera_images = Images(runner.config, runner._weights, runner._ops, len(shown), False, 0)
    usual = runner._capture(camera_images.run, None)
    resized = runner._capture(camera_images.run_resized, None, like=usual)
    found = []
    for graph, given in ((usual, [fitted(one, 224, "openpi") for one in shown]), (resized, shown)):
        assert camera_images.resizes(given, "openpi") == (graph is resized)
        graph.launch(*camera_images.uploads(given, "openpi", graph is resized))
        torch.cuda.synchronize()
        assert graph.stage_ms()["vision"] > 0
        found.append(camera_images.embs.clone())
        camera_images.images.zero_()
        camera_images.embs.fill_(torch.nan)
    assert bool(found[0].isfinite().all()) and torch.equal(*found)
