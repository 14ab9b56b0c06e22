"""python -m peers: programs in turns. What one of them does wrong costs it its figures, and nobody else theirs."""

import io
import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from doc_tables import peers as table
from peers import __main__ as tool
from peers import document, entries, installing, running
from peers.document import NotMeasured, Timed, read_peers_run
from peers.drivers import rounds
from rich.console import Console

from turbopi.bench.work import Job
from turbopi.support.errors import ConfigError

JOB = Job(2, 48, 10, 10)
LIMITS = running.Limits(start_s=30.0, round_s=30.0)

FAKE = """
import json, os, subprocess, sys, time
job = json.loads(sys.argv[1])
fault = job.get("fault", "")
def say(line): print(line if isinstance(line, str) else json.dumps(line), flush=True)
def note(what): open(os.path.join(os.path.dirname(__file__), job["program"] + what), "w").write(str(time.monotonic()))
if fault == "tells when": note(" begin")
if fault == "no start": sys.exit("no such GPU")
if fault == "hangs at start": time.sleep(60)
if fault == "tells when": note(" ready")
if fault == "chats": say("loading weights ...")
say({"ready": True, "note": "a fake" + job.get("of", ""), "versions": {"fake": "1"}, "setup_s": 0.1})
if fault == "speaks twice": say({"ready": True})
for number, line in enumerate(sys.stdin):
    calls = json.loads(line)["calls"]
    if fault == "dies" and number: os._exit(3)
    if fault == "hangs" and number: time.sleep(60)
    if fault == "garbage": say("<html>"); continue
    if fault == "slow": calls = 3 if json.loads(line)["seconds"] == 0.5 else calls
    with open(os.environ["TURNS"], "a") as turns: turns.write(job["program"] + " ")
    part = {"ms": [2.0 + number] * calls, "shape": [job["horizon"], 32], "finite": True}
    part |= job.get("answer", {})
    if fault == "leaves a server": server = subprocess.Popen(["sleep", "60"], start_new_session=True)
    if fault == "leaves a server": open(job["pid"], "w").write(str(server.pid))
    say({"whole call": part, **({"on the GPU": part} if not (fault == "forgets" and number) else {})})
    if fault == "quits": os._exit(5)
"""

FAULTS = (("a", ""), ("b", "dies"), ("c", "no start"))


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> entries.Program:
    (tmp_path / "fake.py").write_text(FAKE)
    monkeypatch.setattr(entries, "DRIVERS", tmp_path)
    monkeypatch.setenv("TURNS", str(tmp_path / "turns"))
    return entries.Program("fake", "fake.py", ("bf16",), install=(("true",),))


def timed(
    fake: entries.Program, words: Mapping[str, object], limits: running.Limits = LIMITS
) -> tuple[list[Timed], list[NotMeasured]]:
    """A program that gets these words, between two good ones."""
    settings = [(replace(fake, name=name), "bf16", sys.executable, words if name == "b" else {}) for name in "abc"]
    return running.time_job(settings, JOB, rounds=3, calls=2, limits=limits)


def test_programs_are_called_in_turns_and_none_is_always_first(fake: entries.Program, tmp_path: Path) -> None:
    found, lost = timed(fake, {})
    assert (tmp_path / "turns").read_text().split() == [*"abc", *"bca", *"cab"]
    assert not lost and [(one.program, one.part) for one in found] == [
        (name, part) for name in "abc" for part in document.PARTS
    ]
    for one in found:
        assert (one.calls, one.p50_ms, one.rounds_ms, one.actions) == (6, 3.0, [2.0, 3.0, 4.0], [10, 32])
        assert (one.job, one.versions, one.note) == (JOB, {"fake": "1"}, "a fake")


@pytest.mark.parametrize(
    ("words", "stage", "said"),
    [
        ({"fault": "no start"}, "start", "it ended with 1 before it got ready; its last words: no such GPU"),
        ({"fault": "chats"}, "start", "it said 'loading weights ...', which wasn't expected"),
        ({"fault": "speaks twice"}, "call", 'it said \'{"ready"'),
        ({"fault": "dies"}, "call", "round 2: it ended with 3 before it answered 2 calls"),
        ({"fault": "quits"}, "call", "round 2: it ended with 5 before it answered 2 calls"),
        ({"fault": "garbage"}, "call", "it said '<html>', which wasn't expected"),
        ({"fault": "forgets"}, "call", "round 2: it timed ['whole call'], and before ['on the GPU', 'whole call']"),
        ({"answer": {"shape": [50, 32]}}, "call", "its actions are [50, 32]; expected [10, d]"),
        ({"answer": {"shape": [1, 10, 32]}}, "call", "its actions are [1, 10, 32]; expected [10, d]"),
        ({"answer": {"shape": [10, 1024]}}, "call", "its actions are [10, 1024]"),
        ({"answer": {"finite": False}}, "call", "its actions have NaN or infinity"),
        ({"answer": {"ms": [1.0]}}, "call", "1 times of 2 calls"),
        ({"answer": {"ms": [1.0, 0.0]}}, "call", "expected some above 0"),
        ({"answer": {"ms": "soon"}}, "call", "which wasn't expected"),
    ],
)
def test_a_program_that_fails_has_a_reason_and_no_figures(
    fake: entries.Program, words: dict[str, object], stage: str, said: str
) -> None:
    found, (lost,) = timed(fake, words)
    assert {one.program for one in found} == {"a", "c"} and all(one.calls == 6 for one in found)
    assert (lost.program, lost.job, lost.stage) == ("b", JOB, stage)
    assert said in lost.reason


@pytest.mark.parametrize(
    ("fault", "limits", "said"),
    [
        ("hangs at start", replace(LIMITS, start_s=0.2), "it hadn't got ready after 0.2 s"),
        ("hangs", replace(LIMITS, round_s=0.2), "round 2: it hadn't answered 2 calls after 0.2 s"),
    ],
)
def test_a_program_that_hangs_is_ended(fake: entries.Program, fault: str, limits: running.Limits, said: str) -> None:
    settings = [(fake, "bf16", sys.executable, {"fault": fault})]
    found, (lost,) = running.time_job(settings, JOB, rounds=3, calls=2, limits=limits)
    assert not found and said in lost.reason


@pytest.mark.parametrize(("part_s", "calls"), [(0.5, 9), (7.0, 15), (None, 15)])
def test_a_slow_programs_calls_may_be_fewer(fake: entries.Program, part_s: float | None, calls: int) -> None:
    settings = [(fake, "bf16", sys.executable, {"fault": "slow"})]
    limits = replace(LIMITS, part_s=part_s)
    found, lost = running.time_job(settings, JOB, rounds=3, calls=5, limits=limits)
    assert not lost and [one.calls for one in found] == [calls, calls]


def test_a_drivers_calls_of_a_part_end_with_its_time_but_three() -> None:
    count = iter(range(100))
    part = rounds.clocked(lambda: next(count), lambda number: [[number] * 32] * 10)
    assert len(rounds._times(part, 20, 0.0)["ms"]) == rounds.FEWEST == next(count)
    assert len(rounds._times(part, 20, None)["ms"]) == 20


def test_figures_are_given_after_each_round(fake: entries.Program) -> None:
    settings = [(replace(fake, name=name), "bf16", sys.executable, {"fault": fault}) for name, fault in FAULTS]
    seen: list[tuple[list[int], list[str]]] = []
    running.time_job(
        settings,
        JOB,
        rounds=3,
        calls=2,
        limits=LIMITS,
        after_round=lambda timed, lost: seen.append(([one.calls for one in timed], [one.program for one in lost])),
    )
    assert seen == [([2, 2, 2, 2], ["c"]), ([4, 4], ["c", "b"]), ([6, 6], ["c", "b"])]


def test_programs_that_tune_themselves_get_ready_alone(fake: entries.Program, tmp_path: Path) -> None:
    """The others stand ready by then, and each tunes by itself."""
    settings = [
        (replace(fake, name=name, tunes=name < "c"), "bf16", sys.executable, {"fault": "tells when"}) for name in "abcd"
    ]
    said: list[str] = []
    running.time_job(settings, JOB, rounds=1, calls=1, limits=LIMITS, say=said.append)
    assert [line.split()[0] for line in said] == ["c", "d", "a", "b"]
    begin, ready = (
        {one: float((tmp_path / f"{one} {what}").read_text()) for one in "abcd"} for what in ("begin", "ready")
    )
    assert max(ready["c"], ready["d"]) < begin["a"] and ready["a"] < begin["b"]


def test_what_a_program_started_ends_with_it(fake: entries.Program, tmp_path: Path) -> None:
    found, lost = timed(fake, {"fault": "leaves a server", "pid": str(tmp_path / "pid")})
    assert not lost and found
    pid = int((tmp_path / "pid").read_text())
    assert not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE


def test_a_python_that_is_missing_is_a_reason(fake: entries.Program) -> None:
    found, (lost,) = running.time_job([(fake, "bf16", "/no/python", {})], JOB, rounds=1, calls=1, limits=LIMITS)
    assert not found and lost.reason == "/no/python: No such file or directory"


# --- installing -------------------------------------------------------------------------------------------------------


def test_what_an_installation_failed_of_is_written_down(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = entries.Program(
        "made",
        "x.py",
        ("bf16",),
        install=(("{python}", "-c", "print('{arch} {src}')"), ("sh", "-c", "echo no; exit 4")),
    )
    every = installing.commands
    monkeypatch.setattr(installing, "commands", lambda *given, **options: every(*given, **options)[1:])  # no venv
    monkeypatch.setattr(installing, "python_of", lambda program, home: sys.executable)
    assert "python -m peers install made" in (installing.missing(program, tmp_path) or "")
    reason = installing.install(program, tmp_path, "90")
    assert reason == "`sh -c echo no; exit 4` ended with 4: no" == installing.missing(program, tmp_path)
    good = replace(program, install=program.install[:1])
    assert installing.install(good, tmp_path, "90") is None is installing.missing(good, tmp_path)
    assert "No such file" in (installing.install(replace(good, install=(("/no/tool",),)), tmp_path, "90") or "")


@pytest.mark.parametrize("program", entries.PROGRAMS, ids=lambda program: program.name)
def test_each_programs_plan_is_whole(program: entries.Program, tmp_path: Path) -> None:
    """What each would run: pinned sources and versions, every place filled, a driver that compiles."""
    compile(program.script.read_text(), program.script.name, "exec")
    plan = installing.commands(program, tmp_path, "90")
    words = [word for command in plan for word in command]
    assert not any("{" + name + "}" in word for word in words for name in ("python", "tool", "src", "arch"))
    if program.git:
        assert program.git[1] in words and len(program.git[1]) == 40
    for command in plan[1:]:
        if "pip" in command:
            assert any("==" in word for word in command), command
    assert bool(plan) == (program is not entries.OURS)
    offline = installing.commands(program, tmp_path, "90", src="/sources", site_packages=True)
    assert all(program.git[0] not in command for command in offline) if program.git else True
    assert (["cp", "-r", "/sources", str(tmp_path / program.name / "src")] in offline) == bool(plan)


def test_every_setting_has_a_row_in_the_table() -> None:
    known = set(table.SHOWN.values())
    assert all(any((p.name, setting) in known for setting in p.settings) for p in entries.PROGRAMS)
    assert {name for name, _ in known} == {program.name for program in entries.PROGRAMS}


# --- the tool ---------------------------------------------------------------------------------------------------------


def programs_are(monkeypatch: pytest.MonkeyPatch, ours: entries.Program, *others: entries.Program) -> None:
    monkeypatch.setattr(tool, "OURS", ours)
    monkeypatch.setattr(tool, "BY_NAME", {one.name: one for one in (ours, *others)})
    monkeypatch.setattr(tool, "OTHERS", [one.name for one in others])


def test_a_run_is_one_file_that_the_table_is_written_from(
    fake: entries.Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    programs_are(
        monkeypatch,
        replace(fake, name="turbopi", install=()),
        replace(fake, name="lerobot", settings=("bf16 eager",)),
        replace(fake, name="sglang", needs_checkpoint=True),
    )
    file, out = tmp_path / "peers.json", io.StringIO()
    words = ["--home", str(tmp_path / "home"), "run", "--python", f"lerobot={sys.executable}", "--device=cpu"]
    words += ["--horizons=10,50", "--rounds=2", "--calls=2", "--out", str(file)]
    assert tool.main(words, Console(file=out, width=200)) == 1  # one has no figures
    run = read_peers_run(file)
    assert {(one.program, one.part, one.job.horizon) for one in run.timed} == {
        (name, part, horizon) for name in ("turbopi", "lerobot") for part in document.PARTS for horizon in (10, 50)
    }
    assert [(one.program, one.stage, one.job) for one in run.not_measured] == [("sglang", "install", None)]
    assert "not measured: sglang, bf16, install: it isn't installed" in out.getvalue()
    assert run.provenance.device == "cpu" and run.clocks == []
    assert table.peers(table.read_run(file)) == [
        "| ms | whole call, H = 10 | H = 50 | on the GPU, H = 10 | H = 50 |",
        "|---|--:|--:|--:|--:|",
        "| Turbo-Pi, bf16 | 2.50 | 2.50 | 2.50 | 2.50 |",
        "| LeRobot, PyTorch eager | 2.50 | 2.50 | 2.50 | 2.50 |",
        "| SGLang, bf16 | not measured | | | |",
    ]
    rows_of_pi05 = table.peers(table.read_run(file))[2:]
    assert tool.main([*words, "--dry-run", "--peers=lerobot"], Console(file=out, width=200)) == 0
    out.truncate(0)
    assert tool.main([*words, "--dry-run", "--without=lerobot=bf16 eager"], Console(file=out, width=200)) == 0
    assert "turbopi, bf16" in out.getvalue() and "lerobot" not in out.getvalue()
    older = table.Run(
        "2026-11-28", {("sglang", "bf16", table.WHOLE, 10): 40.0, ("turbopi", "bf16", table.WHOLE, 10): 7.0}
    )
    newer = table.read_run(file)._replace(date="2026-11-29")
    rows = table.peers(older, newer)[2:]
    assert rows[0] == "| Turbo-Pi, bf16 | 2.50 | 2.50 | 2.50 | 2.50 |"
    assert rows[2] == "| SGLang, bf16 (2026-11-28) | 40.00 |  |  |  |"  # the newer run has no figure of it
    written = json.loads(file.read_text())
    unnamed = {key: value for key, value in written.items() if key != "model"}  # as files were before
    for changed, said in (
        (unnamed | {"small": True}, "small models"),
        (written | {"model": "smolvla"}, "is of smolvla"),
    ):
        file.write_text(json.dumps(changed))
        with pytest.raises(ConfigError, match=said):
            table.read_run(file)
    file.write_text(json.dumps(unnamed))
    assert table.peers(table.read_run(file))[2:] == rows_of_pi05


def test_another_models_run_has_the_programs_that_run_it(
    fake: entries.Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    programs_are(
        monkeypatch,
        replace(fake, name="turbopi", install=(), also={"smolvla": {}}),
        replace(fake, name="lerobot", also={"smolvla": {"settings": ("bf16 eager", "bf16 compiled"), "tunes": True}}),
        replace(fake, name="flashrt"),
    )
    Path(fake.script).write_text(FAKE.replace('job.get("of", "")', '" of " + job["model"]'))
    file, out = tmp_path / "smolvla.json", io.StringIO()
    words = ["run", "--python", f"lerobot={sys.executable}", "--device=cpu", "--model=smolvla", "--horizons=10"]
    words += ["--rounds=1", "--calls=1", "--without=lerobot=bf16 eager", "--out", str(file)]
    assert tool.main(words, Console(file=out, width=200)) == 0
    assert "left out: flashrt: not timed with smolvla" in out.getvalue()
    run = read_peers_run(file)
    assert (run.model, run.not_measured) == ("smolvla", [])
    assert {(one.program, one.setting, one.note) for one in run.timed} == {
        ("turbopi", "bf16", "a fake of smolvla"),
        ("lerobot", "bf16 compiled", "a fake of smolvla"),
    }
    assert {(one.job.image_width, one.job.image_height) for one in run.timed} == {(640, 480)}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "--peers=tensorrt"], "no program is named 'tensorrt'; expected some of flashrt"),
        (["run", "--python", "lerobot"], "expected NAME=PATH"),
        (["run", "--horizons=ten"], "ten"),
        (["run", "--without=flashrt=fp8"], "--without flashrt=fp8: expected bf16; fp8 nt_autotune=force; fp8"),
        (["run", "--without=tensorrt=bf16"], "--without tensorrt=bf16: expected a NAME of turbopi, flashrt"),
        (["run", "--model=smolvla", "--peers=flashrt"], "flashrt is not timed with smolvla; expected some of lerobot"),
        (["run", "--model=smolvla", "--without=lerobot=bf16"], "expected bf16 eager; bf16 compiled"),
    ],
)
def test_a_wrong_word_is_named(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        tool.main(words)
    assert said in capsys.readouterr().err
