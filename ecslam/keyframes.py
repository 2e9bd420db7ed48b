"""What is stored of each keyframe, in camera coordinates (poses live in Trajectory): a few percent of the image, and
what it is known again by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import Config
from .landmarks import KEPT, LANDMARK_BYTES, Landmarks, find_landmarks
from .pixels import Pixels, choose_pixels
from .shutter import Sweep, straight, straight_pixels
from .types import Frame, Intrinsics

THUMBNAIL = (40, 30)
THUMBNAIL_BYTES = 4 * THUMBNAIL[0] * THUMBNAIL[1]
HEAD_BYTES, PIXEL_BYTES = 4, 16
BLOCK, ALIGNMENT = 32 << 20, 64  # bytes; the end of a block takes no memory before it is written to


@dataclass(frozen=True, slots=True)
class Keyframe:
    """One keyframe in one piece of memory, so that a thousand of them cost nothing but their pixels.

    frame: index in the sequence. record: uint8 [bytes]: how many landmarks there are (int32), the thumbnail, the arrays
    of the landmarks and those of the pixels.
    """

    frame: int
    record: NDArray[np.uint8]

    @classmethod
    def of(cls, frame: int, pixels: Pixels, thumbnail: NDArray[np.float32], landmarks: Landmarks) -> Keyframe:
        """A keyframe with copies of these arrays."""
        head = np.array([len(landmarks)], np.int32)
        known = (head, thumbnail, landmarks.points, landmarks.descriptors)
        parts = (*known, pixels.direction, pixels.depth, pixels.color, pixels.feature)
        return cls(frame, np.concatenate([part.ravel().view(np.uint8) for part in parts]))

    def straight(self, camera: Intrinsics, sweep: Sweep) -> Keyframe:
        """The same keyframe as seen halfway through a ``sweep`` (see ``shutter``)."""
        if not sweep.any():
            return self
        known = self.landmarks
        landmarks = replace(known, points=straight(known.points, camera, sweep))
        return Keyframe.of(self.frame, straight_pixels(self.pixels, camera, sweep), self.thumbnail, landmarks)

    def __len__(self) -> int:
        """How many pixels are stored."""
        return (len(self.record) - self._pixels_from) // PIXEL_BYTES

    @property
    def pixels(self) -> Pixels:
        """The stored pixels, views of ``record``."""
        n, stored = len(self), self.record[self._pixels_from :]
        return Pixels(
            stored[: 8 * n].view(np.float32).reshape(n, 2),
            stored[8 * n : 12 * n].view(np.float32),
            stored[12 * n : 15 * n].reshape(n, 3),
            stored[15 * n :].view(np.bool_),
        )

    @property
    def landmarks(self) -> Landmarks:
        """The stored landmarks, views of ``record``."""
        n, stored = self._landmarks, self.record[HEAD_BYTES + THUMBNAIL_BYTES : self._pixels_from]
        return Landmarks(stored[: 12 * n].view(np.float32).reshape(n, 3), stored[12 * n :].reshape(n, 32))

    @property
    def thumbnail(self) -> NDArray[np.float32]:
        """float32 [30 * 40], blurred luminance of zero mean and unit norm."""
        return self.record[HEAD_BYTES : HEAD_BYTES + THUMBNAIL_BYTES].view(np.float32)

    @property
    def _landmarks(self) -> int:
        return int(self.record[:HEAD_BYTES].view(np.int32)[0])

    @property
    def _pixels_from(self) -> int:
        return HEAD_BYTES + THUMBNAIL_BYTES + LANDMARK_BYTES * self._landmarks


class Shelf:
    """Keeps keyframes side by side in large blocks of memory: each for itself would lie among what the engine needs for
    a moment, and pin the gaps."""

    def __init__(self) -> None:
        self._free = np.empty(0, np.uint8)

    def keep(self, keyframe: Keyframe) -> Keyframe:
        """The same keyframe, moved here."""
        count = len(keyframe.record)
        size = -(-count // ALIGNMENT) * ALIGNMENT
        if size > len(self._free):
            self._free = np.empty(max(size, BLOCK), np.uint8)
        kept, self._free = self._free[:count], self._free[size:]
        kept[:] = keyframe.record
        return Keyframe(keyframe.frame, kept)


@dataclass(frozen=True, slots=True)
class Prepared:
    """A keyframe made before its turn, and the configuration it was made by."""

    config: Config
    keyframe: Keyframe


def prepared(frame: Frame, camera: Intrinsics, config: Config) -> Frame:
    """The frame with the keyframe that it will become, for ``make_keyframe`` to find."""
    return replace(frame, keyframe=Prepared(config, make_keyframe(frame, camera, config)))


def make_keyframe(frame: Frame, camera: Intrinsics, config: Config) -> Keyframe:
    """Choose and keep ``keyframe_share`` of a frame's pixels, the same whoever asks."""
    if isinstance(frame.keyframe, Prepared) and frame.keyframe.config == config:
        return frame.keyframe.keyframe
    rng = np.random.default_rng([config.seed, frame.index])
    count = max(64, round(config.keyframe_share * frame.depth.size))
    pixels = choose_pixels(frame, camera, count, config, rng, rim=config.mapping.rim)
    if not config.sampling.without_depth:
        pixels = pixels.take(np.flatnonzero(pixels.depth > 0))
    landmarks = find_landmarks(frame, camera, config, KEPT)
    return Keyframe.of(frame.index, pixels, make_thumbnail(frame.color), landmarks)


def make_thumbnail(color: NDArray[np.uint8]) -> NDArray[np.float32]:
    """A tiny blurred picture whose dot product with another one is their correlation."""
    small = cv2.resize(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), THUMBNAIL, interpolation=cv2.INTER_AREA)
    flat = np.asarray(cv2.GaussianBlur(small.astype(np.float32), (0, 0), 1.5), np.float32).reshape(-1)
    flat -= flat.mean()
    return flat / np.float32(max(float(np.linalg.norm(flat)), 1e-6))


def surface_points(keyframes: Sequence[Keyframe], poses: NDArray[np.float64], limit: int) -> NDArray[np.float32]:
    """Measured points [N, 3] of keyframes in the world, given their poses [K, 4, 4]: about ``limit`` of them where
    there are more."""
    stride = max(1, -(-sum(map(len, keyframes)) // limit))
    parts = [keyframe.pixels.every(stride).in_world(pose) for keyframe, pose in zip(keyframes, poses, strict=True)]
    return np.concatenate(parts) if parts else np.empty((0, 3), np.float32)


def most_similar(keyframes: list[Keyframe], thumbnail: NDArray[np.float32], count: int) -> list[int]:
    """Indices of the ``count`` keyframes that look most like ``thumbnail``, best first."""
    score = np.stack([k.thumbnail for k in keyframes]) @ thumbnail
    return [int(i) for i in np.argsort(-score)[:count]]
