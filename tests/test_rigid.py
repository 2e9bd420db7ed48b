"""Quaternions against SciPy's, everywhere and where single formulas break down."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ecslam.rigid import best_motion, orthonormalise, polished, quaternions, rotations

HALF_TURNS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, -2, 3], [-1, 2, 2]])


@given(st.lists(st.floats(-3.2, 3.2), min_size=3, max_size=3))
def test_quaternions_are_those_of_scipy(turn):
    matrix = Rotation.from_rotvec(turn).as_matrix()[None]
    found = quaternions(matrix)
    assert np.allclose(found @ Rotation.from_matrix(matrix).as_quat(canonical=True).T, 1, atol=1e-14)
    assert found[0, 3] >= 0
    assert np.allclose(rotations(found), matrix, atol=1e-14)


@pytest.mark.parametrize("short_of_half", [0.0, 1e-9, 1e-4])
def test_half_turns(short_of_half):
    axis = HALF_TURNS / np.linalg.norm(HALF_TURNS, axis=1, keepdims=True)
    matrix = Rotation.from_rotvec((np.pi - short_of_half) * axis).as_matrix()
    assert np.allclose(rotations(quaternions(matrix)), matrix, atol=1e-14)


def test_the_length_of_a_quaternion_does_not_matter():
    turn = Rotation.from_euler("xyz", [[0.3, -1.0, 2.0]])
    assert np.allclose(rotations(1.01 * turn.as_quat()), turn.as_matrix(), atol=1e-14)


def test_none_is_none():
    assert rotations(quaternions(np.empty((0, 3, 3)))).shape == (0, 3, 3)


def test_the_nearest_rigid_motion_never_mirrors():
    turn = Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix()
    bent = np.tile(np.eye(4), (2, 1, 1))
    bent[:, :3, :3] = turn @ np.diag([1, 1, -0.1]), turn @ np.diag([1.1, 0.9, 0.2])
    assert np.allclose(orthonormalise(bent)[:, :3, :3], turn)


def test_the_best_motion_is_that_of_scipy_for_each_of_many_and_never_a_reflection():
    rng = np.random.default_rng(0)
    source, target = rng.normal(size=(2, 5, 4, 3))
    for found, a, b in zip(best_motion(source, target), source, target, strict=True):
        turn, _ = Rotation.align_vectors(b - b.mean(0), a - a.mean(0))
        assert np.allclose(found[:3, :3], turn.as_matrix())
        assert np.allclose(found[:3, :3] @ a.mean(0) + found[:3, 3], b.mean(0))
        assert found[3].tolist() == [0, 0, 0, 1]


def test_what_rounding_has_bent_is_polished_as_by_a_decomposition():
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, :3, :3] = rotations(rng.normal(size=(20, 4)))
    poses[:, :3, 3] = rng.normal(size=(20, 3))
    bent = poses.copy()
    bent[:, :3, :3] += 1e-7 * rng.normal(size=(20, 3, 3))
    np.testing.assert_allclose(polished(bent), orthonormalise(bent), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(polished(bent[3]), polished(bent)[3])
    np.testing.assert_allclose(polished(poses), poses, rtol=0, atol=1e-15)
