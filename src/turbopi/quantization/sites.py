"""The places where a policy's numbers may be rounded to eight bits: an activation and the matrices that read it.

    vision.3.fc1    part, layer, kind

Where an adaRMS norm stands in front of the expert's products, the activation is the residual stream times the norm's
1 + scale: the denoising kernel rounds that, and divides by the rms and adds the shift behind the product.
"""

from dataclasses import dataclass
from typing import Literal, Protocol, get_args

from turbopi.config import GemmaConfig, Kind, VisionConfig
from turbopi.quantization.fp8 import ALIGNMENT

Part = Literal["vision", "prefix", "expert"]
PARTS: tuple[Part, ...] = get_args(Part)
KINDS = {
    "vision": ("qkv", "out", "fc1", "fc2"),
    "prefix": ("qkv", "out", "gate_up", "down"),
    "expert": ("qkv", "out", "gate_up", "down"),
}
MLP_KINDS = ("fc1", "fc2", "gate_up", "down")


class Stacks(Protocol):
    """The sizes that sites follow from: `ModelConfig`'s, or another family's.

    last_read      the number of the last prefix layer whose keys and values the expert reads
    expert_inputs  whether the expert's kernels take activations of eight bits, too, or weights alone
    """

    @property
    def kind(self) -> Kind: ...
    @property
    def vision(self) -> VisionConfig: ...
    @property
    def vlm(self) -> GemmaConfig: ...
    @property
    def expert(self) -> GemmaConfig: ...
    @property
    def action_dim(self) -> int: ...
    @property
    def last_read(self) -> int: ...
    @property
    def expert_inputs(self) -> bool: ...


@dataclass(frozen=True)
class Site:
    """tells: a NaN of the prefix reaches the actions through its keys and values alone, the last that the expert reads.

    weights_alone: no kernel takes its activation in eight bits
    """

    part: Part
    layer: int
    kind: str
    width: int  # of the activation
    outputs: int  # of all matrices that read it
    last: bool = False  # of the prefix's last layer, of which nothing but its keys and values is used
    tells: bool = False
    weights_alone: bool = False

    def __str__(self) -> str:
        return f"{self.part}.{self.layer}.{self.kind}"

    @property
    def group(self) -> str:
        """The site without its layer: sites of a group are alike in what they cost and gain."""
        return f"{self.part}.{self.kind}"

    @property
    def refusal(self) -> str | None:
        """Why its products can't be of E4M3 numbers, or None."""
        for name, size in (("input", self.width), ("output", self.outputs)):
            if size % ALIGNMENT:
                return f"its {name} is {size} wide, not a multiple of {ALIGNMENT}"
        return None


def sites(config: Stacks) -> list[Site]:
    """All sites of a model, in the order of the data. The prefix's last layer has keys and values alone."""
    found = []
    v, g, e = config.vision, config.vlm, config.expert
    sizes = {"qkv": (v.width, 3 * v.width), "out": (v.width, v.width), "fc1": (v.width, v.mlp_dim)}
    sizes["fc2"] = (v.mlp_dim, v.width)
    for layer in range(v.depth):
        found += [Site("vision", layer, kind, *sizes[kind]) for kind in KINDS["vision"]]
    stacks: tuple[tuple[Part, int, int, int], ...] = (
        ("prefix", g.depth, g.width, g.mlp_dim),
        ("expert", e.depth, e.width, e.mlp_dim),
    )
    for part, depth, width, hidden in stacks:
        heads, kv = g.num_heads * g.head_dim, 2 * g.num_kv_heads * g.head_dim
        alone = part == "expert" and not config.expert_inputs
        sizes = {"qkv": (width, heads + kv), "out": (heads, width), "gate_up": (width, 2 * hidden)}
        sizes["down"] = (hidden, width)
        for layer in range(depth):
            last = part == "prefix" and layer + 1 == depth
            kinds = ("qkv",) if last else KINDS[part]
            for kind in kinds:
                tells = part == "prefix" and kind == "qkv" and layer == config.last_read
                found.append(Site(part, layer, kind, *sizes[kind], last, tells, alone))
    return found
