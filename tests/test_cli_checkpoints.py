"""`turbopi inspect` and `turbopi convert`."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import smolvla_golden
from checkpoint_helpers import GOLDEN, torch_copy
from cli_helpers import refusal, text_of, turbopi
from lerobot_golden import GOLDEN as GOLDEN_LEROBOT
from lerobot_golden import GoldenCase

from turbopi.checkpoint import open_checkpoint, random_checkpoint
from turbopi.checkpoint.source import mark_random_reported, unreported_notes
from turbopi.cli import checkpoints
from turbopi.policy.shipped import FRAMES, SMALL_POLICY, load_frames

ARM = {
    "name": "my_arm",
    "cameras": {"front": "base_0_rgb"},
    "state": {"joints": 6},
    "action_dim": 6,
}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint folder that `turbopi convert` made of random weights."""
    folder = tmp_path_factory.mktemp("checkpoints") / "tiny"
    result = turbopi("convert", "--random-weights", "pi05_tiny", folder, "--weights-seed", 4)
    assert result.exit_code == 0, result.output
    assert "RANDOM WEIGHTS (pi05_tiny, seed 4): the actions mean nothing." in result.stdout
    assert f"random -> {folder}: 11.66 MB in bf16" in result.stdout
    return folder


def test_inspect_shows_what_the_folder_holds(tiny: Path) -> None:
    result = turbopi("inspect", tiny)
    assert result.exit_code == 0, result.output
    shown = text_of(result.stdout)
    for fact in (
        "format openpi_torch",
        "model pi05",
        "configuration pi05_tiny with random weights, seed 4, from",
        "robot libero",
        "action horizon 10",
        "prompt at most 200 tokens, the state in it",
        "statistics asset physical-intelligence/libero",
        "of the state quantile; 8 dimensions of mean, std, q01, q99",
        "of the actions quantile; 7 dimensions",
        "sizes: vlm width 192, mlp dim 512, depth 6, num heads 8, num kv heads 1, head dim 32",
        "weights 235 tensors, 11.34 MB, stored as BF16",
        "vision tower (SigLIP) 1,298,048",
        "total 5,672,480",
    ):
        assert fact in shown.replace("┃", " ").replace("  ", " "), fact


def test_inspect_shows_the_statistics_by_joint_with_units(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    shown = turbopi("inspect", SMALL_POLICY).stdout
    assert max(map(len, shown.splitlines())) <= 80
    rows = [[cell.strip() for cell in line.strip("│").split("│")] for line in shown.splitlines()]
    assert ["axis-angle x", "rad", "2.187", "3.166", "2.839", "0.4209"] in rows
    assert ["gripper", "−1 open, 1 closed", "-1", "1", "0.1608", "0.987"] in rows
    document = json.loads(turbopi("inspect", SMALL_POLICY, "--json").stdout)
    q01 = document["norm_stats"]["state"]["values"]["q01"]
    assert q01 == pytest.approx(open_checkpoint(SMALL_POLICY).norm_stats.state.q01.tolist())  # type: ignore[union-attr]
    assert document["labels"]["state"][3] == {"name": "axis-angle x", "unit": "rad"}
    robot = tiny.parent / "arm.json"
    robot.write_text(json.dumps(ARM | {"state": {"joints": 5, "grip": 1}}))
    shown = turbopi("inspect", tiny, "--robot", robot).stdout
    assert "joints[4]" in shown and "grip " in shown and "action 5" in shown and "unit" not in shown


def test_random_weights_that_were_converted_say_so_in_every_command(tiny: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    result = turbopi("convert", tiny, again, "--precision", "f32", "--json")
    assert "RANDOM WEIGHTS (seed 4): the actions mean nothing." in result.stderr
    for reported in (False, True):  # by a command, which says so in its own words
        source = open_checkpoint(tiny).source
        if reported:
            mark_random_reported(source)
        assert ("random weights, seed 4: actions mean nothing" in unreported_notes(source)) == (not reported)
        assert unreported_notes(source) == [], "whatever is made of the weights next"
    document = json.loads(result.stdout)
    opened = open_checkpoint(again)
    assert document["random_weights"] is True and document["checkpoint_path"] == str(tiny)
    assert document["weights"] == open_checkpoint(tiny).fingerprint()[:12]
    assert opened.random == "seed 4" and opened.info()["random_weights"] is True
    assert "note: random weights, seed 4: actions mean nothing" in turbopi("inspect", again).stdout
    (tmp_path / "own.json").write_text('{"preset": "pi05_libero", "vision_heads": 4}')
    assert open_checkpoint(again, config=tmp_path / "own.json").random == "seed 4"  # whatever turbopi.json is read
    assert open_checkpoint(SMALL_POLICY).random is None


def test_inspect_json_is_the_checkpoints_own_description(tiny: Path) -> None:
    result = turbopi("inspect", tiny, "--json", "--hash")
    document = json.loads(result.stdout)
    opened = open_checkpoint(tiny)
    assert document.items() >= ({**opened.info(), "sha256": opened.fingerprint()}).items()
    assert len(document["sha256"]) == 64


def test_inspect_of_random_weights_says_so() -> None:
    document = json.loads(turbopi("inspect", "--random-weights", "pi05_libero", "--json").stdout)
    assert document["random_weights"] is True
    assert document["parameters"]["total"] > 3.3e9
    shown = turbopi("inspect", "--random-weights", "pi05_tiny", "--weights-seed", 7).stdout
    assert "note: random weights, seed 7: actions mean nothing" in shown


def test_inspect_without_a_configuration_shows_the_rest_and_the_choices() -> None:
    result = turbopi("inspect", GOLDEN / "pi05" / "torch")
    assert result.exit_code == 0
    assert "not known yet: " in result.stdout
    assert "suggest pi05_libero" in result.stdout
    assert "443,232" in result.stdout


def test_inspect_refuses_a_wrong_configuration_after_the_rest(tmp_path: Path) -> None:
    """One that --config names, or the file beside the weights."""
    given = turbopi("inspect", GOLDEN / "pi05" / "torch", "--config", "pi05-libero")
    folder = torch_copy(tmp_path / "c", preset="pi05_libero", action_horizon=0)
    found = [(given, "did you mean pi05_libero?"), (turbopi("inspect", folder), "action_horizon is 0")]
    for change, why in (
        ({"target_time": 1}, "target_time is 1.0, but"),
        ({"preset": "pi0_libero"}, "is for pi0, but"),
        ({"lora_alpha": 16}, "lora_alpha and lora_rslora only apply to"),
        ({"discrete_state_input": True, "preset": "pi05_libero", "base_model": "x"}, "base_model only applies to"),
    ):  # what can be read, and doesn't fit
        found.append((turbopi("inspect", torch_copy(tmp_path / next(iter(change)), **change)), why))
    for result, why in found:
        assert result.exit_code == 2, result.output
        assert "443,232" in result.stdout and "not known yet" not in result.stdout
        assert result.stderr.startswith("error: ") and why in result.stderr


def test_inspect_says_where_the_tokenizer_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENPI_DATA_HOME", str(tmp_path))
    folder = GOLDEN / "pi05" / "torch"
    assert "not found: `turbopi doctor --checkpoint` says where to get it" in text_of(turbopi("inspect", folder).stdout)
    (tmp_path / "big_vision").mkdir()
    (tmp_path / "big_vision" / "paligemma_tokenizer.model").touch()
    assert "none in the folder; openpi's: " in text_of(turbopi("inspect", folder).stdout)
    assert "Turbo-Pi's own small one" in turbopi("inspect", "--random-weights", "pi05_tiny").stdout


@pytest.mark.parametrize(
    ("case", "state", "actions"),
    [
        (
            "mean_std",
            "lerobot_zscore; 8 dimensions of mean, std, q01",
            "lerobot_zscore; 7 dimensions of mean, std",
        ),
        ("min_max_identity", "lerobot_min_max; 8 dimensions of mean, std", "identity; 7 dimensions of mean, std"),
    ],
)
def test_inspect_shows_lerobots_statistics_before_the_vision_heads_are_known(
    case: str, state: str, actions: str, tmp_path: Path
) -> None:
    folder = GoldenCase(GOLDEN_LEROBOT / case).assemble(tmp_path)
    known = text_of(turbopi("inspect", folder).stdout)
    (folder / "turbopi.json").unlink()
    result = turbopi("inspect", folder)
    assert result.exit_code == 0, result.output
    shown = text_of(result.stdout)
    assert "not known yet: " in shown and "vision_heads" in shown
    for fact in ("statistics in the checkpoint's own files", f"of the state {state}", f"of the actions {actions}"):
        assert fact in shown, fact
        assert fact in known, fact
    assert "91 tensors, 271.4 kB" in shown


def test_inspect_says_that_lerobots_images_may_come_as_cameras_give_them(tmp_path: Path) -> None:
    shown = text_of(turbopi("inspect", GoldenCase(GOLDEN_LEROBOT / "mean_std").assemble(tmp_path)).stdout)
    assert "float32[3, 224, 224] in [0, 1], or uint8[height, width, 3]; any size" in shown


def test_inspect_takes_the_normalization_of_a_turbopi_json_that_lacks_the_vision_heads(tmp_path: Path) -> None:
    folder = GoldenCase(GOLDEN_LEROBOT / "mean_std").assemble(tmp_path)
    (folder / "turbopi.json").write_text(json.dumps({"normalization": "identity"}))
    assert "of the state identity; " in text_of(turbopi("inspect", folder).stdout)


def test_inspect_shows_the_robots_keys_whoever_names_the_robot(tiny: Path) -> None:
    """The turbopi.json beside the weights here; a preset with random weights; --robot."""
    own, preset = turbopi("inspect", tiny), turbopi("inspect", "--random-weights", "pi05_libero")
    for result in (own, preset, turbopi("inspect", tiny, "--robot", "libero")):
        assert result.exit_code == 0, result.output
        assert "its observation/wrist_image" in text_of(result.stdout)
        assert "its observation/state" in text_of(result.stdout)


def test_inspect_shows_a_folder_whose_robot_does_not_fit_and_says_so(tiny: Path, tmp_path: Path) -> None:
    settings = json.loads((tiny / "turbopi.json").read_text()) | {"robot": "aloha"}
    (tmp_path / "aloha.json").write_text(json.dumps(settings))
    result = turbopi("inspect", tiny, "--config", tmp_path / "aloha.json")
    assert result.exit_code == 0, result.output
    assert "no policy can be made of this: robot aloha has 14 values of state" in text_of(result.stdout)


def test_random_weights_take_a_configuration(tmp_path: Path) -> None:
    """The robot, the horizon and the rest are the configuration's, the sizes the preset's."""
    own = tmp_path / "own.json"
    own.write_text(json.dumps({"robot": "my_arm.json", "action_horizon": 12, "name": "mine"}))
    (tmp_path / "my_arm.json").write_text(json.dumps(ARM))
    for config, robot, horizon in (("pi05_droid", "droid", 15), (own, "my_arm", 12)):
        made = tmp_path / f"made-for-{robot}"
        result = turbopi("convert", "--random-weights", "pi05_tiny", made, "--config", config)
        assert result.exit_code == 0, result.output
        assert "RANDOM WEIGHTS (pi05_tiny, seed 0)" in result.stdout
        document = json.loads(turbopi("inspect", made, "--json").stdout)
        assert document["action_horizon"] == horizon
        assert document["robot"] == robot
        assert document["parameters"]["total"] == 5_672_480


def test_random_weights_refuse_what_describes_other_weights(tmp_path: Path) -> None:
    file = tmp_path / "c.json"
    file.write_text(json.dumps({"weights_sha256": "0" * 64}))
    refused = refusal(turbopi("convert", "--random-weights", "pi05_tiny", tmp_path / "out", "--config", file))
    assert refused == f"{file}: weights_sha256 only applies to a checkpoint's own weights"
    wrong = turbopi("convert", "--random-weights", "pi05_tiny", tmp_path / "out", "--config", "pi0_libero")
    assert "preset pi0_libero is for pi0, but the preset pi05_tiny of the random weights holds pi05" in refusal(wrong)


def test_a_converted_folders_description_has_no_empty_entries(tiny: Path) -> None:
    settings = json.loads((tiny / "turbopi.json").read_text())
    assert "robot" in settings
    assert None not in settings.values()


def test_inspect_refuses_what_is_no_checkpoint(tmp_path: Path) -> None:
    assert refusal(turbopi("inspect", tmp_path / "nothing")) == f"there is no folder {tmp_path / 'nothing'}"
    assert "holds no checkpoint: expected model.safetensors" in refusal(turbopi("inspect", tmp_path))
    assert "is an address; Turbo-Pi reads local folders" in refusal(turbopi("inspect", "gs://openpi/pi05_libero"))


@pytest.mark.slow
def test_a_converted_folder_runs_like_the_weights_it_is_made_of(tiny: Path, tmp_path: Path) -> None:
    """But for the few weights that bf16 mode keeps in float32 and the folder has in bfloat16."""
    frame = load_frames()[0]
    observation: dict[str, Any] = {
        "observation/image": frame.base,
        "observation/wrist_image": frame.wrist,
        "observation/state": frame.state,
        "prompt": frame.prompt,
    }
    np.savez(tmp_path / "observation.npz", **observation)
    options = ("--seed", 1, "--steps", 2, "--no-plot", "--no-warmup", "-o")
    first, second = tmp_path / "folder.npz", tmp_path / "random.npz"
    observed = tmp_path / "observation.npz"
    result = turbopi("infer", tiny, observed, *options, first)
    assert result.exit_code == 0, result.output
    random = ("--random-weights", "pi05_tiny", "--weights-seed", 4)
    result = turbopi("infer", *random, observed, *options, second)
    assert result.exit_code == 0, result.output
    with np.load(first) as folder, np.load(second) as made:
        np.testing.assert_allclose(folder["actions"], made["actions"], atol=0.1)
        assert np.ptp(folder["actions"]) > 1


def test_convert_takes_a_checkpoint_to_float32(tiny: Path, tmp_path: Path) -> None:
    result = turbopi("convert", tiny, tmp_path / "f32", "--precision", "f32", "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["folder"] == str(tmp_path / "f32")
    assert document["precision"] == "f32"
    assert open_checkpoint(tmp_path / "f32").fingerprint() == open_checkpoint(tiny).fingerprint()
    assert "openpi_torch -> " in result.stderr


def test_convert_refuses_a_folder_that_is_in_use(tiny: Path) -> None:
    result = turbopi("convert", "--random-weights", "pi05_tiny", tiny, "--json")
    assert result.exit_code == 2
    assert result.stderr.splitlines()[-1] == f"error: {tiny} exists and isn't an empty folder; give a new one"
    assert open_checkpoint(tiny).info()["name"] == "pi05_tiny with random weights, seed 4"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["a"], "convert takes two paths, the checkpoint and the new folder (or --random-weights PRESET and the new"),
        (["a", "b", "c"], "but got 3: a b c"),
        (["a", "b", "--random-weights", "pi05_tiny"], "two kinds of weights: the checkpoint 'a'"),
        (["no-such", "b"], "there is no folder no-such"),
    ],
)
def test_convert_refuses_wrong_paths(arguments: list[str], expected: str) -> None:
    assert expected in refusal(turbopi("convert", *arguments))


def test_convert_refuses_an_unknown_precision(tmp_path: Path) -> None:
    result = turbopi("convert", "--random-weights", "pi05_tiny", tmp_path / "x", "--precision", "fp16", "--json")
    assert result.exit_code == 2
    assert "error: --precision is 'fp16'; expected one of bf16, f32, fp8, fp8-mlp, fp8-f16sums, int8" in result.stderr
    assert not (tmp_path / "x").exists()


def test_the_frames_statistics_are_openpis_format() -> None:
    content = json.loads((FRAMES / "norm_stats.json").read_text())
    assert set(content["norm_stats"]) == {"state", "actions"}
    assert random_checkpoint("pi05_tiny").norm_stats.state is not None


def test_a_smolvla_without_its_library_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HF_HUB_CACHE", str(smolvla_golden.make_hub(tmp_path / "hub")))
    folder = smolvla_golden.make_checkpoint("special_tokens", tmp_path / "smolvla")
    for there in (True, False):
        monkeypatch.setattr(checkpoints, "find_spec", lambda name, there=there: there or None)
        shown = " ".join(text_of(turbopi("inspect", folder).stdout).replace("│", " ").split())
        assert ("needs the library tokenizers, which isn't installed" in shown) == (not there)
