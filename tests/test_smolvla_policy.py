"""SmolVLA through `UnifiedPolicy`, from checkpoint folders as LeRobot writes them, against what LeRobot computed."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from checkpoint_helpers import edit_json, write_json
from cli_helpers import turbopi
from smolvla_golden import COMMIT, GOLDEN, GoldenRuns, make_aloha, make_checkpoint, make_hub, relative

from turbopi import UnifiedPolicy
from turbopi.backends.captured import CapturedBackend
from turbopi.backends.fused_smolvla import FusedSmolVLABackend
from turbopi.checkpoint import open_checkpoint
from turbopi.checkpoint.lerobot_vlm import completed
from turbopi.checkpoint.vision_positions import shifted_rows
from turbopi.models.smolvla.config import PUBLISHED, SmolVLAConfig, from_lerobot
from turbopi.models.smolvla.positions import position_rows
from turbopi.preprocess.images import fit_unit, fitted
from turbopi.realtime.messages import NOTES
from turbopi.realtime.running_chunk import RunningChunk
from turbopi.support.errors import BackendUnavailable, CheckpointError, ConfigError, ObservationError, TokenizerError

pytest.importorskip("tokenizers", reason="SmolVLA's prompts need the extra `smolvla`")
SCHEDULES: Any = {"LINEAR": "linear", "EXP": "exponential", "ONES": "ones", "ZEROS": "zeros"}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """hub/ and each case's folder, as `CASE/checkpoint`: peft's base is beside it."""
    root = tmp_path_factory.mktemp("smolvla")
    make_hub(root / "hub")
    for one in GOLDEN.iterdir():
        if (one / "model.safetensors.xz").is_file():
            make_checkpoint(one.name, root / one.name / "checkpoint")
    make_adapter = root / "peft" / "checkpoint"
    make_adapter.mkdir(parents=True)
    for file in (GOLDEN / "peft/checkpoint").iterdir():
        (make_adapter / file.name).write_bytes(file.read_bytes())
    return root


@pytest.fixture
def hub(folders: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HF_HUB_CACHE", str(folders / "hub"))
    return folders / "hub"


@pytest.mark.parametrize("name", ["base", "missing_camera", "special_tokens", "long_prompt", "peft", "bf16"])
def test_a_folder_of_lerobots_gives_its_actions(name: str, folders: Path, hub: Path) -> None:
    policy, golden = UnifiedPolicy(folders / name / "checkpoint", precision="f32"), GoldenRuns(name)
    assert policy.metadata["model"] == "smolvla"
    for run in range(len(golden)):
        actions = policy.infer(golden.observation(run), noise=golden.noise)["actions"]
        assert relative(actions, golden.actions(run, "float32/" if name == "bf16" else "")) <= 2e-5  # seen: 3e-6


def test_aloha_and_tokens_around_cameras_that_are_not_there_are_lerobots(hub: Path, tmp_path: Path) -> None:
    """By tools/lerobot_cases/smolvla_aloha.py. One camera is always missing, and one in the second observation."""
    folder, kept = make_aloha(tmp_path / "aloha")
    policy = UnifiedPolicy(folder, precision="f32")
    seen = [{key[2:]: one for key, one in kept.items() if key.startswith(f"{run}/observation")} for run in range(2)]
    for run, one in enumerate(seen):
        actions = policy.infer({**one, "task": "pick up the cup"}, noise=kept["noise"])["actions"]
        assert relative(actions, kept[f"{run}/actions"]) <= 2e-5
    several = policy.infer_batch([{**one, "task": "pick up the cup"} for one in seen], seed=1)
    for row, one in enumerate(seen):
        alone = policy.infer({**one, "task": "pick up the cup"}, seed=1 + row)["actions"]
        assert relative(several[row]["actions"], alone) <= 1e-5
    for backend in (CapturedBackend, FusedSmolVLABackend):
        assert "tokens around images that aren't" in str(backend.refuses_model(policy.config.model))


def test_bfloat16_is_lerobots_own(folders: Path, hub: Path) -> None:
    policy, golden = UnifiedPolicy(folders / "bf16" / "checkpoint", precision="bf16"), GoldenRuns("bf16")
    for run in range(len(golden)):
        actions = policy.infer(golden.observation(run), noise=golden.noise)["actions"]
        assert relative(actions, golden.actions(run)) <= 5e-2


def test_chunks_join_as_in_lerobot(folders: Path, hub: Path) -> None:
    policy, golden = UnifiedPolicy(folders / "rtc" / "checkpoint", precision="f32"), GoldenRuns("rtc")
    assert policy.metadata["real_time"]["modes"] == ["rtc", "rtc_identity", "warm_start", "paint"]
    horizon, joined = policy.config.model.action_horizon, 0
    for run, one in enumerate(golden.described["runs"]):
        rtc = one["rtc"]
        if not rtc["prev_rows"] or rtc["inference_delay"] > rtc["execution_horizon"]:
            continue
        left_over = golden.previous[-rtc["prev_rows"] :].astype(np.float32)
        end = rtc["execution_horizon"]
        chunk = RunningChunk(
            left_over=np.pad(left_over, ((0, 0), (0, 32 - left_over.shape[1]))),
            delay=rtc["inference_delay"],
            execution_horizon=horizon - end if end < horizon else None,
            mode="rtc_identity",
            schedule=SCHEDULES[rtc["schedule"]],
            max_guidance_weight=rtc["max_guidance_weight"],
        )
        actions = policy.infer(golden.observation(run), noise=golden.noise, previous=chunk)["actions"]
        assert relative(actions, golden.actions(run)) <= 2e-5
        joined += 1
    assert joined >= 5


def test_a_batch_is_its_observations_one_by_one(folders: Path, hub: Path) -> None:
    policy, golden = UnifiedPolicy(folders / "base" / "checkpoint", precision="f32"), GoldenRuns("base")
    several = [golden.observation(run) for run in range(2)]
    together = policy.infer_batch(several, seed=1)
    for row, one in enumerate(several):
        alone = policy.infer(one, seed=1 + row)["actions"]
        assert relative(together[row]["actions"], alone) <= 1e-5
    misspelt = several[0]
    *_, last = (key for key in misspelt if "images" in key)
    misspelt[f"{last}x"] = misspelt.pop(last)
    for answer in (policy.infer(misspelt, seed=1), *policy.infer_batch([misspelt], seed=1)):
        (note,) = (one for one in answer[NOTES] if one["kind"] == "camera_missing" and "misspelt" in one["text"])
        assert note["names"] == [last] and f"has {last}x, which isn't read" in note["text"]


def test_what_is_missing_is_named(folders: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "nothing"))
    with pytest.raises(CheckpointError, match="don't fit the model"):  # the published sizes aren't these
        open_checkpoint(folders / "base" / "checkpoint")
    other = make_checkpoint("base", tmp_path / "other")
    config = json.loads((other / "config.json").read_text())
    (other / "config.json").write_text(json.dumps(config | {"vlm_model_name": "somebody/else"}))
    with pytest.raises(CheckpointError, match="hf download somebody/else config"):
        open_checkpoint(other)
    vlm = folders / "hub/models--HuggingFaceTB--SmolVLM2-500M-Video-Instruct/snapshots" / COMMIT
    (other / "turbopi.json").write_text(json.dumps({"vlm": str(vlm)}))
    assert open_checkpoint(other).config.model.vocab_size == 352
    with pytest.raises(TokenizerError, match="hf download NAME tokenizer"):
        UnifiedPolicy(other)
    assert UnifiedPolicy(other, tokenizer=vlm).metadata["tokenizer"] == str(vlm / "tokenizer.json")
    own = make_checkpoint("base", tmp_path / "own")  # whose processors name that model's tokenizer
    (own / "turbopi.json").write_text(json.dumps({"vlm": str(vlm)}))
    assert UnifiedPolicy(own).metadata["tokenizer"] == str(vlm / "tokenizer.json")
    assert f"OK    tokenizer   {vlm / 'tokenizer.json'}\n" in turbopi("doctor", "--checkpoint", own).stdout
    (own / "turbopi.json").write_text(json.dumps({"vlm": str(tmp_path / "empty")}))
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "config.json").write_bytes((vlm / "config.json").read_bytes())
    assert "or give --tokenizer its folder" in turbopi("doctor", "--checkpoint", own).stdout


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"adapt_to_pi_aloha": True}, "for 14 joints and grippers, but the state has 6 values and an action 6"),
        ({"resize_imgs_with_padding": [512, 384]}, r"resize_imgs_with_padding = \[512, 384\]"),
        ({"resize_imgs_with_padding": None}, "resize_imgs_with_padding = None"),
        ({"num_vlm_layers": 0}, r"missing .*text_model\.layers\.4\..*{\"vlm\": "),  # all six layers of that model
        ({"num_expert_layers": 3}, "3 layers of the expert don't go into 4 text layers"),
        ({"expert_width_multiplier": 0.6}, "the expert is 9 wide, and the time embedding needs an even number"),
        ({"resize_imgs_with_padding": [104, 104]}, "13 patches a side, of 104 pixels, aren't a multiple of 4"),
    ],
)
def test_what_is_not_computed_is_refused_by_its_key(
    change: dict[str, object], message: str, hub: Path, tmp_path: Path
) -> None:
    folder = make_checkpoint("base", tmp_path / "changed")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | change))
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(folder)


def test_as_many_text_layers_as_there_are_is_what_no_number_of_them_means(hub: Path, tmp_path: Path) -> None:
    """LeRobot cuts the vision-language model's layers only where num_vlm_layers says fewer, above 0."""
    vlm = tmp_path / "vlm"
    shutil.copytree(hub / "models--HuggingFaceTB--SmolVLM2-500M-Video-Instruct/snapshots" / COMMIT, vlm)
    edit_json(vlm / "config.json", lambda config: config["text_config"].update(num_hidden_layers=4))
    for number in (-1, 0, 9):
        folder = make_checkpoint("base", tmp_path / str(number))
        write_json(folder / "turbopi.json", {"vlm": str(vlm)})
        edit_json(folder / "config.json", lambda config, number=number: config.update(num_vlm_layers=number))
        model = open_checkpoint(folder).config.model
        assert isinstance(model, SmolVLAConfig)
        assert model.text.depth == 4


def test_prompts_are_as_long_as_the_preprocessor_says(hub: Path, tmp_path: Path) -> None:
    """As in LeRobot, whose fine-tune may have another tokenizer_max_length and the base's processors."""
    folder, golden = make_checkpoint("long_prompt", tmp_path / "long"), GoldenRuns("long_prompt")
    edit_json(folder / "config.json", lambda config: config.update(tokenizer_max_length=7))
    policy = UnifiedPolicy(folder, precision="f32")
    assert relative(policy.infer(golden.observation(0), noise=golden.noise)["actions"], golden.actions(0)) <= 2e-5


def test_what_the_vision_language_models_config_leaves_out_is_transformers_default() -> None:
    """As the published SmolVLM2's does, which any user of LeRobot has in the Hub's cache."""
    whole = PUBLISHED["HuggingFaceTB/SmolVLM2-500M-Video-Instruct"]
    left_out = {"intermediate_size", "num_hidden_layers"}
    part = {**whole, "vision_config": {key: one for key, one in whole["vision_config"].items() if key not in left_out}}
    assert from_lerobot({}, completed(part)) == from_lerobot({}, whole)
    text = {"hidden_size": 2048, "rms_norm_eps": None}
    other = from_lerobot({}, completed({"text_config": text, "vision_config": {}}))
    assert (other.text.num_heads, other.text.num_kv_heads, other.text.head_dim) == (32, 32, 64)
    assert (other.text.rms_norm_eps, other.scale_factor, other.vision.patch_size) == (1e-6, 2, 32)


@pytest.mark.parametrize(
    ("part", "change", "message"),
    [
        ("text_config", {"hidden_act": "gelu"}, "text_config.hidden_act = 'gelu'; Turbo-Pi computes silu alone"),
        ("text_config", {"model_type": "gemma"}, "text_config.model_type = 'gemma'; Turbo-Pi computes llama alone"),
        ("vision_config", {"hidden_act": "gelu"}, "vision_config.hidden_act = 'gelu'; Turbo-Pi computes gelu_pytorch"),
        ("vision_config", {"image_size": 4}, "vision image_size is 4, of patches of 8"),
    ],
)
def test_another_vision_language_model_is_computed_or_refused(
    part: str, change: dict[str, object], message: str, hub: Path, tmp_path: Path
) -> None:
    """LeRobot 0.6.1 runs all but the last; Turbo-Pi's actions were up to 90 % off."""
    vlm = tmp_path / "vlm"
    shutil.copytree(hub / "models--HuggingFaceTB--SmolVLM2-500M-Video-Instruct/snapshots" / COMMIT, vlm)
    edit_json(vlm / "config.json", lambda config: config[part].update(change))
    folder = make_checkpoint("base", tmp_path / "base")
    edit_json(folder / "config.json", lambda config: config.update(resize_imgs_with_padding=[160, 160]))
    write_json(folder / "turbopi.json", {"vlm": str(vlm)})
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(folder)


@pytest.mark.parametrize(
    ("patches", "table", "element_type", "off"),
    [
        *((32, 32, kind, []) for kind in ("float32", "bfloat16")),  # the published model's
        (40, 40, "float32", [19]),
        (24, 24, "bfloat16", [5, 7, 10, 14, 17, 20, 23]),
        (36, 27, "bfloat16", [20, 28]),
    ],
)
def test_positions_are_rounded_as_in_transformers(patches: int, table: int, element_type: Any, off: list[int]) -> None:
    """`SmolVLMVisionEmbeddings` of transformers 5.5.4 on a CPU: rows that it takes one too early or too late."""
    rows = position_rows(patches, table, element_type).tolist()
    assert [i for i, row in enumerate(rows) if row != i * table // patches] == off


OLD = ("pretrained_revision", "compile_model", "compile_mode", "rtc_config", "use_peft")  # keys since 0.6, …, 0.4.3


def written_by(folder: Path, version: str) -> Path:
    """golden `base` as an older LeRobot writes it."""
    make_checkpoint("base", folder)
    for key in OLD if version < "0.4.3" else OLD[:1]:
        edit_json(folder / "config.json", lambda config, key=key: config.pop(key))
    return folder


def test_actions_are_those_of_the_lerobot_that_wrote_the_files(hub: Path, tmp_path: Path) -> None:
    golden, theirs = GoldenRuns("base"), np.load(GOLDEN / "base/lerobot_0.4.npz")

    def error(folder: Path, key: str, **settings: str) -> float:
        write_json(folder / "turbopi.json", settings)
        policy = UnifiedPolicy(folder, precision="f32")
        return relative(policy.infer(golden.observation(3), noise=golden.noise)["actions"], theirs[key])

    first = written_by(tmp_path / "first", "0.4.0")
    assert error(first, "0.4.0") <= 3e-6
    assert error(first, "0.4.0", lerobot_semantics="0.6") > 1e-5  # t is rounded otherwise
    last = written_by(tmp_path / "last", "0.4.4")
    assert error(last, "0.4.4", vision_positions="shifted") <= 3e-6
    assert error(last, "0.4.4") > 1e-1


def test_positions_that_no_file_tells_are_noted(folders: Path, hub: Path, tmp_path: Path) -> None:
    def noted(folder: Path) -> bool:
        return any("one row and one column too early" in note for note in open_checkpoint(folder).source.notes)

    folder = written_by(tmp_path / "old", "0.4.4")
    assert noted(folder)
    assert not noted(folders / "base" / "checkpoint")  # 0.6 wrote it
    plain = open_checkpoint(folder).fingerprint()
    for choice in ("exact", "shifted"):
        write_json(folder / "turbopi.json", {"vision_positions": choice})
        assert not noted(folder)
        assert (open_checkpoint(folder).fingerprint() == plain) == (choice == "exact")
    for change, message in (
        ({"resize_imgs_with_padding": [160, 160]}, "the table of positions has, 16, but an image has 20"),
        ({"load_vlm_weights": True}, "in a bfloat16 vision tower no version"),
    ):
        edit_json(folder / "config.json", lambda config, change=change: config.update(change))
        with pytest.raises(ConfigError, match=message):
            open_checkpoint(folder)


@pytest.mark.parametrize(("patches", "taken"), [(4, [0, 0, 1, 2]), (2, [0, 1]), (3, [0, 1, 2])])
def test_positions_are_shifted_as_they_were(patches: int, taken: list[int]) -> None:
    """A table of four rows: what those versions of transformers took of it."""
    rows = shifted_rows(4, patches)
    assert [int(rows[i * 4 // patches]) for i in range(patches)] == taken


def test_a_folder_of_before_0_4_is_to_be_migrated(folders: Path, hub: Path, tmp_path: Path) -> None:
    from safetensors.numpy import load_file, save_file

    folder = written_by(tmp_path / "old", "0.3")
    for file in folder.glob("policy_*"):
        file.unlink()
    with pytest.raises(CheckpointError, match="is the download complete"):
        open_checkpoint(folder)
    weights = load_file(folder / "model.safetensors")
    statistics = {"unnormalize_outputs.buffer_action.mean": np.zeros(6, np.float32)}
    save_file(weights | statistics, folder / "model.safetensors")
    with pytest.raises(CheckpointError, match=f"migrate_policy_normalization --pretrained-path {folder}"):
        open_checkpoint(folder)


def test_statistics_that_are_not_there_are_said_and_nothing_is_scaled(hub: Path, tmp_path: Path) -> None:
    """As in lerobot/smolvla_base, whose files have another dataset's alone."""
    from safetensors.numpy import load_file, save_file

    folder = make_checkpoint("base", tmp_path / "unscaled")
    for file in folder.glob("policy_*.safetensors"):
        save_file({f"so100.buffer.{key}": value for key, value in load_file(file).items()}, file)
    policy, golden = UnifiedPolicy(folder, precision="f32"), GoldenRuns("base")
    notes = [note for note in open_checkpoint(folder).source.notes if "has no statistics of" in note]
    assert len(notes) == 2
    assert "observation.state" in notes[0] and "action" in notes[1]
    answer = policy.infer(golden.observation(0), noise=golden.noise, model_actions=True)
    assert np.array_equal(answer["actions"], answer["model_actions"][:, :6].astype(np.float64))


def test_what_has_no_plan_for_it_says_so(folders: Path, hub: Path) -> None:
    checkpoint = folders / "base" / "checkpoint"
    with pytest.raises(BackendUnavailable, match="has no plan for SmolVLA"):
        UnifiedPolicy(checkpoint, backend="pytorch_compile")
    policy = UnifiedPolicy(checkpoint, precision="f32")
    with pytest.raises(ConfigError, match="this is for Pi0 and Pi0"):
        _ = policy.config.planned_model
    with pytest.raises(ObservationError, match="the observation has no camera"):
        policy.infer({"observation.state": np.zeros(6, np.float32), "task": "x"})


def test_images_are_fitted_on_a_device_as_on_the_host() -> None:
    for shape in ((48, 64, 3), (100, 30, 3), (128, 128, 3)):
        image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
        for resize in ("lerobot_smolvla", "lerobot", "lerobot_0.4"):
            ours = fit_unit(torch.from_numpy(image)[None] / 255, (128, 128), resize)[0]
            assert np.abs(ours.numpy() - fitted(image, 128, resize)).max() <= 3e-7
