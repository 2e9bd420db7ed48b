"""odometry.csv of Stray Scanner: a header, then a line a frame with its time and where ARKit thinks the camera was."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..types import InputError
from .mp4 import MOST_FRAMES
from .reading import posed, read_text, rigid

COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
LENS = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True)
class Odometry:
    """frames: [M] numbers, ascending. times: [M] seconds. poses: [M, 4, 4] camera-to-world, OpenCV's axes, in a world
    with y up; NaN where a line has none. lens: [M, 4] fx, fy, cx, cy in pixels of the video, or None. notes: on lines
    that are left out."""

    frames: NDArray[np.int64]
    times: NDArray[np.float64]
    poses: NDArray[np.float64]
    lens: NDArray[np.float64] | None
    notes: tuple[str, ...]


def read_odometry(path: Path) -> Odometry:
    """From the file; of lines for the same frame the first counts. Raises InputError."""
    header, *lines = read_text(path).splitlines() or [""]
    names = [name.strip().lower() for name in header.split(",")]
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise InputError(f"{path}: the first line names no {', '.join(missing)}; it takes {', '.join(COLUMNS)}")
    rows = [fields for fields in (line.split(",") for line in lines) if any(map(str.strip, fields))]
    lensed = all(name in names for name in LENS)
    places = [names.index(name) for name in (*COLUMNS, *(LENS if lensed else ()))]
    table = np.array([[_number(row, place) for place in places] for row in rows]).reshape(-1, len(places))
    usable = table[np.isfinite(table[:, 0]) & (table[:, 1] >= 0) & (table[:, 1] < MOST_FRAMES)]
    if not len(usable):
        raise InputError(f"{path}: no line has a time and a frame number; export it again, or remove the file")
    frames, first = np.unique(usable[:, 1].astype(np.int64), return_index=True)
    usable = usable[first]
    poses, notes = rigid(posed(usable[:, 2:5], usable[:, 5:9]))
    if len(usable) < len(rows):
        notes = (f"{len(rows) - len(usable)} lines of {path.name} are damaged or repeated and are left out", *notes)
    return Odometry(frames, usable[:, 0], poses, usable[:, len(COLUMNS) :] if lensed else None, notes)


def _number(fields: list[str], column: int) -> float:
    """NaN where there is none."""
    try:
        return float(fields[column])
    except (ValueError, IndexError):
        return np.nan
