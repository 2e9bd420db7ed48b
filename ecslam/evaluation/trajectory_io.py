"""Trajectory files: TUM (``timestamp tx ty tz qx qy qz qw``, read and formatted) and KITTI (3x4 rows, formatted)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..rigid import orthonormalise, quaternions, rotations
from ..types import InputError

Floats = NDArray[np.float64]


def format_tum(timestamps: Floats, poses: Floats) -> str:
    """One line per pose with every digit a double has; poses that are not finite are left out.

    timestamps: [N] seconds. poses: [N, 4, 4] camera-to-world, metres. qw >= 0.
    """
    ok = np.isfinite(poses).all((1, 2))
    if not ok.any():
        return ""
    turns = quaternions(orthonormalise(poses[ok])[:, :3, :3])
    rows = np.column_stack([np.asarray(timestamps, np.float64)[ok], poses[ok, :3, 3], turns])
    return "".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist())


def format_kitti(poses: Floats) -> str:
    """One line per pose: the upper three rows of the camera-to-world matrix. poses: [N, 4, 4].

    The format knows a pose by its line number, so one that is not finite is written as ``nan``.
    """
    return "".join(" ".join(map(repr, row)) + "\n" for row in poses[:, :3].reshape(len(poses), 12).tolist())


def read_tum(path: Path) -> tuple[Floats, Floats]:
    """Timestamps [N] (seconds) and camera-to-world poses [N, 4, 4] (metres); blank lines and # comments are skipped.

    Raises InputError, naming the line, for anything but eight finite numbers, a quaternion whose length is off by more
    than 1 %, or time that does not increase; and for a file that cannot be read or holds no pose.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not a text file"
        raise InputError(f"{path}: cannot read the trajectory ({reason}); give a file in TUM format") from None
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.lstrip().startswith("#"):
            rows.append(_row(line, rows[-1][0] if rows else -np.inf, f"{path}:{number}"))
    if not rows:
        raise InputError(f"{path}: no pose in it; expected lines of 'timestamp tx ty tz qx qy qz qw'")
    table = np.array(rows)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rotations(table[:, 4:])
    poses[:, :3, 3] = table[:, 1:4]
    return table[:, 0], poses


def _row(line: str, previous: float, where: str) -> list[float]:
    try:
        row = [float(word) for word in line.split()]
    except ValueError:
        row = []
    if len(row) != 8 or not np.isfinite(row).all():
        raise InputError(
            f"{where}: expected eight numbers 'timestamp tx ty tz qx qy qz qw', found {line.strip()[:60]!r}"
        )
    length = float(np.linalg.norm(row[4:]))
    if abs(length - 1) > 0.01:
        raise InputError(f"{where}: the quaternion has length {length:.3g}, not 1; the order is qx qy qz qw")
    if row[0] <= previous:
        raise InputError(f"{where}: time does not increase ({previous!r} is followed by {row[0]!r}); sort the file")
    return row
