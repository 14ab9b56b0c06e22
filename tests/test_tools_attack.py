"""The tool that attacks the server and the command line: its judges, what it sends, and one tiny run."""

import asyncio
import io
import itertools
import json
import os
import random
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from attack import commands, damages, files, results, zygote
from attack.__main__ import main
from attack.arena import Found, Limits, server_bars
from attack.attacks import ATTACKS, Size
from attack.endings import check_recording
from attack.fake import DigestPolicy
from attack.frames import send
from attack.judging import Bar, Reply, decode, digest, digest_actions, judge, mean, percentile, ratio, shape_fault
from attack.messages import case
from attack.server import answers
from attack.specimens import SPECIMENS, read_observation
from attack.websocket import check_loopback
from rich.console import Console

from turbopi.realtime.wire import WireError, pack, unpack
from turbopi.recordings import Recorder
from turbopi.serve import running

OBSERVATION = {"observation/state": np.linspace(-1, 1, 8), "prompt": "lift", "more": [1, 2.5, b"x", None, {"a": True}]}
MESSAGE = pack(OBSERVATION)


def result_for(observation: Any) -> Reply:
    return Reply("binary", pack({"actions": digest_actions(observation)}))


# --- judges -----------------------------------------------------------------------------------------------------------


def test_the_answer_to_an_observation_is_its_own() -> None:
    assert judge(MESSAGE, result_for(OBSERVATION), valid=True).fault is None
    other = judge(MESSAGE, result_for({**OBSERVATION, "prompt": "drop"}), valid=True)
    assert other.outcome == "wrong" and other.fault is not None


@pytest.mark.parametrize(
    "change",
    [
        {"observation/state": np.linspace(-1, 1, 8, dtype=np.float32)},
        {"more": []},
        {"observation/state": np.zeros((8, 1))},
    ],
)
def test_another_dtype_shape_or_value_is_another_observation(change: dict[str, Any]) -> None:
    assert digest({**OBSERVATION, **change}) != digest(OBSERVATION) == digest(decode(MESSAGE))


@pytest.mark.parametrize(
    ("reply", "message", "valid", "may_close"),
    [
        (Reply("silence"), MESSAGE, True, False),
        (Reply("silence"), None, False, True),
        (Reply("closed", code=1011), None, False, True),
        (Reply("closed", code=1006), None, False, True),
        (Reply("closed", code=1002), MESSAGE, False, False),
        (Reply("closed", code=1002), MESSAGE, True, True),
        (Reply("text", b"bad request: x"), MESSAGE, True, False),
        (Reply("text", b""), b"\xc1", False, False),
        (Reply("text", b"bad request: " + b"x" * 5000), b"\xc1", False, False),
        (Reply("text", b"Traceback (most recent call last):\n  x\nKeyError: 1"), b"\xc1", False, False),
        (result_for(OBSERVATION), b"\xc1", False, False),
        (result_for(OBSERVATION), None, False, True),
        (Reply("binary", b"\xc1"), MESSAGE, True, False),
        (Reply("binary", pack({"no": "actions"})), MESSAGE, True, False),
    ],
)
def test_what_a_server_must_not_answer_is_a_fault(
    reply: Reply, message: bytes | None, valid: bool, may_close: bool
) -> None:
    assert judge(message, reply, valid=valid, may_close=may_close).fault is not None


@pytest.mark.parametrize(
    ("reply", "valid", "may_close"),
    [
        (Reply("text", b"bad request: not a msgpack message"), False, False),
        (Reply("text", b"busy: 16 requests wait already"), True, False),
        (Reply("closed", code=1002), False, True),
        (Reply("closed", code=1009), False, True),
    ],
)
def test_what_a_server_may_answer_is_none(reply: Reply, valid: bool, may_close: bool) -> None:
    assert judge(MESSAGE, reply, valid=valid, may_close=may_close).fault is None


def test_a_models_actions_are_finite_and_have_two_dimensions() -> None:
    good = np.zeros((10, 7))
    assert shape_fault(pack({"actions": good})) is None
    for bad in (good.astype(np.float32), np.zeros(7), np.full((10, 7), np.nan)):
        assert shape_fault(pack({"actions": bad})) is not None
    assert shape_fault(b"\xc1") is not None


def test_a_models_answer_is_judged_by_its_shape_and_only_where_there_was_a_message() -> None:
    actions = pack({"actions": np.zeros((10, 7))})
    message = pack(OBSERVATION)
    assert judge(message, Reply("binary", actions), valid=True, shape=(10, 7)).fault is None
    assert judge(message, Reply("binary", actions), valid=True, shape=(50, 7)).fault is not None
    assert judge(message, Reply("binary", pack({"actions": np.full((10, 7), np.nan)})), valid=True, shape=(10, 7)).fault
    assert judge(b"\xc1", Reply("binary", actions), valid=False, shape=(10, 7)).fault is not None


def test_a_bar_that_could_not_be_measured_is_broken() -> None:
    assert Bar("ratio", 1.5, 1.5).held
    assert not Bar("ratio", 1.51, 1.5).held
    assert not Bar("ratio", None, 1.5).held
    assert ratio(10.0, 15.0) == 1.5
    assert ratio(10.0, None) is None and ratio(None, 1.0) is None and ratio(0.0, 1.0) is None
    assert percentile([3.0, 1.0, 2.0], 0.5) == 2.0 and percentile([], 0.5) is None
    assert mean([20.0] * 9 + [1020.0]) == 120.0 and mean([]) is None


def test_a_request_that_still_waits_is_a_fault() -> None:
    lines = "1.0\t0\t?\n1.0\t20.5\tok\n2.0\t0\t?\n2.0\t900\tlost: x\n3.0\t0\t?\n3.0\t1"
    assert answers(lines, 0.0, 9.0, now=9.0) == [(20.5, "ok"), (900.0, "lost: x"), (6000.0, "no answer yet")]
    assert answers(lines, 0.5, 1.5, now=9.0) == [(20.5, "ok")]
    assert answers(lines, 2.5, 9.0, now=3.1) == []  # it has hardly been asked


def test_every_limit_of_a_server_is_a_bar_and_tracebacks_are_always_one() -> None:
    seen = {
        "rss_mb": {"before": 100.0, "peak": 300.0, "after": 120.0},
        "descriptors": {"before": 10, "peak": 90, "after": 12},
        "log_bytes": 50_000,
        "seconds": 10.0,
        "log_tracebacks": 1,
        "health": {"asked": 20, "failed": 0, "worst_ms": 3.0},
        "good": {"ratio": 1.2, "mean_ratio": 40.0},
    }
    bars = {bar.name: bar for bar in server_bars(Limits(), seen)}
    assert [name for name, bar in bars.items() if not bar.held] == ["mean ratio", "growth MB", "tracebacks logged"]
    assert bars["log kB/s"].value == 5.0 and bars["kept MB"].value == 20.0 and bars["descriptors"].value == 2
    few = server_bars(Limits(None, None, None, None, None, None), seen)
    assert {bar.name for bar in few} == {"healthz failed", "tracebacks logged"}


def test_a_command_may_not_end_in_a_traceback_or_take_for_ever() -> None:
    def done(code: int, stderr: str, killed: str | None = None) -> zygote.Done:
        return zygote.Done(code, "", stderr, 1.0, 100.0, killed)

    assert zygote.fault(done(2, "error: no such file")) is None
    assert zygote.fault(done(0, "")) is None
    said = zygote.fault(
        done(3, "Traceback (most recent call last):\n  File\nKeyError: 'a'\nerror: this is a fault of\n")
    )
    assert said == "a traceback: KeyError: 'a'"
    for bad in (done(3, "error: x"), done(-11, ""), done(2, ""), done(-9, "", "time")):
        assert zygote.fault(bad) is not None


def test_other_numbers_in_silence_are_a_fault_where_a_format_can_tell() -> None:
    def judged(code: int, stdout: str, stderr: str, noticeable: bool) -> tuple[str, str | None]:
        read = zygote.Done(code, stdout, stderr, 1.0, 100.0)
        return files.judge_read(read, "digest\n", damages.Done(Path("a"), "cut", noticeable))

    assert judged(0, "digest\n", "", True) == ("read, the same", None)
    assert judged(0, "other\n", "", False) == ("read, other numbers", None)
    assert judged(0, "other\n", "", True)[1] is not None
    assert judged(2, "", "error: a is damaged\n", True) == ("refused", None)
    assert judged(2, "", "something\n", True)[1] is not None


# --- what is sent -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("host", ["192.168.0.1", "8.8.8.8", "::2", "localhost.example", "0.0.0.0", ""])
def test_only_loopback_is_attacked(host: str) -> None:
    with pytest.raises(ValueError, match="loopback"):
        check_loopback(host)
    assert check_loopback("127.0.0.1") == "127.0.0.1"


def test_frames_are_named_by_two_numbers_and_judged_by_a_decoder_that_agrees_with_the_servers() -> None:
    kinds, taken = set(), 0
    for number in range(1500):
        one = case(7, number)
        assert one == case(7, number)
        kinds.add(one.kind)
        try:
            value = unpack(one.message or b"\xc1")
        except WireError:
            assert not one.valid
            continue
        taken += 1
        assert one.message is not None
        assert digest(decode(one.message)) == digest(value), (number, one.kind)
    assert taken > 100 and len(kinds) > 20
    assert case(8, 0).wire != case(7, 0).wire


def test_absurd_commands_reach_every_command_and_write_only_into_their_folder() -> None:
    options = commands.parameters()
    assert {"--out", "--seed", "--json", "--steps"} <= {option.name for option in options["infer"]}
    assert set(commands.BASES) == set(options), "a new command needs a base: how it is called when nothing is absurd"
    lines = commands.command_lines(1, 600, options)
    assert lines == commands.command_lines(1, 600, options)
    assert {line[0] for line in lines} == set(options)
    for line in lines:
        assert "--host" not in line
        for name, value in itertools.pairwise(line):
            assert name not in commands._OUTPUTS or value.startswith(("{here}", "--")), line


def test_every_damage_changes_something_and_is_the_same_again(tmp_path: Path) -> None:
    content = {"a": [1, 2.5, "x"], "b": {"c": None, "d": [{"e": 1}]}}
    seen = set()
    for number in range(120):
        found = []
        for copy in ("one", "other"):
            folder = tmp_path / f"{number}-{copy}"
            folder.mkdir()
            (folder / "a.json").write_text(json.dumps(content))
            (folder / "b.npz").write_bytes(bytes(range(200)))
            done = damages.damage(random.Random(number), folder)
            now = {path.name: path.read_bytes() if path.is_file() else None for path in folder.iterdir()}
            found.append((done.how, now))
        assert found[0] == found[1]
        seen.add(found[0][0].split()[0])
    assert len(seen) > 8


def test_the_whole_run_fits_into_pieces_of_nine_minutes_and_sends_a_million_frames() -> None:
    assert all(attack.minutes <= 8 for attack in ATTACKS.values())
    frames = ATTACKS["frames"].size
    assert frames.count * frames.pieces == 1_000_000


# --- recordings -------------------------------------------------------------------------------------------------------


def recorded(folder: Path, count: int = 3) -> Path:
    """The folder of a run with so many calls, whose answers are digests."""
    recorder = Recorder(folder, {"policy": "fake"})
    for number in range(count):
        observation = {**OBSERVATION, "prompt": f"number {number}"}
        recorder.put(observation, {"actions": digest_actions(observation)}, size=1)
    recorder.close()
    return recorder.folder


def faults_of(folder: Path, *, killed: bool = False) -> tuple[int, list[str]]:
    faults: list[str] = []
    return check_recording(folder, killed=killed, fault=faults.append), faults


def test_a_whole_recording_has_no_fault(tmp_path: Path) -> None:
    recorded(tmp_path)
    assert faults_of(tmp_path) == (3, [])


def test_what_is_wrong_with_a_recording_is_found(tmp_path: Path) -> None:
    run = recorded(tmp_path)
    with (run / "index.jsonl").open("a") as index:
        index.write('{"file": "0000')
    assert faults_of(tmp_path, killed=True) == (3, [])
    assert "isn't JSON" in faults_of(tmp_path)[1][0]
    (run / "000001.npz").write_bytes((run / "000001.npz").read_bytes()[:-30])
    (run / ".000009.npz.part").write_bytes(b"")
    calls, faults = faults_of(tmp_path)
    assert calls == 2 and len(faults) == 3
    (run / "000000.npz").unlink()
    assert any("aren't there" in fault for fault in faults_of(tmp_path, killed=True)[1])


def test_an_answer_recorded_with_another_observation_is_found(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, {})
    recorder.put(OBSERVATION, {"actions": digest_actions({})}, size=1)
    recorder.close()
    assert "another observation" in faults_of(tmp_path)[1][0]


# --- results ----------------------------------------------------------------------------------------------------------


def piece(name: str, seed: int, *, ratio: float | None, faults: int = 0, count: int = 10) -> results.Piece:
    found = Found(count=count)
    for number in range(faults):
        found.violate(f"wrong {number}", "do it again")
    found.bars.append(Bar("ratio", ratio, 1.5))
    found.outcomes["refused"] += count
    return results.piece(ATTACKS[name], seed, Size(count), found, {}, time.monotonic())


def test_pieces_add_up_and_the_worst_bar_counts(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    for one in (piece("frames", 0, ratio=1.2), piece("frames", 1, ratio=1.4, count=5), piece("churn", 0, ratio=1.0)):
        pieces = results.add(file, one)
    frames, churn = results.totals(results.load(file))
    assert (frames.attack, frames.count, frames.pieces, churn.count) == ("frames", 15, 2, 10)
    assert frames.bars["ratio"].value == 1.4 and frames.outcomes == {"refused": 15}
    assert results.held(pieces)
    pieces = results.add(file, piece("frames", 1, ratio=None, faults=2))
    (frames, _) = results.totals(pieces)
    assert (frames.count, frames.violations, frames.broken) == (20, 2, ["ratio"])
    assert not results.held(pieces)
    assert pieces[0].provenance.commit and pieces[0].prediction


def test_the_table_fits_eighty_columns() -> None:
    pieces = [piece(name, 0, ratio=None, faults=3, count=1_234_567) for name in ATTACKS]
    out = io.StringIO()
    Console(file=out, width=80).print(results.table(pieces))
    lines = out.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    assert all(any(name in line for line in lines) for name in ATTACKS), "a name was cut"
    assert "1,234,567" in out.getvalue()


def test_a_file_of_another_kind_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "a.json"
    file.write_text('{"format": "other"}')
    assert main(["show", str(file)]) == 2
    assert "format is 'other'; expected turbopi-attack (no result of this tool)" in capsys.readouterr().err


# --- runs -------------------------------------------------------------------------------------------------------------


class Mixed(DigestPolicy):
    """A policy that answers with the observation before: what the tool is there to find."""

    def __init__(self) -> None:
        super().__init__(0)
        self._before: dict[str, Any] = {}

    def infer(self, obs: dict[str, Any], /) -> dict[str, Any]:
        self._before, now = obs, self._before
        return super().infer(now)


@pytest.mark.slow
@pytest.mark.parametrize(("policy", "wrong"), [(DigestPolicy(0), False), (Mixed(), True)])
def test_answers_that_belong_to_others_are_found(policy: DigestPolicy, wrong: bool) -> None:
    found = Found()
    with running(policy) as server:
        asyncio.run(send(server.port, 3, range(120), found))
    assert found.count == 120
    assert found.outcomes["result" if not wrong else "wrong"] >= 5
    assert bool(found.violations) == wrong
    if wrong:
        assert found.violations[0]["reproduce"].startswith("python -m attack frame 3 ")


@pytest.mark.slow
def test_damaged_files_through_their_readers(tmp_path: Path) -> None:
    """The judging is the tool's own business here: that each damage was read, and its outcome is known."""
    found, quick = Found(), [one for one in SPECIMENS if one.name in ("observation, by hand", "noise")]
    files.files(1, 3, tmp_path, found, lambda share: None, quick)
    assert found.count == 6 == sum(found.outcomes.values())
    assert set(found.outcomes) <= {"refused", "fault", "read, the same", "read, other numbers"}


def test_an_observation_of_no_robot_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "observation.json").write_text('{"a":' * 50 + "1" + "}" * 50)
    with pytest.raises(typer.Exit) as ended:
        read_observation(str(tmp_path))
    assert ended.value.exit_code == 2 and "observation/image" in capsys.readouterr().err


@pytest.mark.slow
def test_a_tiny_run_leaves_its_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "a.json"
    assert main(["run", "frames", "--count", "80", "--seed", "5", "--out", str(file)]) == 0
    assert "held" in capsys.readouterr().out
    (one,) = results.load(file)
    assert (one.attack, one.seed, one.count, one.verdict) == ("frames", 5, 80, "held")
    assert one.server is not None
    assert one.server["rss_mb"]["peak"] >= one.server["rss_mb"]["before"] > 0
    assert one.server["health"]["failed"] == 0
    assert one.server["good"]["attacked_ms"]["n"] >= 0
    assert main(["show", str(file)]) == 0


@pytest.mark.slow
def test_pieces_run_side_by_side_and_what_there_is_no_time_for_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    few = replace(ATTACKS["frames"], size=Size(20, pieces=2, few=20), minutes=0.1)
    long = replace(ATTACKS["slow_walk"], minutes=1e6)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    monkeypatch.setattr("attack.__main__.ATTACKS", {"frames": few, "slow_walk": long})
    file = tmp_path / "a.json"
    assert main(["all", "--jobs", "2", "--small", "--minutes", "1000", "--out", str(file)]) == 3
    assert [(one.attack, one.seed) for one in results.load(file)] == [("frames", 0)]
    assert "next: slow_walk, seed 0" in capsys.readouterr().out
    assert main(["all", "--jobs", "0", "--out", str(file)]) == 2
    assert "--jobs must be 1 or more, not 0" in capsys.readouterr().err
