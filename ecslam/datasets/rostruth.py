"""Ground truth from the transforms of a recording of ROS: from ``world`` to the camera, link by link."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .reading import rigid
from .rosfiles import printable
from .rosframes import LOOKED_AT, Links, chain, links_of, moves, poses_at
from .rosmessages import Recording

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


def true_poses(
    recording: Recording, camera: str, times: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Poses [N, 4, 4] of the frame ``camera`` in the world at ``times``, NaN where unknown, and notes; None where no
    transforms lead there, or some of them are estimates."""
    for most in (LOOKED_AT, None):  # few tell that there is none
        links = links_of(recording, most)
        frames = chain(links, camera)
        if frames[-1] not in WORLDS or any(word in frame for frame in frames for word in ESTIMATED):
            return None, _why_none(recording, links, frames)
    return rigid(poses_at(links, frames, times))


def _why_none(recording: Recording, links: Links, frames: list[str]) -> tuple[str, ...]:
    """What moves the camera and is no ground truth; the camera's mount does not."""
    others = sorted(topic for topic, kind in recording.types.items() if kind in POSES)
    if any(moves(links[child][1]) for child in frames[:-1]):
        others.append(f"transforms from {printable(frames[-1])}")
    note = f"{', '.join(others[-4:])}: no ground truth, which takes transforms from world to the camera"
    return (note,) if others else ()
