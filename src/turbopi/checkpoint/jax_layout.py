"""Where openpi's JAX tree keeps each parameter, and how to bring it into PyTorch's layout.

Kernels there are [in, out] and attention kernels keep their head axis; layers are stacked along axis 0. Letters: L
layers, D width, F MLP width, N heads, h head_dim. Checked against openpi's own two stored forms of the same weights.
"""

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

_VISION_BLOCK = "PaliGemma/img/Transformer/encoderblock/"
_LLM_BLOCK = "PaliGemma/llm/layers/"
VISION_QUERY = _VISION_BLOCK + "MultiHeadDotProductAttention_0/query/kernel"


@dataclass(frozen=True)
class Output:
    """One parameter read from an array: `transform(array[layer][select])`."""

    name: str  # canonical; "{i}" is the layer
    transform: Callable[[Tensor], Tensor]
    select: tuple[int, ...] = ()

    @property
    def as_stored(self) -> bool:
        """Rows of the array are rows of the parameter."""
        return self.transform is _same


@dataclass(frozen=True)
class Rule:
    """One array of the tree and the parameters it holds."""

    path: str
    outputs: tuple[Output, ...]
    stacked: bool = False  # axis 0 is the layer


def _same(x: Tensor) -> Tensor:
    return x


def _transpose(x: Tensor) -> Tensor:
    return x.transpose(0, 1)  # [in, out] -> [out, in]


def _flat(x: Tensor) -> Tensor:
    return x.reshape(-1)


def _heads_out(x: Tensor) -> Tensor:
    return x.reshape(x.shape[0], -1).transpose(0, 1)  # SigLIP's q, k, v: [D, N, h] -> [N * h, D]


def _heads_in(x: Tensor) -> Tensor:
    return x.reshape(-1, x.shape[-1]).transpose(0, 1)  # attention outputs: [N, h, D] -> [D, N * h]


def _query(x: Tensor) -> Tensor:
    return x.transpose(1, 2).reshape(-1, x.shape[1])  # Gemma's q: [N, D, h] -> [N * h, D]


def _conv(x: Tensor) -> Tensor:
    return x.permute(3, 2, 0, 1)  # [height, width, in, out] -> [out, in, height, width]


def _first(x: Tensor) -> Tensor:
    return x[0]  # [1, tokens, D] -> [tokens, D]


def rules() -> list[Rule]:
    """Every array that a Pi0 or Pi0.5 tree may hold, LoRA adapters aside."""
    return [*_vision_rules(), *_gemma_rules("vlm", ""), *_gemma_rules("expert", "_1"), *_head_rules()]


def path_of(name: str) -> str | None:
    """Where a canonical parameter is stored, as `path` or `path[layer]`; None if the tree has no such parameter."""
    layer = next((part for part in name.split(".") if part.isdigit()), "")
    template = name.replace(f".{layer}.", ".{i}.", 1) if layer else name
    for rule in rules():
        for output in rule.outputs:
            if output.name == template:
                index = ", ".join((layer, *map(str, output.select))) if rule.stacked else ""
                return f"{rule.path}[{index}]" if index else rule.path
    return None


def _vision_rules() -> list[Rule]:
    def block(path: str, name: str, transform: Callable[[Tensor], Tensor]) -> Rule:
        return Rule(_VISION_BLOCK + path, (Output(f"vision.layers.{{i}}.{name}", transform),), stacked=True)

    def plain(path: str, name: str, transform: Callable[[Tensor], Tensor] = _same) -> Rule:
        return Rule(f"PaliGemma/img/{path}", (Output(name, transform),))

    found = [
        plain("embedding/kernel", "vision.patch_embedding.weight", _conv),
        plain("embedding/bias", "vision.patch_embedding.bias"),
        plain("pos_embedding", "vision.position_embedding.weight", _first),
        plain("Transformer/encoder_norm/scale", "vision.post_layernorm.weight"),
        plain("Transformer/encoder_norm/bias", "vision.post_layernorm.bias"),
        plain("head/kernel", "projector.weight", _transpose),
        plain("head/bias", "projector.bias"),
    ]
    for index in (0, 1):
        found += [
            block(f"LayerNorm_{index}/scale", f"layer_norm{index + 1}.weight", _same),
            block(f"LayerNorm_{index}/bias", f"layer_norm{index + 1}.bias", _same),
            block(f"MlpBlock_0/Dense_{index}/kernel", f"mlp.fc{index + 1}.weight", _transpose),
            block(f"MlpBlock_0/Dense_{index}/bias", f"mlp.fc{index + 1}.bias", _same),
        ]
    attention = "MultiHeadDotProductAttention_0/"
    for theirs, ours in (("query", "q"), ("key", "k"), ("value", "v")):
        found += [
            block(f"{attention}{theirs}/kernel", f"self_attn.{ours}_proj.weight", _heads_out),
            block(f"{attention}{theirs}/bias", f"self_attn.{ours}_proj.bias", _flat),
        ]
    return [
        *found,
        block(f"{attention}out/kernel", "self_attn.out_proj.weight", _heads_in),
        block(f"{attention}out/bias", "self_attn.out_proj.bias", _same),
    ]


def _gemma_rules(stack: str, suffix: str) -> list[Rule]:
    def block(path: str, *outputs: tuple[str, Callable[[Tensor], Tensor], tuple[int, ...]]) -> Rule:
        named = (Output(f"{stack}.layers.{{i}}.{name}", transform, select) for name, transform, select in outputs)
        return Rule(_LLM_BLOCK + path, tuple(named), stacked=True)

    found = [
        block(f"attn/q_einsum{suffix}/w", ("self_attn.q_proj.weight", _query, ())),
        block(
            f"attn/kv_einsum{suffix}/w",  # [2 (k, v), 1 KV head, D, h]
            ("self_attn.k_proj.weight", _transpose, (0, 0)),
            ("self_attn.v_proj.weight", _transpose, (1, 0)),
        ),
        block(f"attn/attn_vec_einsum{suffix}/w", ("self_attn.o_proj.weight", _heads_in, ())),
        block(
            f"mlp{suffix}/gating_einsum",  # [2 (gate, up), D, F]
            ("mlp.gate_proj.weight", _transpose, (0,)),
            ("mlp.up_proj.weight", _transpose, (1,)),
        ),
        block(f"mlp{suffix}/linear", ("mlp.down_proj.weight", _transpose, ())),
    ]
    for theirs, ours in (("pre_attention_norm", "input_layernorm"), ("pre_ffw_norm", "post_attention_layernorm")):
        found += [
            block(f"{theirs}{suffix}/scale", (f"{ours}.weight", _same, ())),
            block(f"{theirs}{suffix}/Dense_0/kernel", (f"{ours}.dense.weight", _transpose, ())),
            block(f"{theirs}{suffix}/Dense_0/bias", (f"{ours}.dense.bias", _same, ())),
        ]
    norm = f"PaliGemma/llm/final_norm{suffix}/"
    found += [
        Rule(norm + "scale", (Output(f"{stack}.norm.weight", _same),)),
        Rule(norm + "Dense_0/kernel", (Output(f"{stack}.norm.dense.weight", _transpose),)),
        Rule(norm + "Dense_0/bias", (Output(f"{stack}.norm.dense.bias", _same),)),
    ]
    if stack == "vlm":
        found.append(Rule("PaliGemma/llm/embedder/input_embedding", (Output("vlm.embed_tokens.weight", _same),)))
    return found


def _head_rules() -> list[Rule]:
    found = []
    for name in (
        "action_in_proj",
        "action_out_proj",
        "time_mlp_in",
        "time_mlp_out",
        "state_proj",
        "action_time_mlp_in",
        "action_time_mlp_out",
        "target_time_mlp_1",
        "target_time_mlp_2",
    ):
        found += [
            Rule(f"{name}/kernel", (Output(f"{name}.weight", _transpose),)),
            Rule(f"{name}/bias", (Output(f"{name}.bias", _same),)),
        ]
    return found
