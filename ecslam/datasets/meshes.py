"""Reference surfaces from disk. trimesh is imported only when one is asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..types import InputError, Mesh


def load_mesh(path: Path) -> Mesh:
    """Read a triangle mesh (PLY, OBJ, GLB ...) with vertex colours where it has them. Raises InputError."""
    try:
        import trimesh
    except ImportError:
        raise InputError(f"{path}: reading a mesh needs trimesh; install it with: pip install trimesh") from None
    try:
        mesh: Any = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # trimesh raises whatever its many readers do
        raise InputError(f"{path}: not a readable mesh ({' '.join(str(error).split())}); replace it") from None
    if len(mesh.vertices) == 0 or len(mesh.faces) == 0:
        raise InputError(f"{path}: a mesh without triangles; replace it")
    colored = mesh.visual.kind == "vertex"
    return Mesh(
        np.asarray(mesh.vertices, np.float32),
        np.asarray(mesh.faces, np.int32),
        np.asarray(mesh.visual.vertex_colors[:, :3], np.uint8) if colored else None,
    )


def first_existing(*candidates: Path) -> Path | None:
    """The first path that is a file, or None."""
    return next((path for path in candidates if path.is_file()), None)
