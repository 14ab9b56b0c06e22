"""Films, reports, comparisons."""

import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluate_fakes import SeekingPolicy, run
from file_helpers import no_room
from msgspec.structs import replace

from turbopi.evaluate.compare import HEADS, cells, compare, write_comparison
from turbopi.evaluate.frames import Frame
from turbopi.evaluate.plan import VideoPlan, parse_numbers
from turbopi.evaluate.reading import load_results
from turbopi.evaluate.report import write_report
from turbopi.evaluate.sources import Answer, LocalPolicy
from turbopi.evaluate.video import chunk_groups, draw_frame, write_video
from turbopi.evaluate.visited import Visited, action_error
from turbopi.support.errors import ConfigError, OutputError

pytestmark = pytest.mark.usefixtures("unseen_plots")

GROUPS = chunk_groups("libero", 7)


def frame(step: int = 0, value: float = 0.5) -> Frame:
    camera_image = np.full((32, 32, 3), 90, np.uint8)
    return Frame(step, [camera_image, camera_image], np.full((10, 7), value), planned=5, done=0)


def test_a_frame_shows_caption_pictures_and_chunk() -> None:
    drawn = draw_frame(frame(), "reach the dot", GROUPS, None)
    assert drawn.dtype == np.uint8 and drawn.shape[0] % 2 == drawn.shape[1] % 2 == 0
    assert (drawn == 90).all(axis=2).sum() > 2 * 310 * 310  # both views, but for the tag
    other = draw_frame(frame(value=-0.5), "reach the dot", GROUPS, None)
    changed = np.nonzero((drawn != other).any(axis=(1, 2)))[0]
    assert len(changed) and changed.min() > 320  # another chunk changes the plots below the views, and nothing else
    longer = draw_frame(
        frame(), "pick up the black bowl next to the ramekin and place it on the plate " * 2, GROUPS, None
    )
    assert longer.shape[0] > drawn.shape[0]


@pytest.mark.parametrize("value", [np.nan, 0.0, 1e6])
def test_any_chunk_can_be_drawn(value: float) -> None:
    assert draw_frame(frame(value=value), "x", GROUPS, "aborted").shape[2] == 3


def test_a_film_has_the_simulations_speed(tmp_path: Path) -> None:
    imageio = pytest.importorskip("imageio.v2", reason="pip install 'imageio[ffmpeg]'")
    write_video(tmp_path / "a.mp4", [frame(step) for step in range(0, 40, 5)], "x", "success", "libero", 20.0)
    with imageio.get_reader(tmp_path / "a.mp4") as on_frame:
        assert on_frame.get_meta_data()["fps"] == 8
        assert on_frame.count_frames() == 8 * 2 + 12  # each twice, the last one for another 1.5 s


@pytest.mark.slow
def test_failures_and_a_sample_of_successes_are_filmed(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="pip install 'imageio[ffmpeg]'")
    results = run(tmp_path, SeekingPolicy({0: "nan"}), states=(0, 1, 2, 3), videos=VideoPlan(successes=2))
    names = {episode.initial_state: episode.video for episode in results.in_order()}
    assert names == {
        0: "videos/task00_state00_aborted.mp4",
        1: "videos/task00_state01_success.mp4",
        2: None,
        3: None,
    }
    assert {f"videos/{path.name}" for path in (tmp_path / "videos").iterdir()} == {names[0], names[1]}


def test_a_video_that_cannot_be_written_costs_no_verdict(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="pip install 'imageio[ffmpeg]'")
    (tmp_path / "videos").write_text("in the way")
    (episode,) = run(tmp_path, SeekingPolicy(), states=(0,), videos=VideoPlan("all")).in_order()
    assert episode.success and episode.video is None
    assert str(episode.message).startswith("the video couldn't be written: ")


def test_the_report_opens_from_disk_and_loads_nothing_else(tmp_path: Path) -> None:
    results = run(tmp_path, SeekingPolicy({0: "nan"}), tasks=(0, 1), states=(0, 1))
    text = (tmp_path / "report.html").read_text()
    assert not re.search(r"https?:|//|<script|<link|@import", text.split("</head>")[1])
    for name in re.findall(r'src="([^"]+)"', text):
        assert (tmp_path / name).is_file()
    shown = html.unescape(text)
    assert "3/4" in shown and "75.0 %" in shown and "30.1 to 95.4 %" in shown
    assert "Aborted, as actions weren't finite: 1" in shown and "aren't finite (nan at [2, 1])" in shown
    assert results.tasks[1].instruction in shown


EVIL = '"><script>alert(1)</script>'


def with_evil_text(value: Any, name: str = "") -> Any:
    """A document with script in every text that may come from elsewhere, keys included, where a reader accepts it."""
    if name in ("motion", "real_time"):
        return value  # numbers, or null
    if isinstance(value, dict):
        free = name in ("about", "identity", "versions", "options")
        found = {key: with_evil_text(item, "about" if free else key) for key, item in value.items()}
        return found | ({EVIL: EVIL} if free else {})
    if isinstance(value, list):
        return [with_evil_text(item, name) for item in value]
    return value if name in ("format", "complete", "status") or isinstance(value, int | float) else EVIL


@pytest.mark.slow
def test_foreign_text_is_escaped_wherever_a_page_shows_it(tmp_path: Path) -> None:
    for name, policy in (("a", SeekingPolicy()), ("b", SeekingPolicy({0: "nan"}))):
        run(tmp_path / name, policy, states=(0, 1))
        file = tmp_path / name / "results.json"
        document = with_evil_text(json.loads(file.read_text()))
        file.write_text(json.dumps(document))
    runs = [load_results(tmp_path / name) for name in "ab"]
    assert runs[0].label == runs[0].episodes[0, 0].video == runs[0].tasks[0].instruction == EVIL
    pages = [write_report(runs[1]), write_comparison(tmp_path, compare(runs))[2]]
    for page, least in zip(pages, (12, 5), strict=True):
        text = page.read_text()
        assert "<script" not in text and '="">' not in text
        assert text.count("&lt;script&gt;") >= least


def test_pages_are_escaped_whatever_a_results_object_holds(tmp_path: Path) -> None:
    """Also where `load_results` would have refused it."""
    results = run(tmp_path, SeekingPolicy(), states=(0,))
    (episode,) = results.in_order()
    results.episodes[0, 0] = replace(episode, status=EVIL, message=EVIL, seed=EVIL)
    results.started = EVIL
    results.protocol = {**results.protocol, "suite": EVIL}
    assert "<script" not in write_report(results).read_text()


@pytest.mark.slow
def test_dollars_in_a_label_are_no_formula(tmp_path: Path) -> None:
    policies = SeekingPolicy(), SeekingPolicy()
    for policy in policies:
        policy.metadata["backend"] = r"$\nothing{$"
    runs = [run(tmp_path / name, policy, states=(0,)) for name, policy in zip("ab", policies, strict=True)]
    assert all(path.is_file() for path in write_comparison(tmp_path, compare(runs)))


@pytest.mark.slow
def test_comparing_pairs_the_common_episodes(tmp_path: Path) -> None:
    first = run(tmp_path / "a", SeekingPolicy(), states=(0, 1, 2, 3))
    second = run(tmp_path / "b", SeekingPolicy({0: "nan"}), states=(0, 1, 2))
    compared = compare([first, second])
    assert [(c.rate.successes, c.rate.trials) for c in compared] == [(3, 3), (2, 3)]
    paired = compared[1].paired
    assert paired is not None
    assert (paired.both, paired.only_first, paired.only_second, paired.neither) == (2, 1, 0, 0)
    assert HEADS[3] == "difference,\npoints [95 %]"
    assert cells(compared[1])[2] == "66.7 % [20.8, 93.9]"
    assert re.fullmatch(r"-33\.3 \[-\d+\.\d, \+\d+\.\d\]", cells(compared[1])[3])
    assert cells(compared[1])[4:6] == ["1 : 0", "1.00"]
    written = write_comparison(tmp_path / "c", compared)
    assert json.loads(written[0].read_text())["runs"][1]["paired_with_first"]["only_first"] == 1
    assert "aborted" in written[2].read_text()


@pytest.mark.slow
def test_a_comparison_tells_the_precision_and_calibration_on_noise(tmp_path: Path) -> None:
    exact, rounded = SeekingPolicy(), SeekingPolicy()
    exact.metadata["precision"], rounded.metadata["precision"] = "f32", "fp8"
    rounded.metadata["backend_details"] = {"fp8": {"observations": "random-noise"}}
    runs = [run(tmp_path / name, policy, states=(0,)) for name, policy in (("a", exact), ("b", rounded))]
    compared = compare(runs)
    assert [cells(one)[HEADS.index("precision")] for one in compared] == ["f32", "fp8, random noise"]
    assert [one.document.precision for one in compared] == ["f32", "fp8, random noise"]


def in_fp8(calibration: str) -> SeekingPolicy:
    policy = SeekingPolicy()
    policy.metadata |= {"precision": "fp8", "backend_details": {"fp8": {"identity": calibration}}}
    return policy


@pytest.mark.slow
def test_runs_of_two_calibrations_are_only_compared_on_purpose(tmp_path: Path) -> None:
    policies = {"exact": SeekingPolicy(), "one": in_fp8("aaaaaaaaaaaa"), "other": in_fp8("bbbbbbbbbbbb")}
    exact, one, other = (run(tmp_path / name, policy, states=(0,)) for name, policy in policies.items())
    assert len(compare([exact, one])) == 2
    with pytest.raises(ConfigError, match=r"different calibrations \(aaaaaaaa and bbbbbbbb\): .*--across-calibrations"):
        compare([exact, one, other])
    compared = compare([exact, one, other], across_calibrations=True)
    assert [run.precision for run in compared] == ["f32", "fp8, aaaaaaaa", "fp8, bbbbbbbb"]
    assert [run.document.calibration for run in compared] == [None, "aaaaaaaaaaaa", "bbbbbbbbbbbb"]


@pytest.mark.slow
def test_what_servers_tell_stands_for_their_weights(tmp_path: Path) -> None:
    one, other = (run(tmp_path / name, in_fp8(name * 12), states=(0,)) for name in "ab")
    for results, config in ((one, "pi05_base"), (other, "pi05_libero")):
        calibration = results.policy.identity["calibration"]
        reported = {"server": {"config": config}, "calibration": calibration}
        results.policy = replace(results.policy, identity=reported)
    assert len(compare([one, other])) == 2
    other.policy = replace(other.policy, identity={**other.policy.identity, "server": {"config": "pi05_base"}})
    with pytest.raises(ConfigError, match="FP8 of one model by different calibrations"):
        compare([one, other])


@pytest.mark.slow
def test_a_run_is_not_continued_with_another_calibration(tmp_path: Path) -> None:
    run(tmp_path, in_fp8("aaaaaaaaaaaa"), states=(0,))
    run(tmp_path, in_fp8("aaaaaaaaaaaa"), states=(0, 1))
    with pytest.raises(ConfigError, match=r"policy\.calibration = 'aaaaaaaaaaaa', but this one has 'bbbbbbbbbbbb'"):
        run(tmp_path, in_fp8("bbbbbbbbbbbb"), states=(0, 1))


@pytest.mark.slow
def test_runs_of_another_protocol_are_not_compared(tmp_path: Path) -> None:
    first = run(tmp_path / "a", SeekingPolicy(), states=(0,))
    second = run(tmp_path / "b", SeekingPolicy(), states=(0,), replan=3)
    with pytest.raises(ConfigError, match="aren't comparable: replan is 5 in one and 3 in the other"):
        compare([first, second])
    second.protocol = {**second.protocol, "simulator": "chase"}
    with pytest.raises(ConfigError, match=r"aren't comparable: simulator is .* in one and 'chase' in the other"):
        compare([first, second])
    third = run(tmp_path / "c", SeekingPolicy(), states=(1,))
    with pytest.raises(ConfigError, match="no episode has a verdict in every one of"):
        compare([first, third])


def test_visited_observations_give_the_action_error(tmp_path: Path) -> None:
    class Off(SeekingPolicy):
        def infer_batch(self, observations: Any, seed: Any) -> Any:
            results = super().infer_batch(observations, seed)
            return [result | {"actions": result["actions"] + 0.25} for result in results]

    visited, source = Visited(tmp_path, kept=4), LocalPolicy(SeekingPolicy())
    observations = []
    for number in range(9):
        camera_image = np.full((32, 32, 3), 235, np.uint8)
        camera_image[3 * number, 5] = (200, 40, 40)
        state = np.zeros(8)
        observation = {"observation/image": camera_image, "observation/state": state, "prompt": f"number {number}"}
        observations.append(observation)
        visited(None, 0, observation, 2**63 + number, source.infer([observation], [0])[0])  # type: ignore[arg-type]
    assert visited.seen == 9 and len(visited.entries) == 4
    visited.save()
    again = Visited(tmp_path, kept=4)
    assert again.seen == 9
    assert [str(entry["prompt"]) for entry in again.entries] == [str(entry["prompt"]) for entry in visited.entries]
    exact = action_error(again.entries, source)
    assert exact is not None and exact.rms == exact.max == 0
    off = action_error(again.entries, LocalPolicy(Off()))
    assert off is not None and off.max >= off.rms > 0.1
    assert action_error([], source) is None


def test_a_dimension_that_is_held_still_counts_in_its_own_unit() -> None:
    class Still:
        """Its fourth number is always 1, but for what un-normalising adds."""

        def __init__(self, off: float) -> None:
            self._off = off

        def infer(self, observations: Any, seeds: Any) -> list[Answer]:
            actions = np.random.default_rng(seeds[0]).normal(size=(10, 4))
            actions[:, 3] = 1 + 1e-6 * actions[:, 3]
            return [Answer(actions + self._off * np.array([0, 0, 0, 1]), None)]

    entry = {"seed": np.array(3), "prompt": np.array("x"), "actions": Still(0).infer([{}], [3])[0].actions}
    off = action_error([entry], Still(1e-4))  # type: ignore[arg-type]
    assert off is not None and 0.9e-4 < off.max < 1.1e-4


def visit(visited: Visited, number: int) -> None:
    observation = {"observation/image": np.full((8, 8, 3), number, np.uint8), "prompt": "x"}
    visited(None, 0, observation, number, Answer(np.zeros((2, 7)), None))  # type: ignore[arg-type]


def test_a_run_that_never_began_leaves_the_earlier_sample(tmp_path: Path) -> None:
    first = Visited(tmp_path)
    visit(first, 1)
    first.save()
    before = (tmp_path / "visited.npz").read_bytes()
    for restart in (False, True):
        Visited(tmp_path, restart=restart).save()
        assert (tmp_path / "visited.npz").read_bytes() == before
    again = Visited(tmp_path, restart=True)
    visit(again, 2)
    again.save()
    assert [int(entry["seed"]) for entry in Visited(tmp_path).entries] == [2]


def test_a_damaged_sample_is_refused_by_file(tmp_path: Path) -> None:
    file = tmp_path / "visited.npz"
    sample = Visited(tmp_path)
    visit(sample, 1)
    sample.save()
    whole = file.read_bytes()
    for content in (b"", b"text", whole[:-40], whole.replace(b"0|seed", b"2|seed")):
        file.write_bytes(content)
        with pytest.raises(ConfigError, match=f"^{file}"):
            Visited(tmp_path)
    np.savez(file, seen=3, count=2)
    with pytest.raises(ConfigError, match="lacks entries; give another --out, or --restart"):
        Visited(tmp_path)


def test_a_film_that_cant_be_written_leaves_the_earlier_one(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="pip install 'imageio[ffmpeg]'")
    file = tmp_path / "a.mp4"
    write_video(file, [frame()], "x", "success", "libero", 20.0)
    before = file.read_bytes()
    with (
        no_room(1000),
        pytest.raises(OutputError, match=f"can't write {file}: ffmpeg could not finish it; is there room?"),
    ):
        write_video(file, [frame(step) for step in range(20)], "x", "success", "libero", 20.0)
    assert file.read_bytes() == before and [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_numbers_and_ranges_are_read() -> None:
    assert parse_numbers("--tasks", "0,2,5-7") == [0, 2, 5, 6, 7]
    for text in ("", "a", "3-", "-3", "1,,2", "¹", "0-9999999999", "1" * 5000):
        with pytest.raises(ConfigError, match=r"--tasks is .*expected whole numbers and ranges"):
            parse_numbers("--tasks", text)
    for text in ("7-5", "0,7-5", "7-5,0"):
        with pytest.raises(ConfigError, match=rf"--tasks is '{text}': there is nothing in the range 7-5"):
            parse_numbers("--tasks", text)
