"""A camera that exposes for what it sees, as those of phones and of the Kinect do: dark views brightened, bright ones
darkened, each image for itself."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

AIM, STRENGTH = 110.0, 0.8  # the mean brightness of 255 that it aims at, and how far it goes there
LEAST, MOST = 0.5, 2.0


def exposed(color: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image [H, W, 3] as such a camera takes it: what becomes too bright is cut off."""
    mean = max(float(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).mean()), 1.0)
    gain = min(max((AIM / mean) ** STRENGTH, LEAST), MOST)
    return np.asarray(np.rint(np.minimum(color * np.float32(gain), 255)), np.uint8)
