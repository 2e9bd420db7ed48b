"""The synthetic rooms as sequences: paths, meshes, noise, addresses, and the copy on disk."""

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from ecslam.datasets import open_sequence
from ecslam.datasets.synthetic import ROOMS, Address, open_synthetic, parse_address, write_replica
from ecslam.datasets.synthetic.noise import BASELINE_FOCAL, DISPARITY_SIGMA, DISPARITY_STEP, kinect
from ecslam.datasets.synthetic.sequence import room
from ecslam.kernels.raster import rasterize
from ecslam.se3 import inverse, rotation_angle_deg
from ecslam.types import InputError, Intrinsics, Sequence
from tests.synthetic_oracles import distances, look_up, on_surface, points_of

SMALL: dict[str, Any] = {"width": 160, "height": 120}


@pytest.mark.parametrize("name", ROOMS)
def test_path_is_calm_closed_and_clear(name):
    poses = open_synthetic(name).poses_gt()
    assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (len(poses), 1, 1)), atol=1e-12
    )
    following = np.roll(poses, -1, axis=0)  # after the last frame comes the first
    assert np.linalg.norm(following[:, :3, 3] - poses[:, :3, 3], axis=1).max() < 0.0205
    assert rotation_angle_deg(poses, following).max() < 1.4
    bend = np.diff(poses[:, :3, 3], 2, axis=0)
    assert np.linalg.norm(bend, axis=1).max() < 0.0015
    assert distances(room(name).shapes, poses[:, :3, 3]).min() > 0.35


@pytest.mark.parametrize("name", ROOMS)
def test_all_depth_is_valid_and_within_8_metres(name):
    sequence = open_synthetic(name, 48, 36)
    for i in range(0, len(sequence), 13):
        depth = sequence[i].depth
        assert depth.min() > 0.3
        assert depth.max() < 8.0


@pytest.mark.parametrize("name", ROOMS)
def test_the_end_sees_the_start_again_and_the_middle_does_not(name):
    sequence = open_synthetic(name, **SMALL)
    count = len(sequence)
    points = points_of(sequence.intrinsics, sequence[0]).reshape(-1, 3)[::11]

    def share(i):
        inside, z, measured, _ = look_up(sequence.intrinsics, sequence[i], points)
        return (inside & (np.abs(z - measured) < 0.01 * z)).mean()

    assert share(count - 5) > 0.6
    assert share(int(0.93 * count)) > 0.2
    assert max(share(int(f * count)) for f in (0.4, 0.5, 0.6)) < 0.15


def test_more_frames_go_round_again():
    one, two = open_synthetic("studio", **SMALL), open_synthetic("studio", **SMALL, frames=640)
    assert len(one) == 300
    assert len(two) == len(two.timestamps()) == len(two.poses_gt()) == 640
    assert_array_equal(two.poses_gt()[300:600], one.poses_gt())
    assert_array_equal(two[301].color, one[1].color)
    assert two[301].index == 301
    assert_allclose(np.diff(two.timestamps()), 1 / 30)
    assert_array_equal(open_synthetic("studio", frames=7).poses_gt(), one.poses_gt()[:7])


@pytest.mark.parametrize("name", ROOMS)
def test_is_a_sequence_with_bounds(name):
    sequence = open_sequence(f"synthetic/{name}", **SMALL)
    assert isinstance(sequence, Sequence)
    assert (sequence.name, sequence.layout, sequence.preset) == (f"synthetic/{name}", "synthetic", "lite")
    points = points_of(sequence.intrinsics, sequence[len(sequence) // 3]).reshape(-1, 3)
    assert sequence.bounds is not None
    assert (points > sequence.bounds[0]).all()
    assert (points < sequence.bounds[1]).all()
    for index in (-1, len(sequence)):
        with pytest.raises(IndexError):
            sequence[index]


@pytest.mark.parametrize("name", ["studio", "corridor"])
def test_mesh_is_the_surface(name):
    sequence = open_synthetic(name, **SMALL)
    mesh, shapes = sequence.reference_mesh(), room(name).shapes
    rng = np.random.default_rng(0)
    some = mesh.vertices[rng.integers(len(mesh.vertices), size=1500)].astype(np.float64)
    away = on_surface(shapes, some)
    assert away.max() < 3.1e-4  # where a chord of a curved solid is cut
    assert np.median(away) < 1e-5
    faces = mesh.faces[rng.integers(len(mesh.faces), size=1500)]
    assert on_surface(shapes, mesh.vertices[faces].astype(np.float64).mean(1)).max() < 3.1e-4
    assert mesh.colors is not None
    assert mesh.colors.shape == mesh.vertices.shape
    assert mesh.faces.min() == 0
    assert mesh.faces.max() == len(mesh.vertices) - 1


@pytest.mark.slow
def test_mesh_covers_what_the_camera_sees_in_its_colours():
    from scipy.spatial import cKDTree

    sequence = open_synthetic("studio", **SMALL)
    mesh = sequence.reference_mesh()
    frame = sequence[60]
    points = points_of(sequence.intrinsics, frame).reshape(-1, 3)[::7]
    away, nearest = cKDTree(mesh.vertices).query(points)
    assert away.max() < 0.1
    assert mesh.colors is not None
    error = np.abs(mesh.colors[nearest].astype(float) - frame.color.reshape(-1, 3)[::7]).mean(1)
    assert np.median(error) < 15


@pytest.mark.slow
@pytest.mark.parametrize("name", ["studio", "corridor"])
def test_mesh_has_no_gaps_where_surfaces_meet(name):
    sequence = open_synthetic(name, width=320, height=240)
    mesh = sequence.reference_mesh()
    wrong = []
    for index in range(0, len(sequence), 40):
        truth = sequence[index]
        depth, _ = rasterize(mesh, sequence.intrinsics, truth.c2w_gt)
        away = np.abs(depth - truth.depth) > 0.001
        outline = cv2.morphologyEx(truth.depth, cv2.MORPH_GRADIENT, np.ones((3, 3))) > 0.05  # curved ones are chords
        wrong.append(away[~outline])
    assert np.concatenate(wrong).mean() < 5e-4


@pytest.mark.slow
def test_mesh_faces_look_out_of_solids_into_the_room():
    mesh, shapes = open_synthetic("studio").reference_mesh(), room("studio").shapes
    corner = mesh.vertices[np.random.default_rng(1).permutation(mesh.faces)[:1500]].astype(np.float64)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    middle = corner.mean(1)
    overlap = 0.0005  # at borders
    assert (distances(shapes, middle + 0.0008 * normal) > -overlap).all()
    assert (distances(shapes, middle + 0.0008 * normal) > 0).mean() > 0.98
    assert (distances(shapes, middle - 0.0008 * normal) < overlap).all()


def test_noise_grows_with_the_square_of_depth():
    camera = Intrinsics(512.0, 512.0, 319.5, 239.5, 640, 480)
    color = np.full((480, 640, 3), 120, np.uint8)
    for z in (1.0, 2.0, 3.5):
        noisy, depth = kinect(color, np.full((480, 640), z, np.float32), camera, np.random.default_rng(3))
        sigma = z * z / BASELINE_FOCAL * np.hypot(DISPARITY_SIGMA, DISPARITY_STEP / np.sqrt(12))
        assert depth[depth > 0].std() == pytest.approx(sigma, rel=0.2)
        assert depth[depth > 0].mean() == pytest.approx(z, abs=0.3 * sigma + 1e-3)
        assert (depth > 0).all()
    assert noisy.std() == pytest.approx(2.0, rel=0.1)


def test_noise_leaves_holes_at_jumps_and_grazing_surfaces():
    camera = Intrinsics(512.0, 512.0, 319.5, 239.5, 640, 480)
    rng = np.random.default_rng(0)
    color = np.zeros((480, 640, 3), np.uint8)
    step = np.full((480, 640), 2.0, np.float32)
    step[:, 320:] = 3.0
    _, depth = kinect(color, step, camera, rng)
    assert 0.2 < (depth[:, 318:322] == 0).mean() < 0.8
    assert (depth[:, :300] > 0).all()
    v = (np.arange(480)[:, None] - camera.cy) / camera.fy
    floor = np.broadcast_to(np.float32(1.5) / np.maximum(v, 1e-3), (480, 640)).astype(np.float32)
    _, depth = kinect(color, floor, camera, rng)
    slant = 1 / np.sqrt(1 + v**-2)  # cosine between a ray (0, v, 1) and the floor's normal
    row = np.flatnonzero((slant[:, 0] < 0.1) & (v[:, 0] > 0))
    assert (depth[row] == 0).all()
    assert (depth[-60:] > 0).mean() > 0.95


def test_noise_repeats_with_its_seed():
    options: dict[str, Any] = {**SMALL, "noise": True}
    a, b, other = (open_synthetic("studio", **options, seed=s) for s in (4, 4, 5))
    clean = open_synthetic("studio", **SMALL)[9]
    assert_array_equal(a[9].depth, b[9].depth)
    assert_array_equal(a[9].color, b[9].color)
    assert (a[9].depth != other[9].depth).mean() > 0.1
    assert (a[9].depth != clean.depth).mean() > 0.5
    assert_array_equal(a[9].c2w_gt, clean.c2w_gt)
    assert a[9].depth.dtype == np.float32
    assert np.isfinite(a[9].depth).all()


def test_address_options():
    wanted = Address("studio", 1200, 680, 300, True, 3)
    assert parse_address("synthetic/studio?noise=1&frames=300&size=1200x680&seed=3") == wanted
    assert parse_address("corridor") == Address("corridor")
    sequence = open_synthetic("apartment?frames=5", 320, 240, frames=9)
    assert (len(sequence), sequence.intrinsics.width) == (5, 320)


@given(
    st.builds(
        Address, st.sampled_from(ROOMS), st.integers(16, 4096), st.integers(16, 4096), st.integers(1, 10**5),
        st.booleans(), st.integers(0, 10**9), st.floats(0, 1 / 30), st.booleans(), st.floats(0, 0.9),
    )
)  # fmt: skip
def test_address_round_trip(a):
    text = f"synthetic/{a.room}?size={a.width}x{a.height}&frames={a.frames}&noise={int(a.noise)}&seed={a.seed}"
    text += f"&readout={a.readout}&visitor={int(a.visitor)}&exposure={a.exposure}"
    assert parse_address(text) == a


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("synthetic/studo", "did you mean synthetic/studio?"),
        ("synthetic/xyz", "synthetic/corridor"),
        ("synthetic/studio?nois=1", "unknown option 'nois'"),
        ("synthetic/studio?noise=yes", "noise=0|1"),
        ("synthetic/studio?visitor=me", "visitor=0|1"),
        ("synthetic/studio?exposure=2", "out of range"),
        ("synthetic/studio?exposure=yes", "exposure=SHARE"),
        ("synthetic/studio?size=640", "size=WxH"),
        ("synthetic/studio?size=8x8", "out of range"),
        ("synthetic/studio?frames=0", "out of range"),
        ("synthetic/studio?readout=1", "out of range"),
        ("synthetic/studio?readout=nan", "out of range"),
        ("synthetic/studio?readout=30ms", "readout=SECONDS"),
        ("synthetic/studio?seed=-1", "negative"),
    ],
)
def test_a_wrong_address_is_one_clear_line(address, words):
    with pytest.raises(InputError, match=r"^[^\n]+$") as error:
        open_sequence(address)
    assert words in str(error.value)


@pytest.mark.slow
def test_written_replica_reads_back(tmp_path):
    sequence = open_synthetic("studio", **SMALL, frames=3)
    calls = []
    folder = write_replica(sequence, tmp_path / "room", lambda done, total: calls.append((done, total)))
    assert calls == [(1, 3), (2, 3), (3, 3)]
    again = open_sequence(folder)
    assert (again.layout, len(again), again.intrinsics) == ("replica", 3, sequence.intrinsics)
    poses, mesh, wanted = again.poses_gt(), again.reference_mesh(), sequence.reference_mesh()
    assert poses is not None
    assert mesh is not None
    assert_allclose(inverse(poses) @ sequence.poses_gt(), np.tile(np.eye(4), (3, 1, 1)), atol=1e-9)
    for a, b in zip(again, sequence, strict=True):
        assert_allclose(a.depth, b.depth, atol=0.51 / 6553.5)
        assert np.abs(a.color.astype(int) - b.color).mean() < 3
    assert_array_equal(mesh.vertices, wanted.vertices)
    assert_array_equal(mesh.faces, wanted.faces)
    assert_array_equal(np.asarray(mesh.colors), np.asarray(wanted.colors))


def test_replica_is_not_written_over_something_else(tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(InputError, match="not empty"):
        write_replica(open_synthetic("studio", **SMALL, frames=1), tmp_path)
    with pytest.raises(InputError, match="cannot be written"):
        write_replica(open_synthetic("studio", **SMALL, frames=1), tmp_path / "mine.txt" / "room")
