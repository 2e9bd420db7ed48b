"""Landmarks: where they lie, how they are spread, and the poses that come of matching them."""

from dataclasses import replace

import numpy as np
import pytest
from planes import pose

from ecslam.config import Config
from ecslam.datasets import open_sequence
from ecslam.landmarks import CELLS, KEPT, SOUGHT, Recognition, agreed_motion, find_landmarks
from ecslam.rigid import inverse, rotation_angle_deg

ROOM = open_sequence("synthetic/studio?size=320x240")
CAMERA, CONFIG = ROOM.intrinsics, Config()


def rng():
    return np.random.default_rng(0)


def landmarks(place, count):
    return find_landmarks(ROOM[place], CAMERA, CONFIG, count)


def recognition(place, views):
    return Recognition(landmarks(place, SOUGHT), [landmarks(v, KEPT) for v in views], ROOM.poses_gt()[views], rng())


def test_landmarks_are_measured_points_spread_over_the_image():
    frame = ROOM[0]
    found = landmarks(0, KEPT)
    assert found.points.shape == (KEPT, 3)
    assert found.descriptors.shape == (KEPT, 32)
    u, v = (found.points[:, :2] / found.points[:, 2:] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)).T
    np.testing.assert_array_equal(found.points[:, 2], frame.depth[np.rint(v).astype(int), np.rint(u).astype(int)])
    cells = np.unique((v * CELLS // CAMERA.height) * CELLS + u * CELLS // CAMERA.width)
    assert len(cells) > 0.5 * CELLS**2
    again = landmarks(0, KEPT)
    np.testing.assert_array_equal(again.points, found.points)
    np.testing.assert_array_equal(again.descriptors, found.descriptors)


@pytest.mark.parametrize(
    "bare", [{"color": np.zeros((240, 320, 3), np.uint8)}, {"depth": np.zeros((240, 320), np.float32)}]
)
def test_a_picture_without_corners_or_depth_has_no_landmarks_and_tells_nothing(bare):
    none = find_landmarks(replace(ROOM[0], **bare), CAMERA, CONFIG, KEPT)
    assert len(none) == 0
    poses = ROOM.poses_gt()[:1]
    for seen, view in ((none, none), (none, landmarks(0, KEPT)), (landmarks(0, KEPT), none)):
        found = Recognition(seen, [view], poses, rng())
        assert found.poses.shape == (0, 4, 4)
        assert found.allows(np.eye(4)) == (len(seen) == 0)
        assert found.strange == (len(seen) > 0)


def test_the_motion_that_most_points_agree_on():
    true = pose((20, -30, 10), (0.5, -0.2, 1.0))
    source = rng().uniform((-1, -1, 1), (1, 1, 3), (60, 3))
    target = source @ true[:3, :3].T + true[:3, 3]
    target[20:] = rng().uniform(-2, 2, (40, 3))
    motion, agreed = agreed_motion(source.astype(np.float32), target.astype(np.float32), rng())
    assert 20 <= agreed < 25
    assert np.linalg.norm(motion[:3, 3] - true[:3, 3]) < 0.01
    assert rotation_angle_deg(motion, true) < 0.5
    assert agreed_motion(source[:9].astype(np.float32), target[:9].astype(np.float32), rng())[1] == 0
    assert agreed_motion(source[20:].astype(np.float32), target[20:].astype(np.float32), rng())[1] == 0


@pytest.mark.parametrize("place", [30, 45])
def test_a_view_is_recognised_from_half_a_metre_and_more_away(place):
    found, true = recognition(place, [0, 5, 10]), ROOM.poses_gt()[place]
    assert np.linalg.norm(ROOM.poses_gt()[10, :3, 3] - true[:3, 3]) > 0.35
    assert np.linalg.norm(found.poses[0, :3, 3] - true[:3, 3]) < 0.05
    assert rotation_angle_deg(found.poses[0], true) < 2
    assert found.allows(true)
    assert not found.allows(true @ pose((0, 20, 0)))
    assert not found.strange


def test_another_part_of_the_room_is_strange():
    found = recognition(150, [0, 5, 10])
    assert found.strange
    assert not found.allows(ROOM.poses_gt()[10])


def test_recognition_moves_with_the_world():
    motion = pose((10, 20, 30), (1, 2, 3))
    views = [landmarks(v, KEPT) for v in (0, 5)]
    seen, poses = landmarks(10, SOUGHT), ROOM.poses_gt()[[0, 5]]
    here, moved = (Recognition(seen, views, p, rng()).poses for p in (poses, motion @ poses))
    np.testing.assert_allclose(inverse(motion) @ moved, here, atol=1e-9)
