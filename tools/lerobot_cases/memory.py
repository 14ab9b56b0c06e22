"""Runs the cases with memory through LeRobot with `--policy.type=turbopi`, call by call as `case.json` lists them.

    PYTHONPATH=tools:src:plugins/lerobot_policy_turbopi/src PYTHON -m lerobot_cases.memory FOLDER

Each FOLDER/*/ is a case of tests/golden_memory, with its weights in checkpoint/. It gets plugin.npz: `{run}/actions`,
or `{run}/selected` where the case calls select_action, un-normalised. Prompts are what LeRobot's processors make.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch
from lerobot_policy_turbopi import TurboPiConfig

from lerobot_cases.plugin import _load, _request


def run(folder: Path) -> dict[str, np.ndarray]:
    case, inputs = json.loads((folder / "case.json").read_text()), dict(np.load(folder / "inputs.npz"))
    config = TurboPiConfig(checkpoint=str(folder / "checkpoint"), precision="f32", backend="pytorch", device="cpu")
    policy, pre, post = _load(config)
    noise, selects = torch.from_numpy(inputs["noise"])[None], case["call"] == "select_action"
    found: dict[str, np.ndarray] = {}
    for index, wanted in enumerate(case["runs"]):
        if wanted["reset_before"]:
            policy.reset()
        batch = pre(_request(inputs, wanted["observation"]))
        answer = post((policy.select_action if selects else policy.predict_action_chunk)(batch, noise=noise))[0]
        found[f"{index}/{'selected' if selects else 'actions'}"] = answer.float().numpy()
    return found


if __name__ == "__main__":
    for file in sorted(Path(sys.argv[1]).glob("*/case.json")):
        np.savez(file.parent / "plugin.npz", **run(file.parent))  # type: ignore[arg-type]
