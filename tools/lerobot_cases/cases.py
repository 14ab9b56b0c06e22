"""The cases: what is in each checkpoint's files, and what is asked of it."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

TASK = "pick up the black bowl and put it on the plate"


@dataclass(frozen=True)
class Seen:
    """One observation: images by camera, as (height, width)."""

    camera_images: dict[str, tuple[int, int]]
    task: str = TASK
    state_dim: int = 8
    unit: bool = False  # images are float32 in [0, 1], not uint8; LeRobot before 0.6 divides these by 255, too

    def made(self, seed: int) -> dict[str, np.ndarray]:
        """LeRobot's keys: [h, w, 3] images of a few colours, float32 state, the task as an array of one text."""
        rng = np.random.default_rng(seed)
        made: dict[str, np.ndarray] = {}
        for name, (height, width) in self.camera_images.items():
            blocks = rng.integers(0, 256, (8, 8, 3), dtype=np.uint8)
            rows, columns = np.arange(height) * 8 // height, np.arange(width) * 8 // width
            camera_image = blocks[rows][:, columns]
            made[f"observation.images.{name}"] = camera_image.astype(np.float32) / 255 if self.unit else camera_image
        made["observation.state"] = rng.uniform(-1.3, 1.3, self.state_dim).astype(np.float32)
        made["task"] = np.array([self.task])
        return made


LANDSCAPE, PORTRAIT, SQUARE = (72, 96), (80, 60), (224, 224)


@dataclass(frozen=True)
class Case:
    """A checkpoint and what is asked of it. `runs` are all observations once, unless given."""

    kind: str
    config: dict[str, Any] = field(default_factory=dict)
    observations: tuple[Seen, ...] = (Seen({"top": LANDSCAPE, "wrist": PORTRAIT}),)
    runs: list[dict[str, Any]] | None = None
    cameras: tuple[str, ...] = ("top", "wrist")
    state_dim: int = 8
    config_state_dim: int | None = None  # what config.json says of it, where that is something else
    action_dim: int = 7
    rename_map: dict[str, str] | None = None
    adapter: dict[str, Any] | None = None  # of peft.LoraConfig
    trained: str | None = None  # pattern of the parameters that are trained a few steps with LeRobot's own loss
    seed: int = 0
    weights_seed: int = 1

    def statistics(self) -> dict[str, dict[str, np.ndarray]]:
        """A dataset's: of both, all that LeRobot's modes may want."""
        rng = np.random.default_rng(self.seed + 100)
        found = {}
        for key, dim in (("observation.state", self.state_dim), ("action", self.action_dim)):
            middle, half = rng.uniform(-0.3, 0.3, dim), rng.uniform(0.5, 1.5, dim)
            values = {
                "min": middle - 1.2 * half,
                "max": middle + 1.2 * half,
                "mean": middle + 0.05,
                "std": half / 2,
                "q01": middle - half,
                "q10": middle - half / 2,
                "q50": middle,
                "q90": middle + half / 2,
                "q99": middle + half,
            }
            found[key] = {name: value.astype(np.float32) for name, value in values.items()}
        return found


MODES = {"VISUAL": "IDENTITY", "STATE": "QUANTILES", "ACTION": "QUANTILES"}
TOP_WRIST = {"top": LANDSCAPE, "wrist": PORTRAIT}
JOINTS = ["shoulder.pos", "elbow.pos", "wrist.pos", "roll.pos", "pitch.pos", "yaw.pos", "Gripper.pos"]
EXPERT_ATTENTION = r".*\.gemma_expert\..*\.self_attn\.(q|v)_proj"


def _modes(state: str, action: str) -> dict[str, Any]:
    return {"normalization_mapping": MODES | {"STATE": state, "ACTION": action}}


CASES: dict[str, Case] = {
    # Pi0: the prompt as it is, with a newline; the state as a token; mean and standard deviation
    "pi0": Case(
        "pi0",
        observations=(
            Seen(TOP_WRIST),
            Seen({"top": SQUARE, "wrist": (33, 224)}, task="  Put_the  spoon\nin the drawer\n"),
        ),
        runs=[
            {"observation": 0, "call": {}},
            {"observation": 1, "call": {}},
            {"observation": 0, "call": {"num_steps": 3}},
        ],
    ),
    "pi0_long_prompt": Case("pi0", observations=(Seen(TOP_WRIST, task="stack " * 60),), seed=1),
    "pi0_cameras": Case(
        "pi0",
        {"empty_cameras": 1, "n_obs_steps": 2, **_modes("QUANTILES", "MIN_MAX")},
        cameras=("top", "left", "right"),
        observations=(Seen({"left": LANDSCAPE, "other": SQUARE}, state_dim=6),),
        state_dim=6,
        seed=2,
    ),
    "pi0_relative": Case(
        "pi0",
        {"use_relative_actions": True, "relative_exclude_joints": ["gripper"], "action_feature_names": JOINTS},
        seed=3,
    ),
    "pi0_bf16": Case("pi0", {"dtype": "bfloat16", "chunk_size": 6, "n_action_steps": 4}, seed=4),
    "pi0_peft": Case(
        "pi0",
        adapter={
            "target_modules": rf"({EXPERT_ATTENTION}|model\.(state_proj|action_in_proj|action_time_mlp_in))",
            "r": 4,
            "lora_alpha": 16,
            "use_rslora": True,
        },
        seed=5,
    ),
    # Pi0.5
    "mean_std": Case(
        "pi05",
        _modes("MEAN_STD", "MEAN_STD"),
        observations=(Seen({"top": (300, 500), "wrist": (640, 480)}),),
        seed=6,
    ),
    "min_max_identity": Case("pi05", _modes("MIN_MAX", "IDENTITY"), observations=(Seen(TOP_WRIST, unit=True),), seed=7),
    "trained_embedding": Case("pi05", {"dtype": "float32"}, trained="embed_tokens|action_", seed=13),
    "bf16": Case("pi05", {"dtype": "bfloat16"}, seed=14),
    "relative_excluded": Case(
        "pi05",
        {
            "use_relative_actions": True,
            "relative_exclude_joints": ["ROLL", "grip"],
            "action_feature_names": JOINTS,
            "num_inference_steps": 4,
        },
        seed=8,
    ),
    "renamed": Case(
        "pi05",
        cameras=("camera1", "camera2", "camera3"),
        rename_map={"observation.images.top": "observation.images.camera2"},
        observations=(
            Seen({"camera1": PORTRAIT, "top": LANDSCAPE}),
            Seen({"camera2": LANDSCAPE, "camera3": PORTRAIT, "side": SQUARE}),
            Seen({"top": LANDSCAPE, "camera2": PORTRAIT}),
            Seen({"camera2": PORTRAIT, "top": LANDSCAPE}),
        ),
        seed=9,
    ),
    "two_observations_empty_camera": Case(
        "pi05",
        {"n_obs_steps": 2, "empty_cameras": 1},
        observations=(Seen({"top": (224, 100), "wrist": (1, 1)}), Seen({"wrist": PORTRAIT, "empty_camera_0": SQUARE})),
        seed=10,
    ),
    # a fine-tune by --policy.path: the base's cameras and state in config.json, the data set's statistics
    "fine_tune": Case(
        "pi05",
        cameras=("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb"),
        rename_map={
            "observation.images.top": "observation.images.base_0_rgb",
            "observation.images.wrist": "observation.images.left_wrist_0_rgb",
        },
        observations=(Seen(TOP_WRIST, state_dim=6),),
        state_dim=6,
        config_state_dim=32,
        action_dim=6,
        seed=15,
    ),
    "peft": Case(
        "pi05",
        adapter={
            "target_modules": rf"({EXPERT_ATTENTION}|.*\.language_model\..*\.(o_proj|down_proj)"
            r"|model\.(action_in_proj|action_out_proj|time_mlp_in|time_mlp_out))",
            "r": 4,
            "lora_alpha": 8,
            "rank_pattern": {"q_proj": 2},
            "alpha_pattern": {r"language_model\..*\.o_proj": 3},
            "fan_in_fan_out": True,
        },
        seed=11,
    ),
    "peft_modules_to_save": Case(
        "pi05",
        adapter={
            "target_modules": ["q_proj", "fc1", "patch_embedding", "embed_tokens"],
            "modules_to_save": ["action_out_proj", "time_mlp_in", "post_layernorm"],
            "bias": "lora_only",
            "r": 2,
        },
        seed=12,
    ),
}
