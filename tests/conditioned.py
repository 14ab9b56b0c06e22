"""Conditionings for tests of backends: one of each form and mixture, with random numbers."""

import numpy as np

from turbopi.models.pi0.conditioning import (
    Conditioning,
    Guidance,
    GuidanceMode,
    TokenTimes,
    guidance_strength,
    guidance_weights,
)
from turbopi.models.pi0.noise_choice import NoiseChoice

BY_TOKEN = ["held", "identity", "held_and_identity", "staircase", "same_times", "warm_start"]


def conditioned(which: str, steps: int, horizon: int, width: int, seed: int = 0) -> Conditioning:
    """`which` is one of BY_TOKEN, or "jacobian", "jacobian_and_held" or "chosen_noise"."""
    rng = np.random.default_rng(seed)
    values = rng.standard_normal((horizon, width)).astype(np.float32)
    held = np.arange(horizon) < max(1, horizon // 3)

    def guidance(mode: GuidanceMode, times: TokenTimes) -> Guidance:
        d = max(1, horizon // 4)
        weights, strength = guidance_weights(horizon, d, d), guidance_strength(times.times, 5.0)
        return Guidance(rng.standard_normal((horizon, width)).astype(np.float32), weights, strength, mode)

    plain = TokenTimes.plain(steps, horizon)
    if which == "held":
        return Conditioning(held=held, values=values)
    if which == "chosen_noise":
        return Conditioning(noise=NoiseChoice(held, values))
    if which == "identity":
        return Conditioning(guidance=guidance("identity", plain))
    if which == "held_and_identity":
        return Conditioning(held=held, values=values, guidance=guidance("identity", plain.holding(held)))
    if which == "jacobian":
        return Conditioning(guidance=guidance("jacobian", plain))
    if which == "jacobian_and_held":
        return Conditioning(held=held, values=values, guidance=guidance("jacobian", plain.holding(held)))
    if which == "same_times":
        return Conditioning(tokens=plain)
    if which == "warm_start":
        return Conditioning(tokens=TokenTimes.of(np.linspace(0.5, 0, steps + 1)[:, None].repeat(horizon, 1)))
    if which == "staircase":  # early actions are done first
        ends = np.linspace(0.5, 1.0, horizon)
        grid = 1 - np.linspace(0, 1, steps + 1)[:, None] / ends
        return Conditioning(tokens=TokenTimes.of(grid.clip(0, 1)))
    raise ValueError(which)
