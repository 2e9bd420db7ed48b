"""The six pictures: what their colours mean is written into them."""

import numpy as np
import pytest

from ecslam.runtime.pictures import SCALE_BOTTOM, SCALE_LEFT, SCALE_RIGHT, SCALE_TOP, shrink, shrink_depth, six_pictures


def test_the_difference_of_depth_says_which_colour_stands_for_how_much():
    depth, color = np.full((120, 160), 2, np.float32), np.zeros((120, 160, 3), np.uint8)
    rendered = depth + np.linspace(0, 0.1, 160, dtype=np.float32)
    shown = six_pictures(0, color, depth, color, rendered).depth_difference.astype(int)
    assert shown.shape == (120, 160, 3)
    bar = shown[SCALE_TOP : SCALE_BOTTOM - 1, SCALE_LEFT:-SCALE_RIGHT]
    assert (bar == bar[:1]).all()
    share = np.linspace(0, 159, bar.shape[1]).round().astype(int)
    assert np.abs(bar[0] - shown[60, share]).max() < 12, "0 is at its left end and 10 cm at its right one"
    assert (shown[: SCALE_BOTTOM + 1, -SCALE_RIGHT:] > 200).any(), "the label"


@pytest.mark.parametrize(
    ("size", "expected"), [((680, 1200), (85, 150)), ((480, 640), (120, 160)), ((3, 900), (1, 112))]
)
def test_a_small_picture_shows_all_of_it(size, expected):
    rows, columns = np.indices(size)
    image = np.stack([255 * rows / size[0], 255 * columns / size[1], np.full(size, 7)], -1).astype(np.uint8)
    small = shrink(image, 160)
    assert small.shape == (*expected, 3)
    edge = -(-size[1] // 160)
    assert abs(float(small[..., 1].mean()) - image[..., 1].mean()) < 3
    assert small[0, -1, 1] > 250 - 255 * edge / size[1] > small[0, 0, 1]
    assert (small[..., 2] == 7).all()


@pytest.mark.parametrize("size", [(480, 640), (480, 631), (680, 1200), (3, 321), (48, 64)])
def test_depth_gets_the_size_of_colour_whatever_that_is(size):
    depth = np.arange(size[0] * size[1], dtype=np.float32).reshape(size)
    color = shrink(np.zeros((*size, 3), np.uint8), 320)
    small = shrink_depth(depth, color)
    assert small.shape == color.shape[:2]
    assert np.isin(small, depth).all(), "none is made up"
    assert six_pictures(0, color, small, color, small).depth_difference.shape == color.shape


def test_a_picture_that_is_small_enough_stays():
    image = np.zeros((10, 160, 3), np.uint8)
    assert shrink(image, 160) is image
