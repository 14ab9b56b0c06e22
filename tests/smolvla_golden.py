"""Golden checkpoints of the other families as their users have them: a folder, and the Hub's cache beside it."""

import json
import lzma
import shutil
from pathlib import Path

import numpy as np
from safetensors.numpy import save_file

COMMIT = "0" * 40
GOLDEN = Path(__file__).parent / "golden_smolvla"


def make_hub(folder: Path) -> Path:
    """A Hub cache with the stand-ins of the vision-language models."""
    for one in (GOLDEN / "hub/HuggingFaceTB").iterdir():
        add_to_hub(folder, f"HuggingFaceTB/{one.name}", one)
    return folder


def add_to_hub(folder: Path, name: str, source: Path) -> None:
    repository = folder / f"models--{name.replace('/', '--')}"
    shutil.copytree(source, repository / "snapshots" / COMMIT)
    (repository / "refs").mkdir()
    (repository / "refs/main").write_text(COMMIT)


def make_checkpoint(name: str, folder: Path, golden: Path = GOLDEN) -> Path:
    """A case's checkpoint with its weights unpacked."""
    shutil.copytree(golden / name / "checkpoint", folder)
    if (packed := golden / name / "model.safetensors.xz").is_file():
        (folder / "model.safetensors").write_bytes(lzma.decompress(packed.read_bytes()))
    return folder


def make_aloha(folder: Path) -> tuple[Path, dict[str, np.ndarray]]:
    """special_tokens with another config.json and statistics, and what tools/lerobot_cases/smolvla_aloha.py kept."""
    kept = dict(np.load(GOLDEN / "special_tokens/aloha.npz"))
    make_checkpoint("special_tokens", folder)
    config = json.loads((folder / "config.json").read_text()) | json.loads(str(kept["changes"]))
    (folder / "config.json").write_text(json.dumps(config))
    stats = {key.replace("/", "."): one for key, one in kept.items() if key.endswith(("/mean", "/std"))}
    for file in folder.glob("policy_*.safetensors"):
        save_file(stats, file)
    return folder, kept


class GoldenRuns:
    """A case's observations and what their owner's code computed from them."""

    def __init__(self, name: str, golden: Path = GOLDEN) -> None:
        self.described = json.loads((golden / name / "case.json").read_text())
        self._inputs = dict(np.load(golden / name / "inputs.npz"))
        self._expected = dict(np.load(golden / name / "expected.npz"))

    @property
    def noise(self) -> np.ndarray:
        return self._inputs["noise"]

    @property
    def previous(self) -> np.ndarray:
        return self._inputs["previous"]

    def __len__(self) -> int:
        return len(self.described["runs"])

    def observation(self, run: int) -> dict[str, object]:
        prefix = f"{self.described['runs'][run]['observation']}/"
        found = {key.removeprefix(prefix): one for key, one in self._inputs.items() if key.startswith(prefix)}
        return {key: str(one.reshape(-1)[0]) if one.dtype.kind == "U" else one for key, one in found.items()}

    def expected(self, run: int) -> dict[str, np.ndarray]:
        start = f"{run}/"
        return {key.removeprefix(start): one for key, one in self._expected.items() if key.startswith(start)}

    def actions(self, run: int, part: str = "") -> np.ndarray:
        return self._expected[f"{run}/{part}actions"]


def relative(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Root mean square of the difference, of what `theirs` has; infinite for other shapes."""
    if ours.shape != theirs.shape:
        return np.inf
    exact = theirs.astype(np.float64)
    return float(np.sqrt(np.square(ours - exact).mean() / max(np.square(exact).mean(), 1e-12)))
