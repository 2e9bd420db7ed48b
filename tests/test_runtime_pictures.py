"""The six pictures: what their colours mean is written into them."""

import numpy as np

from ecslam.runtime.pictures import SCALE_BOTTOM, SCALE_LEFT, SCALE_RIGHT, SCALE_TOP, six_pictures


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
