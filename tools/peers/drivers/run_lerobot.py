"""LeRobot's own Pi0.5, SmolVLA and Pi0-FAST: `predict_action_chunk`, eager or with their `compile_model`.

Nothing comes from the Hub: weights are random, SmolVLA's vision-language model is of the job's sizes ("smolvlm"), and
its processor and Pi0-FAST's tokenizers are stand-ins. None of their tokens ends an answer: it has the job's steps.
"""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch
from peers.drivers.rounds import Built, clocked, random_images, serve

VOCABULARY = {"pi05": 257_152, "smolvla": 49_280, "pi0_fast": 257_152}
MOST_TOKENS = 200


def pi05(job: dict[str, Any], config: dict[str, Any]) -> Any:
    from lerobot.policies.pi05.configuration_pi05 import PI05Config
    from lerobot.policies.pi05.modeling_pi05 import PI05Policy

    return PI05Policy(PI05Config(**config, num_inference_steps=job["steps"], dtype="bfloat16"))


def smolvla(job: dict[str, Any], config: dict[str, Any]) -> Any:
    """Element types as with `load_vlm_weights`: bfloat16, but LeRobot's own projections."""
    from lerobot.policies.smolvla import smolvlm_with_expert
    from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
    from transformers import SmolVLMConfig

    sizes = job["smolvlm"]
    if job["small"]:
        from lerobot_cases.small import VOCABULARY

        sizes["text_config"] |= {"num_hidden_layers": 2, "vocab_size": VOCABULARY}
        sizes["vision_config"] |= {"num_hidden_layers": 1}
    ids = SimpleNamespace(fake_image_token_id=0, global_image_token_id=0)
    smolvlm_with_expert.AutoConfig = _from_here(SmolVLMConfig(**sizes))
    smolvlm_with_expert.AutoProcessor = _from_here(SimpleNamespace(tokenizer=ids))
    compiled = job["setting"] == "bf16 compiled"
    policy = SmolVLAPolicy(SmolVLAConfig(**config, num_steps=job["steps"], compile_model=compiled))
    policy.model.vlm_with_expert.vlm.to(torch.bfloat16)
    return policy.to(job["device"])


def pi0_fast(job: dict[str, Any], config: dict[str, Any]) -> Any:
    from lerobot.policies.pi0_fast import modeling_pi0_fast
    from lerobot.policies.pi0_fast.configuration_pi0_fast import PI0FastConfig

    modeling_pi0_fast.AutoProcessor = modeling_pi0_fast.AutoTokenizer = _from_here(_Ids())
    config |= {"max_decoding_steps": job["steps"], "validate_action_token_prefix": False}
    return modeling_pi0_fast.PI0FastPolicy(PI0FastConfig(**config, dtype="bfloat16"))


def _from_here(found: Any) -> Any:
    """What stands in for a class whose `from_pretrained` asks the Hub."""
    return SimpleNamespace(from_pretrained=lambda *_, **__: found)


class _Ids:
    """Both of Pi0-FAST's tokenizers. A token is its id; one of actions stands for a single coefficient."""

    vocab_size, bos_token_id, min_token, scale = VOCABULARY["pi0_fast"], 2, -32, 10.0

    def convert_ids_to_tokens(self, ids: list[int]) -> list[int]:
        return ids

    def convert_tokens_to_ids(self, tokens: Any) -> Any:
        return -1 if tokens == "|" else tokens

    def encode(self, text: str, **_: Any) -> list[int]:
        return [-1]

    @property
    def bpe_tokenizer(self) -> "_Ids":
        return self

    def decode(self, ids: torch.Tensor) -> str:
        return "".join(chr(one % 64) for one in ids.tolist())


MODELS = {"pi05": pi05, "smolvla": smolvla, "pi0_fast": pi0_fast}


def build(job: dict[str, Any]) -> Built:
    from lerobot.configs.types import FeatureType, PolicyFeature

    device, vocabulary, model = job["device"], VOCABULARY[job["model"]], job["model"]
    if job["small"]:
        from lerobot.policies.pi0_fast import modeling_pi0_fast
        from lerobot_cases import small

        small.shrink(modeling_pi0_fast)
        vocabulary = small.VOCABULARY
    keys, images = [f"observation.images.{number}" for number in range(job["cameras"])], random_images(job)
    config = {
        "input_features": {key: PolicyFeature(FeatureType.VISUAL, (3, *images()[0].shape[:2])) for key in keys}
        | {"observation.state": PolicyFeature(FeatureType.STATE, (7,))},
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (32,))},
        "chunk_size": job["horizon"],
        "n_action_steps": job["horizon"],
        "device": device,
    }
    torch.manual_seed(0)
    with torch.device(device):  # drawing 3 billion weights takes a CPU a minute
        policy = MODELS[model](job, config).eval()
    places = job["prompt_tokens"] if model == "smolvla" else MOST_TOKENS  # it pads to the longest alone
    tokens = torch.randint(1, vocabulary, (1, places))
    mask = torch.arange(places)[None] < job["prompt_tokens"]

    def batch() -> dict[str, torch.Tensor]:
        found = {
            key: torch.from_numpy(image).to(device).permute(2, 0, 1)[None].float() / 255
            for key, image in zip(keys, images(), strict=True)
        }
        found["observation.language.tokens"] = tokens.to(device)
        found["observation.language.attention_mask"] = mask.to(device)
        if model == "smolvla":  # the others' is in the prompt
            found["observation.state"] = torch.rand(1, 7).to(device)
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
    kind = "compile_model" if job["setting"] == "bf16 compiled" else "eager"
    note = f"{kind}; {job['prompt_tokens']} of {places} prompt tokens count; without tokenising"
    note += "; resizing is in both parts" if model == "smolvla" else " and resizing"
    if model == "pi0_fast":
        note += f"; greedy, {job['steps']} tokens, KV cache; both parts read the answer"
    return Built(parts, note, ("lerobot", "transformers", "torch"))


if __name__ == "__main__":
    serve(build)
