"""The GPU kernels against the float64 reference: every function, every gradient, ragged sizes.

Not collected by itself: ``test_kernels_gpu.py`` runs it in a process of its own, on a GPU where there is one, else in
Triton's interpreter, since TRITON_INTERPRET=1 must be set before Triton is imported and then holds for the whole
process. The interpreter's time goes by blocks, about a third of a second each, so sizes are small and blocks are larger
than on a GPU.
"""

from dataclasses import fields, replace

import pytest
import torch
from fake_graphs import Forbidding, launch_nothing
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
from on_gpu import DEVICE, INTERPRETED, moved, run

from ecslam.config import FieldConfig
from ecslam.field import grow_field
from ecslam.field_adam import FieldAdam
from ecslam.kernels import FieldParams, PoseMoments, gpu, reference
from ecslam.kernels.poses_gpu import pose_step
from ecslam.pose_adam import BETA2, EPSILON, PoseAdam

torch.set_num_threads(1)
SIZES = (0, 1, 63, 64, 65, 300)
CLOSE = 1e-4
FIELDS = {
    "mixed": FieldConfig(log2_table_size=12, init_scale=0.1),
    "odd": FieldConfig(levels=5, log2_table_size=10, blob_bins=7, init_scale=0.1),
    "wide": FieldConfig(levels=17, log2_table_size=14, blob_bins=4, init_scale=0.1),
}


@pytest.fixture(autouse=True)
def large_blocks(monkeypatch):
    if INTERPRETED:
        monkeypatch.setattr(gpu, "GRID_BLOCK", 64)


def assert_close(found, expected):
    """Each tensor of one tuple to that of the other."""
    for mine, theirs in zip(found, expected, strict=True):
        assert mine.dtype == torch.float32
        assert relative_rms(mine, theirs) < CLOSE


def assert_step(field, c2w, rays, want_params=True, want_poses=True, weights=WEIGHTS):
    mine, theirs = blank(field.params), blank(double(field.params))
    found = run(gpu.step, field.layout, field.params, c2w, rays, weights, mine if want_params else None, want_poses)
    exact = double(field.params), c2w.double(), double(rays), weights, theirs if want_params else None, want_poses
    expected = reference.step(field.layout, *exact)
    assert_close([found.losses], [expected.losses])
    assert (found.d_c2w is None) == (not want_poses)
    if want_poses:
        assert_close([found.d_c2w], [expected.d_c2w])
    for name in (f.name for f in fields(FieldParams)):
        if want_params:
            assert relative_rms(getattr(mine, name), getattr(theirs, name)) < CLOSE, name
        else:
            assert (getattr(mine, name) == 1e3).all()


def assert_render(field, c2w, rays):
    expected = reference.render(field.layout, double(field.params), c2w.double(), double(rays))
    assert_close(run(gpu.render, field.layout, field.params, c2w, rays), expected)


def assert_fields(field, points):
    params = double(field.params)
    for function in ("values", "gradients"):
        expected = getattr(reference, function)(field.layout, params, points.double())
        assert_close(run(getattr(gpu, function), field.layout, field.params, points), expected)


@pytest.mark.parametrize("count", SIZES)
def test_values_and_gradients(count):
    assert_fields(make_field(), make_points(count))


@pytest.mark.parametrize("count", SIZES)
def test_step_and_render(count):
    c2w, rays = make_rays(count, 2)
    assert_step(make_field(), c2w, rays)
    assert_render(make_field(), c2w, rays)


def test_the_block_that_runs_on_a_gpu(monkeypatch):
    monkeypatch.undo()
    assert gpu.GRID_BLOCK < 64
    assert_step(make_field(), *make_rays(gpu.GRID_BLOCK + 1, 2))


@pytest.mark.parametrize(("run", "lanes"), [(1, 64), (2, 32), (8, 32)])
def test_any_number_of_points_may_be_added_up(monkeypatch, run, lanes):
    monkeypatch.setattr(gpu, "TABLE_RUN", run)
    monkeypatch.setattr(gpu, "TABLE_LANES", lanes)
    assert_step(make_field(), *make_rays(7, 19), want_poses=False)


@pytest.mark.parametrize(("count", "samples"), [(3, 43), (70, 1)])
def test_step_and_render_with_other_numbers_of_samples(count, samples):
    c2w, rays = make_rays(count, samples)
    assert_step(make_field(), c2w, rays)
    assert_render(make_field(), c2w, rays)


def test_step_with_more_samples_than_a_block_of_rays_holds():
    assert_step(make_field(), *make_rays(1, gpu.RAY_ELEMENTS + 1), want_params=False)


@pytest.mark.parametrize("kind", ["odd", "wide"])
def test_other_shapes_of_field(kind):
    assert_fields(make_field(FIELDS[kind]), make_points(40))
    assert_step(make_field(FIELDS[kind]), *make_rays(12, 7, poses=5))


def test_after_the_box_grew():
    field = grow_field(make_field(), BOX * 1.5)
    assert_fields(field, make_points(40))
    assert_step(field, *make_rays(12, 7))


@pytest.mark.parametrize(("want_params", "want_poses"), [(False, True), (True, False), (False, False)])
def test_step_gives_what_is_asked_for(want_params, want_poses):
    c2w, rays = make_rays(12, 7)
    assert_step(make_field(), c2w[:, :3].contiguous(), rays, want_params, want_poses)


@pytest.mark.parametrize("feature", [True, False])
@pytest.mark.parametrize("depth", [True, False])
def test_step_when_all_rays_are_alike(feature, depth):
    c2w, rays = make_rays(12, 5)
    rays = replace(rays, feature=torch.full_like(rays.feature, feature), depth=torch.full((12,), 0.7) * depth)
    assert_step(make_field(), c2w, rays)


@pytest.mark.parametrize("beta", [0.5, 300.0])
def test_step_with_soft_and_hard_surfaces(beta):
    field = make_field()
    assert_step(replace(field, params=replace(field.params, beta=torch.tensor([beta]))), *make_rays(12, 10))


def test_a_block_may_meet_many_poses_and_skip_some():
    c2w, rays = make_rays(40, 3, poses=9)
    rays = replace(rays, pose=torch.where(rays.pose == 4, 5, rays.pose))
    assert_step(make_field(), c2w, rays)
    assert not run(gpu.step, make_field().layout, make_field().params, c2w, rays, WEIGHTS, None, True).d_c2w[4].any()


def test_programs_that_take_several_blocks(monkeypatch):
    monkeypatch.setattr(gpu, "PROGRAMS_A_PROCESSOR", 1)
    monkeypatch.setattr(gpu, "processors", lambda device: 1)
    assert_step(make_field(), *make_rays(40, 4))


@pytest.mark.parametrize(("count", "colour"), [(0, 0.1), (1, 0.1), (63, 0.0), (64, 0.1), (65, 0.1), (300, 0.1)])
def test_normal_equations(count, colour):
    field, points = make_field(), make_points(count, seed=1)
    luminance = torch.rand(count, generator=torch.Generator().manual_seed(2))
    c2w = make_poses(1, torch.Generator().manual_seed(3))[0]
    settings = replace(ALIGN, colour_weight=colour, gradient_low=0.05, tsdf_limit=0.3)
    found = run(gpu.normal_equations, field.layout, field.params, c2w, points, luminance, settings)
    exact = double(field.params), c2w.double(), points.double(), luminance.double(), settings
    expected = reference.normal_equations(field.layout, *exact)
    assert (found.used, found.inliers) == (expected.used, expected.inliers)
    assert found.cost == pytest.approx(expected.cost, rel=CLOSE)
    assert found.jtj.dtype == found.jtr.dtype == torch.float64
    assert relative_rms(found.jtj, expected.jtj) < CLOSE
    assert relative_rms(found.jtr, expected.jtr) < CLOSE


def test_inputs_need_not_be_contiguous():
    field, (c2w, rays) = make_field(), make_rays(12, 5)
    wide = replace(rays, z=torch.cat([rays.z, rays.z], 1)[:, ::2])
    straight = replace(wide, z=wide.z.contiguous())
    mine = run(gpu.step, field.layout, field.params, c2w.mT.contiguous().mT, wide, WEIGHTS, None, True)
    theirs = run(gpu.step, field.layout, field.params, c2w, straight, WEIGHTS, None, True)
    assert relative_rms(mine.d_c2w, theirs.d_c2w) < CLOSE


def test_numbers_that_are_not_numbers_stay_in_their_place():
    field, points = make_field(), make_points(20)
    clean, _ = run(gpu.values, field.layout, field.params, points)
    spoiled = points.clone()
    spoiled[7], spoiled[9, 1] = float("nan"), float("inf")
    sdf, _ = run(gpu.values, field.layout, field.params, spoiled)
    keep = torch.ones(20).bool()
    keep[[7, 9]] = False
    assert torch.equal(sdf[keep], clean[keep])


def test_a_layout_is_uploaded_once_and_forgotten_with_it():
    field = make_field()
    for _ in range(2):
        run(gpu.values, field.layout, field.params, make_points(1))
    assert len([key for key in gpu._layouts if key[0] == id(field.layout)]) == 1
    before = len(gpu._layouts)
    del field
    assert len(gpu._layouts) == before - 1


@pytest.mark.parametrize(("want_params", "want_poses"), [(True, True), (True, False), (False, True)])
def test_no_step_waits_for_the_gpu(monkeypatch, want_params, want_poses):
    """On the meta device no value can be read at all."""
    launch_nothing(monkeypatch, gpu)
    field, (c2w, rays) = make_field(), make_rays(40, 4)
    params, rays = (type(t)(*(getattr(t, f.name).to("meta") for f in fields(t))) for t in (field.params, rays))
    c2w, mine = c2w.to("meta"), blank(params) if want_params else None
    gpu.step(field.layout, params, c2w, rays, WEIGHTS, mine, want_poses)  # uploads the layout, once
    with Forbidding():
        found = gpu.step(field.layout, params, c2w, rays, WEIGHTS, mine, want_poses)
    assert found.losses.device.type == "meta"


def test_a_step_that_learns_moves_the_table_as_its_gradient_says():
    field, (c2w, rays) = moved(make_field(), DEVICE), (moved(part, DEVICE) for part in make_rays(20, 4))
    start, mine = field.params.table.clone(), blank(field.params)
    adam = FieldAdam([field.params.table])
    gpu.step(field.layout, field.params, c2w, rays, WEIGHTS, mine, False, adam.steps(1e-2, 0)[0])
    expected, alone = start.clone(), FieldAdam([start])
    reference.map_step([expected], [mine.table], alone.steps(1e-2, 0)[0])
    assert (mine.table != 0).any()
    assert_close([field.params.table - start, adam.mean[0]], [expected - start, alone.mean[0]])


def steps_of_the_map(kernels, shapes, dtype, device, rate, first, steps):
    """How far some parameters get by so many steps after the ``first``, and the moments. A tenth of the gradients are
    none, the others of all sizes."""
    random = torch.Generator().manual_seed(0)
    start = [torch.randn(*shape, generator=random).to(device, dtype) for shape in shapes]
    adam = FieldAdam([torch.zeros(1).to(start[0]), *(p.clone() for p in start)])
    adam.count += first
    for _ in range(steps):
        drawn = [torch.randn(2, *shape, generator=random) for shape in shapes]
        gradients = [(g[0] * 10 ** (4 * g[1] - 4) * (g[1] < 1.3)).to(device, dtype) for g in drawn]
        kernels.map_step(adam.parameters[1:], gradients, adam.steps(0, moved(rate, torch.device(device)))[1])
    way = [p - q for p, q in zip(adam.parameters[1:], start, strict=True)]
    return [t.cpu() for t in (*way, *adam.mean[1:], *adam.square[1:])]


@pytest.mark.parametrize("shapes", [[(0, 2)], [(1,)], [(2049, 2)], [(65, 64), (32, 1), (32, 3), (1,)]])
@pytest.mark.parametrize("first", [0, 40, 100_000])
@pytest.mark.parametrize("rate", [1e-2, torch.tensor(3e-3)])
def test_steps_of_the_map(shapes, first, rate):
    for steps in (1, 3):
        found = steps_of_the_map(gpu, shapes, torch.float32, DEVICE, rate, first, steps)
        assert_close(found, steps_of_the_map(reference, shapes, torch.float64, "cpu", rate, first, steps))


@pytest.mark.parametrize("poses", [1, 5, 33])
@pytest.mark.parametrize("about", [True, False])
def test_a_step_of_the_poses(poses, about):
    g = torch.Generator().manual_seed(0)
    c2w, rates = make_poses(poses, g).double(), torch.rand(poses, 6, generator=g).double() * 0.01
    rates[0] = 0
    rates[-1] = 1e-9
    centre = torch.randn(poses, 3, generator=g).double() if about else None
    expected, found = PoseAdam(c2w, rates, 0.5, centre), c2w
    mean, square = torch.zeros(poses, 6).double(), torch.zeros(poses, 6).double()
    there = [moved(t, DEVICE) for t in (found, mean, square, rates, centre)]
    found, mean, square, rates, centre = there
    moments = PoseMoments(mean, square, centre, (0.5, BETA2), EPSILON)
    for count in range(1, 4):
        gradient = torch.randn(poses, 3, 4, generator=g)
        expected.step(gradient)
        found = pose_step(found, gradient.to(DEVICE), moments, rates, count)
    torch.testing.assert_close(found.cpu(), expected.c2w, rtol=0, atol=1e-8)
    assert poses == 1 or (found.cpu() - c2w).abs().max() > 0.01


@pytest.mark.parametrize(("rays", "samples", "more"), [(0, 32, 11), (1, 8, 11), (37, 32, 11), (6, 33, 17), (5, 96, 21)])
def test_depths_that_follow_a_rendering(rays, samples, more):
    random = torch.Generator().manual_seed(rays)
    z = (4 * torch.rand(rays, samples, generator=random)).sort(1).values
    weights = torch.exp(-(((z - z[:, 2:3]) / 0.2) ** 2))
    weights[::5] = 0
    jitter = torch.rand(rays, 2 * more, generator=random)[:, ::2]
    found = run(gpu.importance_depths, z, weights, jitter)
    assert_close([found], [reference.importance_depths(z.double(), weights.double(), jitter.double())])
    assert (found.diff(dim=1) >= 0).all()
    assert torch.isin(z, found).all()
