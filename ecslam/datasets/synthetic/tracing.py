"""Rays in any direction through a scene: a bounding volume hierarchy in depth-first order with skip links."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .scene import GLOW, Scene
from .solids import ONE, ZERO, distance, enter, lean, scalar
from .surface import at, solid


class Tracer(NamedTuple):
    """box: float32 [B, 6] low and high corners. skip: int32 [B], node to go on with when a box is missed. leaf: int32
    [B], shape of a leaf or -1. local: float32 [N, 12], world to local rotation rows and offset."""

    box: NDArray[np.float32]
    skip: NDArray[np.int32]
    leaf: NDArray[np.int32]
    local: NDArray[np.float32]


def build(scene: Scene) -> Tracer:
    """Split shapes at the median of their centres along the longest axis, down to one a leaf."""
    half = scene.values[:, :3].astype(np.float64)
    reach = np.einsum("nij,nj->ni", np.abs(scene.rotation), half) + 1e-4
    low, high = scene.center - reach, scene.center + reach
    boxes: list[NDArray[np.float64]] = []
    skip: list[int] = []
    leaf: list[int] = []

    def grow(members: NDArray[np.intp]) -> None:
        node = len(boxes)
        boxes.append(np.concatenate([low[members].min(0), high[members].max(0)]))
        leaf.append(int(members[0]) if len(members) == 1 else -1)
        skip.append(0)
        if len(members) > 1:
            axis = np.ptp(scene.center[members], axis=0).argmax()
            ordered = members[np.argsort(scene.center[members, axis], kind="stable")]
            grow(ordered[: len(ordered) // 2])
            grow(ordered[len(ordered) // 2 :])
        skip[node] = len(boxes)

    grow(np.arange(len(half)))
    back = scene.rotation.transpose(0, 2, 1)
    offset = -np.einsum("nij,nj->ni", back, scene.center)
    local = np.concatenate([back.reshape(-1, 9), offset], 1).astype(np.float32)
    return Tracer(np.array(boxes, np.float32), np.array(skip, np.int32), np.array(leaf, np.int32), local)


@scalar
def to_local(local, k, x, y, z, w):
    """A world point (w = 1) or direction (w = 0) in the frame of shape k."""
    k = at(k)
    return (
        local[k, 0] * x + local[k, 1] * y + local[k, 2] * z + w * local[k, 9],
        local[k, 3] * x + local[k, 4] * y + local[k, 5] * z + w * local[k, 10],
        local[k, 6] * x + local[k, 7] * y + local[k, 8] * z + w * local[k, 11],
    )


@scalar
def _meets(box, node, ox, oy, oz, ix, iy, iz, limit):
    node = at(node)
    a, b = (box[node, 0] - ox) * ix, (box[node, 3] - ox) * ix
    near, far = min(a, b), max(a, b)
    a, b = (box[node, 1] - oy) * iy, (box[node, 4] - oy) * iy
    near, far = max(near, min(a, b)), min(far, max(a, b))
    a, b = (box[node, 2] - oz) * iz, (box[node, 5] - oz) * iz
    near, far = max(near, min(a, b)), min(far, max(a, b))
    return near <= far and far >= ZERO and near < limit


@lean
def trace(numbers, values, box, skip, leaf, local, ox, oy, oz, dx, dy, dz, limit, shadow):
    """(shape, distance) of the nearest hit within ``limit``; shape -1 for none. With ``shadow`` any hit will do, and
    shapes that glow are left out."""
    ix, iy, iz = ONE / dx, ONE / dy, ONE / dz
    which, node = -1, 0
    while node < len(skip):
        if not _meets(box, node, ox, oy, oz, ix, iy, iz, limit):
            node = skip[at(node)]
            continue
        k = leaf[at(node)]
        node += 1
        if k < 0 or (shadow and values[k, GLOW] > ZERO):
            continue
        kind, hx, hy, hz, extra = solid(numbers, values, k)
        px, py, pz = to_local(local, k, ox, oy, oz, ONE)
        qx, qy, qz = to_local(local, k, dx, dy, dz, ZERO)
        t = enter(kind, hx, hy, hz, extra, px, py, pz, qx, qy, qz)
        if t < limit:
            limit, which = t, k
            if shadow:
                break
    return which, limit


@lean
def buried(numbers, values, box, skip, leaf, local, x, y, z, owner):
    """Whether a point lies inside a shape other than ``owner``."""
    node = 0
    while node < len(skip):
        n = at(node)
        inside = box[n, 0] <= x <= box[n, 3] and box[n, 1] <= y <= box[n, 4] and box[n, 2] <= z <= box[n, 5]
        if not inside:
            node = skip[n]
            continue
        k = leaf[n]
        node += 1
        if k >= 0 and k != owner:
            kind, hx, hy, hz, extra = solid(numbers, values, k)
            px, py, pz = to_local(local, k, x, y, z, ONE)
            if distance(kind, hx, hy, hz, extra, px, py, pz) < ZERO:
                return True
    return False


@lean
def clearance(numbers, values, box, skip, leaf, local, x, y, z, owner, reach):
    """Distance from a point to the nearest shape other than ``owner``, negative inside one; ``reach`` where all are
    farther than that."""
    node, free = 0, reach
    while node < len(skip):
        n, wide = at(node), max(free, ZERO)
        near = (
            box[n, 0] - wide <= x <= box[n, 3] + wide
            and box[n, 1] - wide <= y <= box[n, 4] + wide
            and box[n, 2] - wide <= z <= box[n, 5] + wide
        )
        if not near:
            node = skip[n]
            continue
        k = leaf[n]
        node += 1
        if k >= 0 and k != owner:
            kind, hx, hy, hz, extra = solid(numbers, values, k)
            px, py, pz = to_local(local, k, x, y, z, ONE)
            free = min(free, distance(kind, hx, hy, hz, extra, px, py, pz))
    return free
