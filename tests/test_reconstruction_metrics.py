"""The rasteriser against geometry; surface errors, Depth L1 and culling on cases with known answers."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ecslam.evaluation.culling import culled, observed, rendered_depth, spread_frames
from ecslam.evaluation.depth_views import depth_l1, random_views, up_direction, viewpoint_candidates
from ecslam.evaluation.reconstruction import register, surface_error
from ecslam.evaluation.report import evaluate_run
from ecslam.evaluation.surface import part, sample_surface, subdivided
from ecslam.evaluation.trajectory import Similarity
from ecslam.kernels.raster import rasterize
from ecslam.types import InputError, Intrinsics, Mesh

CAMERA = Intrinsics(70.0, 80.0, 39.5, 30.0, 80, 60)
SEEDS = st.integers(0, 2**32 - 1)


def from_trimesh(mesh: trimesh.Trimesh) -> Mesh:
    return Mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))


def room(size: tuple[float, float, float] = (4.0, 3.0, 2.5), grow: float = 0.0) -> Mesh:
    """A box seen from inside, its walls pushed outwards by ``grow``, with its middle at the origin."""
    box = trimesh.creation.box([s + 2 * grow for s in size])
    box.invert()
    return from_trimesh(box)


def look(direction: tuple[float, float, float], centre: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    z = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    x = np.cross([0, 0, -1.0], z)
    x /= np.linalg.norm(x)
    c2w = np.eye(4)
    c2w[:3, 0], c2w[:3, 1], c2w[:3, 2], c2w[:3, 3] = x, np.cross(z, x), z, centre
    return c2w


def turning(n: int = 24, tilts: tuple[float, ...] = (-0.8, 0.0, 0.8)) -> np.ndarray:
    angles = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return np.stack([look((np.cos(a), np.sin(a), t)) for a in angles for t in tilts])


def rays(camera: Intrinsics, c2w: np.ndarray) -> np.ndarray:
    """Directions [H, W, 3] in the world whose length along the optical axis is one."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    return local @ c2w[:3, :3].T


# ---- the rasteriser -------------------------------------------------------------------------------------------------


def test_depth_inside_a_box_is_exact_in_every_direction() -> None:
    """The box has twelve triangles, most of which pass the camera's plane."""
    mesh, half = room(), np.array([2.0, 1.5, 1.25])
    for c2w in np.concatenate(
        [turning(7), random_views(np.full((9, 3), 0.3), np.array([0, 0, 1]), np.random.default_rng(0))]
    ):
        depth, face = rasterize(mesh, CAMERA, c2w)
        direction = rays(CAMERA, c2w)
        with np.errstate(divide="ignore"):
            wall = np.maximum((half - c2w[:3, 3]) / direction, (-half - c2w[:3, 3]) / direction)
        np.testing.assert_allclose(depth, wall.min(-1), rtol=1e-5)
        assert (face >= 0).all()


def test_depth_of_a_sphere() -> None:
    mesh = from_trimesh(trimesh.creation.icosphere(5, 0.5))
    c2w = look((1, 0, 0), (-2, 0, 0))
    depth, face = rasterize(mesh, CAMERA, c2w)
    d = rays(CAMERA, c2w)
    a, b, c = (d * d).sum(-1), (d * c2w[:3, 3]).sum(-1), c2w[:3, 3] @ c2w[:3, 3] - 0.25
    root = b * b - a * c
    clear = root > 0.05
    np.testing.assert_allclose(depth[clear], (-b - np.sqrt(np.maximum(root, 0)))[clear] / a[clear], atol=1e-3)
    assert (face[root < -0.02] == -1).all()
    assert (depth[root < -0.02] == 0).all()


def test_solving_for_every_ray_and_triangle_agrees() -> None:
    rng = np.random.default_rng(5)
    soup = rng.normal(size=(40, 3)).astype(np.float32)
    mesh = Mesh(soup, rng.random((6, 40)).argsort(1)[:, :3].astype(np.int32))
    c2w = look((1, 0.2, 0.1), (-1.5, 0, 0))
    depth, face = rasterize(mesh, CAMERA, c2w)
    d = rays(CAMERA, c2w)[:, None, :, None]  # [H, 1, W, 1, 3]
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).transpose(1, 0, 2)[:, :, None]
    system = np.stack(np.broadcast_arrays(d[:, 0], (a - b)[:, 0], (a - c)[:, 0]), -1)  # [H, W, F, 3, 3]
    z, u, v = np.moveaxis(np.linalg.solve(system, (a[:, 0] - c2w[:3, 3])[..., None])[..., 0], -1, 0)
    z[(u < 0) | (v < 0) | (u + v > 1) | (z < 0.01)] = np.inf
    expected = np.where(np.isfinite(z.min(-1)), z.min(-1), 0)
    assert 0.2 < (expected > 0).mean() < 0.95
    np.testing.assert_allclose(depth, expected, rtol=1e-5)
    np.testing.assert_array_equal(face, np.where(expected > 0, z.argmin(-1), -1))


def test_front_only_shows_what_lies_behind_a_back_face() -> None:
    ball = from_trimesh(trimesh.creation.icosphere(3, 0.5))
    inverted = Mesh(ball.vertices, ball.faces[:, ::-1].copy())
    c2w = look((1, 0, 0), (-2, 0, 0))
    both, outer, inner = (
        rasterize(m, CAMERA, c2w, front_only=f)[0][30, 40]
        for m, f in ((inverted, False), (ball, True), (inverted, True))
    )
    assert both == outer == pytest.approx(1.5, abs=0.01)
    assert inner == pytest.approx(2.5, abs=0.01)


def test_an_empty_mesh_renders_nothing() -> None:
    depth, face = rasterize(Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)), CAMERA, np.eye(4))
    assert not depth.any()
    assert (face == -1).all()


# ---- samples and triangles ------------------------------------------------------------------------------------------


def test_samples_are_spread_by_area() -> None:
    mesh = room((4, 1, 1))
    points = sample_surface(mesh, 100_000, np.random.default_rng(0))
    on_ends = np.isclose(np.abs(points[:, 0]), 2).mean()
    assert on_ends == pytest.approx(2 / 18, abs=0.005)
    assert points.mean(0) == pytest.approx([0, 0, 0], abs=0.02)


@pytest.mark.parametrize("edge", [0.1, 0.4, 10.0])
def test_subdividing_keeps_area_orientation_and_place(edge: float) -> None:
    mesh = room()
    fine = subdivided(mesh, edge)
    solid, before = (trimesh.Trimesh(m.vertices, m.faces, process=False) for m in (fine, mesh))
    assert np.linalg.norm(np.diff(solid.triangles[:, [0, 1, 2, 0]], axis=1), axis=2).max() <= edge + 1e-6
    assert solid.area == pytest.approx(before.area, rel=1e-5)
    assert solid.volume == pytest.approx(before.volume, rel=1e-5)
    np.testing.assert_array_equal(mesh.vertices, before.vertices)


# ---- distances ------------------------------------------------------------------------------------------------------


def samples_within_5_cm(samples: int) -> float:
    """How often (per cent) one of that many random samples of ``room()`` lies within 5 cm of a given place on it."""
    return 100 * (1 - np.exp(-samples / 59 * np.pi * 0.05**2))


def test_a_surface_is_as_near_to_itself_as_its_samples_are_dense() -> None:
    rng = np.random.default_rng(0)
    a, b = (sample_surface(room(), 50_000, rng) for _ in range(2))
    error = surface_error(a, b)
    spacing_cm = 100 * 0.5 / np.sqrt(50_000 / 59)
    assert error.accuracy_cm == pytest.approx(spacing_cm, rel=0.05)
    assert error.completion_cm == pytest.approx(spacing_cm, rel=0.05)
    assert error.completion_ratio == pytest.approx(samples_within_5_cm(50_000), abs=0.3)
    same = surface_error(a, a)
    assert (same.accuracy_cm, same.completion_cm, same.completion_ratio) == (0, 0, 100)


@pytest.mark.slow
def test_walls_moved_by_three_centimetres_are_three_centimetres_away() -> None:
    rng = np.random.default_rng(0)
    small = (1.0, 0.8, 0.7)
    error = surface_error(sample_surface(room(small, 0.03), 200_000, rng), sample_surface(room(small), 200_000, rng))
    assert error.accuracy_cm == pytest.approx(3, rel=0.05)
    assert error.completion_cm == pytest.approx(3, rel=0.05)
    assert error.completion_ratio == 100
    far = surface_error(sample_surface(room(small, 0.06), 50_000, rng), sample_surface(room(small), 50_000, rng))
    assert far.completion_ratio == 0


def test_a_missing_half_shows_in_completion_only() -> None:
    rng = np.random.default_rng(0)
    whole = sample_surface(room(), 50_000, rng)
    error = surface_error(whole[whole[:, 0] > 0], whole)
    assert error.accuracy_cm == 0
    assert error.completion_cm > 20
    assert error.completion_ratio == pytest.approx(51, abs=2)


@settings(max_examples=4)
@given(SEEDS)
def test_registration_undoes_a_small_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    target = sample_surface(room(), 20_000, rng)
    off = Similarity(Rotation.from_rotvec(rng.uniform(-0.01, 0.01, 3)).as_matrix(), rng.uniform(-0.02, 0.02, 3))
    source = off.apply(sample_surface(room(), 20_000, rng))
    found = register(source, target)
    assert np.abs(found.apply(off.apply(target)) - target).max() < 0.008


# ---- what was seen --------------------------------------------------------------------------------------------------


def test_only_the_half_that_was_looked_at_is_kept() -> None:
    mesh = subdivided(room(), 0.05)
    poses = np.stack([look((1, y, z)) for y in np.linspace(-1, 1, 5) for z in np.linspace(-0.5, 0.5, 3)])
    kept = culled(mesh, observed(mesh.vertices, poses, CAMERA, rendered_depth(mesh, poses, CAMERA)))
    x = kept.vertices[kept.faces].mean(1)[:, 0]
    assert 0.3 < len(kept.faces) / len(mesh.faces) < 0.7
    assert x.min() > -1
    assert (
        np.isclose(x, 2, atol=1e-4).sum()
        > 0.9 * np.isclose(mesh.vertices[mesh.faces].mean(1)[:, 0], 2, atol=1e-4).sum()
    )


def test_what_is_hidden_behind_a_wall_is_dropped_and_what_is_near_the_surface_is_kept() -> None:
    depth = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    depth[:, :40] = 0
    points = np.array([[0.5, 0, 1.0], [0.5, 0, 2.02], [0.5, 0, 2.04], [-0.5, 0, 1.0], [0.5, 0, -1.0], [9, 0, 1.0]])
    seen = observed(points, np.eye(4)[None], CAMERA, lambda index: depth)
    assert seen.tolist() == [True, True, False, False, False, False]
    free = observed(points, np.eye(4)[None], CAMERA, lambda index: depth, np.array([-0.1, -0.1, 0.1, 1, 1, 1]))
    assert free.tolist() == [True, False, True, False, False, False]


def test_a_point_is_judged_by_the_pixel_it_falls_nearest_to() -> None:
    depth = np.full((CAMERA.height, CAMERA.width), 1.0, np.float32)
    depth[30, 40], depth[31, 40], depth[30, 41] = 3, 5, 5
    pixels = np.array([[39.6, 29.6], [40.4, 30.4], [40.6, 30.4], [40.4, 30.6], [39.4, 30.0]])
    points = 4 * np.column_stack([(pixels - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones(5)])
    seen = observed(points, np.eye(4)[None], CAMERA, lambda index: depth)
    assert seen.tolist() == [False, False, True, True, False]


def test_frames_are_spread_over_the_finite_poses() -> None:
    poses = np.tile(np.eye(4), (1000, 1, 1))
    poses[100:200] = np.nan
    chosen = spread_frames(poses, 50)
    assert len(chosen) == 50
    assert chosen[0] == 0
    assert chosen[-1] == 999
    assert not ((chosen >= 100) & (chosen < 200)).any()
    assert len(spread_frames(poses, 5000)) == 900


# ---- Depth L1 -------------------------------------------------------------------------------------------------------


def views(n: int = 12) -> np.ndarray:
    rng = np.random.default_rng(0)
    up = np.array([0, 0, 1.0])
    return random_views(viewpoint_candidates(np.array([[-2, -1.5, -1.25], [2, 1.5, 1.25]]), up, n, rng), up, rng)


def test_depth_differs_by_the_offset_of_a_plane() -> None:
    def plane(x: float) -> Mesh:
        corners = np.array([[x, -9, -9], [x, 9, -9], [x, 9, 9], [x, -9, 9]], np.float32)
        return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))

    error = depth_l1(plane(2.01), plane(2.0), np.ones(2, bool), look((1, 0, 0))[None], 1, intrinsics=CAMERA)
    assert error is not None
    assert error.cm == pytest.approx(1, rel=1e-3)


def test_equal_meshes_have_equal_depth_and_a_missing_one_costs_the_whole_depth() -> None:
    mesh, seen = room(), np.ones(12, bool)
    same = depth_l1(mesh, mesh, seen, views(), 12)
    assert same is not None
    assert (same.cm, same.views) == (0, 12)
    gone = depth_l1(part(mesh, np.zeros(12, bool)), mesh, seen, views(1), 1)
    assert gone is not None
    depth, _ = rasterize(mesh, Intrinsics(300, 300, 249.5, 249.5, 500, 500), views(1)[0])
    assert gone.cm == pytest.approx(100 * depth.mean(), rel=1e-5)


def test_views_of_what_no_camera_saw_are_left_out() -> None:
    mesh = room()
    assert depth_l1(mesh, mesh, np.zeros(12, bool), views(), 12, intrinsics=CAMERA) is None
    few = depth_l1(mesh, mesh, mesh.vertices[mesh.faces][..., 0].min(1) > 0, views(40), 40, intrinsics=CAMERA)
    assert few is not None
    assert 0 < few.views < 40


def test_views_lie_in_the_middle_of_the_box_and_stand_upright() -> None:
    poses = views(500)
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (500, 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1)
    assert (poses[:, 2, 1] <= 1e-9).all()
    assert np.abs(poses[:, :3, 3]).max(0) == pytest.approx([1.4, 1.05, 0.375], rel=0.05)
    assert up_direction(poses) == pytest.approx([0, 0, 1], abs=0.1)


# ---- everything -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_that_is_right_gets_full_marks_and_the_same_ones_again() -> None:
    done: list[float] = []
    first = evaluate_run(room(), room(), CAMERA, turning(), samples=20_000, views=10, progress=done.append)
    assert first["depth_l1_cm"] is not None
    assert first["depth_l1_cm"] < 0.1
    assert first["accuracy_cm"] == pytest.approx(100 * 0.5 / np.sqrt(20_000 / 59), rel=0.05)
    assert first["completion_ratio"] == pytest.approx(samples_within_5_cm(20_000), abs=2)
    assert done == sorted(done)
    assert done[-1] == 1
    assert evaluate_run(room(), room(), CAMERA, turning(), samples=20_000, views=10) == first


@pytest.mark.slow
def test_a_world_that_is_slightly_off_is_registered_first() -> None:
    off = Similarity(Rotation.from_euler("z", 0.5, degrees=True).as_matrix(), np.array([0.02, -0.03, 0.01]))
    mesh = room()
    shifted = Mesh(off.apply(mesh.vertices).astype(np.float32), mesh.faces)
    aligned, raw = (
        evaluate_run(shifted, mesh, CAMERA, turning(), samples=20_000, views=10, align=a) for a in (True, False)
    )
    assert aligned["depth_l1_cm"] is not None
    assert raw["depth_l1_cm"] is not None
    assert aligned["depth_l1_cm"] < 0.5 < 1.5 < raw["depth_l1_cm"]


def joined(*meshes: Mesh) -> Mesh:
    solid = trimesh.util.concatenate([trimesh.Trimesh(m.vertices, m.faces, process=False) for m in meshes])
    return from_trimesh(solid)


def box(size: tuple[float, float, float]) -> Mesh:
    return from_trimesh(trimesh.creation.box(size))


def test_depth_is_compared_from_free_places_and_not_from_inside_of_furniture() -> None:
    """What lies inside of a cupboard costs nothing: nobody can see it. Most of the middle of this room is cupboard."""
    cupboard = box((0.19, 0.5, 0.19))
    walls = room((1.0, 0.8, 0.7))
    places = [(x, y, z) for x in (-0.4, 0.4) for y in (-0.3, 0.3) for z in (-0.25, 0.25)]
    poses = np.stack([look((np.cos(a), np.sin(a), -2 * p[2]), p) for p in places for a in np.arange(0, 6, 1.0)])
    reference, estimate = joined(walls, cupboard), joined(walls, cupboard, box((0.1, 0.4, 0.1)))
    found = evaluate_run(estimate, reference, CAMERA, poses, samples=2000, views=24, align=False)
    assert found["depth_l1_cm"] is not None
    assert found["depth_l1_cm"] < 0.01


def test_what_no_camera_had_in_its_picture_costs_nothing() -> None:
    """All cameras look outwards, so none of them has the middle of the room in its frustum."""
    walls = room((1.0, 0.8, 0.7))
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    out = np.stack(
        [
            look((np.cos(a), np.sin(a), t), (0.15 * np.cos(a), 0.15 * np.sin(a), 0))
            for a in angles
            for t in (-0.7, 0, 0.7)
        ]
    )
    found = evaluate_run(joined(walls, box((0.1, 0.1, 0.1))), walls, CAMERA, out, samples=2000, views=24, align=False)
    assert found["depth_l1_cm"] is not None
    assert found["depth_l1_cm"] < 0.01
    inwards = out.copy()
    inwards[:, :3, 3] *= -2
    seen = evaluate_run(
        joined(walls, box((0.1, 0.1, 0.1))), walls, CAMERA, inwards, samples=2000, views=24, align=False
    )
    assert seen["depth_l1_cm"] is not None
    assert seen["depth_l1_cm"] > 0.1


def test_nothing_to_measure() -> None:
    empty = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    result = evaluate_run(empty, room(), CAMERA, turning(6), samples=100, views=1)
    assert list(result.values()) == [None] * 4
    with pytest.raises(InputError, match="no true pose"):
        evaluate_run(room(), room(), CAMERA, np.full((3, 4, 4), np.nan))
    with pytest.raises(InputError, match="reference mesh is empty"):
        evaluate_run(room(), empty, CAMERA, turning(6))
    far = turning(6)
    far[:, :3, 3] = 100
    with pytest.raises(InputError, match="see nothing of the reference"):
        evaluate_run(room(), room(), CAMERA, far[:1])
