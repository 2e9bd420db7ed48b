"""What a lens does to images, undone by look-up tables."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Intrinsics


class LookUp:
    """Images whose pixels are looked up in others, at x and y: [H, W], pixels; 0 outside. Held in OpenCV's fast
    fixed-point form."""

    def __init__(self, x: NDArray[Any], y: NDArray[Any]) -> None:
        x, y = x.astype(np.float32), y.astype(np.float32)
        self._fixed, self._fraction = cv2.convertMaps(x, y, cv2.CV_16SC2)
        self._rounded, _ = cv2.convertMaps(x, y, cv2.CV_16SC2, nninterpolation=True)

    def color(self, color: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Colour [H, W, 3], interpolated linearly."""
        return np.asarray(cv2.remap(color, self._fixed, self._fraction, cv2.INTER_LINEAR), np.uint8)

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Depth [H, W] of the nearest pixel: every pixel has a value that was measured."""
        flat = cv2.remap(depth, self._rounded, None, cv2.INTER_NEAREST)  # type: ignore[call-overload]
        return np.asarray(flat, np.float32)


class Lens:
    """Of one camera; an ideal pinhole leaves images as they are."""

    def __init__(self, camera: Intrinsics) -> None:
        self._camera = camera

    def straight_color(self, color: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Colour [H, W, 3] without distortion."""
        return self._straight.color(color) if self._camera.distortion else color

    def straight_depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Depth [H, W] without distortion."""
        return self._straight.depth(depth) if self._camera.distortion else depth

    @cached_property
    def _straight(self) -> LookUp:
        k, size = self._camera.matrix(), (self._camera.width, self._camera.height)
        return LookUp(*cv2.initUndistortRectifyMap(k, np.array(self._camera.distortion), None, k, size, cv2.CV_32FC1))
