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

from .rigid import inverse
from .types import Frame, Intrinsics

COLUMNS, SAMPLES = 64, 4  # cells in a row of the image, and pixels of a cell's row or column that are looked at
KEPT, EVERY = 17, 2  # keyframes that are remembered, and each which of them is asked
FRONT_M, FRONT_PER_M = 0.1, 0.03  # a point has come that is so much nearer than what was seen
LEAST, MOST = 0.006, 0.7  # of all cells: fewer are noise, more are a wrong pose
SLOPE = 0.03  # of the depth, between neighbouring cells of one surface

MOVING = "something moves in the picture and is left out"

Cells = NDArray[np.float32]
Mask = NDArray[np.bool_]


class Movers:
    """Remembers what the last keyframes saw. The engine thread alone writes it."""

    def __init__(self, camera: Intrinsics) -> None:
        self._camera = camera
        self._seen: list[NDArray[np.float32]] = []
        self._keyframes: list[int] = []

    def remember(self, frame: Frame, keyframe: int) -> None:
        """Keep what a frame saw that is the keyframe number ``keyframe``."""
        self._seen = [*self._seen, around(relief(frame.depth))][-KEPT:]
        self._keyframes = [*self._keyframes, keyframe][-KEPT:]

    def without(self, frame: Frame, c2w: NDArray[np.float64], keyframe_poses: NDArray[np.float64]) -> Frame:
        """The frame, seen from about c2w [4, 4], with no depth where something has come; itself where nothing has.
        keyframe_poses: [K, 4, 4] of all keyframes."""
        asked = range(len(self._seen))[::-EVERY]
        if not asked:
            return frame
        near, cell = relief(frame.depth), cell_px(frame.depth)
        seen, poses = np.stack([self._seen[i] for i in asked]), keyframe_poses[[self._keyframes[i] for i in asked]]
        came, settled = compare(near, cell_lens(self._camera, cell), c2w, seen, poses)
        region = grown(large(came), near, ~settled)
        if not region.any() or region.mean() > MOST:
            return frame
        hidden = cv2.dilate(region.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        sides = zip(frame.depth.shape, near.shape, strict=True)
        rows, columns = (np.minimum(np.arange(pixels) // cell, cells - 1) for pixels, cells in sides)
        return replace(frame, depth=np.where(hidden[rows][:, columns], np.float32(0), frame.depth), keyframe=None)

    def state(self) -> dict[str, NDArray[Any]]:
        """What ``load`` needs."""
        return {"seen": np.array(self._seen, np.float32), "keyframes": np.array(self._keyframes, np.int64)}

    def load(self, state: dict[str, NDArray[Any]]) -> None:
        """Go on from what ``state`` gave."""
        self._seen, self._keyframes = list(state["seen"]), state["keyframes"].tolist()


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
    inside = ((np.arange(SAMPLES) + 0.5) * cell / SAMPLES).astype(int)
    rows, columns = (side // cell * cell for side in depth.shape)
    looked_at = np.stack([depth[v:rows:cell, u:columns:cell] for v in inside for u in inside])
    measured = (looked_at > 0) & (looked_at < np.inf)
    nearest = np.where(measured, looked_at, np.float32(np.inf)).min(0)
    return np.where(2 * measured.sum(0) >= len(measured), nearest, np.float32(0))


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
    fx, fy, cx, cy = lens
    rows, columns = near.shape
    v, u = np.indices(near.shape, np.float32)
    local = np.stack([(u - cx) / fx * near, (v - cy) / fy * near, near]).reshape(3, -1).astype(np.float32)
    to_view = (inverse(poses) @ c2w).astype(np.float32)
    x, y, z = (to_view[:, :3, :3] @ local + to_view[:, :3, 3:]).transpose(1, 0, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = np.rint(x / z * fx + cx), np.rint(y / z * fy + cy)
    inside = (z > 0) & (near.reshape(-1) > 0) & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    index = np.where(inside, row * columns + column, 0).astype(np.int64)
    nearest, farthest = (
        np.take_along_axis(depth.reshape(len(seen), -1), index, 1) for depth in (seen[:, 0], seen[:, 1])
    )
    inside &= nearest > 0
    margin = FRONT_M + FRONT_PER_M * nearest
    front = inside & (z < nearest - margin)
    surface = inside & ~front & (z < farthest + margin)
    return front.any(0).reshape(near.shape), surface.any(0).reshape(near.shape)


def large(mask: Mask) -> Mask:
    """The connected regions of a mask [h, w] that have at least ``LEAST`` of its cells."""
    _, labels, found, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    enough = found[:, cv2.CC_STAT_AREA] >= LEAST * mask.size
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
