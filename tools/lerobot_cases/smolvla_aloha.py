"""What LeRobot computes for an ALOHA SmolVLA with tokens around the images, one camera that is always missing and one
that is sometimes: tests/golden_smolvla/special_tokens with another config.json and statistics.

    HF_HUB_CACHE=HUB PYTHONPATH=tools .venv-lerobot/bin/python -m lerobot_cases.smolvla_aloha CHECKPOINT OUT.npz

HUB and CHECKPOINT as tests/smolvla_golden.py makes them. LeRobot 0.6.1. OUT: changes of the config as JSON, statistics,
observations, noise, and LeRobot's actions.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.smolvla import smolvlm_with_expert
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from lerobot.policies.utils import prepare_observation_for_inference
from transformers import AutoTokenizer

JOINTS = 14
CHANGES: dict[str, Any] = {
    "input_features": {
        "observation.images.top": {"type": "VISUAL", "shape": [3, 40, 32]},
        "observation.images.wrist": {"type": "VISUAL", "shape": [3, 32, 40]},
        "observation.images.empty_camera_0": {"type": "VISUAL", "shape": [3, 480, 640]},
        "observation.state": {"type": "STATE", "shape": [JOINTS]},
    },
    "output_features": {"action": {"type": "ACTION", "shape": [JOINTS]}},
    "adapt_to_pi_aloha": True,
    "empty_cameras": 1,
}


class _Processor:
    """The two ids that LeRobot asks a processor's tokenizer for; the rest of it needs files that aren't here."""

    @classmethod
    def from_pretrained(cls, name: str) -> "_Processor":
        made = cls()
        made.tokenizer = AutoTokenizer.from_pretrained(name)
        for key, token in (("fake", "<fake_token_around_image>"), ("global", "<global-img>")):
            setattr(made.tokenizer, f"{key}_image_token_id", made.tokenizer.convert_tokens_to_ids(token))
        return made

    tokenizer: Any


def main() -> None:
    checkpoint, out = map(Path, sys.argv[1:])
    smolvlm_with_expert.AutoProcessor = _Processor
    settings = checkpoint / "config.json"
    settings.write_text(json.dumps(json.loads(settings.read_text()) | CHANGES))
    rng = np.random.default_rng(0)
    stats = {
        key: {"mean": rng.normal(size=JOINTS).astype("f4"), "std": rng.uniform(0.3, 2, JOINTS).astype("f4")}
        for key in ("observation.state", "action")
    }
    config = PreTrainedConfig.from_pretrained(checkpoint)
    policy = SmolVLAPolicy.from_pretrained(checkpoint, config=config).float().eval()
    given = {key: {name: torch.from_numpy(one) for name, one in of.items()} for key, of in stats.items()}
    pre, post = make_pre_post_processors(config, dataset_stats=given)
    noise = rng.normal(size=(config.chunk_size, config.max_action_dim)).astype("f4")
    kept: dict[str, Any] = {"changes": json.dumps(CHANGES), "noise": noise}
    kept |= {f"{key}/{name}": one for key, of in stats.items() for name, one in of.items()}
    for index, cameras in enumerate((("top", "wrist"), ("wrist",))):
        seen = {"observation.state": rng.normal(size=JOINTS).astype("f4")}
        for camera in cameras:
            _, height, width = CHANGES["input_features"][f"observation.images.{camera}"]["shape"]
            seen[f"observation.images.{camera}"] = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
        kept |= {f"{index}/{key}": one.copy() for key, one in seen.items()}  # LeRobot changes the state in place
        batch = prepare_observation_for_inference(seen, torch.device("cpu"), task="pick up the cup", robot_type="")
        with torch.no_grad():
            chunk = post(policy.predict_action_chunk(pre(batch), noise=torch.from_numpy(noise)[None]))
        kept[f"{index}/actions"] = chunk[0].numpy()
    np.savez_compressed(out, **kept)


if __name__ == "__main__":
    main()
