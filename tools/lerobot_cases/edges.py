"""What LeRobot's two pipelines compute, without a model: for checkpoints whose files were changed.

    PYTHONPATH=tools .venv-lerobot/bin/python -m lerobot_cases.edges FOLDER

FOLDER/inputs.npz is an observation in LeRobot's keys, its task, and `chunk` [H, D], what a model might have answered.
Each FOLDER/*/ is a checkpoint without weights, and gets

    edges.npz   tokens (unpadded), state (normalised), images [cameras, 224, 224, 3], image_mask, actions [H, d]

or, if LeRobot can't run it, error.txt.
"""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from lerobot.policies.utils import prepare_observation_for_inference

from lerobot_cases.small import shrink


def edges(checkpoint: Path, inputs: dict[str, np.ndarray]) -> dict[str, Any]:
    config = PreTrainedConfig.from_pretrained(checkpoint)
    pre, post = make_pre_post_processors(config, pretrained_path=str(checkpoint))
    arrays = {key: value for key, value in inputs.items() if key.startswith("observation.")}
    batch = pre(prepare_observation_for_inference(arrays, torch.device("cpu"), task=str(inputs["task"])))
    policy = SimpleNamespace(config=config, parameters=lambda: iter([torch.zeros(1)]))
    camera_images, masks = PI05Policy._preprocess_images(policy, batch)
    tokens, valid = (batch[f"observation.language.{name}"] for name in ("tokens", "attention_mask"))
    if len(tokens) != 1:
        raise ValueError(f"{len(tokens)} prompts came of one")
    chunk = torch.from_numpy(inputs["chunk"])[None, :, : config.output_features["action"].shape[0]]
    return {
        "tokens": tokens[0][valid[0]],
        "state": batch["observation.state"][0],
        "images": torch.stack([camera_image[0].permute(1, 2, 0) for camera_image in camera_images]),
        "image_mask": torch.stack([mask[0] for mask in masks]),
        "actions": post(chunk)[0],
    }


def main() -> None:
    shrink()
    folder = Path(sys.argv[1])
    inputs = dict(np.load(folder / "inputs.npz"))
    for config in sorted(folder.glob("*/config.json")):
        try:
            found = edges(config.parent, inputs)
        except Exception as error:  # whatever LeRobot raises about such files
            (config.parent / "error.txt").write_text(f"{type(error).__name__}: {error}")
        else:
            np.savez(config.parent / "edges.npz", **{name: value.float().numpy() for name, value in found.items()})


if __name__ == "__main__":
    main()
