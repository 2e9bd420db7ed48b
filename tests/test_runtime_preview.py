"""The first frame as a mesh: where it was measured, its front towards the camera, torn where depth jumps."""

import numpy as np

from ecslam.datasets import open_sequence
from ecslam.runtime.preview import depth_mesh
from ecslam.types import Frame, Intrinsics

CAMERA = Intrinsics(60.0, 60.0, 31.5, 23.5, 64, 48)
TURNED = np.array([[0.0, 0, 1, 3], [-1, 0, 0, 0], [0, -1, 0, 1], [0, 0, 0, 1]])  # looks along x from (3, 0, 1)


def seen(depth: np.ndarray, c2w=TURNED):
    color = np.random.default_rng(0).integers(0, 256, (*depth.shape, 3), np.uint8)
    return depth_mesh(Frame(0, 0.0, color, depth.astype(np.float32)), CAMERA, c2w, 0.1, 5.0)


def test_a_wall_lies_where_it_was_measured_and_faces_the_camera():
    mesh = seen(np.full((48, 64), 2.0))
    assert len(mesh.vertices) == 48 * 64
    assert len(mesh.faces) == 2 * 47 * 63
    assert np.allclose(mesh.vertices[:, 0], 5.0)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 0] < 0).all()


def test_it_is_torn_where_depth_jumps_ends_or_is_out_of_range():
    depth = np.full((48, 64), 2.0)
    depth[:, 20:] = 3.0
    depth[:, 40:] = 0.0
    depth[:, 50:] = 9.0
    mesh = seen(depth)
    assert len(mesh.faces) == 2 * 47 * (19 + 19)
    assert set(np.round(mesh.vertices[:, 0], 4)) == {5.0, 6.0}


def test_a_frame_without_depth_gives_an_empty_mesh():
    assert len(seen(np.zeros((48, 64))).faces) == 0


def test_a_built_in_room_is_seen_within_its_walls():
    room = open_sequence("synthetic/studio?size=160x120&frames=4")
    frame = room[0]
    mesh = depth_mesh(frame, room.intrinsics, frame.c2w_gt, 0.1, 10.0)
    low, high = room.bounds
    assert len(mesh.faces) > 10_000
    assert (mesh.vertices > low - 0.01).all()
    assert (mesh.vertices < high + 0.01).all()
    assert len(np.unique(mesh.colors, axis=0)) > 100
