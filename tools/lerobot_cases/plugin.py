"""Runs the stored cases through LeRobot with `--policy.type=turbopi`, and through LeRobot's own policy beside it.

    PYTHONPATH=tools:src:plugins/lerobot_policy_turbopi/src \\
        .venv-lerobot/bin/python -m lerobot_cases.plugin FOLDER

Each FOLDER/*/ is a case of tests/golden_lerobot, golden_smolvla or golden_pi0_fast: checkpoint/ with its weights,
inputs.npz, case.json. It gets plugin.npz, everything by LeRobot's processors, loaded as its commands load them:

    {run}/actions            the plugin's chunk from the stored noise, float32 [H, d], un-normalised
    selected_actions         the plugin's, one by one from select_action, the stored noise for each chunk
    seeded, lerobot_seeded   a chunk with the noise that PyTorch's seed 3 gives, the plugin's and LeRobot's own:
                             the latter not for adapters, nor for cases of other sizes than small.py's, which LeRobot
                             would load in silence as far as names and sizes agree
    bf16, lerobot_bf16       the seeded ones in bfloat16, both or neither
    loaded_again             the first run's, by a policy that was saved and loaded again
"""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot_policy_turbopi import TurboPiConfig

from lerobot_cases.small import VISION_HEADS, shrink


def run(folder: Path) -> dict[str, np.ndarray]:
    case, inputs = json.loads((folder / "case.json").read_text()), dict(np.load(folder / "inputs.npz"))
    checkpoint = folder / "checkpoint"
    config = TurboPiConfig(checkpoint=str(checkpoint), precision="f32", backend="pytorch", device="cpu")
    policy, pre, post = _load(config)
    noise = torch.from_numpy(inputs["noise"])[None] if "noise" in inputs else None  # Pi0-FAST draws none
    found: dict[str, torch.Tensor] = {}
    for index, wanted in enumerate(case["runs"]):
        batch = pre(_request(inputs, wanted["observation"]))
        found[f"{index}/actions"] = post(policy.predict_action_chunk(batch, noise=noise, **wanted.get("call", {})))[0]
    policy.reset()
    steps = range(policy.config.n_action_steps)
    chosen = [post(policy.select_action(pre(_request(inputs, 0)), noise=noise)) for _ in steps]
    found["selected_actions"] = torch.cat(chosen)
    torch.manual_seed(3)
    found["seeded"] = post(policy.predict_action_chunk(pre(_request(inputs, 0))))[0]
    own = PreTrainedConfig.from_pretrained(checkpoint)
    if not own.use_peft and case.get("vision_heads") == VISION_HEADS and noise is not None:
        own.pretrained_path = checkpoint
        config = TurboPiConfig(checkpoint=str(checkpoint), backend="pytorch", device="cpu")
        for name, one in (("lerobot_seeded", own), ("lerobot_bf16", replace(own, dtype="bfloat16")), ("bf16", config)):
            other, pre, post = _load(one)
            torch.manual_seed(3)
            found[name] = post(other.predict_action_chunk(pre(_request(inputs, 0))))[0]
    policy.save_pretrained(folder / "saved")
    again = PreTrainedConfig.from_pretrained(folder / "saved")
    again.pretrained_path = folder / "saved"
    policy, pre, post = _load(again)
    first = case["runs"][0]
    batch = pre(_request(inputs, first["observation"]))
    found["loaded_again"] = post(policy.predict_action_chunk(batch, noise=noise, **first.get("call", {})))[0]
    return {name: value.float().numpy() for name, value in found.items()}


def _load(config: Any) -> tuple[Any, Any, Any]:
    """As lerobot-rollout and lerobot-eval do."""
    policy = get_policy_class(config.type).from_pretrained(config.pretrained_path, config=config)
    policy = policy.to(config.device)
    policy.eval()
    overrides = {"device_processor": {"device": config.device}}
    pre, post = make_pre_post_processors(
        config, pretrained_path=str(config.pretrained_path), preprocessor_overrides=overrides
    )
    return policy, pre, post


def _request(inputs: dict[str, np.ndarray], index: int) -> dict[str, Any]:
    mine = {key.split("/", 1)[1]: value for key, value in inputs.items() if key.startswith(f"{index}/")}
    task = str(mine.pop("task")[0])
    return prepare_observation_for_inference(mine, torch.device("cpu"), task=task)


def main() -> None:
    cases = sorted(Path(sys.argv[1]).glob("*/case.json"))
    if not all(json.loads(case.read_text()).get("kind") in ("smolvla", "pi0_fast") for case in cases):
        shrink()  # of those two Turbo-Pi's alone runs, and the files have what it needs
    torch.use_deterministic_algorithms(True)
    for case in cases:
        found: dict[str, Any] = run(case.parent)
        np.savez(case.parent / "plugin.npz", **found)
        print(case.parent.name, flush=True)


if __name__ == "__main__":
    main()
