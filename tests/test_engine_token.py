"""The engine's step of a model that writes tokens equals the reference's, in its own buffers."""

from collections.abc import Iterator
from dataclasses import fields, replace

import pytest
import torch
from conftest import gpu_or_interpreter
from pi0_fast_golden import make_folder, make_hub, policy_of, runs
from torch import Tensor

from turbopi import UnifiedPolicy
from turbopi.config import Pi0FastConfig
from turbopi.models.observation import Observation

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.engine import token
from turbopi.kernels.portable.token import Int8Rows, Weight
from turbopi.models.pi0.decoding import Decoding
from turbopi.models.pi0_fast.reference import Pi0FastModel, compacted

pytestmark = gpu_or_interpreter()
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.fixture(scope="module", params=["quantiles_empty_camera", "openpi"])
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def policy(name: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[UnifiedPolicy]:
    root = tmp_path_factory.mktemp("pi0_fast")
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("HF_HUB_CACHE", str(make_hub(root / "hub")))
        yield policy_of(make_folder(name, root / name, broken_answers="owners"), device=DEVICE.type, backend="pytorch")


def begun(policy: UnifiedPolicy, name: str, model: Pi0FastModel, run: int) -> Decoding:
    observation = compacted(Observation.stack([policy.prepare(runs(name).observation(run))]).to(DEVICE))
    assert policy.backend.reader is not None
    decoding = model.allocate(observation, 12, policy.backend.reader.ends)
    model.begin(observation, decoding)
    return decoding


@torch.no_grad()
def test_a_token_is_the_references(policy: UnifiedPolicy, name: str) -> None:
    model = policy.backend.model  # type: ignore[attr-defined]  # PyTorch's
    joined = token.JoinedWeights(model)
    ours, theirs = (begun(policy, name, model, 1) for _ in range(2))
    step = token.TokenStep(model, joined, ours)
    for _ in range(2):
        step()
        model.step(theirs)
        assert (ours.logits - theirs.logits).abs().max() <= 2e-5 * theirs.logits.abs().max()
        for field in ("ids", "count", "chosen", "place", "position", "valid", "ended"):
            assert torch.equal(getattr(ours, field), getattr(theirs, field)), field
    for field in ("keys", "values"):
        for one, other in zip(getattr(ours, field), getattr(theirs, field), strict=True):
            torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)


@torch.no_grad()
def test_int8_weights_are_what_is_multiplied(policy: UnifiedPolicy, name: str) -> None:
    model = policy.backend.model  # type: ignore[attr-defined]
    rounded, wide = token.JoinedWeights(model, int8=True), token.JoinedWeights(model)
    wide.head, wide.layers = meant(rounded.head), [as_meant(one) for one in rounded.layers]
    assert (wide.head - model.head).abs().max() <= 0.5001 * rounded.head.scale.max()  # type: ignore[union-attr]
    ours, expected, exact = (begun(policy, name, model, 1) for _ in range(3))
    token.TokenStep(model, rounded, ours)()
    token.TokenStep(model, wide, expected)()
    model.step(exact)
    assert (ours.logits - expected.logits).abs().max() <= 2e-5 * expected.logits.abs().max()
    error = (ours.logits - exact.logits).norm() / exact.logits.norm()
    assert 1e-3 < error < 0.02, "a row's 255 steps are some 0.008 of a normal variable's rms"


def meant(weight: Weight) -> Tensor:
    assert isinstance(weight, Int8Rows) and weight.words.dtype == torch.int32
    return weight.meant()


def as_meant(layer: token.LayerWeights) -> token.LayerWeights:
    return token.LayerWeights(*(meant(getattr(layer, one.name)) for one in fields(layer)))


@pytest.mark.parametrize("name", ["quantiles_empty_camera"], indirect=True)
@torch.no_grad()
def test_an_end_is_marked_and_the_first_of_equals_is_chosen(policy: UnifiedPolicy, name: str) -> None:
    model = policy.backend.model  # type: ignore[attr-defined]
    decoding = begun(policy, name, model, 0)
    step = token.TokenStep(model, token.JoinedWeights(model), decoding)
    step()
    expected = int(decoding.chosen)
    again = begun(policy, name, model, 0)
    ending = replace(again, ends=torch.tensor([*again.ends.tolist(), expected], device=DEVICE))
    token.TokenStep(model, token.JoinedWeights(model), ending)()
    assert bool(ending.ended.all()) and int(ending.chosen) == expected
    weight = model.vlm.embed_tokens.weight
    weight.data[:] = weight[expected].clone()  # every logit the same
    equal = begun(policy, name, model, 0)
    token.TokenStep(model, token.JoinedWeights(model), equal)()
    assert int(equal.chosen) == 0


@torch.no_grad()
def test_a_token_of_text_has_its_own_head_and_leaves_out_ids(policy: UnifiedPolicy, name: str) -> None:
    model: Pi0FastModel = policy.backend.model  # type: ignore[attr-defined]
    head = torch.randn(model.head.shape, generator=torch.Generator().manual_seed(0)).to(model.head)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(model), "head", property(lambda self: head))
        free, ours, theirs = (begun(policy, name, model, 1) for _ in range(3))
        model.step(free)
        best = int(free.chosen)
        patch.setattr(type(model), "never", ((best, best + 1), (len(head), len(head) + 9)))
        token.TokenStep(model, token.JoinedWeights(model), ours)()
        model.step(theirs)
        assert int(ours.chosen) == int(theirs.chosen) != best and torch.isneginf(ours.logits[:, best]).all()
        there = torch.isfinite(theirs.logits)
        assert (ours.logits - theirs.logits)[there].abs().max() <= 2e-5 * theirs.logits[there].abs().max()


def test_other_sizes_are_refused_by_name() -> None:
    assert token.refuses(Pi0FastConfig()) is None
    for change, said in (
        ({"num_kv_heads": 2}, "2 key/value heads"),
        ({"head_dim": 192}, "heads of 192 numbers"),
        ({"width": 8192}, "width 8192"),
    ):
        assert said in str(token.refuses(Pi0FastConfig(vlm=replace(Pi0FastConfig().vlm, **change))))
