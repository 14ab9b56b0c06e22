"""The backends on a real GPU: openpi's numbers, determinism, buckets. Run by scripts/gpu_check."""

import dataclasses
import itertools
import time
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
import torch
from conditioned import BY_TOKEN, conditioned
from conftest import GOLDEN, golden_cases, golden_folder, golden_model
from test_engine import made_up, send

from turbopi import backends
from turbopi.config import ImageResize, PiKind
from turbopi.engine import forward
from turbopi.engine.call import StaticCall
from turbopi.engine.graph import Graph
from turbopi.engine.loops import EulerLoop
from turbopi.engine.plan import GraphKey, bucket
from turbopi.engine.runner import HostRow
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning
from turbopi.models.pi0.reference import FloatPrecision
from turbopi.preprocess.images import RESIZES, fitted
from turbopi.verify.check_golden import check_case

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU"),
    pytest.mark.filterwarnings("default"),  # Inductor warns of what it does
]
CASES = [path.parent.name for path in sorted(GOLDEN.glob("cases/*/inputs.npz"))]
GRAPHS = ["cuda_graph", "fused"]
PORTABLE = "fused, portable kernels"
MODES = [  # pytorch_compile takes minutes to compile them all; gpu_check runs it through scripts/check_golden
    (name, precision)
    for name in ("pytorch", *GRAPHS)  # tensorrt: test_tensorrt_gpu.py
    for precision in backends.precisions(name)
    if precision in ("bf16", "f32")  # FP8 needs a calibration: test_gpu_fp8.py
] + [(PORTABLE, "bf16")]


@pytest.fixture(autouse=True)
def cut_vision(monkeypatch: pytest.MonkeyPatch) -> None:
    """Vision of the golden models has two layers: it is cut behind the first, as the full one is behind the third."""
    monkeypatch.setattr(forward, "HEAD_LAYERS", 1)


@lru_cache
def backend(name: str, kind: PiKind, precision: FloatPrecision) -> backends.Backend:
    checkpoint = golden_folder().checkpoint(kind)
    device = torch.device("cuda", 0)
    with pytest.MonkeyPatch.context() as patched:
        if name == PORTABLE:
            patched.setenv("TURBOPI_KERNELS", "portable")
        return backends.create(
            "fused" if name == PORTABLE else name,
            checkpoint.config.planned_model,
            lambda to, mode: checkpoint.load(to, mode).state,
            device=device,
            precision=precision,
        )


@pytest.mark.parametrize(("name", "precision"), MODES)
@pytest.mark.parametrize("case", CASES)
def test_golden_cases_hold_on_the_gpu(name: str, precision: FloatPrecision, case: str) -> None:
    one = golden_cases()[case]
    comparisons = check_case(one, backend(name, one.kind, precision))
    assert {"v_t", "actions"} <= {c.tensor for c in comparisons}
    assert not [c for c in comparisons if c.ok is False]
    if precision == "bf16":
        for run in one.runs:
            exact, rounded = run.variants["torch_fp32"]["actions"], run.variants["torch_bf16"]["actions"]
            ours = next(c for c in comparisons if c.tensor == "actions" and c.num_steps == run.num_steps)
            assert ours.max <= 2 * float(np.abs(rounded - exact).max())


@pytest.mark.parametrize(("name", "precision"), MODES)
def test_repetition_is_bit_identical_even_behind_a_call_that_was_not_finite(
    name: str, precision: FloatPrecision
) -> None:
    case = golden_cases()["b_third_masked"]
    runner = backend(name, "pi05", precision)
    first = runner.sample(case.observation, case.noise, 10).actions
    for other in (case.noise, torch.full_like(case.noise, torch.nan), *[case.noise] * 3):
        runner.sample(case.observation, other, 10)
        assert torch.equal(runner.sample(case.observation, case.noise, 10).actions, first)


@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.parametrize("kind", ["pi05", "pi0"])
def test_every_prompt_length_in_a_bucket_is_right(name: str, kind: PiKind) -> None:
    """Long and short prompts in turn: what a longer one left in the cache must not be seen by a shorter one."""
    case = golden_cases()["a_three_cams" if kind == "pi05" else "p0_pi0_state"]
    reference, runner = backend("pytorch", kind, "f32"), backend(name, kind, "bf16")
    slots = case.observation.tokens.shape[1]
    tokens = torch.randint(1, 500, (1, slots), generator=torch.Generator().manual_seed(0))
    for length in (33, 48, 34, slots, 1, 17, 16, 47, 2):
        mask = (torch.arange(slots) < length)[None]
        observation = dataclasses.replace(case.observation, tokens=tokens, token_mask=mask)
        exact = reference.sample(observation, case.noise, 3).actions
        ours = runner.sample(observation, case.noise, 3).actions
        relative = (ours - exact).square().mean().sqrt() / exact.square().mean().sqrt()
        assert float(relative) < 0.012, length  # openpi's own at 3 steps: 0.0111 and 0.0061


@pytest.mark.parametrize("name", [*GRAPHS, PORTABLE])
@pytest.mark.parametrize("count", [2, 3, 4, 8])
def test_a_batch_equals_its_rows(name: str, count: int) -> None:
    """Within what sums in another order make of bfloat16: rows of other cameras and prompts, beside each other."""
    rows = [golden_cases()[case].observation for case in ("a_three_cams", "b_third_masked")]
    fields = [field.name for field in dataclasses.fields(Observation)]
    chosen = [rows[i % 2] for i in range(count)]
    batch = Observation(**{field: torch.cat([getattr(row, field) for row in chosen]) for field in fields})
    noise = torch.randn(count, 10, 32, generator=torch.Generator().manual_seed(1))
    runner, reference = backend(name, "pi05", "bf16"), backend("pytorch", "pi05", "f32")
    together = runner.sample(batch, noise, 3).actions
    assert torch.equal(runner.sample(batch, noise, 3).actions, together)
    for i, row in enumerate(chosen):
        alone = runner.sample(row, noise[i : i + 1], 3).actions[0]
        exact = reference.sample(row, noise[i : i + 1], 3).actions[0]

        def relative(x: torch.Tensor, y: torch.Tensor, size: torch.Tensor = exact) -> float:
            return float((x - y).norm() / size.norm())

        assert relative(together[i], exact) < 0.012, "as every prompt's own call: see above"
        assert relative(together[i], alone) < 0.012


@pytest.mark.parametrize("name", [*GRAPHS, PORTABLE])
def test_intermediates_of_a_batch(name: str) -> None:
    """Every step of four observations that run together, against float32."""
    rows = [golden_cases()[case].observation for case in ("a_three_cams", "b_third_masked")] * 2
    fields = [field.name for field in dataclasses.fields(Observation)]
    batch = Observation(**{field: torch.cat([getattr(row, field) for row in rows]) for field in fields})
    noise = torch.randn(4, 10, 32, generator=torch.Generator().manual_seed(1))
    ours = backend(name, "pi05", "bf16").intermediates(batch, noise, 10)
    exact = backend("pytorch", "pi05", "f32").intermediates(batch, noise, 10)
    for tensor in ("x_t", "v_t", "actions"):
        assert float((ours[tensor].cpu() - exact[tensor].cpu()).norm() / exact[tensor].norm()) < 0.012, tensor
    assert any("4 observations" in one for one in backend(name, "pi05", "bf16").describe()["batches"])


@pytest.mark.parametrize("name", GRAPHS)
def test_prefix_and_denoise_apart_equal_the_whole(name: str) -> None:
    case = golden_cases()["b_third_masked"]
    runner = backend(name, "pi05", "bf16")
    whole = runner.sample(case.observation, case.noise, 10).actions
    cache = runner.prefix(case.observation)
    for rows in (runner._cache.k, runner._cache.v):  # type: ignore[attr-defined]
        rows.fill_(torch.nan)  # as a backend has them that encoded nothing
    apart = runner.denoise(cache, case.noise, 10).cpu()
    assert float((whole - apart).abs().max()) < 0.02  # the bucket may differ, and so the order of summation


@pytest.mark.parametrize(("name", "precision"), MODES)
def test_stage_times_are_within_the_call(name: str, precision: FloatPrecision) -> None:
    case = golden_cases()["b_third_masked"]
    runner = backend(name, "pi05", precision)
    runner.sample(case.observation, case.noise, 10)
    start = time.perf_counter()
    sample = runner.sample(case.observation, case.noise, 10)
    call = (time.perf_counter() - start) * 1e3
    assert set(sample.stage_ms) == {"vision", "prefix", "denoise"}
    assert all(milliseconds > 0 for milliseconds in sample.stage_ms.values())
    assert sum(sample.stage_ms.values()) <= call * 1.02


@pytest.mark.parametrize("name", GRAPHS)
def test_vision_apart_and_the_rest_equal_one_graph_of_the_whole_call(name: str) -> None:
    """Bit for bit, whichever prompts and cameras came before, captured when needed and by warm-up."""
    checkpoint = golden_folder().checkpoint("pi05")
    runner: Any = backends.create(
        name,
        checkpoint.config.planned_model,
        lambda to, mode: checkpoint.load(to, mode).state,
        device=torch.device("cuda", 0),
        precision="bf16",
    )
    whole: dict[StaticCall, Graph] = {}

    def in_one(row: HostRow, noise: torch.Tensor) -> torch.Tensor:
        key = GraphKey("answer", 1, len(row.images), False, bucket(len(row.tokens)), EulerLoop(3, horizon))
        call = runner._graphs.entries[key].buffers
        if call not in whole:
            with pytest.MonkeyPatch.context() as patched:
                patched.setattr(forward, "HEAD_LAYERS", None)
                whole[call] = Graph(call.run, runner._pool, runner._stream)
            assert len(whole[call]._parts) == 1
        send(call.images, row.images)
        call.write_inputs(noise[0].numpy(), row.state, row.tokens)
        whole[call].replay()
        return call.actions.clone()

    horizon = checkpoint.config.model.action_horizon
    side = runner.config.vision.image_size
    runner.begin([np.zeros((side, side, 3), np.uint8)])
    assert [len(graph._parts) for graph, _ in runner._graphs.entries.values()] == [2], "vision's head, and its rest"
    for turn in range(2):
        for seed, (cameras, tokens) in enumerate([(2, 5), (3, 40), (2, 47), (1, 16), (2, 5), (0, 17), (3, 17)]):
            observation, _ = made_up("pi05", cameras, tokens, seed)
            noise = torch.randn(1, horizon, 32, generator=torch.Generator().manual_seed(seed))
            row = HostRow.of(observation, 0)
            ours = runner.begin(row.images).finish(row.tokens, row.state, noise[0].numpy(), 3).actions[0]
            assert ours.isfinite().all(), (turn, cameras, tokens)
            assert torch.equal(ours, in_one(row, noise)), (turn, cameras, tokens)
            runner.begin(row.images[:1])  # and given up
        if turn == 0:
            runner.warmup(made_up("pi05", 2, 5)[0], 3)


@pytest.mark.parametrize("way", RESIZES)
@pytest.mark.parametrize("name", GRAPHS)
def test_pictures_of_any_size_give_the_actions_of_pictures_resized_on_the_host(name: str, way: ImageResize) -> None:
    """Bit for bit, in whatever order sizes come, without a capture or an allocation that grows."""
    runner: Any = backend(name, "pi05", "bf16")
    side, rng = runner.config.vision.image_size, np.random.default_rng(0)
    floats = RESIZES[way].float_images
    observation, noise = made_up("pi05", 2, 20)
    if floats:
        observation = dataclasses.replace(observation, images=observation.images.float() / 127.5 - 1)
    runner.warmup(observation, 3, noise.shape[1])
    row, graphs = HostRow.of(observation, 0), len(runner._graphs.entries)
    sizes = ((480, 640), (37, 53), (side, side), (720, 1280), (480, 640))
    for first, second in itertools.pairwise((*sizes, *sizes)):
        camera_images = [rng.integers(0, 256, (*size, 3), dtype=np.uint8) for size in (first, second)]
        on_host = runner.begin([fitted(one, side, way) for one in camera_images])
        expected = on_host.finish(row.tokens, row.state, noise[0].numpy(), 3).actions
        found = runner.begin(camera_images, way).finish(row.tokens, row.state, noise[0].numpy(), 3)
        assert torch.equal(found.actions, expected), (first, second)
        assert all(milliseconds > 0 for milliseconds in found.stage_ms.values()), found.stage_ms
    assert len(runner._graphs.entries) == graphs


def test_time_in_which_the_device_waits_for_the_host_is_the_prefixs() -> None:
    runner: Any = backend("fused", "pi05", "bf16")
    observation, noise = made_up("pi05", 2, 5)
    row = HostRow.of(observation, 0)
    for wait in (0, 0.5):  # the first captures; other processes may use the GPU, too
        begun = runner.begin(row.images)
        time.sleep(wait)
        stage_ms = begun.finish(row.tokens, row.state, noise[0].numpy(), 3).stage_ms
    assert stage_ms["prefix"] > 400 > stage_ms["vision"]


def test_tf32_stays_out_of_the_oracle_whatever_the_caller_has_set() -> None:
    case, oracle = golden_cases()["b_third_masked"], backend("pytorch", "pi05", "f32")
    exact = oracle.sample(case.observation, case.noise, 3).actions
    before, x = torch.get_float32_matmul_precision(), torch.randn(512, 512, device="cuda")
    product = x @ x
    try:
        torch.set_float32_matmul_precision("high")
        assert not torch.equal(x @ x, product), "this GPU has no TF32: nothing is shown"
        assert torch.equal(oracle.sample(case.observation, case.noise, 3).actions, exact)
    finally:
        torch.set_float32_matmul_precision(before)


@pytest.mark.parametrize(("name", "precision"), [mode for mode in MODES if mode[0] in GRAPHS])
@pytest.mark.parametrize("kind", ["pi05", "pi0"])
@pytest.mark.parametrize("which", [*BY_TOKEN, "jacobian", "jacobian_and_held", "chosen_noise"])
def test_conditioned_calls_are_the_references(name: str, precision: FloatPrecision, kind: PiKind, which: str) -> None:
    """Plain calls beside them keep their bits."""
    runner: Any = backend(name, kind, precision)
    observation, noise = made_up(kind, 2, 19)
    requested = conditioned(which, 10, noise.shape[1], noise.shape[2])
    plain = runner.sample(observation, noise, 10).actions
    exact = golden_model(kind).sample(observation, noise, 10, conditioning=requested)
    found = runner.sample(observation, noise, 10, conditioning=requested).actions
    if precision == "f32":
        torch.testing.assert_close(found, exact, atol=5e-5, rtol=5e-5)
    else:
        reference = golden_model(kind, "bf16").sample(observation, noise, 10, conditioning=requested)
        assert 0 < rms(found - exact) <= 2 * rms(reference - exact)
    if requested.held is not None and requested.values is not None:
        np.testing.assert_array_equal(found[0].numpy()[requested.held], requested.values[requested.held])
    assert torch.equal(runner.sample(observation, noise, 10).actions, plain)


@dataclasses.dataclass(frozen=True)
class ConditionedRow:
    """One row of a batch, five steps.

    error  the reference's own in bfloat16, rms over draws of nearly the same noise: the true Jacobian multiplies each
           rounding, so that errors of single draws are 0.02 to 0.06 in one row
    """

    observation: Observation
    noise: torch.Tensor  # [1, 10, 32]
    requested: Conditioning | None
    exact: torch.Tensor  # [10, 32], in float32
    error: float

    @classmethod
    @lru_cache
    def of(cls, row: int, form: str | None) -> "ConditionedRow":
        observation = golden_cases()[("a_three_cams", "b_third_masked")[row % 2]].observation
        noise = torch.randn(1, 10, 32, generator=torch.Generator().manual_seed(100 + row))
        requested = None if form is None else conditioned(form, 5, 10, 32, row)

        def sample(precision: FloatPrecision, near: torch.Tensor) -> torch.Tensor:
            return golden_model("pi05", precision).sample(observation, near, 5, conditioning=requested)[0]

        errors = []
        for seed in range(6):
            jitter = torch.randn(noise.shape, generator=torch.Generator().manual_seed(seed))
            near = noise * (1 + 1e-4 * jitter)
            errors.append(rms(sample("bf16", near) - sample("f32", near)))
        return cls(observation, noise, requested, sample("f32", noise), float(np.sqrt(np.mean(np.square(errors)))))


@pytest.mark.parametrize("name", [*GRAPHS, PORTABLE])
@pytest.mark.parametrize("count", [4, 8])
@pytest.mark.parametrize("which", ["by token", "jacobian"])
def test_a_batch_of_conditioned_observations_equals_its_rows(name: str, count: int, which: str) -> None:
    """Rows of other cameras and prompts, some plain beside those with times, held actions and identity guidance."""
    forms = [None, *BY_TOKEN, "held"] if which == "by token" else ["jacobian", "jacobian_and_held"] * 4
    rows = [ConditionedRow.of(row, form) for row, form in enumerate(forms[:count])]
    fields = [field.name for field in dataclasses.fields(Observation)]
    batch = Observation(**{field: torch.cat([getattr(row.observation, field) for row in rows]) for field in fields})
    noise, requested = torch.cat([row.noise for row in rows]), [row.requested for row in rows]
    runner: Any = backend(name, "pi05", "bf16")
    plain = runner.sample(batch, noise, 5).actions
    together = runner.sample(batch, noise, 5, conditioning=requested).actions
    assert torch.equal(runner.sample(batch, noise, 5, conditioning=requested).actions, together)
    assert torch.equal(runner.sample(batch, noise, 5).actions, plain)
    errors, apart = [], []  # in units of the reference's own
    for row, found in zip(rows, together, strict=True):
        alone = runner.sample(row.observation, row.noise, 5, conditioning=row.requested).actions[0]
        errors.append(rms(found - row.exact) / row.error)
        apart.append(rms(found - alone) / row.error)
        if row.requested is not None and row.requested.held is not None and row.requested.values is not None:
            np.testing.assert_array_equal(found.numpy()[row.requested.held], row.requested.values[row.requested.held])
    assert np.max(errors) <= 3 and np.mean(np.square(errors)) <= 1.5**2, errors
    assert np.max(apart) <= 4 and np.mean(np.square(apart)) <= 2**2, apart
    loop = "by token" if which == "by token" else "guided by the Jacobian"
    assert any("observations" in reported and loop in reported for reported in runner.describe()["batches"])


@pytest.mark.parametrize("kind", ["pi05", "pi0"])
@pytest.mark.parametrize("which", ["held_and_identity", "staircase", "jacobian"])
def test_a_conditioned_batch_in_float32_is_the_references(kind: PiKind, which: str) -> None:
    runner: Any = backend("cuda_graph", kind, "f32")
    one, noise = made_up(kind, 2, 19)
    other, _ = made_up(kind, 1, 7, seed=1)
    both = Observation(**{field: torch.cat((getattr(one, field), getattr(other, field))) for field in vars(one)})
    requested = [conditioned(which, 5, 7, 32, seed) for seed in range(2)]
    exact = golden_model(kind).sample(both, noise.repeat(2, 1, 1), 5, conditioning=requested)
    found = runner.sample(both, noise.repeat(2, 1, 1), 5, conditioning=requested).actions
    torch.testing.assert_close(found, exact, atol=5e-5, rtol=5e-5)
    assert any(reported.startswith("2 observations") for reported in runner.describe()["batches"])


@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.parametrize("forms", [("held", "identity"), ("jacobian", "jacobian_and_held")])
def test_what_is_held_and_what_pulls_changes_without_a_new_capture(name: str, forms: tuple[str, str]) -> None:
    runner: Any = backend(name, "pi05", "bf16")
    observation, noise = made_up("pi05", 1, 7)
    alone = [runner.sample(observation, noise, 5, conditioning=conditioned(one, 5, 7, 32)).actions for one in forms]
    graphs = len(runner._graphs.entries)
    for which, first in [*zip(forms, alone, strict=True)] * 2:
        again = runner.sample(observation, noise, 5, conditioning=conditioned(which, 5, 7, 32)).actions
        assert torch.equal(again, first)
    assert not torch.equal(*alone) and len(runner._graphs.entries) == graphs


@pytest.mark.parametrize("which", ["held", "staircase", "identity"])
def test_conditioned_chunks_that_are_too_long_for_the_kernel_are_right_every_time(which: str) -> None:
    """Their norms read rows that the kernel before gathers."""
    runner: Any = backend("fused", "pi05", "bf16")
    observation, _ = made_up("pi05", 2, 19)
    noise = torch.randn(1, 60, 32, generator=torch.Generator().manual_seed(0))
    requested = conditioned(which, 5, 60, 32)
    exact = golden_model("pi05").sample(observation, noise, 5, conditioning=requested)
    reference = golden_model("pi05", "bf16").sample(observation, noise, 5, conditioning=requested)
    first = runner.sample(observation, noise, 5, conditioning=requested).actions
    assert rms(first - exact) <= 2 * rms(reference - exact)
    for _ in range(20):
        assert torch.equal(runner.sample(observation, noise, 5, conditioning=requested).actions, first)


def rms(x: torch.Tensor) -> float:
    return float(x.square().mean().sqrt())
