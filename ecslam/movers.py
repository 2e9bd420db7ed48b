"""What moves by itself is left out: who walks through the picture belongs neither to the room nor to its map (ours;
that space once seen to be free tells is known from Palazzolo et al., ReFusion, IROS 2019).

A point that lies clearly in front of what an earlier keyframe saw in its direction has come there since. From such
points a region grows over what no earlier keyframe has seen, as far as the surface goes on. What stays where it is
belongs to the room once the keyframes that saw through it are no longer asked.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .earlier import Cells, Views, cell_lens, cell_px, relief_of, to_views
from .kernels import earlier_views
from .types import Frame, Intrinsics

FRONT = np.array([0.1, 0.03], np.float32)  # metres, and share of the depth: a point has come that is so much nearer
LEAST, MOST = 0.006, 0.7  # of all cells: fewer are noise, more are a wrong pose
SLOPE = 0.03  # of the depth, between neighbouring cells of one surface

Mask = NDArray[np.bool_]


def without_movers(
    frame: Frame, camera: Intrinsics, c2w: NDArray[np.float64], earlier: Views, keyframe_poses: NDArray[np.float64]
) -> Frame:
    """The frame, seen from about c2w [4, 4], with no depth where something has come since ``earlier`` views; itself
    where nothing has. keyframe_poses: [K, 4, 4] of all keyframes."""
    if not earlier.keyframes:
        return frame
    near, cell = relief_of(frame), cell_px(frame.depth.shape[1])
    came, settled = compare(near, cell_lens(camera, cell), c2w, earlier.seen, keyframe_poses[earlier.keyframes])
    seed = large(came)
    region = grown(seed, near, ~settled) if seed.any() else seed
    if not 0 < region.mean() <= MOST:
        return frame
    hidden = cv2.dilate(region.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    sides = zip(frame.depth.shape, near.shape, strict=True)
    rows, columns = (np.minimum(np.arange(pixels) // cell, cells - 1) for pixels, cells in sides)
    left = np.where(hidden[rows][:, columns], np.float32(0), frame.depth)
    return replace(frame, depth=left, relief=None, keyframe=None)


def compare(
    near: Cells,
    lens: NDArray[np.float32],
    c2w: NDArray[np.float64],
    seen: NDArray[np.float32],
    poses: NDArray[np.float64],
) -> tuple[Mask, Mask]:
    """Which cells [h, w] lie in front of what one of the views saw there, and which where one of them saw a surface.

    near: depth of the cells, from c2w [4, 4]. lens: see ``cell_lens``. seen: what is ``around`` those of earlier views
    [V, 2, h, w], which are from ``poses`` [V, 4, 4].
    """
    came, settled = np.zeros((2, *near.shape), np.bool_)
    earlier_views.compare(near, lens, to_views(c2w, poses), seen, FRONT, came, settled)
    return came, settled


def large(mask: Mask) -> Mask:
    """The connected regions of a mask [h, w] that have at least ``LEAST`` of its cells."""
    least = LEAST * mask.size
    if np.count_nonzero(mask) < least:
        return np.zeros_like(mask)
    _, labels, found, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    enough = found[:, cv2.CC_STAT_AREA] >= least
    enough[0] = False
    return np.asarray(enough[labels])


def grown(region: Mask, near: Cells, free: Mask) -> Mask:
    """A region [h, w] and what its surface goes on to, from neighbour to neighbour, over ``free`` cells with depth."""
    square, left = np.ones((3, 3), np.uint8), free & (near > 0)
    while region.any():
        farthest = cv2.dilate(np.where(region, near, np.float32(-np.inf)), square)
        nearest = cv2.erode(np.where(region, near, np.float32(np.inf)), square)
        left &= ~region
        more = left & (near < farthest + SLOPE * near) & (near > nearest - SLOPE * near)
        if not more.any():
            break
        region = region | more
    return region
