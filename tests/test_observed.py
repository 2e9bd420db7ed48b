"""Where the map has been observed."""

import cv2
import numpy as np
import pytest
import torch

from ecslam.observed import ObservedVoxels
from ecslam.observed_gpu import ObservedTable
from ecslam.pixels import Pixels


def plane(count, depth=1.0):
    """Pixels of a wall ``depth`` metres ahead; 0 for none."""
    direction = np.random.default_rng(0).uniform(-0.4, 0.4, (count, 2)).astype(np.float32)
    depths = np.full(count, depth, np.float32)
    return Pixels(direction, depths, np.zeros((count, 3), np.uint8), np.zeros(count, bool))


def test_pixels_are_known_where_the_wall_has_been_seen():
    observed, wall = ObservedVoxels(), plane(2000)
    points = wall.points()
    observed.add(points[points[:, 0] < 0], np.eye(4))
    known = observed.known(wall, np.eye(4), same_count=False)
    assert 900 < len(known) < 1200
    assert known.direction[:, 0].max() < 0.05
    moved = np.eye(4)
    moved[2, 3] = 0.5
    assert observed.known(wall, moved, same_count=False) is wall


def test_a_pixel_without_depth_is_not_known_where_the_camera_stands():
    observed, wall = ObservedVoxels(), plane(1000)
    wall.depth[:400] = 0
    observed.add(np.concatenate([wall.points(), np.full((1, 3), 0.01, np.float32)]), np.eye(4))
    assert len(observed.known(wall, np.eye(4), same_count=False)) == 600


@pytest.mark.parametrize("same_count", [True, False])
def test_their_number_stays_where_a_recorded_loop_needs_it(same_count):
    observed, wall = ObservedVoxels(), plane(1000)
    points = wall.points()
    observed.add(points[points[:, 0] < 0], np.eye(4))
    known = observed.known(wall, np.eye(4), same_count)
    assert (len(known) == 1000) == same_count
    assert known.direction[:, 0].max() < 0.05


def test_a_view_is_seen_from_its_camera():
    observed, there = ObservedVoxels(), np.eye(4)
    there[:3, 3] = (0, 0, 2)
    observed.add(np.array([[0, 0, 1.02]], np.float32), there)
    assert observed.contains(np.array([[0.01, 0.01, 3.03], [0, 0, 1.02]])).tolist() == [True, False]
    assert observed.views == 1


def test_a_table_on_a_device_knows_the_same_places():
    voxels, table = ObservedVoxels(), ObservedTable(torch.device("cpu"))
    rng, there = np.random.default_rng(0), np.eye(4)
    there[:3, :3], there[:3, 3] = cv2.Rodrigues(np.array([0.3, -0.2, 0.9]))[0], (3.0, -2.0, 0.7)
    for seen in (voxels, table):
        for _ in range(2):
            seen.add(plane(2000).points(), there)
    points = rng.uniform(-6, 6, (200_000, 3))
    points[:2000] = plane(2000).points().astype(np.float64) @ there[:3, :3].T + there[:3, 3]
    known, found = voxels.contains(points), table.marks[table._slots(torch.from_numpy(points))].numpy()
    assert known.sum() > 100
    assert found[known].all()
    assert (found & ~known).mean() < 0.002
    assert table.views == voxels.views == 2


def test_pixels_without_depth_are_not_known():
    observed, holes = ObservedVoxels(), plane(500)
    observed.add(holes.points(), np.eye(4))
    holes.depth[::2] = 0
    assert (observed.known(holes, np.eye(4), same_count=False).depth > 0).all()
