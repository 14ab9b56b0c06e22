"""The operations that the tuner counts are those that the engine runs: recorded on a CPU, with a small model."""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import golden_model
from test_engine import static_call
from torch import Tensor

from turbopi.config import PRESETS, Kind, preset
from turbopi.engine.batch import BatchBuffers, BatchLoop, BatchSize, PackedPrefix
from turbopi.engine.call import CallShape, Images
from turbopi.engine.loops import EulerLoop
from turbopi.engine.plan import BUCKET, bucket
from turbopi.engine.weights import modulation, pack
from turbopi.kernels.interface import Ops, Segments
from turbopi.kernels.plain import PLAIN
from turbopi.kernels.plain_batch import PLAIN_BATCH
from turbopi.kernels.tile_table import Kernels
from turbopi.models.smolvla.family import BASE
from turbopi.support.errors import ConfigError
from turbopi.tune import shapes
from turbopi.tune.shapes import Call, calls, distinct, operations

STEPS, HORIZON = 2, 10
Ran = Counter[tuple[str, int, int, int]]
FULL = preset("pi05_libero").planned_model


def recording(ran: Ran) -> Ops:
    """Plain operations that count their sizes: (operation, rows, columns, inner). Products of a norm count as such."""
    last: list[tuple[str, Tensor]] = [("", torch.empty(0))]  # the norm that ran last, and its result

    def norm(name: str, reference: Any) -> Any:
        def run(*given: Any, **more: Any) -> tuple[Tensor, Tensor]:
            x, normed = reference(*given, **more)
            last[0] = name, normed
            return x, normed

        return run

    def product(name: str, reference: Any) -> Any:
        def run(x: Tensor, weight: Tensor, *rest: Any, **more: Any) -> Tensor:
            rows, columns = x.shape[0], weight.shape[0] // (2 if name == "geglu" else 1)
            in_front = last[0][0] if x is last[0][1] else None
            ran[named(name, in_front), rows, columns, weight.shape[1]] += 1
            return reference(x, weight, *rest, **more)

        return run

    def vision(qkv: Tensor, images: int, heads: int, **more: Any) -> Tensor:
        ran["vision_attention", qkv.shape[0], heads, qkv.shape[1] // 3 // heads] += 1
        return PLAIN.vision_attention(qkv, images, heads, **more)

    def attention(q: Tensor, k: Tensor, v: Tensor, length: Tensor, slots: int, heads: int, *rest: Any) -> Tensor:
        ran["prefix_attention", q.shape[0] // heads, heads, q.shape[1]] += 1
        return PLAIN.attention(q, k, v, length, slots, heads, *rest)

    def packed(q: Tensor, k: Tensor, v: Tensor, segments: Segments, heads: int) -> Tensor:
        ran["packed_attention", len(k), heads, q.shape[1]] += 1
        return PLAIN_BATCH.packed_attention(q, k, v, segments, heads)

    def suffix(qkv: Tensor, cos: Tensor, sin: Tensor, k: Tensor, *rest: Any) -> Tensor:
        ran["suffix_attention", len(qkv), rest[3], k.shape[1]] += 1
        return PLAIN_BATCH.suffix_attention(qkv, cos, sin, k, *rest)

    return replace(
        PLAIN,
        residual_layer_norm=norm("layer", PLAIN.residual_layer_norm),
        residual_rms_norm=norm("rms", PLAIN.residual_rms_norm),
        linear=product("plain", PLAIN.linear),
        residual_linear=product("parts", PLAIN.residual_linear),
        linear_gelu=product("gelu", PLAIN.linear_gelu),
        linear_geglu=product("geglu", PLAIN.linear_geglu),
        vision_attention=vision,
        attention=attention,
        batch=replace(PLAIN_BATCH, packed_attention=packed, suffix_attention=suffix),
    )


def named(operation: str, norm_in_front: str | None) -> str:
    return operation if norm_in_front is None else f"{operation} of a norm: {norm_in_front}"


def counted(kind: Kind, call: Call, monkeypatch: pytest.MonkeyPatch) -> Ran:
    monkeypatch.setattr(shapes, "_has_choice", lambda one: True)
    config, ran = golden_model(kind).config, Ran()
    for one in operations(config, call, "fp8", "portable", steps=STEPS, horizon=HORIZON):
        ran[named(one.operation, one.norm_in_front), one.rows, one.columns, one.inner] += one.uses
    return ran


@pytest.mark.parametrize("kind", ["pi05", "pi0"])
@pytest.mark.parametrize("cameras", [0, 2])
def test_one_observations_operations(kind: Kind, cameras: int, monkeypatch: pytest.MonkeyPatch) -> None:
    ran = Ran()
    call = static_call(kind, CallShape(cameras, 48, EulerLoop(STEPS, HORIZON)), ops=recording(ran))
    call.write_inputs(
        np.zeros((HORIZON, call.config.action_dim), np.float32),
        np.zeros(call.config.action_dim, np.float32),
        np.ones(40, np.int64),
    )
    call.images.run()
    call.encode()  # all denoising steps are one kernel
    if not cameras:  # an empty tower is run on no rows
        ran = Ran({key: uses for key, uses in ran.items() if key[1]})
    assert ran == counted(kind, Call(cameras, 48), monkeypatch)


@pytest.mark.parametrize("kind", ["pi05", "pi0"])
def test_a_batchs_operations(kind: Kind, monkeypatch: pytest.MonkeyPatch) -> None:
    model, ran, batch, cameras, slots = golden_model(kind), Ran(), 2, 1, 16
    config, ops, cpu = model.config, recording(ran), torch.device("cpu")
    weights = pack(config, dict(model.state_dict()))
    camera_images = Images(config, weights, ops, batch * cameras, False, 0)
    buffers = BatchBuffers(config, weights, ops, BatchSize(batch, batch * cameras), camera_images, batch * slots)
    prefix = PackedPrefix(buffers, batch * slots)
    prefix.write([cameras] * batch, [np.ones(slots, np.int64)] * batch)
    table = modulation(config, weights.conditioning, STEPS)
    loop = BatchLoop(buffers, EulerLoop(STEPS, HORIZON), weights, None if table is None else table.to(cpu))
    camera_images.run()
    prefix.run()
    loop.run()
    assert ran == counted(kind, Call(cameras, slots, batch), monkeypatch)


@pytest.mark.parametrize("kernels", ["hopper", "portable"])
def test_vision_in_eight_bits_has_hidden_columns_in_whole_lines(kernels: Kernels) -> None:
    """As `engine.weights` packs them."""
    hidden = {}
    precisions: tuple[shapes.Precision, ...] = ("bf16", "fp8")
    for precision in precisions:
        found = {one.name: one for one in shapes.operations(FULL, Call(2, 48), precision, kernels)}
        if precision == "fp8" or kernels == "hopper":  # else the library's
            hidden[precision] = found["vision fc1"].columns, found["vision fc2"].inner
    assert hidden.pop("fp8") == (4352, 4352) and set(hidden.values()) <= {(4304, 4304)}


def test_on_hopper_the_same_products_have_its_names() -> None:
    call = Call(2, 48, 4)
    names = {"bias": "plain", "residual": "parts"}
    ours = Ran()
    for one in operations(FULL, call, "fp8", "hopper", horizon=10):
        ours[names.get(one.operation, one.operation), one.rows, one.columns, one.inner] += one.uses
    theirs = Ran()
    for one in operations(FULL, call, "fp8", "portable", horizon=10):
        if not one.operation.endswith("_attention"):  # those have kernels of their own there
            theirs[one.operation, one.rows, one.columns, one.inner] += one.uses
    assert {key: uses for key, uses in ours.items() if key[2:] != (2048, 1152)} == theirs  # but for the projector


def test_bfloat16_products_of_other_gpus_are_the_librarys_but_for_geglu() -> None:
    found = operations(FULL, Call(2, 48), "bf16", "portable")
    assert {one.operation for one in found} == {"vision_attention", "prefix_attention", "geglu"}


def test_prompts_are_counted_in_the_engines_buckets() -> None:
    assert BUCKET == shapes.BUCKET and all(bucket(count) == shapes.bucket(count) for count in range(1, 100))


def test_every_prompt_is_measured_of_one_observation_and_the_usual_one_of_batches() -> None:
    found = calls(FULL, [2], [], [1, 8])
    assert found[:2] == [Call(2, 48, 1), Call(2, 48, 8)]
    assert {one.prompt_tokens for one in found if one.batch == 1} == {*range(16, 209, 16)}
    assert [one for one in found if one.batch == 8] == [Call(2, 48, 8)]
    assert calls(FULL, [1, 2], [40, 48, 200], [1]) == [Call(c, tokens) for tokens in (48, 208) for c in (1, 2)]


def test_prompts_that_take_the_same_tiles_are_measured_once() -> None:
    found = [one for call in calls(FULL, [2], [], [1]) for one in operations(FULL, call, "fp8", "portable")]
    kept = distinct(found)
    assert len({one.key for one in kept}) == len(kept) < len(found)
    assert {one.key.rows for one in kept} == {512, 576, 640, 704, 768}
    assert next(one for one in kept if one.name == "prefix qkv").rows == 560, "the first call's own rows"


def test_smolvlas_operations_are_its_towers_and_its_text_layers() -> None:
    hopper = {one.name: one for one in operations(BASE.model, Call(2, 48), "bf16", "hopper")}
    fc1, fc2 = hopper["vision fc1"], hopper["vision fc2"]
    assert (fc1.rows, fc1.columns, fc1.inner, fc1.uses) == (2 * 1024, 3072, 768, 12)
    assert (fc2.rows, fc2.columns, fc2.inner) == (2 * 1024, 768, 3072)
    portable = {one.name: one for one in operations(BASE.model, Call(2, 48), "bf16", "portable")}
    attention = portable["vision attention"]
    assert (attention.rows, attention.columns, attention.inner, attention.images) == (2 * 1024, 12, 64, 2)
    in_fp8 = {one.name: one for one in operations(BASE.model, Call(2, 48), "fp8", "hopper")}
    assert in_fp8.keys() == hopper.keys() and {one for one in in_fp8 if in_fp8[one].numbers == "bf16"} == {"projector"}
    four = {one.name: one for one in operations(BASE.model, Call(2, 48, 4), "bf16", "hopper", horizon=50)}
    assert hopper.keys() < four.keys() and "actions qkv" not in hopper
    assert four["vision fc1"].rows == 4 * 2 * 1024 and four["prefix down"].rows == 4 * (2 * 64 + 48 + 1)
    out = four["actions out"]
    assert (out.rows, out.columns, out.inner, out.uses) == (4 * 50, 720, 960, 10 * 16)
    with pytest.raises(ConfigError, match="Pi0-FAST runs no operations whose tiles can be chosen"):
        operations(PRESETS["pi0_fast_base"].model, Call(2, 48), "bf16", "hopper")
