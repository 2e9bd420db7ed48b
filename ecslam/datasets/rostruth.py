"""Ground truth from the transforms of a recording of ROS: from ``world`` to the camera, link by link."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..types import FrameError
from .reading import rigid
from .rosmessages import OLD_TRANSFORMS, TRANSFORMS, Recording
from .tum import MAX_DIFFERENCE_S, interpolate_poses

WORLDS = ("world", "mocap")
ESTIMATED = ("odom", "map")  # in the name of a frame
POSES = tuple(
    f"{package}/msg/{name}"
    for package, names in {
        "nav_msgs": ("Odometry", "Path"),
        "geometry_msgs": ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped"),
    }.items()
    for name in names
)
FIXED = 1e-6  # how little a link moves that is known at all times


def true_poses(
    recording: Recording, camera: str, times: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Poses [N, 4, 4] of the frame ``camera`` in the world at ``times``, NaN where unknown, and notes; None where no
    transforms lead there, or some of them are estimates."""
    links = _links(recording)
    frames: list[str] = [camera]
    chain: list[NDArray[np.float64]] = []
    while frames[-1] in links and len(chain) < len(links):
        parent, rows = links[frames[-1]]
        frames.append(parent)
        chain.append(rows)
    if frames[-1] not in WORLDS or any(word in frame for frame in frames for word in ESTIMATED):
        others = [topic for topic, kind in recording.types.items() if kind in POSES]
        others += [f"transforms from {frames[-1]}"] if chain else []
        note = f"{', '.join(sorted(others)[:4])}: no ground truth, which takes transforms from world to the camera"
        return None, (note,) if others else ()
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    for rows in chain:
        poses = _at(rows, times) @ poses
    return rigid(poses)


def _links(recording: Recording) -> dict[str, tuple[str, NDArray[np.float64]]]:
    """By child: its parent, and time x y z qx qy qz qw [M, 8] at ascending distinct times."""
    found: dict[str, tuple[str, list[list[float]]]] = {}
    for topic in recording.of_type(TRANSFORMS, OLD_TRANSFORMS):
        for place in recording.places[topic]:
            try:
                message = recording.message(topic, place)
            except FrameError:
                continue
            for each in message.transforms:
                told_by = each.header.frame_id.strip("/")
                parent, rows = found.setdefault(each.child_frame_id.strip("/"), (told_by, []))
                stamp, move, turn = each.header.stamp, each.transform.translation, each.transform.rotation
                pose = move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w
                if told_by == parent and np.isfinite(pose).all() and abs(np.linalg.norm(pose[3:]) - 1) < 0.1:
                    rows.append([(10**9 * stamp.sec + stamp.nanosec) / 1e9, *pose])
    return {child: (parent, _ascending(rows)) for child, (parent, rows) in found.items() if rows}


def _ascending(rows: list[list[float]]) -> NDArray[np.float64]:
    table = np.array(rows)
    return table[np.unique(table[:, 0], return_index=True)[1]]


def _at(rows: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
    """A link's poses [N, 4, 4] at ``times``: the same where it never moves, else between those told nearby."""
    if np.ptp(rows[:, 1:], axis=0).max() < FIXED:
        return interpolate_poses(rows[:1, 0], rows[:1, 1:], np.full(len(times), rows[0, 0]), MAX_DIFFERENCE_S)
    return interpolate_poses(rows[:, 0], rows[:, 1:], times, MAX_DIFFERENCE_S)
