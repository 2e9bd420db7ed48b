"""The loops that hold a frame against what earlier views saw (numba), in cells of a few pixels. What is worked out for
every cell is laid out so that several of a row go at once: without branches, and in plain float32."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def nearest(depth, cell, inside, out):
    """The nearest depth in each cell, 0 where less than half of it is measured.

    depth: float32 [H, W] metres. cell: its side in pixels; inside: int64 [S], the rows and columns of a cell that are
    looked at. out: float32 [H // cell, W // cell].
    """
    rows, columns = out.shape
    none, zero, enough = np.float32(np.inf), np.float32(0), np.int32(inside.shape[0] ** 2 - 1) // 2
    measured = np.empty(columns, np.int32)
    for row in range(rows):
        least = out[row]
        least[:], measured[:] = none, 0
        for i in range(inside.shape[0]):
            for j in range(inside.shape[0]):
                pixels = depth[row * cell + inside[i], inside[j] :]
                for column in range(columns):
                    z = pixels[column * cell]
                    there = (z > zero) & (z < none)
                    least[column] = min(least[column], z if there else none)
                    measured[column] += np.int32(1) if there else np.int32(0)
        for column in range(columns):
            least[column] = least[column] if measured[column] > enough else zero


@njit(nogil=True, cache=True, error_model="numpy")
def to_views(c2w, poses, out):
    """Motions ``out`` float32 [V, 3, 4] from the coordinates of a camera at c2w float64 [4, 4] to those of views from
    ``poses`` float64 [V, 4, 4]."""
    for view in range(poses.shape[0]):
        pose = poses[view]
        for i in range(3):
            for j in range(4):
                moved = 0.0
                for k in range(3):
                    moved += pose[k, i] * (c2w[k, j] - (pose[k, 3] if j == 3 else 0.0))
                out[view, i, j] = moved


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def project(depths, v, lens, to_view, rows, index, ahead):
    """Where a view [rows, columns] sees the cells of row ``v``: flat ``index``, -1 outside, and the depth ``ahead``."""
    fx, fy, cx, cy = lens
    m00, m01, m02, m03 = to_view[0]
    m10, m11, m12, m13 = to_view[1]
    m20, m21, m22, m23 = to_view[2]
    columns = depths.size
    zero, half, one, wide, high = np.float32(0), np.float32(0.5), np.float32(1), np.float32(columns), np.float32(rows)
    down = (np.float32(v) - cy) * (one / fy)
    for u in range(columns):
        depth = depths[u]
        a, b = (np.float32(u) - cx) * (one / fx) * depth, down * depth
        z = m20 * a + m21 * b + m22 * depth + m23
        column = (m00 * a + m01 * b + m02 * depth + m03) * (one / z) * fx + cx + half
        row = (m10 * a + m11 * b + m12 * depth + m13) * (one / z) * fy + cy + half
        inside = (depth > zero) & (z > zero)
        inside &= (column >= zero) & (column < wide) & (row >= zero) & (row < high)
        index[u] = np.int32(row) * np.int32(columns) + np.int32(column) if inside else np.int32(-1)
        ahead[u] = z


@njit(nogil=True, cache=True, error_model="numpy")
def compare(near, lens, to_view, seen, front, came, settled):
    """Note which cells lie in front of what one of the views saw there, and which where one of them saw a surface.

    near: float32 [h, w] depth of the cells. lens: float32 fx, fy, cx, cy in cells. to_view: float32 [V, 3, 4], from
    their camera's coordinates to those of each view. seen: float32 [V, 2, h, w], the nearest and the farthest depth
    about each cell of a view. front: float32, metres and share of the depth by which something is nearer that lies in
    front. came, settled: bool [h, w], False before.
    """
    rows, columns = near.shape
    index, ahead = np.empty(columns, np.int32), np.empty(columns, np.float32)
    for view in range(seen.shape[0]):
        least, most = seen[view, 0].ravel(), seen[view, 1].ravel()
        for v in range(rows):
            project(near[v], v, lens, to_view[view], rows, index, ahead)
            for u in range(columns):
                i = index[u]
                if i >= 0 and least[i] > np.float32(0):
                    margin = front[0] + front[1] * least[i]
                    if ahead[u] < least[i] - margin:
                        came[v, u] = True
                    elif ahead[u] < most[i] + margin:
                        settled[v, u] = True


@njit(nogil=True, cache=True, error_model="numpy")
def ratios(near, light, lens, to_view, seen, lights, within, every, stride, out):
    """How much brighter views saw what a frame sees: fills ``out`` float32 [V * h * w] with logarithms of the ratios,
    and returns how many there are.

    near, lens, to_view, seen: see ``compare``. light: float32 [h, w], logarithms of how bright the cells are, 0 where
    that tells nothing; lights: [V, h, w], those of the views. within: float32, metres and share of the depth by which
    what is one surface may differ. Every ``every``-th view is asked, about every ``stride``-th row and column of cells.
    """
    rows, columns = near.shape
    index, ahead = np.empty(columns, np.int32), np.empty(columns, np.float32)
    found = 0
    for view in range(0, seen.shape[0], every):
        least, most = seen[view, 0].ravel(), seen[view, 1].ravel()
        theirs = lights[view].ravel()
        for v in range(0, rows, stride):
            project(near[v], v, lens, to_view[view], rows, index, ahead)
            for u in range(0, columns, stride):
                i = index[u]
                if i >= 0 and least[i] > np.float32(0):
                    margin = within[0] + within[1] * least[i]
                    same = (ahead[u] > least[i] - margin) & (ahead[u] < most[i] + margin)
                    if same and theirs[i] > np.float32(0) and light[v, u] > np.float32(0):
                        out[found] = theirs[i] - light[v, u]
                        found += 1
    return found
