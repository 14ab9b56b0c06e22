"""The demonstrations of the two policies of the post: they differ in the side alone."""

import numpy as np
import pytest
import torch

from turbopi_lab.small_policy import post
from turbopi_lab.studies.post import ONE_WAY, TWO_WAYS, Ways

pytestmark = pytest.mark.slow


def sides(ways: Ways, number: int = 300) -> np.ndarray:
    """float64[N]: how far the first actions of demonstrations lead to the left of the way to the target."""
    frames = post.demonstrations(ways, number, 0)  # fewer than AT_ONCE: all of them begin an episode
    target, _, tip = frames.places[:250].double().unbind(1)
    line = target - tip
    moved = frames.chunks[:250, :5].double().sum(1)
    return (line[:, 0] * moved[:, 1] - line[:, 1] * moved[:, 0]).numpy()


def test_one_way_is_always_the_same_and_two_are_drawn_evenly() -> None:
    one, two = sides(ONE_WAY), sides(TWO_WAYS)
    assert len(np.unique(np.sign(one))) == 1
    assert 0.35 < (np.sign(two) == np.sign(one[0])).mean() < 0.65


def test_frames_that_arent_mirrored_keep_their_side() -> None:
    frames = post.demonstrations(ONE_WAY, 250, 0)
    torch.manual_seed(0)

    def share(mirrored: bool) -> float:
        drawn = frames.draw(400, mirrored=mirrored)
        target, _, tip = drawn.places.unbind(1)
        line, moved = target - tip, drawn.chunks[:, :5].sum(1)
        return float((line[:, 0] * moved[:, 1] < line[:, 1] * moved[:, 0]).float().mean())

    assert share(False) in (0.0, 1.0) and 0.4 < share(True) < 0.6
