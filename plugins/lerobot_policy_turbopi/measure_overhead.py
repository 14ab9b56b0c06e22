"""What `predict_action_chunk` costs over Turbo-Pi's own call, on the machine that runs it, with LeRobot and the plugin.

    python measure_overhead.py --checkpoint=FOLDER [--precision=bf16] [--backend=auto] [--size=480x640] [--calls=200]
    python measure_overhead.py --random-weights=pi05_libero    no checkpoint: sizes of a preset, weights by chance

Both calls run in turns: the plugin's from a batch that LeRobot's processors left on the device, and
`UnifiedPolicy.infer` from the same observation on the host, which also tokenises and un-normalises. The last line of
output is one JSON document: medians in milliseconds, and the plugin's minus Turbo-Pi's own.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot_policy_turbopi import TurboPiConfig
from lerobot_policy_turbopi.modeling_turbopi import TurboPiPolicy

from turbopi import UnifiedPolicy
from turbopi.checkpoint import random_checkpoint

WARM = 20  # calls before those that count


def policy_of(arguments: argparse.Namespace) -> TurboPiPolicy:
    options = {"backend": arguments.backend, "precision": arguments.precision}
    if arguments.checkpoint:
        return TurboPiPolicy(TurboPiConfig(checkpoint=arguments.checkpoint, **options))
    checkpoint = random_checkpoint(arguments.random_weights, 0, "auto")
    cameras = [f"observation.images.{name}" for name in ("top", "wrist")]
    described = replace(
        checkpoint.config,
        robot="lerobot",
        robot_options={"image_keys": cameras, "state_dim": 8, "action_dim": 7},
        image_resize="lerobot",
    )
    turbopi = UnifiedPolicy(replace(checkpoint, config=described), **options)
    turbopi.warmup()
    config = TurboPiConfig(
        input_features={key: PolicyFeature(FeatureType.VISUAL, (3, 224, 224)) for key in cameras},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        num_inference_steps=described.num_denoising_steps,
        **options,
    )
    config.chunk_size, config.max_action_dim = described.model.action_horizon, described.model.action_dim
    config.image_resolution = (described.planned_model.vision.image_size,) * 2
    return TurboPiPolicy(config, turbopi=turbopi)


def inputs_of(policy: TurboPiPolicy, size: tuple[int, int]) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """An observation as a robot sends it, and the same one as LeRobot's processors leave it."""
    rng, turbopi = np.random.default_rng(0), policy.turbopi
    assert turbopi is not None
    seen = turbopi.example_observation()
    for key in policy.config.image_features:
        if key in seen:
            seen[key] = rng.integers(256, size=(*size, 3), dtype=np.uint8)
    prepared, device = turbopi.prepare(seen), policy.config.device
    batch = {
        key: torch.from_numpy(value).permute(2, 0, 1)[None].to(device).float() / 255
        for key, value in seen.items()
        if key in policy.config.image_features
    }
    batch["observation.state"] = torch.from_numpy(prepared.state)[None].to(device)
    batch["observation.language.tokens"] = torch.from_numpy(prepared.tokens)[None].to(device)
    batch["observation.language.attention_mask"] = torch.from_numpy(prepared.token_mask)[None].to(device)
    return seen, batch


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--checkpoint")
    which.add_argument("--random-weights", metavar="PRESET")
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--precision", default="bf16")
    parser.add_argument("--size", default="480x640", help="HEIGHTxWIDTH of the images")
    parser.add_argument("--calls", type=int, default=200)
    arguments = parser.parse_args()
    height, width = map(int, arguments.size.split("x"))
    policy = policy_of(arguments)
    observation, batch = inputs_of(policy, (height, width))
    turbopi = policy.turbopi
    assert turbopi is not None
    noise = np.random.default_rng(1).standard_normal((policy.config.chunk_size, policy.config.max_action_dim))
    noise_on_device = torch.from_numpy(noise.astype(np.float32))[None].to(policy.config.device)
    calls: dict[str, Callable[[], Any]] = {
        "plugin_ms": lambda: policy.predict_action_chunk(batch, noise=noise_on_device).cpu(),
        "turbopi_ms": lambda: turbopi.infer(observation, noise=noise),
    }
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(WARM + arguments.calls):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            taken[name].append((time.perf_counter() - start) * 1e3)
    medians = {name: statistics.median(times[WARM:]) for name, times in taken.items()}
    metadata = turbopi.metadata
    found = {name: metadata[name] for name in ("device_name", "backend", "precision", "torch")} | medians
    print(json.dumps(found | {"size": arguments.size, "overhead_ms": medians["plugin_ms"] - medians["turbopi_ms"]}))


if __name__ == "__main__":
    main()
