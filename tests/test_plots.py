"""Plots: axes that show a value as large as it is, one colour for one thing, and nothing that vanishes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_helpers import turbopi
from evaluate_fakes import SeekingPolicy, run
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from PIL import Image
from replay_data import EVERY, write_npz

from turbopi.checkpoint.norm_stats import FeatureStats
from turbopi.evaluate.plots import write_plots
from turbopi.policy.ranges import DrawnRange, TrainingRange
from turbopi.policy.shipped import SMALL_POLICY
from turbopi.robots.labels import Label
from turbopi.support.action_groups import action_groups
from turbopi.support.plots import SOLVED, Row, plot_chunks, write_figure

RANDOM = np.random.default_rng(0)


def axes_of(drawn: list[Figure], robot: str, chunks: list[np.ndarray], folder: Path) -> list[list[Axes]]:
    """Each row's axes, a group of actions each."""
    rows = [Row("a row", {"camera": np.zeros((8, 8, 3), np.uint8)}, chunk) for chunk in chunks]
    plot_chunks(folder / "chunks.png", rows, robot=robot, title="title", random_weights=False)
    return [panel.axes[1:] for panel in drawn[-1].subfigs]


def quiet(dims: int) -> np.ndarray:
    """float64[10, dims]: constants with the noise of a model on them."""
    return np.linspace(0.1, 0.9, dims) + 0.01 * RANDOM.standard_normal((10, dims))


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "dims"), [("libero", 7), ("droid", 8), ("aloha", 14), ("mine", 9)])
def test_noise_looks_small_and_every_row_has_the_same_axis(
    robot: str, dims: int, drawn: list[Figure], tmp_path: Path
) -> None:
    constant = np.full((10, dims), 0.7) + 0.01 * RANDOM.standard_normal((10, dims))
    for chunks in ([constant], [quiet(dims), 0.5 * quiet(dims)]):
        by_row = axes_of(drawn, robot, chunks, tmp_path)
        for number, group in enumerate(action_groups(robot, dims)):
            spans = [axes[number].get_ylim() for axes in by_row]
            assert len(set(spans)) == 1
            low, high = spans[0]
            for axes in by_row:
                for line in axes[number].get_lines():
                    values = np.asarray(line.get_ydata())
                    assert low < values.min() and values.max() < high
                    assert np.ptp(values) < 0.4 * (high - low)
            if group.limits is not None:
                assert low < group.limits[0] and group.limits[1] < high
                assert high - low < 1.2 * (group.limits[1] - group.limits[0])


def test_the_state_is_drawn_in_its_training_range_and_actions_beside_theirs(
    drawn: list[Figure], tmp_path: Path
) -> None:
    state = TrainingRange(FeatureStats(q01=np.array([0.0, 1.0]), q99=np.array([10.0, 1.0])), [Label("hip"), Label("b")])
    actions = DrawnRange((Label("left"), Label("right")), np.array([-3.0, np.nan]), np.array([2.0, np.nan]))
    rows = [Row("a row", {}, np.zeros((10, 2)), state=np.array([45.0, 1.0]))]
    ranges: dict[str, Any] = {"state_range": state.drawn, "action_range": actions}
    plot_chunks(tmp_path / "chunks.png", rows, robot="mine", title="title", random_weights=False, **ranges)
    in_range, chunk = drawn[-1].subfigs[0].axes
    assert [label.get_text() for label in in_range.get_yticklabels()] == ["hip  45", "b  1"]
    assert [np.asarray(line.get_xdata()).tolist() for line in in_range.get_lines()] == [[2], [0.5]]  # far; constant
    assert [-3.0, 2.0] in [np.asarray(line.get_ydata()).tolist() for line in chunk.get_lines()]
    low, high = chunk.get_ylim()
    assert low < -3 and high > 2  # though no action is there
    legend = chunk.get_legend()
    assert legend is not None and [text.get_text() for text in legend.get_texts()] == ["left", "right"]


def test_known_units_have_fixed_axes() -> None:
    for robot, dims in (("libero", 7), ("droid", 8), ("aloha", 14)):
        assert all(group.limits is not None for group in action_groups(robot, dims))


def test_a_value_beyond_the_limits_is_shown(drawn: list[Figure], tmp_path: Path) -> None:
    chunk = np.zeros((10, 7))
    chunk[3, 6] = 4.0
    (axes,) = axes_of(drawn, "libero", [chunk], tmp_path)
    assert axes[2].get_ylim()[1] > 4 and axes[1].get_ylim()[1] < 1.2


def test_a_character_that_no_font_has_warns_nobody(tmp_path: Path) -> None:
    figure = Figure()
    figure.suptitle("wave at the \N{ROBOT FACE}")
    write_figure(tmp_path / "one.png", figure)  # a warning would be an error here


def test_what_is_not_finite_leaves_an_axis(drawn: list[Figure], tmp_path: Path) -> None:
    (axes,) = axes_of(drawn, "mine", [np.full((10, 3), np.nan)], tmp_path)
    assert axes[0].get_ylim() == (-1, 1)


def test_a_gripper_has_a_colour_of_its_own_and_a_joint_the_same_in_both_arms(
    drawn: list[Figure], tmp_path: Path
) -> None:
    def colours(robot: str, dims: int) -> dict[str, list[Any]]:
        (axes,) = axes_of(drawn, robot, [np.zeros((10, dims))], tmp_path)
        found: dict[str, list[Any]] = {}
        for one in axes:
            for line in one.get_lines():
                found.setdefault(str(line.get_label()).removeprefix("about "), []).append(to_rgba(line.get_color()))
        return found

    libero, aloha = colours("libero", 7), colours("aloha", 14)
    for name in ("x", "y", "z"):  # translation and rotation
        assert libero[name][0] == libero[name][1] != libero["gripper"][0]
    assert all(one[0] == one[1] for name, one in aloha.items() if name.startswith("joint"))
    assert libero["gripper"] == colours("droid", 8)["gripper"] == aloha["left"] != aloha["right"]


def evaluated(drawn: list[Figure], folder: Path, **protocol: Any) -> dict[str, Axes]:
    """Plots of three episodes, by name."""
    results = run(folder, SeekingPolicy(), states=(0, 1, 2), **protocol)
    drawn.clear()  # those of the run's own report
    return {name: figure.axes[0] for name, figure in zip(write_plots(results), drawn, strict=True)}


@pytest.mark.slow
def test_a_curve_of_episodes_that_were_all_solved_ends_at_100_percent(drawn: list[Figure], tmp_path: Path) -> None:
    """Also when one was solved by the very last step that was allowed: where the axis used to end."""
    free = evaluated(drawn, tmp_path / "free")["steps.png"]
    slowest = int(np.asarray(free.get_lines()[0].get_xdata())[-2])
    for limit, plot in ((40, free), (slowest, evaluated(drawn, tmp_path / "tight", max_steps=slowest)["steps.png"])):
        curve, line = plot.get_lines()
        assert np.asarray(curve.get_ydata())[-1] == 100
        assert np.asarray(line.get_xdata()).tolist() == [limit, limit]
        reached = float(np.asarray(curve.get_xdata())[-2])
        assert reached <= limit < plot.get_xlim()[1] and plot.get_ylim()[1] > 100


def test_a_success_rate_of_zero_is_seen(drawn: list[Figure], tmp_path: Path) -> None:
    plots = evaluated(drawn, tmp_path, max_steps=2)
    assert "steps.png" not in plots
    success = plots["success.png"]
    assert [bar.get_width() for bar in success.patches] == [0, 0]  # type: ignore[attr-defined]
    ends = [line for line in success.get_lines() if line.get_marker() == "o"]
    assert [line.get_xydata().tolist() for line in ends] == [[[0, 0]], [[0, 1]]]  # type: ignore[union-attr]
    assert ends[0].get_color() == SOLVED and not any(line.get_clip_on() for line in ends)


@pytest.mark.slow
def test_the_plots_of_a_replay_are_drawn(tmp_path: Path) -> None:
    report = tmp_path / "report"
    quick = ("--device", "cpu", "--precision", "f32", "--steps", 1, "--changed", 0, "--every", EVERY)
    ran = turbopi("replay", write_npz(tmp_path / "data"), SMALL_POLICY, *quick, "--report", report)
    assert ran.exit_code == 0 and "The chunks follow the recorded actions" in ran.output
    for name in ("by_index", "joints", "episode", "worst"):
        assert np.asarray(Image.open(report / f"{name}.png")).std() > 5
