"""Neural RGB-D: images/img0.png, depth_filtered/depth0.png (or depth/, millimetres), focal.txt and poses.txt.

From the README and loader of https://github.com/dazinovic/neural-rgbd-surface-reconstruction: poses are camera-to-world
with OpenGL's axes, four lines each; the optical centre is the middle of the image. ``depth`` is exact; the published
figures are of ``depth_filtered``, which imitates a sensor.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..types import InputError, Intrinsics
from .files import FileSequence
from .meshes import first_existing
from .reading import (
    OPENGL,
    common_size,
    has_numbered,
    numbered,
    paired,
    read_numbers,
    read_pose_list,
    same_shape,
)

COLOR = r"img(\d{1,9})\.(?:png|jpe?g)"
DEPTH_FOLDERS = ("depth_filtered", "depth_with_noise", "depth")
FRAMES_PER_S = 30.0


def sniff(path: Path) -> bool:
    """Whether the folder has images/imgN."""
    return has_numbered(path / "images", COLOR)


def open(path: Path) -> FileSequence:
    """Open the folder; colour is resized to depth, to which the focal length belongs. Raises InputError."""
    color = numbered(path / "images", COLOR)
    found = (numbered(path / name, r"depth(\d{1,9})\.png") for name in DEPTH_FOLDERS)
    depth = next(filter(None, found), {})
    numbers = paired(color, depth, path)
    color_size, size = common_size(list(color.values())), common_size(list(depth.values()))
    same_shape(color_size, size, path)
    truth = first_existing(path / "poses.txt", path / "trainval_poses.txt") or path / "poses.txt"
    poses, notes = read_pose_list(truth, numbers)
    if truth.name == "trainval_poses.txt":
        notes = ("no poses.txt: errors are against trainval_poses.txt, itself an estimate", *notes)
    return FileSequence(
        name=path.name,
        layout="neuralrgbd",
        preset="lite",
        intrinsics=_camera(path / "focal.txt", size),
        color_files=list(color.values()),
        depth_files=list(depth.values()),
        depth_scale=1000.0,
        times=np.array(numbers) / FRAMES_PER_S,
        poses=None if poses is None else poses @ OPENGL,
        color_size=color_size,
        mesh_file=first_existing(path / "gt_mesh.ply", path / "gt_mesh_culled.ply"),
        notes=notes,
    )


def _camera(file: Path, size: tuple[int, int]) -> Intrinsics:
    focal = read_numbers(file)
    if focal.size != 1 or not np.isfinite(focal).all():
        raise InputError(
            f"{file}: holds {' '.join(map(str, focal[:4]))}; it takes one number, the focal length in pixels of depth"
        )
    return Intrinsics(focal.item(), focal.item(), (size[0] - 1) / 2, (size[1] - 1) / 2, *size)
