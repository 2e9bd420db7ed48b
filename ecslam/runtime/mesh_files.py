"""Meshes to bytes in the formats that can be taken away."""

from __future__ import annotations

from ..datasets.meshes import ply_bytes
from ..interrupts import interrupts_held
from ..types import InputError, Mesh


@interrupts_held()
def mesh_bytes(mesh: Mesh, format: str) -> bytes:
    """The mesh as ``ply``, ``glb`` or ``obj``. Raises InputError for another format or when trimesh is missing."""
    if format == "ply":
        return ply_bytes(mesh)
    if format not in ("glb", "obj"):
        raise InputError(f"mesh format {format!r}: there are ply, glb and obj")
    try:
        import trimesh
    except ImportError:
        raise InputError(f"writing a mesh as {format} needs trimesh; install it with: pip install trimesh") from None
    made = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colors, process=False)
    data = made.export(file_type=format)
    return data.encode() if isinstance(data, str) else bytes(data)
