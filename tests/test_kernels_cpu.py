"""The fused CPU kernels against the float64 reference: every function, every gradient, at ragged sizes."""

import threading
from dataclasses import fields, replace

import pytest
import torch
from kernel_cases import (
    ALIGN,
    BOX,
    WEIGHTS,
    blank,
    double,
    make_field,
    make_points,
    make_poses,
    make_rays,
    relative_rms,
)

from ecslam.config import FieldConfig, MappingConfig
from ecslam.field import grow_field, map_params
from ecslam.field_adam import FieldAdam
from ecslam.kernels import FieldParams, reference
from ecslam.pose_adam import PoseAdam
from ecslam.samples import smooth_lattice

cpu = pytest.importorskip("ecslam.kernels.cpu")
SIZES = (0, 1, 63, 64, 65, 1000)
CLOSE = 1e-5
CLOSE_BETA = 2e-4  # a single number, the sum of terms that cancel
FIELDS = {
    "mixed": FieldConfig(log2_table_size=12, init_scale=0.1),
    "odd": FieldConfig(levels=5, log2_table_size=10, blob_bins=7, init_scale=0.1),
    "wide": FieldConfig(levels=17, log2_table_size=14, blob_bins=4, init_scale=0.1),
}


def step_both(field, c2w, rays, want_params=True, want_poses=True, weights=WEIGHTS):
    """The step of the CPU back end and of the float64 reference: (result, gradients) each."""
    mine, theirs = blank(field.params), blank(double(field.params))
    found = cpu.step(field.layout, field.params, c2w, rays, weights, mine if want_params else None, want_poses)
    params, poses, batch = double(field.params), c2w.double(), double(rays)
    expected = reference.step(field.layout, params, poses, batch, weights, theirs if want_params else None, want_poses)
    return found, mine, expected, theirs


def assert_step(field, c2w, rays, **options):
    found, mine, expected, theirs = step_both(field, c2w, rays, **options)
    assert found.losses.dtype == torch.float32
    assert relative_rms(found.losses, expected.losses) < CLOSE
    if expected.d_c2w is None:
        assert found.d_c2w is None
    else:
        assert relative_rms(found.d_c2w, expected.d_c2w) < CLOSE
    for name in (f.name for f in fields(FieldParams)):
        limit = CLOSE_BETA if name == "beta" else CLOSE
        assert relative_rms(getattr(mine, name), getattr(theirs, name)) < limit, name


@pytest.mark.parametrize("kind", FIELDS)
@pytest.mark.parametrize("count", SIZES)
def test_values_and_gradients(kind, count):
    field = make_field(FIELDS[kind])
    points = make_points(count)
    params = double(field.params)
    for function in ("values", "gradients"):
        found = getattr(cpu, function)(field.layout, field.params, points)
        expected = getattr(reference, function)(field.layout, params, points.double())
        for mine, theirs in zip(found, expected, strict=True):
            assert relative_rms(mine, theirs) < CLOSE


@pytest.mark.parametrize(
    ("count", "samples"),
    [(count, samples) for count in SIZES[:-1] for samples in (1, 43)]
    + [(SIZES[-1], 1), pytest.param(SIZES[-1], 43, marks=pytest.mark.slow)],
)
def test_step_and_render(count, samples):
    field = make_field()
    c2w, rays = make_rays(count, samples)
    assert_step(field, c2w, rays)
    found = cpu.render(field.layout, field.params, c2w, rays)
    expected = reference.render(field.layout, double(field.params), c2w.double(), double(rays))
    for mine, theirs in zip(found, expected, strict=True):
        assert relative_rms(mine, theirs) < CLOSE


@pytest.mark.parametrize("kind", ["odd", pytest.param("wide", marks=pytest.mark.slow)])
def test_step_with_other_shapes_of_field(kind):
    assert_step(make_field(FIELDS[kind]), *make_rays(130, 17, poses=5))


@pytest.mark.parametrize("log2_table_size", [12, pytest.param(14, marks=pytest.mark.slow)])
def test_step_after_the_box_grew(log2_table_size):
    field = grow_field(make_field(FieldConfig(log2_table_size=log2_table_size, init_scale=0.1)), BOX * 1.5)
    assert_step(field, *make_rays(100, 20))


@pytest.mark.slow
def test_step_when_many_neighbours_in_a_cell_have_no_gradient():
    c2w, rays = make_rays(70, 40)
    rays = replace(rays, depth=torch.full((70,), 0.7), z=torch.linspace(0.67, 0.9, 40).repeat(70, 1))
    weights = replace(WEIGHTS, depth_uniform=0.0, depth_feature=0.0, colour_uniform=0.0, colour_feature=0.0)
    assert_step(make_field(), c2w, rays, weights=weights)


@pytest.mark.parametrize("feature", [True, False])
@pytest.mark.parametrize("depth", [True, False])
def test_step_when_all_rays_are_alike(feature, depth):
    c2w, rays = make_rays(70, 12)
    rays = replace(rays, feature=torch.full_like(rays.feature, feature), depth=torch.full((70,), 0.7) * depth)
    assert_step(make_field(), c2w, rays)


@pytest.mark.parametrize("beta", [0.5, 10.0, 300.0])
def test_step_with_soft_and_hard_surfaces(beta):
    field = make_field()
    params = replace(field.params, beta=torch.tensor([beta]))
    assert_step(replace(field, params=params), *make_rays(100, 30))


@pytest.mark.parametrize(("want_params", "want_poses"), [(False, True), (True, False), (False, False)])
def test_step_gives_what_is_asked_for(want_params, want_poses):
    c2w, rays = make_rays(65, 20)
    field = make_field()
    found, mine, expected, theirs = step_both(field, c2w[:, :3].contiguous(), rays, want_params, want_poses)
    assert relative_rms(found.losses, expected.losses) < CLOSE
    assert (found.d_c2w is not None) == want_poses
    if want_poses:
        assert relative_rms(found.d_c2w, expected.d_c2w) < CLOSE
    else:
        assert relative_rms(mine.table, theirs.table) < CLOSE or not want_params
    if not want_params:
        assert (mine.table == 1e3).all()


def test_a_pose_without_rays_has_no_gradient():
    c2w, rays = make_rays(40, 10, poses=4)
    rays = replace(rays, pose=torch.where(rays.pose == 2, 3, rays.pose))
    found = cpu.step(make_field().layout, make_field().params, c2w, rays, WEIGHTS, None, True)
    assert not found.d_c2w[2].any()
    assert found.d_c2w[3].any()


@pytest.mark.parametrize("colour_weight", [0.0, 0.1])
@pytest.mark.parametrize("count", [*SIZES, 5000])
def test_normal_equations(count, colour_weight):
    field = make_field()
    points = make_points(count, seed=1)
    luminance = torch.rand(count, generator=torch.Generator().manual_seed(2))
    c2w = make_poses(1, torch.Generator().manual_seed(3))[0]
    settings = replace(ALIGN, colour_weight=colour_weight, gradient_low=0.05, tsdf_limit=0.3)
    found = cpu.normal_equations(field.layout, field.params, c2w, points, luminance, settings)
    expected = reference.normal_equations(
        field.layout, double(field.params), c2w.double(), points.double(), luminance.double(), settings
    )
    assert found.used == expected.used
    assert found.inliers == expected.inliers
    assert found.cost == pytest.approx(expected.cost, rel=CLOSE)
    assert relative_rms(found.jtj, expected.jtj) < CLOSE
    assert relative_rms(found.jtr, expected.jtr) < CLOSE


@pytest.mark.parametrize("kind", FIELDS)
def test_a_step_that_learns_at_once_is_the_same_as_one_after_the_other(kind):
    field, (c2w, rays) = make_field(FIELDS[kind]), make_rays(300, 20)
    at_once, after = (map_params(field.params, torch.clone) for _ in range(2))
    one, two = FieldAdam([at_once.table]), FieldAdam([after.table])
    mine, theirs = blank(field.params), blank(field.params)
    before = torch.randn(field.params.table.shape, generator=torch.Generator().manual_seed(4))
    for adam, params in ((one, at_once), (two, after)):
        reference.map_step([params.table], [1e-3 * before], adam.steps(1e-2, 0)[0])
    found = cpu.step(field.layout, at_once, c2w, rays, WEIGHTS, mine, True, one.steps(1e-2, 0)[0])
    expected = cpu.step(field.layout, after, c2w, rays, WEIGHTS, theirs, True)
    reference.map_step([after.table], [theirs.table], two.steps(1e-2, 0)[0])
    assert torch.equal(found.d_c2w, expected.d_c2w)
    for name in (f.name for f in fields(FieldParams)):
        assert torch.equal(getattr(mine, name), getattr(theirs, name)), name
    for got, wanted in ((at_once.table, after.table), (one.mean[0], two.mean[0]), (one.square[0], two.square[0])):
        torch.testing.assert_close(got, wanted, rtol=1e-5, atol=1e-7)
    assert (at_once.table - field.params.table).abs().min() > 0


def everything(field, c2w, rays, points):
    """All outputs of all functions in one list."""
    into = blank(field.params)
    result = cpu.step(field.layout, field.params, c2w, rays, WEIGHTS, into, True)
    out = [result.losses, result.d_c2w, *(getattr(into, f.name) for f in fields(into))]
    out += [*cpu.values(field.layout, field.params, points), *cpu.gradients(field.layout, field.params, points)]
    out += cpu.render(field.layout, field.params, c2w, rays)
    sums = cpu.normal_equations(field.layout, field.params, c2w[0], points, points[:, 0], ALIGN)
    return [*out, sums.jtj, sums.jtr, torch.tensor([sums.cost, sums.used, sums.inliers])]


def test_results_repeat_bit_for_bit_with_any_number_of_threads():
    field, (c2w, rays), points = make_field(), make_rays(900, 20), make_points(5000)
    first = everything(field, c2w, rays, points)
    before = torch.get_num_threads()
    try:
        for threads in (before, 1, 3):
            torch.set_num_threads(threads)
            for mine, theirs in zip(everything(field, c2w, rays, points), first, strict=True):
                assert torch.equal(mine, theirs)
    finally:
        torch.set_num_threads(before)


def test_two_threads_at_once_get_what_each_gets_alone():
    cases = [(make_field(seed=s), *make_rays(600, 20, seed=s), make_points(4500, seed=s)) for s in (1, 2)]
    alone = [everything(*case) for case in cases]
    wrong = []

    def repeat(case, expected):
        for _ in range(8):
            same = [torch.equal(a, b) for a, b in zip(everything(*case), expected, strict=True)]
            wrong.extend(i for i, equal in enumerate(same) if not equal)

    threads = [threading.Thread(target=repeat, args=pair) for pair in zip(cases, alone, strict=True)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_inputs_need_not_be_contiguous_and_are_left_alone():
    field, (c2w, rays) = make_field(), make_rays(50, 10)
    wide = torch.cat([rays.z, rays.z], 1)[:, ::2]
    straight = wide.contiguous()
    rays = replace(rays, z=wide)
    before = map_params(field.params, torch.clone)
    mine = cpu.step(
        field.layout, field.params, c2w.transpose(1, 2).contiguous().transpose(1, 2), rays, WEIGHTS, None, True
    )
    theirs = cpu.step(field.layout, field.params, c2w, replace(rays, z=straight), WEIGHTS, None, True)
    assert torch.equal(mine.d_c2w, theirs.d_c2w)
    assert all(torch.equal(getattr(before, f.name), getattr(field.params, f.name)) for f in fields(before))


def test_numbers_that_are_not_numbers_stay_in_their_place():
    field = make_field()
    points = make_points(100)
    clean, _ = cpu.values(field.layout, field.params, points)
    spoiled = points.clone()
    spoiled[7] = float("nan")
    spoiled[9, 1] = float("inf")
    sdf, _ = cpu.values(field.layout, field.params, spoiled)
    keep = torch.ones(100).bool()
    keep[[7, 9]] = False
    assert torch.equal(sdf[keep], clean[keep])


@pytest.mark.parametrize("poses", [0, 1, 5, 33])
@pytest.mark.parametrize("about", [True, False])
def test_steps_of_the_poses(poses, about):
    g = torch.Generator().manual_seed(0)
    c2w, rates = make_poses(poses, g).double(), torch.rand(poses, 6, generator=g).double() * 0.3
    rates[:1], rates[-1:] = 0, 1e-6
    centre = torch.randn(poses, 3, generator=g).double() if about else None
    mine, theirs = (PoseAdam(c2w, rates, 0.5, centre, kernels) for kernels in (cpu, reference))
    for share in (1.0, 0.7, None):
        gradient = torch.randn(poses, 3, 4, generator=g)
        mine.step(gradient, share)
        theirs.step(gradient, share)
        torch.testing.assert_close(mine.c2w, theirs.c2w, rtol=0, atol=1e-12)
    assert poses < 5 or (mine.c2w - c2w).abs().max() > 0.1


@pytest.mark.parametrize("kind", FIELDS)
@pytest.mark.parametrize(("side", "step_m"), [(2, 0.1), (5, 0.03), (9, 0.1), (16, 0.5)])
def test_smoothness_agrees_with_the_reference(kind, side, step_m):
    field = make_field(FIELDS[kind])
    config = MappingConfig(smooth_points=side, smooth_voxel_m=step_m)
    lattice = smooth_lattice(field, config, torch.Generator().manual_seed(side))
    found = cpu.smoothness(field.layout, field.params.table, lattice)
    expected = reference.smoothness(field.layout, field.params.table.double(), lattice.double())
    assert expected.abs().max() > 0
    assert relative_rms(found, expected) < CLOSE
    assert torch.equal(found, cpu.smoothness(field.layout, field.params.table, lattice))
