"""The LeRobot plugin without LeRobot: options, chunks and queues, refusals. Inside LeRobot: test_lerobot_plugin.py."""

import json
import re
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lerobot_fakes
import memory_golden
import numpy as np
import pytest
import torch
from checkpoint_helpers import edit_json
from lerobot_golden import GOLDEN, GoldenCase, _observation

from turbopi import UnifiedPolicy
from turbopi.preprocess.tokenizer import TINY_TOKENIZER, load_tokenizer
from turbopi.realtime.running_chunk import RunningChunk
from turbopi.serve import PolicyServer, running
from turbopi.support.errors import ActionError, CheckpointError, ConfigError, ObservationError

TOP, WRIST = "observation.images.top", "observation.images.wrist"
H, D = 10, 32


@pytest.fixture
def modeling(monkeypatch: pytest.MonkeyPatch) -> Any:
    return lerobot_fakes.install(monkeypatch)


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    return GoldenCase(GOLDEN / "mean_std").assemble(tmp_path)


class Model:
    """A policy's model that answers with the noise plus a number that counts its calls."""

    def __init__(self, kind: str = "pi05") -> None:
        self.config = SimpleNamespace(model=SimpleNamespace(kind=kind), turns_aloha=False)
        self.seen: list[tuple[Any, int]] = []
        self.backend = self
        self.metadata = {"real_time": {"modes": ["rtc", "rtc_identity"]}}

    def sample(self, inputs: Any, noise: torch.Tensor, num_steps: int, **joined: Any) -> Any:
        self.seen.append((inputs, num_steps))
        self.joined = joined
        return SimpleNamespace(actions=noise + len(self.seen))


def batch(rows: int = 1, /, **changed: Any) -> dict[str, torch.Tensor]:
    mask = torch.zeros(rows, 20, dtype=torch.int64)
    mask[:, :5] = 1
    made: dict[str, Any] = {
        TOP: torch.rand(rows, 3, 224, 224),
        WRIST: torch.rand(rows, 3, 224, 224),
        "observation.state": torch.arange(8.0).expand(rows, 8),
        "observation.language.tokens": torch.arange(20).expand(rows, 20),
        "observation.language.attention_mask": mask,
    }
    return {key: value for key, value in (made | changed).items() if value is not None}


def made(modeling: Any, checkpoint: Path, model: Any = None, **options: Any) -> tuple[Any, Any]:
    model = model or Model()
    config = modeling.TurboPiConfig(checkpoint=str(checkpoint), warmup=False, **options)
    return modeling.TurboPiPolicy(config, turbopi=model), model


def test_the_package_has_the_name_that_lerobot_looks_for() -> None:
    found = re.search(r'^name = "(\w+)"', (lerobot_fakes.PLUGIN.parent / "pyproject.toml").read_text(), re.MULTILINE)
    assert found is not None
    name = found[1]
    assert name.startswith("lerobot_policy_") and (lerobot_fakes.PLUGIN / name / "__init__.py").is_file()


def test_lerobot_finds_policy_and_processors_by_their_names(modeling: Any) -> None:
    """LeRobot's rule: configuration_x.XConfig, modeling_x.XPolicy, processor_x.make_{type}_pre_post_processors."""
    config = modeling.TurboPiConfig
    assert lerobot_fakes.PreTrainedConfig.types["turbopi"].__name__ == config.__name__ == "TurboPiConfig"
    assert config.__module__.replace("configuration_", "modeling_") == modeling.TurboPiPolicy.__module__
    processors = lerobot_fakes.PLUGIN / "lerobot_policy_turbopi" / "processor_turbopi.py"
    assert "def make_turbopi_pre_post_processors(" in processors.read_text()


def test_what_no_option_says_is_the_checkpoints(modeling: Any, checkpoint: Path) -> None:
    config = modeling.TurboPiConfig(checkpoint=str(checkpoint))
    described = json.loads((checkpoint / "config.json").read_text())
    assert (config.chunk_size, config.n_action_steps) == (described["chunk_size"], described["n_action_steps"])
    assert config.num_inference_steps == described["num_inference_steps"]
    assert list(config.image_features) == [TOP, WRIST] and config.output_features["action"].shape == (7,)
    assert config.pretrained_path == checkpoint
    given = modeling.TurboPiConfig(checkpoint=str(checkpoint), n_action_steps=3, num_inference_steps=2)
    assert (given.n_action_steps, given.num_inference_steps) == (3, 2)


def test_a_chunk_is_the_models_answer_as_wide_as_the_robots_actions(modeling: Any, checkpoint: Path) -> None:
    policy, model = made(modeling, checkpoint)
    given, noise = batch(), torch.randn(1, H, D)
    chunk = policy.predict_action_chunk(given, noise=noise, num_steps=4)
    torch.testing.assert_close(chunk, noise[..., :7] + 1)
    inputs, steps = model.seen[0]
    assert steps == 4
    torch.testing.assert_close(inputs.images[0, 1], given[WRIST][0].permute(1, 2, 0) * 2 - 1)
    assert inputs.image_mask.tolist() == [[True, True]] and inputs.token_mask.sum() == 5
    assert not inputs.state.any()  # Pi0.5 has it in the prompt


def test_pi0_reads_the_padded_state(modeling: Any, checkpoint: Path) -> None:
    policy, model = made(modeling, checkpoint, Model("pi0"))
    policy.predict_action_chunk(batch())
    assert model.seen[0][0].state[0].tolist() == [*range(8), *[0.0] * 24]


def test_a_missing_camera_is_left_out(modeling: Any, checkpoint: Path) -> None:
    policy, model = made(modeling, checkpoint)
    policy.predict_action_chunk(batch(1, **{TOP: None}))
    assert model.seen[0][0].images.shape == (1, 1, 224, 224, 3)


def test_the_same_seed_of_pytorch_gives_the_same_noise(modeling: Any, checkpoint: Path) -> None:
    chunks, given = [], batch()
    for _ in range(2):
        policy, _ = made(modeling, checkpoint)
        torch.manual_seed(5)
        chunks.append(policy.predict_action_chunk(given))
    assert torch.equal(*chunks)
    torch.manual_seed(5)
    assert torch.equal(chunks[0], torch.normal(0.0, 1.0, (1, H, D))[..., :7] + 1)


def test_actions_come_one_by_one_until_n_action_steps_are_used(modeling: Any, checkpoint: Path) -> None:
    policy, model = made(modeling, checkpoint, n_action_steps=3)
    noise = torch.randn(2, H, D)
    actions = [policy.select_action(batch(2), noise=noise) for _ in range(7)]
    torch.testing.assert_close(torch.stack(actions[:3]), noise[:, :3, :7].transpose(0, 1) + 1)
    torch.testing.assert_close(actions[3], noise[:, 0, :7] + 2)
    assert len(model.seen) == 3
    policy.reset()
    torch.testing.assert_close(policy.select_action(batch(2), noise=noise), noise[:, 0, :7] + 4)


def test_dropping_queued_actions_looks_at_the_next_observation(modeling: Any, checkpoint: Path) -> None:
    """LeRobot's main branch calls it when the task changes within an episode."""
    policy, model = made(modeling, checkpoint, n_action_steps=3)
    policy.select_action(batch())
    policy.drop_queued_actions()
    policy.select_action(batch())
    assert len(model.seen) == 2


def test_what_is_saved_has_all_that_the_processors_name(modeling: Any, checkpoint: Path, tmp_path: Path) -> None:
    (checkpoint / "tokenizer").mkdir()
    (checkpoint / "tokenizer" / "tokenizer.json").write_text("{}")
    file = checkpoint / "policy_preprocessor.json"
    content = json.loads(file.read_text())
    content["steps"][-1]["artifacts"] = {"tokenizer_name": "tokenizer"}
    file.write_text(json.dumps(content))
    policy, _ = made(modeling, checkpoint)
    (tmp_path / "saved").mkdir()
    policy._save_pretrained(tmp_path / "saved")
    policy._save_pretrained(tmp_path / "saved")  # over what is there
    assert (tmp_path / "saved" / "tokenizer" / "tokenizer.json").read_text() == "{}"
    assert (tmp_path / "saved" / "policy_postprocessor.json").is_file()
    content["steps"][-1]["artifacts"] = {"tokenizer_name": "../tokenizer"}
    file.write_text(json.dumps(content))
    with pytest.raises(CheckpointError, match="which isn't in"):
        policy._save_pretrained(tmp_path / "saved")


def test_training_is_refused(modeling: Any, checkpoint: Path) -> None:
    policy, _ = made(modeling, checkpoint)
    for call in (lambda: policy.forward(batch()), policy.get_optim_params, policy.config.get_optimizer_preset):
        with pytest.raises(NotImplementedError, match=r"train with --policy\.type=pi05"):
            call()


def test_bad_batches_are_refused_by_what_they_lack(modeling: Any, checkpoint: Path) -> None:
    policy, _ = made(modeling, checkpoint)
    with pytest.raises(ObservationError, match=r"none of the checkpoint's cameras, observation\.images\.top"):
        policy.predict_action_chunk(batch(1, **{TOP: None, WRIST: None}))
    with pytest.raises(ObservationError, match=r"no 'observation\.language\.tokens'.*Preprocess it first"):
        policy.predict_action_chunk(batch(1, **{"observation.language.tokens": None}))


def test_actions_that_are_not_finite_are_refused(modeling: Any, checkpoint: Path) -> None:
    policy, _ = made(modeling, checkpoint)
    with pytest.raises(ActionError, match="aren't finite"):
        policy.predict_action_chunk(batch(), noise=torch.full((1, H, D), torch.nan))


def test_checkpoints_and_options_that_cannot_be_are_refused(modeling: Any, checkpoint: Path) -> None:
    config = modeling.TurboPiConfig
    with pytest.raises(ConfigError, match=r"needs --policy\.checkpoint"):
        modeling.TurboPiPolicy(config())
    with pytest.raises(ConfigError, match="n_action_steps is 11; it should be from 1 to the chunk's 10"):
        config(checkpoint=str(checkpoint), n_action_steps=11)
    with pytest.raises(ConfigError, match="n_action_steps is 0"):
        config(checkpoint=str(checkpoint), n_action_steps=0)
    described = json.loads((checkpoint / "config.json").read_text())
    (checkpoint / "config.json").write_text(json.dumps(described | {"type": "act"}))
    with pytest.raises(CheckpointError, match="type 'act'; Turbo-Pi runs 'pi05' and 'pi0'"):
        config(checkpoint=str(checkpoint))
    with pytest.raises(CheckpointError, match="neither a folder nor a name on the hub"):
        modeling.local_folder(SimpleNamespace(checkpoint="/no/such/folder", pretrained_revision=None))


def test_turbopi_itself_runs_behind_it(modeling: Any, checkpoint: Path) -> None:
    """A loaded and warm policy, and the model's own refusal of noise of another shape."""
    config = modeling.TurboPiConfig(checkpoint=str(checkpoint), backend="pytorch", precision="f32")
    policy = modeling.TurboPiPolicy(config)
    assert policy.predict_action_chunk(batch(2)).shape == (2, H, 7)
    with pytest.raises(ObservationError, match=r"noise has shape \[1, 10, 7\], but .* \[1, 10, 32\]"):
        policy.predict_action_chunk(batch(), noise=torch.zeros(1, H, 7))
    with pytest.raises(ObservationError, match="number of denoising steps is 0"):
        policy.predict_action_chunk(batch(), num_steps=0)


@pytest.mark.parametrize("served", [False, True])
def test_memory_is_of_each_row_and_ends_with_its_episode(modeling: Any, tmp_path: Path, served: bool) -> None:
    """An entry a call, also while queued actions play; here or on a server."""
    folder = memory_golden.make_checkpoint("visual", tmp_path / "checkpoint")
    golden, wrong = memory_golden.MemoryRuns("visual"), batch(2)
    options: dict[str, Any] = {"backend": "pytorch", "precision": "f32", "device": "cpu"}
    exact = UnifiedPolicy(folder, **options)

    def shown(run: int) -> dict[str, Any]:
        sent: dict[str, Any] = golden.observation(run)
        made = {key: torch.from_numpy(value)[None] for key, value in sent.items() if key != "task"}
        images = {key: value.permute(0, 3, 1, 2) / 255 for key, value in made.items() if "images" in key}
        made |= {key: torch.nn.functional.interpolate(value, (224, 224)) for key, value in images.items()}
        inputs = exact.prepare(sent)
        made["observation.language.tokens"] = torch.from_numpy(inputs.tokens)[None]
        made["observation.language.attention_mask"] = torch.from_numpy(inputs.token_mask)[None]
        return made | {"task": [sent["task"]]}

    with running(exact) if served else nullcontext() as server:
        where: dict[str, Any] = {"checkpoint": str(folder), **options, "warmup": False}
        if served:
            assert server is not None
            where = {"server": f"ws://127.0.0.1:{server.port}"}
        policy = modeling.TurboPiPolicy(modeling.TurboPiConfig(**where, n_action_steps=2))
        for episode in range(2):
            for run in (0, 3, 1, 2, 3):
                policy.select_action(shown(run))
                if run == 2:
                    policy.drop_queued_actions()  # the task changes: memory stays
            if server is None:
                (kept,) = policy._histories
            else:
                assert server._histories is not None
                (kept,) = (robot.history for robot in server._histories._robots.values())
            assert kept.observations == 5, episode
            with pytest.raises(ObservationError, match=r"2 rows"):
                policy.predict_action_chunk(wrong)
            policy.reset()


# -- real-time chunking ------------------------------------------------------------------------------------------------


def prepared(policy: Any, observation: dict[str, Any]) -> dict[str, torch.Tensor]:
    """A robot's observation, as LeRobot's preprocessor passes it on."""
    # the plugin's own reads no prompts
    policy.turbopi.pipeline.tokenizer = load_tokenizer(TINY_TOKENIZER, vocab_size=1024)
    inputs = policy.turbopi.prepare(observation)
    images = torch.from_numpy(inputs.images).permute(0, 3, 1, 2).add(1).div(2)
    return {
        TOP: images[:1],
        WRIST: images[1:2],
        "observation.state": torch.from_numpy(inputs.state)[None],
        "observation.language.tokens": torch.from_numpy(inputs.tokens)[None],
        "observation.language.attention_mask": torch.from_numpy(inputs.token_mask)[None],
    }


def loaded(modeling: Any, checkpoint: Path, **changed: Any) -> Any:
    """A policy of the checkpoint with its config changed, in float32."""
    edit_json(checkpoint / "config.json", lambda content: content.update(changed))
    return modeling.TurboPiPolicy(
        modeling.TurboPiConfig(checkpoint=str(checkpoint), backend="pytorch", precision="f32", warmup=False)
    )


def set_rtc(policy: Any, rtc_config: Any, mode: str = "guided") -> None:
    """As lerobot-rollout does."""
    policy.config.rtc_config, policy.config.rtc_mode = rtc_config, mode
    policy.init_rtc_processor()


def test_guided_chunks_are_lerobots(modeling: Any, tmp_path: Path) -> None:
    """All twenty stored runs of LeRobot 0.6.1's own policy, delays past the execution horizon among them."""
    case = GoldenCase(GOLDEN / "rtc")
    policy = loaded(modeling, case.assemble(tmp_path))
    inputs, stored = np.load(case.folder / "inputs.npz"), np.load(case.folder / "rtc.npz")
    batch, noise = prepared(policy, _observation(inputs, 0)), torch.from_numpy(inputs["noise"])[None]
    for index, run in enumerate(json.loads((case.folder / "rtc.json").read_text())):
        rtc = lerobot_fakes.rtc_config(run["schedule"], run["execution_horizon"], run["max_guidance_weight"])
        set_rtc(policy, rtc)
        left_over = torch.from_numpy(stored[f"{index}/prev"]) if run["prev_rows"] else None
        chunk = policy.predict_action_chunk(
            batch,
            noise,
            run["num_steps"],
            inference_delay=run["inference_delay"],
            prev_chunk_left_over=left_over,
        )
        np.testing.assert_allclose(chunk[0], stored[f"{index}/normalized_actions"], atol=1e-5, err_msg=str(run))


def test_chunks_join_re_anchored_left_overs_as_lerobots(modeling: Any, tmp_path: Path) -> None:
    """Guided and trained, with both paddings of LeRobot's versions: recorded by tools/lerobot_cases/rtc.py."""
    case = GoldenCase(GOLDEN / "relative_excluded")
    policy = loaded(modeling, case.assemble(tmp_path), rtc_training_max_delay=4)
    stored, inputs = np.load(case.folder / "rtc.npz"), np.load(case.folder / "inputs.npz")
    observation = _observation(inputs, 0) | {"observation.state": stored["state"]}
    batch = prepared(policy, observation)
    noise = torch.from_numpy(inputs["noise"])[None]
    plain = policy.predict_action_chunk(batch, noise)[0]
    for index, run in enumerate(json.loads((case.folder / "rtc.json").read_text())["runs"]):
        set_rtc(policy, lerobot_fakes.rtc_config(run["schedule"], run["execution_horizon"]), run["mode"])
        chunk = policy.predict_action_chunk(
            batch,
            noise,
            inference_delay=run["inference_delay"],
            prev_chunk_left_over=torch.from_numpy(stored[f"{index}/left_over"]),
        )[0]
        np.testing.assert_allclose(chunk, stored[f"{index}/normalized_actions"], atol=1e-5, err_msg=str(run))
        far = float((chunk - plain).abs().max())
        assert far > 1e-2 if run["inference_delay"] else far == 0, run


def test_the_mode_of_lerobots_main_branch_is_followed(modeling: Any, checkpoint: Path) -> None:
    policy, model = made(modeling, checkpoint)
    policy.config.rtc_training_max_delay = 3
    policy.config.rtc_config = lerobot_fakes.rtc_config(mode="trained")
    policy.predict_action_chunk(batch(), inference_delay=2, prev_chunk_left_over=torch.ones(5, 7))
    (one,) = model.joined["conditioning"]
    assert one.held.tolist() == [True] * 2 + [False] * 8 and (one.values[:2, :7] == 1).all()


def test_a_delay_longer_than_was_trained_is_cut_with_a_warning(
    modeling: Any, checkpoint: Path, caplog: pytest.LogCaptureFixture
) -> None:
    policy, model = made(modeling, checkpoint, rtc_mode="trained")
    policy.config.rtc_training_max_delay, policy.config.rtc_config = 3, lerobot_fakes.rtc_config()
    for _ in range(2):
        policy.predict_action_chunk(batch(), inference_delay=5, prev_chunk_left_over=torch.ones(6, 7))
    assert model.joined["conditioning"][0].held.sum() == 3
    assert [record.message.split(" (")[0] for record in caplog.records] == [
        "the policy takes 5 control steps, but the next chunk joins only 3 of them"
    ]


def test_calls_that_join_are_warm_before_the_robot_moves(modeling: Any, checkpoint: Path) -> None:
    """LeRobot expects the longest delay that it has measured: one cold call would be expected for ever."""
    policy, model = made(modeling, checkpoint)
    warm: list[dict[str, Any]] = []
    model.warmup, policy.config.warmup = lambda **of: warm.append(of), True
    policy.init_rtc_processor()
    set_rtc(policy, lerobot_fakes.rtc_config())
    assert warm == [{"horizons": H, "real_time": "rtc_identity"}]


def test_without_rtc_nothing_is_joined(modeling: Any, checkpoint: Path) -> None:
    policy, model = made(modeling, checkpoint)
    for rtc, left_over in ((None, torch.ones(5, 7)), (lerobot_fakes.rtc_config(), torch.ones(0, 7))):
        policy.config.rtc_config = rtc
        policy.predict_action_chunk(batch(), inference_delay=2, prev_chunk_left_over=left_over)
        assert model.joined == {}


def test_rtc_that_cannot_be_is_refused(modeling: Any, checkpoint: Path) -> None:
    with pytest.raises(ConfigError, match="rtc_mode is 'held'; choose one of guided, trained"):
        made(modeling, checkpoint, rtc_mode="held")
    policy, model = made(modeling, checkpoint)
    with pytest.raises(ConfigError, match=r"config\.json has no rtc_training_max_delay above 0"):
        set_rtc(policy, lerobot_fakes.rtc_config(), "trained")
    model.metadata["real_time"]["modes"] = []
    with pytest.raises(ConfigError, match="'rtc_identity', and this backend has none"):
        set_rtc(policy, lerobot_fakes.rtc_config())
    with pytest.raises(ConfigError, match="select_action and RTC"):
        policy.select_action(batch())
    for left_over, delay, message in (
        (torch.ones(11, 7), 2, r"shape \[11, 7\]; .* \[K, 7\] or \[1, K, 7\], K up to 10"),
        (torch.ones(5, 8), 2, r"shape \[5, 8\]"),
        (torch.ones(2, 5, 7), 2, r"shape \[2, 5, 7\]"),
        (torch.full((5, 7), torch.nan), 2, "aren't finite"),
        (torch.ones(5, 7), None, "inference_delay is None"),
    ):
        with pytest.raises(ObservationError, match=message):
            policy.predict_action_chunk(batch(), inference_delay=delay, prev_chunk_left_over=left_over)


# -- a server ----------------------------------------------------------------------------------------------------------


class WithNoise:
    """A policy that always denoises the same noise, as a server's: so its answers can be compared."""

    def __init__(self, policy: UnifiedPolicy, noise: np.ndarray) -> None:
        self._policy, self._noise, self.metadata = policy, noise, policy.metadata
        self.joined: list[RunningChunk | None] = []

    def infer(self, obs: Any, **options: Any) -> dict[str, Any]:
        self.joined.append(options.get("previous"))
        return self._policy.infer(obs, noise=self._noise, **options)


@pytest.fixture(scope="module")
def behind_it(tmp_path_factory: pytest.TempPathFactory) -> WithNoise:
    """A policy with relative actions that was trained with delays up to 4."""
    case = GoldenCase(GOLDEN / "relative_excluded")
    checkpoint = case.assemble(tmp_path_factory.mktemp("served"))
    edit_json(checkpoint / "config.json", lambda content: content.update(rtc_training_max_delay=4))
    policy = UnifiedPolicy(checkpoint, backend="pytorch", precision="f32", device="cpu", tokenizer=TINY_TOKENIZER)
    return WithNoise(policy, np.load(case.folder / "inputs.npz")["noise"])


@pytest.fixture(scope="module")
def server(behind_it: WithNoise) -> Iterator[PolicyServer]:
    """`turbopi serve` with a key."""
    with running(behind_it, api_key="open-sesame") as server:
        yield server


@pytest.fixture
def served(modeling: Any, server: PolicyServer, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("TURBOPI_API_KEY", "open-sesame")
    return modeling.TurboPiPolicy(modeling.TurboPiConfig(server=f"ws://127.0.0.1:{server.port}"))


def robots_own(**changed: np.ndarray) -> dict[str, Any]:
    """The stored case's observation, as LeRobot's engine batches it; nothing else is done before a server."""
    stored = _observation(np.load(GOLDEN / "relative_excluded" / "inputs.npz"), 0) | changed
    batch: dict[str, Any] = {"observation.state": torch.from_numpy(stored["observation.state"])[None]}
    for key in (TOP, WRIST):
        batch[key] = torch.from_numpy(stored[key]).permute(2, 0, 1)[None].float() / 255
    return batch | {"task": [stored["task"]]}


def test_a_servers_chunks_join_as_lerobots(served: Any) -> None:
    """Over a websocket: LeRobot's stored numbers, in the robot's units, from what the robot sees."""
    case = GOLDEN / "relative_excluded"
    stored, runs = np.load(case / "rtc.npz"), json.loads((case / "rtc.json").read_text())["runs"]
    assert served.config.action_feature_names[3] == "roll.pos" and list(served.config.image_features) == [TOP, WRIST]
    first = served.predict_action_chunk(robots_own())
    np.testing.assert_allclose(first[0], stored["first/actions"], atol=1e-5)
    second, compared = robots_own(**{"observation.state": stored["state"]}), 0
    for index, run in enumerate(runs):
        s = run["execution_horizon"]
        served.config.rtc_config = None
        first = served.predict_action_chunk(robots_own())
        left_over = first[0, run["row"] :][:s]
        left_over = torch.cat([left_over, torch.zeros(s - len(left_over), 7)])
        served.config.rtc_config, served.config.rtc_mode = lerobot_fakes.rtc_config(run["schedule"], s), run["mode"]
        served.init_rtc_processor()
        chunk = served.predict_action_chunk(
            second, inference_delay=run["inference_delay"], prev_chunk_left_over=left_over
        )
        if run["row"] + s <= H or run["mode"] == "trained":  # else LeRobot pulls towards its padding, too
            np.testing.assert_allclose(chunk[0], stored[f"{index}/actions"], atol=1e-5, err_msg=str(run))
            compared += 1
        else:
            assert float((chunk[0] - first[0]).abs().max()) > 1e-2
    assert compared == 7


def test_a_servers_calls_that_join_are_warm_before_the_robot_moves(served: Any, behind_it: WithNoise) -> None:
    set_rtc(served, lerobot_fakes.rtc_config(), "trained")
    plain, joins = behind_it.joined[-2:]
    assert (
        plain is None
        and joins is not None
        and (joins.mode, joins.delay, len(joins.left_over)) == ("rtc_trained", 1, H - 1)
    )


def test_a_servers_actions_come_one_by_one(served: Any) -> None:
    chunk = served.predict_action_chunk(robots_own())
    actions = [served.select_action(robots_own()) for _ in range(H + 1)]
    assert torch.equal(torch.stack(actions[:H], 1), chunk) and torch.equal(actions[H], chunk[:, 0])
    served.reset()


def test_what_a_server_decides_about_is_refused(modeling: Any, served: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    url = served.config.server
    for option in ({"backend": "fused"}, {"num_inference_steps": 3}, {"checkpoint": "me/mine"}):
        with pytest.raises(ConfigError, match=f"{next(iter(option))} is .*the server decides about it"):
            modeling.TurboPiConfig(server=url, **option)
    with pytest.raises(ObservationError, match="noise and num_steps were given"):
        served.predict_action_chunk(robots_own(), num_steps=2)
    with pytest.raises(ObservationError, match=r"the batch has no 'observation\.state'"):
        served.predict_action_chunk({"task": ["go"]})
    served.config.rtc_config = lerobot_fakes.rtc_config()
    with pytest.raises(ObservationError, match="rows that the server's last answers don't have"):
        served.predict_action_chunk(robots_own(), inference_delay=1, prev_chunk_left_over=torch.ones(5, 7))
    monkeypatch.delenv("TURBOPI_API_KEY")
    with pytest.raises(ConfigError, match="wants its API key"):
        modeling.TurboPiConfig(server=url)


def test_a_server_of_another_robot_is_refused(modeling: Any) -> None:
    policy = SimpleNamespace(metadata={"robot": "libero", "real_time": {"modes": []}}, infer=None)
    with running(policy) as server, pytest.raises(ConfigError, match="observations of robot 'libero'"):
        modeling.TurboPiConfig(server=f"ws://127.0.0.1:{server.port}")


def test_what_is_saved_of_a_server_has_processors_that_change_nothing(served: Any, tmp_path: Path) -> None:
    served._save_pretrained(tmp_path)
    steps = json.loads((tmp_path / "policy_preprocessor.json").read_text())["steps"]
    assert [step["registry_name"] for step in steps] == [
        "rename_observations_processor",
        "to_batch_processor",
        "device_processor",
    ]
    assert {file.name for file in tmp_path.iterdir()} == {
        "config.json",
        "policy_preprocessor.json",
        "policy_postprocessor.json",
    }
