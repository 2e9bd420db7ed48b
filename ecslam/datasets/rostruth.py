"""Ground truth from the transforms of a recording of ROS: from ``world`` to the camera, link by link."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..indices import evenly
from ..types import FrameError
from .reading import rigid
from .rosfiles import printable
from .rosmessages import OLD_TRANSFORMS, TRANSFORMS, Recording
from .tum import MAX_DIFFERENCE_S, interpolate_poses

WORLDS = ("world", "mocap")
ESTIMATED = ("odom", "map")  # in the name of a frame
Links = dict[str, tuple[str, NDArray[np.float64]]]
POSES = tuple(
    f"{package}/msg/{name}"
    for package, names in {
        "nav_msgs": ("Odometry", "Path"),
        "geometry_msgs": ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped"),
    }.items()
    for name in names
)
LOOKED_AT = 300  # messages that tell which frame hangs on which
FIXED = 1e-6  # how little a link moves that is known at all times


def true_poses(
    recording: Recording, camera: str, times: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Poses [N, 4, 4] of the frame ``camera`` in the world at ``times``, NaN where unknown, and notes; None where no
    transforms lead there, or some of them are estimates."""
    for most in (LOOKED_AT, None):  # few tell that there is none
        links = _links(recording, most)
        frames = _chain(links, camera)
        if frames[-1] not in WORLDS or any(word in frame for frame in frames for word in ESTIMATED):
            return None, _why_none(recording, frames)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    for child in frames[:-1]:
        poses = _at(links[child][1], times) @ poses
    return rigid(poses)


def _why_none(recording: Recording, frames: list[str]) -> tuple[str, ...]:
    others = sorted(topic for topic, kind in recording.types.items() if kind in POSES)
    others += [f"transforms from {printable(frames[-1])}"] if len(frames) > 1 else []
    note = f"{', '.join(others[-4:])}: no ground truth, which takes transforms from world to the camera"
    return (note,) if others else ()


def _chain(links: Links, camera: str) -> list[str]:
    """The frames from ``camera`` upwards."""
    frames = [camera]
    while frames[-1] in links and len(frames) <= len(links):
        frames.append(links[frames[-1]][0])
    return frames


def _links(recording: Recording, most: int | None) -> Links:
    """By child: its parent, "" for several, and time x y z qx qy qz qw [M, 8] at ascending distinct times. most:
    messages of a topic to look at, spread over it."""
    found: dict[str, tuple[str, list[list[float]]]] = {}
    for topic in recording.of_type(TRANSFORMS, OLD_TRANSFORMS):
        places = recording.places[topic]
        for i in evenly(len(places), most or len(places)):
            try:
                message = recording.message(topic, places[i])
            except FrameError:
                continue
            for each in message.transforms:
                told_by = each.header.frame_id.strip("/")
                parent, rows = found.setdefault(each.child_frame_id.strip("/"), (told_by, []))
                stamp, move, turn = each.header.stamp, each.transform.translation, each.transform.rotation
                if told_by != parent:
                    found[each.child_frame_id.strip("/")] = "", rows
                else:
                    time = (10**9 * stamp.sec + stamp.nanosec) / 1e9
                    rows.append([time, move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w])
    tables = {child: (parent, _ascending(np.array(rows))) for child, (parent, rows) in found.items()}
    return {child: (parent, table) for child, (parent, table) in tables.items() if len(table)}


def _ascending(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rows that are poses, by time."""
    table = table[np.isfinite(table).all(1) & (np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1) < 0.1)]
    return table[np.unique(table[:, 0], return_index=True)[1]]


def _at(rows: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
    """A link's poses [N, 4, 4] at ``times``: the same where it never moves, else between those told nearby."""
    if np.ptp(rows[:, 1:], axis=0).max() < FIXED:
        return interpolate_poses(rows[:1, 0], rows[:1, 1:], np.full(len(times), rows[0, 0]), MAX_DIFFERENCE_S)
    return interpolate_poses(rows[:, 0], rows[:, 1:], times, MAX_DIFFERENCE_S)
