"""Four questions about TensorRT, answered on any checkpoint.

attention   The language model's layers as engines, {fused attention, written out} × {float16, bfloat16, float32}: how
            far K and V of every layer, and the actions made from them, are from the float32 reference. Each engine is
            one layer whose weights are inputs, so a style is one engine for all layers.
mask        The suffix's attention over a cache that is compacted, padded and masked, or padded and not masked: cosine
            of the actions with the compacted reference's, for some numbers of steps. It needs no TensorRT.
actions     Backends' actions against the float32 reference's: cosine and relative error, on any observations.
throughput  Observations one at a time through `tensorrt`, and several in flight through `tensorrt_pipelined`.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from msgspec import Struct, field
from torch import Tensor

from turbopi.model.kv_cache import EmbeddedPrefix, KVCache
from turbopi.model.layers import rope_tables
from turbopi.model.reference import Pi0Model
from turbopi.observation import Observation
from turbopi.policy import UnifiedPolicy
from turbopi.provenance import Provenance
from turbopi.tensorrt import Library
from turbopi.tensorrt.call import Part
from turbopi.tensorrt.engine import Engine, Input, Specification, build
from turbopi.tensorrt.networks import LayerStyle, prefix_layer
from turbopi.tensorrt.ops import TORCH_DTYPES, Dtype

DTYPES: tuple[Dtype, ...] = ("f16", "bf16", "f32")
CACHES = ("compacted", "padded, masked", "padded, not masked")
Load = Callable[[Specification], Part]


class Off(Struct, frozen=True):
    """How far actions are from the exact ones; None: not finite."""

    max: float | None
    relative: float | None
    cosine: float | None


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


class CacheOff(Struct, frozen=True):
    """The actions made from one kind of cache."""

    cache: str  # one of CACHES
    slots: int
    steps: int  # of denoising
    max: float | None
    relative: float | None
    cosine: float | None


class BackendOff(Struct, frozen=True):
    """A backend's actions on a group of observations."""

    backend: str
    observations: str
    count: int
    worst_cosine: float | None  # None: not finite
    worst_relative: float | None


Timings = dict[str, float]  # medians, e.g. "total_ms", and "per_second": observations


class Throughput(Struct, frozen=True):
    calls: int
    one_at_a_time: dict[str, Timings] = field(name="one at a time")  # by backend
    in_flight: Timings = field(name="in flight")
    actions_equal_bit_for_bit: bool


class StudyDocument(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What `turbopi study` writes; a part that wasn't asked for is left out."""

    provenance: Provenance
    model: str
    random_weights: bool
    observations: str  # where they come from
    seed: int
    steps: int
    prefix_tokens: int | None = None
    library: str | None = None
    precision: list[StyleOff] | None = None
    mask: list[CacheOff] | None = None
    actions: list[BackendOff] | None = None
    throughput: Throughput | None = None


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
            results.append(StyleOff("fused" if fused else "written out", dtype, layers, _errors(actions, truth)))
    return results


def mask_study(model: Pi0Model, observation: Observation, noise: Tensor, steps: Sequence[int]) -> list[CacheOff]:
    """Actions from three kinds of cache against those of the compacted one, by number of steps.

    The padded cache has all slots: masked cameras and padding too. Without a mask the suffix attends to them.
    """
    compacted, padded = model.prefix(observation), model.prefix(observation, compact=False)
    caches: dict[str, KVCache] = dict(zip(CACHES, (compacted, padded, replace(padded, mask=None)), strict=True))
    results = []
    for name, cache in caches.items():
        for count in steps:
            truth = model.denoise(compacted, noise, count)
            errors = _errors(model.denoise(cache, noise, count), truth)
            results.append(CacheOff(name, cache.k.shape[3], count, errors.max, errors.relative, errors.cosine))
    return results


def actions_study(
    exact: UnifiedPolicy, judged: UnifiedPolicy, observations: Mapping[str, Sequence[Any]], num_steps: int
) -> list[BackendOff]:
    """The model's actions (all of its dimensions, before the robot's units) through one policy against another's.

    One result for each group of observations, with the worst observation's cosine and relative error; the i-th one of
    a group gets the noise of seed i.
    """
    results = []
    for group, given in observations.items():
        errors = []
        for seed, obs in enumerate(given):
            one = Observation.stack([exact.prepare(obs)])
            shape = (1, exact.config.model.action_horizon, exact.config.model.action_dim)
            noise = torch.from_numpy(np.random.default_rng(seed).standard_normal(shape, dtype=np.float32))
            ours, truth = (policy.backend.sample(one, noise, num_steps).actions for policy in (judged, exact))
            errors.append(_errors(ours.cpu(), truth.cpu()))
        cosines = [one.cosine for one in errors if one.cosine is not None]
        relative = [one.relative for one in errors if one.relative is not None]
        finite = len(cosines) == len(relative) == len(errors)
        worst = (min(cosines), max(relative)) if finite else (None, None)
        results.append(BackendOff(judged.backend.name, group, len(errors), *worst))
    return results


def throughput_study(
    plain: UnifiedPolicy, pipelined: UnifiedPolicy, observations: Sequence[Any], calls: int
) -> Throughput:
    """Latency of one call at a time through both, throughput of calls in flight, and whether the actions are the same.

    Both run the same observations and noise in turn; the pipelined policy's backend has `submit`. Milliseconds are
    from host to host, throughput is observations a second.
    """
    seeds = range(len(observations))

    def one_at_a_time(policy: UnifiedPolicy) -> tuple[list[np.ndarray], Timings]:
        for obs, seed in zip(observations, seeds, strict=True):  # warm, and the actions to compare with
            policy.infer(obs, seed=seed)
        results, start = [], time.perf_counter()
        for i in range(calls):
            results.append(policy.infer(observations[i % len(observations)], seed=i % len(observations)))
        seconds = time.perf_counter() - start
        return [one["actions"] for one in results], {**_medians(results), "per_second": calls / seconds}

    expected, alone = one_at_a_time(plain)
    again, pipelined_alone = one_at_a_time(pipelined)
    start = time.perf_counter()
    futures = [pipelined.submit(observations[i % len(seeds)], seed=i % len(seeds)) for i in range(calls)]
    flown = [future.result() for future in futures]
    seconds = time.perf_counter() - start
    equal = all(
        np.array_equal(a, b) and np.array_equal(a, c["actions"]) for a, b, c in zip(expected, again, flown, strict=True)
    )
    return Throughput(
        calls,
        {plain.backend.name: alone, pipelined.backend.name: pipelined_alone},
        {**_medians(flown), "per_second": calls / seconds},
        equal,
    )


def _medians(results: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Of every timing of some calls."""
    names = results[0]["policy_timing"]
    return {name: float(np.median([one["policy_timing"][name] for one in results])) for name in names}


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
    keys, values = _errors(k, exact_k), _errors(v, exact_v)
    return LayerOff(keys.max, keys.relative, keys.cosine, values.max, values.relative, values.cosine)


def _errors(ours: Tensor, exact: Tensor) -> Off:
    """Largest and relative (2-norm) difference and cosine."""
    ours, exact = ours.double().flatten(), exact.double().flatten()
    if not bool(ours.isfinite().all()):
        return Off(None, None, None)
    difference = ours - exact
    relative = float(difference.norm() / exact.norm())
    return Off(float(difference.abs().max()), relative, float(F.cosine_similarity(ours, exact, dim=0)))


def builder(library: Library) -> Load:
    """Builds and loads engines that aren't kept."""

    def load(specification: Specification) -> Part:
        return Engine(library, specification.name, build(library, specification))

    return load
