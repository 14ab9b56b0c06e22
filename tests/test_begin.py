"""Vision starts while the host still tokenises: the order, the same actions, and no harm from what goes wrong then."""

import dataclasses
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from conftest import golden_model
from policy_helpers import policy_on
from test_engine import answer, made_up, shape_of, static_call

from turbopi import UnifiedPolicy
from turbopi.backends.cuda_graph import CudaGraphBackend
from turbopi.checkpoint import random_checkpoint
from turbopi.config import Kind
from turbopi.engine.graph import HEAD
from turbopi.engine.runner import HostRow
from turbopi.kernels.interface import Ops
from turbopi.kernels.plain import PLAIN
from turbopi.support.errors import BackendError, ObservationError

pytestmark = pytest.mark.usefixtures("two_layers")

CPU = torch.device("cpu")


class Ran:
    """A graph's interface around a function that runs anew in every launch, and tells its name."""

    def __init__(
        self, run: Callable[[Any], None], after: "Ran | None", tell: Callable[[str], None], at_once: bool = True
    ) -> None:
        self._run, self._tell, self._name = run, tell, run.__name__
        self._stages: list[str] = []
        self._before = after
        if at_once:  # as a capture does
            run(lambda stage: None)

    def launch(self, *before: Callable[[], None]) -> None:
        left = iter(before)

        def mark(stage: str) -> None:
            if stage == HEAD:
                next(left, lambda: None)()
            else:
                self._stages.append(stage)

        self._stages.clear()
        self._tell(self._name)
        mark(HEAD)
        self._run(mark)
        assert next(left, None) is None, "each is done before a graph of its own"

    replay = launch

    def stage_ms(self) -> dict[str, float]:
        before = {} if self._before is None else self._before.stage_ms()
        return before | dict.fromkeys(self._stages, 1.0)


class OnCpu(CudaGraphBackend):
    """`cuda_graph` without the graphs. `told` has what was launched, in order; "run" is vision."""

    def _make_ops(self) -> Ops:
        self.reported: list[str] = []
        return PLAIN

    def _capture(self, run: Any, after: Any, like: Any = None) -> Any:
        return Ran(run, after, self.reported.append)


class Unrun(OnCpu):
    """Whose captures don't run what they capture, for tests of which there are."""

    def _capture(self, run: Any, after: Any, like: Any = None) -> Any:
        return Ran(run, after, self.reported.append, at_once=False)


def on_cpu(kind: Kind = "pi05", cls: type[OnCpu] = OnCpu) -> OnCpu:
    model = golden_model(kind)
    return cls(model.config, lambda device, precision: dict(model.state_dict()), device=CPU, precision="f32")


@pytest.fixture(scope="module")
def reference() -> UnifiedPolicy:
    return UnifiedPolicy(random_checkpoint("pi05_tiny"), backend="pytorch", device="cpu", precision="f32")


@pytest.fixture
def policy(reference: UnifiedPolicy, monkeypatch: pytest.MonkeyPatch) -> UnifiedPolicy:
    policy = policy_on(OnCpu, random_checkpoint("pi05_tiny"), num_denoising_steps=2)
    encoder = policy.pipeline.tokenizer.encoder

    class Telling:
        def encode(self, text: str, *, add_bos: bool) -> Any:
            policy.backend.reported.append("tokenise")  # type: ignore[attr-defined]
            if "unspeakable" in text:
                raise ObservationError("no words for it")
            return encoder.encode(text, add_bos=add_bos)

    monkeypatch.setattr(policy.pipeline.tokenizer, "encoder", Telling())
    return policy


def test_vision_is_launched_before_the_prompt_is_read(policy: UnifiedPolicy) -> None:
    observation = policy.example_observation()
    policy.infer(observation, seed=0)
    reported = policy.backend.reported  # type: ignore[attr-defined]
    reported.clear()
    policy.infer(observation, seed=0)
    assert reported == ["run", "tokenise", "answer"]


def test_actions_are_the_references(policy: UnifiedPolicy, reference: UnifiedPolicy) -> None:
    for seed, prompt in enumerate(["pick", "pick up the black bowl and place it on the plate " * 3, "put it down"]):
        observation = {**policy.example_observation(seed), "prompt": prompt}
        result = policy.infer(observation, seed=seed)
        expected = reference.infer(observation, seed=seed, num_steps=2)["actions"]
        np.testing.assert_allclose(result["actions"], expected, rtol=0, atol=2e-5)
        timing = result["policy_timing"]
        assert {"vision_ms", "prefix_ms", "denoise_ms"} <= timing.keys()
        parts = timing["preprocess_ms"] + timing["queue_ms"] + timing["infer_ms"] + timing["postprocess_ms"]
        assert parts == pytest.approx(timing["total_ms"], rel=1e-6)


@pytest.mark.slow
def test_a_batch_equals_its_observations(policy: UnifiedPolicy) -> None:
    observations = [policy.example_observation(seed) for seed in range(3)]
    alone = [policy.infer(observation, seed=seed)["actions"] for seed, observation in enumerate(observations)]
    together = policy.infer_batch(observations, seed=0)
    for one, actions in zip(together, alone, strict=True):
        np.testing.assert_allclose(one["actions"], actions, atol=1e-4)  # sums in another order


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "arguments"),
    [
        ({"prompt": "the unspeakable"}, {"seed": 1}),
        ({"observation/state": np.full(8, 1e300)}, {"seed": 1}),
        ({}, {"noise": np.zeros((2, 2), np.float32)}),
    ],
)
def test_what_goes_wrong_behind_vision_leaves_the_next_call_right(
    policy: UnifiedPolicy, wrong: dict[str, Any], arguments: dict[str, Any]
) -> None:
    good, other = policy.example_observation(0), policy.example_observation(1)
    expected = policy.infer(good, seed=0)["actions"]
    policy.backend.reported.clear()  # type: ignore[attr-defined]
    with pytest.raises(ObservationError):
        policy.infer({**other, **wrong}, **arguments)
    assert policy.backend.reported[0] == "run"  # type: ignore[attr-defined]
    assert "answer" not in policy.backend.reported  # type: ignore[attr-defined]
    np.testing.assert_array_equal(policy.infer(good, seed=0)["actions"], expected)


@pytest.mark.slow
def test_calls_from_several_threads_get_their_own_answers(policy: UnifiedPolicy) -> None:
    observations = [policy.example_observation(seed) for seed in range(4)]
    expected = [policy.infer(observation, seed=seed)["actions"] for seed, observation in enumerate(observations)]
    wrong: list[int] = []

    def ask(i: int) -> None:
        for _ in range(5):
            if not np.array_equal(policy.infer(observations[i], seed=i)["actions"], expected[i]):
                wrong.append(i)

    threads = [threading.Thread(target=ask, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pi05", "pi0"])
@pytest.mark.parametrize("warm", [False, True])
def test_every_bucket_and_number_of_cameras_in_turn_equals_a_call_of_its_own(kind: Kind, warm: bool) -> None:
    backend = on_cpu(kind)
    if warm:
        backend.warmup(made_up(kind, 2, 5)[0], 2)
    for seed, (cameras, tokens) in enumerate([(2, 5), (3, 40), (2, 47), (0, 5), (1, 16), (2, 5), (3, 17), (2, 33)]):
        observation, noise = made_up(kind, cameras, tokens, seed)
        expected = answer(static_call(kind, shape_of(observation, noise, 2)), observation, noise)
        row = HostRow.of(observation, 0)
        ours = backend.begin(row.images).finish(row.tokens, row.state, noise[0].numpy(), 2)
        assert torch.equal(ours.actions[0], expected), (cameras, tokens)
        assert torch.equal(backend.sample(observation, noise, 2).actions[0], expected), (cameras, tokens)


def test_float_pictures_and_whole_numbers_in_turn() -> None:
    backend = on_cpu()
    observation, noise = made_up("pi05", 2, 5)
    floats = dataclasses.replace(observation, images=observation.images.float() / 255 * 2 - 1.003)
    for one in (observation, floats, observation, floats):
        row = HostRow.of(one, 0)
        ours = backend.begin(row.images).finish(row.tokens, row.state, noise[0].numpy(), 2)
        expected = answer(static_call("pi05", shape_of(one, noise, 2)), one, noise)
        assert torch.equal(ours.actions[0], expected)


def test_calls_share_the_pictures_of_as_many_cameras() -> None:
    backend = on_cpu()
    for tokens in (5, 20, 40):
        observation, noise = made_up("pi05", 2, tokens)
        backend.sample(observation, noise, 1)
    buffers = [one.buffers for one in backend._graphs.entries.values()]
    assert len(buffers) == 1 + 3, "vision, and a call for each bucket"
    assert len({one.embs.data_ptr() for one in buffers}) == 1


def test_one_observation_at_a_time() -> None:
    backend = on_cpu()
    observation, noise = made_up("pi05", 2, 5)
    row = HostRow.of(observation, 0)
    rest = (row.tokens, row.state, noise[0].numpy(), 1)
    first, second = backend.begin(row.images), backend.begin(row.images)
    with pytest.raises(BackendError, match="begun another"):
        first.finish(*rest)
    actions = second.finish(*rest).actions
    with pytest.raises(BackendError, match="has finished this observation"):
        second.finish(*rest)
    assert torch.equal(backend.sample(observation, noise, 1).actions, actions)


def test_one_batch_at_a_time() -> None:
    """Else the first one's prompts would be answered by the second one's images."""
    backend, made = on_cpu(), [made_up("pi05", 2, 5, seed) for seed in (0, 1)]
    rows, noise = [HostRow.of(one, 0) for one, _ in made], np.concatenate([noise.numpy() for _, noise in made])
    camera_images, rest = (
        [row.images for row in rows],
        ([row.tokens for row in rows], np.stack([r.state for r in rows])),
    )
    actions = backend.begin_batch(camera_images).finish(*rest, noise, 1).actions
    first, second = backend.begin_batch(camera_images[::-1]), backend.begin_batch(camera_images)
    with pytest.raises(BackendError, match="begun another"):
        first.finish(*rest, noise, 1)
    assert torch.equal(second.finish(*rest, noise, 1).actions, actions)
    with pytest.raises(BackendError, match="has finished this observation"):
        second.finish(*rest, noise, 1)
    batch, alone = backend.begin_batch(camera_images), backend.begin(camera_images[0])
    with pytest.raises(BackendError, match="begun another"):
        batch.finish(*rest, noise, 1)
    torch.testing.assert_close(
        alone.finish(rows[0].tokens, rows[0].state, noise[0], 1).actions[0], actions[0], rtol=0, atol=1e-4
    )


def test_a_begun_observation_is_over_when_the_next_ones_pictures_are_wrong() -> None:
    backend = on_cpu()
    observation, noise = made_up("pi05", 2, 5)
    row = HostRow.of(observation, 0)
    begun = backend.begin(row.images)
    with pytest.raises(ValueError, match="broadcast"):
        backend.begin([row.images[1], row.images[1][:3]])
    with pytest.raises(BackendError, match="begun another"):
        begun.finish(row.tokens, row.state, noise[0].numpy(), 1)


@pytest.mark.parametrize("part", ["run", "answer"])
def test_a_backend_may_explain_why_the_gpu_failed_in_either_part(part: str) -> None:
    class Knowing(OnCpu):
        def _explain(self, error: RuntimeError) -> None:
            raise BackendError("a kernel trapped") from error

    backend = on_cpu("pi05", Knowing)
    observation, noise = made_up("pi05", 2, 5)
    backend.sample(observation, noise, 1)

    def fail(name: str) -> None:
        if name == part:
            raise RuntimeError("CUDA error: unspecified launch failure")

    for graph, _ in backend._graphs.entries.values():
        graph._tell = fail  # type: ignore[attr-defined]
    with pytest.raises(BackendError, match="a kernel trapped"):
        backend.sample(observation, noise, 1)


def test_too_many_cameras_or_tokens_or_none_at_all_are_refused() -> None:
    backend = on_cpu()
    observation, noise = made_up("pi05", 1, 5)
    row = HostRow.of(observation, 0)
    with pytest.raises(ObservationError, match="up to 4 cameras, this observation has 5"):
        backend.begin(row.images * 5)
    most = backend.config.max_prompt_tokens
    with pytest.raises(ObservationError, match=f"{most} prompt tokens, this observation has 1 and {most + 1}"):
        backend.begin(row.images).finish(np.ones(most + 1, np.int64), row.state, noise[0].numpy(), 1)
    with pytest.raises(ObservationError, match="this observation has 0 and 0"):
        backend.begin([]).finish(row.tokens[:0], row.state, noise[0].numpy(), 1)
    assert backend.sample(observation, noise, 1).actions.isfinite().all()
