"""LeRobot's own Pi0.5: `PI05Policy.predict_action_chunk`, eager."""

from collections.abc import Callable
from typing import Any

import torch
from peers.drivers.rounds import Built, clocked, random_images, serve

VOCABULARY = 257_152
MOST_TOKENS = 200


def build(job: dict[str, Any]) -> Built:
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.pi05.configuration_pi05 import PI05Config
    from lerobot.policies.pi05.modeling_pi05 import PI05Policy

    device, vocabulary = job["device"], VOCABULARY
    if job["small"]:
        from lerobot_cases import small

        small.shrink()
        vocabulary = small.VOCABULARY
    keys = [f"observation.images.{number}" for number in range(job["cameras"])]
    config = PI05Config(
        input_features={key: PolicyFeature(FeatureType.VISUAL, (3, 224, 224)) for key in keys}
        | {"observation.state": PolicyFeature(FeatureType.STATE, (7,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (32,))},
        chunk_size=job["horizon"],
        n_action_steps=job["horizon"],
        num_inference_steps=job["steps"],
        dtype="bfloat16",
        device=device,
    )
    torch.manual_seed(0)
    with torch.device(device):  # drawing 3 billion weights takes a CPU a minute
        policy = PI05Policy(config).eval()
    tokens = torch.randint(1, vocabulary, (1, MOST_TOKENS))
    mask = torch.arange(MOST_TOKENS)[None] < job["prompt_tokens"]
    images = random_images(job)

    def batch() -> dict[str, torch.Tensor]:
        found = {
            key: torch.from_numpy(image).to(device).permute(2, 0, 1)[None].float() / 255
            for key, image in zip(keys, images(), strict=True)
        }
        found["observation.language.tokens"] = tokens.to(device)
        found["observation.language.attention_mask"] = mask.to(device)
        return found

    def whole() -> Any:
        with torch.inference_mode():
            return policy.predict_action_chunk(batch()).float().cpu().numpy()

    ready = batch()
    wait: Callable[[], None] = torch.cuda.synchronize if device == "cuda" else lambda: None

    def on_the_gpu() -> Any:
        with torch.inference_mode():
            actions = policy.predict_action_chunk(ready)
            wait()
            return actions

    parts = {"whole call": clocked(whole), "on the GPU": clocked(on_the_gpu, lambda actions: actions.float().cpu())}
    note = f"eager; {job['prompt_tokens']} of {MOST_TOKENS} prompt tokens count; without tokenising and resizing"
    return Built(parts, note, ("lerobot", "transformers", "torch"))


if __name__ == "__main__":
    serve(build)
