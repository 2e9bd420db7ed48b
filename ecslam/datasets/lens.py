"""What a lens does to images, undone by look-up tables."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Intrinsics


class Lens:
    """Of one camera; an ideal pinhole leaves images as they are."""

    def __init__(self, camera: Intrinsics) -> None:
        self._camera = camera

    def straight_color(self, color: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Colour [H, W, 3] without distortion."""
        if not self._camera.distortion:
            return color
        fixed, fraction, _ = self._maps
        return np.asarray(cv2.remap(color, fixed, fraction, cv2.INTER_LINEAR), np.uint8)

    def straight_depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Depth [H, W] without distortion: every pixel has a value that was measured."""
        if not self._camera.distortion:
            return depth
        flat = cv2.remap(depth, self._maps[2], None, cv2.INTER_NEAREST)  # type: ignore[call-overload]
        return np.asarray(flat, np.float32)

    @cached_property
    def _maps(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """In OpenCV's fast fixed-point form: two for linear colour, one, rounded, for nearest depth."""
        k, size = self._camera.matrix(), (self._camera.width, self._camera.height)
        x, y = cv2.initUndistortRectifyMap(k, np.array(self._camera.distortion), None, k, size, cv2.CV_32FC1)
        fixed, fraction = cv2.convertMaps(x, y, cv2.CV_16SC2)
        rounded, _ = cv2.convertMaps(x, y, cv2.CV_16SC2, nninterpolation=True)
        return fixed, fraction, rounded
