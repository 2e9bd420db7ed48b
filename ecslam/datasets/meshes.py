"""Surfaces from disk and to PLY. trimesh is imported only when one is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..interrupts import interrupts_held
from ..types import InputError, Mesh


class NoSurface(InputError):
    """There is no mesh, or one without triangles."""


@interrupts_held()  # trimesh swallows nearly all that come while it is imported
def load_mesh(path: Path, mend: str = "replace it") -> Mesh:
    """Read a triangle mesh (PLY, OBJ, GLB ...) with vertex colours where it has them.

    mend: what to do about one that is damaged. Raises NoSurface for one without triangles, else InputError.
    """
    try:
        import trimesh
    except ImportError:
        raise InputError(f"{path}: reading a mesh needs trimesh; install it with: pip install trimesh") from None
    try:
        mesh: Any = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # trimesh raises whatever its many readers do
        raise InputError(f"{path}: not a readable mesh ({' '.join(str(error).split())}); {mend}") from None
    if len(getattr(mesh, "faces", ())) == 0 or len(mesh.vertices) == 0:  # older trimeshes: a list, a PointCloud
        raise NoSurface(f"{path}: a mesh without triangles; {mend}")
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{path}: not a readable mesh (vertices that are not finite); {mend}")
    colored = mesh.visual.kind == "vertex"
    return Mesh(
        np.asarray(mesh.vertices, np.float32),
        np.asarray(mesh.faces, np.int32),
        np.asarray(mesh.visual.vertex_colors[:, :3], np.uint8) if colored else None,
    )


def ply_bytes(mesh: Mesh) -> bytes:
    """Binary little-endian PLY with vertex colours where the mesh has them."""
    fields = [("position", "<f4", 3)]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    if mesh.colors is not None:
        fields.append(("color", "u1", 3))
        header += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    vertices = np.empty(len(mesh.vertices), fields)
    vertices["position"] = mesh.vertices
    if mesh.colors is not None:
        vertices["color"] = mesh.colors
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, mesh.faces
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()


def first_existing(*candidates: Path) -> Path | None:
    """The first path that is a file, or None."""
    return next((path for path in candidates if path.is_file()), None)
