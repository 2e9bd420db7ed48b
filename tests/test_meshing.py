"""Laws of the mesher: close to the surface, closed, oriented, sparse, deterministic, cut off where nothing was seen."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from ecslam.meshing import MeshingStopped, ObservedBlocks, extract_mesh, voxel_for_budget
from ecslam.meshing_blocks import pack, unpack
from ecslam.meshing_table import EDGE_AXIS, EDGE_CORNER, TRIANGLES
from ecslam.types import Mesh

TRUNCATION_M = 0.1
CENTRE = np.array([0.31, -0.17, 0.05], np.float32)
RADIUS_M = 0.5


def sphere_sdf(points: np.ndarray) -> np.ndarray:
    return np.clip((np.linalg.norm(points - CENTRE, axis=1) - RADIUS_M) / TRUNCATION_M, -1, 1)


def box_sdf(points: np.ndarray, half: float = 0.4) -> np.ndarray:
    q = np.abs(points - CENTRE) - half
    return np.clip((np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)) / TRUNCATION_M, -1, 1)


def directions(n: int = 40_000) -> np.ndarray:
    v = np.random.default_rng(0).normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


SPHERE_POINTS = CENTRE + RADIUS_M * directions()
SPHERE = ObservedBlocks.from_points(SPHERE_POINTS, 0.08)


def as_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def test_normals_of_a_sphere_point_outwards() -> None:
    ball = trimesh.creation.icosphere(3)
    vertices = np.concatenate([ball.vertices, [[0, 0, 0]]]).astype(np.float32)
    normals = Mesh(vertices, ball.faces.astype(np.int32)).vertex_normals()
    assert np.allclose(normals[:-1], ball.vertices, atol=0.02)
    assert not normals[-1].any(), "a vertex without a face has none"


@pytest.mark.parametrize("voxel_m", [0.1, 0.05, 0.02])
def test_a_sphere_is_closed_oriented_and_where_it_should_be(voxel_m: float) -> None:
    mesh = extract_mesh(sphere_sdf, None, SPHERE, voxel_m)
    solid = as_trimesh(mesh)
    distance = np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS_M
    assert np.abs(distance).max() < voxel_m**2 / RADIUS_M
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume == pytest.approx(4 / 3 * np.pi * RADIUS_M**3, rel=0.03)
    outward = np.einsum("ij,ij->i", solid.face_normals, solid.triangles_center - CENTRE)
    assert outward.min() > 0
    assert mesh.vertices.dtype == np.float32
    assert mesh.faces.dtype == np.int32


def test_the_area_converges_with_the_square_of_the_voxel() -> None:
    true = 4 * np.pi * RADIUS_M**2
    errors = [abs(as_trimesh(extract_mesh(sphere_sdf, None, SPHERE, v)).area - true) for v in (0.1, 0.05, 0.025)]
    assert errors[0] > 3 * errors[1] > 9 * errors[2]


def test_a_box_is_closed_and_has_its_size() -> None:
    faces = np.random.default_rng(1).uniform(-0.4, 0.4, (6, 8000, 3))
    for axis in range(3):
        faces[2 * axis, :, axis], faces[2 * axis + 1, :, axis] = -0.4, 0.4
    mesh = extract_mesh(box_sdf, None, ObservedBlocks.from_points(faces.reshape(-1, 3) + CENTRE), 0.03)
    solid = as_trimesh(mesh)
    assert solid.is_watertight
    assert solid.extents == pytest.approx([0.8] * 3, abs=1e-3)
    assert solid.volume == pytest.approx(0.8**3, rel=0.01)


def test_the_surface_is_that_of_another_marching_cubes() -> None:
    """On one lattice both put their vertices on the same edges; only how they are joined may differ."""
    measure = pytest.importorskip("skimage.measure")
    voxel_m, first, count = 0.05, np.array([-8, -18, -14]), 32

    def bumpy_sdf(points: np.ndarray) -> np.ndarray:
        return sphere_sdf(points) + 0.3 * np.sin(9 * points).prod(1)

    lattice = (first + np.stack(np.meshgrid(*[np.arange(count)] * 3, indexing="ij"), -1).reshape(-1, 3)) * voxel_m
    values = bumpy_sdf(lattice.astype(np.float32)).reshape(count, count, count)
    vertices, faces, *_ = measure.marching_cubes(values, 0.0)
    theirs = trimesh.Trimesh((first + vertices) * voxel_m, faces, process=False)
    mine = as_trimesh(extract_mesh(bumpy_sdf, None, ObservedBlocks.from_points(lattice, 0.08), voxel_m))
    for a, b in ((mine, theirs), (theirs, mine)):
        assert KDTree(a.vertices).query(b.vertices)[0].max() < 1e-4
    assert mine.area == pytest.approx(theirs.area, rel=5e-3)
    assert len(mine.vertices) > 1000


def test_any_field_gives_a_closed_manifold() -> None:
    """White noise meets every case of the table in every neighbourhood, ambiguous faces among them."""
    inner = np.array([[x, y, z] for x in range(18) for y in range(18) for z in range(18)])
    observed = ObservedBlocks(1.0, np.sort(pack(inner.astype(np.int64) - 9)))

    def noise(points: np.ndarray) -> np.ndarray:
        index = np.rint(points).astype(np.int64)
        value = np.sin(index @ [12.9898, 78.233, 37.719]) * 43758.5453 % 1 - 0.5
        return np.where((index > -9).all(1) & (index < 8).all(1), value, 0.5)

    solid = as_trimesh(extract_mesh(noise, None, observed, 1.0))
    assert len(solid.faces) > 10_000
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume > 0


def test_vertices_lie_on_lattice_edges_of_the_asked_size() -> None:
    voxel_m = 0.07
    mesh = extract_mesh(sphere_sdf, None, SPHERE, voxel_m)
    off = np.abs(mesh.vertices / voxel_m - np.rint(mesh.vertices / voxel_m)) > 1e-4
    assert (off.sum(1) <= 1).all()


def test_colours_are_the_functions_at_the_vertices() -> None:
    def color(points: np.ndarray) -> np.ndarray:
        return np.clip(128 + 100 * points, 0, 255).astype(np.uint8)

    mesh = extract_mesh(sphere_sdf, color, SPHERE, 0.03)
    assert mesh.colors is not None
    assert mesh.colors.dtype == np.uint8
    np.testing.assert_array_equal(mesh.colors, color(mesh.vertices))


def test_work_grows_with_the_surface_not_with_the_volume() -> None:
    """Scaling a sphere by three multiplies its surface by 9 and its box by 27."""
    counts = []
    for scale in (1, 3):
        observed = ObservedBlocks.from_points(scale * RADIUS_M * directions(200_000), 0.08)
        seen: list[np.ndarray] = []

        def sdf(points: np.ndarray, scale: int = scale, seen: list[np.ndarray] = seen) -> np.ndarray:
            seen.append(points)
            return np.linalg.norm(points, axis=1) - scale * RADIUS_M

        extract_mesh(sdf, None, observed, 0.04)
        points = np.concatenate(seen)
        assert len(np.unique(points, axis=0)) == len(points)
        assert max(map(len, seen)) <= 1 << 17
        counts.append(len(points))
    assert counts[1] < 10 * counts[0]


def test_what_was_not_seen_is_cut_off() -> None:
    block_m, voxel_m = 0.05, 0.02
    observed = ObservedBlocks.from_points(SPHERE_POINTS[SPHERE_POINTS[:, 0] > CENTRE[0]], block_m)
    half = extract_mesh(sphere_sdf, None, observed, voxel_m)
    assert half.vertices[:, 0].min() > CENTRE[0] - 1.5 * block_m - voxel_m
    whole = as_trimesh(extract_mesh(sphere_sdf, None, SPHERE, voxel_m)).area
    assert as_trimesh(half).area == pytest.approx(whole / 2, rel=0.15)


def test_the_same_place_gives_the_same_triangles_however_much_else_was_seen() -> None:
    half = extract_mesh(sphere_sdf, None, ObservedBlocks.from_points(SPHERE_POINTS[::2], 0.08), 0.04)
    again = extract_mesh(sphere_sdf, None, ObservedBlocks.from_points(SPHERE_POINTS[::2], 0.08), 0.04)
    far = SPHERE.merged(np.array([[50.0, 0, 0]]))
    more = extract_mesh(lambda p: np.where(p[:, 0] > 40, 1.0, sphere_sdf(p)), None, far, 0.04)
    np.testing.assert_array_equal(half.vertices, again.vertices)
    np.testing.assert_array_equal(half.faces, again.faces)
    np.testing.assert_array_equal(more.vertices, extract_mesh(sphere_sdf, None, SPHERE, 0.04).vertices)


@pytest.mark.parametrize("value", [1.0, -1.0, np.nan])
def test_a_field_without_a_surface_gives_an_empty_mesh(value: float) -> None:
    mesh = extract_mesh(lambda p: np.full(len(p), value), lambda p: np.zeros((len(p), 3), np.uint8), SPHERE, 0.05)
    assert mesh.vertices.shape == (0, 3)
    assert mesh.faces.shape == (0, 3)
    assert mesh.colors is not None
    assert mesh.colors.shape == (0, 3)


def test_nothing_observed_gives_an_empty_mesh() -> None:
    mesh = extract_mesh(sphere_sdf, None, ObservedBlocks(0.08), 0.05)
    assert mesh.faces.shape == (0, 3)


def test_broken_field_values_leave_a_hole_and_no_nan() -> None:
    def broken(points: np.ndarray) -> np.ndarray:
        return np.where(points[:, 2] > CENTRE[2], np.nan, sphere_sdf(points))

    mesh = extract_mesh(broken, None, SPHERE, 0.04)
    assert len(mesh.faces) > 500
    assert np.isfinite(mesh.vertices).all()
    assert mesh.vertices[:, 2].max() <= CENTRE[2]


def test_zeros_on_the_lattice_give_no_face_without_area() -> None:
    octahedron = 0.5 * directions() / np.abs(directions()).sum(1, keepdims=True)
    observed = ObservedBlocks.from_points(octahedron, 0.08)
    mesh = extract_mesh(lambda p: np.abs(p).sum(1) - np.float32(0.5), None, observed, 0.1)
    solid = as_trimesh(mesh)
    assert solid.is_watertight
    assert solid.area_faces.min() > 0


def test_progress_rises_to_one_and_stop_is_heard() -> None:
    done: list[float] = []
    extract_mesh(sphere_sdf, None, SPHERE, 0.01, progress=done.append)
    assert done == sorted(done)
    assert len(done) > 3
    assert done[-1] == 1
    calls: list[int] = []

    def counted(points: np.ndarray) -> np.ndarray:
        calls.append(len(points))
        return sphere_sdf(points)

    with pytest.raises(MeshingStopped):
        extract_mesh(counted, None, SPHERE, 0.01, should_stop=lambda: bool(calls))
    assert len(calls) == 1


def test_the_budget_is_kept() -> None:
    fine = extract_mesh(sphere_sdf, None, SPHERE, 0.02)
    voxel_m = voxel_for_budget(0.02, len(fine.faces), 5000)
    assert 3500 < len(extract_mesh(sphere_sdf, None, SPHERE, voxel_m).faces) <= 5000
    assert voxel_for_budget(0.02, 100, 100) == voxel_for_budget(0.02, 100, 0) == 0.02


def test_every_case_of_the_table_uses_just_its_cut_edges() -> None:
    for case in range(256):
        used = TRIANGLES[case][TRIANGLES[case] >= 0]
        inside = [bool(case >> c & 1) for c in range(8)]
        cut = [
            e for e, (c, a) in enumerate(zip(EDGE_CORNER, EDGE_AXIS, strict=True)) if inside[c] != inside[c | 1 << a]
        ]
        assert sorted(set(used)) == cut


@given(st.lists(st.tuples(*[st.integers(-(2**20), 2**20 - 1)] * 3), max_size=20))
def test_keys_hold_every_block_and_sort_like_it(blocks: list[tuple[int, int, int]]) -> None:
    index = np.array(sorted(blocks), np.int64).reshape(-1, 3)
    keys = pack(index)
    np.testing.assert_array_equal(unpack(keys), index)
    assert (np.diff(keys) >= 0).all()


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0.02, 0.5))
def test_merging_piece_by_piece_is_the_same_as_at_once(seed: int, block_m: float) -> None:
    points = np.random.default_rng(seed).normal(size=(60, 3))
    at_once = ObservedBlocks.from_points(points, block_m)
    pieces = ObservedBlocks(block_m).merged(points[:7]).merged(points[7:40]).merged(points[40:]).merged(points[:20])
    np.testing.assert_array_equal(at_once.keys, pieces.keys)
    assert (np.diff(at_once.keys) > 0).all()


def test_broken_points_are_ignored() -> None:
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e9, 0, 0], [0.01, 0.01, 0.01]])
    assert len(ObservedBlocks.from_points(points, 0.08)) == 8
