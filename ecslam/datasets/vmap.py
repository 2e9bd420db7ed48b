"""Replica (vMAP): rgb/rgb_0.png, depth/depth_0.png (millimetres) and traj_w_c.txt, here or in imap/00."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .files import FileSequence
from .meshes import first_existing
from .reading import find_intrinsics, has_numbered, numbered, paired, read_pose_list, same_size
from .replica import CAMERA, FRAMES_PER_S

COLOR = r"rgb_(\d{1,9})\.(?:png|jpe?g)"


def sniff(path: Path) -> bool:
    """Whether the folder, or imap/00 in it, has rgb/rgb_N images."""
    return _root(path) is not None


def open(path: Path) -> FileSequence:
    """Open the folder. Raises InputError."""
    root = _root(path) or path
    scene = root.parents[1] if root.parent.name == "imap" else root
    color = numbered(root / "rgb", COLOR)
    depth = numbered(root / "depth", r"depth_(\d{1,9})\.png")
    numbers = paired(color, depth, root)
    size = same_size(list(color.values()), list(depth.values()))
    camera, notes = find_intrinsics([root, scene], CAMERA, size)
    poses, pose_notes = read_pose_list(root / "traj_w_c.txt", numbers)
    return FileSequence(
        name=scene.name if scene == root else f"{scene.name}-{root.name}",
        layout="vmap",
        preset="lite",
        intrinsics=camera,
        color_files=list(color.values()),
        depth_files=list(depth.values()),
        depth_scale=1000.0,
        times=np.array(numbers) / FRAMES_PER_S,
        poses=poses,
        color_size=size,
        mesh_file=first_existing(root / "mesh.ply", scene / "mesh.ply", scene.parent / f"{scene.name}_mesh.ply"),
        notes=(*notes, *pose_notes),
    )


def _root(path: Path) -> Path | None:
    candidates = (path, path / "00", path / "imap" / "00")
    return next((p for p in candidates if has_numbered(p / "rgb", COLOR)), None)
