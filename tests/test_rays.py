"""From stored pixels and poses to rays: units, places, and what a weight is called."""

from dataclasses import fields

import numpy as np
import pytest
import torch

from ecslam.config import Config, LossWeights, SamplingConfig
from ecslam.kernels import reference
from ecslam.pixels import Pixels
from ecslam.rays import gather, kernel_weights, make_rays, upload, view_centre
from ecslam.types import Intrinsics

CONFIG = Config(sampling=SamplingConfig(uniform=8, near_depth=4), depth_far_m=6.0)
BOX = torch.tensor([[-2.0, -2, -2], [2, 2, 2]])


def pixels(depth_m, color=255):
    """Pixels to the right of the middle, one for each depth."""
    count = len(depth_m)
    direction = np.tile(np.array([[0.5, 0.0]], np.float32), (count, 1))
    return Pixels(direction, np.array(depth_m, np.float32), np.full((count, 3), color, np.uint8), np.zeros(count, bool))


def rays_of(view, c2w, row=None):
    on_device = upload(view, torch.device("cpu"))
    row = torch.zeros(len(view), dtype=torch.int64) if row is None else row
    jitter = torch.full((len(view), 12), 0.5)
    return make_rays(on_device, row, c2w, BOX, reference, CONFIG, jitter, missing=True)


def test_white_is_one_and_a_direction_lies_at_unit_depth():
    white, black = (rays_of(pixels([1.0], value), torch.eye(4)[None]) for value in (255, 0))
    assert white.color.tolist() == [[1, 1, 1]]
    assert black.color.tolist() == [[0, 0, 0]]
    assert white.direction.tolist() == [[0.5, 0, 1]]


def test_a_ray_without_depth_ends_where_that_of_its_own_pose_leaves_the_box():
    turned = torch.tensor([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 1], [0, 0, 0, 1]])  # looks along x from z = 1
    c2w = torch.stack([torch.eye(4), turned])
    rays = rays_of(pixels([0.0, 0.0]), c2w, torch.tensor([0, 1]))
    near_m = CONFIG.sampling.near_m
    assert rays.z[:, -1].tolist() == pytest.approx([near_m + (2 - near_m) * 7.5 / 8] * 2)  # in the last eighth
    c2w[1, 0, 3] = 1.5
    moved = rays_of(pixels([0.0, 0.0]), c2w, torch.tensor([0, 1]))
    assert moved.z[1, -1] < 0.6
    assert moved.z[0].tolist() == rays.z[0].tolist()


def test_the_middle_of_a_view_is_that_of_its_measured_points():
    rays = rays_of(pixels([1.0, 0.0, 3.0, 0.0]), torch.eye(4)[None])
    assert view_centre(rays).tolist() == [1, 0, 2]
    assert view_centre(rays_of(pixels([0.0]), torch.eye(4)[None])).tolist() == [0, 0, 0]


def test_gathered_pixels_come_iteration_by_iteration():
    near, far = pixels([1.0, 2.0]), pixels([5.0, 6.0])
    found = gather([near, far], [np.array([[0, 1], [1, 1]]), np.array([[1], [0]])])
    assert found.depth.tolist() == [1, 2, 6, 2, 2, 5]


@pytest.mark.parametrize("size", [(320, 240), (64, 48), (1280, 720)])
def test_a_camera_of_another_size_sees_to_the_same_edges(size):
    """Pixel centres lie at whole numbers, so an image reaches from -0.5 to its width - 0.5."""
    camera = Intrinsics(517.3, 516.5, 318.6, 255.3, 640, 480)
    other = camera.resized(*size)
    for a, b in ((camera, other), (other, other.resized(640, 480))):
        for share in (0, 0.3, 1):
            assert (share * a.width - 0.5 - a.cx) / a.fx == pytest.approx((share * b.width - 0.5 - b.cx) / b.fx)
            assert (share * a.height - 0.5 - a.cy) / a.fy == pytest.approx((share * b.height - 0.5 - b.cy) / b.fy)


def test_a_weight_keeps_its_name():
    loss = LossWeights(*range(1, 8))
    weights = kernel_weights(loss, Config(truncation_m=0.05, centre_share=0.3))
    assert {f.name: getattr(weights, f.name) for f in fields(weights)} == {
        **{f.name: getattr(loss, f.name) for f in fields(loss)},
        "truncation_m": 0.05,
        "centre_share": 0.3,
    }
