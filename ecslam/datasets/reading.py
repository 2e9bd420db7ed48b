"""Small readers that the layouts share: numbered files, matrices, intrinsics, image sizes, lists of poses."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from ..indices import evenly
from ..types import FrameError, InputError, Intrinsics
from .images import read_header
from .registration import Registration

MAX_PIXELS = 64_000_000
MAX_TEXT_BYTES = 64 << 20
INTRINSICS_FILE = "camera-intrinsics.txt"
COLOR_INTRINSICS_FILE, DEPTH_TO_COLOR_FILE = "color-intrinsics.txt", "depth-to-color.txt"
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # from its camera axes to OpenCV's, or back


def numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """Files of ``folder`` whose name as a whole matches ``pattern``, in any case; by the number in its first group."""
    regex = re.compile(pattern, re.IGNORECASE)
    if not folder.is_dir():
        return {}
    matches = ((regex.fullmatch(path.name), path) for path in sorted(folder.iterdir()))
    found = {int(match[1]): path for match, path in matches if match}
    return dict(sorted(found.items()))


def has_numbered(folder: Path, pattern: str) -> bool:
    """Whether any file name in ``folder`` matches ``pattern`` as a whole, in any case."""
    return folder.is_dir() and any(re.fullmatch(pattern, path.name, re.IGNORECASE) for path in folder.iterdir())


def paired(color: dict[int, Path], depth: dict[int, Path], folder: Path) -> list[int]:
    """The frame numbers, once it is sure that each has both images. Raises InputError naming the first that has not."""
    alone = sorted(color.keys() ^ depth.keys())
    if alone:
        missing, present = ("depth image (a 16-bit PNG)", color) if alone[0] in color else ("colour image", depth)
        raise InputError(
            f"{folder}: {len(color)} colour and {len(depth)} depth images; {present[alone[0]].name} is the first "
            f"without its {missing}; add the missing files or remove those left over"
        )
    if not color:
        raise InputError(f"{folder}: no colour and depth images; give the folder that holds them")
    return list(color)


def read_text(path: Path) -> str:
    """A text file of sensible size, without the mark that Windows puts before UTF-8. Raises InputError."""
    try:
        if path.stat().st_size > MAX_TEXT_BYTES:
            raise InputError(f"{path}: over {MAX_TEXT_BYTES >> 20} MiB of text; is it the right file?")
        return path.read_text("utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); put a readable one there") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not text in UTF-8; save it as that") from None


def read_numbers(path: Path) -> NDArray[np.float64]:
    """All numbers of a text file, flat, without comments (``#``); ``inf`` and ``nan`` are allowed, also as
    ``-nan(ind)``. Raises InputError."""
    text = re.sub("#.*", "", read_text(path))
    try:
        return np.array(text.replace(",", " ").replace("(ind)", "").split(), np.float64)
    except ValueError:
        raise InputError(f"{path}: holds something that is not a number; write plain numbers") from None


def read_intrinsics(path: Path, width: int, height: int) -> Intrinsics:
    """Intrinsics from a 3x3 or 4x4 calibration matrix in a text file. Raises InputError."""
    values = read_numbers(path)
    if values.size not in (9, 16) or not np.isfinite(values).all():
        raise InputError(f"{path}: {values.size} numbers, but a calibration matrix is 3x3 (or 4x4) finite numbers")
    k = values.reshape(3, 3) if values.size == 9 else values.reshape(4, 4)
    return Intrinsics(float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]), width, height)


def find_intrinsics(
    folders: list[Path], default: Intrinsics, size: tuple[int, int]
) -> tuple[Intrinsics, tuple[str, ...]]:
    """From the first ``camera-intrinsics.txt`` in ``folders``, else ``default`` scaled to ``size``; and notes on it.

    Raises InputError when the default belongs to images of another shape.
    """
    for folder in folders:
        if (folder / INTRINSICS_FILE).is_file():
            found = read_intrinsics(folder / INTRINSICS_FILE, *size)
            return default if replace(found, readout_s=default.readout_s) == default else found, ()
    if size == (default.width, default.height):
        return default, ()
    made_for, here = f"{default.width}x{default.height}", f"{size[0]}x{size[1]}"
    if size[0] * default.height != size[1] * default.width:
        raise InputError(
            f"{folders[0]}: {here} images, but this camera has {made_for}; "
            f"write its 3x3 matrix to {INTRINSICS_FILE} there"
        )
    note = f"no {INTRINSICS_FILE}: the usual intrinsics for {made_for} were scaled to {here}"
    return default.resized(*size), (f"{note}; ecslam calibrate can tell better",)


def common_size(files: list[Path], samples: int = 9) -> tuple[int, int]:
    """The (width, height) that most of some spread files have, from headers alone. Raises InputError."""
    sizes: Counter[tuple[int, int]] = Counter()
    problem = ""
    for i in evenly(len(files), samples):
        try:
            sizes[read_header(files[i]).size] += 1
        except FrameError as error:
            problem = problem or str(error)
    if not sizes:
        raise InputError(f"none of the images looked at is readable, the first being {problem}")
    (width, height), _ = sizes.most_common(1)[0]
    if width * height > MAX_PIXELS:
        raise InputError(f"{files[0].parent}: images of {width}x{height} pixels; at most {MAX_PIXELS} pixels are read")
    return width, height


def same_size(color_files: list[Path], depth_files: list[Path]) -> tuple[int, int]:
    """The size that colour and depth share. Raises InputError when they do not."""
    color, depth = common_size(color_files), common_size(depth_files)
    require_same_size(color, depth, color_files[0].parent)
    return depth


def require_same_size(color: tuple[int, int], depth: tuple[int, int], folder: Path) -> None:
    """Raises InputError when colour and depth in ``folder`` differ in (width, height)."""
    if color != depth:
        raise InputError(
            f"{folder}: colour images are {color[0]}x{color[1]} but depth images {depth[0]}x{depth[1]}; "
            "this layout has both at one size, pixel on pixel: export them again, registered"
        )


def require_focal_lengths(camera: Intrinsics, place: Path | str) -> None:
    """Raises InputError when no lens has those of ``camera``, which ``place`` tells."""
    if not (camera.fx > 0 and camera.fy > 0):
        raise InputError(f"{place}: focal lengths {camera.fx:g} and {camera.fy:g}; calibrate the camera")


def find_registration(folder: Path, depth: Intrinsics, color_size: tuple[int, int]) -> Registration | None:
    """What ``color-intrinsics.txt`` (3x3) and ``depth-to-color.txt`` (4x4, metres) in ``folder`` say of another camera
    than ``depth`` for colour images of ``color_size`` (width, height); None without them. Raises InputError."""
    matrix, motion = folder / COLOR_INTRINSICS_FILE, folder / DEPTH_TO_COLOR_FILE
    if matrix.is_file() != motion.is_file():
        missing, present = (motion, matrix) if matrix.is_file() else (matrix, motion)
        raise InputError(f"{missing}: is missing, but {present.name} is there; colour is registered by both together")
    if not matrix.is_file():
        return None
    values = read_numbers(motion)
    moves = rigid(values.reshape(-1, 4, 4))[0] if values.size == 16 else np.full((1, 4, 4), np.nan)
    if not np.isfinite(moves).all():
        raise InputError(
            f"{motion}: not a rigid motion as a 4x4 matrix, from depth's camera to that of colour, in metres"
        )
    color = read_intrinsics(matrix, *color_size)
    require_focal_lengths(depth, f"{folder}: depth")
    require_focal_lengths(color, matrix)
    try:
        return Registration(depth, color, moves[0])
    except InputError as error:
        raise InputError(f"{motion}: {error}") from None


def same_shape(color: tuple[int, int], depth: tuple[int, int], folder: Path) -> None:
    """Raises InputError when images of these sizes (width, height) cannot show the same view."""
    if abs(color[0] / color[1] - depth[0] / depth[1]) > 0.02:
        raise InputError(
            f"{folder}: colour ({color[0]}x{color[1]}) and depth ({depth[0]}x{depth[1]}) have different shapes and "
            "cannot show the same view; export both again, uncropped"
        )


def finite_poses(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[N] whether all of a pose [N, 4, 4] is finite."""
    return cast("NDArray[np.bool_]", np.logical_and.reduce(np.isfinite(poses), axis=(1, 2)))


def posed(positions: NDArray[np.float64], quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses [N, 4, 4] from positions [N, 3] and quaternions x y z w [N, 4], NaN where these are none."""
    from scipy.spatial.transform import Rotation  # half a second to import, which other layouts need not wait for

    good = np.isfinite(positions).all(1) & np.isfinite(quaternions).all(1)
    good &= np.abs(np.linalg.norm(quaternions, axis=1) - 1) < 0.1
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    if good.any():
        poses[good, :3, :3] = Rotation.from_quat(quaternions[good]).as_matrix()
    poses[:, :3, 3] = positions
    poses[~good] = np.nan
    return poses


def rigid(poses: NDArray[np.float64]) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Poses [N, 4, 4] with NaN for each that is not finite or not a rigid motion, and a note when there are any."""
    safe = np.where(finite_poses(poses)[:, None, None], poses, 0.0)
    rotation = safe[:, :3, :3]
    square = rotation @ rotation.transpose(0, 2, 1) - np.eye(3)
    good = (np.abs(square).max((1, 2)) < 1e-2) & (np.linalg.det(rotation) > 0)
    good &= np.abs(safe[:, 3] - [0, 0, 0, 1]).max(1) < 1e-6
    bad = int((~good).sum())
    notes = (
        (f"{bad} of {len(poses)} ground-truth poses are missing, infinite or no rigid 4x4 matrix and are left out",)
        if bad
        else ()
    )
    return np.where(good[:, None, None], poses, np.nan), notes


def read_pose_files(files: list[Path | None]) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Poses [N, 4, 4] from one 4x4 text file a frame (None = it has none), and notes; None when no frame has one."""
    if not any(files):
        return None, ()
    poses = np.full((len(files), 4, 4), np.nan)
    for i, path in enumerate(files):
        if path is not None:
            try:
                values = read_numbers(path)
            except InputError:
                continue
            if values.size == 16:
                poses[i] = values.reshape(4, 4)
    return rigid(poses)


def read_pose_list(path: Path, numbers: list[int]) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Poses [N, 4, 4] of frames ``numbers`` from a file with one 4x4 matrix a frame, and notes; None without the file.

    Frames after the file's last pose have NaN. Raises InputError for what holds no matrices.
    """
    if not path.is_file():
        return None, ()
    values = read_numbers(path)
    if values.size % 16:
        raise InputError(f"{path}: {values.size} numbers, not a multiple of 16; write one 4x4 matrix for each frame")
    poses = values.reshape(-1, 4, 4)
    wanted = np.array(numbers)
    known = wanted < len(poses)
    chosen = np.full((len(wanted), 4, 4), np.nan)
    chosen[known] = poses[wanted[known]]
    spare = len(poses) - int(known.sum())
    found, notes = rigid(chosen)
    return found, (*notes, f"{path.name} has {spare} poses without images") if spare else notes
