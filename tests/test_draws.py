"""The rays of mapping iterations, drawn on the CPU ahead of their turn."""

import numpy as np
import pytest
import torch

from ecslam.config import Config, MappingConfig, SamplingConfig
from ecslam.draws import AHEAD, HostDraw, shares
from ecslam.field import create_field
from ecslam.kernels import reference
from ecslam.pixels import Pixels

CONFIG = Config(
    mapping=MappingConfig(rays=90, newest_share=0.4), sampling=SamplingConfig(uniform=6, near_depth=3), depth_far_m=6.0
)
BOX = np.array([[-2.0, -2, -2], [2, 2, 2]])


def view(depth_m, rng, missing=0):
    depth = np.full(200, depth_m, np.float32)
    depth[:missing] = 0
    color = rng.integers(0, 256, (200, 3)).astype(np.uint8)
    return Pixels(rng.uniform(-0.4, 0.4, (200, 2)).astype(np.float32), depth, color, np.zeros(200, bool))


def drawn(iterations, missing=0, seed=0):
    rng = np.random.default_rng(0)
    views = [view(depth_m, rng, missing) for depth_m in (1.0, 1.5, 0.5)]
    field, poses = create_field(CONFIG.field, BOX, 0, torch.device("cpu")), torch.eye(4).repeat(3, 1, 1)
    generator = torch.Generator().manual_seed(seed)
    draw = HostDraw(views, CONFIG, field, reference, np.random.default_rng(seed), generator)
    return views, [draw(i, poses) for i in range(iterations)]


def test_each_view_gets_its_share_of_its_own_pixels():
    views, batches = drawn(AHEAD + 2)
    for rays in batches:
        assert torch.bincount(rays.pose).tolist() == shares(3, 90, 0.4)
        assert (rays.direction[:, 1].diff() >= 0).all()
        for i, one in enumerate(views):
            assert (rays.depth[rays.pose == i] == one.depth[0]).all()
            known = {tuple(d) for d in one.direction}
            assert all(tuple(d) in known for d in rays.direction[rays.pose == i, :2].numpy())


def test_iterations_differ_and_repeat_from_the_same_seed():
    _, first = drawn(2 * AHEAD)
    _, again = drawn(2 * AHEAD)
    _, other = drawn(2 * AHEAD, seed=1)
    for a, b in zip(first, again, strict=True):
        assert all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("direction", "z", "color", "pose"))
    assert not torch.equal(first[0].z, other[0].z)
    assert len({tuple(rays.direction[:, 0].tolist()) for rays in first}) == 2 * AHEAD


@pytest.mark.parametrize("missing", [0, 60, 200])
def test_depths_rise_and_end_behind_what_was_measured_or_inside_the_box(missing):
    _, batches = drawn(3, missing)
    for rays in batches:
        has = rays.depth > 0
        assert rays.z.shape == (len(has), 9)
        assert (rays.z.diff(dim=1) >= 0).all()
        reach = CONFIG.sampling.depth_range_m
        assert (rays.z[has] <= rays.depth[has, None] + reach + 1e-6).all()
        assert ((rays.z[has] - rays.depth[has, None]).abs() <= reach).sum(1).ge(3).all()
        assert (rays.z[~has] <= 2.0 + 1e-6).all()
        assert missing == 200 or has.any()
        assert missing == 0 or (~has).any()
