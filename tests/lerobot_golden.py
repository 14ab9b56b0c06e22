"""Comparing Turbo-Pi with what LeRobot's own code computed: cases as tools/lerobot_cases writes them."""

import json
import lzma
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from turbopi import UnifiedPolicy
from turbopi.checkpoint import open_checkpoint
from turbopi.models.observation import ModelInputs, Observation
from turbopi.models.pi0.reference import Pi0Model
from turbopi.preprocess.tokenizer import TINY_TOKENIZER

GOLDEN = Path(__file__).parent / "golden_lerobot"
EXACT = ("tokens", "token_mask", "image_mask")
INPUTS = {"images": 2e-6, "normalized_state": 2e-6}
FLOAT32 = {"keys": 4e-6, "values": 4e-6, "v_1": 4e-6, "normalized_actions": 2e-6, "actions": 2e-6}  # seen: a third
BFLOAT16 = {
    "keys": 4e-2,
    "values": 1e-2,
    "v_1": 2e-2,
    "normalized_actions": 5e-3,
    "actions": 5e-3,
}  # LeRobot's; seen: half


@dataclass(frozen=True)
class GoldenCase:
    """A case's folder."""

    folder: Path

    @property
    def described(self) -> dict[str, Any]:
        return dict(json.loads((self.folder / "case.json").read_text()))

    def assemble(self, into: Path) -> Path:
        """The checkpoint as LeRobot left it, beside its base model if it is an adapter, with a turbopi.json."""
        described, checkpoint = self.described, into / "checkpoint"
        settings = {"vision_heads": described["vision_heads"]}
        shutil.copytree(self.folder / "checkpoint", checkpoint)
        if "weights" in described:
            self._unpack(described["weights"], checkpoint)
        else:
            shutil.copytree(self.folder / "base", into / "base")
            self._unpack(described["base_weights"], into / "base")
            settings["base_model"] = "../base"
        (checkpoint / "turbopi.json").write_text(json.dumps(settings))
        return checkpoint

    def _unpack(self, name: str, folder: Path) -> None:
        packed = self.folder.parent / "weights" / name
        (folder / "model.safetensors").write_bytes(lzma.decompress(packed.read_bytes()))

    def differences(self, checkpoint: Path) -> dict[str, float]:
        """By name, the largest of all runs: nan where shapes differ or what must be equal isn't.

        Largest absolute difference for images and state; relative root mean square for the rest.
        """
        described = self.described
        inputs, expected = np.load(self.folder / "inputs.npz"), np.load(self.folder / "expected.npz")
        policy = UnifiedPolicy(checkpoint, backend="pytorch", precision="f32", device="cpu", tokenizer=TINY_TOKENIZER)
        opened = open_checkpoint(checkpoint)
        model = Pi0Model.from_state(opened.config.planned_model, opened.load("cpu", "f32").state)
        found: dict[str, float] = {}
        for index, run in enumerate(described["runs"]):
            theirs = {key.split("/", 1)[1]: expected[key] for key in expected.files if key.startswith(f"{index}/")}
            observation = _observation(inputs, run["observation"])
            ours = _computed(policy, model, observation, inputs["noise"], run["call"])
            for name, value in theirs.items():
                difference = _difference(name, ours[name], value, theirs)
                found[name] = float(np.maximum(found.get(name, 0.0), difference))  # nan stays
        return found

    def wrong(self, checkpoint: Path) -> dict[str, float]:
        """The differences over their bounds: {} if Turbo-Pi computes what LeRobot computed."""
        dtype = self.described["config"].get("dtype", "float32")
        bounds = dict.fromkeys(EXACT, 0.0) | INPUTS | (BFLOAT16 if dtype == "bfloat16" else FLOAT32)
        differences = self.differences(checkpoint)
        assert differences.keys() == bounds.keys()
        return {name: value for name, value in differences.items() if not value <= bounds[name]}


def _observation(inputs: Any, index: int) -> dict[str, Any]:
    prefix = f"{index}/"
    found = {key[len(prefix) :]: inputs[key] for key in inputs.files if key.startswith(prefix)}
    return found | {"task": str(found["task"][0])}


def _computed(
    policy: UnifiedPolicy, model: Pi0Model, observation: dict[str, Any], noise: np.ndarray, call: dict[str, Any]
) -> dict[str, np.ndarray]:
    prepared: ModelInputs = policy.prepare(observation)
    steps = call.get("num_steps", policy.config.num_denoising_steps)
    trace: dict[str, torch.Tensor] = {}
    model.sample(Observation.stack([prepared]), torch.from_numpy(noise)[None], steps, trace=trace)
    return {
        "tokens": prepared.tokens,
        "token_mask": prepared.token_mask,
        "image_mask": prepared.image_mask,
        "images": prepared.images[:, ::8, ::8],
        "normalized_state": prepared.state,
        "keys": trace["kv_k"][:, 0, ::16, 0].numpy(),
        "values": trace["kv_v"][:, 0, ::16, 0].numpy(),
        "v_1": trace["v_t"][0, 0].numpy(),
        "normalized_actions": trace["actions"][0].numpy(),
        "actions": policy.infer(observation, noise=noise, **call)["actions"],
    }


def _difference(name: str, ours: np.ndarray, theirs: np.ndarray, run: dict[str, np.ndarray]) -> float:
    if name in ("normalized_state", "normalized_actions"):  # padded here
        ours = ours[..., : theirs.shape[-1]]
    if name in ("keys", "values"):
        per_image = (len(run["images"][0]) * 8 // 14) ** 2
        valid = np.concatenate([np.repeat(run["image_mask"], per_image), run["token_mask"]])[::16]
        if ours.shape == theirs.shape:
            ours, theirs = ours[:, valid], theirs[:, valid]
    if name == "images":  # of a masked one nothing is read
        ours, theirs = ours[run["image_mask"]], theirs[run["image_mask"]]
    if ours.shape != theirs.shape:
        return float("nan")
    if name in EXACT:
        return 0.0 if np.array_equal(ours, theirs) else float("nan")
    ours, theirs = ours.astype(np.float64), theirs.astype(np.float64)
    if name in ("images", "normalized_state"):
        return float(np.abs(ours - theirs).max())
    return float(np.sqrt(((ours - theirs) ** 2).mean()) / np.sqrt((theirs**2).mean()))
