"""Pi0-FAST on a GPU: backend `cuda_graph` writes the ids that its owners' code writes."""

from pathlib import Path

import pytest
import torch
from pi0_fast_golden import make_folder, make_hub, policy_of, runs
from smolvla_golden import relative

from turbopi import UnifiedPolicy
from turbopi.models.observation import Observation
from turbopi.support.errors import ConfigError

pytestmark = [pytest.mark.gpu, pytest.mark.filterwarnings("default")]  # Inductor warns of what it does


@pytest.fixture(scope="module", params=["quantiles_empty_camera", "openpi"])
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def folder(name: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("pi0_fast")
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("HF_HUB_CACHE", str(make_hub(root / "hub")))
        return make_folder(name, root / name, broken_answers="owners")


@pytest.fixture(scope="module")
def captured(folder: Path) -> UnifiedPolicy:
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("HF_HUB_CACHE", str(folder.parent / "hub"))
        return policy_of(folder, device="cuda", backend="cuda_graph")


def test_captured_float32_gives_the_owners_actions(name: str, captured: UnifiedPolicy) -> None:
    golden = runs(name)
    for run in [*range(len(golden)), 0]:
        assert relative(captured.infer(golden.observation(run))["actions"], golden.actions(run)) <= 1e-5


def test_captured_intermediates_are_the_references(name: str, captured: UnifiedPolicy, folder: Path) -> None:
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("HF_HUB_CACHE", str(folder.parent / "hub"))
        plain = policy_of(folder)
    prepared = Observation.stack([plain.prepare(runs(name).observation(0))])
    noise = torch.randn(1, 8, 7, generator=torch.Generator().manual_seed(0))
    ours, exact = (policy.backend.intermediates(prepared, noise, 80) for policy in (captured, plain))
    assert relative(ours["logits"].cpu().numpy(), exact["logits"].numpy()) <= 1e-4
    places = torch.cat(
        (prepared.image_mask.repeat_interleave(plain.config.model.vision.num_tokens, 1), prepared.token_mask), 1
    )
    for part in ("kv_k", "kv_v"):
        of_both = (trace[part].cpu()[:, 0][:, places[0]].numpy() for trace in (ours, exact))
        assert relative(*of_both) <= 1e-4, part


def test_bfloat16_is_as_near_to_float32_as_ordinary_bfloat16(name: str, captured: UnifiedPolicy, folder: Path) -> None:
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("HF_HUB_CACHE", str(folder.parent / "hub"))
        both = [policy_of(folder, device="cuda", precision="bf16", backend=one) for one in ("cuda_graph", "pytorch")]
    prepared = Observation.stack([both[0].prepare(runs(name).observation(0))])
    noise = torch.randn(1, 8, 7, generator=torch.Generator().manual_seed(0))
    graphs, ordinary, exact = (
        policy.backend.intermediates(prepared, noise, 80)["logits"].float().cpu().numpy()
        for policy in (*both, captured)
    )
    assert 0 < relative(graphs, exact) <= 1.5 * relative(ordinary, exact)


def test_int8_weights_are_refused_by_name_or_near_float32(name: str, captured: UnifiedPolicy, folder: Path) -> None:
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("HF_HUB_CACHE", str(folder.parent / "hub"))
        rounded = policy_of(folder, device="cuda", precision="int8-weights", backend="auto")
        with pytest.raises(ConfigError, match="doesn't run in 'int8-weights': models that write"):
            policy_of(folder, device="cuda", precision="int8-weights", backend="pytorch")
    assert rounded.metadata["backend_details"]["tokens_by"] == "engine, weights in INT8"
    prepared = Observation.stack([rounded.prepare(runs(name).observation(0))])
    noise = torch.randn(1, 8, 7, generator=torch.Generator().manual_seed(0))
    ours, exact = (
        policy.backend.intermediates(prepared, noise, 80)["logits"].float().cpu().numpy()
        for policy in (rounded, captured)
    )
    assert 0 < relative(ours, exact) <= 0.05
