"""RLinf's own layout of Pi0.5 and Pi0 ("RLinf PyTorch").

Its `model.safetensors` has openpi's JAX tree in PyTorch's clothes: `img.…`, `llm.layers.N.….0` for the language model
and `.1` for the action expert, both kernels of gate and up in one array [2, in, out]. What RLinf trains it saves as
`full_weights.pt`, a pickle, which its own converter makes this of (rlinf.utils.ckpt_convertor.openpi.convert).
Source: that converter.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from turbopi.checkpoint.source import Piece, Shape, row_ranges
from turbopi.checkpoint.torch_files import ITEMSIZE, TorchSource, read_tensor
from turbopi.support.errors import CheckpointError

EMBEDDING = "llm.embedder.embedding.weight"
_STACKS = ("vlm", "expert")


@dataclass(frozen=True)
class _Part:
    """A parameter, of a stored tensor."""

    name: str  # canonical
    take: Callable[[Tensor], Tensor] = lambda x: x


def _third(number: int) -> Callable[[Tensor], Tensor]:
    return lambda x: x.chunk(3)[number]


def _kernel(number: int) -> Callable[[Tensor], Tensor]:
    return lambda x: x[number].transpose(0, 1)


def _parts(key: str) -> list[_Part]:
    """The parameters that a tensor of this name holds; none of a name that the layout doesn't have."""
    module, _, kind = key.rpartition(".")
    plain = {"img.stem": "vision.patch_embedding", "img.encoder.norm": "vision.post_layernorm", "img.head": "projector"}
    if key == "img.pos_embedding":
        return [_Part("vision.position_embedding.weight", lambda x: x.flatten(0, -2))]
    if key == EMBEDDING:
        return [_Part("vlm.embed_tokens.weight")]
    if module in plain:
        return [_Part(f"{plain[module]}.{kind}")]
    if (found := re.fullmatch(r"img\.encoder\.layers\.(\d+)\.(.+)", key)) is not None:
        return _of_vision(f"vision.layers.{found[1]}", found[2])
    if (found := re.fullmatch(r"llm\.final_norms\.([01])\.(.+)", key)) is not None:
        return _of_norm(f"{_STACKS[int(found[1])]}.norm", found[2])
    if (found := re.fullmatch(r"llm\.layers\.(\d+)\.(\w+(?:\.\w_proj)?)\.([01])\.(.+)", key)) is not None:
        return _of_layer(f"{_STACKS[int(found[3])]}.layers.{found[1]}", found[2], found[4])
    return []


def _of_vision(layer: str, name: str) -> list[_Part]:
    if (found := re.fullmatch(r"attn\.in_proj_(weight|bias)", name)) is not None:
        return [_Part(f"{layer}.self_attn.{x}_proj.{found[1]}", _third(i)) for i, x in enumerate("qkv")]
    name = re.sub(r"^norm([12])\.", r"layer_norm\1.", name)
    return [_Part(f"{layer}.{re.sub(r'^attn', 'self_attn', name)}")]


def _of_layer(layer: str, module: str, name: str) -> list[_Part]:
    norms = {"pre_attention_norms": "input_layernorm", "pre_ffw_norms": "post_attention_layernorm"}
    if module in norms:
        return _of_norm(f"{layer}.{norms[module]}", name)
    if module == "mlps":
        gating = [_Part(f"{layer}.mlp.{x}_proj.weight", _kernel(i)) for i, x in enumerate(("gate", "up"))]
        linear = [_Part(f"{layer}.mlp.down_proj.weight", lambda x: x.transpose(0, 1))]
        return {"w_gating": gating, "w_linear": linear}.get(name, [])
    return [_Part(f"{layer}.{module.replace('attn.', 'self_attn.')}.{name}")] if module.startswith("attn.") else []


def _of_norm(norm: str, name: str) -> list[_Part]:
    named = {"scale": "weight", "ada_modulation.weight": "dense.weight", "ada_modulation.bias": "dense.bias"}
    return [_Part(f"{norm}.{named[name]}")] if name in named else []


class RLinfSource:
    """Weights of a file in RLinf's layout under canonical names; others keep theirs, and are refused by name later."""

    vision_heads: int | None = None

    def __init__(self, file: TorchSource) -> None:
        self._file, self.format, self.notes = file, file.format, file.notes
        self.notes.append("weights in RLinf's layout")
        self._stored: dict[str, tuple[str, _Part]] = {}
        self.shapes: dict[str, Shape] = {}
        self.dtypes: dict[str, str] = {}
        for key, shape in file.shapes.items():
            for part in _parts(key) or [_Part(key)]:
                try:
                    self.shapes[part.name] = tuple(part.take(torch.empty(shape, device="meta")).shape)
                except (IndexError, RuntimeError) as error:
                    raise CheckpointError(f"{key} has shape {list(shape)}, which no Pi0 or Pi0.5 has") from error
                self._stored[part.name], self.dtypes[part.name] = (key, part), file.dtypes[key]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def native_name(self, name: str) -> str:
        return self._file.native_name(self._stored[name][0]) if name in self._stored else name

    def pieces(self, device: torch.device) -> Iterator[Piece]:
        for name, (key, part) in self._stored.items():
            values = part.take(read_tensor(self._file.stored(key)))
            for start, stop in row_ranges(self.shapes[name], ITEMSIZE[self.dtypes[name]]):
                yield Piece(name, start, values[start:stop])
