"""Where the map begins, and when it grows."""

import numpy as np
import pytest

from ecslam.config import FieldConfig
from ecslam.pixels import Pixels
from ecslam.scene_box import SceneBox

MARGIN_M = 0.1
CONFIG = FieldConfig(box_margin_m=MARGIN_M)
BOX = np.array([[-1.0, -1, 0], [1, 1, 3]], np.float32)


def wall(outside=0.0, count=1000):
    """Pixels of a wall 2 m ahead, of which a share lies at 4 m."""
    direction = np.random.default_rng(0).uniform(-0.2, 0.2, (count, 2)).astype(np.float32)
    depth = np.where(np.arange(count) < outside * count, 4, 2).astype(np.float32)
    return Pixels(direction, depth, np.zeros((count, 3), np.uint8), np.zeros(count, bool))


def test_it_begins_as_given_else_around_what_the_first_frame_measured():
    assert SceneBox(CONFIG, BOX.astype(float)).first(wall(), np.eye(4)).tolist() == BOX.tolist()
    c2w = np.eye(4)
    c2w[:3, 3] = 10, 0, 0
    low, high = SceneBox(CONFIG, None).first(wall(), c2w)
    side = 0.02 * np.hypot(0.8, 0.8)
    assert low == pytest.approx([10 - 0.4 - MARGIN_M - side, -0.4 - MARGIN_M - side, 2 - MARGIN_M - side], abs=0.01)
    assert high == pytest.approx([10 + 0.4 + MARGIN_M + side, 0.4 + MARGIN_M + side, 2 + MARGIN_M + side], abs=0.01)


@pytest.mark.parametrize(("outside", "grows"), [(0.0, False), (0.008, False), (0.03, True), (0.4, True)])
def test_it_grows_where_over_one_in_a_hundred_points_lies_outside(outside, grows):
    more, note = SceneBox(CONFIG, None).check(BOX, wall(outside), np.eye(4))
    assert note == ""
    assert (more is not None) == grows
    if more is not None:
        assert more[1, 2] > 4


def test_one_from_the_configuration_stays_and_is_complained_about_when_it_gets_twice_as_bad():
    box = SceneBox(FieldConfig(box=tuple(BOX.ravel().tolist())), np.zeros((2, 3)))
    assert box.first(wall(), np.eye(4)).tolist() == BOX.tolist()
    notes = [box.check(BOX, wall(outside), np.eye(4))[1] for outside in (0.005, 0.1, 0.15, 0.3)]
    assert [note.partition(" ")[0] for note in notes] == ["", "10%", "", "30%"]
