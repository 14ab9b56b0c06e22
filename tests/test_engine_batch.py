"""A batch in the engine: several observations' rows in the same products, each with what it gets alone."""

import itertools

import numpy as np
import pytest
import torch
from conftest import golden_cases, golden_model
from hypothesis import given
from hypothesis import strategies as st
from test_begin import OnCpu, on_cpu
from test_engine import send
from torch import Tensor

from turbopi.config import Kind
from turbopi.engine.batch import BatchBuffers, BatchLoop, BatchSize, PackedPrefix
from turbopi.engine.call import Images
from turbopi.engine.graph_cache import MOST_LOOPS
from turbopi.engine.loops import EulerLoop
from turbopi.engine.packing import TILE, most_tiles, pack_rows
from turbopi.engine.plan import split
from turbopi.engine.runner import HostRow
from turbopi.engine.weights import modulation, pack
from turbopi.kernels.interface import PairDenoiser
from turbopi.kernels.plain import PLAIN
from turbopi.kernels.sm90.denoise.plain import denoise_plain
from turbopi.models.observation import Observation
from turbopi.models.pi0.denoise import euler_step
from turbopi.models.pi0.reference import Trace
from turbopi.support.errors import ObservationError

CPU = torch.device("cpu")
COSTS = {1: 1, 2: 1.6, 4: 2.9, 8: 5.5, 16: 10.7}


@given(st.integers(1, 40))
def test_a_batch_is_split_into_calls_that_hold_it(count: int) -> None:
    calls = split(count, COSTS)
    assert {*calls} <= {*COSTS} and calls == sorted(calls, reverse=True)
    assert sum(calls) >= count > sum(calls[:-1]), "only the last call may have room left"


@pytest.mark.parametrize(
    ("count", "calls"), [(1, [1]), (3, [2, 1]), (5, [4, 1]), (6, [4, 2]), (7, [8]), (8, [8]), (15, [16]), (20, [16, 4])]
)
def test_few_too_many_run_apart_and_few_missing_are_left_empty(count: int, calls: list[int]) -> None:
    assert split(count, COSTS) == calls


def test_a_call_that_is_slower_than_its_observations_apart_is_never_made() -> None:
    assert split(3, {1: 1, 2: 2.2, 4: 3.2}) == [1, 1, 1]


@given(
    observations=st.lists(st.tuples(st.integers(0, 4), st.integers(0, 9)).filter(any), min_size=1, max_size=5),
    spare=st.integers(0, 40),
    empty=st.integers(0, 3),
    heads=st.sampled_from([1, 4, 8]),
)
def test_packed_rows(observations: list[tuple[int, int]], spare: int, empty: int, heads: int) -> None:
    per_image, batch = 4, len(observations) + empty
    prompts = [np.arange(1, tokens + 1) + 100 * i for i, (_, tokens) in enumerate(observations)]
    rows = sum(count * per_image + tokens for count, tokens in observations) + spare
    counts = [count for count, _ in observations]
    packed = pack_rows(counts, prompts, batch=batch, rows=rows, per_image=per_image, heads=heads)
    starts, lengths = packed.segments
    assert lengths.sum() == rows and (lengths[len(observations) : batch] == 0).all() and lengths[batch] == spare
    assert (starts[1:] == starts[:-1] + lengths[:-1]).all()
    seen = 0
    for start, length, count, prompt in zip(starts, lengths, counts, prompts, strict=False):
        own, camera_images = packed.source[start : start + length], count * per_image
        assert (own[:camera_images] == np.arange(seen, seen + camera_images)).all() and (
            -1 - own[camera_images:] == prompt
        ).all()
        assert (packed.positions[start : start + length] == np.arange(length)).all()
        seen += camera_images
    assert packed.tiles.shape == (most_tiles(rows, batch, heads), 4)
    queries = np.zeros(rows * heads, int)  # each row of queries is in one tile, and sees its own segment
    begins = [int(first) for first, end, _, _ in packed.tiles[::2] if first < end]
    assert {start * heads for start, length in packed.segments.T if length} <= set(begins), "a block may take two"
    for first, end, key, keys in packed.tiles:
        for query in range(first, min(first + TILE, end)):
            queries[query] += 1
            assert key <= query // heads < key + keys and [key, keys] in packed.segments.T.tolist()
    assert (queries == 1).all()


@pytest.fixture(params=["pi05", "pi0"])
def kind(request: pytest.FixtureRequest) -> Kind:
    return request.param


def observations(kind: Kind, cameras: list[int], tokens: list[int], horizon: int) -> tuple[Observation, torch.Tensor]:
    config = golden_model(kind).config
    g = torch.Generator().manual_seed(0)
    width, size, count = config.max_prompt_tokens, config.vision.image_size, len(cameras)
    made = Observation(
        images=torch.randint(0, 256, (count, 3, size, size, 3), generator=g, dtype=torch.uint8),
        image_mask=torch.arange(3) < torch.tensor(cameras)[:, None],
        tokens=torch.randint(1, config.vocab_size, (count, width), generator=g),
        token_mask=torch.arange(width) < torch.tensor(tokens)[:, None],
        state=torch.randn(count, config.action_dim, generator=g),
    )
    return made, torch.randn(count, horizon, config.action_dim, generator=g)


def batched(
    kind: Kind,
    observation: Observation,
    noise: torch.Tensor,
    batch: int,
    slots: int,
    steps: int,
    by: PairDenoiser | None = None,
) -> BatchLoop:
    """A batched call that has run."""
    model = golden_model(kind)
    weights = pack(model.config, dict(model.state_dict()))
    rows = [HostRow.of(observation, row) for row in range(observation.batch_size)]
    shown = [image for row in rows for image in row.images]
    camera_images = Images(model.config, weights, PLAIN, len(shown), False, 0)
    size = BatchSize(batch, len(shown))
    buffers = BatchBuffers(model.config, weights, PLAIN, size, camera_images, slots + 16)
    prefix = PackedPrefix(buffers, slots)
    prefix.write([len(row.images) for row in rows], [row.tokens for row in rows])
    table = modulation(model.config, weights.conditioning, steps)
    loop = BatchLoop(buffers, EulerLoop(steps, noise.shape[1]), by or weights, table)
    loop.write(noise.numpy(), observation.state.numpy())
    send(camera_images, shown)
    camera_images.run()
    prefix.run()
    loop.run()
    return loop


@pytest.mark.slow
def test_each_observation_gets_what_it_gets_alone(kind: Kind) -> None:
    """Other cameras, prompts of other lengths, one without an image, one without a prompt, and an empty place."""
    observation, noise = observations(kind, [2, 0, 3, 1], [7, 12, 3, 0], horizon=5)
    ours = batched(kind, observation, noise, batch=5, slots=32, steps=3)
    exact = golden_model(kind).sample(observation, noise, 3)
    torch.testing.assert_close(ours.actions[:4], exact, atol=2e-5, rtol=2e-5)
    assert bool(ours.actions.isfinite().all()), "an empty place's numbers stay numbers"


class Pairs:
    """In place of the kernel that denoises two observations: each alone, by the plain loop."""

    def __init__(self, kind: Kind, steps: int) -> None:
        model = golden_model(kind)
        self._config, self._weights = model.config, pack(model.config, dict(model.state_dict()))
        table = modulation(self._config, self._weights.conditioning, steps)
        assert table is not None
        self._table = table

    def launch_pair(self, noise: Tensor, k: Tensor, v: Tensor, segments: Tensor, x_t: Tensor, v_t: Tensor) -> None:
        for row, (start, end) in enumerate(itertools.pairwise(segments.tolist())):
            x_t[:, row], v_t[:, row] = denoise_plain(
                self._config,
                self._weights.expert,
                self._weights.small,
                self._table,
                noise[row],
                k[:, start:],
                v[:, start:],
                end - start,
            )


@pytest.mark.parametrize("cameras", [[2, 3], [0, 1], [2]])
def test_two_denoised_by_a_kernel_of_their_own_get_what_each_gets_alone(cameras: list[int]) -> None:
    observation, noise = observations("pi05", cameras, [7, 12][: len(cameras)], horizon=5)
    ours = batched("pi05", observation, noise, batch=2, slots=32, steps=3, by=Pairs("pi05", 3))
    exact = golden_model("pi05").sample(observation, noise, 3)
    torch.testing.assert_close(ours.actions[: len(exact)], exact, atol=2e-5, rtol=2e-5)
    assert bool(ours.actions.isfinite().all())
    for row in range(len(exact)):
        x_t, v_t = ours.x_t[:, row], ours.v_t[:, row]
        torch.testing.assert_close(x_t[-1], exact[row], atol=2e-5, rtol=2e-5)
        torch.testing.assert_close(x_t[1:], euler_step(x_t[:-1], v_t, 3))


def test_another_observation_beside_it_changes_nothing(kind: Kind) -> None:
    observation, noise = observations(kind, [2, 1], [7, 12], horizon=5)
    before = batched(kind, observation, noise, batch=2, slots=32, steps=2).actions.clone()
    observation.tokens[1] += 1
    noise[1] *= 2
    after = batched(kind, observation, noise, batch=2, slots=32, steps=2).actions
    assert torch.equal(before[0], after[0]) and not torch.equal(before[1], after[1])


class TestBackend:
    """`cuda_graph` without its graphs, over whole batches."""

    @pytest.fixture
    def backend(self) -> OnCpu:
        return on_cpu()

    @pytest.mark.slow
    def test_any_number_of_observations(self, backend: OnCpu) -> None:
        made, noise = observations("pi05", [2, 0, 3, 1, 2, 2, 1], [7, 12, 3, 1, 5, 5, 9], horizon=5)
        exact = golden_model("pi05").sample(made, noise, 2)
        torch.testing.assert_close(backend.sample(made, noise, 2).actions, exact, atol=2e-5, rtol=2e-5)
        assert backend.describe()["batches"] == ["8 observations with 16 images, H=5, 2 steps"]

    def test_a_call_of_more_pictures_than_before(self, backend: OnCpu) -> None:
        """Other buffers, and the first ones go on."""
        for cameras in ([1, 1], [2, 3], [1, 1]):
            made, noise = observations("pi05", cameras, [7, 12], horizon=5)
            exact = golden_model("pi05").sample(made, noise, 2)
            torch.testing.assert_close(backend.sample(made, noise, 2).actions, exact, atol=2e-5, rtol=2e-5)

    @pytest.mark.parametrize("name", ["a_three_cams", "b_third_masked", "p0_pi0_state"])
    def test_intermediates_of_golden_cases(self, name: str) -> None:
        """Two golden observations with unequal masks, through one batched call."""
        case = golden_cases()[name]
        made, noise = case.observation, case.noise
        if made.batch_size == 1:  # its twin has a camera less
            twice = {name: value.repeat(2, *[1] * (value.dim() - 1)) for name, value in vars(made).items()}
            made, noise = Observation(**twice), noise.repeat(2, 1, 1)
            made.image_mask[1, 0] = False
        backend, trace = on_cpu(case.kind), Trace()
        ours = backend.intermediates(made, noise, 10)
        exact = golden_model(case.kind).sample(made, noise, 10, compact=False, trace=trace)
        for name in ("x_t", "v_t"):
            torch.testing.assert_close(ours[name], trace[name], atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(ours["actions"], exact, atol=1e-4, rtol=1e-4)
        valid = torch.cat((made.image_mask.repeat_interleave(backend.config.vision.num_tokens, 1), made.token_mask), 1)
        for name in ("kv_k", "kv_v"):
            theirs = trace[name] * valid[None, :, :, None, None]
            torch.testing.assert_close(ours[name], theirs.view_as(ours[name]), atol=1e-4, rtol=1e-4)
        assert len(backend.describe()["batches"]) == 1

    def test_one_observation_is_the_runners_own_call(self, backend: OnCpu) -> None:
        made, noise = observations("pi05", [2], [7], horizon=5)
        trace = backend.intermediates(made, noise, 2)
        assert torch.equal(trace["actions"], backend.sample(made, noise, 2).actions)
        assert backend.describe()["batches"] == []

    @pytest.mark.slow
    def test_strict_takes_what_is_captured(self, backend: OnCpu) -> None:
        backend.strict = True
        four, noise = observations("pi05", [2, 2, 2, 2], [7, 12, 3, 1], horizon=5)
        one = Observation(**{name: value[:1] for name, value in vars(four).items()})
        backend.warmup(one, 2, 5)
        exact = backend.sample(four, noise, 2).actions  # one by one
        assert backend.describe()["batches"] == []
        backend.warmup_batches(one, 2, 5, [4])
        reported = len(backend.reported)
        torch.testing.assert_close(backend.sample(four, noise, 2).actions, exact, atol=2e-5, rtol=2e-5)
        assert backend.reported[reported:] == ["run", "run", "run"], "vision, prefix and denoising of all four"
        with pytest.raises(ObservationError, match=r"5 observations at once.*policy\.warmup\(batches=5\)"):
            backend.sample(*observations("pi05", [2] * 5, [3] * 5, horizon=5), 2)
        with pytest.raises(ObservationError, match=r"4 observations with 12 images"):
            backend.sample(*observations("pi05", [3] * 4, [3] * 4, horizon=5), 2)

    def test_a_forgotten_loops_batches_go_with_it(self, backend: OnCpu) -> None:
        made, noise = observations("pi05", [1, 1], [7, 12], horizon=5)
        for steps in range(1, 12):
            backend.sample(made, noise, steps)
        assert len(backend.describe()["batches"]) == MOST_LOOPS
