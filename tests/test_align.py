"""What an alignment is given: its stages, its points and their brightness."""

import cv2
import numpy as np
import pytest

from ecslam.align import LEAST_KNOWN, WIDE_GRADIENT, known_points, stages
from ecslam.config import AlignConfig, Config
from ecslam.kernels.reference import LUMINANCE
from ecslam.pixels import Pixels


def test_stages_go_from_coarse_to_fine_and_the_last_one_trusts_fewer_gradients():
    config = Config(
        truncation_m=0.05,
        align=AlignConfig(
            kernels_m=(0.2, 0.06, 0.02), gradient_range=(0.8, 1.2), tsdf_limit=1.1, colour_weight_m=0.04,
            colour_kernel=0.3,
        ),
    )  # fmt: skip
    found = stages(config)
    assert [s.kernel_m for s in found] == [0.2, 0.06, 0.02]
    assert [(s.gradient_low, s.gradient_high) for s in found] == [WIDE_GRADIENT, WIDE_GRADIENT, (0.8, 1.2)]
    assert {(s.truncation_m, s.tsdf_limit, s.colour_weight, s.colour_kernel) for s in found} == {(0.05, 1.1, 0.04, 0.3)}


class Known:
    """A surface that is known to the right of ``edge`` metres."""

    def __init__(self, edge):
        self.edge = edge

    def distances(self, points):
        return np.zeros(len(points), np.float32), points[:, 0] > self.edge


def coloured(count=300):
    """Pixels from left to right, 2 m away but for every third, which has no depth, in all colours."""
    rng = np.random.default_rng(0)
    direction = np.stack([np.linspace(-0.5, 0.5, count), np.zeros(count)], 1).astype(np.float32)
    depth = np.where(np.arange(count) % 3 == 0, 0, 2).astype(np.float32)
    return Pixels(direction, depth, rng.integers(0, 256, (count, 3), np.uint8), np.zeros(count, bool))


def test_points_have_the_brightness_of_their_own_pixels_as_volume_and_map_see_it():
    pixels = coloured()
    found = known_points(Known(-9), pixels, np.eye(4))
    colors = pixels.color[pixels.depth > 0]
    gray = cv2.cvtColor(colors[None], cv2.COLOR_RGB2GRAY)[0] / 255
    assert np.allclose(found.light.numpy(), gray, atol=0.6 / 255)
    assert np.allclose(found.light.numpy(), colors / 255 @ np.array(LUMINANCE), atol=1e-6)
    assert np.allclose(found.local.numpy(), pixels.points())


@pytest.mark.parametrize(("edge", "fewer"), [(0.0, True), (0.3, False)])
def test_points_are_taken_where_the_surface_is_known_unless_that_leaves_too_few(edge, fewer):
    pixels, c2w = coloured(), np.eye(4)
    c2w[0, 3] = 0.4
    found = known_points(Known(edge + 0.4), pixels, c2w)
    count = int((pixels.points()[:, 0] > edge).sum())
    assert (count >= LEAST_KNOWN) == fewer
    assert len(found.local) == len(found.light) == (count if fewer else len(pixels.points()))
    assert found.every(3).light.tolist() == found.light.tolist()[::3]
