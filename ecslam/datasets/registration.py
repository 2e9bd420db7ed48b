"""Colour moved to where depth sees it, for recordings of two cameras side by side that nobody has registered.

A pixel of depth knows where it lies in space, so what colour it has is looked up; the other way round depth would get
holes. So a frame's camera is that of depth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import InputError, Intrinsics
from .images import shrunk
from .lens import Lens

UNKNOWN_M = 3.0  # what is taken for the distance of pixels without depth
SEEN_FROM_M = 1.0  # both cameras see the whole of a frame from here on
LEAST_SHARE = 0.2
FINER = 1.5


@dataclass(frozen=True, eq=False)
class Registration:
    """depth, color: the cameras of the images as stored, distortion included. depth_to_color: [4, 4] takes points in
    metres from the first one's coordinates to the second one's. Raises InputError where the two hardly see the same."""

    depth: Intrinsics
    color: Intrinsics
    depth_to_color: NDArray[np.float64]

    def __post_init__(self) -> None:
        rows, columns = self._both
        seen = (rows.stop - rows.start) * (columns.stop - columns.start)
        if seen < LEAST_SHARE * self.depth.width * self.depth.height:
            raise InputError(
                "the cameras of colour and depth hardly see the same: the motion between them must take points from "
                "depth to colour, in metres"
            )

    @property
    def camera(self) -> Intrinsics:
        """Of the frames: that of depth without distortion, cut to what colour sees as well."""
        rows, columns = self._both
        width, height = columns.stop - columns.start, rows.stop - rows.start
        k, center = self.depth, (self.depth.cx - columns.start, self.depth.cy - rows.start)
        return Intrinsics(k.fx, k.fy, *center, width, height, readout_s=k.readout_s * height / k.height)

    def registered(
        self, color: NDArray[np.uint8], depth: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Colour and depth of ``camera`` from images as stored, depth in metres; 0 where colour does not see it."""
        color = self._color_lens.straight_color(color)
        if self._seen.width != color.shape[1]:
            color = shrunk(color, (self._seen.width, self._seen.height))
        depth = self._depth_lens.straight_depth(depth)[self._both]
        inverse = np.float32(1) / np.where(depth > 0, depth, np.float32(UNKNOWN_M))
        x, y = _projected(self._far[:, self._both[0], self._both[1]], self._shift, inverse)
        moved = cv2.remap(color, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(moved, np.uint8), depth * _inside(x, y, self._seen)

    @cached_property
    def _seen(self) -> Intrinsics:
        """The camera of colour, coarser where it is much finer than depth."""
        ideal, factor = replace(self.color, distortion=()), self.color.fx / self.depth.fx
        if factor < FINER:
            return ideal
        return ideal.resized(round(ideal.width / factor), round(ideal.height / factor))

    @cached_property
    def _far(self) -> NDArray[np.float32]:
        """[3, H, W] where colour sees what each pixel of depth looks at, were it infinitely far (homogeneous)."""
        v, u = np.mgrid[: self.depth.height, : self.depth.width]
        through = self._seen.matrix() @ self.depth_to_color[:3, :3] @ np.linalg.inv(self.depth.matrix())
        return np.einsum("ij,jhw->ihw", through, np.stack([u, v, np.ones_like(u)])).astype(np.float32)

    @cached_property
    def _shift(self) -> NDArray[np.float32]:
        """[3] by how much that moves, times the inverse of the depth."""
        return (self._seen.matrix() @ self.depth_to_color[:3, 3]).astype(np.float32)

    @cached_property
    def _both(self) -> tuple[slice, slice]:
        """Rows and columns of depth that colour sees, too, as long as they are ``SEEN_FROM_M`` away or farther."""
        inverses = (np.full_like(self._far[0], inverse) for inverse in (1 / SEEN_FROM_M, 0.0))
        ends = (_projected(self._far, self._shift, inverse) for inverse in inverses)
        near, far = (_inside(x, y, self._seen) for x, y in ends)
        return _all_true(near & far)

    @cached_property
    def _color_lens(self) -> Lens:
        return Lens(self.color)

    @cached_property
    def _depth_lens(self) -> Lens:
        return Lens(self.depth)


def _projected(
    far: NDArray[np.float32], shift: NDArray[np.float32], inverse: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where colour sees pixels, x and y [H, W], given ``_far``, ``_shift`` and 1 / depth [H, W]; NaN behind it."""
    x, y = shift[0] * inverse, shift[1] * inverse
    x += far[0]
    y += far[1]
    if shift[2] or (far[2] != 1).any():  # else the two look the same way
        z = far[2] + shift[2] * inverse
        z[z <= 0] = np.nan
        x /= z
        y /= z
    return x, y


def _inside(x: NDArray[np.float32], y: NDArray[np.float32], camera: Intrinsics) -> NDArray[np.bool_]:
    """[H, W] whether the image of ``camera`` shows what lies at x and y."""
    return np.asarray((x > -0.5) & (x < camera.width - 0.5) & (y > -0.5) & (y < camera.height - 0.5))


def _all_true(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns between which all of ``mask`` [H, W] is true: the outer line with most that is not goes."""
    (top, left), (bottom, right) = (0, 0), mask.shape
    while not mask[top:bottom, left:right].all():
        out = ~mask[top:bottom, left:right]
        worst = int(np.argmax([out[0].mean(), out[-1].mean(), out[:, 0].mean(), out[:, -1].mean()]))
        top, bottom, left, right = np.array([top, bottom, left, right]) + np.diag([1, -1, 1, -1])[worst]
    return slice(int(top), int(bottom)), slice(int(left), int(right))
