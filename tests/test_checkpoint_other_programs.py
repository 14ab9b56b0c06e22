"""Dexbotic's, StarVLA's and openpi-comet's checkpoints: the golden weights as their own code saves them.

golden_programs/actions.npz has what their own servers answered, on a CPU, with the golden weights, statistics (`state`,
`action`: mean, std, q01, q99), and the observation and noise of golden/policy/libero_pi05 (to Dexbotic's the images as
openpi resizes them): Dexbotic's (commit 7a4d2ee4, `_get_response` of the inference configs of pi05_exp, libero_pi05 and
pi0_exp, transformers 4.51) and StarVLA's (0ed0aad2, StarVLAOpenPIPolicy, transformers 4.57, with a vocabulary and a
vision tower as small as the golden ones). The stand-in tokenizer is the golden fixtures'. Each had loaded the weights
and saved them: `SAVED` is the SHA-256 of the names and shapes in that file.
"""

import hashlib
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from checkpoint_helpers import GOLDEN, STORED, edit_tensors, read_tree, torch_copy, write_json, write_tree
from safetensors.torch import save_file
from torch import Tensor

from turbopi import UnifiedPolicy
from turbopi.checkpoint import Checkpoint, convert, open_checkpoint
from turbopi.checkpoint.names import to_openpi
from turbopi.support.errors import CheckpointError, ConfigError

ACTIONS = Path(__file__).parent / "golden_programs" / "actions.npz"
SAVED = {
    ("dexbotic", "pi05"): "3f000c630ce34462d87aefbb82a6a426647affb7d472497891463a3dc63c91d3",
    ("dexbotic", "pi0"): "203c10ea294a92cce0a1da10550a47240cb1b975d34d9ec525d8078f00388040",
    ("starvla", "pi05"): "a00ebf1c9366dd0300a67bc2331e98c77ec2dead38f9c451054996b0ecddd60b",
    ("starvla", "pi0"): "9bf00bdce765bc5d8ec2717849fdb62241443be5597d9d7c8c452e760dae4e6a",
}
VISION = "mm_vision_tower.vision_tower.vision_model."
POOLING = {  # of a SigLIP that Dexbotic builds whole, and doesn't call
    "probe": (1, 1, 64),
    "attention.in_proj_weight": (192, 64),
    "attention.in_proj_bias": (192,),
    "attention.out_proj.weight": (64, 64),
    "attention.out_proj.bias": (64,),
    "layernorm.weight": (64,),
    "layernorm.bias": (64,),
    "mlp.fc1.weight": (128, 64),
    "mlp.fc1.bias": (128,),
    "mlp.fc2.weight": (64, 128),
    "mlp.fc2.bias": (64,),
}
RELATIVE = {"robot_options": {"delta_actions": True}}
SETTINGS: dict[tuple[str, str], dict[str, Any]] = {
    ("dexbotic", "pi05"): {"preset": "pi05_libero", **RELATIVE},
    ("dexbotic", "pi05_libero"): {"preset": "pi05_libero", "normalization": "zscore"},
    ("dexbotic", "pi0"): {"preset": "pi0_libero"},
    ("starvla", "pi05"): {"preset": "pi05_libero"},
    ("starvla", "pi0"): {"preset": "pi0_libero"},
}


class ByteTokenizer:
    def encode(self, text: str, add_bos: bool) -> list[int]:
        return [2] * add_bos + [3 + byte % 509 for byte in text.encode()]


def statistics(*names: str, width: int | None = None) -> dict[str, dict[str, list[float]]]:
    """The golden ones, called `names`, of both features, filled with zeros up to `width`."""
    found = {}
    with np.load(ACTIONS) as file:
        for feature in ("state", "action"):
            rows = [[*row, *[0.0] * ((width or len(row)) - len(row))] for row in file[feature].tolist()]
            found[feature] = dict(zip(names, rows, strict=True))
    return found


def dexbotic(state: dict[str, Tensor], kind: str) -> dict[str, Tensor]:
    begins = (
        ("vision.patch_embedding.", f"{VISION}embeddings.patch_embedding."),
        ("vision.position_embedding.", f"{VISION}embeddings.position_embedding."),
        ("vision.layers.", f"{VISION}encoder.layers."),
        ("vision.", VISION),
        ("projector.", "mm_projector."),
        ("vlm.", "llm."),
        ("expert.", "action_expert."),
    )
    made = {f"model.{VISION}head.{name}": torch.ones(shape) for name, shape in POOLING.items()}
    made["model.action_expert.embed_tokens.weight"] = torch.ones(512, 32)
    if kind == "pi0":
        made["lm_head.weight"] = torch.ones(512, 96)
    for name, value in state.items():
        ours, theirs = next(((ours, theirs) for ours, theirs in begins if name.startswith(ours)), ("", ""))
        made[f"model.{theirs}{name.removeprefix(ours)}"] = value
    return made


def starvla(state: dict[str, Tensor]) -> dict[str, Tensor]:
    embedding = state["vlm.embed_tokens.weight"]
    made = {"vlm.model.model.language_model.embed_tokens.weight": embedding.clone()}
    made["action_head.gemma_expert.lm_head.weight"] = torch.ones(512, 32)
    for name, value in state.items():
        name = to_openpi(name)
        for openpis, theirs in (("paligemma.", "vlm.model."), ("gemma_expert.", "action_head.gemma_expert."), ("", "")):
            if name.startswith(before := f"paligemma_with_expert.{openpis}" if openpis else ""):
                made[theirs + name.removeprefix(before) if openpis else f"action_head.{name}"] = value
                break
    return made


def golden(kind: str, folder: Path) -> Checkpoint:
    config = {"preset": "pi05_libero" if kind == "pi05" else "pi0_aloha", "vision_heads": 4}
    write_json(folder / f"{kind}.json", config)
    return open_checkpoint(GOLDEN / kind / "jax", folder / f"{kind}.json")


def written(folder: Path, program: str, case: str, **settings: Any) -> Path:
    """The golden weights as that program saves them, its statistics, and a turbopi.json."""
    kind = case.split("_")[0]
    state = golden(kind, folder).load("cpu", "f32").state
    tensors = dexbotic(state, kind) if program == "dexbotic" else starvla(state)
    names = sorted(f"{name} {list(value.shape)}" for name, value in tensors.items())
    assert hashlib.sha256("\n".join(names).encode()).hexdigest() == SAVED[program, kind]
    weights = folder / "run" / ("" if program == "dexbotic" else "fp32")
    weights.mkdir(parents=True)
    save_file({name: value.contiguous() for name, value in tensors.items()}, weights / "model.safetensors")
    config = {"vision_heads": 4, "action_horizon": 10, **SETTINGS[program, case], **settings}
    write_json(weights / "turbopi.json", config)
    if program == "dexbotic":
        both = statistics("mean", "std", "min", "max", width=32)
        write_json(weights / "norm_stats.json", {"norm_stats": {"default": {"min": -1, "max": 1}, **both}})
        write_json(weights / "config.json", {"model_type": f"dexbotic_{kind}", "action_dim": 32, "chunk_size": 50})
    else:
        both = statistics("mean", "std", "q01", "q99")
        write_json(weights.parent / "dataset_statistics.json", {"libero_franka": both})
        (weights.parent / "config.yaml").write_text("framework: {name: PI05}\n")
    return weights


@pytest.mark.parametrize(("program", "case"), SETTINGS)
def test_a_policy_answers_as_its_own_server(tmp_path: Path, program: str, case: str) -> None:
    folder = written(tmp_path, program, case)
    opened = open_checkpoint(folder)
    assert opened.fingerprint() == golden(opened.config.model.kind, tmp_path).fingerprint()
    with np.load(STORED.parent / "policy" / "libero_pi05.npz") as file:
        stored = {key: file[key] for key in file.files}
    observation = {key.removeprefix("in/"): stored[key] for key in stored if key.startswith("in/")}
    if program == "dexbotic":
        observation["observation/image"] = stored["model_in/image_u8/base_0_rgb"]
        observation["observation/wrist_image"] = stored["model_in/image_u8/left_wrist_0_rgb"]
    policy = UnifiedPolicy(folder, precision="f32", backend="pytorch", tokenizer=ByteTokenizer())
    actions = policy.infer(observation, noise=stored["noise"])["actions"]
    with np.load(ACTIONS) as file:
        theirs = file[f"{program}_{case}"]
    # StarVLA embeds times in float32, openpi's PyTorch in float64: 1.4e-5; Dexbotic's are within 4e-7
    most = 2e-5 if program == "starvla" else 2e-6
    assert np.sqrt(((actions - theirs) ** 2).mean() / (theirs**2).mean()) < most


def test_notes_say_what_else_differs(tmp_path: Path) -> None:
    notes = "\n".join(open_checkpoint(written(tmp_path, "dexbotic", "pi05")).source.notes)
    assert re.search(r"Dexbotic's layout: .* 224 × 224 alone", notes) and "chunk_size = 50 (used: 10)" in notes


def test_what_lies_beside_starvlas_weights_comes_first(tmp_path: Path) -> None:
    folder = written(tmp_path, "starvla", "pi05")
    stats = {name: [1.0, 2.0] for name in ("mean", "std", "q01", "q99")}
    write_json(folder / "norm_stats.json", {"norm_stats": {"state": stats, "actions": stats}})
    opened = open_checkpoint(folder)
    assert opened.norm_stats.actions is not None and opened.norm_stats.actions.dim == 2


@pytest.mark.parametrize(("program", "message"), [("dexbotic", "never writes"), ("starvla", "fills the state up")])
def test_a_state_in_the_prompt_is_refused(tmp_path: Path, program: str, message: str) -> None:
    folder = written(tmp_path, program, "pi05", discrete_state_input=True)
    with pytest.raises(ConfigError, match=rf"turbopi\.json: discrete_state_input is true, but \w+ {message}"):
        open_checkpoint(folder)


@pytest.mark.parametrize(
    ("program", "missing"),
    [
        ("dexbotic", "model.action_expert.layers.1.self_attn.o_proj.weight"),
        ("starvla", "action_head.gemma_expert.model.layers.1.self_attn.o_proj.weight"),
    ],
)
def test_what_is_missing_or_too_much_is_called_by_its_name(tmp_path: Path, program: str, missing: str) -> None:
    folder = written(tmp_path, program, "pi05")
    edit_tensors(folder, **{missing: None, "model.pointnet.weight": torch.ones(2, 2)})
    message = rf"missing {re.escape(missing)}; not a part of the model: model\.pointnet\.weight"
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(folder)


def test_dexbotics_hybrid_and_its_other_models_are_refused(tmp_path: Path) -> None:
    folder = written(tmp_path, "dexbotic", "pi05")
    edit_tensors(folder, **{"lm_head.weight": torch.ones(512, 96)})
    with pytest.raises(CheckpointError, match=r"lm_head\.weight: Dexbotic's hybrid Pi0\.5, whose prompts"):
        open_checkpoint(folder)
    edit_tensors(folder, **{"model.action_in_proj.weight": None})
    with pytest.raises(CheckpointError, match=r"model\.llm\..*: one of Dexbotic's other models"):
        open_checkpoint(folder)


def test_starvlas_frameworks_on_other_language_models_are_refused(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "other")
    edit_tensors(folder, **{"qwen_vl_interface.model.lm_head.weight": torch.ones(4, 4)})
    with pytest.raises(CheckpointError, match=r"qwen_vl_interface\.\S+: one of StarVLA's frameworks on Qwen"):
        open_checkpoint(folder)


def test_statistics_of_several_datasets_are_refused(tmp_path: Path) -> None:
    folder = written(tmp_path, "starvla", "pi05")
    file = folder.parent / "dataset_statistics.json"
    write_json(file, json.loads(file.read_text()) | {"another": {}})
    with pytest.raises(CheckpointError, match=r"has statistics of another, libero_franka; expected one dataset"):
        open_checkpoint(folder)


@pytest.mark.parametrize("program", ["dexbotic", "starvla"])
def test_converted_it_is_openpis(tmp_path: Path, program: str) -> None:
    opened = open_checkpoint(convert(written(tmp_path, program, "pi05"), tmp_path / "converted", precision="f32"))
    assert opened.fingerprint() == golden("pi05", tmp_path).fingerprint()
    assert opened.norm_stats.actions is not None and opened.norm_stats.actions.q99 is not None
    with np.load(ACTIONS) as file:
        np.testing.assert_allclose(opened.norm_stats.actions.q99[:7], file["action"][3])


def comets(folder: Path, tree: dict[str, np.ndarray]) -> Path:
    """As its training on several machines saves a step: Orbax 0.11 without OCDBT writes a folder for each array.

    Its configs pi05_b1k-*: chunks of 32 actions, of which the R1 Pro takes 23, and statistics of those.
    """
    write_tree(folder / "params", tree, value=True, ocdbt=False)
    for name in ("_METADATA", "_sharding"):
        write_json(folder / "params" / name, {})
    stats = {"mean": [0.1] * 23, "std": [2.0] * 23, "q01": [-1.5] * 23, "q99": [0.5] * 23}
    asset = folder / "assets" / "behavior-1k" / "2025-challenge-demos"
    asset.mkdir(parents=True)
    write_json(asset / "norm_stats.json", {"norm_stats": {"state": stats, "actions": stats}})
    robot = {
        "name": "r1pro",
        "cameras": {"head": "base_0_rgb", "left": "left_wrist_0_rgb", "right": "right_wrist_0_rgb"},
        "state": {"state": 23},
        "action_dim": 23,
    }
    write_json(folder / "r1pro.json", robot)
    chosen = {"asset_id": "behavior-1k/2025-challenge-demos", "action_horizon": 32, "robot": "r1pro.json"}
    write_json(folder / "turbopi.json", {"preset": "pi05_base"} | chosen)
    return folder


def test_openpi_comets_step_is_read(tmp_path: Path) -> None:
    opened = open_checkpoint(comets(tmp_path / "20000", read_tree(GOLDEN / "pi05" / "jax" / "params")))
    assert opened.fingerprint() == open_checkpoint(GOLDEN / "pi05" / "jax", "pi05_libero").fingerprint()
    assert opened.config.model.action_horizon == 32 and opened.config.discrete_state_input
    assert opened.norm_stats.actions is not None and opened.norm_stats.actions.dim == 23
    policy = UnifiedPolicy(opened, precision="f32", backend="pytorch", tokenizer=ByteTokenizer())
    cameras = dict.fromkeys(("head", "left", "right"), np.zeros((224, 224, 3), np.uint8))
    actions = policy.infer({**cameras, "state": np.zeros(23), "prompt": "turn on the radio"}, seed=0)["actions"]
    assert actions.shape == (32, 23) and np.isfinite(actions).all()


def test_its_point_clouds_and_absent_arrays_are_refused_by_name(tmp_path: Path) -> None:
    tree = read_tree(GOLDEN / "pi05" / "jax" / "params")
    folder = comets(tmp_path / "20000", tree | {"pointnet/mlp/kernel": np.ones((3, 4), np.float32)})
    shutil.rmtree(folder / "params" / "params.time_mlp_out.bias.value")
    message = r"missing time_mlp_out/bias; not a part of the model: pointnet/mlp/kernel"
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(folder)
    (folder / "params" / "params.action_out_proj.kernel.value" / "0.0").unlink()
    with pytest.raises(CheckpointError, match=r"action_out_proj/kernel has 0 of its 1 chunks"):
        open_checkpoint(folder)
