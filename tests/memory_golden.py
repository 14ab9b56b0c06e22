"""LeRobot's golden checkpoints of Pi0.5 with memory, as its users have them."""

import json
import lzma
import shutil
from pathlib import Path
from typing import Any

from smolvla_golden import GoldenRuns

GOLDEN = Path(__file__).parent / "golden_memory"
CASES = ("visual", "visual_last_layers", "proprio", "select_action")


def make_checkpoint(name: str, folder: Path, settings: dict[str, object] | None = None, **config: object) -> Path:
    """A case's checkpoint with its weights and tokenizer; other values of turbopi.json and config.json, if given."""
    shutil.copytree(GOLDEN / name / "checkpoint", folder)
    for packed, unpacked in (
        (GOLDEN / name / "model.safetensors.xz", folder / "model.safetensors"),
        (GOLDEN / "tokenizer.json.xz", folder / "tokenizer/tokenizer.json"),
    ):
        unpacked.parent.mkdir(exist_ok=True)
        unpacked.write_bytes(lzma.decompress(packed.read_bytes()))
    shutil.copy(GOLDEN / "tokenizer_config.json", folder / "tokenizer")
    (folder / "turbopi.json").write_text(json.dumps({"vision_heads": 4} | (settings or {})))
    (folder / "config.json").write_text(json.dumps(json.loads((folder / "config.json").read_text()) | config))
    return folder


class MemoryRuns(GoldenRuns):
    """A case's calls in order, and what LeRobot computed in them."""

    def __init__(self, name: str) -> None:
        super().__init__(name, GOLDEN)

    def resets(self, run: int) -> bool:
        """Whether an episode begins."""
        return bool(self.described["runs"][run]["reset_before"])

    def expected(self, run: int, part: str = "") -> dict[str, Any]:
        """part: "training/" for the prompt as in training, of proprioceptive memory."""
        prefix = f"{part}{run}/"
        return {key.removeprefix(prefix): one for key, one in self._expected.items() if key.startswith(prefix)}
