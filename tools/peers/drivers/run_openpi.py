"""openpi's PyTorch Pi0.5: `PI0Pytorch.sample_actions`.

Two of its modules import JAX, of which PyTorch's side needs a table of sizes and nothing: they are stood in for here,
so that the environment needs no JAX.
"""

import sys
from collections.abc import Callable
from importlib import import_module
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from peers.drivers.rounds import Built, clocked, random_images, serve

VOCABULARY = 257_152
MOST_TOKENS = 200
CAMERAS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")
SIZES = {"gemma_2b": (2048, 18, 16_384), "gemma_300m": (1024, 18, 4096)}  # width, depth, mlp_dim
SMALL = {"gemma_2b": (2048, 2, 64), "gemma_300m": (64, 2, 64)}  # of Gemma alone: it fixes the rest


def _sizes(width: int, depth: int, mlp_dim: int) -> SimpleNamespace:
    return SimpleNamespace(width=width, depth=depth, mlp_dim=mlp_dim, num_heads=8, num_kv_heads=1, head_dim=256)


def _stand_in(name: str, **content: Any) -> None:
    package, _, own = name.rpartition(".")
    module = ModuleType(name)
    vars(module).update(content)
    sys.modules[name] = module
    setattr(import_module(package), own, module)


def build(job: dict[str, Any]) -> Built:
    sys.path.insert(0, f"{job['src']}/src")
    sizes = SMALL if job["small"] else SIZES
    _stand_in("openpi.models.gemma", get_config=lambda variant: _sizes(*sizes[variant]))
    _stand_in("openpi.shared.image_tools")
    from openpi.models_pytorch.pi0_pytorch import PI0Pytorch

    _, _, how = job["setting"].partition(" ")
    config = SimpleNamespace(
        pi05=True,
        paligemma_variant="gemma_2b",
        action_expert_variant="gemma_300m",
        dtype="bfloat16",
        action_dim=32,
        action_horizon=job["horizon"],
        max_token_len=MOST_TOKENS,
        pytorch_compile_mode=None if how == "eager" else how,
    )
    device = torch.device(job["device"])
    torch.manual_seed(0)
    with device:  # drawing 3 billion weights takes a CPU a minute
        model = PI0Pytorch(config)
    model = model.to(device).eval()
    tokens = torch.randint(1, VOCABULARY, (1, MOST_TOKENS)).to(device)
    mask = (torch.arange(MOST_TOKENS)[None] < job["prompt_tokens"]).to(device)
    images = random_images(job)
    masks = {name: torch.tensor([number < job["cameras"]], device=device) for number, name in enumerate(CAMERAS)}
    dark = np.zeros((224, 224, 3), np.uint8)

    def observation() -> SimpleNamespace:
        seen = [*images(), *[dark] * (len(CAMERAS) - job["cameras"])]
        on_device = [torch.from_numpy(image).to(device).permute(2, 0, 1)[None].float() for image in seen]
        return SimpleNamespace(
            images={name: image / 127.5 - 1 for name, image in zip(CAMERAS, on_device, strict=True)},
            image_masks=masks,
            state=torch.zeros(1, 32, device=device),
            tokenized_prompt=tokens,
            tokenized_prompt_mask=mask,
            token_ar_mask=None,
            token_loss_mask=None,
        )

    def whole() -> Any:
        return model.sample_actions(device, observation(), num_steps=job["steps"]).float().cpu()

    ready = observation()
    wait: Callable[[], None] = torch.cuda.synchronize if device.type == "cuda" else lambda: None
    noise = torch.randn(1, job["horizon"], 32, device=device)

    def on_the_gpu() -> Any:
        actions = model.sample_actions(device, ready, noise=noise, num_steps=job["steps"])
        wait()
        return actions

    parts = {"on the GPU": clocked(on_the_gpu, lambda actions: actions.float().cpu())}
    if how == "eager":
        parts = {"whole call": clocked(whole), **parts}
    note = (
        f"{job['cameras']} of {len(CAMERAS)} camera slots and {job['prompt_tokens']} of {MOST_TOKENS} prompt tokens "
        "count; without tokenising and resizing"
    )
    return Built(parts, note, ("transformers", "torch"), {"openpi": job["commit"]})


if __name__ == "__main__":
    serve(build)
