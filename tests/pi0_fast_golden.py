"""Golden checkpoints of Pi0-FAST as their users have them, and the policies of these."""

import json
import shutil
from pathlib import Path
from typing import Any

from smolvla_golden import GoldenRuns, add_to_hub, make_checkpoint

from turbopi import UnifiedPolicy

GOLDEN = Path(__file__).parent / "golden_pi0_fast"
TOKENIZER = GOLDEN / "hub/tokenizer.model"
RUNS = {
    "base": 2,
    "broken": 5,
    "no_prefix": 2,
    "quantiles_empty_camera": 2,
    "relative": 2,
    "short_execution": 2,
    "openpi": 2,
}
MAIN = ("quantiles_empty_camera", "relative", "short_execution")  # their folders have both tokenizers
OPENPI = {
    "preset": "pi0_fast_libero",
    "asset_id": "small",
    "action_horizon": 8,
    "max_prompt_tokens": 120,
    "max_decoding_steps": 90,
    "robot_options": {},
}


def make_hub(folder: Path) -> Path:
    for name in ("lerobot/fast-action-tokenizer", "physical-intelligence/fast"):
        add_to_hub(folder, name, GOLDEN / "hub" / name.rpartition("/")[2])
    return folder


def make_folder(name: str, folder: Path, **settings: object) -> Path:
    """A case's checkpoint, with a turbopi.json."""
    make_checkpoint(name, folder, GOLDEN)
    if name in MAIN:
        shutil.copytree(GOLDEN / "main", folder, dirs_exist_ok=True)
    values: dict[str, object] = {"vision_heads": runs(name).described["vision_heads"]}
    values |= OPENPI if name == "openpi" else {}
    (folder / "turbopi.json").write_text(json.dumps(values | settings))
    return folder


def runs(name: str) -> GoldenRuns:
    return GoldenRuns(name, GOLDEN)


def policy_of(folder: Path, **options: Any) -> UnifiedPolicy:
    given: dict[str, Any] = {"precision": "f32", "device": "cpu", "tokenizer": TOKENIZER}
    return UnifiedPolicy(folder, **given | options)
