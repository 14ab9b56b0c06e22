"""The certificate: what is right passes, each planted fault fails by its name, and the document is complete."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import verify_fakes
from cli_helpers import refusal, turbopi

from turbopi import backends
from turbopi.checkpoint import random_checkpoint
from turbopi.models.observation import ModelInputs
from turbopi.models.pi0.reference import Pi0Model
from turbopi.policy.examples import Example, NoisyExample
from turbopi.policy.policy import UnifiedPolicy
from turbopi.recordings import RecordedCall, save_call
from turbopi.recordings.sources import chosen_files
from turbopi.support.errors import CheckpointError
from turbopi.support.reading import plain_document, read_document
from turbopi.verify.check_golden import _compare_rounded, check_case
from turbopi.verify.document import Certificate, Judged
from turbopi.verify.golden import GoldenFolder, Run
from turbopi.verify.inputs import VerifyPlan
from turbopi.verify.intermediates import Errors, Place, first_suspect, in_order, tensors_of
from turbopi.verify.run import verify
from turbopi.verify.verdict import ACTIONS, Compared, Repetition, Rule, judge

pytestmark = pytest.mark.usefixtures("two_layers", "unseen_plots")

STEPS = 2
WEIGHTS = ("--random-weights", "pi05_tiny")
QUICK = (*WEIGHTS, "--device", "cpu", "--steps", STEPS, "--count", 1, "--noises", 2)


def plant(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    assert hasattr(verify_fakes, name)
    spec = backends.BackendSpec("faulty", "verify_fakes", name, "for a test")
    monkeypatch.setitem(backends.BACKENDS, "faulty", spec)


def certified(backend: str, *more: object, exit_code: int = 0) -> dict[str, Any]:
    """The document of a run with that exit code."""
    result = turbopi("verify", *QUICK, "--backend", backend, "--json", *more)
    assert result.exit_code == exit_code, (result.output, result.exception)
    document: dict[str, Any] = json.loads(result.stdout)
    last = result.stderr.rstrip().splitlines()[-1]
    assert last == document["verdict"]
    assert last.startswith("PASS: " if exit_code == 0 else "FAIL: ")
    return document


# What is right


@pytest.mark.slow
def test_plain_bf16_passes_and_its_document_is_complete(tmp_path: Path, drawn: list[Any]) -> None:
    document = certified("pytorch", "--report", tmp_path)
    read_again = read_document(tmp_path / "verify.json", Certificate)
    assert plain_document(read_again) == document == json.loads((tmp_path / "verify.json").read_text())
    assert document["ok"] is True
    assert document["first_off"] is None
    assert document["bounds"]["factor_of_control"] == 5
    assert document["bounds"]["overridden"] is False
    assert document["control"].startswith("pytorch f32 with every weight")
    actions = document["actions"]
    assert 1e-4 < actions["relative_rms"] < document["bounds"]["actions_relative_rms"]
    assert actions["control"]["relative_rms"] * 5 == pytest.approx(document["bounds"]["actions_relative_rms"])
    assert 0.999 < actions["cosine"] < 1
    assert actions["worst"]["observation"] == "LIBERO frame 0"
    assert [row["name"] for row in actions["dimensions"]][-1] == "gripper"
    assert all(0 < row["rms"] <= row["max"] for row in actions["dimensions"])
    names = [(row["name"], row["index"]) for row in document["intermediates"]]
    assert names.index(("prefix_embs", None)) < names.index(("kv_k", 0)) < names.index(("kv_v", 0))
    assert names.index(("kv_v", 0)) < names.index(("kv_k", 1)) < names.index(("cond", 0)) < names.index(("v_t", 0))
    assert names.index(("v_t", 0)) < names.index(("x_t", 1)) < names.index(("v_t", 1)) < names.index(("x_t", 2))
    assert names[-1] == ("actions", None)
    assert {name for name, _ in names} >= {"suffix_out", "vision_last_hidden", "expert_hidden_step0"}
    determinism = document["determinism"]
    assert (determinism["identical"], determinism["calls"], determinism["differing"]) == (2, 2, None)
    for times in document["latency_ms"].values():
        assert 0 < times["p50"] <= times["p95"]
    assert document["weights"]["fingerprint"] == random_checkpoint("pi05_tiny").fingerprint()
    assert len(document["observations"]["sha256"]) == 64
    assert document["provenance"]["commit"]
    assert json.loads((tmp_path / "verify.json").read_text()) == document
    plots = {"layers.png": ("kv_k", "kv_v"), "steps.png": ("v_t", "x_t")}
    for figure, (plot, of_plot) in zip(drawn, plots.items(), strict=True):
        assert (tmp_path / plot).read_bytes().startswith(b"\x89PNG")
        lines = [line.get_xydata().tolist() for line in figure.axes[0].get_lines()]
        expected: list[list[list[float]]] = []
        for tensor in of_plot:  # an error, its control, what is allowed; of these what a logarithmic axis can show
            rows = [row for row in document["intermediates"] if row["name"] == tensor]
            for of_line in ([(row["index"], row) for row in rows], [(row["index"], row["control"]) for row in rows]):
                expected.append([[index, one["relative_rms"]] for index, one in of_line if one["relative_rms"] > 0])
            expected.append([[row["index"], row["allowed"]] for row in rows if row["control"]["relative_rms"] > 0])
        if plot == "steps.png":
            bound = document["bounds"]["actions_relative_rms"]
            expected += [[[STEPS, actions["relative_rms"]]], [[0, bound], [1, bound]]]  # the latter from edge to edge
        assert lines == expected and all(expected)
        assert "PASS" in figure.axes[0].get_title()


def test_the_oracle_has_no_error_against_itself() -> None:
    document = certified("pytorch", "--precision", "f32", "--no-hash", "--noises", 1)
    assert all(row["relative_rms"] == 0 and row["cosine"] == 1 for row in document["intermediates"])
    assert document["bounds"]["actions_relative_rms"] == 1e-5
    assert document["control"] == "pytorch bf16"
    assert document["actions"]["control"]["relative_rms"] > 1e-3
    assert document["weights"]["fingerprint"] is None


@pytest.mark.slow
def test_another_bf16_backend_is_held_to_plain_bf16(monkeypatch: pytest.MonkeyPatch) -> None:
    plant(monkeypatch, "Correct")
    document = certified("faulty")
    assert document["control"] == "pytorch bf16"
    actions = document["actions"]
    assert actions["relative_rms"] == actions["control"]["relative_rms"] > 0
    assert document["bounds"]["actions_relative_rms"] == pytest.approx(1.25 * actions["relative_rms"])
    assert "prefix_embs" in document["not_exposed"]


# What is wrong


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "precision", "first"),
    [
        ("WrongKeys", "bf16", ("kv_k", verify_fakes.FAULTY_LAYER)),
        ("EarlySuffix", "bf16", ("v_t", 0)),
        ("EarlySuffix", "f32", ("v_t", 0)),
        ("FastPathDiffers", "bf16", ("actions", None)),
    ],
)
def test_the_first_wrong_intermediate_is_named(
    fault: str, precision: str, first: tuple[str, int | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    plant(monkeypatch, fault)
    document = certified("faulty", "--precision", precision, "--noises", 1, exit_code=1)
    assert (document["first_off"]["name"], document["first_off"]["index"]) == first
    assert f"first off: {document['first_off']['text']}" in document["verdict"]
    assert document["checks"][0]["ok"] is False


@pytest.mark.slow
def test_an_error_above_what_is_allowed_says_that_it_informs_and_another_number_decides(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plant(monkeypatch, "WrongTrace")
    monkeypatch.setenv("COLUMNS", "140")
    result = turbopi("verify", *QUICK, "--backend", "faulty")
    assert result.exit_code == 0, result.output
    rows = {line.split("│")[1].strip(): line for line in result.stdout.splitlines() if line.startswith("│")}
    above = rows[f"kv_k, {verify_fakes.FAULTY_LAYER}"]
    assert "above, informs" in above
    assert "ok, decides" in rows["actions"]
    assert sum("above" in row or "decides" in row for row in rows.values()) == 2
    assert "Of all else `allowed` is informative" in result.stdout
    assert "(informative: the actions decide, and they pass)" in result.stdout
    assert result.stdout.splitlines()[-1].startswith("PASS: ")


@pytest.mark.slow
def test_what_is_not_finite_fails_with_a_whole_report(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    plant(monkeypatch, "NotFinite")
    document = certified("faulty", "--report", tmp_path, "--noises", 1, exit_code=1)
    assert "the actions aren't finite" in document["verdict"]
    assert f"first off: v_t step {verify_fakes.FAULTY_STEP} (not finite)" in document["verdict"]
    assert document["actions"]["relative_rms"] is None  # JSON has no infinity
    assert document["actions"]["finite"] is False
    assert (tmp_path / "steps.png").exists()


@pytest.mark.slow
def test_bits_that_change_on_repetition_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    plant(monkeypatch, "Unsteady")
    document = certified("faulty", exit_code=1)
    assert [check["name"] for check in document["checks"] if not check["ok"]] == ["determinism"]
    assert "0 of 2 repeated calls were bit-identical" in document["verdict"]
    assert document["determinism"]["differing"] == "LIBERO frame 0"
    assert 0 < document["determinism"]["max"] < 1e-5


@pytest.mark.slow
def test_a_backend_that_hides_what_is_demanded_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    plant(monkeypatch, "Secretive")
    assert "'faulty' doesn't expose v_t" in refusal_of("--backend", "faulty")


@pytest.mark.slow
def test_a_certificate_says_that_the_oracle_was_float32_whatever_the_program_had_set() -> None:
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        document = verify(random_checkpoint("pi05_tiny"), quick_plan())
    finally:
        torch.set_float32_matmul_precision(before)
    said: Any = document.oracle_float32
    assert said["exact"] is True and said["within"]["products"]["all"] == "highest"
    assert said["callers"]["products"]["all"] == "high"
    json.dumps(said)


def test_weights_whose_reference_is_not_finite_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def overflowing(model: Pi0Model, *args: Any) -> tuple[torch.Tensor, torch.Tensor]:
        k, v = original(model, *args)
        v[1, 0, 0, 5] = float("inf")
        return k, v

    original = Pi0Model.encode_prefix
    monkeypatch.setattr(Pi0Model, "encode_prefix", overflowing)
    with pytest.raises(CheckpointError, match=r"itself gives values that aren't finite: kv_v layer 1, on LIBERO frame"):
        verify(random_checkpoint("pi05_tiny"), quick_plan())


# Nothing to judge


def judged(noise: np.ndarray, exact: np.ndarray, ours: np.ndarray, of_control: np.ndarray, **rule: Any) -> Judged:
    """The verdict on one call, by the actions float32[H, d] of reference, backend and control."""
    inputs = ModelInputs(np.zeros(1), np.ones(1, bool), np.zeros(1), np.ones(1, bool), np.zeros(1))
    call = NoisyExample(0, Example("one", inputs, np.zeros(8)), 0, torch.from_numpy(noise[None]), first=True)
    compared, control = Compared(), Compared()
    for which, actions in ((compared, ours), (control, of_control)):
        which.add(call, {ACTIONS: actions}, {ACTIONS: exact}, actions, exact)
    return judge(Rule.of("fused", "bf16", **rule), "bf16", "plain", compared, control, Repetition())


NOISE = np.random.default_rng(0).standard_normal((10, 32)).astype(np.float32)
BIAS = np.linspace(-3, 3, 32, dtype=np.float32)


@pytest.mark.parametrize(
    "exact",
    [
        np.zeros_like(NOISE),
        np.ones_like(NOISE),
        NOISE,  # denoising did nothing
        sum([BIAS / 10] * 10, NOISE),  # or the same whatever the observation
        NOISE + np.nan,
    ],
    ids=["zero", "constant", "untouched", "constant_velocity", "nan"],
)
@pytest.mark.parametrize("bound", [{}, {"bound": 1.0}])
def test_a_reference_without_a_signal_passes_nothing(exact: np.ndarray, bound: dict[str, float]) -> None:
    document = judged(NOISE, exact, exact, exact, **bound)
    assert not document.ok
    assert document.verdict.startswith("FAIL: nothing to judge: the float32 reference's actions")


def test_a_control_that_gives_no_bound_passes_nothing() -> None:
    exact = (NOISE * 0.1).astype(np.float32)
    rounded = exact + np.float32(1e-3) * NOISE[::-1]
    assert judged(NOISE, exact, rounded, rounded).ok
    same = judged(NOISE, exact, exact, exact)
    assert not same.ok and "nothing to judge: the control has no error" in same.verdict
    infinite = judged(NOISE, exact, rounded, exact + np.inf)
    assert not infinite.ok and "nothing to judge: the control's actions aren't finite" in infinite.verdict
    assert judged(NOISE, exact, exact, exact + np.inf, bound=1e-5).ok  # a bound of its own needs no control


@pytest.mark.slow
def test_weights_that_do_nothing_fail_as_nothing_to_judge(monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(model: Pi0Model, *args: Any, **options: Any) -> torch.Tensor:
        for parameter in model.action_out_proj.parameters():
            parameter.data.zero_()
        return original(model, *args, **options)

    original = Pi0Model.denoise
    monkeypatch.setattr(Pi0Model, "denoise", nothing)
    document = verify(random_checkpoint("pi05_tiny"), quick_plan())
    assert not document.ok
    assert document.verdict.startswith("FAIL: nothing to judge: ")
    assert document.checks[0].name == "signal"


def test_a_golden_case_without_a_signal_is_refused(golden: Path) -> None:
    case = next(iter(GoldenFolder(golden).cases()))
    empty = {name: {"actions": case.noise.numpy()} for name in ("torch_fp32", "torch_bf16")}
    with pytest.raises(CheckpointError, match=f"{case.name}, torch_fp32, 3 steps: nothing to judge"):
        check_case(dataclasses.replace(case, runs=[Run(3, empty)]), tiny_policy().backend)


def test_a_golden_bf16_run_that_is_not_finite_is_no_bound(golden: Path) -> None:
    case = next(iter(GoldenFolder(golden).cases()))
    exact, ours = case.noise.numpy() * 0.5, case.noise.numpy() * 0.4
    variants = {"torch_fp32": {"actions": exact}, "torch_bf16": {"actions": exact + np.inf}}
    (compared,) = _compare_rounded(case, Run(3, variants), {"actions": ours}, "bf16")
    assert compared.ok is False


# Bounds, observations, refusals


@pytest.mark.slow
def test_overridden_bounds_decide_and_are_recorded() -> None:
    document = certified("pytorch", "--bound", "1e-9", "--noises", 1, exit_code=1)
    assert document["bounds"]["overridden"] is True
    assert document["bounds"]["actions_relative_rms"] == 1e-9
    assert document["bounds"]["reason"] == "given by the user"
    assert "is not within 1.00e-09 (the bound that was given)" in document["verdict"]


@pytest.mark.slow
def test_a_recording_is_verified_by_its_files(tmp_path: Path) -> None:
    policy = tiny_policy()
    for number in range(3):
        call = RecordedCall(policy.example_observation(number), {"actions": np.zeros((10, 7))}, 0.0)
        save_call(tmp_path / f"{number:06d}.npz", call)
    document = verify(random_checkpoint("pi05_tiny"), quick_plan(observations=tmp_path, count=2))
    assert document.observations.names == ["000000.npz", "000001.npz"]
    assert document.observations.count == 2


def test_observations_made_by_hand_are_verified_too_evenly_spread(tmp_path: Path) -> None:
    for number in range(4):
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / "observation.json").write_text("{}")
    assert [name for name, _ in chosen_files(tmp_path, 2)] == ["0", "2"]
    assert len(chosen_files(tmp_path)) == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--backend", "emulated_fp8", "--precision", "fp8"], "precision 'fp8' needs a calibration"),
        (["--backend", "emulated_fp8", "--precision", "fp8", "--quantization", "none.json"], "no file none.json"),
        (["--precision", "f32", "--quantization", "none.json"], "precision 'f32' takes no calibration"),
        (["--precision", "fp8"], "fp8 needs an NVIDIA GPU of compute capability 8.9 or newer; take --precision bf16"),
    ],
)
def test_calibrations_are_looked_at_before_anything_runs(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], message: str
) -> None:
    monkeypatch.delattr("turbopi.verify.run._Reference")
    assert message in refusal_of("--device", "cpu", *arguments)


def test_an_observation_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "one.npz", state=np.zeros(8))
    assert refusal_of("--observations", tmp_path / "one.npz").startswith("one.npz: ")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--bound", "1e-3", "--factor", "2"], "--bound and --factor were both given"),
        (["--factor", "-1"], "--factor is -1.0; expected a number above 0"),
        (["--bound", "nan"], "--bound is nan"),
        (["--precision", "fp7"], "unknown precision 'fp7'"),
        (["--backend", "warp"], "unknown backend 'warp'"),
        (["--observations", "nowhere"], "nowhere doesn't exist"),
    ],
)
def test_wrong_options_are_refused(arguments: list[str], message: str) -> None:
    assert message in refusal_of(*arguments)


def refusal_of(*arguments: object) -> str:
    """The error line of a run whose other output goes to stderr, too."""
    result = turbopi("verify", *QUICK, *arguments, "--json")
    assert result.exit_code == 2, (result.output, result.exception)
    assert result.stdout == ""
    return result.stderr.rstrip().splitlines()[-1].removeprefix("error: ")


def test_anothers_file_is_not_replaced_by_a_certificate(tmp_path: Path) -> None:
    file = tmp_path / "verify.json"
    file.write_text('{"floors": {}}')
    reported = refusal_of("--report", tmp_path)
    assert f"{file} is there and isn't a certificate of `turbopi verify`, so it isn't replaced" in reported
    assert file.read_text() == '{"floors": {}}'


def test_no_weights_are_refused() -> None:
    assert "no weights" in refusal(turbopi("verify"))


# The numbers themselves


def test_errors_pool_what_is_added() -> None:
    errors = Errors()
    errors.add(np.array([1.0, 2.0]), np.array([1.0, 1.0]))
    errors.add(np.array([3.0]), np.array([5.0]))
    assert errors.max == 2
    assert errors.rms == pytest.approx(math.sqrt(5 / 3))
    assert errors.relative_rms == pytest.approx(math.sqrt(5 / 27))
    assert errors.cosine == pytest.approx(18 / math.sqrt(14 * 27))
    errors.add(np.array([np.nan]), np.array([0.0]))
    assert errors.relative_rms == float("inf")


def test_slots_nobody_attends_to_are_left_out() -> None:
    mask = np.array([True, False])
    inputs = ModelInputs(np.zeros(0), mask, np.zeros(3), np.array([True, True, False]), np.zeros(0))
    slots = torch.arange(7.0)  # two images of two tokens, three of the prompt
    kv = slots[None, None, :, None, None].expand(2, 1, 7, 1, 1)
    tensors = tensors_of({"prefix_embs": slots[None, :, None], "kv_k": kv}, inputs, with_prefix=True)
    for place in (Place("prefix_embs"), Place("kv_k", 0), Place("kv_k", 1)):
        assert tensors[place].ravel().tolist() == [0, 1, 4, 5]
    assert tensors_of({"kv_k": kv, "times": torch.ones(2)}, inputs, with_prefix=False).keys() == {Place("times")}


def _off_by(values: dict[Place, float]) -> dict[Place, Errors]:
    out = {}
    for place, value in values.items():
        out[place] = Errors()
        out[place].add(np.array([1 + value]), np.array([1.0]))
    return out


def test_a_jump_is_suspect_only_where_the_control_does_not_jump() -> None:
    places = [Place("v_t", step) for step in range(3)]
    jumping = dict(zip(places, (1e-4, 2e-4, 6e-3), strict=True))
    allowed = dict.fromkeys(places, 1e-2)
    suspect = first_suspect(_off_by(jumping), _off_by(dict.fromkeys(places, 3e-3)), allowed, 10)
    assert suspect is not None
    assert str(suspect) == "v_t step 2 (relative rms 0.00600, 30 x that before)"
    assert first_suspect(_off_by(jumping), _off_by(jumping), allowed, 10) is None


def test_actions_come_last_and_every_name_has_its_place() -> None:
    places = [ACTIONS, Place("x_t", 1), Place("kv_v", 0), Place("v_t", 0), Place("kv_k", 1), Place("prefix_embs")]
    expected = ["prefix_embs", "kv_v layer 0", "kv_k layer 1", "v_t step 0", "x_t step 1", "actions"]
    assert [str(place) for place in in_order(places)] == expected


def test_the_stated_bounds() -> None:
    assert Rule.of("pytorch_compile", "f32").limit(control=0.5) == 1e-5
    assert Rule.of("fused", "bf16").limit(control=0.02) == pytest.approx(0.025)
    assert Rule.of("pytorch", "bf16").limit(control=0.02) == pytest.approx(0.1)
    assert Rule.of("pytorch", "bf16", trained=True).limit(control=0.02) == pytest.approx(0.2)


def tiny_policy() -> UnifiedPolicy:
    return UnifiedPolicy(random_checkpoint("pi05_tiny"), backend="pytorch", device="cpu", num_denoising_steps=1)


def quick_plan(**more: Any) -> VerifyPlan:
    arguments = {"backend": "pytorch", "precision": "f32", "num_denoising_steps": 1, "device": "cpu"}
    return VerifyPlan(arguments, **{"count": 1, "noises": 1, **more})
