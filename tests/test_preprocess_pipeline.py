"""Both edges together: openpi's and LeRobot's numbers end to end, the order of steps, refusals."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turbopi.checkpoint.norm_stats import FeatureStats, NormStats, load_norm_stats
from turbopi.config import CAMERAS, PRESETS, ModelConfig, Normalization, NormMode, PolicyConfig, preset
from turbopi.models.observation import Observation
from turbopi.preprocess.images import resize_unit_into
from turbopi.preprocess.pipeline import Pipeline
from turbopi.preprocess.tokenizer import PromptTokenizer, prompt_texts
from turbopi.robots import Robot, RobotInputs, create_robot
from turbopi.robots.libero import Libero
from turbopi.support.errors import ConfigError, ObservationError

GOLDEN = Path(__file__).parent / "golden"
POLICIES: dict[str, dict[str, Any]] = json.loads((GOLDEN / "policy" / "policy.json").read_text())


class ByteTokenizer:
    """The golden data's stand-in; remembers what it was asked."""

    def __init__(self) -> None:
        self.calls: list[list[Any]] = []

    def encode(self, text: str, add_bos: bool) -> Sequence[int]:
        self.calls.append([text, add_bos])
        return [2] * add_bos + [3 + byte % 509 for byte in text.encode()]


def plausible(width: int) -> FeatureStats:
    ramp = np.linspace(-0.1, 0.1, width)
    return FeatureStats(mean=ramp, std=ramp + 1, q01=ramp - 1, q99=ramp + 2, min=ramp - 1, max=ramp + 2)


def pipeline(config: PolicyConfig, state: int = 8, actions: int = 7, **options: Any) -> Pipeline:
    stats = NormStats(plausible(state), plausible(actions))
    return Pipeline(config, stats, PromptTokenizer(ByteTokenizer(), vocab_size=512), **options)


LIBERO = preset("pi05_tiny")  # with the state in the prompt
PLAIN = preset("pi05_base")


def golden_pipeline(name: str) -> tuple[Pipeline, ByteTokenizer, dict[str, np.ndarray]]:
    settings = POLICIES[name]
    mode: Any = "quantile" if settings["quantile_norm"] else "zscore"
    model = ModelConfig(kind=settings["model"], max_prompt_tokens=200 if settings["model"] == "pi05" else 48)
    config = PolicyConfig(
        name,
        model,
        settings["robot"],
        Normalization(mode, mode),
        discrete_state_input=settings["model"] == "pi05",
        robot_options={} if settings["robot"] == "libero" else {"adapt_to_pi": True, "delta_actions": True},
    )
    stats = load_norm_stats(GOLDEN / "preprocess" / "norm_stats" / settings["norm_stats"] / "norm_stats.json")
    encoder = ByteTokenizer()
    with np.load(GOLDEN / "policy" / f"{name}.npz") as file:
        data = {key: file[key] for key in file.files}
    return Pipeline(config, stats, PromptTokenizer(encoder, vocab_size=512)), encoder, data


@pytest.mark.parametrize("name", POLICIES)
def test_what_reaches_the_model_is_openpis_exactly(name: str) -> None:
    edges, encoder, data = golden_pipeline(name)
    inputs, state = edges.before({key[3:]: value for key, value in data.items() if key.startswith("in/")})
    assert encoder.calls == POLICIES[name]["encode_calls"]
    np.testing.assert_array_equal(inputs.tokens, data["model_in/tokenized_prompt"], strict=True)
    np.testing.assert_array_equal(inputs.token_mask, data["model_in/tokenized_prompt_mask"], strict=True)
    for i, camera in enumerate(CAMERAS):
        np.testing.assert_array_equal(inputs.images[i], data[f"model_in/image_u8/{camera}"], strict=True)
        assert inputs.image_mask[i] == data[f"model_in/image_mask/{camera}"]
    assert state.dtype == np.float64
    # numpy's arcsin, in ALOHA's grippers, differs by an ulp between its versions
    np.testing.assert_allclose(state, data["model_in/state"], rtol=0, atol=3e-16 if "aloha" in name else 0)
    np.testing.assert_array_equal(inputs.state, data["model_in/state"].astype(np.float32), strict=True)


@pytest.mark.parametrize("name", POLICIES)
@pytest.mark.parametrize("variant", ["torch_fp32", "torch_bf16", "jax_fp32", "jax_bf16"])
def test_what_reaches_the_robot_is_openpis_exactly(name: str, variant: str) -> None:
    edges, _, data = golden_pipeline(name)
    state = data["model_in/state"]
    if variant.startswith("jax"):  # which rounds the state to float32 on its way through the model
        state = state.astype(np.float32)
    result = edges.after(data[f"{variant}/model_actions"], state)
    assert list(result) == ["actions"]
    np.testing.assert_array_equal(result["actions"], data[f"{variant}/actions"], strict=True)


def test_lerobots_edges_from_end_to_end() -> None:
    keys = ["observation.images.top", "observation.images.wrist"]
    config = PolicyConfig(
        "lerobot",
        dataclasses.replace(LIBERO.model, vocab_size=512),
        "lerobot",
        Normalization("lerobot_quantile", "lerobot_zscore"),
        robot_options={"image_keys": keys, "num_missing_cameras": 1, "state_dim": 6, "action_dim": 5},
        image_resize="lerobot",
    )
    encoder = ByteTokenizer()
    stats = NormStats(plausible(6), plausible(5))
    edges = Pipeline(config, stats, PromptTokenizer(encoder, vocab_size=512))
    rng = np.random.default_rng(0)
    top = rng.random((3, 100, 140), np.float32)
    state = rng.normal(size=6).astype(np.float32)
    inputs, context = edges.before({keys[0]: top, "observation.state": state, "task": "fold_it"})

    expected = np.full((3, 224, 224, 3), -1, np.float32)  # the wrist camera is missing, too
    resize_unit_into(top.transpose(1, 2, 0), expected[0])
    np.testing.assert_array_equal(inputs.images, expected, strict=True)
    assert inputs.image_mask.tolist() == [True, False, False]

    q01, q99 = plausible(6).q01, plausible(6).q99
    assert q01 is not None
    assert q99 is not None
    low, high = q01.astype(np.float32), q99.astype(np.float32)
    normalized = 2 * (state - low) / (high - low) - 1
    np.testing.assert_array_equal(context, np.pad(normalized, (0, 26)))
    assert encoder.calls == [list(call) for call in prompt_texts("fold it", normalized)]

    chunk = rng.normal(size=(10, 32)).astype(np.float32)
    mean, std = plausible(5).mean, plausible(5).std
    assert mean is not None
    assert std is not None
    actions = chunk[:, :5] * std.astype(np.float32) + mean.astype(np.float32)
    np.testing.assert_array_equal(edges.after(chunk, context)["actions"], actions.astype(np.float64), strict=True)


@pytest.mark.parametrize("mode", ["lerobot_quantile", "lerobot_zscore", "lerobot_min_max", "identity"])
def test_lerobots_relative_actions_are_added_to_the_state_that_came(mode: NormMode) -> None:
    keys, mask = ["observation.images.top"], [True, False, True, True, False]
    config = PolicyConfig(
        "lerobot",
        dataclasses.replace(LIBERO.model, vocab_size=512),
        "lerobot",
        Normalization(mode, "lerobot_quantile"),
        robot_options={"image_keys": keys, "state_dim": 6, "action_dim": 5, "relative_dims": mask},
        image_resize="lerobot",
    )
    stats = plausible(6)
    constant = np.array([1.0, 1.0, 0.0, 1.0, 1.0, 1.0])  # a joint that never moved: scaling back would lose the state
    stats = dataclasses.replace(stats, **{name: getattr(stats, name) * constant for name in stats.available})
    edges = Pipeline(config, NormStats(stats, plausible(5)), PromptTokenizer(ByteTokenizer(), vocab_size=512))
    rng = np.random.default_rng(0)
    state = rng.normal(size=6).astype(np.float32)
    observation = {keys[0]: rng.random((3, 40, 60), np.float32), "observation.state": state, "task": "go"}
    chunk = rng.normal(size=(10, 32)).astype(np.float32)
    _, context = edges.before(observation)
    unscaled = edges.action_scale.unnormalize(chunk)[:, :5].astype(np.float32)
    expected = unscaled + state[:5] * np.array(mask, np.float32)
    np.testing.assert_array_equal(edges.after(chunk, context)["actions"], expected.astype(np.float64), strict=True)
    assert not np.shares_memory(context, state)


@pytest.mark.parametrize("name", PRESETS)
def test_every_presets_example_goes_through_and_comes_back(name: str) -> None:
    config = preset(name)
    widths = {"libero": (8, 7), "droid": (8, 8), "aloha": (14, 14), "plain": (32, 32)}[config.robot]
    edges = pipeline(config, *widths)
    inputs, state = edges.before(edges.example(seed=1))
    size, width = config.model.image_size, config.model.action_dim
    actions = edges.after(np.zeros((config.model.action_horizon, width), np.float32), state)["actions"]
    tokens = config.model.max_prompt_tokens
    expected: list[tuple[np.ndarray, tuple[int, ...], type]] = [
        (inputs.images, (3, size, size, 3), np.uint8),
        (inputs.image_mask, (3,), np.bool_),
        (inputs.tokens, (tokens,), np.int64),
        (inputs.token_mask, (tokens,), np.bool_),
        (inputs.state, (width,), np.float32),
        (state, (max(width, widths[0]),), np.float64),
        (actions, (config.model.action_horizon, widths[1]), np.float64),
    ]
    for array, shape, dtype in expected:
        assert array.shape == shape
        assert array.dtype == dtype


def test_the_observation_is_neither_changed_nor_kept() -> None:
    edges = pipeline(preset("pi05_aloha"), 14, 14)
    observation, untouched = edges.example(), edges.example()
    inputs, state = edges.before(observation)
    np.testing.assert_equal(observation, untouched)
    images, values = inputs.images.copy(), state.copy()
    observation["state"][:] = 9
    for camera_image in observation["images"].values():
        camera_image[:] = 9
    np.testing.assert_array_equal(inputs.images, images)
    np.testing.assert_array_equal(state, values)


def test_a_state_that_needs_no_scaling_and_no_padding_is_copied_too() -> None:
    edges = pipeline(dataclasses.replace(PLAIN, normalization=Normalization("identity", "identity")))
    observation = {**edges.example(), "state": np.zeros(32)}
    _, state = edges.before(observation)
    observation["state"][:] = 9
    assert not state.any()


def test_the_models_actions_and_the_state_are_left_alone() -> None:
    edges = pipeline(preset("pi05_aloha"), 14, 14)
    _, state = edges.before(edges.example())
    chunk = np.random.default_rng(0).normal(size=(50, 32)).astype(np.float32)
    before = chunk.copy(), state.copy()
    first = edges.after(chunk, state)["actions"]
    np.testing.assert_array_equal(chunk, before[0])
    np.testing.assert_array_equal(state, before[1])
    np.testing.assert_array_equal(edges.after(chunk, state)["actions"], first)


@pytest.mark.parametrize("name", ["pi05_libero", "pi05_droid", "pi05_aloha", "pi05_base", "pi0_libero", "pi0_aloha"])
def test_chunks_of_a_batch_leave_as_they_do_one_by_one(name: str) -> None:
    """To the last bit, and without the batch's memory, which a backend may write to again."""
    config = preset(name)
    widths = {"libero": (8, 7), "droid": (8, 8), "aloha": (14, 14), "plain": (32, 32)}[config.robot]
    edges = pipeline(config, *widths)
    states = [edges.before(edges.example(seed))[1] for seed in range(3)]
    chunks = np.random.default_rng(0).normal(size=(3, config.model.action_horizon, 32)).astype(np.float32)
    together = edges.after_all(chunks, states)
    for row, result in enumerate(together):
        alone = edges.after(chunks[row], states[row])["actions"]
        np.testing.assert_array_equal(result["actions"], alone, strict=True)
        assert not np.shares_memory(result["actions"], chunks)
        assert not any(np.shares_memory(result["actions"], other["actions"]) for other in together[:row])


def test_states_of_several_widths_are_added_as_each_alone() -> None:
    """Identity takes any; only what relative actions are added to counts."""
    config = dataclasses.replace(PLAIN, normalization=Normalization("identity", "identity"))
    edges = pipeline(config, robot=Relative())
    states = [edges.before({"state": np.arange(width, dtype=np.float64)})[1] for width in (7, 33, 40)]
    assert [len(state) for state in states] == [32, 33, 40]
    chunks = np.random.default_rng(0).normal(size=(3, 4, 32)).astype(np.float32)
    for chunk, state, result in zip(chunks, states, edges.after_all(chunks, states), strict=True):
        np.testing.assert_array_equal(result["actions"], edges.after(chunk, state)["actions"])
        np.testing.assert_array_equal(result["actions"][0], chunk[0, :7] + np.append(np.arange(6.0), 0))


def test_relative_actions_are_added_to_the_unnormalised_state() -> None:
    config = PolicyConfig("base", ModelConfig(), "plain")
    edges = pipeline(config, 7, 7, robot=Relative())
    state = np.linspace(10, 16, 7)
    _, context = edges.before({"state": state})
    at_rest = edges.action_scale.normalize(np.zeros((4, 7)))
    actions = edges.after(np.pad(at_rest, ((0, 0), (0, 25))).astype(np.float32), context)["actions"]
    np.testing.assert_allclose(actions, np.tile([*state[:6], 0], (4, 1)), atol=1e-5)


class Relative(Robot):
    """No camera, seven numbers, six of them relative."""

    name = "relative"
    delta_mask = (True,) * 6 + (False,)
    default_prompt = "the robot's prompt"

    def inputs(self, observation: Mapping[str, Any]) -> RobotInputs:
        return RobotInputs({}, {}, observation["state"])

    def outputs(self, actions: np.ndarray) -> np.ndarray:
        return actions[:, :7]

    def example(self, rng: np.random.Generator) -> dict[str, Any]:
        return {"state": rng.random(7)}


def test_cameras_that_a_robot_leaves_out_are_masked_and_order_doesnt_matter() -> None:
    class Wrist(Relative):
        def inputs(self, observation: Mapping[str, Any]) -> RobotInputs:
            camera_images = {
                camera: np.full((224, 224, 3), i, np.uint8) for i, camera in enumerate(reversed(CAMERAS[:2]))
            }
            return RobotInputs(camera_images, dict.fromkeys(camera_images, True), observation["state"])

    edges = pipeline(PLAIN, 7, 7, robot=Wrist())
    inputs, _ = edges.before(edges.example())
    assert inputs.image_mask.tolist() == [True, True, False]
    assert inputs.images[:, 0, 0, 0].tolist() == [1, 0, 0]


def test_a_masked_picture_is_never_read() -> None:
    class Masked(Relative):
        def inputs(self, observation: Mapping[str, Any]) -> RobotInputs:
            camera_images = {"base_0_rgb": np.zeros((5, 5), np.int64)}  # would be refused
            return RobotInputs(camera_images, {"base_0_rgb": False}, observation["state"])

    edges = pipeline(PLAIN, 7, 7, robot=Masked())
    inputs, _ = edges.before(edges.example())
    assert not inputs.image_mask.any()
    assert not inputs.images.any()


def test_a_robots_own_faults_are_refused_like_an_observations() -> None:
    class Faulty(Relative):
        def __init__(self, **replaced: Any) -> None:
            self.replaced = replaced

        def inputs(self, observation: Mapping[str, Any]) -> RobotInputs:
            image = {"base_0_rgb": np.zeros((5, 5, 3), np.uint8)}
            return dataclasses.replace(RobotInputs(image, {"base_0_rgb": True}, observation["state"]), **self.replaced)

    for replaced, message in (
        ({"state": np.array([np.nan] * 7)}, "state isn't finite: value 0 is nan"),
        ({"state": np.zeros((1, 7))}, "state has shape"),
        ({"images": {"base_0_rgb": np.zeros((3, 5, 5), np.uint8)}}, r"base_0_rgb has shape \(3, 5, 5\)"),
        ({"images": {"base_0_rgb": np.zeros((5, 5, 3), np.int64)}}, "base_0_rgb has dtype int64"),
        ({"images": {}}, "base_0_rgb is None"),
        ({"prompt": 7}, "prompt is an int"),
    ):
        edges = pipeline(PLAIN, 7, 7, robot=Faulty(**replaced))
        with pytest.raises(ObservationError, match=message):
            edges.before(edges.example())


def test_a_picture_without_a_mask_is_used() -> None:
    class Unmasked(Relative):
        def inputs(self, observation: Mapping[str, Any]) -> RobotInputs:
            return RobotInputs({"base_0_rgb": np.full((224, 224, 3), 9, np.uint8)}, {}, observation["state"])

    edges = pipeline(PLAIN, 7, 7, robot=Unmasked())
    inputs, _ = edges.before(edges.example())
    assert inputs.image_mask.tolist() == [True, False, False]
    assert (inputs.images[0] == 9).all()


# Prompts


def prompt_of(edges: Pipeline, observation: Mapping[str, Any]) -> str:
    encoder: Any = edges.tokenizer.encoder
    encoder.calls.clear()
    edges.before(observation)
    return str(encoder.calls[0][0]).split(",")[0].removeprefix("Task: ")


def test_the_observations_prompt_comes_first_then_the_arguments_the_configs_and_the_robots() -> None:
    state = {"state": np.zeros(7)}
    assert prompt_of(pipeline(PLAIN, 7, 7, robot=Relative()), state) == "the robot's prompt"
    configured = dataclasses.replace(PLAIN, default_prompt="the config's prompt")
    assert prompt_of(pipeline(configured, 7, 7, robot=Relative()), state) == "the config's prompt"
    given = pipeline(configured, 7, 7, robot=Relative(), default_prompt="the argument's prompt")
    assert prompt_of(given, state) == "the argument's prompt"
    edges = pipeline(LIBERO, default_prompt="unused")
    assert prompt_of(edges, {**edges.example(), "prompt": "fold_the towel"}) == "fold the towel"
    assert prompt_of(edges, {**edges.example(), "prompt": ""}) == ""  # a prompt, if an odd one


def test_without_any_prompt_the_observation_is_refused() -> None:
    edges = pipeline(LIBERO)
    observation = {key: value for key, value in edges.example().items() if key != "prompt"}
    expected = r"no prompt\. It has .*state.*under 'prompt', or .* default one: --default-prompt"
    with pytest.raises(ObservationError, match=expected):
        edges.before(observation)


def test_the_state_is_in_the_prompt_normalised_and_unpadded_or_not_at_all() -> None:
    with_state, without = pipeline(LIBERO), pipeline(dataclasses.replace(LIBERO, discrete_state_input=False))
    observation = with_state.example()
    for edges in (with_state, without):
        _, state = edges.before(observation)
        encoder: Any = edges.tokenizer.encoder
        expected = prompt_texts(observation["prompt"], state[:8] if edges is with_state else None)
        assert encoder.calls == [list(call) for call in expected]


# Refusals

ODD_SHAPES = st.sampled_from([(), (0,), (1,), (7,), (8,), (14,), (3, 4), (2, 3, 3), (3, 9, 1), (9, 9, 3), (1, 9, 9, 3)])
ODD_DTYPES = st.sampled_from(["u1", "i8", "f2", "f4", "f8", "?", "c8", "U3", "S2", ">f4", "M8[s]", "O"])
ODD_VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=5),
    st.binary(max_size=5),
    st.lists(st.one_of(st.floats(), st.lists(st.integers(), max_size=3)), max_size=9),
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
    st.builds(lambda shape, dtype: np.zeros(shape, dtype), ODD_SHAPES, ODD_DTYPES),
    st.builds(lambda shape, value: np.full(shape, value), ODD_SHAPES, st.floats()),
)
FUZZED = [
    pipeline(LIBERO),
    pipeline(preset("pi05_droid"), 8, 8),
    pipeline(preset("pi05_aloha"), 14, 14),
    pipeline(PLAIN, 32, 32),
]


@given(edges=st.sampled_from(FUZZED), data=st.data())
@settings(max_examples=200, deadline=None)
def test_whatever_an_observation_holds_it_is_used_or_refused_as_such(edges: Pipeline, data: st.DataObject) -> None:
    observation = edges.example()
    observation[data.draw(st.sampled_from([*observation, "images/cam_high", "image"]))] = data.draw(ODD_VALUES)
    try:
        inputs, state = edges.before(observation)
    except ObservationError:
        return
    assert np.isfinite(inputs.state).all()
    assert np.isfinite(edges.after(np.zeros((2, 32), np.float32), state)["actions"]).all()


@pytest.mark.parametrize("observation", [None, [1], "image", 3])
def test_an_observation_is_a_dict(observation: Any) -> None:
    with pytest.raises(ObservationError, match=f"an observation is a dict, got {type(observation).__name__}"):
        pipeline(LIBERO).before(observation)


def test_states_wider_than_pi0_or_the_statistics_are_refused() -> None:
    unscaled = dataclasses.replace(preset("pi0_base"), normalization=Normalization("identity", "identity"))
    edges = pipeline(unscaled, 32, 32)
    edges.before({**edges.example(), "state": np.zeros(1)})
    with pytest.raises(ObservationError, match="the state has 33 values, but the model takes at most 32"):
        edges.before({**edges.example(), "state": np.zeros(33)})
    with pytest.raises(ObservationError, match="state has 8 values, but the checkpoint's statistics cover 6"):
        pipeline(PLAIN, 6, 32).before(edges.example())


def test_pi05_takes_states_wider_than_its_actions_as_they_are_only_in_its_prompt() -> None:
    edges = pipeline(PLAIN, 40, 32)
    stats = plausible(40)
    assert stats.q01 is not None
    assert stats.q99 is not None
    raw = np.random.default_rng(0).uniform(-1, 1, 40)
    inputs, state = edges.before({**edges.example(), "state": raw})
    np.testing.assert_array_equal(state, (raw - stats.q01) / (stats.q99 - stats.q01 + 1e-6) * 2 - 1)
    np.testing.assert_array_equal(inputs.state, state[:32].astype(np.float32), strict=True)
    encoder: Any = edges.tokenizer.encoder
    assert encoder.calls == [list(call) for call in prompt_texts(edges.example()["prompt"], state)]
    assert edges.before({**edges.example(), "state": raw[:8]})[1].shape == (40,)
    with pytest.raises(ObservationError, match="state value 39 is 1e\\+39 once normalised"):
        pipeline(dataclasses.replace(PLAIN, normalization=Normalization("identity", "identity"))).before(
            {**edges.example(), "state": np.append(raw[:39], 1e39)}
        )


@pytest.mark.parametrize("mode", ["quantile", "lerobot_quantile"])
@pytest.mark.parametrize("width", [3, 7, 8, 14])
def test_the_plain_robots_example_fits_the_statistics(mode: NormMode, width: int) -> None:
    edges = pipeline(dataclasses.replace(PLAIN, normalization=Normalization(mode, "identity")), width)
    edges.before(edges.example())


def test_cameras_of_a_robot_that_has_the_models_order_keep_it_whatever_their_names() -> None:
    keys = ["left_wrist_0_rgb", "base_0_rgb"]
    options = {"image_keys": keys, "state_dim": 6, "action_dim": 5}
    edges = pipeline(dataclasses.replace(LIBERO, robot="lerobot", robot_options=options), 6, 5)
    camera_images = {key: np.full((3, 224, 224), shade, np.uint8) for key, shade in zip(keys, (10, 20), strict=True)}
    inputs, _ = edges.before({**camera_images, "observation.state": np.zeros(6), "task": "go"})
    assert [int(image[0, 0, 0]) for image in inputs.images] == [10, 20]


def test_naming_the_configs_own_robot_again_keeps_its_options() -> None:
    assert pipeline(preset("pi0_libero"), robot="libero").robot.delta_mask == (True,) * 6 + (False,)
    aloha = dataclasses.replace(preset("pi05_aloha"), robot_options={"adapt_to_pi": False, "delta_actions": False})
    assert pipeline(aloha, 14, 14, robot="aloha").robot == create_robot("aloha", aloha.robot_options)
    assert pipeline(preset("pi0_libero"), 14, 14, robot="aloha").robot == create_robot("aloha")


def test_relative_actions_beyond_the_models_are_refused_at_once() -> None:
    class Wide(Libero):
        delta_mask = (True,) * 40

    with pytest.raises(ConfigError, match="robot libero has a delta_mask of 40 dimensions, but the model's actions"):
        pipeline(LIBERO, robot=Wide())


@pytest.mark.parametrize("huge", [1e60, 1.7e308, -1e300])
def test_states_too_large_for_the_model_are_refused(huge: float) -> None:
    edges = pipeline(PLAIN, 32, 32)
    with pytest.raises(ObservationError, match=r"state value 3 is .*, too large for the model"):
        edges.before({**edges.example(), "state": np.array([0, 0, 0, huge])})


def test_pictures_too_narrow_to_resize_are_refused() -> None:
    edges = pipeline(LIBERO)
    with pytest.raises(ObservationError, match="an image of 1x500 pixels is too narrow"):
        edges.before({**edges.example(), "observation/image": np.zeros((1, 500, 3), np.uint8)})


@pytest.mark.parametrize(
    ("config", "state", "actions", "options", "message"),
    [
        (LIBERO, 7, 7, {}, "robot libero has 8 values of state, but the statistics cover 7"),
        (LIBERO, 8, 6, {}, "robot libero has 7 values of actions, but the statistics cover 6"),
        (LIBERO, 8, 33, {}, "the statistics cover 33 values of actions, but the model has 32"),
        (
            preset("pi0_libero").with_model(action_dim=7),
            7,
            7,
            {},
            "robot libero has 8 values of state, but the model takes 7",
        ),
        (preset("pi0_base"), 8, 7, {"robot": "libro"}, "unknown robot 'libro'"),
        (dataclasses.replace(preset("pi0_base"), discrete_state_input=True), 8, 7, {}, "only Pi0.5 reads the state"),
        (dataclasses.replace(LIBERO, image_resize=cast(Any, "bicubic")), 8, 7, {}, "image_resize is openpi or lerobot"),
    ],
)
def test_parts_that_dont_fit_are_refused_at_once(
    config: PolicyConfig, state: int, actions: int, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        pipeline(config, state, actions, **options)


def test_missing_statistics_are_refused_at_once() -> None:
    with pytest.raises(ConfigError, match="quantile normalisation of actions needs q01 and q99"):
        Pipeline(LIBERO, NormStats(plausible(8), None), PromptTokenizer(ByteTokenizer(), vocab_size=512))


def test_metadata_describes_the_robot_in_plain_values() -> None:
    aloha = pipeline(preset("pi05_aloha"), 14, 14, default_prompt="transfer cube").metadata
    assert aloha["reset_pose"] == [0, -1.5, 1.5, 0, 0, 0]
    assert (aloha["robot"], aloha["robot_action_dim"], aloha["default_prompt"]) == ("aloha", 14, "transfer cube")
    plain = pipeline(PLAIN, 32, 32).metadata
    assert "reset_pose" not in plain
    assert plain["robot_action_dim"] == 32
    assert json.loads(json.dumps(aloha)) == aloha


def test_examples_are_the_same_for_the_same_seed_only() -> None:
    edges = pipeline(LIBERO)
    np.testing.assert_equal(edges.example(4), edges.example(4))
    assert (edges.example(4)["observation/image"] != edges.example(5)["observation/image"]).any()


@pytest.mark.parametrize("resize", ["openpi", "lerobot"])
def test_every_pixel_is_written(resize: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Padding and missing cameras are black, whatever the memory held before."""
    config = dataclasses.replace(PLAIN, image_resize=resize)
    wide = np.full((60, 224, 3), 200, np.uint8)
    observation = {"images": {CAMERAS[0]: wide, CAMERAS[1]: np.full((224, 224, 3), 9, np.uint8)}, "state": np.zeros(8)}
    clean = pipeline(config, default_prompt="x").before(observation)[0].images
    empty = np.empty

    def poisoned(*args: Any, **options: Any) -> np.ndarray:
        out = empty(*args, **options)
        out.fill(77)
        return out

    monkeypatch.setattr(np, "empty", poisoned)
    images = pipeline(config, default_prompt="x").before(observation)[0].images
    np.testing.assert_array_equal(images, clean)
    black = 0 if resize == "openpi" else -1
    assert (images[2] == black).all()
    assert (images[0, :60] == black).all()
    assert not (images[0, 112] == black).any()


def test_a_single_observation_isnt_copied_and_several_are() -> None:
    inputs, _ = pipeline(PLAIN, default_prompt="x").before(
        {"images": {CAMERAS[0]: np.zeros((8, 8, 3), np.uint8)}, "state": np.zeros(8)}
    )
    one, two = Observation.stack([inputs]), Observation.stack([inputs, inputs])
    assert np.shares_memory(one.images.numpy(), inputs.images)
    assert not np.shares_memory(two.images.numpy(), inputs.images)
    for name in ("images", "image_mask", "tokens", "token_mask", "state"):
        np.testing.assert_array_equal(getattr(one, name).numpy()[0], getattr(inputs, name))
        np.testing.assert_array_equal(getattr(two, name).numpy()[1], getattr(inputs, name))


@pytest.mark.parametrize("resize", ["openpi", "lerobot"])
def test_vision_is_given_the_valid_pictures_that_before_returns(resize: Any) -> None:
    """Of any size and layout, in order, one that is fine as it is without a copy; the rest follows with `read`."""
    edges = pipeline(dataclasses.replace(PLAIN, image_resize=resize), default_prompt="x")
    rng = np.random.default_rng(0)
    exact = rng.integers(256, size=(224, 224, 3), dtype=np.uint8)
    wide, channels_first = (rng.integers(256, size=s, dtype=np.uint8) for s in ((60, 224, 3), (3, 224, 224)))
    for sent in ([exact, wide], [wide, channels_first, exact], [channels_first]):
        observation = {"images": dict(zip(CAMERAS, sent, strict=False)), "state": np.full(8, 0.5)}
        inputs, state = edges.before(observation)
        seen = edges.see(observation)
        assert len(seen.camera_images) == len(sent)
        np.testing.assert_array_equal(np.stack(seen.camera_images), inputs.images[inputs.image_mask])
        assert np.stack(seen.camera_images).dtype == inputs.images.dtype
        if resize == "openpi" and sent[-1] is exact:
            assert np.shares_memory(seen.camera_images[-1], exact)
        edges.read(seen)
        np.testing.assert_array_equal(seen.state, state)
        np.testing.assert_array_equal(seen.model_state, inputs.state)
        np.testing.assert_array_equal(seen.tokens[seen.token_mask], inputs.tokens[inputs.token_mask])
