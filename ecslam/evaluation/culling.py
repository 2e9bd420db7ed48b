"""Leaving out what no camera saw, so that a map is judged by what it was shown.

As in Co-SLAM's protocol a vertex counts as seen when, in at least one frame, it projects into the image and is not more
than 3 cm behind the surface there, and a face is kept when one of its corners was seen; the surface there is the mesh
itself, rendered from the same pose, both sides visible. (NICE-SLAM's looks at the frustum alone.) What differs: Co-SLAM
adds virtual cameras, placed by hand for each scene, for parts that were occluded all the time; here at most 200 evenly
spaced frames are used, at no more than 640 pixels of width; and long triangles are split first, or a wall made of two
triangles would be kept or dropped as a whole.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from ..cores import cores
from ..indices import evenly
from ..kernels.raster import in_sight, rasterize
from ..types import Intrinsics, Mesh
from .surface import part

OCCLUSION_MARGIN_M = 0.03
WORKERS = cores()

DepthFunction = Callable[[int], NDArray[np.float32]]


def spread_frames(poses: NDArray[np.float64], limit: int = 200) -> NDArray[np.int64]:
    """At most ``limit`` evenly spaced indices of the poses [N, 4, 4] that are finite."""
    finite = np.flatnonzero(np.isfinite(poses).all((1, 2)))
    return finite[evenly(len(finite), limit)]


def rendered_depth(mesh: Mesh, poses: NDArray[np.float64], intrinsics: Intrinsics) -> DepthFunction:
    """index -> depth float32 [H, W] of the mesh from poses [N, 4, 4]."""
    return lambda index: rasterize(mesh, intrinsics, poses[index])[0]


def observed(
    points: NDArray[np.floating],
    poses: NDArray[np.float64],
    intrinsics: Intrinsics,
    depth: DepthFunction,
    margin_m: float | NDArray[np.floating] = OCCLUSION_MARGIN_M,
    *,
    progress: Callable[[float], None] | None = None,
) -> NDArray[np.bool_]:
    """bool [N]: which points [N, 3] some frame saw, i.e. have z <= depth + margin_m at the pixel they project to.

    poses: [M, 4, 4] camera-to-world, all finite. depth: index 0..M-1 -> [H, W], metres, 0 = none (sees nothing); called
    from several threads. margin_m: a number or [N]; with a negative one the answer is which points lie in free space.
    """
    points = np.asarray(points, np.float32)
    margins = np.broadcast_to(np.asarray(margin_m, np.float32), len(points))
    seen = np.zeros(len(points), bool)
    with ThreadPoolExecutor(WORKERS) as pool:
        for start in range(0, len(poses), 2 * WORKERS):
            frames = range(start, min(start + 2 * WORKERS, len(poses)))
            rest = np.flatnonzero(~seen)
            p, m = points[rest], margins[rest]
            for hit in pool.map(lambda i, p=p, m=m: in_sight(p, m, intrinsics, poses[i], depth(i)), frames):
                seen[rest] |= hit
            if progress is not None:
                progress(frames.stop / len(poses))
    return seen


def framed(points: NDArray[np.floating], poses: NDArray[np.float64], intrinsics: Intrinsics) -> NDArray[np.bool_]:
    """bool [N]: which points [N, 3] lie in the frustum of at least one of the poses [M, 4, 4], hidden or not."""
    endless = np.full((intrinsics.height, intrinsics.width), np.inf, np.float32)
    return observed(points, poses, intrinsics, lambda index: endless)


def culled(mesh: Mesh, seen: NDArray[np.bool_]) -> Mesh:
    """The faces with a corner among the seen vertices (bool [V])."""
    return part(mesh, faces_seen(mesh, seen))


def faces_seen(mesh: Mesh, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """bool [F] from bool [V]: at least one corner was seen."""
    return np.asarray(seen[mesh.faces].any(1))


def faces_seen_whole(mesh: Mesh, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """bool [F] from bool [V]: all corners were seen."""
    return np.asarray(seen[mesh.faces].all(1))
