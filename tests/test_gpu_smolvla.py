"""SmolVLA on a GPU: backend `cuda_graph` gives LeRobot's actions, `fused` what the reference does."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from smolvla_golden import GoldenRuns, make_checkpoint, make_hub
from test_gpu_int8 import is_as_far_off
from torch import Tensor

from turbopi import UnifiedPolicy
from turbopi.backends.base import StageTimer
from turbopi.backends.captured import CapturedBackend
from turbopi.backends.pytorch import reference_model
from turbopi.calibrate.run import Settings, calibrate
from turbopi.checkpoint import Checkpoint, open_checkpoint
from turbopi.checkpoint.random_weights import random_checkpoint
from turbopi.engine.emulate import RoundedWeights, relative_rms, rounded
from turbopi.models.observation import Observation, Past
from turbopi.models.pi0.conditioning import Conditioning, Guidance
from turbopi.quantization.formats import FORMATS
from turbopi.quantization.sites import sites
from turbopi.support.errors import ObservationError

pytestmark = [pytest.mark.gpu, pytest.mark.filterwarnings("default")]  # Inductor warns of what it does


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Checkpoint]:
    root = tmp_path_factory.mktemp("smolvla")
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("HF_HUB_CACHE", str(make_hub(root / "hub")))
        return {
            name: open_checkpoint(make_checkpoint(name, root / name)) for name in ("base", "missing_camera", "bf16")
        }


def relative(ours: np.ndarray, theirs: np.ndarray) -> float:
    exact = theirs.astype(np.float64)
    return float(np.sqrt(np.square(ours - exact).mean() / np.square(exact).mean()))


@pytest.mark.parametrize("name", ["base", "missing_camera"])
def test_captured_float32_gives_lerobots_actions(name: str, checkpoints: dict[str, Checkpoint]) -> None:
    policy, golden = UnifiedPolicy(checkpoints[name], precision="f32", backend="cuda_graph"), GoldenRuns(name)
    for run in range(len(golden)):
        actions = policy.infer(golden.observation(run), noise=golden.noise)["actions"]
        assert relative(actions, golden.actions(run)) <= 2e-5


def test_captured_bfloat16_is_as_near_to_float32_as_lerobots(checkpoints: dict[str, Checkpoint]) -> None:
    policy, golden = UnifiedPolicy(checkpoints["bf16"], backend="cuda_graph"), GoldenRuns("bf16")
    for run in range(len(golden)):
        actions = policy.infer(golden.observation(run), noise=golden.noise)["actions"]
        exact = golden.actions(run, "float32/")
        assert relative(actions, exact) <= 2 * max(relative(golden.actions(run), exact), 1e-2)


def test_auto_takes_it_and_a_strict_policy_runs_what_was_warmed_up(checkpoints: dict[str, Checkpoint]) -> None:
    policy, golden = UnifiedPolicy(checkpoints["base"], precision="f32", strict=True), GoldenRuns("base")
    assert policy.metadata["backend"] == "cuda_graph"
    with pytest.raises(ObservationError, match="warmup"):
        policy.infer(golden.observation(0), noise=golden.noise)
    policy.warmup(cameras=[1, 2])
    for _ in range(2):
        for run in range(len(golden)):
            actions = policy.infer(golden.observation(run), noise=golden.noise)["actions"]
            assert relative(actions, golden.actions(run)) <= 2e-5


def test_a_conditioned_loop_and_a_batch_equal_the_references(checkpoints: dict[str, Checkpoint]) -> None:
    captured, plain = (
        UnifiedPolicy(checkpoints["base"], precision="f32", backend=name) for name in ("cuda_graph", "pytorch")
    )
    golden = GoldenRuns("base")
    target, weights = np.full((10, 32), 0.5, np.float32), np.linspace(1, 0, 10, dtype=np.float32)
    pull = Conditioning(guidance=Guidance(target, weights, np.ones((10, 10), np.float32), "identity"))
    held = Conditioning(held=np.arange(10) < 3, values=target)
    for one in (pull, held):
        both = [
            policy.infer(golden.observation(0), seed=1, conditioning=one)["actions"] for policy in (captured, plain)
        ]
        assert relative(*both) <= 2e-5
    prepared = Observation.stack([plain.prepare(golden.observation(0))])
    noise = torch.from_numpy(golden.noise)[None]
    traces = [policy.backend.intermediates(prepared, noise, 10) for policy in (captured, plain)]
    for name in ("kv_k", "kv_v", "x_t", "v_t", "actions"):
        ours, exact = (trace[name].cpu().numpy() for trace in traces)
        assert relative(ours, exact) <= 1e-4
    several = [golden.observation(run) for run in range(2)]
    rows = [policy.infer_batch(several, seed=1, conditioning=[None, pull]) for policy in (captured, plain)]
    assert all(relative(a["actions"], b["actions"]) <= 2e-5 for a, b in zip(*rows, strict=True))


def answer_without_waiting(policy: UnifiedPolicy, conditioning: Conditioning | None) -> None:
    """A call up to where its actions are read; PyTorch raises for what waits for the device before."""
    backend, config = policy.backend, policy.backend.config
    assert isinstance(backend, CapturedBackend)
    images = [np.full((48, 64, 3), fill, np.uint8) for fill in (20, 200)]
    inputs = [np.arange(3)], np.zeros((1, config.state_dim), np.float32)
    noise = np.random.default_rng(1).normal(size=(1, config.action_horizon, config.action_dim)).astype(np.float32)
    answers = []
    for mode in ("default", "error"):  # the first call captures
        torch.cuda.set_sync_debug_mode(mode)
        try:
            turn = backend.see([images], "lerobot", [Past()])
            made = backend.answer(turn, *inputs, noise, 10, conditioning, StageTimer(backend.device))
        finally:
            torch.cuda.set_sync_debug_mode("default")
        answers.append(made.actions.cpu().numpy())
    assert np.isfinite(answers[0]).all() and np.array_equal(answers[0], answers[1])


@pytest.mark.parametrize("form", ["plain", "held", "pulled"])
def test_no_captured_call_waits_for_the_device_before_its_actions(
    checkpoints: dict[str, Checkpoint], form: str
) -> None:
    policy = UnifiedPolicy(checkpoints["base"], precision="f32", backend="cuda_graph")
    target = np.full((10, 32), 0.5, np.float32)
    guidance = Guidance(target, np.linspace(1, 0, 10, dtype=np.float32), np.ones((10, 10), np.float32), "identity")
    given = {"held": Conditioning(held=np.arange(10) < 3, values=target), "pulled": Conditioning(guidance=guidance)}
    answer_without_waiting(policy, given.get(form))


def test_a_captured_batch_of_other_prompts_and_cameras_gives_lerobots_actions(
    checkpoints: dict[str, Checkpoint],
) -> None:
    for name in ("base", "missing_camera"):
        policy, golden = UnifiedPolicy(checkpoints[name], precision="f32", backend="cuda_graph"), GoldenRuns(name)
        runs = [run % len(golden) for run in range(3)]
        noise = np.stack([golden.noise] * len(runs))
        together = policy.infer_batch([golden.observation(run) for run in runs], noise=noise)
        for run, one in zip(runs, together, strict=True):
            assert relative(one["actions"], golden.actions(run)) <= 2e-5
        assert policy.metadata["backend_details"]["batches"]


# -- fused: its kernels take heads of at least 16 columns, which the golden models haven't; so the published sizes -----


@pytest.fixture(scope="module")
def published() -> Checkpoint:
    return random_checkpoint("smolvla_base")


@pytest.fixture(scope="module")
def policies(published: Checkpoint) -> dict[str, UnifiedPolicy]:
    return {
        "exact": UnifiedPolicy(published, backend="pytorch", precision="f32"),
        "ordinary": UnifiedPolicy(published, backend="pytorch"),
        "fused": UnifiedPolicy(published),
    }


def test_fused_waits_for_the_device_as_little(policies: dict[str, UnifiedPolicy]) -> None:
    answer_without_waiting(policies["fused"], None)


def seen(policy: UnifiedPolicy, seed: int, cameras: int, prompt: str) -> dict[str, Any]:
    observation = policy.example_observation(seed)
    (folder,) = {"image", "images"} & observation.keys()
    left = dict(list(observation[folder].items())[:cameras])
    assert len(left) == cameras
    return {**observation, folder: left, "prompt": prompt}


@pytest.mark.parametrize(("cameras", "prompt"), [(1, "a"), (2, "put the red cup on the plate " * 3), (3, "open it")])
def test_fused_is_as_near_to_float32_as_ordinary_bfloat16(
    policies: dict[str, UnifiedPolicy], cameras: int, prompt: str
) -> None:
    observation = seen(policies["exact"], 3, cameras, prompt)
    noise = np.random.default_rng(5).normal(size=(50, 32)).astype(np.float32)
    exact, ordinary, fused = (policies[name].infer(observation, noise=noise)["actions"] for name in policies)
    assert 0 < relative(fused, exact) <= 1.5 * relative(ordinary, exact)
    assert policies["fused"].metadata["backend"] == "fused"


def test_every_intermediate_of_fused_is_as_near(policies: dict[str, UnifiedPolicy]) -> None:
    observation = Observation.stack([policies["exact"].prepare(seen(policies["exact"], 7, 2, "go there"))])
    noise = torch.from_numpy(np.random.default_rng(6).normal(size=(1, 50, 32)).astype(np.float32))
    policies["fused"].backend.sample(observation, torch.full_like(noise, torch.nan), 10)  # which leaves nothing behind
    traces = [policies[name].backend.intermediates(observation, noise, 10) for name in policies]
    for name in ("kv_k", "kv_v", "x_t", "v_t", "actions"):
        exact, ordinary, fused = (trace[name].float().cpu().numpy() for trace in traces)
        assert relative(fused, exact) <= 1.5 * relative(ordinary, exact), name


def test_a_loop_of_other_steps_and_actions_and_a_conditioned_one(policies: dict[str, UnifiedPolicy]) -> None:
    observation = seen(policies["exact"], 4, 2, "close it")
    target, weights = np.full((50, 32), 0.3, np.float32), np.linspace(1, 0, 50, dtype=np.float32)
    pull = Conditioning(guidance=Guidance(target, weights, np.ones((10, 50), np.float32), "identity"))
    every: tuple[dict[str, Any], ...] = ({"num_steps": 3}, {"horizon": 20}, {"conditioning": pull})
    for options in every:
        exact, ordinary, fused = (policies[name].infer(observation, seed=2, **options)["actions"] for name in policies)
        assert relative(fused, exact) <= 1.5 * relative(ordinary, exact), options
    again = [policies["fused"].infer(observation, seed=2)["actions"] for _ in range(2)]
    assert np.array_equal(*again)


def test_a_strict_fused_policy_runs_what_was_warmed_up(published: Checkpoint) -> None:
    policy = UnifiedPolicy(published, backend="fused", strict=True)
    observation = seen(policy, 1, 2, "go")
    with pytest.raises(ObservationError, match="warmup"):
        policy.infer(observation)
    policy.warmup(cameras=[2])
    assert np.isfinite(policy.infer(observation)["actions"]).all()
    with pytest.raises(ObservationError, match="warmup"):
        policy.infer(observation, num_steps=7)
    policy.warmup(cameras=[2], batches=8)
    for count in (2, 5, 8):
        assert all(np.isfinite(one["actions"]).all() for one in policy.infer_batch([observation] * count, seed=1))


def test_a_fused_batch_of_other_prompts_and_cameras_is_as_near(policies: dict[str, UnifiedPolicy]) -> None:
    prompts = ["a", "put the red cup on the plate " * 3, "open it"]
    several = [seen(policies["exact"], 8 + row, 3 - row, prompt) for row, prompt in enumerate(prompts)]
    for count in (2, 3):
        exact, ordinary = (
            [policies[name].infer(one, seed=1 + row)["actions"] for row, one in enumerate(several[:count])]
            for name in ("exact", "ordinary")
        )
        for _ in range(2):
            fused = [one["actions"] for one in policies["fused"].infer_batch(several[:count], seed=1)]
            for ours, usual, right in zip(fused, ordinary, exact, strict=True):
                assert 0 < relative(ours, right) <= 1.5 * relative(usual, right)
    sizes = policies["fused"].metadata["backend_details"]["batches"]
    assert sizes == ["2 observations with up to 3 cameras", "4 observations with up to 3 cameras"]


# -- FP8 and INT8 ------------------------------------------------------------------------------------------------------

HERE = torch.cuda.get_device_capability() if torch.cuda.is_available() else (0, 0)
EIGHT_BITS = [
    pytest.param("int8", marks=pytest.mark.skipif(HERE[0] in (10, 11), reason="this GPU refuses INT8")),
    pytest.param("fp8", marks=pytest.mark.skipif(HERE < (8, 9), reason="this GPU has no FP8")),
]


@pytest.fixture(scope="module", params=EIGHT_BITS)
def calibrated(request: pytest.FixtureRequest, published: Checkpoint, policies: dict[str, UnifiedPolicy]) -> Any:
    """(calibration, three observations of two, one and two cameras, noise, float32's actions, those of float32 with
    rounded sites, by whether the expert's are).
    """
    format, device = FORMATS[request.param], torch.device("cuda", 0)
    given: Any = {"count": 4, "target": 0.0, "methods": ("max",), "format": format}
    calibration = calibrate(published, Settings({"device": device}, "random-noise", **given))
    model: Any = reference_model(policies["exact"].backend)
    plan = calibration.plan(model.config, format.name)
    prompts = ["a", "put the red cup on the plate " * 3, "open it"]
    inputs = [
        policies["exact"].prepare(seen(policies["exact"], 3 + i, 2 - i % 2, one)) for i, one in enumerate(prompts)
    ]
    several, noise = Observation.stack(inputs), torch.randn(3, 50, 32, generator=torch.Generator().manual_seed(2))

    def actions() -> Tensor:
        rows = [model.sample(several.row(i).to(device), noise[i : i + 1].to(device), 10) for i in range(3)]
        return torch.cat(rows).cpu()

    exact, emulated = actions(), {}
    for expert in (True, False):
        used = {site: plan.scales[str(site)] for site in sites(model.config) if str(site) in plan.rounded}
        used = {site: scale for site, scale in used.items() if expert or site.part != "expert"}
        weights = RoundedWeights({site: plan.directions[str(site)] for site in used}, format)
        with rounded(model, used, weights):
            emulated[expert] = actions()
    return calibration, several, noise, exact, emulated


@pytest.fixture(scope="module", params=["auto", "portable"] if HERE == (9, 0) else ["auto"])
def in_eight_bits(request: pytest.FixtureRequest, published: Checkpoint, calibrated: Any) -> Any:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("TURBOPI_KERNELS", request.param)
        given: Any = {"precision": calibrated[0].numbers, "quantization": calibrated[0]}
        return UnifiedPolicy(published, backend="fused", **given).backend


def test_eight_bits_are_as_far_from_float32_as_their_emulation(in_eight_bits: Any, calibrated: Any) -> None:
    """Alone, and in a batch, whose expert is in bfloat16."""
    runner, (_, several, noise, exact, emulated) = in_eight_bits, calibrated
    alone = [runner.sample(several.row(i), noise[i : i + 1], 10).actions.clone() for i in (0, 1, 2, 2)]
    assert torch.equal(alone[2], alone.pop())
    for in_kernel, ours in ((True, torch.cat(alone)), (False, runner.sample(several, noise, 10).actions)):
        for row, right, expected in zip(ours, exact, emulated[in_kernel], strict=True):
            print(f"{relative_rms(row, right):.4f} of float32, emulated {relative_rms(expected, right):.4f}")
            assert is_as_far_off(row, right, expected)
    plan = runner.describe()[runner.precision]["plan"]
    assert plan["vision.fc1"] == plan["prefix.down"] == runner.precision
    assert plan["expert"].startswith("int8" if runner.precision == "int8" else "bf16")


@pytest.mark.parametrize("rows", [1, 3])
def test_damage_in_eight_bits_harms_no_other_observation(in_eight_bits: Any, calibrated: Any, rows: int) -> None:
    """NaN in what captured kernels round, then in one observation's state and image."""
    runner, several, noise = in_eight_bits, calibrated[1].each(lambda part: part[:rows]), calibrated[2][:rows]

    def finite(given: Observation) -> list[bool]:
        return runner.sample(given, noise, 10).actions.isfinite().flatten(1).all(1).tolist()

    right = runner.sample(several, noise, 10).actions.clone()
    vision, layers = runner._tower.layers, runner._prefix.layers
    matrices: list[Any] = [vision[3].out[0], layers[0].qkv, layers[2].out, layers[4].gate_up, layers[5].down]
    numbers = [vision[0].qkv[1], vision[1].fc1[1], vision[2].norm1[0], layers[1].norm2]
    for one in [*numbers, *(matrix.scale for matrix in matrices)]:
        before = one[3].clone()
        one[3] = torch.nan
        assert finite(several) == [False] * rows
        one[3] = before
    for name, at in (("images", (0, 1, 100, 30, 0)), ("state", (0, 2))):
        damaged = getattr(several, name).float().clone()
        damaged[at] = torch.nan
        assert finite(replace(several, **{name: damaged})) == [False, True, True][:rows], name
    assert torch.equal(runner.sample(several, noise, 10).actions, right)
