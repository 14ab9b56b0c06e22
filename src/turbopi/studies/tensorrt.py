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
from torch import Tensor

from turbopi.model.kv_cache import EmbeddedPrefix, KVCache
from turbopi.model.layers import rope_tables
from turbopi.model.reference import Pi0Model
from turbopi.observation import Observation
from turbopi.policy import UnifiedPolicy
from turbopi.tensorrt import Library
from turbopi.tensorrt.call import Part
from turbopi.tensorrt.engine import Engine, Input, Specification, build
from turbopi.tensorrt.networks import LayerStyle, prefix_layer
from turbopi.tensorrt.ops import TORCH_DTYPES, Dtype

DTYPES: tuple[Dtype, ...] = ("f16", "bf16", "f32")
CACHES = ("compacted", "padded, masked", "padded, not masked")
Load = Callable[[Specification], Part]


def attention_study(
    model: Pi0Model, observation: Observation, noise: Tensor, num_steps: int, load: Load
) -> list[dict[str, Any]]:
    """Errors of every style for one observation (batch 1) and a float32 model, which denoises all of them."""
    embedded = model.embed(observation)
    exact = model.keys_values(embedded)
    truth = model.denoise(exact, noise, num_steps)
    results = []
    for fused in (True, False):
        for dtype in DTYPES:
            result: dict[str, Any] = {"attention": "fused" if fused else "written out", "precision": dtype}
            k, v = _keys_values(model, embedded, LayerStyle(fused, dtype), load)
            actions = model.denoise(replace(exact, k=k, v=v), noise, num_steps)
            result["layers"] = [_layer_errors(k[i], v[i], exact.k[i], exact.v[i]) for i in range(len(k))]
            result["actions"] = _errors(actions, truth)
            results.append(result)
    return results


def mask_study(model: Pi0Model, observation: Observation, noise: Tensor, steps: Sequence[int]) -> list[dict[str, Any]]:
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
            results.append({"cache": name, "slots": cache.k.shape[3], "steps": count, **errors})
    return results


def actions_study(
    exact: UnifiedPolicy, judged: UnifiedPolicy, observations: Mapping[str, Sequence[Any]], num_steps: int
) -> list[dict[str, Any]]:
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
        finite = all(one["cosine"] is not None for one in errors)
        worst = {
            "worst_cosine": min(one["cosine"] for one in errors) if finite else None,  # type: ignore[type-var]
            "worst_relative": max(one["relative"] for one in errors) if finite else None,  # type: ignore[type-var]
        }
        results.append({"backend": judged.backend.name, "observations": group, "count": len(errors), **worst})
    return results


def throughput_study(
    plain: UnifiedPolicy, pipelined: UnifiedPolicy, observations: Sequence[Any], calls: int
) -> dict[str, Any]:
    """Latency of one call at a time through both, throughput of calls in flight, and whether the actions are the same.

    Both run the same observations and noise in turn; the pipelined policy's backend has `submit`. Milliseconds are
    from host to host, throughput is observations a second.
    """
    seeds = range(len(observations))

    def one_at_a_time(policy: UnifiedPolicy) -> tuple[list[np.ndarray], dict[str, Any]]:
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
    return {
        "calls": calls,
        "one at a time": {plain.backend.name: alone, pipelined.backend.name: pipelined_alone},
        "in flight": {**_medians(flown), "per_second": calls / seconds},
        "actions_equal_bit_for_bit": equal,
    }


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


def _layer_errors(k: Tensor, v: Tensor, exact_k: Tensor, exact_v: Tensor) -> dict[str, float | None]:
    return {
        f"{name}_{kind}": value
        for name, ours, exact in (("k", k, exact_k), ("v", v, exact_v))
        for kind, value in _errors(ours, exact).items()
    }


def _errors(ours: Tensor, exact: Tensor) -> dict[str, float | None]:
    """Largest and relative (2-norm) difference and cosine; None for what isn't finite."""
    ours, exact = ours.double().flatten(), exact.double().flatten()
    if not bool(ours.isfinite().all()):
        return {"max": None, "relative": None, "cosine": None}
    difference = ours - exact
    return {
        "max": float(difference.abs().max()),
        "relative": float(difference.norm() / exact.norm()),
        "cosine": float(F.cosine_similarity(ours, exact, dim=0)),
    }


def builder(library: Library) -> Load:
    """Builds and loads engines that aren't kept."""

    def load(specification: Specification) -> Part:
        return Engine(library, specification.name, build(library, specification))

    return load
