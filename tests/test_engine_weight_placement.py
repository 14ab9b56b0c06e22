"""Weights are read to where packing wants them: the same numbers, and nothing is held twice."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from turbopi.checkpoint import random_checkpoint
from turbopi.config import PRESETS
from turbopi.engine.weight_placement import GATE_UP, WeightPlacement, is_conditioning, join, joined_with
from turbopi.engine.weights import Weights, pack
from turbopi.models import parameter_shapes

CPU, META = torch.device("cpu"), torch.device("meta")
CONFIG = PRESETS["pi05_tiny"].with_model(vocab_size=64)


def nothing(name: str) -> bool:
    return False


def packed(on_host: Callable[[str], bool] = nothing) -> tuple[Weights, dict[str, Tensor]]:
    """Of a placement, and the state as it was read."""
    state = random_checkpoint(CONFIG).load(WeightPlacement(CONFIG.planned_model, CPU, on_host), "bf16").state
    return pack(CONFIG.planned_model, dict(state)), state


def matrices(layer: Any) -> list[Tensor]:
    """Of a Gemma layer."""
    return [layer.qkv, layer.out, layer.gate_up, layer.down]


def test_packed_weights_are_those_of_tensors_apart() -> None:
    found, _ = packed()
    plain = pack(CONFIG.planned_model, random_checkpoint(CONFIG).load("cpu", "bf16").state)
    for a, b in zip([*found.vlm, *found.expert], [*plain.vlm, *plain.expert], strict=True):
        assert all(torch.equal(x, y) for x, y in zip(matrices(a), matrices(b), strict=True))
    pairs: Any
    for one, other in zip(found.vision, plain.vision, strict=True):
        for pairs in (zip(one.qkv, other.qkv, strict=True), zip(one.fc1, other.fc1, strict=True)):
            assert all(torch.equal(x, y) for x, y in pairs)


def test_what_is_joined_is_where_it_was_read_to() -> None:
    found, state = packed()
    stacks: dict[str, Any] = {"vlm": found.vlm[:-1], "expert": found.expert}
    for stack, layers in stacks.items():
        for i, layer in enumerate(layers):
            for matrix, first in ((layer.qkv, "self_attn.q_proj"), (layer.gate_up, "mlp.gate_proj")):
                assert matrix.data_ptr() == state[f"{stack}.layers.{i}.{first}.weight"].data_ptr()
    assert found.vision[0].qkv[1].data_ptr() == state["vision.layers.0.self_attn.q_proj.bias"].data_ptr()


def test_tensors_lie_where_the_room_has_them() -> None:
    placement = WeightPlacement(CONFIG.planned_model, META, lambda name: is_conditioning(CONFIG.planned_model, name))
    shapes = {"time_mlp_in.weight": CPU, "expert.layers.0.input_layernorm.dense.weight": CPU, "projector.weight": META}
    for name, device in shapes.items():
        assert placement(name, (2, 3), torch.float32).device == device
    pi0 = replace(CONFIG.planned_model, kind="pi0")
    assert not is_conditioning(pi0, "time_mlp_in.weight"), "which of Pi0 is a part of every step"


def test_a_room_keeps_nothing_of_what_it_gave_away() -> None:
    """What packing rounds or drops shall be freed layer by layer, not when all is packed."""
    placement, shapes = WeightPlacement(CONFIG.planned_model, CPU, nothing), parameter_shapes(CONFIG.planned_model)
    names = [f"vlm.layers.1.mlp.{part}.weight" for part in GATE_UP]
    stores = [[placement(name, shapes[name], torch.bfloat16).untyped_storage() for name in names] for _ in range(2)]
    (gate, up), (other_gate, other_up) = ([one.data_ptr() for one in some] for some in stores)
    assert gate == up != other_gate == other_up


def test_a_damaged_number_is_found_wherever_it_lies(monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = random_checkpoint(CONFIG)
    pieces = checkpoint.source.pieces

    def damaged(device: torch.device):  # type: ignore[no-untyped-def]
        for piece in pieces(device):
            if piece.name == "vlm.layers.1.self_attn.k_proj.weight":
                piece.values[1, 2] = torch.nan
            yield piece

    monkeypatch.setattr(checkpoint.source, "pieces", damaged)
    with pytest.raises(Exception, match=r"vlm\.layers\.1\.self_attn\.k_proj\.weight"):
        checkpoint.load(WeightPlacement(CONFIG.planned_model, CPU, nothing), "bf16")


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("vlm.layers.3.mlp.up_proj.weight", "gate_proj up_proj"),
        ("vision.layers.0.self_attn.v_proj.bias", "q_proj k_proj v_proj"),
        ("vlm.layers.3.mlp.down_proj.weight", ""),
        ("vlm.layers.3.self_attn.o_proj.weight", ""),
    ],
)
def test_who_is_joined_with_whom(name: str, parts: str) -> None:
    found = joined_with(name)
    assert ("" if found is None else " ".join(one.rsplit(".", 2)[-2] for one in found)) == parts


def test_only_neighbours_that_fill_their_memory_are_joined_without_a_copy() -> None:
    whole = torch.arange(24.0).view(6, 4)
    first, second, last = whole.split([1, 2, 3])  # type: ignore[no-untyped-call]
    assert join([first, second, last], None).data_ptr() == whole.data_ptr()
    assert join([first, second, last], META).device == META
    for parts in ([second, first, last], [first, second], [second, last], [first, second, last.clone()]):
        found = join(parts, None)
        assert torch.equal(found, torch.cat(parts)) and found.data_ptr() != whole.data_ptr()
    square = torch.arange(8.0).view(2, 2, 2)
    turned = [square[0].T, square[1].T]
    assert torch.equal(join(turned, None), torch.cat(turned))
