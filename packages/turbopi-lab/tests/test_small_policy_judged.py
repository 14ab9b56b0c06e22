"""What `python -m turbopi_lab.small_policy judged` makes of evaluations' folders."""

from pathlib import Path
from typing import Any, Literal

import pytest

from turbopi.evaluate.motion import Motion
from turbopi.evaluate.results import Episode, PolicyDescription, Results
from turbopi.sim.base import Task
from turbopi_lab.small_policy.card import write_card
from turbopi_lab.small_policy.judged import DELAYED, PLAIN, delayed_table, judge, load_judged, table, write_judged

MOTION = Motion(seams=3, seam_jump=0.25, seam_gap=0.1, step_jump=0.05, jerk=0.1, standing=0, dropped=0)


def run(folder: Path, solved: str, *, weights: str = "w", **protocol: Any) -> Path:
    """solved: for the initial states from 30 on, 1 or 0."""
    policy = PolicyDescription("fused bf16", {"weights": weights}, {"device_name": "a GPU"})
    tasks = [Task(0, "pick", "pick it up", 50, 220)]
    results = Results(folder, {"suite": "libero_spatial", **protocol}, policy, tasks, {"torch": "2"}, {})
    results.planned = {(0, 30 + place) for place in range(len(solved))}
    for place, one in enumerate(solved):
        status: Literal["success", "failure"] = "success" if one == "1" else "failure"
        results.add(Episode(0, 30 + place, status, 90 + place, seed=1, seconds=1.0, motion=MOTION))
    results.save()
    return folder


def test_runs_are_paired_with_the_first_episode_by_episode(tmp_path: Path) -> None:
    first = run(tmp_path / "first", "1101")
    late = run(tmp_path / "late", "0111", execution="rtc_trained", delay=4)
    found = judge({"float32": first, "late": late}).runs
    assert found["float32"].against_first is None
    assert (found["float32"].what, found["late"].what) == ("fused bf16", "fused bf16, rtc_trained, delay 4")
    paired = found["late"].against_first
    assert paired is not None
    assert (paired.pairs, paired.only_first, paired.only_second) == (4, 1, 1)
    assert found["late"].steps == {"0": "30:x 31:91 32:92 33:93"}
    assert found["late"].by_task == {"0": (3, 4)}
    assert found["late"].seam_jump == 0.25


def test_other_weights_are_refused(tmp_path: Path) -> None:
    runs = {"a": run(tmp_path / "a", "1"), "b": run(tmp_path / "b", "1", weights="others")}
    with pytest.raises(ValueError, match="b has the weights others; expected w"):
        judge(runs)


def test_the_document_is_read_back_and_makes_the_card(tmp_path: Path) -> None:
    runs = {name: run(tmp_path / name, "1110") for name in (*PLAIN, *DELAYED)}
    write_judged(runs, tmp_path / "judged.json")
    document = load_judged(tmp_path / "judged.json")
    assert document == judge(runs)
    assert table(document)[2] == "| `pytorch`, float32 | 3 of 4 | 75.0 % [30.1, 95.4] |  |"
    assert delayed_table(document)[2].startswith("| `async` | 2 | 3 of 4 | 75.0 % [30.1, 95.4] | +0.0 [")
    curves = tmp_path / "curves.csv"
    heads = ["seconds", "step", "frames", "dagger_frames", "demonstration", "demonstration solved", "dagger"]
    heads += ["recent_trials", "recent_trials_solved"]
    curves.write_text(",".join(heads) + "\n" + ",".join("7" for _ in heads) + "\n")
    write_card(tmp_path / "judged.json", curves, tmp_path / "card.md")
    assert "| 0 | pick up the black bowl" in (tmp_path / "card.md").read_text()
