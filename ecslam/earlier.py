"""What the last keyframes saw, in cells of a few pixels: whatever a new frame is held against."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .kernels import earlier_views
from .types import Frame, Intrinsics

COLUMNS, SAMPLES = 64, 4  # cells in a row of the image, and pixels of a cell's row or column whose depth is looked at
KEPT, EVERY = 17, 2  # keyframes that are remembered, and each which of them is asked
DARK, BRIGHT = 10.0, 245.0  # of 255: outside, a cell's mean says little about how bright its surface is

Cells = NDArray[np.float32]


class Views(NamedTuple):
    """Earlier views, the newest first. seen: float32 [V, 2, h, w], see ``around``. lights: float32 [V, h, w], see
    ``light``, at the first frame's exposure. keyframes: their numbers [V]."""

    seen: NDArray[np.float32]
    lights: NDArray[np.float32]
    keyframes: list[int]


class EarlierViews:
    """Remembers what the last keyframes saw. The engine thread alone writes it."""

    def __init__(self) -> None:
        self._seen: list[NDArray[np.float32]] = []
        self._lights: list[Cells] = []
        self._keyframes: list[int] = []
        self._ask()

    def _ask(self) -> None:
        """Work out which of what is remembered is asked from now on."""
        asked = range(len(self._seen))[::-EVERY]
        seen, lights = (np.array([kept[i] for i in asked]) for kept in (self._seen, self._lights))
        self.asked = Views(seen, lights, [self._keyframes[i] for i in asked])

    def remember(self, frame: Frame, keyframe: int) -> None:
        """Keep what a frame saw that is the keyframe number ``keyframe``."""
        self._seen = [*self._seen, around(relief_of(frame))][-KEPT:]
        self._lights = [*self._lights, _at_first(light_of(frame), frame.gain)][-KEPT:]
        self._keyframes = [*self._keyframes, keyframe][-KEPT:]
        self._ask()

    def state(self) -> dict[str, NDArray[Any]]:
        """What ``load`` needs."""
        seen, lights = (np.array(kept, np.float32) for kept in (self._seen, self._lights))
        return {"seen": seen, "lights": lights, "keyframes": np.array(self._keyframes, np.int64)}

    def load(self, state: dict[str, NDArray[Any]]) -> None:
        """Go on from what ``state`` gave."""
        self._seen, self._lights = list(state["seen"]), list(state["lights"])
        self._keyframes = state["keyframes"].tolist()
        self._ask()


def relief_of(frame: Frame) -> Cells:
    """A frame's relief, which somebody may have looked at already."""
    return relief(frame.depth) if frame.relief is None else frame.relief


def light_of(frame: Frame) -> Cells:
    """A frame's light, which somebody may have looked at already."""
    return light(frame.color) if frame.light is None else frame.light


def cell_px(width: int) -> int:
    """The side of a cell in pixels, of an image of that width."""
    return max(1, round(width / COLUMNS))


@cache
def cell_lens(camera: Intrinsics, cell: int) -> NDArray[np.float32]:
    """fx, fy, cx, cy of a camera whose pixels are the cells."""
    middle = (cell - 1) / 2
    centre = (camera.cx - middle) / cell, (camera.cy - middle) / cell
    return np.array([camera.fx / cell, camera.fy / cell, *centre], np.float32)


def to_views(c2w: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float32]:
    """Motions [V, 3, 4] from the coordinates of a camera at c2w [4, 4] to those of views from ``poses`` [V, 4, 4]."""
    out = np.empty((len(poses), 3, 4), np.float32)
    earlier_views.to_views(c2w, poses, out)
    return out


def relief(depth: NDArray[np.float32]) -> Cells:
    """The nearest depth in each cell [h, w] of an image, 0 where less than half of the cell is measured."""
    cell = cell_px(depth.shape[1])
    inside = ((np.arange(SAMPLES) + 0.5) * cell / SAMPLES).astype(np.int64)
    out = np.empty([side // cell for side in depth.shape], np.float32)
    earlier_views.nearest(np.ascontiguousarray(depth, np.float32), cell, inside, out)
    return out


def light(color: NDArray[np.uint8]) -> Cells:
    """The logarithm of the mean luminance of each cell [h, w] of an image; 0 where that is too dark or too bright."""
    cell = cell_px(color.shape[1])
    height, width = (side // cell for side in color.shape[:2])
    small = cv2.resize(color[: height * cell, : width * cell], (width, height), interpolation=cv2.INTER_AREA)
    mean = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    return np.log(np.where((mean >= DARK) & (mean <= BRIGHT), mean, 1), dtype=np.float32)


def _at_first(seen: Cells, gain: float) -> Cells:
    """What would have been seen at the exposure of the first frame, see ``light``; no gain makes it 0."""
    return np.where(seen > 0, seen + np.float32(np.log(gain)), np.float32(0))


def around(seen: Cells) -> NDArray[np.float32]:
    """The nearest and the farthest depth in and around each cell [2, h, w] of a view [h, w]; 0 where there is none in
    it."""
    square, known = np.ones((3, 3), np.uint8), seen > 0
    nearest = cv2.erode(np.where(known, seen, np.float32(np.inf)), square)
    return np.stack([np.where(known, nearest, np.float32(0)), cv2.dilate(seen, square)]).astype(np.float32)
