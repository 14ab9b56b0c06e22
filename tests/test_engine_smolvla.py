"""SmolVLA's vision and prefix in the engine's form equal the reference's: without a GPU in float32, by Triton's
interpreter.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import gpu_or_interpreter
from smolvla_golden import relative
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.checkpoint import random_checkpoint
from turbopi.config import VisionConfig
from turbopi.engine.smolvla import Expert, Placement, Prefix, Vision
from turbopi.kernels.ops import fused_ops
from turbopi.kernels.plain import PLAIN
from turbopi.kernels.portable.ops import portable_ops
from turbopi.models.observation import Observation
from turbopi.models.smolvla.config import ElementTypes, SmolVLAConfig, TextConfig
from turbopi.models.smolvla.family import BASE
from turbopi.models.smolvla.reference import SmolVLAModel

ON_GPU = torch.cuda.is_available()
DEVICE = torch.device("cuda" if ON_GPU else "cpu")
DTYPE = torch.bfloat16 if ON_GPU else torch.float32
pytestmark = gpu_or_interpreter()


def config_of(**sizes: Any) -> SmolVLAConfig:
    text = TextConfig(width=64, mlp_dim=48, num_heads=6, num_kv_heads=2, head_dim=16, vocab_size=20, depth=4)
    vision = VisionConfig(width=32, depth=2, mlp_dim=48, num_heads=2, patch_size=4, image_size=16)
    return SmolVLAConfig(vision, text, expert_width=48, expert_mlp=80, image_size=16, max_prompt_tokens=7, **sizes)


def model(**sizes: Any) -> SmolVLAModel:
    made, generator = SmolVLAModel(config_of(**sizes)), torch.Generator().manual_seed(1)
    for name, parameter in made.named_parameters():
        torch.nn.init.normal_(parameter, std=parameter.shape[-1] ** -0.5, generator=generator)
        if "norm" in name and name.endswith("weight"):
            parameter.data = 1 + 0.3 * parameter.data
    return made.to(DEVICE).eval().requires_grad_(False)


@pytest.mark.parametrize(
    ("sizes", "cameras", "prompt"),
    [
        ({"expert_depth": 4}, 2, 3),
        ({"expert_depth": 2, "image_start": (3, 4), "image_end": (5,)}, 1, 7),
        ({"expert_depth": 2, "self_every": 3}, 1, 1),
        ({"expert_depth": 4, "self_every": 3}, 2, 5),
        ({"expert_depth": 4, "self_every": None}, 2, 5),
    ],
)
def test_keys_and_values_are_the_references(sizes: dict[str, object], cameras: int, prompt: int) -> None:
    made, generator = model(**sizes), torch.Generator().manual_seed(2)
    # the library's GELU on a CPU is another one than on a GPU
    ops = fused_ops(DEVICE) if ON_GPU else replace(portable_ops(), linear_gelu=PLAIN.linear_gelu)
    images = (torch.rand(cameras, 16, 16, 3, generator=generator) * 2 - 1).to(DEVICE)
    tokens = torch.randint(20, (1, prompt), generator=generator).to(DEVICE)
    state = torch.randn(1, 32, generator=generator).to(DEVICE)
    everywhere = torch.ones(1, max(cameras, prompt), dtype=torch.bool, device=DEVICE)
    observation = Observation(images[None], everywhere[:, :cameras], tokens, everywhere[:, :prompt], state)
    cache = made.prefix(observation)
    beside = [(cache.k[i], cache.v[i]) for i in made.config.expert_at]
    crossed = made.cross_keys_values(cache)
    exact = [own if other is None else other for own, other in zip(beside, crossed, strict=True)]

    vision, prefix = Vision.pack(made, ops, DTYPE), Prefix.pack(made, ops, DTYPE)
    embedded = vision(images)
    near = 3e-2 if ON_GPU else 2e-5
    assert relative(_numpy(embedded), _numpy(made.embed_images(images))) <= near
    padded = torch.zeros(7, dtype=torch.int64, device=DEVICE)
    padded[:prompt] = tokens[0]
    length = torch.tensor([prefix.before_prompt(cameras) + prompt + 1], device=DEVICE)
    x = prefix.embed(embedded, padded, state, length)
    assert len(x) == prefix.places(cameras) and int(length) == int(cache.lengths)
    keys, values = prefix.of_expert(prefix.keys_values(x, length))
    for i, (k, v) in enumerate(exact):
        for ours, theirs in ((keys[i], k[0]), (values[i], v[0])):
            assert relative(_numpy(ours[:, : int(length)]), _numpy(theirs)) <= near, i


class Made(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Notes the operations."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.names: list[str] = []

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.names.append(function.name().removeprefix("aten::").split(".")[0])
        return function(*args, **(kwargs or {}))


def test_a_second_run_makes_no_table_that_the_first_has_made() -> None:
    made = model(expert_depth=4)
    ops = fused_ops(DEVICE) if ON_GPU else replace(portable_ops(), linear_gelu=PLAIN.linear_gelu)
    vision, prefix = Vision.pack(made, ops, DTYPE), Prefix.pack(made, ops, DTYPE)
    images, tokens = torch.zeros(1, 16, 16, 3, device=DEVICE), torch.zeros(7, dtype=torch.int64, device=DEVICE)
    state, length = torch.zeros(1, 32, device=DEVICE), torch.full((1,), 4, device=DEVICE)

    def run() -> list[str]:
        with Made() as noted:
            prefix.of_expert(prefix.keys_values(prefix.embed(vision(images), tokens, state, length), length))
        return noted.names

    tables = {"arange", "cos", "sin", "pow"}
    assert tables <= set(run())
    second = run()
    assert not tables & set(second) and second.count("embedding") == 1, second  # the prompt's


def _numpy(x: Tensor) -> np.ndarray:
    return x.float().cpu().numpy()


def test_matrices_side_by_side_are_the_models_own() -> None:
    """They take no memory twice, and stay where a captured graph reads them."""
    made = model(expert_depth=4).to(DTYPE)
    before = {name: weight.clone() for name, weight in made.named_parameters()}

    def packed() -> list[Any]:
        vision, prefix = Vision.pack(made, PLAIN, DTYPE), Prefix.pack(made, PLAIN, DTYPE)
        layers = [layer.qkv[0] for layer in vision.layers]
        return layers + [matrix for layer in prefix.layers for matrix in (layer.qkv, layer.gate_up)]

    def places(tensors: Iterable[Tensor]) -> set[int]:
        return {one.untyped_storage().data_ptr() for one in tensors}

    matrices, parameters = packed(), list(made.parameters())
    assert places(matrices) <= places(parameters) and len(matrices) == len(places(matrices)) == 10
    assert [one.data_ptr() for one in packed()] == [one.data_ptr() for one in matrices]
    assert all(torch.equal(weight, before[name]) for name, weight in made.named_parameters())
    storages = {one.data_ptr(): one.nbytes() for one in (weight.untyped_storage() for weight in parameters)}
    assert sum(storages.values()) == sum(weight.nbytes for weight in parameters)


def test_read_to_its_places_it_is_packed_with_the_same_bits_and_moves_nothing() -> None:
    config = config_of(expert_depth=4, element_types=ElementTypes("float32", "bfloat16"))
    checkpoint, bfloat16 = random_checkpoint(replace(BASE, model=config)), torch.bfloat16
    places = DEVICE, Placement(config, DEVICE, bfloat16)
    plain, placed = (SmolVLAModel.from_state(config, checkpoint.load(to, "bf16").state) for to in places)
    before = {name: weight.data_ptr() for name, weight in placed.named_parameters()}
    kept = [{weight.dtype for weight in (*one.vision.parameters(), one.projector.weight)} for one in (plain, placed)]
    assert kept == [{torch.float32}, {bfloat16}]
    own = [layer.self_attn.k_proj.weight.dtype for layer in placed.expert.layers]
    assert own == [bfloat16, torch.float32, bfloat16, torch.float32]  # as LeRobot's layers across have them

    def packed(made: SmolVLAModel) -> list[Any]:
        vision, prefix = Vision.pack(made, PLAIN, bfloat16), Prefix.pack(made, PLAIN, bfloat16)
        pairs = [(*one.norm1, *one.qkv, *one.out, *one.norm2, *one.fc1, *one.fc2) for one in vision.layers]
        layers = [(one.qkv, one.out, one.gate_up, one.down, one.norm1, one.norm2) for one in prefix.layers]
        across = [matrices for _, matrices in prefix.across]
        ends = (*vision.patch, vision.positions, *vision.norm, vision.projector, *prefix.special)
        return [one for some in (*pairs, *layers) for one in some] + [*across, *ends, Expert.pack(made).packed.weights]

    assert all(torch.equal(one, other) for one, other in zip(packed(placed), packed(plain), strict=True))
    assert before == {name: weight.data_ptr() for name, weight in placed.named_parameters()}
