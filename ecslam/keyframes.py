"""The stored pixels of each keyframe: a few percent of the image, in camera coordinates (poses live in Trajectory)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import Config
from .pixels import Pixels, choose_pixels
from .types import Frame, Intrinsics

THUMBNAIL = (40, 30)
BLOCK, ALIGNMENT = 32 << 20, 64  # bytes; an untouched end of a block takes no memory, an unused one would


@dataclass(frozen=True, slots=True)
class Keyframe:
    """frame: index in the sequence. thumbnail: float32 [30 * 40], blurred luminance of zero mean and unit norm."""

    frame: int
    pixels: Pixels
    thumbnail: NDArray[np.float32]


class Shelf:
    """Keeps the arrays of keyframes side by side in large blocks of memory: each for itself would lie among what the
    engine needs for a moment, and pin the gaps."""

    def __init__(self) -> None:
        self._free = np.empty(0, np.uint8)

    def keep(self, keyframe: Keyframe) -> Keyframe:
        """The same keyframe, its arrays moved here."""
        pixels = Pixels(*(self._put(getattr(keyframe.pixels, f.name)) for f in fields(Pixels)))
        return Keyframe(keyframe.frame, pixels, self._put(keyframe.thumbnail))

    def _put(self, array: NDArray[Any]) -> NDArray[Any]:
        size = -(-array.nbytes // ALIGNMENT) * ALIGNMENT
        if size > len(self._free):
            self._free = np.empty(max(size, BLOCK), np.uint8)
        kept = self._free[: array.nbytes].view(array.dtype).reshape(array.shape)
        self._free = self._free[size:]
        kept[...] = array
        return kept


def make_keyframe(frame: Frame, camera: Intrinsics, config: Config, rng: np.random.Generator) -> Keyframe:
    """Choose and keep ``keyframe_share`` of a frame's pixels."""
    count = max(64, round(config.keyframe_share * frame.depth.size))
    pixels = choose_pixels(frame, camera, count, config, rng, rim=config.mapping.rim)
    if not config.sampling.without_depth:
        pixels = pixels.take(np.flatnonzero(pixels.depth > 0))
    return Keyframe(frame.index, pixels, make_thumbnail(frame.color))


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
