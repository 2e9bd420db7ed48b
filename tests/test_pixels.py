"""FUS: features and a jittered uniform grid."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ecslam.config import Config
from ecslam.pixels import choose_pixels, feature_points, grid_points, spread_pixels
from ecslam.types import Frame, Intrinsics

CAMERA = Intrinsics(500, 510, 319.5, 239.5, 640, 480)


@pytest.fixture
def frame():
    rng = np.random.default_rng(0)
    color = cv2.resize(rng.integers(0, 255, (24, 32, 3), np.uint8), (640, 480), interpolation=cv2.INTER_NEAREST)
    depth = np.full((480, 640), 2.0, np.float32)
    depth[:, :100] = 0
    return Frame(0, 0.0, color, depth)


@given(st.integers(1, 5000), st.integers(0, 30), st.integers(0, 10))
@settings(max_examples=40)
def test_grid_gives_exactly_the_count_spread_evenly(count, border, seed):
    height, width = 120, 160
    index = grid_points(height, width, border, count, np.random.default_rng(seed))
    v, u = np.divmod(index, width)
    assert len(index) == count
    assert v.min() >= border
    assert v.max() < height - border
    assert u.min() >= border
    assert u.max() < width - border
    if count >= 400:
        quadrants = np.histogram2d(v, u, bins=2, range=[[border, height - border], [border, width - border]])[0]
        assert quadrants.min() > 0.8 * count / 4


def test_features_are_corners_and_come_first(frame):
    config = Config()
    pixels = choose_pixels(frame, CAMERA, 1000, config, np.random.default_rng(0))
    corners = feature_points(frame, config, 500)
    assert len(pixels) == 1000
    assert pixels.feature.sum() == len(corners) > 100
    assert pixels.feature[: len(corners)].all()
    _v, u = np.divmod(corners, 640)
    assert (
        np.abs((u + 0.5) / 20 - np.rint((u + 0.5) / 20)).max() < 0.2
    )  # the picture's corners lie on a 20-pixel lattice


def test_features_are_half_of_the_pixels_at_most(frame):
    pixels = choose_pixels(frame, CAMERA, 100, Config(), np.random.default_rng(0))
    assert len(pixels) == 100
    assert pixels.feature.sum() == 50


def test_ablation_takes_no_features(frame):
    pixels = choose_pixels(frame, CAMERA, 1000, Config(fus=False), np.random.default_rng(0))
    assert len(pixels) == 1000
    assert not pixels.feature.any()


def test_directions_and_points_project_back(frame):
    pixels = choose_pixels(frame, CAMERA, 500, Config(), np.random.default_rng(1))
    u = pixels.direction[:, 0] * CAMERA.fx + CAMERA.cx
    v = pixels.direction[:, 1] * CAMERA.fy + CAMERA.cy
    assert np.allclose(u, np.rint(u), atol=1e-3)
    assert np.allclose(v, np.rint(v), atol=1e-3)
    index = np.rint(v).astype(int), np.rint(u).astype(int)
    assert (pixels.color == frame.color[index]).all()
    assert (pixels.depth == frame.depth[index]).all()
    assert (pixels.depth[np.rint(u) < 100] == 0).all()
    assert np.allclose(pixels.points()[:, 2], 2.0)
    assert len(pixels.points()) == (pixels.depth > 0).sum()


def test_depth_out_of_range_counts_as_none(frame):
    near = Config(depth_far_m=1.5)
    assert (choose_pixels(frame, CAMERA, 200, near, np.random.default_rng(0)).depth == 0).all()


def test_flat_image_has_no_features_and_still_gives_the_count(frame):
    flat = Frame(0, 0.0, np.zeros_like(frame.color), frame.depth)
    pixels = choose_pixels(flat, CAMERA, 300, Config(), np.random.default_rng(0))
    assert len(pixels) == 300
    assert not pixels.feature.any()


def test_the_rim_is_for_the_map_alone(frame):
    def reach(pixels):
        u = pixels.direction[:, 0] * CAMERA.fx + CAMERA.cx
        return u.min(), 639 - u.max()

    config, rng = Config(border_px=20), np.random.default_rng(0)
    assert min(reach(choose_pixels(frame, CAMERA, 4000, config, rng))) >= 19.9
    assert min(reach(spread_pixels(frame, CAMERA, 4000, config, rng))) >= 19.9
    assert max(reach(choose_pixels(frame, CAMERA, 4000, config, rng, rim=True))) < 10


def test_spread_pixels_are_a_grid_without_features(frame):
    pixels = spread_pixels(frame, CAMERA, 777, Config(), np.random.default_rng(0))
    assert len(pixels) == 777
    assert not pixels.feature.any()
    assert 0 < (pixels.depth == 0).mean() < 0.3
