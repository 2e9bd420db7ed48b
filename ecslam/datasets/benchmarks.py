"""Recordings in TUM's layout whose camera and ground truth are known, told by the names of folders and files.

TUM: its page on file formats and intrinsics. Bonn: the data set's page; the markers there are no camera, and their
matrix to it carries a scale of 1.059, which a motion cannot have. ICL-NUIM: its page on codes; images and poses of the
PNG archives have one numbering, image 0 is without a pose, and camera and world have y up and are left-handed, which
mirroring both mends.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..types import Intrinsics

ICL_TRUTH = "*.gt.freiburg"
KINECT_READOUT_S = 0.03  # of the depth of a Kinect v1 or an Xtion


@dataclass(frozen=True)
class Benchmark:
    """frames_per_s: where times are frame numbers, else 0. before, after [4, 4]: before @ T @ after is camera-to-world,
    OpenCV's axes, for T of the ground truth's file."""

    camera: Intrinsics
    layout: str = "tum"
    preset: str = "tum"
    frames_per_s: float = 0.0
    before: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    after: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))


def _kinect(fx: float, fy: float, cx: float, cy: float, distortion: tuple[float, ...] = ()) -> Intrinsics:
    return Intrinsics(fx, fy, cx, cy, 640, 480, distortion, KINECT_READOUT_S)


def _rigid(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4, 4] with the nearest rotation in place of a scaled one."""
    left, _, right = np.linalg.svd(matrix[:3, :3])
    out = matrix.copy()
    out[:3, :3] = left @ right
    return out


TO_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # and back
MARKERS = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0, 0, 0, 1],
    ]
)
MIRROR = np.diag([1.0, -1, 1, 1])

FREIBURG = r"(?<![a-z])(?:fr|freiburg)[_-]?{}(?!\d)"
ICL = Benchmark(
    Intrinsics(481.2, 480.0, 319.5, 239.5, 640, 480), "icl", "lite", frames_per_s=30.0, before=MIRROR, after=MIRROR
)
KNOWN = {
    FREIBURG.format(1): Benchmark(
        _kinect(517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    ),
    FREIBURG.format(2): Benchmark(
        _kinect(520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    ),
    FREIBURG.format(3): Benchmark(_kinect(535.4, 539.2, 320.1, 247.6)),
    r"rgbd_bonn_": Benchmark(
        _kinect(542.822841, 542.57687, 315.59352, 237.756098, (0.039903, -0.099343, -0.00073, -0.000144)),
        before=TO_ROS,
        after=TO_ROS @ _rigid(MARKERS),
    ),
    r"traj\d\w*_frei": ICL,
}


def benchmark(folder: Path, header: str) -> Benchmark | None:
    """Which one a folder is of; header: the comments of its list of images. None where that cannot be told."""
    if any(folder.glob(ICL_TRUTH)):
        return ICL
    texts = (folder.name.lower(), header.lower())
    return next((known for text in texts for pattern, known in KNOWN.items() if re.search(pattern, text)), None)
