"""Pi0-FAST through `UnifiedPolicy`, from checkpoint folders as its owners write them, against what they computed."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pi0_fast_golden import GOLDEN, RUNS, TOKENIZER, make_folder, make_hub, policy_of, runs
from replayed_graphs import Replayed, replay_on_cpu
from safetensors.numpy import load_file, save_file
from sentencepiece import SentencePieceProcessor
from smolvla_golden import relative
from typer.testing import CliRunner, Result

from turbopi import UnifiedPolicy
from turbopi.backends import tokens
from turbopi.bench.work import Job
from turbopi.checkpoint import open_checkpoint, random_checkpoint
from turbopi.cli import app
from turbopi.config import PRESETS
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning
from turbopi.models.pi0_fast.answers import Unread
from turbopi.realtime import RealTimeClient
from turbopi.realtime.running_chunk import RunningChunk
from turbopi.serve import running
from turbopi.support.errors import (
    ActionError,
    BackendUnavailable,
    CheckpointError,
    ConfigError,
    ObservationError,
    TokenizerError,
)
from turbopi.verify.intermediates import tensors_of

BROKEN = {
    ("broken", 0): "has 14 coefficients, and 8 actions of 7 values have 56",
    ("broken", 1): "has 120 coefficients",
    ("broken", 3): "cut character",
    ("broken", 4): "has 0 coefficients",
    ("no_prefix", 0): "begins with",
    ("no_prefix", 1): "has the code -3",
    ("openpi", 1): "coefficients, and 8 actions",
}
P = "model.paligemma_with_expert.paligemma."
HEAD, EMBEDDING = P + "lm_head.weight", P + "model.language_model.embed_tokens.weight"
ALL = [(name, run) for name, count in RUNS.items() for run in range(count)]
WHOLE = [one for one in ALL if one not in BROKEN and one[0] != "short_execution"]


@pytest.fixture(scope="module", autouse=True)
def hub(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HF_HUB_CACHE", str(make_hub(tmp_path_factory.mktemp("hub"))))
        yield


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("fast")
    for name in RUNS:
        make_folder(name, root / name)
    return root


@pytest.mark.parametrize(("name", "run"), WHOLE)
def test_a_folder_gives_its_owners_actions(folders: Path, name: str, run: int) -> None:
    policy, golden = policy_of(folders / name), runs(name)
    assert policy.metadata["model"] == "pi0_fast"
    answer = policy.infer(golden.observation(run), model_actions=True)
    assert relative(answer["model_actions"], golden.expected(run)["normalized_actions"]) <= 1e-6
    assert relative(answer["actions"], golden.actions(run)) <= 1e-6


@pytest.mark.parametrize(("name", "run"), BROKEN)
def test_a_broken_answer_gives_no_actions(folders: Path, name: str, run: int) -> None:
    policy, observation = policy_of(folders / name), runs(name).observation(run)
    with pytest.raises(ActionError, match=BROKEN[name, run]):
        policy.infer(observation)


def test_a_broken_answer_in_a_batch_is_named(folders: Path) -> None:
    with pytest.raises(ActionError, match=r"observation 1 of 2.*Nothing is sent to the robot"):
        policy_of(folders / "broken").infer_batch([runs("broken").observation(run) for run in (2, 0)])


@pytest.mark.parametrize(("name", "run"), BROKEN)
def test_the_owners_own_reading_is_given_on_request(tmp_path: Path, name: str, run: int) -> None:
    policy = policy_of(make_folder(name, tmp_path / name, broken_answers="owners"))
    golden = runs(name)
    if "error" in golden.expected(run):
        with pytest.raises(ActionError, match="begins with"):  # LeRobot raises, too
            policy.infer(golden.observation(run))
        return
    assert relative(policy.infer(golden.observation(run))["actions"], golden.actions(run)) <= 1e-6


def test_all_actions_of_an_answer_are_read_whatever_lerobot_executes(folders: Path, tmp_path: Path) -> None:
    golden = runs("short_execution")
    policy = policy_of(folders / "short_execution")
    assert any("n_action_steps = 4" in note for note in open_checkpoint(folders / "short_execution").source.notes)
    assert policy.infer(golden.observation(0))["actions"].shape == (8, 7)
    theirs = make_folder("short_execution", tmp_path / "theirs", action_horizon=4, broken_answers="owners")
    assert relative(policy_of(theirs).infer(golden.observation(0))["actions"], golden.actions(0)) <= 1e-6


def test_a_flow_s_options_are_refused_by_name(folders: Path) -> None:
    policy, observation = policy_of(folders / "base"), runs("base").observation(0)
    chunk = RunningChunk(left_over=np.zeros((4, 7), np.float32), delay=1)
    given: Any
    for given in (
        {"num_steps": 5},
        {"solver": "heun"},
        {"time_grid": "shifted_to_noise"},
        {"noise": np.zeros((8, 7), np.float32)},
        {"horizon": 4},
        {"previous": chunk},
        {"conditioning": Conditioning(held=np.arange(8) < 1, values=np.zeros((8, 7), np.float32))},
    ):
        with pytest.raises(ObservationError, match="writes its actions as tokens"):
            policy.infer(observation, **given)
    with pytest.raises(ConfigError, match="no denoising steps"):
        policy_of(folders / "base", num_denoising_steps=5)
    with pytest.raises(ConfigError, match="real-time mode 'rtc'; this policy has none"):
        policy.warmup(real_time="rtc")
    with pytest.raises(BackendUnavailable, match="has no plan for Pi0-FAST"):
        policy_of(folders / "base", backend="pytorch_compile")
    with pytest.raises(ConfigError, match="this is for Pi0 and Pi0"):
        _ = policy.config.planned_model
    assert not policy.runs_batches and policy.metadata["real_time"]["modes"] == []
    policy.warmup()


def test_the_action_tokenizer_is_found_or_asked_for(
    folders: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with monkeypatch.context() as patch:
        patch.setenv("HF_HUB_CACHE", str(tmp_path / "nothing"))
        for name, repository in (("base", "lerobot/fast-action-tokenizer"), ("openpi", "physical-intelligence/fast")):
            with pytest.raises(TokenizerError, match=rf"hf download {repository}`; or say in a turbopi\.json"):
                policy_of(folders / name)
        policy_of(folders / "relative")  # its folder holds the copy that training used
        named = make_folder("base", tmp_path / "named", action_tokenizer=str(GOLDEN / "hub/fast"))
        policy_of(named)
    assert "action tokenizer" not in caplog.text
    other = make_folder("relative", tmp_path / "other")
    file = other / "action_tokenizer/processor_config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"scale": 7}))
    policy_of(other)
    assert "isn't the one that is used" in caplog.text
    with pytest.raises(TokenizerError, match="has no id_to_piece"):
        policy_of(folders / "base", tokenizer=_Encoder())


class _Encoder:
    def encode(self, text: str, *, add_bos: bool) -> list[int]:
        return [2, 3]


def first_logits(policy: Any, observation: dict[str, object]) -> torch.Tensor:
    trace: dict[str, torch.Tensor] = {}
    inputs = Observation.stack([policy.prepare(observation)])
    policy.backend.model.generate(inputs, policy.backend.reader, 2, trace=trace, forced=[7])
    return trace["logits"]


def test_lm_head_writes_and_embed_tokens_reads_where_lerobot_trained_them_apart(tmp_path: Path) -> None:
    """A head whose rows are moved by one moves the logits by one, also those behind a written token."""
    folder, observation = make_folder("base", tmp_path / "apart"), runs("base").observation(0)
    tied = first_logits(policy_of(folder, backend="pytorch"), observation)
    tensors = load_file(folder / "model.safetensors")
    save_file(tensors | {HEAD: np.roll(tensors[HEAD], 1, axis=0)}, folder / "model.safetensors")
    checkpoint = open_checkpoint(folder)
    assert checkpoint.info()["notes"] == [] and "lm_head.weight" in checkpoint.source.shapes
    apart = first_logits(policy_of(folder, backend="pytorch"), observation)
    assert torch.equal(apart, tied.roll(1, dims=-1))
    base, adapted = (make_folder("base", tmp_path / name) for name in ("base", "adapted"))  # of lm_head alone
    (adapted / "model.safetensors").unlink()
    config = json.loads((adapted / "config.json").read_text()) | {"use_peft": True}
    (adapted / "config.json").write_text(json.dumps(config))
    lora = {"peft_type": "LORA", "r": 1, "lora_alpha": 1, "base_model_name_or_path": str(base)}
    (adapted / "adapter_config.json").write_text(json.dumps(lora))
    rows, width = tensors[HEAD].shape
    a, b = np.eye(1, width, dtype=np.float32), 2 * np.eye(1, rows, 5, dtype=np.float32).T
    where = f"base_model.model.{HEAD.removesuffix('weight')}"
    save_file({f"{where}lora_A.weight": a, f"{where}lora_B.weight": b}, adapted / "adapter_model.safetensors")
    state = open_checkpoint(adapted).load("cpu", "f32").state
    change = state["lm_head.weight"] - state["vlm.embed_tokens.weight"]
    assert change[5, 0] == 2 and change.count_nonzero() == 1
    for missing in (EMBEDDING, HEAD):
        save_file({name: one for name, one in tensors.items() if name != missing}, base / "model.safetensors")
        with pytest.raises(CheckpointError, match=r"has one table for both\. Merge it in LeRobot's environment"):
            open_checkpoint(adapted)


def test_a_prompt_that_names_a_control_piece_has_it_as_in_lerobot(folders: Path) -> None:
    policy = policy_of(folders / "base")
    inputs = policy.prepare(runs("base").observation(0) | {"task": "put</s><pad>it"})
    tokens, encode = inputs.tokens[inputs.token_mask].tolist(), SentencePieceProcessor(model_file=str(TOKENIZER)).encode
    beginning = [2, *encode("Task: put"), 1, 0, *encode("it, State: ")]
    assert tokens[: len(beginning)] == beginning


def test_the_tokenizer_that_lerobot_saves_reads_answers_too(folders: Path) -> None:
    golden, policy = runs("quantiles_empty_camera"), policy_of(folders / "quantiles_empty_camera", tokenizer=None)
    assert policy.metadata["tokenizer"].endswith("tokenizer/tokenizer.json")
    assert relative(policy.infer(golden.observation(1))["actions"], golden.actions(1)) <= 1e-6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"temperature": 0.7}, "temperature = 0.7, which Turbo-Pi doesn't compute; it does greedy decoding"),
        ({"max_decoding_steps": 0}, "max_decoding_steps is 0; expected a whole number from 1"),
        ({"type": "pi05"}, "has a step 'pi0_fast_prepare_state_tokenizer_processor_step'|are pi0_fast weights"),
    ],
)
def test_what_is_not_computed_is_refused_by_its_key(tmp_path: Path, change: dict[str, object], message: str) -> None:
    folder = make_folder("base", tmp_path / "changed")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | change))
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(folder)


def test_keys_of_another_family_are_refused(tmp_path: Path) -> None:
    folder = make_folder("base", tmp_path / "grid", time_grid="multiplied")
    with pytest.raises(ConfigError, match="time_grid can't be chosen for Pi0-FAST"):
        open_checkpoint(folder)
    file = tmp_path / "of_pi05.json"
    file.write_text('{"broken_answers": "owners"}')
    with pytest.raises(ConfigError, match=r"broken_answers can't be chosen for Pi0\.5"):
        random_checkpoint("pi05_tiny", config_source=file)


def test_weights_without_lerobots_files_are_named(tmp_path: Path, folders: Path) -> None:
    tensors = load_file(folders / "base/model.safetensors")
    save_file({name.removeprefix("model."): one for name, one in tensors.items()}, tmp_path / "model.safetensors")
    with pytest.raises(CheckpointError, match=r"looks like LeRobot's Pi0-FAST, but no config\.json"):
        open_checkpoint(tmp_path, "pi0_fast_libero")


def test_droid_s_wrist_camera_is_the_last_of_three() -> None:
    droid, tiny = PRESETS["pi0_fast_droid"], PRESETS["pi0_fast_tiny"]
    policy = UnifiedPolicy(random_checkpoint(dataclasses.replace(droid, model=tiny.with_model(action_dim=8).model)))
    observation = policy.example_observation()
    inputs = policy.prepare(observation)
    assert inputs.image_mask.tolist() == [True] * 3 and not inputs.images[1].any()
    assert np.array_equal(inputs.images[2], observation["observation/wrist_image_left"])
    reading = policy._checks.reading(policy.pipeline.see(dict(observation)))
    assert reading is not None
    assert set(reading.images) == {"observation/exterior_image_1_left", "observation/wrist_image_left"}


def test_a_server_goes_on_behind_a_broken_answer(folders: Path, caplog: pytest.LogCaptureFixture) -> None:
    policy, golden = policy_of(folders / "broken"), runs("broken")
    policy.warmup()  # of made-up observations, whose answers may say anything
    assert "can't be read" not in caplog.text
    with running(policy) as server:
        client = RealTimeClient("127.0.0.1", server.port)
        assert client.metadata["max_decoding_steps"] == 80 and client.metadata["num_denoising_steps"] == 0
        with pytest.raises(ActionError, match=r"has 14 coefficients.*Nothing is sent to the robot"):
            client.infer(golden.observation(0))
        assert relative(client.infer(golden.observation(2))["actions"], golden.actions(2)) <= 1e-6
        client.close()


# -- the captured decoding, on a CPU -----------------------------------------------------------------------------------


@pytest.fixture
def cuda_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    replay_on_cpu(monkeypatch)


@pytest.mark.parametrize("name", ["base", "quantiles_empty_camera", "openpi"])
def test_graphs_write_what_the_reference_writes(folders: Path, cuda_graph: None, name: str) -> None:
    policy, golden = policy_of(folders / name, backend="cuda_graph"), runs(name)
    assert type(policy.backend) is tokens.CapturedTokensBackend
    policy.warmup(cameras=int(golden.expected(0)["image_mask"].sum()))
    for run in (0, 1, 0) if name != "openpi" else (0, 0):
        before = Replayed.launches
        answer = policy.infer(golden.observation(run))
        assert relative(answer["actions"], golden.actions(run)) <= 1e-6
        ids = np.trim_zeros(golden.expected(run)["generated"])
        assert Replayed.launches - before <= 2 + len(ids) + tokens.LOOK
    assert set(answer["policy_timing"]) >= {"vision_ms", "prefix_ms", "denoise_ms"}


def test_graphs_show_the_reference_s_intermediates(folders: Path, cuda_graph: None) -> None:
    name, noise = "quantiles_empty_camera", torch.randn(1, 8, 7, generator=torch.Generator().manual_seed(0))
    traces = []
    for backend in ("pytorch", "cuda_graph"):
        policy = policy_of(folders / name, backend=backend)
        inputs = policy.prepare(runs(name).observation(0))
        traces.append((policy.backend.intermediates(Observation.stack([inputs]), noise, 80), inputs))
    (ours, inputs), (theirs, _) = traces[1], traces[0]
    found, exact = (tensors_of(trace, inputs, with_prefix=True) for trace in (ours, theirs))
    assert found.keys() <= exact.keys() and len(found) == 16 + 2 * len(theirs["kv_k"])
    for place, values in found.items():
        assert relative(values, exact[place]) <= 1e-5, place


def test_strict_refuses_cameras_that_warm_up_left_out(folders: Path, cuda_graph: None) -> None:
    policy = policy_of(folders / "base", backend="cuda_graph", strict=True)
    with pytest.raises(ObservationError, match=r"strict: .*2 cameras"):
        policy.infer(runs("base").observation(0))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*script_method:DeprecationWarning")
def test_a_compiled_step_writes_the_reference_s_ids(folders: Path) -> None:
    """The step as `cuda_graph` compiles it, but for a CPU."""
    policy, golden = policy_of(folders / "relative"), runs("relative")
    backend: Any = policy.backend
    model, reader = backend.model, backend.reader
    observation = Observation.stack([policy.prepare(golden.observation(0))])
    decoding = model.allocate(observation, 80, reader.ends)
    step: Any = torch.compile(model.step, fullgraph=True, dynamic=False, options={"coordinate_descent_tuning": True})
    with torch.no_grad():
        model.begin(observation, decoding)
        while (rows := decoding.rows(reader, 80)) is None:
            step(decoding)
    assert rows == model.generate(observation, reader, 80)


# -- commands ----------------------------------------------------------------------------------------------------------


def run_command(*arguments: object) -> Result:
    result = CliRunner().invoke(app, [str(one) for one in arguments])
    assert result.exit_code == 0, result.output
    return result


def _document(result: Result) -> dict[str, Any]:
    """Of --json: what is printed on stdout."""
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def test_commands_take_it(folders: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "observation.npz", **runs("base").observation(0))  # type: ignore[arg-type]
    base, options = folders / "base", ("--precision", "f32", "--tokenizer", TOKENIZER)
    out = tmp_path / "actions.npz"
    printed = run_command("infer", base, tmp_path / "observation.npz", *options, "--json", "-o", out)
    assert np.shape(_document(printed)["actions"]) == (8, 7)
    described = _document(run_command("inspect", base, "--json"))
    assert described["kind"] == "pi0_fast" and described["parameters"]["expert"] == 0


def test_a_timed_job_has_tokens_and_no_horizon_or_steps() -> None:
    assert str(Job(writes_tokens=True)) == "2 cameras, 48 tokens, 10 tokens written"
    assert str(Job()) == "2 cameras, 48 tokens, H=10, 10 steps"
    refused = CliRunner().invoke(app, ["bench", "--random-weights", "pi0_fast_tiny", "--horizons", "10"])
    assert refused.exit_code == 2 and "writes tokens, --steps of them, and has no horizon" in refused.stderr


@pytest.mark.slow
def test_a_benchs_title_and_report_have_tokens_written(tmp_path: Path) -> None:
    quick = ("bench", "--random-weights", "pi0_fast_tiny", "--calls", "1", "--seconds", "0", "--cameras", "1")
    shown = " ".join(run_command(*quick, "--steps", "1,2", "--no-error", "--report", tmp_path).stdout.split())
    for text in (shown, (tmp_path / "report.md").read_text()):
        assert "2 tokens written" in text and " H=10" not in text and " steps" not in text


@pytest.mark.slow
def test_random_weights_are_timed_and_verified(tmp_path: Path) -> None:
    measured = run_command(
        *("bench", "--random-weights", "pi0_fast_tiny", "--calls", "1", "--steps", "2,3", "--seconds", "0"),
        *("--precisions", "f32", "--cameras", "1", "--json"),
    )
    document = _document(measured)
    assert document["main_job"]["writes_tokens"] is True
    results = document["results"]
    assert [one["job"]["steps"] for one in results] == [2, 3] and all(one["floor_ms"]["denoise"] for one in results)
    verified = run_command(
        *("verify", "--random-weights", "pi0_fast_tiny", "--backend", "pytorch", "--precision", "f32", "--count", "1"),
        *("--noises", "1", "--json"),
    )
    document = _document(verified)
    assert document["decides"] == "logits" and document["ok"]
    assert Unread(random_checkpoint("pi0_fast_tiny").config.model).actions([1, 2]).shape == (10, 7)  # type: ignore[arg-type]
