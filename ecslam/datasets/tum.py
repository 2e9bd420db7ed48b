"""TUM RGB-D: rgb.txt and depth.txt (or associations.txt), lists of time-stamped images (5000 = 1 m); groundtruth.txt.

So are ETH3D's (with the camera in calibration.txt, about pixel centres, as its authors' BAD SLAM reads it), Bonn's and
ICL-NUIM's.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..types import InputError, Intrinsics
from .benchmarks import ICL_TRUTH, KINECT_READOUT_S, Benchmark, benchmark
from .files import FileSequence
from .listing import listed_file, read_rows, to_numbers, to_times
from .meshes import first_existing
from .reading import INTRINSICS_FILE, find_intrinsics, read_numbers, read_text, same_size
from .views import in_order

MAX_DIFFERENCE_S = 0.02
DEPTH_SCALE = 5000.0
MOST_IN_DISORDER = 0.05  # of the listed images; beyond, the order of a list means nothing
MOST_MISSING = 0.05  # of the listed images; each of Bonn's recordings lacks some
ASSOCIATIONS = ("associations.txt", "associated.txt", "association.txt", "associate.txt")
CALIBRATION = "calibration.txt"
UNKNOWN_CAMERA = Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480, readout_s=KINECT_READOUT_S)

Times = NDArray[np.float64]


class Images(NamedTuple):
    """times: [N] of the depth images."""

    times: Times
    color: list[Path]
    depth: list[Path]
    notes: tuple[str, ...]


def sniff(path: Path) -> bool:
    """Whether the folder has rgb.txt and depth.txt, or one list of both."""
    return _has_lists(path) or _associations(path) is not None


def open(path: Path) -> FileSequence:
    """Open the folder. Raises InputError.

    Depth is registered to colour, so both are undistorted alike. A frame has the time of its depth image, for depth
    decides the pose: on freiburg1_xyz ground truth at the times of the depth images makes surfaces of different frames
    fit to 14 mm, at those of the colour images (12 ms later) to 21 mm.
    """
    images = _by_time(_from_lists(path) if _has_lists(path) else _from_associations(path))
    size = same_size(images.color, images.depth)
    known = benchmark(path, _header(path / "rgb.txt"))
    camera, camera_notes = _camera(path, known, size)
    times = _seconds(images.times, known)
    poses, pose_notes = ground_truth(path, known, times)
    return FileSequence(
        name=path.name,
        layout=known.layout if known else "tum",
        preset=known.preset if known else "tum",
        intrinsics=camera,
        color_files=images.color,
        depth_files=images.depth,
        depth_scale=DEPTH_SCALE,
        times=times,
        poses=poses,
        color_size=size,
        notes=(*images.notes, *camera_notes, *pose_notes),
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


def _read_list(path: Path) -> tuple[Times, list[Path]]:
    rows = read_rows(path, 2)
    return to_times([row[0] for row in rows], path), [listed_file(path.parent, row[1]) for row in rows]


def _has_lists(path: Path) -> bool:
    return (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()


def _associations(path: Path) -> Path | None:
    return first_existing(*(path / name for name in ASSOCIATIONS))


def _from_lists(path: Path) -> Images:
    """Of each list what is there, joined by time."""
    color_times, color_files = _read_list(path / "rgb.txt")
    depth_times, depth_files = _read_list(path / "depth.txt")
    color, depth = _present(path, color_files), _present(path, depth_files)
    pairs = associate(color_times[color], depth_times[depth], MAX_DIFFERENCE_S)
    if len(pairs) == 0:
        raise InputError(
            f"{path}: no colour and depth image lie within 20 ms of each other; do both lists count seconds, "
            "on one clock?"
        )
    alone = len(color) - len(pairs), len(depth) - len(pairs)
    notes = _notes_on_missing([*color_files, *depth_files], len(color) + len(depth))
    if any(alone):
        notes = (*notes, f"{alone[0]} colour and {alone[1]} depth images have no partner within 20 ms and are left out")
    i, j = color[pairs[:, 0]], depth[pairs[:, 1]]
    return Images(depth_times[j], [color_files[k] for k in i], [depth_files[k] for k in j], notes)


def _from_associations(path: Path) -> Images:
    """The pairs that somebody has made; whether depth comes first, as in ICL-NUIM, is told by the file names."""
    file = _associations(path) or path / ASSOCIATIONS[0]
    rows = read_rows(file, 4)
    depth_first = sum("depth" in row[1].lower() for row in rows) > sum("depth" in row[3].lower() for row in rows)
    places = {"color": (2, 3), "depth": (0, 1)} if depth_first else {"color": (0, 1), "depth": (2, 3)}
    times = to_times([row[places["depth"][0]] for row in rows], file)
    color, depth = ([listed_file(path, row[places[what][1]]) for row in rows] for what in ("color", "depth"))
    both, notes = with_both(path, color, depth)
    return Images(times[both], [color[k] for k in both], [depth[k] for k in both], notes)


def _by_time(images: Images) -> Images:
    """In the order of time where the lists are in none. A few that are out of order keep their places, for their times
    may be wrong; a run leaves them out."""
    disordered = len(np.unique(images.times)) - in_order(images.times).sum()
    if disordered <= max(1, MOST_IN_DISORDER * len(images.times)):
        return images
    order = np.argsort(images.times, kind="stable")
    color, depth = ([files[k] for k in order] for files in (images.color, images.depth))
    note = "images are not listed in the order of time, but taken in it"
    return Images(images.times[order], color, depth, (*images.notes, note))


def with_both(folder: Path, color: list[Path], depth: list[Path]) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """The indices of listed pairs of images that are both there, and a note where some are not. Raises InputError when
    too many are not."""
    seen, measured = _present(folder, color), _present(folder, depth)
    return np.intersect1d(seen, measured), _notes_on_missing([*color, *depth], len(seen) + len(measured))


def _present(folder: Path, files: list[Path]) -> NDArray[np.int64]:
    """The indices of those that exist. Raises InputError when too many do not."""
    there = np.array([file.is_file() for file in files])
    if (~there).sum() > MOST_MISSING * len(files):
        raise InputError(
            f"{folder}: {(~there).sum()} listed images are missing, the first is {files[there.argmin()]}; "
            "copy them there or take their lines out"
        )
    return np.flatnonzero(there)


def _notes_on_missing(files: list[Path], there: int) -> tuple[str, ...]:
    if there == len(files):
        return ()
    first = next(file for file in files if not file.is_file())
    return (f"{len(files) - there} listed images are missing and are left out, the first is {first.name}",)


def _header(file: Path) -> str:
    """The comments at its beginning."""
    if not file.is_file():
        return ""
    return "".join(line for line in read_text(file).splitlines()[:10] if line.startswith("#"))


def _camera(path: Path, known: Benchmark | None, size: tuple[int, int]) -> tuple[Intrinsics, tuple[str, ...]]:
    """From a file, or known by the folder's name or the header of rgb.txt. Known ones have their distortion."""
    by_hand, calibrated = ((path / name).is_file() for name in (INTRINSICS_FILE, CALIBRATION))
    if calibrated and not by_hand and known is None:
        values = read_numbers(path / CALIBRATION)
        if values.size != 4 or not np.isfinite(values).all():
            raise InputError(
                f"{path / CALIBRATION}: {values.size} numbers, but it takes four, fx fy cx cy; write these, or the "
                f"camera's 3x3 matrix to {INTRINSICS_FILE} there"
            )
        fx, fy, cx, cy = values.tolist()
        return Intrinsics(fx, fy, cx, cy, *size), ()
    camera, notes = find_intrinsics([path], known.camera if known else UNKNOWN_CAMERA, size)
    if known is not None:
        camera = replace(camera, readout_s=known.camera.readout_s)
    elif not by_hand:
        notes = (
            *notes,
            f"a standard Kinect is assumed: no {INTRINSICS_FILE} or {CALIBRATION}, and no recording that is known by "
            "its folder's name (freiburg1, 2 or 3 ...); ecslam calibrate can tell better",
        )
    if calibrated and (known or by_hand):
        notes = (*notes, f"{CALIBRATION} is not used: {INTRINSICS_FILE if by_hand else 'the camera is known'}")
    return camera, notes


def _seconds(times: Times, known: Benchmark | None) -> Times:
    """Times, or frame numbers where the benchmark has these."""
    numbered = known is not None and known.frames_per_s > 0 and (times == np.rint(times)).all()
    return times / known.frames_per_s if known is not None and numbered else times


def ground_truth(
    path: Path, known: Benchmark | None, times: Times
) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Poses [N, 4, 4] at ``times`` from the folder's ``groundtruth.txt``, NaN where it has none near, or None; and
    notes on it. Raises InputError."""
    files = [each for each in (path / "groundtruth.txt", *sorted(path.glob(ICL_TRUTH))) if each.is_file()]
    if not files:
        return None, ()
    if len(files) > 1:
        names = ", ".join(each.name for each in files)
        return None, (f"several files of ground truth ({names}), so none is used; leave one",)
    (file,) = files
    rows = to_numbers(read_rows(file, 8), file)
    usable = rows[np.isfinite(rows).all(1) & (np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1) < 0.1)]
    if len(usable) == 0:
        raise InputError(
            f"{file}: no line is a pose (time x y z qx qy qz qw with a unit quaternion); correct or remove it"
        )
    stamps, first = np.unique(_seconds(usable[:, 0], known), return_index=True)
    poses = interpolate_poses(stamps, usable[first, 1:], times, MAX_DIFFERENCE_S)
    missing = int(np.isnan(poses[:, 0, 0]).sum())
    notes = (f"{missing} of {len(times)} frames have no ground truth within 20 ms",) if missing else ()
    if missing == len(times):
        spans = (f"{each.min():.3f} .. {each.max():.3f}" for each in (stamps, times))
        notes = (*notes, "{} is of times {}, images are of {}".format(file.name, *spans))
    if len(usable) < len(rows):
        notes = (*notes, f"{len(rows) - len(usable)} lines of {file.name} are not poses and are left out")
    return (known.before @ poses @ known.after if known else poses), notes
