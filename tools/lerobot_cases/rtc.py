"""Real-time chunking as LeRobot's engine does it: what its own policy computes, and the plugin's beside it.

    PYTHONPATH=tools:src:plugins/lerobot_policy_turbopi/src \\
        .venv-lerobot-main/bin/python -m lerobot_cases.rtc CHECKPOINT INPUTS.npz FOLDER [--plugin]

CHECKPOINT is a case's with relative actions and its weights, with rtc_training_max_delay = 4 where LeRobot has it (its
main branch): else the runs of mode "trained" are left out. INPUTS.npz is the case's. A first chunk is computed, and
from a second state the chunks that join what is left of it. FOLDER gets rtc.json, the runs, and rtc.npz:

    state                       of the second observation
    first/model_actions         [H, d] normalised, first/actions [H, d]: the chunk that is joined
    {run}/left_over             [K, d], re-anchored to the second state, cut or padded: what the policy gets
    {run}/normalized_actions, {run}/actions

--plugin: the same by `--policy.type=turbopi`.
"""

import argparse
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import RTCAttentionSchedule
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.rtc import reanchor_relative_rtc_prefix
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.processor import NormalizerProcessorStep, RelativeActionsProcessorStep
from lerobot_policy_turbopi import TurboPiConfig

from lerobot_cases.small import shrink


def _run(
    mode: str, delay: int, horizon: int, row: int, schedule: str = "LINEAR", padding: str = "zeros"
) -> dict[str, Any]:
    return {
        "mode": mode,
        "inference_delay": delay,
        "execution_horizon": horizon,
        "row": row,  # of the first chunk: where the left-over begins
        "schedule": schedule,
        "padding": padding,  # of a left-over shorter than the execution horizon: LeRobot's pull request 4454 has "last"
    }


RUNS = [
    _run("guided", 2, 6, 3),
    _run("guided", 3, 5, 2, "EXP"),
    _run("guided", 7, 6, 1),  # the delay is past the execution horizon
    _run("guided", 6, 10, 0, "ONES"),  # horizon as long as the chunk, delay more than half of it
    _run("guided", 2, 8, 6),
    _run("guided", 2, 8, 6, padding="last"),
    _run("trained", 3, 6, 3),
    _run("trained", 4, 5, 5, padding="last"),
    _run("trained", 0, 6, 3),
]


def record(checkpoint: Path, inputs: dict[str, np.ndarray], *, plugin: bool) -> dict[str, torch.Tensor]:
    policy, pre, post = _load(checkpoint, plugin=plugin)
    noise = torch.from_numpy(inputs["noise"])[None]
    observation = {key[2:]: value for key, value in inputs.items() if key.startswith("0/")}
    task = str(observation.pop("task")[0])

    def preprocessed() -> dict[str, Any]:
        return dict(pre(prepare_observation_for_inference(dict(observation), torch.device("cpu"), task=task)))

    first = policy.predict_action_chunk(preprocessed(), noise=noise)
    actions = post(first)
    observation["observation.state"] = observation["observation.state"] + np.float32(0.1)
    found = {
        "state": torch.from_numpy(observation["observation.state"]),
        "first/model_actions": first[0],
        "first/actions": actions[0],
    }
    (relative,) = (step for step in pre.steps if isinstance(step, RelativeActionsProcessorStep))
    (normalizer,) = (step for step in pre.steps if isinstance(step, NormalizerProcessorStep))
    for index, run in enumerate(RUNS):
        batch = preprocessed()
        left_over = reanchor_relative_rtc_prefix(
            actions[0, run["row"] :], relative.get_cached_state(), relative, normalizer, "cpu"
        ).reshape(-1, actions.shape[-1])
        missing = run["execution_horizon"] - len(left_over)
        if missing > 0:
            last = left_over[-1:] if run["padding"] == "last" else torch.zeros_like(left_over[-1:])
            left_over = torch.cat([left_over, last.expand(missing, -1)])
        left_over = left_over[: run["execution_horizon"]]
        if not _set_rtc(policy, run, plugin=plugin):
            continue
        joined = policy.predict_action_chunk(
            batch, noise=noise, inference_delay=run["inference_delay"], prev_chunk_left_over=left_over
        )
        found |= {
            f"{index}/left_over": left_over,
            f"{index}/normalized_actions": joined[0],
            f"{index}/actions": post(joined)[0],
        }
    return found


def _set_rtc(policy: Any, run: dict[str, Any], *, plugin: bool) -> bool:
    """As LeRobot's rollout does; whether this policy has the run's mode."""
    mode = {"mode": run["mode"]} if hasattr(RTCConfig(), "mode") and not plugin else {}
    if run["mode"] == "trained" and not (mode or (plugin and policy.config.rtc_training_max_delay)):
        return False
    policy.config.rtc_config = RTCConfig(
        prefix_attention_schedule=RTCAttentionSchedule[run["schedule"]],
        execution_horizon=run["execution_horizon"],
        **mode,
    )
    if plugin:
        policy.config.rtc_mode = run["mode"]
    policy.init_rtc_processor()
    return True


def _load(checkpoint: Path, *, plugin: bool) -> tuple[Any, Any, Any]:
    config: Any = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    if plugin:
        config = TurboPiConfig(
            checkpoint=str(checkpoint), precision="f32", backend="pytorch", device="cpu", warmup=False
        )
    policy: Any = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
    return policy, *make_pre_post_processors(config, pretrained_path=str(checkpoint))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("inputs", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--plugin", action="store_true")
    given = parser.parse_args()
    shrink()
    found = record(given.checkpoint.absolute(), dict(np.load(given.inputs)), plugin=given.plugin)
    arrays: dict[str, Any] = {name: value.detach().float().numpy() for name, value in found.items()}
    np.savez_compressed(given.folder / "rtc.npz", **arrays)
    described = {"runs": RUNS, "versions": {name: version(name) for name in ("lerobot", "torch", "transformers")}}
    (given.folder / "rtc.json").write_text(json.dumps(described, indent=1) + "\n")


if __name__ == "__main__":
    main()
