"""Of the language model's last layer nothing runs but what its keys and values need."""

import dataclasses
from typing import Any

import pytest
import torch
from conftest import golden_model
from test_engine import answer, made_up, shape_of, static_call
from torch import nn

from turbopi.engine.without_compiler import OPS
from turbopi.kernels.interface import Ops
from turbopi.kernels.plain import PLAIN


@pytest.mark.parametrize("ops", [PLAIN, OPS], ids=["operations", "without a compiler"])
def test_the_engine_needs_no_more_of_its_matrices_than_rows_of_keys_and_values(ops: Ops) -> None:
    observation, noise = made_up("pi05", 2, 20)
    call = static_call("pi05", shape_of(observation, noise, 2), ops=ops)
    whole = answer(call, observation, noise)
    keys, values = call.cache_k.clone(), call.cache_v.clone()
    last, rows = call.weights.vlm[-1], 2 * call.config.vlm.head_dim
    nothing: dict[str, Any] = dict.fromkeys(("out", "gate_up", "down", "norm2"))
    call.weights.vlm[-1] = dataclasses.replace(last, qkv=last.qkv[-rows:], **nothing)
    assert torch.equal(answer(call, observation, noise), whole)
    assert torch.equal(call.cache_k, keys) and torch.equal(call.cache_v, values)


def test_the_reference_runs_none_of_its_other_modules() -> None:
    model = golden_model("pi05")
    observation, noise = made_up("pi05", 2, 20)
    last = f"vlm.layers.{model.config.vlm.depth - 1}."
    ran = set[str]()

    def note(module: nn.Module, given: object) -> None:
        ran.add(names[module])

    names = {module: name.removeprefix(last) for name, module in model.named_modules() if name.startswith(last)}
    hooks = [module.register_forward_pre_hook(note) for module in names]
    try:
        model.sample(observation, noise, 2)
    finally:
        for hook in hooks:
            hook.remove()
    assert ran == {"input_layernorm", "self_attn.k_proj", "self_attn.v_proj"}
