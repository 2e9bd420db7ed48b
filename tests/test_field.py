"""The map's laws: growing keeps values, a frozen copy stays put, layouts fill their table exactly."""

from dataclasses import replace

import numpy as np
import torch

from ecslam.config import FieldConfig
from ecslam.field import box_of_points, create_field, grow_field, table_rows
from ecslam.kernels import reference

BOX = np.array([[-1.0, -0.5, 0], [1, 0.5, 1]])
CONFIG = FieldConfig(finest_voxel_m=0.02, log2_table_size=12, init_scale=0.5)


def points(count=2000, seed=0):
    low, high = BOX
    return torch.from_numpy(np.random.default_rng(seed).uniform(low, high, (count, 3)).astype(np.float32))


def make(config=CONFIG):
    return create_field(config, BOX, 0, torch.device("cpu"))


def test_levels_fill_the_table_without_gap_or_overlap():
    field = make()
    layout = field.layout
    rows = [reference.row(layout, level, _lattice(layout, level)) for level in range(layout.levels)]
    for level, row in enumerate(rows):
        first, size = int(layout.offset[level]), int(layout.size[level])
        assert row.min() >= first
        assert row.max() < first + size
        if int(layout.dims[level, 0]):
            assert len(row.unique()) == size  # dense: one row a lattice point
    assert int(layout.offset[-1] + layout.size[-1]) == table_rows(layout) == len(field.params.table)
    assert (layout.dims[:, 0] > 0).any()
    assert (layout.dims[:, 0] == 0).any()


def _lattice(layout, level):
    dims = layout.dims[level].tolist() if int(layout.dims[level, 0]) else [30, 30, 30]
    axes = [torch.arange(n) + int(f) for n, f in zip(dims, layout.first[level], strict=True)]
    return torch.cartesian_prod(*axes)


def test_growing_keeps_every_value_inside_the_old_box():
    field = make(replace(CONFIG, levels=2, base_resolution=4))
    assert field.layout.dims[:, 0].gt(0).tolist() == [True, False]
    bigger = grow_field(field, np.array([[-3.0, -0.2, -1], [1.5, 4, 2]]))
    again = grow_field(bigger, np.array([[-3.5, -0.2, -2], [1.5, 4, 2]]))
    for grown in (bigger, again):
        for a, b in zip(
            reference.values(field.layout, field.params, points()),
            reference.values(grown.layout, grown.params, points()),
            strict=True,
        ):
            assert torch.equal(a, b)
    assert torch.equal(again.layout.box, torch.tensor([[-3.5, -0.5, -2], [1.5, 4, 2]]))


ROOM = np.array([[-5.0, -5, -1], [5, 5, 2]])


def test_a_level_that_outgrows_the_table_is_hashed_and_keeps_what_was_learnt():
    field = make()
    grown = grow_field(field, ROOM)
    old, new = field.layout, grown.layout
    assert (new.size <= 2**CONFIG.log2_table_size).all()
    assert table_rows(new) == len(grown.params.table)
    (changed,) = torch.nonzero((old.dims[:, 0] > 0) & (new.dims[:, 0] == 0)).T
    assert len(changed) == 3
    for level in changed.tolist():
        lattice = _lattice(old, level)
        place = reference.row(new, level, lattice)
        before, after = field.params.table[reference.row(old, level, lattice)], grown.params.table[place]
        kept = (after == before).all(1)
        assert kept.sum() == len(place.unique()), "one lattice point keeps each row"
        assert (after.norm(dim=1) >= before.norm(dim=1)).all(), "the one that learnt most"
        assert kept.float().mean() > 0.6


def test_frozen_copy_does_not_follow():
    field = make()
    frozen = field.freeze()
    before, _ = reference.values(frozen.layout, frozen.params, points())
    field.params.table.add_(1)
    field.params.w_in.mul_(2)
    assert torch.equal(before, reference.values(frozen.layout, frozen.params, points())[0])


def test_same_seed_same_field():
    assert torch.equal(make().params.table, make().params.table)
    other = create_field(CONFIG, BOX, 1, torch.device("cpu"))
    assert not torch.equal(make().params.table, other.params.table)


def test_box_ignores_stray_points_and_keeps_a_margin():
    cloud = np.concatenate([np.random.default_rng(0).uniform(0, 1, (5000, 3)), [[50, 50, 50]]])
    low, high = box_of_points(cloud, 0.3)
    side = 0.02 * np.sqrt(3)
    assert np.allclose(low, -0.3 - side, atol=0.01)
    assert np.allclose(high, 1.3 + side, atol=0.01)
