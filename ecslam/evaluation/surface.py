"""What evaluation needs from a triangle mesh: even samples, small triangles, a part of it, another place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..types import Mesh
from .trajectory import Similarity


def sample_surface(mesh: Mesh, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """``count`` points [count, 3] spread evenly over the area; none when the mesh has no area."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)  # [F, 3, 3]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    until = np.cumsum(areas)
    if not len(until) or until[-1] <= 0:
        return np.zeros((0, 3))
    face = np.searchsorted(until, rng.uniform(0, until[-1], count), side="right")
    a, b, c = np.moveaxis(corners[np.minimum(face, len(until) - 1)], 1, 0)
    root, share = np.sqrt(rng.uniform(size=(count, 1))), rng.uniform(size=(count, 1))
    return (1 - root) * a + root * (1 - share) * b + root * share * c


def subdivided(mesh: Mesh, max_edge_m: float) -> Mesh:
    """The same surface, without colours, in triangles whose edges are at most ``max_edge_m`` long.

    Longer ones are halved at their longest edge. Faces keep their orientation. Neighbours may be split differently:
    good for looking at vertices, not for topology.
    """
    vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
    done = [np.zeros((0, 3), np.int32)]
    while len(faces):
        corners = vertices[faces]
        lengths = np.linalg.norm(corners[:, [1, 2, 0]] - corners, axis=2)  # edge k runs from corner k to corner k + 1
        longest = lengths.argmax(1)
        small = lengths.max(1) <= max_edge_m
        done.append(faces[small])
        order = (longest[~small, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(faces[~small], order, 1).T
        ends, middle = np.unique(np.sort(np.stack([a, b], 1), 1), axis=0, return_inverse=True)
        m = (middle.reshape(-1) + len(vertices)).astype(np.int32)
        vertices = np.concatenate([vertices, vertices[ends].mean(1, dtype=np.float32)])
        faces = np.concatenate([np.stack([a, m, c], 1), np.stack([m, b, c], 1)])
    return Mesh(vertices, np.concatenate(done))


def part(mesh: Mesh, faces: NDArray[np.bool_]) -> Mesh:
    """The faces where bool [F] is True, and the vertices they use."""
    kept = mesh.faces[faces]
    used, renumbered = np.unique(kept, return_inverse=True)
    colors = None if mesh.colors is None else mesh.colors[used]
    return Mesh(mesh.vertices[used], renumbered.reshape(-1, 3).astype(np.int32), colors)


def moved(mesh: Mesh, motion: Similarity) -> Mesh:
    """The mesh at another place."""
    return replace(mesh, vertices=motion.apply(mesh.vertices.astype(np.float64)).astype(np.float32))
