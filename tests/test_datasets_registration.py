"""Colour moved to where depth sees it: against scenes whose colour is known at every point in space."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from coloured_wall import DEPTH, WIDE, images, motion, paint, seen

from ecslam.datasets import open_sequence
from ecslam.datasets.registration import Registration
from ecslam.types import InputError, Intrinsics


@pytest.mark.parametrize(
    ("color", "depth_to_color"),
    [
        (WIDE, motion(move=(-0.025, 0, 0))),
        (WIDE, motion((1.0, -2.0, 3.0), (0.05, -0.02, 0.01))),
        (WIDE.resized(192, 144), motion((0, 1.0, 0), (-0.04, 0, 0))),
    ],
    ids=["Kinect", "turned", "finer"],
)
@pytest.mark.parametrize("wall_m", [1.0, 2.5])
def test_each_pixel_has_the_colour_of_the_point_that_it_measured(
    color: Intrinsics, depth_to_color: np.ndarray, wall_m: float
) -> None:
    pair = Registration(DEPTH, color, depth_to_color)
    moved, depth = pair.registered(*images(color, depth_to_color, wall_m))
    points, true_depth = seen(pair.camera, np.eye(4), wall_m)
    assert moved.shape == (*depth.shape, 3) == (pair.camera.height, pair.camera.width, 3)
    np.testing.assert_allclose(depth, true_depth, rtol=1e-5)
    assert np.abs(moved.astype(int) - paint(points)).max() <= 2
    stored, _ = images(color, depth_to_color, wall_m)
    assert np.abs(cv2.resize(stored, (64, 48)).astype(int) - paint(seen(DEPTH, np.eye(4), wall_m)[0])).max() > 10


def test_a_part_that_is_deeper_for_colour_everywhere_is_projected_too() -> None:
    """The optical axis, where it would not be, is cut off, for colour does not see it."""
    move, color_camera = motion((0, -6.0, 0)), Intrinsics(60.0, 60.0, -12.0, 23.5, 64, 48)
    pair = Registration(replace(DEPTH, cx=0.0), color_camera, move)
    assert pair.camera.cx < -2
    points, _ = seen(color_camera, np.linalg.inv(move), 2.0)
    moved, _ = pair.registered(paint(points), np.full((48, 64), 2.0, np.float32))
    assert np.abs(moved.astype(int) - paint(seen(pair.camera, np.eye(4), 2.0)[0])).max() <= 2


def test_what_is_near_moves_farther_than_what_is_behind_it() -> None:
    move = motion(move=(-0.1, 0, 0))
    color, far = images(WIDE, move, 2.0)
    pair = Registration(DEPTH, WIDE, move)
    at = np.mgrid[10:40, 24:40]
    near = far.copy()
    near[10:40, 24:40] = 1.0
    moved, _ = pair.registered(color, near)
    points, _ = seen(DEPTH, np.eye(4), 1.0)
    v, u = at
    x = (points[v, u, 0] - 0.1) * WIDE.fx + WIDE.cx
    y = points[v, u, 1] * WIDE.fy + WIDE.cy
    expected = cv2.remap(color, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    np.testing.assert_allclose(moved[v, u].astype(int), expected, atol=2)
    assert np.abs(moved[v, u].astype(int) - pair.registered(color, far)[0][v, u]).max() > 2


def test_pixels_without_depth_get_a_colour_and_no_depth() -> None:
    color, depth = images(WIDE, motion(), 2.0)
    hole = depth.copy()
    hole[5:9, 5:9] = 0
    moved, left = Registration(DEPTH, WIDE, motion()).registered(color, hole)
    assert (left[5:9, 5:9] == 0).all()
    assert (left[20:] > 0).all()
    np.testing.assert_array_equal(moved, Registration(DEPTH, WIDE, motion()).registered(color, depth)[0])


def test_frames_are_cut_to_what_both_cameras_see() -> None:
    narrow = Intrinsics(90.0, 90.0, 31.5, 23.5, 64, 48)
    pair = Registration(DEPTH, narrow, motion())
    k = pair.camera
    assert (k.width, k.height) < (DEPTH.width, DEPTH.height)
    corners = np.array([[0, 0, 1], [k.width - 1, k.height - 1, 1]]) @ np.linalg.inv(k.matrix()).T @ narrow.matrix().T
    assert (corners[:, :2] > -0.5).all()
    assert (corners[:, :2] < np.array([63.5, 47.5])).all()
    assert corners[1, 0] - corners[0, 0] > 64 - 2.5 * 90 / 60
    _, depth = pair.registered(*images(narrow, motion(), 1.5))
    np.testing.assert_allclose(depth, 1.5, rtol=1e-5)


def test_depth_too_near_for_colour_to_see_it_is_left_out() -> None:
    move = motion(move=(-0.1, 0, 0))
    pair = Registration(DEPTH, WIDE, move)
    color, depth = images(WIDE, move, 0.15)
    _, left = pair.registered(color, depth)
    assert 0.2 < (left == 0).mean() < 0.9


def test_both_lenses_are_straightened() -> None:
    bent = replace(WIDE, distortion=(0.15, -0.05, 0.001, 0.0))
    ideal, depth = images(WIDE, motion(), 2.0)
    v, u = np.mgrid[:48, :64].astype(np.float32)
    at = cv2.undistortPoints(
        np.stack([u, v], -1).reshape(-1, 1, 2), bent.matrix(), np.array(bent.distortion), P=bent.matrix()
    ).reshape(48, 64, 2)
    as_drawn = cv2.remap(ideal, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    straight, _ = Registration(DEPTH, bent, motion()).registered(as_drawn, depth)
    expected, _ = Registration(DEPTH, WIDE, motion()).registered(ideal, depth)
    inner = np.s_[8:-8, 8:-8]
    np.testing.assert_allclose(straight[inner].astype(int), expected[inner], atol=3)


@pytest.mark.parametrize("move", [motion((0, 180, 0)), motion((0, 80, 0)), motion(move=(25.0, 0, 0))])
def test_cameras_that_see_different_things_are_refused(move: np.ndarray) -> None:
    with pytest.raises(InputError, match="hardly see the same"):
        Registration(DEPTH, WIDE, move)


# ---- in 7-Scenes' layout ----


def write(folder: Path, color: np.ndarray, depth_m: np.ndarray) -> Path:
    folder.mkdir(exist_ok=True)
    assert cv2.imwrite(str(folder / "frame-000000.color.png"), color[..., ::-1])
    assert cv2.imwrite(str(folder / "frame-000000.depth.png"), np.rint(1000 * depth_m).astype(np.uint16))
    return folder


def kinect_pair() -> tuple[np.ndarray, np.ndarray]:
    """Colour as stored, and a wall at 2 m."""
    points, _ = seen(Intrinsics(525.0, 525.0, 320.0, 240.0, 640, 480), motion(move=(0.025, 0, 0)), 2.0)
    return paint(points), np.full((480, 640), 2.0, np.float32)


@pytest.mark.parametrize("named", [False, True])
def test_a_kinects_own_pixels_are_registered(tmp_path: Path, named: bool) -> None:
    folder = write(tmp_path / "a", *kinect_pair())
    if named:
        np.savetxt(folder / "camera-intrinsics.txt", [[585, 0, 320], [0, 585, 240], [0, 0, 1]])
    sequence = open_sequence(folder)
    k = sequence.intrinsics
    assert (k.fx, k.cx, k.width, k.height) == (585, 320, 640, 480)
    points, _ = seen(k, np.eye(4), 2.0)
    assert np.abs(sequence[0].color.astype(int) - paint(points)).max() <= 2


def test_images_of_another_camera_are_taken_as_they_are(tmp_path: Path) -> None:
    color, depth = kinect_pair()
    folder = write(tmp_path / "a", color, depth)
    np.savetxt(folder / "camera-intrinsics.txt", [[525, 0, 320], [0, 525, 240], [0, 0, 1]])
    np.testing.assert_array_equal(open_sequence(folder)[0].color, color)


def write_own(folder: Path, color: Intrinsics, move: np.ndarray) -> Path:
    write(folder, *images(color, move, 2.0))
    np.savetxt(folder / "camera-intrinsics.txt", DEPTH.matrix())
    np.savetxt(folder / "color-intrinsics.txt", color.matrix())
    np.savetxt(folder / "depth-to-color.txt", move)
    return folder


def test_two_files_tell_of_a_camera_of_ones_own(tmp_path: Path) -> None:
    sequence = open_sequence(write_own(tmp_path / "a", WIDE.resized(128, 96), motion((0, 3.0, 0), (-0.05, 0, 0))))
    points, _ = seen(sequence.intrinsics, np.eye(4), 2.0)
    assert np.abs(sequence[0].color.astype(int) - paint(points)).max() <= 2


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda f: (f / "depth-to-color.txt").unlink(), "depth-to-color.txt: is missing, but color-intrinsics.txt"),
        (lambda f: (f / "color-intrinsics.txt").unlink(), "color-intrinsics.txt: is missing, but depth-to-color.txt"),
        (lambda f: np.savetxt(f / "depth-to-color.txt", 2 * np.eye(4)), "not a rigid motion"),
        (lambda f: np.savetxt(f / "depth-to-color.txt", np.eye(3)), "not a rigid motion"),
        (lambda f: np.savetxt(f / "depth-to-color.txt", motion(move=(25.0, 0, 0))), "in metres"),
        (lambda f: np.savetxt(f / "color-intrinsics.txt", np.eye(2)), "calibration matrix"),
        (lambda f: np.savetxt(f / "color-intrinsics.txt", np.diag([0, 0, 1])), "color-intrinsics.txt: focal lengths 0"),
        (lambda f: np.savetxt(f / "camera-intrinsics.txt", np.diag([0, 0, 1])), ": depth: focal lengths 0 and 0"),
    ],
)
def test_what_cannot_be_used_is_said(tmp_path: Path, spoil: object, words: str) -> None:
    folder = write_own(tmp_path / "a", WIDE, motion(move=(-0.05, 0, 0)))
    assert callable(spoil)
    spoil(folder)
    with pytest.raises(InputError, match=words):
        open_sequence(folder)
