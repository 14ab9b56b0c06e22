"""Text of Pi0.5, and actions that are made of subtasks, against what the code of LeRobot's PR 4184 computed."""

import json
import lzma
import shutil
import urllib.request
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from checkpoint_helpers import edit_json
from lerobot_golden import GOLDEN as LEROBOT
from lerobot_golden import GoldenCase
from pi0_fast_golden import TOKENIZER
from replayed_graphs import Replayed, replay_on_cpu
from safetensors.numpy import load_file, save_file
from sentencepiece import SentencePieceProcessor
from smolvla_golden import GoldenRuns, relative
from typer.testing import CliRunner

from turbopi import UnifiedPolicy
from turbopi.backends import captured_text, tokens
from turbopi.checkpoint import open_checkpoint, random_checkpoint
from turbopi.cli import app
from turbopi.config import TextConfig
from turbopi.models.observation import Observation
from turbopi.models.pi0.text import never_written
from turbopi.policy.text import SubtaskHistory
from turbopi.preprocess.text_prompts import text_ids, text_of
from turbopi.preprocess.tokenizer import TINY_TOKENIZER, PromptTokenizer
from turbopi.realtime import RealTimeClient
from turbopi.realtime.wire import pack, unpack
from turbopi.serve import running
from turbopi.support.action_groups import task_of
from turbopi.support.errors import CheckpointError, ConfigError, ObservationError

GOLDEN = Path(__file__).parent / "golden_text"
P = "model.paligemma_with_expert.paligemma."
HEAD, EMBEDDING = P + "lm_head.weight", P + "model.language_model.embed_tokens.weight"


def make_folder(name: str, folder: Path, **config: object) -> Path:
    """A case's checkpoint, with values of config.json changed."""
    shutil.copytree(GOLDEN / name / "checkpoint", folder)
    (folder / "model.safetensors").write_bytes(lzma.decompress((GOLDEN / "model.safetensors.xz").read_bytes()))
    said = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(said | config))
    (folder / "turbopi.json").write_text('{"vision_heads": 2}')
    return folder


def policy_of(folder: Path, **options: Any) -> UnifiedPolicy:
    given: dict[str, Any] = {"backend": "pytorch", "precision": "f32", "device": "cpu", "tokenizer": TOKENIZER}
    return UnifiedPolicy(folder, **given | options)


def runs(name: str) -> GoldenRuns:
    return GoldenRuns(name, GOLDEN)


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> dict[str, UnifiedPolicy]:
    root = tmp_path_factory.mktemp("text")
    return {name: policy_of(make_folder(name, root / name)) for name in ("subtasks", "joint")}


# -- what LeRobot computed ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["subtasks", "joint"])
def test_ids_and_logits_are_lerobots(policies: dict[str, UnifiedPolicy], name: str) -> None:
    policy, golden = policies[name], runs(name)
    writer: Any = policy.backend.writer
    assert policy.config.text is not None
    for run in range(len(golden)):
        theirs = golden.expected(run)
        if not len(theirs["generated"]):
            continue
        seen = policy.pipeline.see(golden.observation(run))
        inputs = policy.pipeline.complete(seen)
        assert relative(seen.prompt_state, theirs["normalized_state"]) <= 1e-6
        ids = text_ids(policy.pipeline.tokenizer, policy.config.text, seen.prompt, seen.prompt_state)
        assert ids == theirs["task_tokens"].tolist()
        inputs.tokens[: len(ids)], inputs.token_mask[:] = ids, np.arange(len(inputs.tokens)) < len(ids)
        observation = Observation.stack([inputs])
        written, kept = writer.write(observation, 128, keep=True)
        assert written == theirs["generated"].tolist()
        first = kept["logits"][:2, 0, :980:4].numpy()
        assert relative(first, theirs["logits"]) <= 2e-5  # seen: 2e-7
        positions = kept["decode_positions"][:, 0].numpy()
        assert (positions == 2 * 256 + len(ids) - 1 + np.arange(len(written))).all()
        assert writer.write(writer.see(observation), 128)[0] == written
        assert writer.write(observation, 1)[0] == written[:1]
        if run == 0:  # the control: what it never writes would win
            writer.never, never = (), writer.never
            assert writer.write(observation, 1)[0] == [1500]
            writer.never = never


@pytest.mark.parametrize("name", ["subtasks", "joint"])
def test_subtasks_and_actions_are_lerobots(policies: dict[str, UnifiedPolicy], name: str) -> None:
    policy, golden = policies[name], runs(name)
    for run, described in enumerate(golden.described["runs"]):
        if described["begins"]:
            policy.reset()
        theirs = golden.expected(run)
        answer = policy.infer(golden.observation(run), noise=golden.noise, model_actions=True)
        assert answer["subtask"] == str(theirs["subtask"]), run
        assert relative(answer["model_actions"][:, :7], theirs["normalized_actions"]) <= 1e-6
        assert relative(answer["actions"], theirs["actions"]) <= 1e-6
        assert {"vision_ms", "text_ms", "prefix_ms", "denoise_ms"} <= answer["policy_timing"].keys()


@pytest.mark.parametrize("name", ["subtasks", "joint"])
def test_a_given_subtask_is_acted_on_and_leaves_the_held_one(policies: dict[str, UnifiedPolicy], name: str) -> None:
    policy, golden = policies[name], runs(name)
    policy.reset()
    assert policy.infer(golden.observation(0), noise=golden.noise)["subtask"] == "open the drawer"
    given = policy.infer(golden.observation(1), noise=golden.noise, subtask=str(golden.expected(1)["subtask"]))
    assert relative(given["actions"], golden.actions(1)) <= 1e-6
    other = policy.infer(golden.observation(1), noise=golden.noise, subtask="wave")
    assert other["subtask"] == "wave" and relative(other["actions"], golden.actions(1)) > 1e-3
    assert policy.infer(golden.observation(1))["subtask"] == ("open the drawer" if name == "subtasks" else "grasp it")


def test_bytes_that_are_no_text_together_are_replaced_each_as_in_transformers() -> None:
    encoder = SentencePieceProcessor(model_file=str(TOKENIZER))
    ids = [encoder.piece_to_id(f"<0x{byte:02X}>") for byte in "ü".encode() + b"\xffo"]
    tokenizer = PromptTokenizer(encoder, vocab_size=2200)
    assert text_of(tokenizer, ids[:2]) == "ü" and text_of(tokenizer, [*ids, 2000]) == "\N{REPLACEMENT CHARACTER}" * 4


def test_a_subtask_too_long_for_the_prompt_is_refused_not_cut(policies: dict[str, UnifiedPolicy]) -> None:
    with pytest.raises(ObservationError, match="it is never cut"):
        policies["subtasks"].infer(runs("subtasks").observation(0), subtask="ü" * 300)


def test_vision_runs_once_a_chunk(policies: dict[str, UnifiedPolicy], monkeypatch: pytest.MonkeyPatch) -> None:
    policy, seen = policies["subtasks"], []
    model: Any = policy.backend.model  # type: ignore[attr-defined]
    embed = model.embed_images

    def watched(images: torch.Tensor) -> Any:
        seen.append(images.shape[1])
        return embed(images)

    monkeypatch.setattr(model, "embed_images", watched)
    policy.reset()
    assert policy.infer(runs("subtasks").observation(0))["subtask"] == "open the drawer"
    assert seen == [2]  # cameras


def test_rows_of_a_batch_have_their_own_episodes(policies: dict[str, UnifiedPolicy]) -> None:
    policy, golden = policies["subtasks"], runs("subtasks")
    histories = [policy.new_history() for _ in range(3)]
    observations = [golden.observation(run) for run in (0, 2, 3)]
    noise = np.stack([golden.noise] * 3)
    answers = policy.infer_batch(observations, noise=noise, histories=histories, subtasks=[None, None, "wave"])
    assert [one["subtask"] for one in answers] == ["open the drawer", "grasp it", "wave"]
    for row, run in ((0, 0), (1, 2)):
        assert relative(answers[row]["actions"], golden.actions(run)) <= 1e-6
    with pytest.raises(ObservationError, match="a history for each of 2 robots"):
        policy.infer_batch(observations[:2])
    with pytest.raises(ObservationError, match="subtasks has 1 entries for 2 observations"):
        policy.infer_batch(observations[:2], histories=histories[:2], subtasks=["wave"])


def test_a_subtask_is_held_until_the_next_is_written() -> None:
    history = SubtaskHistory()
    assert not history.holds(2)
    history.record("", "the task")
    history.observations += 1
    assert history.subtask == "the task" and history.holds(2)
    history.observations += 1
    history.record("written", "the task")
    assert history.subtask == "written" and not history.holds(2) and not history.holds(1)
    history.record("", "the task")
    assert history.subtask == "written"
    history.reset()
    assert (history.observations, history.subtask) == (0, "")


@pytest.mark.parametrize(
    ("replan", "executed", "chunks"), [(0, 4, 1), (-3, 4, 1), (10, 4, 2), (14, 4, 4), (1, 4, 1), (9, 4, 2)]
)
def test_replan_steps_are_rounded_to_chunks_as_python_rounds(
    tmp_path: Path, replan: int, executed: int, chunks: int
) -> None:
    folder = make_folder("subtasks", tmp_path / "c", subtask_replan_steps=replan, n_action_steps=executed)
    text = open_checkpoint(folder).config.text
    assert text is not None and text.subtasks is not None and text.subtasks.chunks == chunks


def test_action_tokens_and_locations_are_never_written() -> None:
    of_pi052, other = TextConfig("{prompt}", skipped_ids=1152), TextConfig("{prompt}")
    assert never_written(of_pi052, 257_152) == ((254_976, 256_000), (256_000, 257_024))
    assert never_written(TextConfig("{prompt}", skipped_ids=128), 257_152) == ((256_000, 257_024),)
    assert never_written(other, 257_152) == ()


# -- checkpoints -------------------------------------------------------------------------------------------------------


def test_a_head_that_is_the_embedding_is_loaded_once(tmp_path: Path) -> None:
    folder = make_folder("subtasks", tmp_path / "c")
    tensors = load_file(folder / "model.safetensors")
    assert open_checkpoint(folder).load_head("cpu", "f32").shape == (2200, 24)  # type: ignore[union-attr]
    found = open_checkpoint(folder).load("cpu", "f32").state["vlm.embed_tokens.weight"]
    assert np.array_equal(found.numpy(), tensors[EMBEDDING])
    halves = tensors | {EMBEDDING: tensors[EMBEDDING].astype(np.float16)}  # a head may be of another dtype
    save_file(halves, folder / "model.safetensors")
    head = open_checkpoint(folder).load_head("cpu", "bf16")
    assert head is not None and head.dtype == torch.bfloat16
    for tied in ({HEAD: tensors[EMBEDDING]}, {HEAD: None}, {EMBEDDING: None}):
        kept = {name: one for name, one in (tensors | tied).items() if one is not None}
        save_file(kept, folder / "model.safetensors")
        assert open_checkpoint(folder).load_head("cpu", "f32") is None
    save_file(tensors, folder / "model.safetensors")
    before = open_checkpoint(folder).fingerprint()
    tensors[HEAD][3, 3] += 1
    save_file(tensors, folder / "model.safetensors")
    assert open_checkpoint(folder).fingerprint() != before
    tensors[HEAD][3, 3] = np.nan
    save_file(tensors, folder / "model.safetensors")
    with pytest.raises(CheckpointError, match=r"lm_head\.weight are NaN"):
        policy_of(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"apply_chat_template": True}, "apply_chat_template = True, which Turbo-Pi doesn't compute"),
        ({"memory_scratchpad": True}, "memory_scratchpad = True, which Turbo-Pi doesn't compute"),
        ({"use_visual_memory": True}, "has memory .* and type 'pi052'"),
        ({"joint_subtask_conditioning": True, "unfreeze_lm_head": False}, "the language head wasn't trained"),
        ({"n_action_steps": 0}, "n_action_steps is 0"),
        ({"joint_subtask_conditioning": 1}, "joint_subtask_conditioning is 1"),
        ({"type": "pi05"}, "has a step 'render_messages_processor' that Turbo-Pi doesn't know"),
    ],
)
def test_what_is_not_computed_is_refused_by_its_key(tmp_path: Path, change: dict[str, object], message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(make_folder("subtasks", tmp_path / "c", **change))


@pytest.mark.parametrize("change", [{"text_loss_weight": 0.0}, {"unfreeze_lm_head": False}])
def test_an_untrained_head_writes_nothing_and_actions_follow_the_prompt(
    tmp_path: Path, change: dict[str, object]
) -> None:
    folder, golden = make_folder("subtasks", tmp_path / "c", **change), runs("subtasks")
    policy = policy_of(folder)
    assert any("language head wasn't trained" in note for note in open_checkpoint(folder).source.notes)
    assert policy.metadata["subtasks"]["written"] is False and "text" not in policy.metadata
    answer = policy.infer(golden.observation(3), noise=golden.noise)  # whose subtask is the task
    assert answer["subtask"] == "Go home" and relative(answer["actions"], golden.actions(3)) <= 1e-6
    with pytest.raises(ObservationError, match="language head wasn't trained"):
        policy.generate(golden.observation(0))


def test_another_backend_acts_on_given_subtasks_alone(tmp_path: Path) -> None:
    policy, golden = policy_of(make_folder("subtasks", tmp_path / "c"), backend="pytorch_compile"), runs("subtasks")
    with pytest.raises(ObservationError, match="'pytorch_compile' writes no subtasks, and this policy acts on them"):
        policy.infer(golden.observation(0))
    with pytest.raises(ObservationError, match="'pytorch_compile' writes no text: take backend 'pytorch'"):
        policy.generate(golden.observation(0))
    joint = policy_of(make_folder("joint", tmp_path / "j"), backend="pytorch_compile")
    with pytest.raises(ObservationError, match="no causal prompts"):
        joint.infer(golden.observation(0), subtask="wave")


@pytest.mark.parametrize("name", ["subtasks", "joint"])
def test_graphs_write_and_act_as_lerobot(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    replay_on_cpu(monkeypatch)
    monkeypatch.setattr(captured_text, "Graph", Replayed)
    policy, golden = policy_of(make_folder(name, tmp_path / "c"), backend="cuda_graph", strict=True), runs(name)
    with pytest.raises(ObservationError, match=r"strict: .*2 cameras"):
        policy.infer(golden.observation(0))
    policy.warmup(cameras=2)
    for run, described in enumerate(golden.described["runs"]):
        if described["begins"]:
            policy.reset()
        theirs, before = golden.expected(run), Replayed.launches
        answer = policy.infer(golden.observation(run), noise=golden.noise)
        assert answer["subtask"] == str(theirs["subtask"])
        assert relative(answer["actions"], golden.actions(run)) <= 1e-6
        written = len(theirs["generated"])
        words = 1 + written + tokens.LOOK if written else 0
        assert Replayed.launches - before <= 2 + words + policy.config.num_denoising_steps  # of vision one alone
    given = policy.infer(golden.observation(0), noise=golden.noise, subtask="open the drawer")
    assert relative(given["actions"], golden.actions(0)) <= 1e-6
    assert policy.generate(golden.observation(0), max_tokens=3) == "open the"


def test_auto_takes_the_backend_that_writes(tmp_path: Path) -> None:
    policy = policy_of(make_folder("subtasks", tmp_path / "c"), backend="auto")
    assert policy.backend.name == "pytorch" and "that writes subtasks" in policy.metadata["backend_reason"]


def test_inspect_says_what_is_written(tmp_path: Path) -> None:
    folder = make_folder("joint", tmp_path / "c", subtask_replan_steps=8)
    result = CliRunner().invoke(app, ["inspect", str(folder)])
    assert result.exit_code == 0, result.output
    assert "a subtask for 2 chunks, joint" in " ".join(result.output.replace("│", " ").split())
    assert open_checkpoint(folder).info()["text"]["subtasks"] == {"chunks": 2, "joint": True}


def test_a_head_beside_a_pi05_s_embedding_is_used_where_settings_say_that_it_was_trained(tmp_path: Path) -> None:
    folder = GoldenCase(LEROBOT / "trained_embedding").assemble(tmp_path)
    edit_json(folder / "turbopi.json", lambda said: said.update(text={"template": "{prompt}:", "max_tokens": 3}))
    policy = policy_of(folder, tokenizer=TINY_TOKENIZER)
    tensors, writer = load_file(folder / "model.safetensors"), cast("Any", policy.backend.writer)
    assert np.array_equal(writer.head.numpy(), tensors[HEAD])
    assert np.array_equal(writer.vlm.embed_tokens.weight.numpy(), tensors[EMBEDDING])
    assert isinstance(policy.generate(policy.example_observation()), str)


# -- a head that the user says was trained -----------------------------------------------------------------------------


def tiny(tmp_path: Path, text: object = None) -> UnifiedPolicy:
    file = tmp_path / "tiny.json"
    file.write_text(json.dumps({} if text is None else {"text": text}))
    return UnifiedPolicy(random_checkpoint("pi05_tiny", config_source=file), device="cpu", precision="f32")


def test_others_write_what_their_settings_say(tmp_path: Path) -> None:
    policy = tiny(tmp_path, {"template": "Q: {prompt}\nA:", "max_tokens": 5})
    observation = policy.example_observation()
    said = policy.generate(observation)
    assert said == policy.generate(observation, prompt=observation["prompt"], max_tokens=5)
    assert policy.metadata["text"] == {"template": "Q: {prompt}\nA:", "max_tokens": 5}
    assert "subtask" not in policy.infer(observation)
    with pytest.raises(ObservationError, match="max_tokens is 6; it should be a whole number from 1 to 5"):
        policy.generate(observation, max_tokens=6)
    for prompt in ("", " ", "x" * 2001, 3):
        with pytest.raises(ObservationError, match=r"prompt is .*; it should be a text of 1 to 2000 characters"):
            policy.generate(observation, prompt=prompt)  # type: ignore[arg-type]
    with pytest.raises(ObservationError, match=r"the prompt takes \d+ tokens; expected at most 200"):
        policy.generate(observation, prompt="a b c d " * 200)
    with pytest.raises(ObservationError, match="acts on none: leave it out"):
        policy.infer(observation, subtask="wave")


def test_no_text_without_a_word_about_the_head(tmp_path: Path) -> None:
    policy = tiny(tmp_path)
    with pytest.raises(ObservationError, match=r"no file says that its language head was trained.*\"template\""):
        policy.generate(policy.example_observation())
    assert not policy.metadata.keys() & {"text", "subtasks"}


@pytest.mark.parametrize(
    "text",
    [{}, "User: {prompt}", {"template": "no place"}, {"template": "{prompt}", "max_tokens": 0}, {"templates": "x"}, 3],
)
def test_settings_of_text_are_checked(tmp_path: Path, text: object) -> None:
    with pytest.raises(ConfigError, match=r"text is .*; expected an object with template"):
        tiny(tmp_path, text)


def test_settings_of_text_are_for_pi05_that_does_not_describe_itself(tmp_path: Path) -> None:
    folder, text = make_folder("subtasks", tmp_path / "c"), {"template": "{prompt}"}
    (folder / "turbopi.json").write_text(json.dumps({"vision_heads": 2, "text": text}))
    with pytest.raises(ConfigError, match="text can't be chosen for LeRobot's pi052"):
        open_checkpoint(folder)
    file = tmp_path / "pi0.json"
    file.write_text(json.dumps({"text": text, "discrete_state_input": False}))
    with pytest.raises(ConfigError, match=r"text can't be chosen for Pi0; it is for Pi0\.5"):
        random_checkpoint("pi0_base", config_source=file)


# -- over the wire, and as a command -----------------------------------------------------------------------------------


BAD_KEYS: tuple[tuple[dict[str, Any], str], ...] = (
    ({"subtask": ""}, "turbopi/subtask is ''; it should be a text of 1 to 2000 characters"),
    ({"subtask": 3}, "turbopi/subtask is 3"),
    ({"subtask": "x" * 2001}, "turbopi/subtask is 'xxx"),
    ({"generate": 1}, "turbopi/generate is 1; it should be true, or the prompt as a text of 1 to 2000"),
    ({"generate": " "}, "turbopi/generate is ' '"),
    ({"max_tokens": 3}, "turbopi/max_tokens came without turbopi/generate"),
    (
        {"generate": True, "max_tokens": 0},
        "turbopi/max_tokens is 0; it should be a whole number from 1 to 1000",
    ),
    ({"generate": True, "max_tokens": 999}, "max_tokens is 999; it should be a whole number from 1 to 128"),
    ({"generate": True, "subtask": "wave"}, "turbopi/generate asks for a text and no actions"),
    ({"generate": True, "model_actions": True}, "turbopi/generate asks for a text and no actions"),
    ({"batch": 1, "generate": True}, "turbopi/batch"),
    ({"batch": 1}, "turbopi/batch came to a policy with memory"),
)


def test_a_server_writes_and_holds_subtasks_of_each_robot(policies: dict[str, UnifiedPolicy]) -> None:
    policy, golden = policies["subtasks"], runs("subtasks")
    with running(policy) as server, RealTimeClient("127.0.0.1", server.port) as client:
        assert client.metadata["subtasks"] == {"chunks": 2, "joint": False, "written": True}
        assert client.generate(golden.observation(0)) == "open the drawer"
        assert client.generate(golden.observation(0), max_tokens=1) == ""
        assert client.generate(golden.observation(0), prompt="Go home", max_tokens=3) != "open the drawer"
        said = [client.infer(golden.observation(run))["subtask"] for run in (0, 1, 2)]
        assert said == ["open the drawer", "open the drawer", "grasp it"]
        posted = pack({**golden.observation(0), "turbopi/generate": True})  # by HTTP, without a session
        headers = {"Content-Type": "application/msgpack"}
        url = f"http://127.0.0.1:{server.port}/v1/actions"
        with urllib.request.urlopen(urllib.request.Request(url, posted, headers)) as reply:
            assert unpack(reply.read())["text"] == "open the drawer"
        with RealTimeClient("127.0.0.1", server.port) as other:
            assert other.infer(golden.observation(3))["subtask"] == "Go home"
        given = client.infer({**golden.observation(0), "turbopi/subtask": "wave"})
        assert given["subtask"] == "wave" and "memory" not in given
        client.reset()
        assert client.infer(golden.observation(3))["subtask"] == "Go home"
        for keys, message in BAD_KEYS:
            sent = {f"turbopi/{key}": value for key, value in keys.items()}
            with pytest.raises(ObservationError, match=message):
                client.infer({**golden.observation(0), **sent})


def test_a_server_without_text_refuses_its_keys(tmp_path: Path) -> None:
    policy = tiny(tmp_path)
    observation = policy.example_observation()
    with running(policy) as server, RealTimeClient("127.0.0.1", server.port) as client:
        with pytest.raises(ConfigError, match='no text \\(its metadata has no "text"'):
            client.generate(observation)
        for key, value in (("generate", True), ("subtask", "wave")):
            with pytest.raises(ObservationError, match="this server's doesn't"):
                client.infer(observation | {f"turbopi/{key}": value})
        assert "subtask" not in client.infer(observation)


def test_a_subtask_is_shown_behind_the_prompt() -> None:
    assert task_of({"task": "tidy"}, {"subtask": "grasp it"}) == "tidy → grasp it"
    for answer in ({}, {"subtask": "tidy"}, {"subtask": 3}):
        assert task_of({"task": "tidy"}, answer) == "tidy"


def test_the_command_prints_what_is_written(tmp_path: Path) -> None:
    folder = make_folder("subtasks", tmp_path / "c")
    np.savez(tmp_path / "observation.npz", **runs("subtasks").observation(0))  # type: ignore[arg-type]
    arguments = ["infer", str(folder), str(tmp_path / "observation.npz"), "--generate", "", "--json"]
    options = ["--precision", "f32", "--device", "cpu", "--tokenizer", str(TOKENIZER)]
    result = CliRunner().invoke(app, arguments + options)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["text"] == ["open the drawer"]
    acted = CliRunner().invoke(app, [*arguments[:3], "-o", str(tmp_path / "a.npz"), "--no-plot", *options])
    assert acted.exit_code == 0 and "subtask: 'open the drawer'" in acted.output
    refused = CliRunner().invoke(app, [*arguments, "--seed", "1"])
    assert refused.exit_code != 0 and "--generate makes no actions" in refused.output
