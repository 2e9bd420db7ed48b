"""Rolling shutter: what rows measured on the way lies where it is seen from halfway."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from planes import CAMERA, corner, look, look_row_by_row, pose

from ecslam.config import Config
from ecslam.config_files import apply_settings, load_preset
from ecslam.datasets import open_sequence
from ecslam.datasets.benchmarks import KINECT_READOUT_S, benchmark
from ecslam.datasets.reading import INTRINSICS_FILE, find_intrinsics
from ecslam.datasets.registration import Registration
from ecslam.evaluation.trajectory import absolute_error
from ecslam.keyframes import make_keyframe
from ecslam.pixels import choose_pixels
from ecslam.shutter import STILL, straight, straight_pixels, sweep_between
from ecslam.slam import Slam
from ecslam.types import Intrinsics
from ecslam.volume import FusedVolume

ROLLING = replace(CAMERA, readout_s=0.03)
SWEEP = np.array([0.02, -0.01, 0.03, 0.01, -0.02, 0.005])
SEEN_FROM = pose((2, -3, 1), (0.02, 0.01, -0.02))
CONFIG = Config(border_px=4, feature_count=20)


def off_the_walls(points, c2w=SEEN_FROM):
    """Distances [N] of camera points to the nearest of the corner's walls."""
    world = points @ c2w[:3, :3].T + c2w[:3, 3]
    return np.abs([world @ n - d for n, d in corner()]).min(0)


def rolling_pixels(count=2000):
    frame = look_row_by_row(SEEN_FROM, SWEEP, corner())
    return choose_pixels(frame, CAMERA, count, CONFIG, np.random.default_rng(0))


def test_a_sweep_is_the_share_of_the_motion_that_reading_takes():
    before, after = pose((1, 2, 3), (0.3, 0, 0)), pose((3, 1, 3), (0.33, 0.02, 0))
    whole = sweep_between(before, after, 0.03, ROLLING)
    np.testing.assert_allclose(sweep_between(before, after, 0.06, ROLLING), whole / 2, rtol=1e-12)
    np.testing.assert_allclose(before @ pose(np.degrees(whole[3:]), whole[:3]), after, atol=1e-12)
    np.testing.assert_array_equal(sweep_between(before, after, 0.001, ROLLING), whole)
    for seconds, camera in ((0.03, CAMERA), (0.0, ROLLING), (-1.0, ROLLING)):
        assert sweep_between(before, after, seconds, camera) is STILL


def test_points_lie_on_what_they_were_measured_of():
    points = rolling_pixels().points()
    moved = straight(points, CAMERA, SWEEP)
    assert np.median(off_the_walls(points)) > 2e-3
    assert off_the_walls(moved).max() < 2e-4
    assert straight(points, CAMERA, STILL) is points


def test_pixels_are_straightened_with_their_rays():
    pixels = rolling_pixels()
    pixels.depth[::3] = 0
    found = straight_pixels(pixels, CAMERA, SWEEP)
    assert off_the_walls(found.points()).max() < 2e-4
    np.testing.assert_array_equal(found.depth == 0, pixels.depth == 0)
    np.testing.assert_array_equal(found.color, pixels.color)
    far = found.direction[::3] - straight_pixels(pixels, CAMERA, SWEEP * [0, 0, 0, 1, 1, 1]).direction[::3]
    assert np.abs(far).max() < 1e-4  # at a great distance turning alone counts
    assert straight_pixels(pixels, CAMERA, STILL) is pixels


def test_a_keyframe_is_straightened_with_its_landmarks():
    frame = look_row_by_row(SEEN_FROM, SWEEP, corner())
    keyframe = make_keyframe(frame, CAMERA, CONFIG)
    found = keyframe.straight(CAMERA, SWEEP)
    assert len(found) == len(keyframe)
    assert len(keyframe.landmarks) == len(found.landmarks) > 5
    assert off_the_walls(found.pixels.points()).max() < 2e-4 < off_the_walls(keyframe.pixels.points()).max()
    assert off_the_walls(found.landmarks.points).max() < 2e-3 < off_the_walls(keyframe.landmarks.points).max()
    np.testing.assert_array_equal(found.landmarks.descriptors, keyframe.landmarks.descriptors)
    np.testing.assert_array_equal(found.thumbnail, keyframe.thumbnail)
    assert keyframe.straight(CAMERA, STILL) is keyframe


def test_the_volume_holds_what_a_still_camera_would_have_seen():
    true = FusedVolume(0.02, 0.06)
    true.integrate(look(SEEN_FROM, corner()), CAMERA, SEEN_FROM, 0.1, 8.0)
    on_walls = straight(rolling_pixels(500).points(), CAMERA, SWEEP) @ SEEN_FROM[:3, :3].T + SEEN_FROM[:3, 3]
    off = {}
    for sweep in (SWEEP, STILL):
        volume = FusedVolume(0.02, 0.06)
        frame = look_row_by_row(SEEN_FROM, SWEEP, corner())
        volume.integrate(frame, CAMERA, SEEN_FROM, 0.1, 8.0, sweep)
        distance, known = volume.distances(on_walls)
        assert known.mean() > 0.9
        off[sweep is STILL] = np.abs(distance[known] - true.distances(on_walls)[0][known])
    assert np.median(off[False]) < 3e-4
    assert np.median(off[True]) > 2e-3


@pytest.mark.slow
def test_a_room_seen_row_by_row_is_tracked_better_with_it():
    room = open_sequence("synthetic/studio?frames=300&size=240x180&readout=0.03")
    frames, off = [room[i] for i in range(60)], []
    true = np.array([frame.c2w_gt for frame in frames])
    for deskew in ("true", "false"):
        config = apply_settings(load_preset("live"), [f"deskew={deskew}", "mapping.first_iterations=30"])
        slam = Slam(config, room.intrinsics, first_pose=true[0])
        for frame in frames:
            slam.step(frame)
        off.append(absolute_error(slam.trajectory.poses(), true).cm.rmse)
    assert off[0] < 0.85 * off[1]


def test_rows_of_a_room_are_seen_from_where_the_camera_is_by_then():
    still, rolling = (open_sequence(f"synthetic/studio?frames=300&size=96x72{end}") for end in ("", "&readout=0.03"))
    assert rolling.intrinsics == replace(still.intrinsics, readout_s=0.03)
    whole = rolling[100].depth
    late = np.abs(whole - still[100].depth)
    assert np.median(late[34:38]) < np.median(late[:6]) < 0.1
    motion = sweep_between(still[100].c2w_gt, still[101].c2w_gt, 1 / 30, rolling.intrinsics)
    pixels = choose_pixels(rolling[100], rolling.intrinsics, 1000, Config(), np.random.default_rng(0))
    volume = FusedVolume(0.02, 0.06)
    volume.integrate(still[100], still.intrinsics, still[100].c2w_gt, 0.1, 8.0)
    medians = []
    for sweep in (motion, STILL):
        points = straight_pixels(pixels, still.intrinsics, sweep).in_world(still[100].c2w_gt)
        distance, known = volume.distances(points)
        medians.append(np.median(np.abs(distance[known])))
    assert medians[0] < 0.6 * medians[1]


def test_cameras_keep_their_shutter():
    assert ROLLING.resized(80, 60).readout_s == 0.03
    color = Intrinsics(160.0, 160.0, 79.5, 40.0, 160, 80)
    seen = Registration(ROLLING, color, np.eye(4)).camera
    assert seen.height < 120
    assert seen.readout_s == pytest.approx(0.03 * seen.height / 120)


@pytest.mark.parametrize("name", ["rgbd_dataset_freiburg1_xyz", "fr2_desk", "fr3_office", "rgbd_bonn_static"])
def test_recordings_of_a_kinect_are_known_to_have_one(name):
    known = benchmark(Path(name), "")
    assert known.camera.readout_s == KINECT_READOUT_S


def test_a_matrix_beside_the_images_says_whether_it_is_the_same_camera(tmp_path):
    for focal, readout_s in ((160.0, 0.03), (150.0, 0.0)):
        (tmp_path / INTRINSICS_FILE).write_text(f"{focal} 0 79.5\n0 {focal} 59.5\n0 0 1\n")
        found, _ = find_intrinsics([tmp_path], ROLLING, (160, 120))
        assert (found.fx, found.readout_s) == (focal, readout_s)
