"""Depths along rays."""

from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ecslam.config import SamplingConfig
from ecslam.kernels import RayBatch, cpu, reference
from ecslam.kernels.reference_depths import drawn, importance_depths, stratified
from ecslam.samples import ray_exit, rendered_depths, thinned


def jitter(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def sample_depths(depth, far, config, numbers, kernels=reference):
    return kernels.sample_depths(depth, far, numbers, config.uniform, config.near_m, config.depth_range_m)


@given(st.lists(st.floats(0.2, 6), min_size=1, max_size=20), st.integers(0, 100))
@settings(max_examples=40)
def test_samples_are_sorted_and_where_they_belong(depths, seed):
    depth = torch.tensor(depths)
    config = SamplingConfig()
    z = sample_depths(depth, torch.full_like(depth, 8.0), config, jitter(len(depths), 43, seed=seed))
    assert z.shape == (len(depths), 43)
    assert (z.diff(dim=1) >= 0).all()
    assert (z >= config.near_m - 1e-6).all()
    assert (z <= depth[:, None] + config.depth_range_m + 1e-5).all()
    near = ((z - depth[:, None]).abs() <= config.depth_range_m + 1e-5).sum(1)
    assert (near >= config.near_depth).all()


def test_samples_near_the_depth_fill_the_whole_range_around_it():
    z = sample_depths(torch.full((50,), 2.0), torch.full((50,), 8.0), SamplingConfig(uniform=0), jitter(50, 11))
    assert (((z - 1.9) / 0.2 * 11).floor() == torch.arange(11)).all()


def test_rays_without_depth_reach_the_end_of_the_box():
    z = sample_depths(torch.zeros(50), torch.full((50,), 3.0), SamplingConfig(), jitter(50, 43))
    assert z.max() <= 3
    assert (z[:, -1] > 2.7).all()


def test_stratified_puts_one_sample_in_every_interval():
    z = stratified(torch.zeros(10), torch.ones(10), 16, jitter(10, 16))
    assert (torch.floor(z * 16) == torch.arange(16)).all()


def test_importance_samples_gather_at_the_weights():
    z = torch.linspace(0, 4, 41).expand(100, 41).contiguous()
    weights = torch.exp(-(((z - 2.5) / 0.1) ** 2))
    found = drawn(z, weights, jitter(100, 11))
    assert found.shape == (100, 11)
    assert ((found - 2.5).abs() < 0.4).float().mean() > 0.95
    assert abs(float(found.mean()) - 2.5) < 0.02


class Wall:
    """A back end whose map is a wall at 2.5 m. looked: the depths it was asked to render."""

    importance_depths = staticmethod(importance_depths)

    def render(self, layout, params, c2w, rays):
        self.looked = rays.z
        return rays.color, rays.depth, torch.exp(-(((rays.z - 2.5) / 0.2) ** 2))


def test_rendered_depths_look_for_the_surface_along_the_whole_ray():
    zero, config, wall = torch.zeros(5), SamplingConfig(uniform=16, near_depth=5), Wall()
    z = sample_depths(zero, torch.full((5,), 4.0), config, torch.full((5, 21), 0.5))
    rays = RayBatch(torch.ones(5, 3), thinned(z, config), zero, torch.zeros(5, 3), zero > 0, zero.long())
    field = SimpleNamespace(layout=None, params=None)
    found = rendered_depths(rays, torch.eye(4)[None], field, wall, jitter(5, 5))
    assert wall.looked.shape == (5, 16)
    assert wall.looked.max() > 3.6
    assert wall.looked.diff(dim=1).max() < 0.6
    assert found.shape == z.shape
    assert (found.diff(dim=1) >= 0).all()
    assert ((found - 2.5).abs() < 0.5).sum(1).ge(5 + 3).all(), "the new ones and those that were there"


@pytest.mark.parametrize("rays", [0, 1, 300])
@pytest.mark.parametrize(("uniform", "near_depth"), [(32, 11), (8, 11), (0, 11), (4, 1), (96, 21)])
def test_on_a_cpu_one_pass_finds_the_same_bits(rays, uniform, near_depth):
    config = SamplingConfig(uniform=uniform, near_depth=near_depth, near_m=0.3)
    depth, far = 5 * jitter(rays, seed=1), 0.2 + 4 * jitter(rays, seed=2)
    depth[::4], depth[1::9], depth[2::9] = 0, 0.1, 0.32
    numbers = jitter(rays, uniform + near_depth, seed=3)
    z = sample_depths(depth, far, config, numbers, cpu)
    assert torch.equal(z, sample_depths(depth, far, config, numbers))
    if uniform:
        z, more = thinned(z, config), jitter(rays, 2 * near_depth, seed=4)[:, ::2]
        weights = jitter(rays, uniform, seed=5) ** 8
        weights[::5], weights[1::5, 2:] = 0, 0
        assert torch.equal(cpu.importance_depths(z, weights, more), importance_depths(z, weights, more))


def test_ray_exit_of_a_box():
    box = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
    direction = torch.tensor([[0.0, 0, 1], [0, 0, -1], [1, 0, 1]])
    found = ray_exit(torch.tensor([[0.0, 0, 0.5]] * 3), direction, box, 8.0)
    assert torch.allclose(found, torch.tensor([0.5, 1.5, 0.5]))
    assert ray_exit(torch.zeros(1, 3), torch.tensor([[0.0, 0, 1e-4]]), box, 8.0) == 8
