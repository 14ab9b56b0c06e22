"""The tool that made the small policy: it trains the model that is run, and exports what it trained."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from turbopi.backends.pytorch import reference_model
from turbopi.models.observation import Observation
from turbopi.models.pi0 import denoise
from turbopi.models.pi0.reference import Pi0Model
from turbopi.policy.policy import UnifiedPolicy
from turbopi.policy.shipped import SMALL_POLICY
from turbopi.sim import SimulatorUnavailable, create
from turbopi.sim.chase import Chase
from turbopi_lab.small_policy import chase
from turbopi_lab.small_policy.actor import Actor
from turbopi_lab.small_policy.collect import REPLAN, Player
from turbopi_lab.small_policy.episodes import HORIZON, Episode, Frame, load_tapes, save_tapes
from turbopi_lab.small_policy.expert import Expert, Sight, rotation_between
from turbopi_lab.small_policy.export import CONFIG, export
from turbopi_lab.small_policy.forward import (
    Guide,
    draw_delays,
    draw_times,
    flow_loss,
    held_actions,
    mixed,
    time_embedding,
    velocity,
)
from turbopi_lab.small_policy.scenes import INSTRUCTIONS, OTHER_PROMPT, TRAINING_STATES, VALIDATION_STATES, Setting
from turbopi_lab.small_policy.start import fresh_model
from turbopi_lab.small_policy.train import Settings, Trainer, prompt_table, toy_memory

pytestmark = pytest.mark.slow

STATS = SMALL_POLICY / "assets" / "turbopi" / "libero_spatial" / "norm_stats.json"


def inputs(batch: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rng = np.random.default_rng(0)
    images = torch.from_numpy(rng.integers(0, 256, (batch, 2, 224, 224, 3), np.uint8))
    tokens, masks = prompt_table()
    return images, tokens[[2, 4, 0][:batch]], masks[[2, 4, 0][:batch]], torch.randn(batch, HORIZON, 32)


def lively_model() -> Pi0Model:
    """Fresh weights, but none of those that start at zero."""
    model = fresh_model(CONFIG.planned_model, 0).requires_grad_(False)
    for name, parameter in model.named_parameters():
        if name.startswith("action_out_proj") or ".dense." in name:
            parameter.normal_(0, 0.1)
    return model


def reference_velocity(model: Pi0Model, observation: Observation, x_t: Tensor, t: float) -> Tensor:
    cache = model.prefix(observation)
    rope = denoise.suffix_rope(cache, HORIZON, model.config.expert.head_dim, model.config.rope_base)
    mask = denoise.suffix_mask(cache, HORIZON, False)
    cond = model.time_condition(denoise.time_embedding(np.array([t], np.float32), model.config.expert.width))
    return model.velocity(x_t, cache.state, cond, cache.k, cache.v, rope, mask)[1]


def test_the_training_forward_is_the_reference_and_so_is_each_repeated_draw() -> None:
    torch.manual_seed(0)
    model, (images, tokens, masks, x_t) = lively_model(), inputs(3)
    observation = Observation(images, torch.ones(3, 2, dtype=torch.bool), tokens, masks, torch.zeros(3, 32))
    expected = reference_velocity(model, observation, x_t, 0.7)
    assert expected.std() > 0.1
    found, hidden = velocity(model, images, tokens, masks, x_t, torch.full((3,), 0.7))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-4)
    assert hidden.shape == (3, 512 + tokens.shape[1], CONFIG.planned_model.vlm.width)
    others = torch.randn_like(x_t)
    both = torch.stack((x_t, others), dim=1).flatten(0, 1)
    times = torch.tensor([0.7, 0.2]).repeat(3)
    repeated, _ = velocity(model, images, tokens, masks, both, times)
    torch.testing.assert_close(repeated[::2], expected, rtol=0, atol=1e-4)
    torch.testing.assert_close(repeated[1::2], reference_velocity(model, observation, others, 0.2), rtol=0, atol=1e-4)


def test_held_actions_are_at_time_zero_as_in_the_reference() -> None:
    """And what is held is seen by the others: a row without any held action, in the same batch, is an ordinary one."""
    torch.manual_seed(0)
    model, (images, tokens, masks, x_t) = lively_model(), inputs(3)
    observation = Observation(images, torch.ones(3, 2, dtype=torch.bool), tokens, masks, torch.zeros(3, 32))
    held = held_actions(torch.tensor([4, 0, 4]), HORIZON)
    found, _ = velocity(model, images, tokens, masks, x_t, torch.full((3,), 0.7), held=held)
    torch.testing.assert_close(found[1], reference_velocity(model, observation, x_t, 0.7)[1], rtol=0, atol=1e-4)
    cache = model.prefix(observation)
    rope = denoise.suffix_rope(cache, HORIZON, model.config.expert.head_dim, model.config.rope_base)
    times = np.where(held[0].numpy(), 0.0, 0.7).astype(np.float32)
    cond = model.time_condition(denoise.time_embedding(times, model.config.expert.width))[None]  # [1, H, E]
    mask = denoise.suffix_mask(cache, HORIZON, False)
    expected = model.velocity(x_t, cache.state, cond, cache.k, cache.v, rope, mask)[1]
    torch.testing.assert_close(found[[0, 2]], expected[[0, 2]], rtol=0, atol=1e-4)
    assert (found[0] - reference_velocity(model, observation, x_t, 0.7)[0]).abs().max() > 0.01


def test_held_actions_are_clean_and_out_of_the_loss() -> None:
    torch.manual_seed(0)
    actions, noise, t = torch.randn(4, 16, 3), torch.randn(4, 16, 3), torch.tensor([0.2, 0.5, 0.8, 1.0])
    delays = torch.tensor([0, 1, 6, 3])
    held = held_actions(delays, 16)
    assert held.sum(1).tolist() == delays.tolist() and held[2, :6].all() and not held[2, 6:].any()
    x = mixed(actions, noise, t, held)
    torch.testing.assert_close(x[held], actions[held], rtol=0, atol=0)
    torch.testing.assert_close(x[~held], mixed(actions, noise, t)[~held], rtol=0, atol=0)
    predicted, weights = torch.randn(4, 16, 3, requires_grad=True), torch.ones(3)
    loss = flow_loss(predicted, noise - actions, weights, held)
    loss.backward()  # type: ignore[no-untyped-call]
    assert predicted.grad is not None
    assert not predicted.grad[held].any() and predicted.grad[~held].all()
    assert loss.item() == pytest.approx(float((predicted.detach() - noise + actions)[~held].square().mean()))


def test_delays_are_drawn_evenly_and_a_trainer_without_them_holds_nothing(trainer: Trainer, monkeypatch: Any) -> None:
    leads = torch.tensor([0, 4]).repeat_interleave(7000)
    drawn = draw_delays(leads, 6, torch.Generator().manual_seed(0))
    assert torch.bincount(drawn[:7000], minlength=7).min() > 850 and drawn.max() == 6
    assert torch.bincount(drawn[7000:], minlength=7)[4:].min() > 2100 and drawn[7000:].min() == 4
    seen: list[Tensor | None] = []

    def noting(model: Any, *arguments: Any) -> Any:
        seen.append(arguments[6])
        return velocity(model, *arguments)

    monkeypatch.setattr("turbopi_lab.small_policy.train.velocity", noting)
    batch = toy_memory(2, trainer.device).batch(torch.arange(2))
    trainer.losses(batch)
    monkeypatch.setattr(trainer, "settings", dataclasses.replace(trainer.settings, max_delay=6))
    losses = trainer.losses(batch)
    assert seen[0] is None and seen[1] is not None and seen[1].shape == (4, HORIZON)
    assert torch.isfinite(losses["flow"])


def test_the_dynamic_tasks_frames_begin_with_what_is_on_its_way() -> None:
    frames = chase.demonstrations(400, seed=0, at_once=8)
    assert set(frames.delays.tolist()) == set(range(chase.MOST_DELAY + 1))
    assert frames.chunks.norm(dim=-1).max() < 1.01
    turned = frames.draw(64)
    assert turned.chunks.shape == (64, chase.HORIZON, 2)
    rows = np.random.default_rng(0).integers(0, 99, 3)
    world = Chase.start([np.random.default_rng(row) for row in rows])
    places = torch.from_numpy(np.stack((world.target, world.before[:, 0], world.tip), axis=1)).float()
    camera_images = chase.Frames(places, torch.zeros(3, 1, 2), torch.zeros(3)).camera_images(48)
    as_drawn = torch.from_numpy(world.draw(48)).float() / 255 * 2 - 1
    torch.testing.assert_close(camera_images, as_drawn, rtol=0, atol=0.6 / 255 * 2)


def test_the_time_embedding_is_the_models() -> None:
    times = np.array([0.001, 0.3, 1.0], np.float32)
    torch.testing.assert_close(
        time_embedding(torch.from_numpy(times), 128), denoise.time_embedding(times, 128), rtol=0, atol=1e-6
    )


def test_times_are_beta_distributed() -> None:
    times = draw_times(200_000, "cpu", torch.Generator().manual_seed(0))
    assert times.min() >= 0.001
    assert times.max() <= 1
    unscaled = (times - 0.001) / 0.999
    assert unscaled.mean().item() == pytest.approx(1.5 / 2.5, abs=0.003)  # Beta(a, 1): a / (a + 1)
    assert unscaled.var().item() == pytest.approx(1.5 / (2.5**2 * 3.5), abs=0.002)


def test_the_loss_weighs_dimensions() -> None:
    weights = torch.tensor([1.0, 0.0, 3.0])
    error = torch.tensor([[[2.0, 100.0, 1.0]]])
    assert flow_loss(error, torch.zeros_like(error), weights).item() == pytest.approx((4 + 3) / 4)


@pytest.fixture(scope="module")
def trainer(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    folder = tmp_path_factory.mktemp("run")
    settings = Settings(folder, STATS, device="cpu", compile=False, batch=4, repeats=2, warmup_steps=1)
    return Trainer(dataclasses.replace(settings, learning_rate=3e-3))


def test_a_few_steps_on_a_few_frames_lower_the_loss_and_the_export_is_what_was_trained(
    trainer: Trainer, tmp_path: Path
) -> None:
    memory = toy_memory(2, trainer.device)
    batch = memory.batch(torch.arange(2))
    losses = []
    for _ in range(12):
        torch.manual_seed(1)  # the same noise, times and changes of the images: only learning is left
        losses.append(float(trainer.step(batch, 0.0)["flow"]))
    assert losses[-1] < 0.9 * losses[0]

    state = {name: value.detach() for name, value in trainer.model.state_dict().items()}
    folder = export(state, trainer.stats, tmp_path / "checkpoint", "f32")
    policy = UnifiedPolicy(folder, backend="pytorch", precision="f32", device="cpu")
    example = policy.example_observation() | {"prompt": INSTRUCTIONS[4]}
    prepared = policy.prepare(example)
    observation = Observation.stack([prepared])
    torch.manual_seed(2)
    x_t = torch.randn(1, HORIZON, 32)
    tokens, masks = prompt_table()
    with torch.no_grad():
        trained, _ = velocity(
            trainer.model, observation.images[:, :2], tokens[4:5], masks[4:5], x_t, torch.tensor([0.5])
        )
    loaded = reference_velocity(reference_model(policy.backend), observation, x_t, 0.5)
    torch.testing.assert_close(loaded, trained, rtol=0, atol=1e-4)
    assert json.loads((folder / "turbopi.json").read_text())["discrete_state_input"] is False


def test_the_guide_reads_the_prefix_and_not_the_padding() -> None:
    torch.manual_seed(0)
    guide, hidden = Guide(192, 14, 7), torch.randn(2, 512 + 24, 192)
    mask = torch.zeros(2, 24, dtype=torch.bool)
    mask[:, :16] = True
    values, logits = guide(hidden, mask)
    assert (values.shape, logits.shape) == ((2, 14), (2, 7))
    hidden[:, 512 + 16 :] = 1e3
    torch.testing.assert_close(guide(hidden, mask)[0], values)
    hidden[:, 100] += 1
    assert not torch.allclose(guide(hidden, mask)[0], values)


def episode(by_expert: str, success: bool, lead: int = 0) -> Episode:
    """One character a step: e for the expert, l for the learner; a frame at every step; labels count up from 0, what
    was carried out from 1000."""
    steps = range(len(by_expert))
    made = Episode(Setting(0, 0), success=success, by_expert=[who == "e" for who in by_expert])
    made.labels = [np.full(7, float(step)) for step in steps]
    made.executed = [np.full(7, 1000.0 + step) for step in steps]
    sight = Sight(np.zeros(3), np.zeros(3), np.zeros(3), np.eye(3), opening=0.0, held=False)
    made.frames = [Frame(step, lead, None, sight, "reach", np.zeros(8), np.full(5, float(step))) for step in steps]
    return made


def test_only_what_the_expert_followed_up_itself_is_labelled() -> None:
    turns = episode("llll" + "e" * (HORIZON + 2) + "ll" + "e" * 3, success=False)
    assert [frame.step for frame in turns.labelled] == [4, 5, 6]
    solved = episode("l" + "e" * 12, success=True)
    assert [frame.step for frame in solved.labelled] == list(range(1, 13))
    np.testing.assert_array_equal(solved.chunk(solved.labels, 9)[:, 0], [9, 10, 11] + [12] * (HORIZON - 3))
    assert not episode("e" * 160, success=False).useful


def test_first_actions_of_the_learner_are_kept_as_carried_out_and_never_as_labels() -> None:
    turns = episode("llll" + "e" * HORIZON, success=False, lead=2)
    assert [frame.step for frame in turns.labelled] == [2, 3, 4]
    record = turns.record("dagger")
    assert record.leads.tolist() == [2, 2, 2]
    np.testing.assert_array_equal(record.chunks[0, :, 0], np.arange(2, HORIZON + 2))
    np.testing.assert_array_equal(record.executed[0, :, 0], np.arange(1002, HORIZON + 1002))


def test_a_tape_is_read_as_it_was_written(tmp_path: Path) -> None:
    first, none = episode("e" * (HORIZON + 3), success=False), episode("lll", success=False)
    bodies = np.random.default_rng(0).normal(size=(4, 7))
    save_tapes(tmp_path / "some.npz", [first.tape("demonstration", bodies), none.tape("dagger", bodies + 1)])
    found = list(load_tapes([tmp_path / "some.npz"]))
    assert [len(tape.joints) for tape in found] == [4, 0]
    assert (found[0].record.kind, found[0].record.setting) == ("demonstration", Setting(0, 0))
    np.testing.assert_array_equal(found[0].record.chunks, first.record("demonstration").chunks)
    np.testing.assert_array_equal(found[0].joints[:, 0], [0, 1, 2, 3])
    np.testing.assert_array_equal(found[1].bodies, bodies + 1)


class CountingWorld:
    """A scene in which nothing happens but steps."""

    def __init__(self) -> None:
        self._images: dict[str, Any] = {"drawn": True}
        self.requested_to_look: list[bool] = []

    def step(self, action: np.ndarray, look: bool) -> bool:
        self.requested_to_look.append(look)
        return False


@pytest.mark.parametrize("delay", [0, 3])
def test_a_late_chunk_of_the_learner_takes_over_where_what_it_was_told_to_hold_ends(
    delay: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Chunk k is k * 100 + its row. What is held goes on from the chunk before."""
    reported: list[list[float]] = []

    def ask(camera_images: Any, prompt: int, held: np.ndarray) -> np.ndarray:
        reported.append(held[:, 0].tolist())
        return np.repeat(np.arange(HORIZON)[:, None] + 100.0 * (len(reported) - 1), 7, axis=1)

    player = Player.__new__(Player)
    player.ask, player.draws, player.episode = ask, True, Episode(Setting(0, 0))
    world: Any = CountingWorld()
    player.world, player.expert = world, Expert.__new__(Expert)
    sight = Sight(np.zeros(3), np.zeros(3), np.zeros(3), np.eye(3), opening=0.0, held=False)
    monkeypatch.setattr(player.expert, "look", lambda: sight)
    monkeypatch.setattr(player.expert, "act", lambda seen: np.zeros(7))
    monkeypatch.setattr(player, "_images", lambda: np.zeros(0))
    kept: list[int] = []
    monkeypatch.setattr(player, "_keep_frame", lambda seen, lead: kept.append(len(player.episode.labels)))
    player._let_learner(3 * REPLAN, delay, lead=2)
    driven = [float(action[0]) for action in player.episode.executed]
    if delay == 0:
        assert driven == [*range(5), *range(100, 105), *range(200, 205)] and reported == [[], [], []]
    else:
        assert driven == [*range(8), *range(103, 108), *range(203, 205)] and reported == [
            [],
            [5, 6, 7],
            [105, 106, 107],
        ]
    assert kept == [3 * REPLAN - 2]  # where what is left of the learner's steps is the lead
    assert [step for step, look in enumerate(world.requested_to_look, start=1) if look] == [5, 10, 13, 15]


def test_what_an_actor_is_told_to_hold_begins_its_chunk_and_changes_the_rest() -> None:
    torch.manual_seed(0)
    actor = Actor(CONFIG.planned_model, 2, *prompt_table(), torch.device("cpu"))
    actor.take(lively_model().state_dict())
    camera_images = np.random.default_rng(0).integers(0, 256, (2, 2, 224, 224, 3), np.uint8)
    held = np.random.default_rng(1).uniform(-1, 1, (4, 7))
    torch.manual_seed(1)
    free = actor.act(camera_images, [2, 2])
    torch.manual_seed(1)
    found = actor.act(camera_images, [2, 2], [held, held[:0]])
    np.testing.assert_array_equal(found[0, :4, :7], held.astype(np.float32))
    np.testing.assert_array_equal(found[0, :4, 7:], 0)
    assert np.abs(found[0, 4:] - free[0, 4:]).max() > 1e-3
    np.testing.assert_allclose(found[1], free[1], rtol=0, atol=1e-5)  # a row that holds nothing


def test_held_actions_are_those_that_were_carried_out(trainer: Trainer, monkeypatch: pytest.MonkeyPatch) -> None:
    """The state that the rest of a chunk is for came of them, and not of what the expert would have done."""
    seen: list[Tensor] = []

    def noting(model: Any, images: Any, tokens: Any, mask: Any, x_t: Tensor, *rest: Any) -> Any:
        seen.extend((x_t, rest[2]))
        return velocity(model, images, tokens, mask, x_t, *rest)

    monkeypatch.setattr("turbopi_lab.small_policy.train.velocity", noting)
    monkeypatch.setattr(trainer, "settings", dataclasses.replace(trainer.settings, max_delay=6))
    batch = dataclasses.replace(toy_memory(2, trainer.device).batch(torch.arange(2)), leads=torch.tensor([6, 6]))
    trainer.losses(batch)
    x, held = seen
    assert held[:, :6].all() and not held[:, 6:].any()
    executed = trainer.normalized(batch.executed).repeat_interleave(trainer.settings.repeats, 0)
    torch.testing.assert_close(x[:, :6], executed[:, :6], rtol=0, atol=0)
    assert (x[:, :6] - trainer.normalized(batch.chunks).repeat_interleave(2, 0)[:, :6]).abs().max() > 0.1


def test_the_states_that_results_are_measured_on_are_never_trained_on() -> None:
    assert not set(TRAINING_STATES) & set(range(25, 50))
    assert not set(VALIDATION_STATES) & set(range(30, 50))


def test_the_other_bowl_has_another_tasks_prompt() -> None:
    assert Setting(0, 0).prompt == 0
    assert Setting(0, 0, other_bowl=True).prompt == 1
    assert all(scene != prompt for scene, prompt in OTHER_PROMPT.items())
    assert len(OTHER_PROMPT) == len(INSTRUCTIONS) == 10


def test_a_rotation_takes_one_orientation_to_the_other() -> None:
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(rotation_between(np.eye(3), quarter), [0, 0, np.pi / 2], atol=1e-12)
    np.testing.assert_array_equal(rotation_between(quarter, quarter), np.zeros(3))


def test_the_expert_knows_the_suites_instructions() -> None:
    simulator = create("libero")
    try:
        simulator.check()
    except SimulatorUnavailable as error:
        pytest.skip(str(error))
    assert list(INSTRUCTIONS) == [task.instruction for task in simulator.tasks("libero_spatial")]
