"""A small pi052 policy of LeRobot's open PR 4184, and the subtasks and actions that its own code computes on a CPU.

The PR isn't merged: PR_SOURCE is the `src` folder of a checkout of it (the commit in `PINNED`), and stands before the
installed LeRobot. From the root:

    PYTHONPATH=PR_SOURCE:tools .venv-lerobot/bin/python -m lerobot_cases.text tests/golden_text

It leaves model.safetensors.xz, and of each case CASE/checkpoint/, case.json, inputs.npz and expected.npz:

    {run}/task_tokens, generated, logits (of two steps, every fourth of the tokenizer's ids), subtask, source, tokens,
    causal (joint form), normalized_state, normalized_actions, actions

The language head is fitted to say the texts in SAYS, so that answers end and no two logits are near each other. One of
its rows would win every time, and is of those that the policy never writes.
"""

import json
import lzma
import shutil
import sys
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
import transformers

PINNED = "f2c8867df1f83e5717ec71cfdd158e96b82828e7"
TOKENIZER = Path(__file__).parents[2] / "tests" / "golden_pi0_fast" / "main" / "tokenizer"
_from_pretrained = transformers.AutoTokenizer.from_pretrained
transformers.AutoTokenizer.from_pretrained = lambda name, **options: _from_pretrained(str(TOKENIZER), **options)

from lerobot_cases import small  # noqa: E402

small.VOCABULARY = 2200
small.shrink()

from lerobot.configs.types import FeatureType, PolicyFeature  # noqa: E402
from lerobot.policies.factory import get_policy_class, make_pre_post_processors  # noqa: E402
from lerobot.policies.pi052.configuration_pi052 import PI052Config  # noqa: E402
from lerobot.policies.pi052.inference import pi052_adapter  # noqa: E402
from lerobot.policies.utils import prepare_observation_for_inference  # noqa: E402

CAMERAS, STATE, ACTION, EOS, NEVER = ("front", "wrist"), 6, 7, 1, 1500
SAYS = ("  open the \n drawer", "grasp it", "")  # by observation
TASKS = ("tidy the_kitchen table", "tidy the_kitchen table", "Go home")


@dataclass(frozen=True)
class Case:
    """runs: the observation of each chunk; -1: a new episode begins."""

    config: dict[str, Any]
    runs: tuple[int, ...]


CASES = {
    "subtasks": Case({"subtask_replan_steps": 10}, (0, 1, 1, -1, 2, 0, 0, 1, 2)),
    "joint": Case({"joint_subtask_conditioning": True}, (0, 1)),
}


def main(folder: Path) -> None:
    observations = [_observation(index) for index in range(len(SAYS))]
    policies = {name: _policy(case) for name, case in CASES.items()}
    head = _fitted_head(policies, observations)
    for name, policy in policies.items():
        policy.model.paligemma_with_expert.paligemma.lm_head.weight = torch.nn.Parameter(head.clone())
        _record(folder / name, policy, CASES[name], observations)
    content = {(folder / name / "checkpoint/model.safetensors").read_bytes() for name in CASES}
    (weights,) = content
    (folder / "model.safetensors.xz").write_bytes(lzma.compress(weights, preset=lzma.PRESET_EXTREME | 9))
    for name in CASES:
        (folder / name / "checkpoint/model.safetensors").unlink()


def _observation(index: int) -> dict[str, Any]:
    random = np.random.default_rng(index)
    images = {
        f"observation.images.{name}": np.kron(random.integers(0, 256, (3, 4, 3)), np.ones((24, 24, 1))).astype(np.uint8)
        for name in CAMERAS
    }
    return images | {"observation.state": random.uniform(-2, 2, STATE).astype(np.float32), "task": TASKS[index]}


def _policy(case: Case) -> Any:
    features = {f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, 72, 96)) for name in CAMERAS}
    config = PI052Config(
        device="cpu",
        input_features=features | {"observation.state": PolicyFeature(FeatureType.STATE, (STATE,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTION,))},
        chunk_size=8,
        n_action_steps=4,
        recipe_path="recipes/subtask.yaml",
        enable_fast_action_loss=False,
        fast_skip_tokens=100,
        tokenizer_max_length=100,
        **case.config,
    )
    policy = get_policy_class("pi052")(config)
    small.fill(policy.named_parameters(), 0)
    policy.model.paligemma_with_expert.gemma_expert.lm_head.weight.data.zero_()  # which nothing reads
    language = policy.model.paligemma_with_expert.paligemma.model.language_model
    language.embed_tokens.weight.data[980:] = 0
    for layer in language.layers:  # so that the task and the images reach the last token
        for name, factor in (("q_proj", 4), ("k_proj", 2), ("o_proj", 16)):
            getattr(layer.self_attn, name).weight.data *= factor
    return policy.eval()


def _fitted_head(policies: dict[str, Any], observations: list[dict[str, Any]]) -> torch.Tensor:
    """The head [V, D] that says SAYS behind each observation, in float32 of few bits."""
    hidden: list[torch.Tensor] = []
    targets: list[int] = []
    for name, policy in policies.items():
        ids_of = pi052_adapter._get_loc_tokenizer("x", transformers.AutoTokenizer, lambda one: one)
        for text, observation in zip(SAYS, observations, strict=True):
            said = [*ids_of(text, add_special_tokens=False)["input_ids"], EOS]
            states = _hidden_of(policy, observation, said, joint=name == "joint")
            hidden.append(states)
            targets += said
    points, wanted = torch.cat(hidden), torch.tensor(targets)
    rows = torch.from_numpy(np.unique(targets))
    head = torch.zeros(small.VOCABULARY, points.shape[1])
    generator = torch.Generator().manual_seed(0)
    head[:980] = torch.randint(-7, 8, (980, points.shape[1]), generator=generator) / 64
    chosen = torch.nn.Parameter(head[rows])
    optimizer = torch.optim.Adam([chosen], lr=0.03)
    scale = points.norm(dim=1).mean()
    for _ in range(3000):
        logits = points @ head.index_copy(0, rows, chosen).T
        loss = torch.nn.functional.multi_margin_loss(logits, wanted, margin=float(scale), p=1)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    head[rows] = (chosen.detach() * 256).round() / 256
    head[NEVER] = 2 * head[targets[0]]
    logits = points @ head.T
    assert (logits.argmax(1) == NEVER).any()
    logits[:, NEVER] = -torch.inf
    best = logits.topk(2, dim=1)
    assert (best.indices[:, 0] == wanted).all() and (best.values[:, 0] - best.values[:, 1]).min() > 0.1
    return head


@torch.no_grad()
def _hidden_of(policy: Any, observation: dict[str, Any], said: list[int], joint: bool) -> torch.Tensor:
    """What the head reads [len(said), D] when the policy says `said`: by its own code, with ids put in its mouth."""
    found: list[torch.Tensor] = []
    forced = iter(said)
    head, sample = policy.model.paligemma_with_expert.paligemma.lm_head, policy._sample_next_token
    hook = head.register_forward_hook(lambda module, inputs, output: found.append(inputs[0][0, -1].clone()))
    policy._sample_next_token = lambda *_: torch.tensor([next(forced)])
    policy.reset()
    policy._prepare_action_batch(_batch(policy, observation))
    hook.remove()
    policy._sample_next_token = sample
    return torch.stack(found)


def _batch(policy: Any, observation: dict[str, Any]) -> dict[str, Any]:
    arrays = {key: value for key, value in observation.items() if key != "task"}
    pre, _ = make_pre_post_processors(policy.config, dataset_stats=_statistics())
    return pre(prepare_observation_for_inference(arrays, torch.device("cpu"), task=observation["task"]))


def _statistics() -> dict[str, dict[str, torch.Tensor]]:
    random = np.random.default_rng(7)
    found = {}
    for key, width in (("observation.state", STATE), ("action", ACTION)):
        low, high = random.uniform(-3, -1, width), random.uniform(1, 3, width)
        values = {"q01": low, "q99": high, "mean": (low + high) / 2, "std": (high - low) / 4, "min": low, "max": high}
        found[key] = {name: torch.tensor(value, dtype=torch.float32) for name, value in values.items()}
    return found


@torch.no_grad()
def _record(folder: Path, policy: Any, case: Case, observations: list[dict[str, Any]]) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    policy.save_pretrained(folder / "checkpoint")
    file = folder / "checkpoint/config.json"  # the PR's older draccus writes the type, main's doesn't
    file.write_text(json.dumps({"type": "pi052"} | json.loads(file.read_text()), indent=4))
    pre, post = make_pre_post_processors(policy.config, dataset_stats=_statistics())
    pre.save_pretrained(folder / "checkpoint")
    post.save_pretrained(folder / "checkpoint")
    shutil.rmtree(folder / "checkpoint/tokenizer", ignore_errors=True)
    policy = type(policy).from_pretrained(folder / "checkpoint").eval()
    noise = np.random.default_rng(3).standard_normal((8, 32)).astype(np.float32)
    policy.model.sample_noise = lambda shape, device: torch.from_numpy(noise)[None]
    policy.reset()
    found: dict[str, np.ndarray] = {}
    head, run = policy.model.paligemma_with_expert.paligemma.lm_head, 0
    for index in case.runs:
        if index < 0:
            policy.reset()
            continue
        logits: list[torch.Tensor] = []
        sampled: list[int] = []
        sample, select = policy._sample_next_token, policy.select_message
        hook = head.register_forward_hook(lambda module, inputs, output, to=logits: to.append(output[0, -1].clone()))
        prompts: list[torch.Tensor] = []

        def choose(*given: Any, sample: Any = sample, to: list[int] = sampled) -> torch.Tensor:
            ids = sample(*given)
            to.append(int(ids[0]))
            return ids

        def watched(batch: Any, select: Any = select, to: list[torch.Tensor] = prompts, **options: Any) -> str:
            to.append(batch["observation.language.tokens"][0])
            return select(batch, **options)

        policy._sample_next_token, policy.select_message = choose, watched
        raw = pre(
            prepare_observation_for_inference(
                {key: value for key, value in observations[index].items() if key != "task"},
                torch.device("cpu"),
                task=observations[index]["task"],
            )
        )
        batch = policy._prepare_action_batch(raw)
        hook.remove()
        del policy._sample_next_token, policy.select_message
        normalized = policy.predict_action_chunk(batch)
        values = {
            "generated": np.array(sampled, np.int64),
            "subtask": np.array(policy.last_subtasks[0]),
            "source": np.array(policy.last_subtasks_source[0] if sampled else "held"),
            "tokens": batch["observation.language.tokens"][0].numpy(),
            "normalized_state": batch["observation.state"][0].numpy(),
            "normalized_actions": normalized[0].numpy(),
            "actions": post(normalized)[0].numpy(),
        }
        if sampled:
            values |= {"task_tokens": prompts[0].numpy(), "logits": torch.stack(logits)[:2, :980:4].numpy()}
        if (marks := batch.get("observation.language.causal_marks")) is not None:
            values["causal"] = marks[0].numpy()
        found |= {f"{run}/{name}": value for name, value in values.items()}
        run += 1
    inputs: dict[str, Any] = {"noise": noise}
    for index, observation in enumerate(observations):
        inputs |= {f"{index}/{key}": np.array(value) for key, value in observation.items()}
    np.savez_compressed(folder / "inputs.npz", **inputs)
    np.savez_compressed(folder / "expected.npz", **found)  # type: ignore[arg-type]
    versions = {name: version(name) for name in ("transformers", "torch")} | {"lerobot": f"PR 4184 at {PINNED}"}
    described = {"vision_heads": small.VISION_HEADS, "versions": versions, "config": case.config}
    runs = []
    begins = True
    for index in case.runs:
        if index >= 0:
            runs.append({"observation": index, "begins": begins})
        begins = index < 0
    (folder / "case.json").write_text(json.dumps(described | {"runs": runs}, indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
