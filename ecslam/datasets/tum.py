"""TUM RGB-D: rgb.txt and depth.txt, lists of time-stamped images (depth 5000 = 1 m), and groundtruth.txt."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..types import InputError, Intrinsics
from .files import FileSequence
from .reading import INTRINSICS_FILE, find_intrinsics, read_text, same_size

MAX_DIFFERENCE_S = 0.02
DEPTH_SCALE = 5000.0

# Calibration of the colour cameras, from the data set's page on file formats and intrinsics.
CAMERAS = {
    "1": Intrinsics(517.3, 516.5, 318.6, 255.3, 640, 480, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": Intrinsics(520.9, 521.0, 325.1, 249.7, 640, 480, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": Intrinsics(535.4, 539.2, 320.1, 247.6, 640, 480),
}
UNKNOWN_CAMERA = Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)


def sniff(path: Path) -> bool:
    """Whether the folder has rgb.txt and depth.txt."""
    return (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()


def open(path: Path) -> FileSequence:
    """Open the folder. Raises InputError.

    Depth is registered to colour, so both are undistorted alike. A frame has the time of its depth image, for depth
    decides the pose: on freiburg1_xyz ground truth at the times of the depth images makes surfaces of different frames
    fit to 14 mm, at those of the colour images (12 ms later) to 21 mm.
    """
    color_times, color_files = _read_list(path / "rgb.txt")
    depth_times, depth_files = _read_list(path / "depth.txt")
    pairs = associate(color_times, depth_times, MAX_DIFFERENCE_S)
    if len(pairs) == 0:
        raise InputError(
            f"{path}: no colour and depth image lie within 20 ms of each other; do both lists count seconds, "
            "on one clock?"
        )
    color_files, depth_files = [color_files[i] for i in pairs[:, 0]], [depth_files[i] for i in pairs[:, 1]]
    _require(path, [*color_files, *depth_files])
    size = same_size(color_files, depth_files)
    camera, camera_notes = _camera(path, size)
    times = depth_times[pairs[:, 1]]
    poses, pose_notes = _ground_truth(path / "groundtruth.txt", times)
    dropped = (len(color_times) - len(pairs), len(depth_times) - len(pairs))
    notes = (f"{dropped[0]} colour and {dropped[1]} depth images have no partner within 20 ms and are left out",)
    return FileSequence(
        name=path.name,
        layout="tum",
        preset="tum",
        intrinsics=camera,
        color_files=color_files,
        depth_files=depth_files,
        depth_scale=DEPTH_SCALE,
        times=times,
        poses=poses,
        color_size=size,
        notes=(*(notes if any(dropped) else ()), *camera_notes, *pose_notes),
    )


def associate(a: NDArray[np.float64], b: NDArray[np.float64], limit: float) -> NDArray[np.int64]:
    """Index pairs [M, 2], one-to-one, of times at most ``limit`` seconds apart; the closest pair is joined first.

    Neither list need be sorted; the pairs come in the order of ``a``.
    """
    order = np.argsort(b, kind="stable")
    low, high = np.searchsorted(b[order], a - limit, "left"), np.searchsorted(b[order], a + limit, "right")
    i = np.repeat(np.arange(len(a)), high - low)
    j = order[np.array([k for s, e in zip(low, high, strict=True) for k in range(s, e)], np.int64)]
    free_a, free_b = np.ones(len(a), bool), np.ones(len(b), bool)
    pairs = []
    for k in np.argsort(np.abs(a[i] - b[j]), kind="stable"):
        if free_a[i[k]] and free_b[j[k]]:
            free_a[i[k]] = free_b[j[k]] = False
            pairs.append((i[k], j[k]))
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)


def interpolate_poses(
    known: NDArray[np.float64], trajectory: NDArray[np.float64], times: NDArray[np.float64], limit: float
) -> NDArray[np.float64]:
    """Poses [N, 4, 4] at ``times`` from a trajectory [M, 7] (x y z qx qy qz qw) at ascending distinct times ``known``.

    Linear in position and slerp in rotation between two neighbours within ``limit`` seconds; else the nearest one
    within ``limit``; else NaN.
    """
    from scipy.spatial.transform import (  # half a second to import, which other layouts need not wait for
        Rotation,
        Slerp,
    )

    right = np.searchsorted(known, times).clip(0, len(known) - 1)
    left = np.where(known[right] > times, right - 1, right).clip(0)
    far_left, far_right = np.abs(known[left] - times) > limit, np.abs(known[right] - times) > limit
    nearest = np.where(np.abs(known[left] - times) <= np.abs(known[right] - times), left, right)
    at = np.where(far_left | far_right, known[nearest], times).clip(known[0], known[-1])
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    for axis in range(3):
        poses[:, axis, 3] = np.interp(at, known, trajectory[:, axis])
    rotations = Rotation.from_quat(trajectory[:, 3:])
    poses[:, :3, :3] = (
        Slerp(known, rotations)(at) if len(known) > 1 else rotations[np.zeros(len(at), int)]
    ).as_matrix()
    poses[far_left & far_right] = np.nan
    return poses


def _rows(path: Path, columns: int) -> list[list[str]]:
    """The first ``columns`` fields of each line that is no comment. Raises InputError."""
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        fields = line.split("#")[0].replace(",", " ").split()
        if fields and len(fields) < columns:
            raise InputError(f"{path}: line {number} has {len(fields)} of {columns} fields; complete or remove it")
        if fields:
            rows.append(fields[:columns])
    if not rows:
        raise InputError(f"{path}: lists nothing; it needs lines of {columns} fields, the first a time in seconds")
    return rows


def _numbers(rows: list[list[str]], path: Path) -> NDArray[np.float64]:
    try:
        values = np.array(rows, np.float64)
    except ValueError:
        raise InputError(
            f"{path}: holds something that is not a number where one is due; correct or remove that line"
        ) from None
    return values


def _read_list(path: Path) -> tuple[NDArray[np.float64], list[Path]]:
    rows = _rows(path, 2)
    times = _numbers([row[:1] for row in rows], path)[:, 0]
    if not np.isfinite(times).all():
        raise InputError(f"{path}: a time is not finite; correct or remove that line")
    return times, [path.parent / row[1] for row in rows]


def _require(folder: Path, files: list[Path]) -> None:
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise InputError(
            f"{folder}: {len(missing)} listed images are missing, the first is {missing[0]}; "
            "copy them there or take their lines out"
        )


def _camera(path: Path, size: tuple[int, int]) -> tuple[Intrinsics, tuple[str, ...]]:
    """Which of the three cameras it was, told by the folder's name or the header of rgb.txt."""
    header = "".join(line for line in read_text(path / "rgb.txt").splitlines()[:10] if line.startswith("#"))
    matches = (re.search(r"(?<![a-z])(?:fr|freiburg)[_-]?([123])(?!\d)", text.lower()) for text in (path.name, header))
    known = next((CAMERAS[match[1]] for match in matches if match), None)
    camera, notes = find_intrinsics([path], known or UNKNOWN_CAMERA, size)
    if known is None and not (path / INTRINSICS_FILE).is_file():
        notes = (
            *notes,
            f"a standard Kinect is assumed: no {INTRINSICS_FILE}, and no freiburg1, 2 or 3 in the folder's name",
        )
    return camera, notes


def _ground_truth(path: Path, times: NDArray[np.float64]) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    if not path.is_file():
        return None, ()
    rows = _numbers(_rows(path, 8), path)
    usable = rows[np.isfinite(rows).all(1) & (np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1) < 0.1)]
    if len(usable) == 0:
        raise InputError(
            f"{path}: no line is a pose (time x y z qx qy qz qw with a unit quaternion); correct or remove it"
        )
    known, first = np.unique(usable[:, 0], return_index=True)
    poses = interpolate_poses(known, usable[first, 1:], times, MAX_DIFFERENCE_S)
    missing = int(np.isnan(poses[:, 0, 0]).sum())
    notes = (f"{missing} of {len(times)} frames have no ground truth within 20 ms",) if missing else ()
    if len(usable) < len(rows):
        notes = (*notes, f"{len(rows) - len(usable)} lines of {path.name} are not poses and are left out")
    return poses, notes
