"""Whether the ground truth moves the camera as the depth says: poses in another convention look fine by themselves."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..indices import evenly
from ..types import Frame, FrameError, Intrinsics, Sequence
from .reading import OPENGL, finite_poses

PAIRS, FARTHEST = 8, 30  # pairs of frames looked at, and how many frames may lie between
MOVED_M, TURNED_DEG = 0.1, 6.0  # either is enough
STRIDE, LEAST_POINTS = 8, 50
BETTER, WORTH, MUCH = 0.5, 0.005, 0.04  # Kinect recordings with their own poses have under 0.01
NOWHERE = "by the ground truth, no two frames looked at saw the same"

Poses = NDArray[np.float64]


class Reading(NamedTuple):
    """A way to read the files. meaning: completes "by so much less if". stretch: what the camera's steps are multiplied
    by. w_first: quaternions that were taken for x y z w are w x y z."""

    meaning: str
    inverted: bool = False
    axes: Poses = np.eye(4)
    stretch: float = 1.0
    w_first: bool = False

    def move(self, poses: Poses) -> Poses:
        """From the camera of the first of two poses [2, 4, 4] to that of the second, [4, 4]."""
        if self.w_first:
            poses = _reordered(poses)
        first, second = (np.linalg.inv(poses) if self.inverted else poses) @ self.axes
        out: Poses = np.linalg.inv(second) @ first
        out[:3, 3] *= self.stretch
        return out


def _reordered(poses: Poses) -> Poses:
    """Poses [N, 4, 4] with the rotations that their quaternions are in the order w x y z."""
    from scipy.spatial.transform import Rotation

    out = poses.copy()
    out[:, :3, :3] = Rotation.from_quat(
        np.roll(Rotation.from_matrix(poses[:, :3, :3]).as_quat(), -1, axis=1)
    ).as_matrix()
    return out


AS_IT_IS = Reading("")
OTHERS = (
    Reading("poses were inverted, for they seem to be world-to-camera", inverted=True),
    Reading("y and z axes of the poses were negated, for they seem to be OpenGL's", axes=OPENGL),
    Reading("poses were inverted, then y and z axes negated, for they seem to be OpenGL's views", True, OPENGL),
    Reading("poses were in metres, for they seem to be in millimetres", stretch=1e-3),
    Reading("quaternions were qw qx qy qz, for they seem not to be qx qy qz qw", w_first=True),
    Reading("depth were 5 times as much: a wrong depth scale", stretch=0.2),
    Reading("depth were a fifth: a wrong depth scale", stretch=5.0),
    Reading("depth were 10 times as much: a wrong depth scale", stretch=0.1),
    Reading("depth were a tenth: a wrong depth scale", stretch=10.0),
)


def odd_truth(sequence: Sequence) -> str:
    """What is odd about ground truth and depth taken together, or "". Reads a few pairs of frames."""
    poses = sequence.poses_gt()
    if poses is None:
        return ""
    views = list(_views(sequence, poses))
    given, *others = (_misfit(views, sequence.intrinsics, reading) for reading in (AS_IT_IS, *OTHERS))
    least = min(others)
    misses = f"by the ground truth, what two frames measured differs by {given:.1%}" if np.isfinite(given) else NOWHERE
    if least < min(BETTER * given, given - WORTH):
        return f"{misses}, by {least:.1%} if {OTHERS[others.index(least)].meaning}"
    return f"{misses}: wrong poses, intrinsics or depth scale?" if MUCH < given < np.inf else ""


def _views(sequence: Sequence, poses: Poses) -> Iterator[tuple[Frame, Frame, Poses]]:
    """Pairs of frames that see much the same from somewhat different places, and their poses [2, 4, 4]."""
    good = np.flatnonzero(finite_poses(poses))
    for first in good[evenly(len(good), PAIRS + 1)]:
        later = good[(good > first) & (good <= first + FARTHEST)]
        moved = np.linalg.norm(poses[later, :3, 3] - poses[first, :3, 3], axis=1) > MOVED_M
        traces = (poses[later, :3, :3] * poses[first, :3, :3]).sum((1, 2))
        turned = traces < 1 + 2 * np.cos(np.radians(TURNED_DEG))
        if not (moved | turned).any():
            continue
        second = later[(moved | turned).argmax()]
        try:
            yield sequence[int(first)], sequence[int(second)], poses[[first, second]]
        except FrameError:
            continue


def _misfit(views: list[tuple[Frame, Frame, Poses]], camera: Intrinsics, reading: Reading) -> float:
    """The median share by which the depth of the second frame of each pair differs from what the first one measured;
    infinite where hardly anything is seen in both."""
    found = [_differences(a, b, reading.move(poses), camera) for a, b, poses in views]
    pooled = np.concatenate(found) if found else np.empty(0)
    return float(np.median(pooled)) if len(pooled) >= LEAST_POINTS else np.inf


def _differences(a: Frame, b: Frame, move: Poses, camera: Intrinsics) -> NDArray[np.float64]:
    v, u = (each.ravel() for each in np.mgrid[: camera.height : STRIDE, : camera.width : STRIDE])
    v, u = v[a.depth[v, u] > 0], u[a.depth[v, u] > 0]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))])
    x, y, z = move[:3, :3] @ (rays * a.depth[v, u]) + move[:3, 3:]
    x, y, z = x[z > 0], y[z > 0], z[z > 0]
    column, row = np.rint(camera.fx * x / z + camera.cx), np.rint(camera.fy * y / z + camera.cy)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    measured = b.depth[row[inside].astype(np.int64), column[inside].astype(np.int64)]
    return (np.abs(z[inside] - measured) / measured.clip(1e-6))[measured > 0]
