"""How well a surface explains a frame."""

import numpy as np
import pytest

from ecslam.pixels import Pixels
from ecslam.tracker import fit

TRUNCATION_M = 0.06


class Wall:
    """A surface at z = 2 m that is known where x lies below ``edge`` metres."""

    def __init__(self, edge=np.inf):
        self.edge = edge

    def distances(self, points):
        return (2 - points[:, 2]).astype(np.float32), points[:, 0] < self.edge


def measured(depth_m, without=0):
    """Pixels spread from left to right, at one depth each; some more without any."""
    count = len(depth_m) + without
    direction = np.stack([np.linspace(-0.5, 0.5, count), np.zeros(count)], 1).astype(np.float32)
    depth = np.concatenate([np.array(depth_m, np.float32), np.zeros(without, np.float32)])
    return Pixels(direction, depth, np.zeros((count, 3), np.uint8), np.zeros(count, bool))


def test_points_within_half_a_truncation_on_either_side_are_explained():
    depths = [2.0] * 40 + [2.029] * 20 + [1.971] * 20 + [2.031] * 10 + [1.969] * 10
    assert fit(Wall(), measured(depths, without=50), np.eye(4), TRUNCATION_M) == pytest.approx(0.8)


def test_a_pose_that_is_off_explains_nothing():
    c2w = np.eye(4)
    c2w[2, 3] = 0.05
    assert fit(Wall(), measured([2.0] * 100), c2w, TRUNCATION_M) == 0


@pytest.mark.parametrize(("edge", "explained"), [(0.0, 1.0), (-0.7, 1.0), (-0.85, 0.0)])
def test_only_what_is_known_counts_and_next_to_nothing_says_nothing(edge, explained):
    """At 2 m the points reach from -1 to 1 m, so that below -0.85 m lie 7.5 % of them."""
    assert fit(Wall(edge), measured([2.0] * 201), np.eye(4), TRUNCATION_M) == explained
