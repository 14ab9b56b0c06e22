"""Reading a golden folder: openpi's weights, inputs and outputs on a tiny model.

    checkpoints/model.json                       sizes, which the checkpoints don't record in full
    checkpoints/{pi05,pi0}/{torch,jax}/          the same weights in openpi's two layouts
    cases/<case>/inputs.npz                      what the model is given
    cases/<case>/<variant>.steps<N>.npz          what openpi computed: see VARIANTS

Any seed, batch size, camera mask, prompt and horizon; tensors may be missing from any file.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import get_args

import numpy as np
import torch

from turbopi.checkpoint import Checkpoint, open_checkpoint
from turbopi.config import CAMERAS, GemmaConfig, ModelConfig, Normalization, PiKind, PolicyConfig, VisionConfig
from turbopi.models import FAMILIES
from turbopi.models.observation import Observation
from turbopi.support.errors import CheckpointError, ObservationError
from turbopi.support.reading import read_json, read_npz

VARIANTS = ("torch_fp32", "jax_fp32", "torch_bf16", "jax_bf16")
Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Run:
    """openpi's outputs for one case with one number of steps: variant -> tensors by name."""

    num_steps: int
    variants: dict[str, Arrays]


@dataclass(frozen=True)
class Case:
    name: str
    kind: PiKind
    observation: Observation
    noise: torch.Tensor  # float32[B, H, action_dim]
    runs: list[Run]


class GoldenFolder:
    """A folder in the golden format. Raises CheckpointError or ObservationError naming what isn't there or fits not."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        for needed in ("checkpoints/model.json", "cases"):
            if not (self.path / needed).exists():
                raise CheckpointError(f"{self.path} isn't a golden folder: there is no {needed} in it")

    @cached_property
    def sizes(self) -> dict[str, object]:
        return read_json(self.path / "checkpoints/model.json")

    def model_config(self, kind: PiKind) -> ModelConfig:
        """The tiny model's sizes, from model.json."""
        sizes = self.sizes
        limits = sizes["max_token_len"]
        assert isinstance(limits, dict)
        return ModelConfig(
            kind=kind,
            vision=VisionConfig(**sizes["vision"]),  # type: ignore[arg-type]
            vlm=GemmaConfig(**sizes["vlm"]),  # type: ignore[arg-type]
            expert=GemmaConfig(**sizes["expert"]),  # type: ignore[arg-type]
            vocab_size=int(sizes["vocab_size"]),  # type: ignore[call-overload]
            action_dim=int(sizes["action_dim"]),  # type: ignore[call-overload]
            max_prompt_tokens=int(limits[kind]),
            rms_norm_eps=float(sizes["rms_norm_eps"]),  # type: ignore[arg-type]
            rope_base=float(sizes["rope_base"]),  # type: ignore[arg-type]
        )

    def checkpoint(self, kind: PiKind) -> Checkpoint:
        """openpi's PyTorch checkpoint of that kind, or its JAX one where the folder has no other."""
        folder = self.path / "checkpoints" / kind
        for layout, mark in (("torch", "model.safetensors"), ("jax", "params")):
            if (folder / layout / mark).exists():
                config = PolicyConfig(
                    f"golden {kind}", self.model_config(kind), "plain", Normalization("identity", "identity")
                )
                return open_checkpoint(folder / layout, config)
        raise CheckpointError(f"{folder} has neither torch/model.safetensors nor jax/params")

    def cases(self) -> Iterator[Case]:
        """All cases, by name."""
        for folder in sorted(p for p in (self.path / "cases").iterdir() if (p / "inputs.npz").exists()):
            yield self._case(folder)

    def _case(self, folder: Path) -> Case:
        found: dict[int, dict[str, Arrays]] = {}
        for file in sorted(folder.glob("*.steps*.npz")):
            match = re.fullmatch(r"(\w+)\.steps(\d+)\.npz", file.name)
            if match and match[1] in VARIANTS:
                found.setdefault(int(match[2]), {})[match[1]] = read_npz(file)
        runs = [Run(steps, variants) for steps, variants in sorted(found.items())]
        inputs = read_npz(folder / "inputs.npz")
        kind = self._kind(folder.name, inputs, runs)
        return Case(folder.name, kind, _observation(inputs), torch.from_numpy(inputs["noise"]), runs)

    def _kind(self, name: str, inputs: Arrays, runs: list[Run]) -> PiKind:
        """Pi0.5 or Pi0. Nothing records it, but their prompt lengths differ, and only Pi0.5 has a time condition."""
        limits = self.sizes["max_token_len"]
        assert isinstance(limits, dict)
        width = inputs["tokenized_prompt"].shape[1]
        fits: list[PiKind] = [kind for kind in get_args(PiKind) if limits.get(kind) == width]
        if len(fits) == 1:
            return fits[0]
        if any("cond" in arrays for run in runs for arrays in run.variants.values()):
            return next(kind for kind in get_args(PiKind) if FAMILIES[kind].modulated)
        kinds: list[PiKind] = [kind for kind in get_args(PiKind) if (self.path / "checkpoints" / kind).exists()]
        if len(kinds) == 1:
            return kinds[0]
        raise ObservationError(
            f"case {name}: can't tell Pi0.5 from Pi0: {width} prompt slots fit {fits or 'neither'} of {limits}, "
            "no file has `cond`, and there are checkpoints of both"
        )


def _observation(inputs: Arrays) -> Observation:
    """Images as uint8 if all cameras have them so, else as the float32 the model sees."""
    names = [name.removeprefix("image_mask/") for name in inputs if name.startswith("image_mask/")]
    names.sort(key=lambda name: (CAMERAS.index(name) if name in CAMERAS else len(CAMERAS), name))
    as_uint8 = all(f"image_u8/{name}" in inputs for name in names)

    def camera_image(name: str) -> np.ndarray:
        if as_uint8:
            return inputs[f"image_u8/{name}"]
        if f"image_f32/{name}" in inputs:
            return inputs[f"image_f32/{name}"]
        return inputs[f"image_u8/{name}"].astype(np.float32) / 255 * 2 - 1

    return Observation(
        images=torch.from_numpy(np.stack([camera_image(name) for name in names], axis=1)),
        image_mask=torch.from_numpy(np.stack([inputs[f"image_mask/{name}"] for name in names], axis=1)),
        tokens=torch.from_numpy(inputs["tokenized_prompt"].astype(np.int64)),
        token_mask=torch.from_numpy(inputs["tokenized_prompt_mask"].astype(bool)),
        state=torch.from_numpy(inputs["state"].astype(np.float32)),
    )
