"""Weights are read to where packing wants them: the same numbers, and nothing is held twice."""

import re
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.profiler import ProfilerActivity

from turbopi.checkpoint import open_checkpoint, random_checkpoint, write_random
from turbopi.config import PRESETS, GemmaConfig, ModelConfig, PolicyConfig, VisionConfig
from turbopi.engine.weight_placement import GATE_UP, WeightPlacement, is_conditioning, join, joined_with
from turbopi.engine.weights import Weights, pack
from turbopi.kernels.portable.quantize import quantize
from turbopi.models import parameter_shapes
from turbopi.quantization.directions import directions
from turbopi.quantization.formats import OF_EIGHT_BITS, Format
from turbopi.quantization.fp8 import Matrix
from turbopi.support.errors import CheckpointError

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


def rounded(format: Format) -> Callable[[str, Tensor], Matrix]:
    """As `fused` makes matrices: in eight bits, of some sites for directions, and some as they are."""

    def make(place: str, matrix: Tensor) -> Matrix:
        if place == "prefix.0.out" or not matrix.numel():
            return matrix
        common = None
        if place.endswith((".0.qkv", ".1.down")):
            rows = torch.randn(40, matrix.shape[1], generator=torch.Generator().manual_seed(len(place)))
            common = directions(rows)
        return quantize(matrix, 0.02, common, format)

    return make


@pytest.mark.parametrize("format", OF_EIGHT_BITS.values(), ids=OF_EIGHT_BITS)
def test_matrices_rounded_as_they_are_read_have_the_bits_of_those_rounded_when_all_is_read(format: Format) -> None:
    model, checkpoint, make = CONFIG.planned_model, random_checkpoint(CONFIG), rounded(format)
    expected = pack(model, checkpoint.load("cpu", "bf16").state, make)
    placement = WeightPlacement(model, CPU, nothing, make)
    state = checkpoint.load(placement, "bf16").state
    assert not any(name.startswith("vision.layers") and name.endswith("proj.weight") for name in state)
    found = pack(model, state, made=placement.made)
    assert not placement.made
    ours, theirs = list(numbers_of(found)), list(numbers_of(expected))
    assert sum(one.element_size() == 1 for one in ours) > 10
    for one, other in zip(ours, theirs, strict=True):
        assert one.dtype == other.dtype and one.shape == other.shape
        assert torch.equal(one.contiguous().view(torch.uint8), other.contiguous().view(torch.uint8))


def numbers_of(weights: Any) -> Iterator[Tensor]:
    """All tensors in it, scalars too, in order."""
    if isinstance(weights, Tensor):
        yield weights.reshape(-1) if weights.ndim else weights[None]
    elif isinstance(weights, float):
        yield torch.tensor([weights])
    elif isinstance(weights, list | tuple | dict):
        for one in weights.values() if isinstance(weights, dict) else weights:
            yield from numbers_of(one)
    elif is_dataclass(weights):
        yield from numbers_of(vars(weights))


# full Pi0.5's proportions at a 250th of its size
SMALL = ModelConfig(
    vision=VisionConfig(width=72, depth=27, mlp_dim=272, num_heads=4),
    vlm=GemmaConfig(width=128, mlp_dim=1024, head_dim=16),
    expert=GemmaConfig(width=64, mlp_dim=256, head_dim=16),
    vocab_size=16_000,
)
FULL_BYTES, LIMIT = 6.9e9, 1.5e9  # full Pi0.5's weights in bfloat16; what the host may hold of them


def peak_bytes(run: Callable[[], Any], file: Path) -> int:
    """The most bytes that PyTorch holds while something runs, without the mapped file, which it counts, too."""
    with torch.profiler.profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profile:
        run()
    events = [event for event in profile.profiler.kineto_results.events() if event.name() == "[memory]"]
    events = [event for event in events if abs(event.nbytes()) < 0.9 * file.stat().st_size]
    return max(accumulate(event.nbytes() for event in sorted(events, key=lambda event: event.start_ns())))


def test_loading_for_eight_bits_never_holds_the_weights_on_the_host(tmp_path: Path) -> None:
    """Counted from PyTorch's own allocations and frees, not from what the system says."""
    write_random(PolicyConfig("small", SMALL, "plain"), tmp_path / "small")
    checkpoint = open_checkpoint(tmp_path / "small")

    def peak_and_state(make: Callable[[str, Tensor], Matrix] | None, on_host: Callable[[str], bool]) -> tuple[int, Any]:
        found: list[Any] = []
        room = WeightPlacement(SMALL, CPU, on_host, make)
        peak = peak_bytes(lambda: found.append(checkpoint.load(room, "bf16")), tmp_path / "small" / "model.safetensors")
        return peak, found[0]

    def on_device(state: dict[str, Tensor]) -> int:
        """Of what isn't rounded, whatever the state has besides."""
        mine = [
            one for name, one in state.items() if not re.match(r"expert\.|v\w+\.layers\..*(proj|fc\d)\.weight", name)
        ]
        return sum(one.nbytes for one in mine)

    on_gpu = torch.empty(0, 0)  # a matrix that a GPU has
    peak, loaded = peak_and_state(lambda place, matrix: on_gpu, lambda name: name.startswith("expert."))
    scale = loaded.bytes / FULL_BYTES
    assert 0.3 * LIMIT < (peak - on_device(loaded.state)) / scale < LIMIT
    before, _ = peak_and_state(None, lambda name: True)
    assert before / scale > 0.9 * FULL_BYTES


def test_a_damaged_number_is_found_wherever_it_lies(monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = random_checkpoint(CONFIG)
    pieces = checkpoint.source.pieces

    def damaged(device: torch.device):  # type: ignore[no-untyped-def]
        for piece in pieces(device):
            if piece.name == "vlm.layers.1.self_attn.k_proj.weight":
                piece.values[1, 2] = torch.nan
            yield piece

    monkeypatch.setattr(checkpoint.source, "pieces", damaged)
    for make in (None, lambda place, matrix: matrix):
        with pytest.raises(CheckpointError, match=r"vlm\.layers\.1\.self_attn\.k_proj\.weight"):
            checkpoint.load(WeightPlacement(CONFIG.planned_model, CPU, nothing, make), "bf16")


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
