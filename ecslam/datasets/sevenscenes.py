"""7-Scenes: frame-000000.color.png (or .jpg), .depth.png (millimetres) and .pose.txt, here or in seq-01.

Colour comes as the Kinect took it, beside depth and through a wider lens; left there, it is up to 40 pixels off.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..types import InputError, Intrinsics
from .benchmarks import KINECT_READOUT_S
from .files import FileSequence
from .meshes import first_existing
from .reading import (
    INTRINSICS_FILE,
    common_size,
    find_intrinsics,
    find_registration,
    has_numbered,
    numbered,
    paired,
    read_pose_files,
    read_text,
    require_same_size,
)
from .registration import Registration

COLOR = r"frame-(\d{1,9})\.color\.(?:jpe?g|png)"
KINECT = Intrinsics(585.0, 585.0, 320.0, 240.0, 640, 480, readout_s=KINECT_READOUT_S)
KINECT_COLOR, KINECT_BASELINE_M = Intrinsics(525.0, 525.0, 320.0, 240.0, 640, 480), 0.025  # redkitchen fits these best
INFO, INFO_KEY = ("info.txt", "_info.txt"), "m_calibrationDepthIntrinsic"
FRAMES_PER_S = 30.0


def sniff(path: Path) -> bool:
    """Whether the folder, or a seq-NN folder in it, holds frame-NNNNNN.color images."""
    return has_numbered(path, COLOR) or bool(_parts(path))


def open(path: Path) -> FileSequence:
    """Open the folder. Raises InputError."""
    folder = path
    if not has_numbered(path, COLOR):
        parts = _parts(path)
        if len(parts) > 1:
            raise InputError(f"{path}: holds {len(parts)} sequences; name one of them, e.g. {parts[0]}")
        folder = parts[0]
    color = numbered(folder, COLOR)
    depth = numbered(folder, r"frame-(\d{1,9})\.depth\.png")
    numbers = paired(color, depth, folder)
    colors, depths = list(color.values()), list(depth.values())
    color_size, size = common_size(colors), common_size(depths)
    camera, notes = _camera(folder, size)
    registration = find_registration(folder, camera, color_size) or _kinect(camera, color_size)
    if registration is None:
        require_same_size(color_size, size, folder)
    pose_files = numbered(folder, r"frame-(\d{1,9})\.pose\.txt")
    poses, pose_notes = read_pose_files([pose_files.get(n) for n in numbers])
    name = folder.name if not folder.name.startswith("seq-") else f"{folder.parent.name}-{folder.name}"
    return FileSequence(
        name=name,
        layout="7scenes",
        preset="lite",
        intrinsics=registration.camera if registration else camera,
        color_files=colors,
        depth_files=depths,
        depth_scale=1000.0,
        times=np.array(numbers) / FRAMES_PER_S,
        poses=poses,
        color_size=color_size,
        notes=(*notes, *pose_notes),
        registration=registration,
    )


def _kinect(depth: Intrinsics, color_size: tuple[int, int]) -> Registration | None:
    """Where nothing but the camera's own pixels has been stored: images that were registered have another camera."""
    if depth != KINECT or color_size != (KINECT.width, KINECT.height):
        return None
    move = np.eye(4)
    move[0, 3] = -KINECT_BASELINE_M
    return Registration(depth, KINECT_COLOR, move)


def _camera(folder: Path, size: tuple[int, int]) -> tuple[Intrinsics, tuple[str, ...]]:
    """By hand, else as BundleFusion's archives and ScanNet's SensReader tell it, else a Kinect's."""
    file = first_existing(*(folder / name for name in INFO))
    text = read_text(file) if file else ""
    if INFO_KEY not in text or any((place / INTRINSICS_FILE).is_file() for place in (folder, folder.parent)):
        return find_intrinsics([folder, folder.parent], KINECT, size)
    entries = dict(re.findall(r"^(\w+)\s*=\s*(.+)$", text, re.MULTILINE))
    try:
        k = np.array(entries[INFO_KEY].split(), np.float64).reshape(4, 4)
        made_for = int(entries["m_depthWidth"]), int(entries["m_depthHeight"])
        return Intrinsics(k[0, 0], k[1, 1], k[0, 2], k[1, 2], *made_for).resized(*size), ()
    except (KeyError, ValueError, ZeroDivisionError) as error:
        raise InputError(
            f"{file}: tells no camera of the depth ({type(error).__name__}: {error}); write its 3x3 matrix to "
            f"{INTRINSICS_FILE} there"
        ) from None


def _parts(path: Path) -> list[Path]:
    folders = (p for p in sorted(path.iterdir()) if re.fullmatch(r"seq-\d+", p.name))
    return [p for p in folders if has_numbered(p, COLOR)]
