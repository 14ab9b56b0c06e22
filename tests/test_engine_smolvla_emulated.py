"""SmolVLA's denoising loop in the portable kernel, run on a CPU thread by thread, against the reference's loop."""

import copy
import dataclasses
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from emulator import emulate
from smolvla_golden import relative
from test_kernels_portable_denoise_emulated import Emulated
from torch import Tensor

from turbopi.engine.emulate import RoundedWeights, rounded
from turbopi.engine.smolvla import Expert
from turbopi.kernels.portable.denoise import kernel as denoise
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.smolvla.config import SmolVLAConfig, TextConfig
from turbopi.models.smolvla.reference import SmolVLAModel
from turbopi.quantization.formats import INT8
from turbopi.quantization.plan import PrecisionPlan
from turbopi.quantization.sites import sites

pytestmark = [pytest.mark.slow, pytest.mark.skipif(emulate.COMPILER is None, reason="no g++ here")]
CPU = torch.device("cpu")
FOUR_WARPS = dataclasses.replace(denoise.IN_RANGES, warps=4)
SMALL = TextConfig(width=64, mlp_dim=48, num_heads=6, num_kv_heads=2, head_dim=16, vocab_size=20, depth=4)


def model(seed: int, **sizes: Any) -> SmolVLAModel:
    made = SmolVLAModel(SmolVLAConfig(text=SMALL, expert_width=48, expert_mlp=80, action_dim=16, **sizes))
    generator = torch.Generator().manual_seed(seed)
    for name, parameter in made.named_parameters():
        spread = 0.2 if name.startswith("action") else parameter.shape[-1] ** -0.5
        torch.nn.init.normal_(parameter, std=spread, generator=generator)
        if "norm" in name and name.endswith("weight"):
            parameter.data = 1 + 0.3 * parameter.data
        parameter.data = parameter.data.bfloat16().float()
    return made.eval().requires_grad_(False)


def cache(made: SmolVLAModel, rows: int, length: int) -> KVCache:
    text, generator = made.config.text, torch.Generator().manual_seed(7)
    shape = (text.depth, 1, text.num_kv_heads, rows, text.head_dim)
    k, v = (torch.randn(shape, generator=generator).bfloat16().float() for _ in range(2))
    return KVCache(k, v, torch.arange(rows)[None] < length, torch.tensor([length]), k.new_zeros(1, 0, text.width))


def run(
    made: SmolVLAModel,
    kept: KVCache,
    noise: Tensor,
    steps: int,
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    blocks: int,
    choice: denoise.Choices | None = None,
    *,
    before: Tensor | None = None,
    seed: int = 0,
    plan: PrecisionPlan | None = None,
) -> Tensor:
    def load(device: torch.device, sizes: dict[str, int], arch: str | None) -> tuple[Any, Any]:
        assert choice is None or sizes["TP_ACROSS_AT_ONCE"] == choice.across_at_once
        return Emulated(sizes, folder, seed, prepare=False), Emulated(sizes, folder, seed, prepare=True)

    monkeypatch.setattr(denoise, "load", load)
    monkeypatch.setattr(denoise, "unavailable", lambda device, weights: None)
    monkeypatch.setattr(denoise, "has_large_l2", lambda device: True)
    monkeypatch.setattr(torch.cuda, "device", lambda device: nullcontext())
    expert = Expert.pack(made, plan)
    of_expert = [(kept.k[i], kept.v[i]) for i in made.config.expert_at]
    crossed = made.cross_keys_values(kept)
    given = [own if other is None else other for own, other in zip(of_expert, crossed, strict=True)]
    keys, values = (torch.cat(parts).bfloat16() for parts in zip(*given, strict=True))
    kernel = expert.denoiser(
        steps, cache_rows=keys.shape[2], suffix=len(noise), device=CPU, blocks=blocks, choice=choice
    )
    x_t = torch.full((steps + 1, *noise.shape), torch.nan)
    v_t = torch.full((steps, *noise.shape), torch.nan)
    for one in (noise,) if before is None else (before, noise):
        kernel.launch(one, keys, values, kept.lengths, x_t, v_t)
    return x_t[-1]


@pytest.mark.parametrize(
    ("sizes", "suffix", "length", "blocks", "choice"),
    [
        ({"self_every": 2, "expert_depth": 4}, 10, 21, 3, None),
        ({"self_every": 2, "expert_depth": 2}, 3, 5, 1, None),  # beside every second text layer: all are self layers
        ({"self_every": 0, "expert_depth": 4}, 17, 30, 2, None),
        ({"self_every": None, "expert_depth": 4}, 50, 30, 4, None),
        ({"self_every": 3, "expert_depth": 4}, 10, 460, 3, None),  # keys in several shares
        ({"self_every": 2, "expert_depth": 4}, 10, 200, 13, denoise.IN_RANGES),  # a block has nothing across
        ({"self_every": 0, "expert_depth": 4}, 17, 30, 18, FOUR_WARPS),
        ({"self_every": 3, "expert_depth": 4}, 8, 30, 6, FOUR_WARPS),
        ({"self_every": 2, "expert_depth": 4, "int8": True}, 10, 21, 3, None),
        ({"self_every": 0, "expert_depth": 4, "int8": True}, 17, 30, 18, FOUR_WARPS),
        ({"self_every": 3, "expert_depth": 4, "int8": True}, 10, 200, 13, denoise.IN_RANGES),
    ],
)
def test_the_loop_is_as_exact_as_ordinary_bf16(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    sizes: dict[str, Any],
    suffix: int,
    length: int,
    blocks: int,
    choice: denoise.Choices | None,
) -> None:
    """With int8: of weights that are rounded, but for the matrix that mixes in the time."""
    steps, int8 = 2, "int8" in sizes
    made = model(1, **{name: size for name, size in sizes.items() if name != "int8"})
    kept = cache(made, length + 9, length)
    noise = torch.randn(suffix, 16, generator=torch.Generator().manual_seed(3))
    scales = {site: 1.0 for site in sites(made.config) if int8 and site.part == "expert"}
    plan = PrecisionPlan("int8", {str(site): 1.0 for site in scales}, {}, {}) if int8 else None
    plain = made.denoise(kept, noise[None], steps)[0]
    with rounded(made, scales, RoundedWeights(format=INT8)):
        exact = made.denoise(kept, noise[None], steps)[0]
    assert torch.equal(exact, plain) != int8
    ordinary = copy.deepcopy(made)
    ordinary.expert.bfloat16()
    ours = run(made, kept, noise, steps, monkeypatch, tmp_path, blocks, choice, plan=plan)
    usual = relative(ordinary.denoise(kept, noise[None], steps)[0].numpy(), plain.numpy())
    error = relative(ours.numpy(), exact.numpy())
    assert 0 < error <= 1.1 * usual, (error, usual)


def test_a_call_that_was_not_finite_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made = model(1, self_every=2, expert_depth=2)
    kept, noise = cache(made, 14, 5), torch.randn(3, 16, generator=torch.Generator().manual_seed(3))
    usual, after = (
        run(made, kept, noise, 1, monkeypatch, tmp_path, 1, before=one)
        for one in (None, torch.full((3, 16), torch.nan))
    )
    assert torch.equal(usual, after)


def test_across_in_one_phase_it_is_right_in_whatever_order_threads_go(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    made = model(1, self_every=2, expert_depth=4)
    kept, noise = cache(made, 30, 21), torch.randn(10, 16, generator=torch.Generator().manual_seed(3))
    first, *others = (
        run(made, kept, noise, 2, monkeypatch, tmp_path, 13, FOUR_WARPS, seed=seed) for seed in (0, 4, 5, 6)
    )
    assert all(torch.equal(first, other) for other in others)
