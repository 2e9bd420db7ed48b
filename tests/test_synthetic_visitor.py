"""Somebody who walks through a built-in room."""

import numpy as np

from ecslam.datasets import open_sequence
from ecslam.datasets.synthetic.visitor import (
    AHEAD_M,
    BODY_RADIUS_M,
    EVERY,
    HALF,
    HEAD_M,
    STEP_M,
    standing,
    with_visitor,
)
from ecslam.types import Intrinsics

ALONE, VISITED = (open_sequence(f"synthetic/studio?size=64x48&visitor={there}") for there in (0, 1))
PATH = ALONE.poses_gt()


def test_between_visits_nobody_is_there():
    for index in (0, EVERY // 2 - HALF - 1, EVERY // 2 + HALF + 1, EVERY):
        assert standing(index, PATH, 0.0) is None
        one, other = ALONE[index], VISITED[index]
        assert np.array_equal(one.depth, other.depth)
        assert np.array_equal(one.color, other.color)


def test_a_visitor_walks_across_in_front_of_the_camera():
    middle = EVERY // 2
    feet = [standing(middle + since, PATH, 0.0) for since in (-HALF, 0, HALF)]
    assert np.allclose(np.linalg.norm(feet[1][:2] - PATH[middle, :2, 3]), AHEAD_M)
    assert np.allclose(feet[2] - feet[1], feet[1] - feet[0])
    assert np.isclose(np.linalg.norm(feet[2] - feet[0]), 2 * HALF * STEP_M)
    across = (feet[2] - feet[0])[:2]
    assert abs(across @ PATH[middle, :2, 2]) < 1e-9
    assert across @ PATH[middle, :2, 0] > 0


def test_a_visitor_hides_what_is_behind_and_nothing_else():
    one, other = ALONE[EVERY // 2], VISITED[EVERY // 2]
    changed = one.depth != other.depth
    assert 0.1 < changed.mean() < 0.6
    assert (other.depth[changed] < one.depth[changed]).all()
    assert np.array_equal(one.color[~changed], other.color[~changed])


def test_depth_is_that_of_a_round_body_seen_from_the_front():
    camera = Intrinsics(400.0, 400.0, 31.5, 23.5, 64, 48)
    level = np.eye(4)
    level[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    level[:3, 3] = (0, -2, 1)
    wall = np.full((48, 64), 5, np.float32)
    color, depth = with_visitor(np.zeros((48, 64, 3), np.uint8), wall, camera, level, np.zeros(3))
    assert np.isclose(depth[24, 31], 2 - BODY_RADIUS_M, atol=1e-3)
    assert (color[24, 31] > 0).any()
    level[2, 3] = HEAD_M
    _, depth = with_visitor(color, wall, camera, level, np.zeros(3))
    assert np.isclose(depth[24, 31], 2 - 0.12, atol=1e-3)
    assert depth[24, 63] == 5
