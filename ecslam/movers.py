"""What moves by itself is left out: who walks through the picture belongs neither to the room nor to its map (ours;
that space once seen to be free tells is known from Palazzolo et al., ReFusion, IROS 2019).

A point that lies clearly in front of what an earlier keyframe saw in its direction has come there since. From such
points a region grows over what no earlier keyframe has seen, as far as the surface goes on. What stays where it is
belongs to the room once the keyframes that saw through it are no longer asked.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .kernels import earlier_views
from .rigid import inverse
from .types import Frame, Intrinsics

COLUMNS, SAMPLES = 64, 4  # cells in a row of the image, and pixels of a cell's row or column that are looked at
KEPT, EVERY = 17, 2  # keyframes that are remembered, and each which of them is asked
FRONT_M, FRONT_PER_M = 0.1, 0.03  # a point has come that is so much nearer than what was seen
LEAST, MOST = 0.006, 0.7  # of all cells: fewer are noise, more are a wrong pose
SLOPE = 0.03  # of the depth, between neighbouring cells of one surface

Cells = NDArray[np.float32]
Mask = NDArray[np.bool_]


class Movers:
    """Remembers what the last keyframes saw. The engine thread alone writes it."""

    def __init__(self, camera: Intrinsics) -> None:
        self._camera = camera
        self._seen: list[NDArray[np.float32]] = []
        self._keyframes: list[int] = []
        self._ask()

    def _ask(self) -> None:
        """Work out which of what is remembered is asked from now on."""
        asked = range(len(self._seen))[::-EVERY]
        self._asked = np.array([self._seen[i] for i in asked]), [self._keyframes[i] for i in asked]

    def remember(self, frame: Frame, keyframe: int) -> None:
        """Keep what a frame saw that is the keyframe number ``keyframe``."""
        self._seen = [*self._seen, around(_relief_of(frame))][-KEPT:]
        self._keyframes = [*self._keyframes, keyframe][-KEPT:]
        self._ask()

    def without(self, frame: Frame, c2w: NDArray[np.float64], keyframe_poses: NDArray[np.float64]) -> Frame:
        """The frame, seen from about c2w [4, 4], with no depth where something has come; itself where nothing has.
        keyframe_poses: [K, 4, 4] of all keyframes."""
        seen, keyframes = self._asked
        if not keyframes:
            return frame
        near, cell = _relief_of(frame), cell_px(frame.depth)
        came, settled = compare(near, cell_lens(self._camera, cell), c2w, seen, keyframe_poses[keyframes])
        region = grown(large(came), near, ~settled)
        if not region.any() or region.mean() > MOST:
            return frame
        hidden = cv2.dilate(region.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        sides = zip(frame.depth.shape, near.shape, strict=True)
        rows, columns = (np.minimum(np.arange(pixels) // cell, cells - 1) for pixels, cells in sides)
        left = np.where(hidden[rows][:, columns], np.float32(0), frame.depth)
        return replace(frame, depth=left, relief=None, keyframe=None)

    def state(self) -> dict[str, NDArray[Any]]:
        """What ``load`` needs."""
        return {"seen": np.array(self._seen, np.float32), "keyframes": np.array(self._keyframes, np.int64)}

    def load(self, state: dict[str, NDArray[Any]]) -> None:
        """Go on from what ``state`` gave."""
        self._seen, self._keyframes = list(state["seen"]), state["keyframes"].tolist()
        self._ask()


def _relief_of(frame: Frame) -> Cells:
    return relief(frame.depth) if frame.relief is None else frame.relief


def cell_px(depth: NDArray[np.float32]) -> int:
    """The side of a cell of an image in pixels."""
    return max(1, round(depth.shape[1] / COLUMNS))


def cell_lens(camera: Intrinsics, cell: int) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a camera whose pixels are the cells."""
    middle = (cell - 1) / 2
    return camera.fx / cell, camera.fy / cell, (camera.cx - middle) / cell, (camera.cy - middle) / cell


def relief(depth: NDArray[np.float32]) -> Cells:
    """The nearest depth in each cell [h, w] of an image, 0 where less than half of the cell is measured."""
    cell = cell_px(depth)
    inside = ((np.arange(SAMPLES) + 0.5) * cell / SAMPLES).astype(np.int64)
    out = np.empty([side // cell for side in depth.shape], np.float32)
    earlier_views.nearest(np.ascontiguousarray(depth, np.float32), cell, inside, out)
    return out


def compare(
    near: Cells,
    lens: tuple[float, float, float, float],
    c2w: NDArray[np.float64],
    seen: NDArray[np.float32],
    poses: NDArray[np.float64],
) -> tuple[Mask, Mask]:
    """Which cells [h, w] lie in front of what one of the views saw there, and which where one of them saw a surface.

    near: depth of the cells, from c2w [4, 4]. seen: what is ``around`` those of earlier views [V, 2, h, w], which are
    from ``poses`` [V, 4, 4].
    """
    came, settled = np.zeros((2, *near.shape), np.bool_)
    to_view = (inverse(poses) @ c2w)[:, :3].astype(np.float32)
    front = np.array([FRONT_M, FRONT_PER_M], np.float32)
    earlier_views.compare(near, np.array(lens, np.float32), to_view, seen, front, came, settled)
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


def around(seen: Cells) -> NDArray[np.float32]:
    """The nearest and the farthest depth in and around each cell [2, h, w] of a view [h, w]; 0 where there is none in
    it."""
    square, known = np.ones((3, 3), np.uint8), seen > 0
    nearest = cv2.erode(np.where(known, seen, np.float32(np.inf)), square)
    return np.stack([np.where(known, nearest, np.float32(0)), cv2.dilate(seen, square)]).astype(np.float32)
