"""What do TensorRT's attention and precisions do to the language model's keys and values, and to actions?

{fused attention, written out} × {float16, bfloat16, float32}: how far K and V of every layer, and the actions made from
them, are from the float32 reference. Each engine is one layer whose weights are inputs, so a style is one engine for
all layers.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from msgspec import Struct
from torch import Tensor

from turbopi.backends.pytorch import reference_model
from turbopi.backends.tensorrt import Library, library
from turbopi.backends.tensorrt.call import Part
from turbopi.backends.tensorrt.engine import Engine, Input, Specification, build
from turbopi.backends.tensorrt.networks import LayerStyle, prefix_layer
from turbopi.backends.tensorrt.ops import TORCH_DTYPES, Dtype
from turbopi.models.observation import Observation
from turbopi.models.pi0.kv_cache import EmbeddedPrefix
from turbopi.models.pi0.layers import rope_tables
from turbopi.models.pi0.reference import Pi0Model
from turbopi.policy.policy import UnifiedPolicy
from turbopi.support.reading import plain_document
from turbopi.support.text import cosine, significant
from turbopi_lab.studies.differences import Off, errors_of
from turbopi_lab.studies.problems import one_problem
from turbopi_lab.studies.report import Cell, Control, Grid, Panel, Plot, Report, Series
from turbopi_lab.studies.study import Setup, Study

DTYPES: tuple[Dtype, ...] = ("f16", "bf16", "f32")
Load = Callable[[Specification], Part]


class LayerOff(Struct, frozen=True):
    """How far K and V of one layer of the language model are from the reference's; None: not finite."""

    k_max: float | None
    k_relative: float | None
    k_cosine: float | None
    v_max: float | None
    v_relative: float | None
    v_cosine: float | None


class StyleOff(Struct, frozen=True):
    """One way to compute the language model's layers."""

    attention: str  # "fused", "written out"
    precision: str
    layers: list[LayerOff]  # from the first
    actions: Off


def attention_study(
    model: Pi0Model, observation: Observation, noise: Tensor, num_steps: int, load: Load
) -> list[StyleOff]:
    """Errors of every style for one observation (batch 1) and a float32 model, which denoises all of them."""
    embedded = model.embed(observation)
    exact = model.keys_values(embedded)
    truth = model.denoise(exact, noise, num_steps)
    results = []
    for fused in (True, False):
        for dtype in DTYPES:
            k, v = _keys_values(model, embedded, LayerStyle(fused, dtype), load)
            actions = model.denoise(replace(exact, k=k, v=v), noise, num_steps)
            layers = [_layer_errors(k[i], v[i], exact.k[i], exact.v[i]) for i in range(len(k))]
            results.append(StyleOff("fused" if fused else "written out", dtype, layers, errors_of(actions, truth)))
    return results


def _keys_values(model: Pi0Model, embedded: EmbeddedPrefix, style: LayerStyle, load: Load) -> tuple[Tensor, Tensor]:
    """K and V [layer, 1, 1, S, K] in float32, by one engine that runs all layers but takes each one's weights."""
    config, device, dtype = model.config, model.device, TORCH_DTYPES[style.dtype]
    g, rows = config.vlm, embedded.embs.shape[1]
    cos, sin = rope_tables(embedded.layout.computed_positions, g.head_dim, config.rope_base)
    tables = {"cos": cos[0, 0].contiguous(), "sin": sin[0, 0].contiguous()}
    x = embedded.embs[0].to(dtype).contiguous()
    part: Part | None = None
    keys, values = [], []
    for layer in _layers(model):
        weights = {name: tensor.to(dtype).contiguous() for name, tensor in layer["matrices"].items()}
        inputs = {"x": x, **tables, **layer["norms"], **weights}
        if part is None:
            names = dict.fromkeys(("x", *weights), style.dtype)
            shapes = {n: Input(tuple(t.shape), names.get(n, "f32")) for n, t in inputs.items()}
            attention = "fused" if style.fused else "explicit"
            part = load(
                Specification(
                    f"study-{attention}-{style.dtype}",
                    shapes,
                    lambda ops, given: prefix_layer(ops, config, style, given),
                )
            )
        following = torch.full_like(x, torch.nan)
        k, v = (torch.full((rows, g.head_dim), torch.nan, dtype=dtype, device=device) for _ in range(2))
        part.run(**inputs, x_next=following, k=k, v=v)
        keys.append(k.float())
        values.append(v.float())
        x = following
    return torch.stack(keys)[:, None, None], torch.stack(values)[:, None, None]


def _layers(model: Pi0Model) -> Any:
    layers: Any = model.vlm.layers
    for layer in layers:
        a, m = layer.self_attn, layer.mlp
        matrices = {
            "qkv": torch.cat([a.q_proj.weight, a.k_proj.weight, a.v_proj.weight]),
            "out": a.o_proj.weight,
            "gate": m.gate_proj.weight,
            "up": m.up_proj.weight,
            "down": m.down_proj.weight,
        }
        norms = {"norm1": layer.input_layernorm, "norm2": layer.post_attention_layernorm}
        yield {"matrices": matrices, "norms": {name: (1 + norm.weight.float())[None] for name, norm in norms.items()}}


def _layer_errors(k: Tensor, v: Tensor, exact_k: Tensor, exact_v: Tensor) -> LayerOff:
    keys, values = errors_of(k, exact_k), errors_of(v, exact_v)
    return LayerOff(keys.max, keys.relative, keys.cosine, values.max, values.relative, values.cosine)


def builder(library: Library) -> Load:
    """Builds and loads engines that aren't kept."""

    def load(specification: Specification) -> Part:
        return Engine(library, specification.name, build(library, specification))

    return load


def run(setup: Setup) -> Report:
    checkpoint = setup.needed_checkpoint("precision")
    policy = UnifiedPolicy(checkpoint, backend="pytorch", precision="f32", device=setup.device)
    observation, noise, source = one_problem(policy, setup)
    lib = library()
    found = attention_study(reference_model(policy.backend), observation, noise, setup.steps, builder(lib))
    return _report(setup, found, f"{lib.name} {lib.version}", f"{policy.config.name}, {source}: the first, one noise")


def _report(setup: Setup, found: Sequence[StyleOff], named: str, of: str) -> Report:
    by_style = {(one.attention, one.precision): one.actions for one in found}
    exact = max(_size(by_style[attention, "f32"].relative) for attention in ("fused", "written out"))
    rows: list[list[Cell]] = []
    for one in found:
        first, last = one.layers[0], one.layers[-1]
        offs: list[Cell] = [first.k_relative, last.k_relative, last.v_relative, last.v_max]
        rows.append([one.attention, one.precision, *offs, one.actions.relative, cosine(one.actions.cosine)])
    columns = ["attention", "precision", "K, layer 0", "K, last", "V, last", "V, last, max", "actions", "cosine"]
    series = [
        Series(
            f"{one.attention}, {one.precision}",
            [float(number) for number in range(len(one.layers))],
            [_size(layer.k_relative) for layer in one.layers],
        )
        for one in found
    ]
    return setup.report(
        STUDY,
        method=f"{of}. {named} against the float32 reference, {setup.steps} steps.",
        controls=[
            Control("float32 is the reference.", exact < 1e-3, f"Relative error of the actions {significant(exact)}.")
        ],
        tables=[Grid("Errors against the float32 reference", columns, rows)],
        plots=[Plot("precision", [Panel("Keys", "layer", "relative error", series, log_y=True)])],
        verdict="Relative error of the actions, fused and written out: "
        + "; ".join(
            f"{dtype} {significant(by_style['fused', dtype].relative)}, "
            f"{significant(by_style['written out', dtype].relative)}"
            for dtype in DTYPES
        )
        + ".",
        would_change="A TensorRT whose fused attention accumulates in less than float32, or weights with outliers.",
        not_run=["In closed loop."],
        data={"precision": [plain_document(one) for one in found], "library": named},
    )


def _size(error: float | None) -> float:
    return math.inf if error is None else error


STUDY = Study(
    "precision",
    "What do TensorRT's attention and precisions do to keys, values and actions?",
    "Fused attention in float16 or bfloat16 ruins the cache: 0 % on LIBERO. Written out in float32 it is exact: 100 %.",
    run,
    needs_tensorrt=True,
)
