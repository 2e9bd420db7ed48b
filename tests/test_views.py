"""Pictures of the map: which rays are rendered, and what becomes of what comes back."""

from types import SimpleNamespace

import numpy as np
import torch

from ecslam.config import Config, SamplingConfig
from ecslam.types import Intrinsics
from ecslam.views import queries, render_view

CAMERA = Intrinsics(100.0, 120.0, 7.0, 3.0, 16, 8)
CONFIG = Config(sampling=SamplingConfig(uniform=10, near_depth=6, depth_range_m=0.1), depth_far_m=5.0)
FIELD = SimpleNamespace(layout=None, params=None, device=torch.device("cpu"))


class Kernels:
    """Sees red in the left half of the picture, and the last sample as the depth. rays: what was asked for."""

    def render(self, layout, params, c2w, rays):
        self.rays = rays
        left = (rays.direction[:, :1] < 0).float()
        return torch.cat([left, 0 * left, 0 * left], 1), rays.z[:, -1], rays.z

    def values(self, layout, params, points):
        return points[:, 2] - 2, points.abs()


def test_a_picture_is_of_every_pixel_and_samples_are_dense_where_a_depth_is_known():
    depth = np.full((8, 16), 2.0, np.float32)
    depth[4:] = 0
    kernels = Kernels()
    color, found = render_view(FIELD, kernels, CAMERA, np.eye(4), depth, CONFIG)
    v, u = np.mgrid[:8, :16]
    rays = kernels.rays.direction.numpy().reshape(8, 16, 3)
    assert np.allclose(rays, np.stack([(u - 7) / 100, (v - 3) / 120, np.ones((8, 16))], -1))
    assert (color[:, :7] == [255, 0, 0]).all()
    assert (color[:, 7:] == 0).all()
    z = kernels.rays.z.numpy().reshape(8, 16, -1)
    assert z.shape[-1] == 16
    assert (np.diff(z) >= 0).all()
    near = np.abs(z - 2) <= 0.1 + 1e-6
    assert (near[:4].sum(-1) >= 6).all()
    assert np.allclose(found[:4], 2.1)
    assert (z[4:].min(-1) < 0.6).all()
    assert (z[4:, :, :-6].max(-1) > 4.5).all()


def test_a_map_answers_in_numpy_with_colours_of_eight_bits():
    sdf, color = queries(FIELD, Kernels())
    points = np.array([[0, 0.5, 1], [1, 0, 0]])
    assert sdf(points).tolist() == [-1, -2]
    assert color(points).tolist() == [[0, 128, 255], [255, 0, 0]]
    assert color(points).dtype == np.uint8
