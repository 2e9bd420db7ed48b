"""Replica (NICE-SLAM): results/frame000000.jpg and depth000000.png, traj.txt and cam_params.json."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ..types import InputError, Intrinsics
from .files import FileSequence
from .meshes import first_existing
from .reading import has_numbered, numbered, paired, read_pose_list, read_text, same_size

COLOR = r"frame(\d{1,9})\.(?:jpe?g|png)"
CAMERA = Intrinsics(600.0, 600.0, 599.5, 339.5, 1200, 680)
DEPTH_SCALE = 6553.5
FRAMES_PER_S = 30.0


def sniff(path: Path) -> bool:
    """Whether the folder has results/frameNNNNNN images."""
    return has_numbered(path / "results", COLOR)


def open(path: Path) -> FileSequence:
    """Open the folder. Raises InputError."""
    color = numbered(path / "results", COLOR)
    depth = numbered(path / "results", r"depth(\d{1,9})\.png")
    numbers = paired(color, depth, path / "results")
    size = same_size(list(color.values()), list(depth.values()))
    camera, depth_scale = _camera(path, size)
    poses, notes = read_pose_list(path / "traj.txt", numbers)
    return FileSequence(
        name=path.name,
        layout="replica",
        preset="lite",
        intrinsics=camera,
        color_files=list(color.values()),
        depth_files=list(depth.values()),
        depth_scale=depth_scale,
        times=np.array(numbers) / FRAMES_PER_S,
        poses=poses,
        color_size=size,
        mesh_file=first_existing(path / "mesh.ply", path.parent / f"{path.name}_mesh.ply"),
        notes=notes,
    )


def _camera(path: Path, size: tuple[int, int]) -> tuple[Intrinsics, float]:
    """Intrinsics and depth scale from cam_params.json in the folder or its parent, else those of the original."""
    file = first_existing(path / "cam_params.json", path.parent / "cam_params.json")
    camera, scale = (CAMERA, DEPTH_SCALE) if file is None else _read_camera(file)
    if (camera.width, camera.height) != size:
        source = f"{file} is for" if file else "without cam_params.json they should be"
        raise InputError(
            f"{path}: images are {size[0]}x{size[1]}, but {source} {camera.width}x{camera.height}; "
            'put {"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}} of these images into cam_params.json'
        )
    return camera, scale


def _read_camera(file: Path) -> tuple[Intrinsics, float]:
    try:
        values = json.loads(read_text(file))["camera"]
        w, h, fx, fy, cx, cy, scale = (float(values[k]) for k in ("w", "h", "fx", "fy", "cx", "cy", "scale"))
        return Intrinsics(fx, fy, cx, cy, int(w), int(h)), scale
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise InputError(
            f"{file}: needs numbers for w, h, fx, fy, cx, cy and scale under the key camera "
            f"({type(error).__name__}: {error})"
        ) from None
