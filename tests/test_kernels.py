"""The reference kernels: analytic scenes, finite differences and the laws of rendering."""

from dataclasses import fields, replace

import pytest
import torch
from kernel_cases import ALIGN, WEIGHTS, blank, double, make_field, make_points, make_poses, make_rays, relative_rms

from ecslam.config import FieldConfig
from ecslam.field import TsdfField
from ecslam.kernels import FieldParams, RayBatch, reference, select, use
from ecslam.se3 import retract
from ecslam.types import InputError

TINY = FieldConfig(levels=3, log2_table_size=8, base_resolution=3, finest_voxel_m=0.3, blob_bins=4, init_scale=0.5)
SPHERE = FieldConfig(levels=1, log2_table_size=20, base_resolution=64, finest_voxel_m=0.05, blob_bins=4)
RADIUS, TRUNCATION = 0.8, 0.5


def tiny() -> TsdfField:
    field = make_field(TINY)
    return replace(field, params=double(field.params))


def on_lattice(function) -> TsdfField:
    """A field whose TSDF is ``function`` of the lattice points, trilinear between them, and whose colour is grey."""
    field = make_field(SPHERE)
    layout, p = field.layout, field.params
    nx, ny, nz = layout.dims[0].tolist()
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (nz, ny, nx)), indexing="ij")
    lattice = torch.stack([x, y, z], -1).reshape(-1, 3) + layout.first[0]
    table = torch.zeros_like(p.table, dtype=torch.float64)
    table[:, 0] = function(layout.anchor + lattice * layout.voxel[0])
    w_in, w_sdf = torch.zeros_like(p.w_in).double(), torch.zeros_like(p.w_sdf).double()
    w_in[0, 0], w_in[0, 1], w_sdf[0], w_sdf[1] = 1, -1, 1, -1  # relu(f) - relu(-f) = f
    params = FieldParams(table, w_in, w_sdf, torch.zeros_like(p.w_rgb).double(), p.beta.double())
    return replace(field, params=params)


def sphere() -> TsdfField:
    return on_lattice(lambda x: (x.norm(dim=-1) - RADIUS) / TRUNCATION)


def test_one_blob_sums_to_one_is_positive_and_periodic():
    layout = make_field().layout
    points = make_points(500).double()
    blob = reference.encode_one_blob(layout, points).view(-1, 3, layout.bins)
    torch.testing.assert_close(blob.sum(-1), torch.ones(500, 3).double())
    assert (blob >= -1e-12).all()
    assert ((blob > 1e-9).sum(-1) <= 3).all()
    around = reference.encode_one_blob(layout, points + layout.blob_size.double()).view_as(blob)
    torch.testing.assert_close(around, blob)


def test_the_grid_reproduces_a_linear_function_and_its_gradient():
    normal = torch.tensor([0.3, -0.5, 0.2]).double()
    field = on_lattice(lambda x: x.double() @ normal + 0.1)
    points = make_points(300).double().clamp(-0.9, 0.9)
    sdf, d_sdf, _, d_luminance = reference.gradients(field.layout, field.params, points)
    torch.testing.assert_close(sdf, points @ normal + 0.1, atol=1e-6, rtol=0)
    torch.testing.assert_close(d_sdf, normal.expand(300, 3), atol=1e-5, rtol=0)
    assert not d_luminance.any()


def test_a_sphere_has_its_distance_and_its_normals():
    field = sphere()
    points = make_points(2000).double()
    points = points[(points.norm(dim=-1) > 0.5) & (points.abs().amax(-1) < 0.95)]
    sdf, d_sdf, luminance, _ = reference.gradients(field.layout, field.params, points)
    assert ((sdf * TRUNCATION - (points.norm(dim=-1) - RADIUS)).abs() < 0.05**2).all()
    normal = torch.nn.functional.normalize(points, dim=-1)
    assert ((d_sdf * TRUNCATION * normal).sum(-1) > 0.95).all()
    torch.testing.assert_close(luminance, torch.full_like(luminance, 0.5))


def test_rays_see_the_sphere_where_it_is():
    field = sphere()
    field.params.beta.fill_(200.0)
    z = torch.linspace(0.05, 0.9, 400)[None].repeat(5, 1)
    direction = torch.tensor([[0, 0, 1], [0.1, 0, 1], [0, 0.1, 1], [-0.1, 0.05, 1], [0.05, -0.1, 1]], dtype=torch.float)
    c2w = torch.eye(4)[None]
    c2w[0, 2, 3] = -0.05
    inside_out = replace(field.params, w_sdf=-field.params.w_sdf)  # the camera is inside: outside is solid
    rays = RayBatch(direction, z, torch.zeros(5), torch.zeros(5, 3), torch.zeros(5).bool(), torch.zeros(5).long())
    _, depth, weights = reference.render(field.layout, inside_out, c2w.double(), double(rays))
    hit = c2w[0, :3, 3] + depth[:, None] * direction
    assert ((hit.norm(dim=-1) - RADIUS).abs() < 0.02).all()
    torch.testing.assert_close(weights.sum(1), torch.ones(5).double(), atol=1e-6, rtol=0)


def test_weights_are_what_is_absorbed():
    sdf = torch.randn(20, 30, generator=torch.Generator().manual_seed(0)).double()
    beta = torch.tensor([0.3]).double()
    weights = reference.ray_weights(sdf, beta)
    density = beta * torch.sigmoid(-beta * sdf)
    assert (weights > 0).all()
    torch.testing.assert_close(weights.sum(1), 1 - torch.exp(-density.sum(1)))


def test_gradcheck_of_the_field():
    field = tiny()
    points = make_points(4).double().clamp(-0.8, 0.8)
    p = field.params

    def run(table, w_in, w_sdf, w_rgb, x):
        return reference.field(field.layout, FieldParams(table, w_in, w_sdf, w_rgb, p.beta), x)

    leaves = [t.clone().requires_grad_() for t in (p.table, p.w_in, p.w_sdf, p.w_rgb, points)]
    assert torch.autograd.gradcheck(run, leaves, fast_mode=True)


def test_step_gradients_are_finite_differences_of_its_losses():
    field = tiny()
    c2w, rays = make_rays(24, 9)
    c2w, rays = c2w[:, :3].double(), double(rays)
    into = blank(field.params)
    result = reference.step(field.layout, field.params, c2w, rays, WEIGHTS, into, True)
    generator = torch.Generator().manual_seed(1)

    def objective(params, poses):
        return float(reference.step(field.layout, params, poses, rays, WEIGHTS, None, False).losses.sum())

    for name in (f.name for f in fields(FieldParams)):
        value, h = getattr(field.params, name), 1e-6
        way = torch.randn(value.shape, generator=generator).double()
        ahead, behind = (objective(replace(field.params, **{name: value + s * h * way}), c2w) for s in (1, -1))
        assert (ahead - behind) / (2 * h) == pytest.approx(float((getattr(into, name) * way).sum()), rel=1e-4)
    way = torch.randn(c2w.shape, generator=generator).double()
    ahead, behind = (objective(field.params, c2w + s * 1e-8 * way) for s in (1, -1))
    assert (ahead - behind) / 2e-8 == pytest.approx(float((result.d_c2w * way).sum()), rel=1e-3)


def test_moving_the_world_and_the_cameras_together_changes_nothing():
    field = tiny()
    c2w, rays = make_rays(50, 12)
    shift = torch.tensor([1.0, -2.0, 0.5])  # exact in float32
    layout = replace(
        field.layout,
        anchor=field.layout.anchor + shift,
        blob_low=field.layout.blob_low + shift,
        box=field.layout.box + shift,
    )
    moved = c2w.clone().double()
    moved[:, :3, 3] += shift
    here = reference.step(field.layout, field.params, c2w.double(), double(rays), WEIGHTS, None, True)
    there = reference.step(layout, field.params, moved, double(rays), WEIGHTS, None, True)
    assert relative_rms(there.losses, here.losses) < 1e-5
    assert relative_rms(there.d_c2w[..., 3], here.d_c2w[..., 3]) < 1e-4


def test_rays_without_depth_count_for_colour_alone():
    field = tiny()
    c2w, rays = make_rays(30, 8)
    blind = replace(double(rays), depth=torch.zeros(30).double())
    losses = reference.step(field.layout, field.params, c2w.double(), blind, WEIGHTS, None, False).losses
    assert not losses[:4].any()
    assert losses[4] > 0


def test_each_loss_follows_its_weight():
    field = tiny()
    c2w, rays = make_rays(60, 20)
    rays = double(rays)
    base = reference.step(field.layout, field.params, c2w.double(), rays, WEIGHTS, None, False).losses
    assert (base > 0).all()
    twice = replace(WEIGHTS, centre=2 * WEIGHTS.centre)
    other = reference.step(field.layout, field.params, c2w.double(), rays, twice, None, False).losses
    torch.testing.assert_close(other, base * torch.tensor([1, 2, 1, 1, 1]))


def test_normal_equations_hold_the_gradient_of_the_cost():
    field = sphere()
    points = make_points(500, seed=3).double() * 0.4
    luminance = torch.rand(500, generator=torch.Generator().manual_seed(4)).double()
    c2w = make_poses(1, torch.Generator().manual_seed(5))[0].double()
    sums = reference.normal_equations(field.layout, field.params, c2w, points, luminance, ALIGN)
    torch.testing.assert_close(sums.jtj, sums.jtj.T)
    assert (torch.linalg.eigvalsh(sums.jtj) > -1e-9).all()
    assert 0 < sums.inliers <= sums.used <= 500
    settings = replace(ALIGN, tsdf_limit=1e6)
    sums = reference.normal_equations(field.layout, field.params, c2w, points, luminance, settings)
    for axis in range(6):
        way = torch.zeros(6).double()
        way[axis] = 1e-6
        ahead, behind = (
            reference.normal_equations(field.layout, field.params, retract(c2w, s * way), points, luminance, settings)
            for s in (1, -1)
        )
        assert (ahead.cost - behind.cost) / 2e-6 == pytest.approx(float(sums.jtr[axis]), rel=1e-3, abs=1e-6)


def test_a_gauss_newton_step_puts_points_back_on_the_sphere():
    field = sphere()
    generator = torch.Generator().manual_seed(6)
    points = RADIUS * torch.nn.functional.normalize(torch.randn(400, 3, generator=generator), dim=-1).double()
    c2w = torch.eye(4).double()
    c2w[:3, 3] = torch.tensor([0.05, -0.03, 0.04])
    for _ in range(4):
        settings = replace(ALIGN, truncation_m=TRUNCATION, kernel_m=1.0, colour_weight=0.0)
        sums = reference.normal_equations(field.layout, field.params, c2w, points, torch.zeros(400), settings)
        step = torch.linalg.solve(sums.jtj + 1e-3 * torch.eye(6).double(), -sums.jtr)
        c2w = retract(c2w, step)
    assert c2w[:3, 3].norm() < 2e-3


def test_nothing_is_legal():
    field = tiny()
    sdf, rgb = reference.values(field.layout, field.params, torch.zeros(0, 3).double())
    assert sdf.shape == (0,)
    assert rgb.shape == (0, 3)
    c2w, rays = make_rays(0, 5)
    into = blank(field.params)
    result = reference.step(field.layout, field.params, c2w.double(), double(rays), WEIGHTS, into, True)
    assert not result.losses.any()
    assert not result.d_c2w.any()
    assert not any(getattr(into, f.name).any() for f in fields(into))


def test_the_device_chooses_and_a_wish_overrides(monkeypatch):
    monkeypatch.delenv("ECSLAM_KERNELS", raising=False)
    cpu = torch.device("cpu")
    assert select(cpu)[0] == "cpu"
    with use("reference"):
        assert select(cpu)[1] is reference
    monkeypatch.setenv("ECSLAM_KERNELS", "reference")
    assert select(cpu)[0] == "reference"
    monkeypatch.setenv("ECSLAM_KERNELS", "gpu")
    with pytest.raises(InputError, match="gpu"):
        select(cpu)
    with pytest.raises(InputError, match="no such back end"), use("fpga"):
        pass
