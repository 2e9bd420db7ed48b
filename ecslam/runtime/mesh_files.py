"""Meshes to bytes: binary PLY by a small writer of our own, GLB and OBJ through trimesh."""

from __future__ import annotations

import numpy as np

from ..types import InputError, Mesh


def ply_bytes(mesh: Mesh) -> bytes:
    """Binary little-endian PLY with vertex colours where the mesh has them."""
    columns: list[tuple[str, str]] = [(axis, "<f4") for axis in "xyz"]
    if mesh.colors is not None:
        columns += [(name, "u1") for name in ("red", "green", "blue")]
    vertices = np.empty(len(mesh.vertices), np.dtype(columns))
    for i, axis in enumerate("xyz"):
        vertices[axis] = mesh.vertices[:, i]
    if mesh.colors is not None:
        for i, name in enumerate(("red", "green", "blue")):
            vertices[name] = mesh.colors[:, i]
    faces = np.empty(len(mesh.faces), np.dtype([("count", "u1"), ("index", "<i4", (3,))]))
    faces["count"] = 3
    faces["index"] = mesh.faces
    names = {"<f4": "float", "u1": "uchar"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property {names[kind]} {name}" for name, kind in columns),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    return ("\n".join(header) + "\n").encode() + vertices.tobytes() + faces.tobytes()


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
