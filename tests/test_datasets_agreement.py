"""`check` on ground truth that contradicts the depth: it says which convention the poses seem to have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ecslam.datasets import open_sequence
from ecslam.datasets.agreement import odd_truth
from ecslam.datasets.check import check_sequence
from ecslam.types import Frame

ROOM = open_sequence("synthetic/studio?size=80x60")
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
TURNED = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


class Spoilt:
    """The studio with other poses and a factor on its depth."""

    def __init__(self, poses: np.ndarray | None, depth: float = 1.0) -> None:
        self._poses, self._depth = poses, depth

    def __getattr__(self, name: str) -> object:
        return getattr(ROOM, name)

    def __len__(self) -> int:
        return len(ROOM)

    def __getitem__(self, index: int) -> Frame:
        return replace(ROOM[index], depth=ROOM[index].depth * np.float32(self._depth))

    def poses_gt(self) -> np.ndarray | None:
        return self._poses


def millimetres() -> np.ndarray:
    poses = ROOM.poses_gt().copy()
    poses[:, :3, 3] *= 1000
    return poses


def other_quaternions() -> np.ndarray:
    """Written as w x y z, read as x y z w."""
    poses = ROOM.poses_gt().copy()
    wxyz = np.roll(Rotation.from_matrix(poses[:, :3, :3]).as_quat(), 1, axis=1)
    poses[:, :3, :3] = Rotation.from_quat(wxyz).as_matrix()
    return poses


@pytest.mark.parametrize(
    ("says", "room"),
    [
        ("world-to-camera", Spoilt(np.linalg.inv(ROOM.poses_gt()))),
        ("OpenGL's", Spoilt(ROOM.poses_gt() @ OPENGL)),
        ("OpenGL's views", Spoilt(np.linalg.inv(ROOM.poses_gt() @ OPENGL))),
        ("millimetres", Spoilt(millimetres())),
        ("qw qx qy qz", Spoilt(other_quaternions())),
        ("5 times as much", Spoilt(ROOM.poses_gt(), 0.2)),
        ("a fifth", Spoilt(ROOM.poses_gt(), 5.0)),
        ("10 times as much", Spoilt(ROOM.poses_gt(), 0.1)),
        ("a tenth", Spoilt(ROOM.poses_gt(), 10.0)),
        ("wrong poses", Spoilt(ROOM.poses_gt() @ TURNED)),
    ],
)
def test_what_would_make_ground_truth_and_depth_agree_is_said(says: str, room: Spoilt) -> None:
    assert says in odd_truth(room)
    assert any(says in text for text in check_sequence(room, samples=4).odd)


@pytest.mark.parametrize("poses", [ROOM.poses_gt(), None, np.full((len(ROOM), 4, 4), np.nan)])
def test_ground_truth_that_fits_or_is_not_there_is_not_odd(poses: np.ndarray | None) -> None:
    assert odd_truth(Spoilt(poses)) == ""
