"""7-Scenes: frame-000000.color.png (or .jpg), .depth.png (millimetres) and .pose.txt, here or in seq-01."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..types import InputError, Intrinsics
from .files import FileSequence
from .reading import find_intrinsics, has_numbered, numbered, paired, read_pose_files, same_size

COLOR = r"frame-(\d{1,9})\.color\.(?:jpg|png)"
KINECT = Intrinsics(585.0, 585.0, 320.0, 240.0, 640, 480)
FRAMES_PER_S = 30.0


def sniff(path: Path) -> bool:
    """Whether the folder, or a seq-NN folder in it, holds frame-NNNNNN.color images."""
    return has_numbered(path, COLOR) or (path.is_dir() and bool(_parts(path)))


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
    camera, notes = find_intrinsics([folder, folder.parent], KINECT, size)
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


def _parts(path: Path) -> list[Path]:
    folders = (p for p in sorted(path.iterdir()) if re.fullmatch(r"seq-\d+", p.name))
    return [p for p in folders if has_numbered(p, COLOR)]
