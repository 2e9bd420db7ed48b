"""The stored pixels of each keyframe: a few percent of the image, in camera coordinates (poses live in Trajectory)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .pixels import Pixels

THUMBNAIL = (40, 30)


@dataclass(frozen=True)
class Keyframe:
    """frame: index in the sequence. thumbnail: float32 [30 * 40], blurred luminance of zero mean and unit norm."""

    frame: int
    pixels: Pixels
    thumbnail: NDArray[np.float32]


def make_thumbnail(color: NDArray[np.uint8]) -> NDArray[np.float32]:
    """A tiny blurred picture whose dot product with another one is their correlation."""
    small = cv2.resize(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), THUMBNAIL, interpolation=cv2.INTER_AREA)
    flat = np.asarray(cv2.GaussianBlur(small.astype(np.float32), (0, 0), 1.5), np.float32).reshape(-1)
    flat -= flat.mean()
    return flat / np.float32(max(float(np.linalg.norm(flat)), 1e-6))


def most_similar(keyframes: list[Keyframe], thumbnail: NDArray[np.float32], count: int) -> list[int]:
    """Indices of the ``count`` keyframes that look most like ``thumbnail``, best first."""
    score = np.stack([k.thumbnail for k in keyframes]) @ thumbnail
    return [int(i) for i in np.argsort(-score)[:count]]
