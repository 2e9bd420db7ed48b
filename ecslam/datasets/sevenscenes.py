"""7-Scenes: frame-000000.color.png (or .jpg), .depth.png (millimetres) and .pose.txt, here or in seq-01."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..types import InputError, Intrinsics
from .files import FileSequence
from .meshes import first_existing
from .reading import (
    INTRINSICS_FILE,
    find_intrinsics,
    has_numbered,
    numbered,
    paired,
    read_pose_files,
    read_text,
    same_size,
)

COLOR = r"frame-(\d{1,9})\.color\.(?:jpg|png)"
KINECT = Intrinsics(585.0, 585.0, 320.0, 240.0, 640, 480)
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
    size = same_size(list(color.values()), list(depth.values()))
    camera, notes = _camera(folder, size)
    pose_files = numbered(folder, r"frame-(\d{1,9})\.pose\.txt")
    poses, pose_notes = read_pose_files([pose_files.get(n) for n in numbers])
    name = folder.name if not folder.name.startswith("seq-") else f"{folder.parent.name}-{folder.name}"
    return FileSequence(
        name=name,
        layout="7scenes",
        preset="lite",
        intrinsics=camera,
        color_files=list(color.values()),
        depth_files=list(depth.values()),
        depth_scale=1000.0,
        times=np.array(numbers) / FRAMES_PER_S,
        poses=poses,
        color_size=size,
        notes=(*notes, *pose_notes),
    )


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
