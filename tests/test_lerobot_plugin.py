"""The LeRobot plugin inside LeRobot itself; test_lerobot_plugin_alone.py needs no LeRobot.

LeRobot runs in an environment of its own, see test_lerobot_itself.py.
"""

import json
import os
import random
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import memory_golden
import numpy as np
import pi0_fast_golden
import pytest
import smolvla_golden
from checkpoint_helpers import edit_json
from lerobot_cases import tokenizer_folder
from lerobot_golden import GOLDEN, GoldenCase

from turbopi import UnifiedPolicy, open_checkpoint
from turbopi.preprocess.tokenizer import TINY_TOKENIZER, load_tokenizer
from turbopi.robots.raw_keys import ROBOT_TYPES
from turbopi.serve import running

pytestmark = pytest.mark.slow

REPOSITORY = Path(__file__).parents[1]
PYTHON = Path(os.environ.get("TURBOPI_LEROBOT_PYTHON", REPOSITORY / ".venv-lerobot" / "bin" / "python")).absolute()
CASES = sorted(file.parent.name for file in GOLDEN.glob("*/case.json"))
OF_0_4 = "square_lerobot0.4.4"
OTHER_SIZES = (OF_0_4, "rtc")  # than the small LeRobot of tools/lerobot_cases has: its own policy can't load them
BF16 = 5e-3  # LeRobot's own bfloat16 from the float32 that is computed here; seen: half


def in_lerobot(*arguments: str | Path, **more: str) -> subprocess.CompletedProcess[str]:
    """`python ARGUMENTS` with LeRobot, the plugin and the tools, offline."""
    if not PYTHON.is_file():
        hint = f"LeRobot isn't installed at {PYTHON}; scripts/lerobot_env installs it (about 3 GB)"
        if os.environ.get("TURBOPI_REQUIRE_LEROBOT"):
            pytest.fail(hint)
        pytest.skip(hint)
    paths = ("src", "tools", "plugins/lerobot_policy_turbopi/src")
    environment = {
        "PYTHONPATH": os.pathsep.join(str(REPOSITORY / path) for path in paths),
        "HF_HUB_OFFLINE": "1",
        "OMP_NUM_THREADS": "1",
        **more,
    }
    command = [str(PYTHON), *map(str, arguments)]
    return subprocess.run(
        command, env={**os.environ, **environment}, capture_output=True, text=True, timeout=800, check=False
    )


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stored cases with their weights, and what came of them through LeRobot with the plugin."""
    folder = tmp_path_factory.mktemp("plugin")
    for name in CASES:
        GoldenCase(GOLDEN / name).assemble(folder / name)
        for file in ("case.json", "inputs.npz"):
            shutil.copy(GOLDEN / name / file, folder / name)
    done = in_lerobot("-m", "lerobot_cases.plugin", folder)
    assert done.returncode == 0, done.stderr[-4000:]
    return folder


SMOLVLA = ("base", "missing_camera", "special_tokens")


@pytest.fixture(scope="module")
def ran_smolvla(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As `ran`, of SmolVLA's cases; its tokenizer is in a Hub's cache."""
    folder = tmp_path_factory.mktemp("smolvla")
    hub = smolvla_golden.make_hub(tmp_path_factory.mktemp("hub"))
    for name in SMOLVLA:
        (folder / name).mkdir()
        smolvla_golden.make_checkpoint(name, folder / name / "checkpoint")
        for file in ("case.json", "inputs.npz"):
            shutil.copy(smolvla_golden.GOLDEN / name / file, folder / name)
    (folder / "aloha").mkdir()
    _, kept = smolvla_golden.make_aloha(folder / "aloha" / "checkpoint")
    inputs: dict[str, Any] = kept | {f"{run}/task": np.array(["pick up the cup"]) for run in range(2)}
    np.savez(folder / "aloha" / "inputs.npz", **inputs)
    (folder / "aloha" / "case.json").write_text(
        json.dumps({"kind": "smolvla", "runs": [{"observation": 0}, {"observation": 1}]})
    )
    done = in_lerobot("-m", "lerobot_cases.plugin", folder, HF_HUB_CACHE=str(hub))
    assert done.returncode == 0, done.stderr[-4000:]
    return folder


@pytest.mark.parametrize("name", SMOLVLA)
def test_smolvlas_actions_are_lerobots(ran_smolvla: Path, name: str) -> None:
    found = np.load(ran_smolvla / name / "plugin.npz")
    stored = np.load(smolvla_golden.GOLDEN / name / "expected.npz")
    runs = [key for key in stored.files if key.endswith("/actions")]
    assert runs
    for key in [*runs, "selected_actions"]:
        steps = min(len(found[key]), len(stored[key]))
        assert rms(found[key][:steps], stored[key][:steps]) <= 2e-5, key


def test_smolvlas_of_aloha_are_lerobots(ran_smolvla: Path) -> None:
    found = np.load(ran_smolvla / "aloha" / "plugin.npz")
    stored = np.load(smolvla_golden.GOLDEN / "special_tokens/aloha.npz")
    for key in ("0/actions", "1/actions"):
        assert rms(found[key], stored[key]) <= 2e-5, key


PI0_FAST = ("quantiles_empty_camera", "relative")
NO_TOKENIZER = """\
class UniversalActionProcessor:
    @classmethod
    def register_for_auto_class(cls, *_): ...
    @classmethod
    def from_pretrained(cls, *_, **__):
        return cls()
"""  # in place of the owners' code, which LeRobot's processors load, and use in training alone


@pytest.fixture(scope="module")
def ran_pi0_fast(joining: tuple[Path, tuple[str, ...]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As `ran`, of Pi0-FAST's cases that LeRobot's main branch saved: their folders have both tokenizers."""
    if "trained" not in joining[1]:
        pytest.skip("this LeRobot can't read a tokenizer's folder")
    folder = tmp_path_factory.mktemp("pi0_fast")
    for name in PI0_FAST:
        (folder / name).mkdir()
        checkpoint = pi0_fast_golden.make_folder(name, folder / name / "checkpoint", broken_answers="owners")
        (checkpoint / "action_tokenizer" / "processing_action_tokenizer.py").write_text(NO_TOKENIZER)

        def tokenize_by_the_folder(content: Any, tokenizer: str = str(checkpoint / "tokenizer")) -> None:
            (step,) = (one for one in content["steps"] if one["registry_name"] == "action_tokenizer_processor")
            step["config"]["paligemma_tokenizer_name"] = tokenizer

        edit_json(checkpoint / "policy_preprocessor.json", tokenize_by_the_folder)
        for file in ("case.json", "inputs.npz"):
            shutil.copy(pi0_fast_golden.GOLDEN / name / file, folder / name)
    done = in_lerobot("-m", "lerobot_cases.plugin", folder)
    assert done.returncode == 0, done.stderr[-4000:]
    return folder


@pytest.mark.parametrize("name", PI0_FAST)
def test_pi0_fasts_actions_are_lerobots(ran_pi0_fast: Path, name: str) -> None:
    found, golden = np.load(ran_pi0_fast / name / "plugin.npz"), pi0_fast_golden.runs(name)
    for run in range(len(golden)):
        assert rms(found[f"{run}/actions"], golden.actions(run)) <= 2e-5
    np.testing.assert_array_equal(found["selected_actions"], found["0/actions"][: len(found["selected_actions"])])


def test_memory_is_lerobots_call_by_call(joining: tuple[Path, tuple[str, ...]], tmp_path: Path) -> None:
    """With the prompts of LeRobot's processors, which have the state. LeRobot 0.6.1 has no memory."""
    if "trained" not in joining[1]:
        pytest.skip("this LeRobot has no memory")
    for name in memory_golden.CASES:
        (tmp_path / name).mkdir()
        memory_golden.make_checkpoint(name, tmp_path / name / "checkpoint")
        for file in ("case.json", "inputs.npz"):
            shutil.copy(memory_golden.GOLDEN / name / file, tmp_path / name)
    done = in_lerobot("-m", "lerobot_cases.memory", tmp_path)
    assert done.returncode == 0, done.stderr[-4000:]
    for name in memory_golden.CASES:
        found, stored = np.load(tmp_path / name / "plugin.npz"), np.load(memory_golden.GOLDEN / name / "expected.npz")
        for key in found.files:
            assert rms(found[key], stored[key]) <= 2e-6, (name, key)


@pytest.mark.parametrize("name", [name for name in CASES if name not in OTHER_SIZES and "peft" not in name])
def test_bfloat16_is_as_near_to_float32_as_lerobots(ran: Path, name: str) -> None:
    found = np.load(ran / name / "plugin.npz")
    ours, theirs = (rms(found[which], found["seeded"]) for which in ("bf16", "lerobot_bf16"))
    assert 1e-5 < ours < 2 * theirs


@pytest.mark.parametrize("name", [name for name in CASES if name != OF_0_4])
def test_actions_are_lerobots(ran: Path, name: str) -> None:
    """From the same noise, as whole chunks and one by one, and from the same seed."""
    found, stored = np.load(ran / name / "plugin.npz"), np.load(GOLDEN / name / "expected.npz")
    described = json.loads((GOLDEN / name / "case.json").read_text())
    bound = BF16 if described["config"].get("dtype") == "bfloat16" else 1e-5
    for index in range(len(described["runs"])):
        assert difference(found[f"{index}/actions"], stored[f"{index}/actions"]) < bound
    # one by one they are the rows of the chunk; LeRobot's own are stored where its queue was recorded
    assert ("selected_actions" in stored) == (name != "rtc")
    selected = stored["selected_actions"] if "selected_actions" in stored else stored["0/actions"]
    assert difference(found["selected_actions"], selected) < bound
    assert ("lerobot_seeded" in found) == ("peft" not in name and name not in OTHER_SIZES)
    if "lerobot_seeded" in found:
        assert difference(found["seeded"], found["lerobot_seeded"]) < bound
        assert difference(found["seeded"], found["0/actions"]) > 0.1  # other noise: the comparison's control


def test_a_checkpoint_of_0_4_runs_as_the_lerobot_that_runs_it(ran: Path) -> None:
    """The processors are of today, whichever LeRobot wrote the files."""
    found, case = np.load(ran / OF_0_4 / "plugin.npz"), GoldenCase(GOLDEN / OF_0_4)
    edit_json(ran / OF_0_4 / "checkpoint" / "turbopi.json", lambda content: content.update(lerobot_semantics="0.6"))
    policy = UnifiedPolicy(
        ran / OF_0_4 / "checkpoint", backend="pytorch", precision="f32", device="cpu", tokenizer=TINY_TOKENIZER
    )
    inputs = np.load(case.folder / "inputs.npz")
    observation = {key[2:]: inputs[key] for key in inputs.files if key.startswith("0/")}
    answer = policy.infer(observation | {"task": str(observation["task"][0])}, noise=inputs["noise"])["actions"]
    assert difference(found["0/actions"], answer) < 1e-5
    assert difference(found["0/actions"], np.load(case.folder / "expected.npz")["0/actions"]) > 1e-3


@pytest.mark.parametrize("name", CASES)
def test_what_was_saved_computes_the_same_again(ran: Path, name: str) -> None:
    found = np.load(ran / name / "plugin.npz")
    assert np.array_equal(found["loaded_again"], found["0/actions"])
    assert not list((ran / name / "saved").glob("model*"))  # the weights stay where they are


def rms(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Relative to the actions' root mean square."""
    return float(np.sqrt(((ours - theirs) ** 2).mean() / (theirs**2).mean()))


def difference(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Largest, relative to the actions' root mean square."""
    assert ours.shape == theirs.shape
    return float(np.abs(ours - theirs).max() / np.sqrt((theirs.astype(np.float64) ** 2).mean()))


def test_lerobot_rollout_moves_a_robot_with_the_plugin(ran: Path) -> None:
    """LeRobot's own command; the plugin is found by the installed package's name."""
    folder = ran / "mean_std"
    options = ("--robot.type=fake_arm", "--duration=1", "--task=pick up the bowl", "--play_sounds=false")
    rest = "--return_to_initial_position=false"
    for policy in (
        ("--policy.type=turbopi", f"--policy.checkpoint={folder / 'checkpoint'}", "--policy.n_action_steps=4"),
        (f"--policy.path={folder / 'saved'}", "--policy.num_inference_steps=3"),
    ):
        done = in_lerobot("-m", "lerobot_cases.cli", "rollout", *options, rest, *policy)
        assert done.returncode == 0, done.stderr[-4000:]
        assert "Turbo-Pi runs" in done.stderr and "Rollout finished" in done.stderr
        sent = re.search(r"fake_arm was sent (\d+) actions", done.stdout)
        assert sent and int(sent[1]) > 0


def test_what_lerobots_strategies_record_is_played_again(ran: Path, tmp_path: Path) -> None:
    policy = ("--policy.type=turbopi", f"--policy.checkpoint={ran / 'mean_std' / 'checkpoint'}")
    home = {"HF_LEROBOT_HOME": str(tmp_path)}
    dataset = ("--dataset.single_task=pick", "--dataset.push_to_hub=false", "--dataset.rgb_encoder.vcodec=h264")
    lasts = "--dataset.num_episodes=1", "--dataset.episode_time_s=1", "--dataset.reset_time_s=1"
    for strategy, more in (("sentry", ("--dataset.streaming_encoding=true",)), ("episodic", lasts)):
        name = f"me/rollout_{strategy}"
        recording = (f"--strategy.type={strategy}", f"--dataset.repo_id={name}", "--dataset.no_stamp=true")
        options = (*policy, *recording, *dataset, *more, "--use_torch_compile=true")
        assert moved(in_lerobot(*ROLLOUT, *options, **home)) > 0
        played = ("--robot.type=fake_arm", f"--dataset.repo_id={name}", "--dataset.episode=0", "--play_sounds=false")
        assert moved(in_lerobot("-m", "lerobot_cases.cli", "replay", *played, **home)) > 0


def test_lerobot_rollout_renames_cameras(ran: Path) -> None:
    policy = ("--policy.type=turbopi", f"--policy.checkpoint={ran / 'renamed' / 'checkpoint'}")
    names = {f"observation.images.{own}": f"observation.images.camera{i}" for i, own in ((1, "top"), (2, "wrist"))}
    assert moved(in_lerobot(*ROLLOUT, *policy, f"--rename_map={json.dumps(names)}")) > 0


def test_lerobot_eval_runs_episodes_with_the_plugin(ran: Path, tmp_path: Path) -> None:
    checkpoint = f"--policy.checkpoint={ran / 'mean_std' / 'checkpoint'}"
    done = in_lerobot(
        *("-m", "lerobot_cases.cli", "eval", "--env.type=fake", "--policy.type=turbopi", checkpoint),
        *("--eval.n_episodes=2", "--eval.batch_size=2", "--eval.use_async_envs=false", f"--output_dir={tmp_path}/out"),
    )
    assert done.returncode == 0, done.stderr[-4000:]
    assert json.loads((tmp_path / "out" / "eval_info.json").read_text())["overall"]["n_episodes"] == 2


def test_robot_types_are_lerobots() -> None:
    """What `--robot so101_follower` expects is what LeRobot's robot of that type gives and takes."""
    done = in_lerobot("-m", "lerobot_cases.robot_types")
    assert done.returncode == 0, done.stderr[-4000:]
    theirs = json.loads(done.stdout.splitlines()[-1])
    assert theirs == {name: [list(joints), list(joints)] for name, joints in ROBOT_TYPES.items()}


def test_a_tokenizers_folder_means_to_turbopi_what_it_means_to_transformers(tmp_path: Path) -> None:
    """And where LeRobot saves it beside the processors, the plugin's saved policy has it, too."""
    checkpoint = GoldenCase(GOLDEN / "mean_std").assemble(tmp_path)
    tokenizer_folder.write(checkpoint / "tokenizer")
    edit_json(checkpoint / "policy_preprocessor.json", name_the_folder)
    rng = random.Random(0)
    parts = [
        "pick up",
        "the",
        "bowl",
        "\n",
        "\t",
        "_",
        "<s>",
        "<unk>",
        "é",
        "漢",
        "🙂",
        "aaa",
        "Task:",
        "<0x41>",
        "▁",
        "  ",
    ]
    texts = ["".join(rng.choice(parts) + rng.choice(("", " ")) for _ in range(rng.randint(1, 12))) for _ in range(1000)]
    (tmp_path / "texts.json").write_text(json.dumps(texts))
    done = in_lerobot("-m", "lerobot_cases.saved_tokenizer", checkpoint, tmp_path / "texts.json")
    assert done.returncode == 0, done.stderr[-4000:]
    found = json.loads(done.stdout.splitlines()[-1])
    ours = load_tokenizer(named=open_checkpoint(checkpoint).named_tokenizer, vocab_size=1024).encoder
    assert found["ids"] == [list(ours.encode(text, add_bos=True)) for text in texts]
    assert not found["artifacts"] or found["kept"]


def name_the_folder(content: Any) -> None:
    (step,) = (step for step in content["steps"] if step["registry_name"] == "tokenizer_processor")
    step["config"]["tokenizer_name"] = "tokenizer"
    step["artifacts"] = {"tokenizer_name": "tokenizer"}


def test_lerobots_own_policy_server_is_not_said_to_take_the_plugin() -> None:
    """docs/lerobot.md and the plugin's README say that it doesn't; that is LeRobot's list of types."""
    done = in_lerobot(
        "-c",
        "import sys, lerobot.utils.import_utils as u; u.require_package = lambda *a, **b: None; "
        "sys.modules['grpc'] = sys; import lerobot.async_inference.constants as c; print(c.SUPPORTED_POLICIES)",
    )
    assert done.returncode == 0, done.stderr[-4000:]
    assert "'pi05'" in done.stdout and "turbopi" not in done.stdout


ROLLOUT = (
    *("-m", "lerobot_cases.cli", "rollout", "--robot.type=fake_arm", "--duration=2", "--task=pick up the bowl"),
    *("--play_sounds=false", "--return_to_initial_position=false"),
)
RTC = ("--inference.type=rtc", "--inference.rtc.execution_horizon=6", "--inference.queue_threshold=8")


def moved(done: subprocess.CompletedProcess[str]) -> int:
    """How many actions the robot was sent. Fails if LeRobot did, or if its engine met with an error."""
    assert done.returncode == 0 and "RTC inference error" not in done.stderr, done.stderr[-4000:]
    sent = re.search(r"fake_arm was sent (\d+) actions", done.stdout)
    assert sent is not None
    return int(sent[1])


@pytest.fixture(scope="module")
def joining(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[str, ...]]:
    """A checkpoint with relative actions, which LeRobot runs with RTC alone, and the modes that it can have there.

    0.6.1 has no mode "trained", and refuses a config.json that says how a checkpoint was trained for it.
    """
    checkpoint = GoldenCase(GOLDEN / "relative_excluded").assemble(tmp_path_factory.mktemp("joining"))
    answer = in_lerobot(
        "-c", "from lerobot.policies.pi05 import PI05Config as C; print(hasattr(C, 'use_visual_memory'))"
    )
    assert answer.returncode == 0, answer.stderr[-4000:]
    if "True" not in answer.stdout:
        return checkpoint, ("guided",)
    edit_json(checkpoint / "config.json", lambda content: content.update(rtc_training_max_delay=4))
    return checkpoint, ("guided", "trained")


def test_lerobot_rollout_joins_chunks_with_the_plugin(joining: tuple[Path, tuple[str, ...]]) -> None:
    checkpoint, modes = joining
    for mode in modes:
        policy = ("--policy.type=turbopi", f"--policy.checkpoint={checkpoint}", "--policy.num_inference_steps=2")
        assert moved(in_lerobot(*ROLLOUT, *RTC, *policy, f"--policy.rtc_mode={mode}")) > 10


def test_lerobot_rollout_moves_a_robot_by_a_server(joining: tuple[Path, tuple[str, ...]]) -> None:
    """With LeRobot's RTC and without, over loopback; LeRobot has neither the weights nor the processors."""
    checkpoint, _ = joining
    policy = UnifiedPolicy(checkpoint, backend="pytorch", precision="f32", device="cpu", tokenizer=TINY_TOKENIZER)
    with running(policy) as server:
        for engine in (RTC, ("--inference.type=sync",)):
            remote = ("--policy.type=turbopi", f"--policy.server=ws://127.0.0.1:{server.port}")
            assert moved(in_lerobot(*ROLLOUT, *engine, *remote)) > 10


def test_chunks_join_as_those_of_lerobots_own_policy(joining: tuple[Path, tuple[str, ...]], tmp_path: Path) -> None:
    """By LeRobot's own re-anchoring, and as the numbers that are stored."""
    (checkpoint, modes), case, found = joining, GOLDEN / "relative_excluded", {}
    for who, option in (("own", ()), ("plugin", ("--plugin",))):
        (tmp_path / who).mkdir()
        done = in_lerobot("-m", "lerobot_cases.rtc", checkpoint, case / "inputs.npz", tmp_path / who, *option)
        assert done.returncode == 0, done.stderr[-4000:]
        found[who] = dict(np.load(tmp_path / who / "rtc.npz"))
    stored = dict(np.load(case / "rtc.npz"))
    assert found["plugin"].keys() == found["own"].keys() and len(found["own"]) == 3 + 3 * (6 if len(modes) == 1 else 9)
    for name, value in found["plugin"].items():
        for other in (stored, found["own"]):
            assert difference(value, other[name]) < 1e-5, name
