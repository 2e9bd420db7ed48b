"""The smoothness term against automatic differentiation, and where its lattice lies."""

import numpy as np
import torch

from ecslam.config import FieldConfig, MappingConfig
from ecslam.field import create_field
from ecslam.kernels import reference
from ecslam.samples import smooth_lattice

BOX = np.array([[-1.0, -0.5, 0], [1, 0.5, 1.5]])
FIELD = create_field(
    FieldConfig(finest_voxel_m=0.05, log2_table_size=10, levels=5, init_scale=0.5), BOX, 0, torch.device("cpu")
)
CONFIG = MappingConfig(smooth_points=5, smooth_voxel_m=0.1)


def lattice(seed=0, config=CONFIG):
    return smooth_lattice(FIELD, config, torch.Generator().manual_seed(seed))


def test_smoothness_is_the_mean_squared_difference_of_neighbours():
    points, n = lattice(), CONFIG.smooth_points
    table = FIELD.params.table.detach().clone().requires_grad_()
    feature = reference.encode_hash(FIELD.layout, table, points).reshape(n, n, n, -1)
    expected = sum(feature.diff(dim=axis).square().sum() for axis in range(3)) / n**3
    found = reference.smoothness(FIELD.layout, FIELD.params.table, points)
    assert torch.allclose(found, torch.autograd.grad(expected, table)[0], atol=1e-6)


def test_the_lattice_lies_anywhere_in_the_box():
    low, high = torch.from_numpy(BOX).float()
    many = torch.stack([lattice(seed) for seed in range(60)])
    assert (many >= low).all()
    assert (many <= high).all()
    steps = many[0].reshape(5, 5, 5, 3)
    assert torch.allclose(steps.diff(dim=0), torch.tensor([0.1, 0, 0]), atol=1e-6)
    assert torch.allclose(steps.diff(dim=2), torch.tensor([0, 0, 0.1]), atol=1e-6)
    reach = many.amax((0, 1)) - many.amin((0, 1))
    assert (reach > 0.9 * (high - low)).all()


def test_a_lattice_larger_than_the_box_ends_at_its_walls():
    low, high = torch.from_numpy(BOX).float()
    points = lattice(config=MappingConfig(smooth_points=8, smooth_voxel_m=0.5))
    assert torch.equal(points.amin(0), low)
    assert torch.equal(points.amax(0), high)
