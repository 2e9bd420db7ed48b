"""Meshes as the browser wants them: few enough triangles, in a GLB with true vertex colours."""

from __future__ import annotations

import json
import struct
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ecslam.types import Mesh

TRIANGLE_BUDGET = 100_000

_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125
_SRGB = np.arange(256) / 255.0
_LINEAR = np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)
# glTF vertex colours are linear; 16 bits keep the dark end of 8-bit sRGB apart.
_SRGB_TO_LINEAR16 = np.round(_LINEAR * 65535).astype(np.uint16)


def simplify(mesh: Mesh, triangles: int = TRIANGLE_BUDGET) -> Mesh:
    """At most about ``triangles`` triangles by merging vertices in the cells of a grid; unchanged if few enough."""
    count = len(mesh.faces)
    if count <= triangles:
        return mesh
    normals = mesh.face_normals()
    area = np.linalg.norm(normals, axis=1).sum() / 2
    cell = float(np.sqrt(2 * area / triangles))
    while True:
        out = _cluster(mesh, normals, cell)
        if len(out.faces) <= triangles:
            return out
        cell *= 1.15


def _cluster(mesh: Mesh, normals: NDArray[np.float64], cell: float) -> Mesh:
    """The mesh with one vertex in each cell of a grid, without the faces that collapse or turn away from ``normals``,
    which they had before."""
    key = np.floor((mesh.vertices - mesh.vertices.min(0)) / cell).astype(np.int64)
    size = key.max(0) + 1
    flat = (key[:, 0] * size[1] + key[:, 1]) * size[2] + key[:, 2]
    _, group, counts = np.unique(flat, return_inverse=True, return_counts=True)

    def mean(values: NDArray[np.generic]) -> NDArray[np.float64]:
        return np.stack([np.bincount(group, values[:, k], len(counts)) / counts for k in range(3)], 1)

    faces = group[mesh.faces]
    kept = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    colors = None if mesh.colors is None else np.round(mean(mesh.colors)).astype(np.uint8)
    out = Mesh(mean(mesh.vertices).astype(np.float32), faces[kept].astype(np.int32), colors)
    turned = (normals[kept] * out.face_normals()).sum(1) <= 0
    return replace(out, faces=out.faces[~turned])


def to_glb(mesh: Mesh, colors: NDArray[np.uint8], wireframe: bool = False) -> bytes:
    """A binary glTF of the mesh with sRGB vertex ``colors`` [V, 3], unlit so that they show as they were seen.

    Only front faces are drawn: a room seen from outside opens like a doll's house. ``wireframe`` draws its edges.
    """
    index = _edges(mesh.faces) if wireframe else mesh.faces
    rgba = np.full((len(mesh.vertices), 4), 65535, np.uint16)
    rgba[:, :3] = _SRGB_TO_LINEAR16[colors]
    position = np.ascontiguousarray(mesh.vertices, np.float32)
    small = len(position) <= 65535  # 65535 itself means "start again" to a GPU
    index_type = _UINT16 if small else _UINT32
    parts = [position.tobytes(), rgba.tobytes(), index.astype(np.uint16 if small else np.uint32).tobytes()]
    parts[-1] += bytes(-len(parts[-1]) % 4)
    offsets = np.cumsum([0, *map(len, parts)]).tolist()
    low, high = position.min(0).tolist(), position.max(0).tolist()
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "materials": [{"extensions": {"KHR_materials_unlit": {}}}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "COLOR_0": 1},
                        "indices": 2,
                        "mode": 1 if wireframe else 4,
                        "material": 0,
                    }
                ]
            }
        ],
        "buffers": [{"byteLength": offsets[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(part), "target": target}
            for start, part, target in zip(offsets, parts, (34962, 34962, 34963), strict=False)
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": len(position),
                "type": "VEC3",
                "min": low,
                "max": high,
            },
            {"bufferView": 1, "componentType": _UINT16, "count": len(rgba), "type": "VEC4", "normalized": True},
            {
                "bufferView": 2,
                "componentType": index_type,
                "count": int(index.size),
                "type": "SCALAR",
            },
        ],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(parts)
    header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(body))
    return header + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body


def _edges(faces: NDArray[np.int32]) -> NDArray[np.int32]:
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1).astype(np.int64)
    keys = np.unique(pairs[:, 0] * (pairs[:, 1].max(initial=0) + 1) + pairs[:, 1])
    return np.stack(np.divmod(keys, pairs[:, 1].max(initial=0) + 1), 1).astype(np.int32)
