"""Where the map has been observed."""

import numpy as np
import pytest

from ecslam.observed import ObservedVoxels
from ecslam.pixels import Pixels


def plane(count, depth=1.0):
    """Pixels of a wall ``depth`` metres ahead; 0 for none."""
    direction = np.random.default_rng(0).uniform(-0.4, 0.4, (count, 2)).astype(np.float32)
    depths = np.full(count, depth, np.float32)
    return Pixels(direction, depths, np.zeros((count, 3), np.uint8), np.zeros(count, bool))


def test_pixels_are_known_where_the_wall_has_been_seen():
    observed, wall = ObservedVoxels(), plane(2000)
    points = wall.points()
    observed.add(points[points[:, 0] < 0])
    known = observed.known(wall, np.eye(4), same_count=False)
    assert 900 < len(known) < 1200
    assert known.direction[:, 0].max() < 0.05
    moved = np.eye(4)
    moved[2, 3] = 0.5
    assert observed.known(wall, moved, same_count=False) is wall


@pytest.mark.parametrize("same_count", [True, False])
def test_their_number_stays_where_a_recorded_loop_needs_it(same_count):
    observed, wall = ObservedVoxels(), plane(1000)
    points = wall.points()
    observed.add(points[points[:, 0] < 0])
    known = observed.known(wall, np.eye(4), same_count)
    assert (len(known) == 1000) == same_count
    assert known.direction[:, 0].max() < 0.05


def test_pixels_without_depth_are_not_known():
    observed, holes = ObservedVoxels(), plane(500)
    observed.add(holes.points())
    holes.depth[::2] = 0
    assert (observed.known(holes, np.eye(4), same_count=False).depth > 0).all()
