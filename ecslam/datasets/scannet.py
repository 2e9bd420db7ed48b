"""ScanNet (exported): color/0.jpg, depth/0.png (millimetres), pose/0.txt and intrinsic/intrinsic_depth.txt."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .files import FileSequence
from .meshes import first_existing
from .reading import common_size, has_numbered, numbered, paired, read_intrinsics, read_pose_files, same_shape

COLOR = r"(\d{1,9})\.(?:jpe?g|png)"
FRAMES_PER_S = 30.0


def sniff(path: Path) -> bool:
    """Whether the folder, or frames in it, has color/N images beside a depth folder."""
    return _root(path) is not None


def open(path: Path) -> FileSequence:
    """Open the folder; colour is resized to depth, whose intrinsics hold for both. Raises InputError."""
    root = _root(path) or path
    scene = root.parent if root.name == "frames" else root
    color = numbered(root / "color", COLOR)
    depth = numbered(root / "depth", r"(\d{1,9})\.png")
    numbers = paired(color, depth, root)
    color_size, size = common_size(list(color.values())), common_size(list(depth.values()))
    same_shape(color_size, size, root)
    pose_files = numbered(root / "pose", r"(\d{1,9})\.txt")
    poses, notes = read_pose_files([pose_files.get(n) for n in numbers])
    return FileSequence(
        name=scene.name,
        layout="scannet",
        preset="scannet",
        intrinsics=read_intrinsics(root / "intrinsic" / "intrinsic_depth.txt", *size),
        color_files=list(color.values()),
        depth_files=list(depth.values()),
        depth_scale=1000.0,
        times=np.array(numbers) / FRAMES_PER_S,
        poses=poses,
        color_size=color_size,
        mesh_file=find_mesh(scene.name, root, scene),
        notes=notes,
    )


def find_mesh(scene: str, *folders: Path) -> Path | None:
    """The reconstruction that comes with a scene, from the first of ``folders`` that holds it."""
    return first_existing(*(f / f"{scene}_vh_clean{end}.ply" for f in folders for end in ("", "_2")))


def _root(path: Path) -> Path | None:
    candidates = (path, path / "frames")
    return next((p for p in candidates if (p / "depth").is_dir() and has_numbered(p / "color", COLOR)), None)
