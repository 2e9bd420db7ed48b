"""Images of frames in memory that processes share, so that those who read them need not send them (Linux)."""

from __future__ import annotations

import mmap
import os
import threading
import weakref
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..types import Frame, Intrinsics

MOST_BYTES = 1 << 30
RESTING = 4  # slots that are left alone after their frame is gone: a GPU may still be fetching it
ALIGNMENT = 4096
OWN_DEPTH = np.empty((1, 1), np.float32)  # stands for measured depth that has a place of its own
NO_COLOR, NO_DEPTH = np.empty((0, 0, 3), np.uint8), np.empty((0, 0), np.float32)


class Slots:
    """Places for the images of ``count`` frames of a camera, fewer where that would be over ``MOST_BYTES``: colour,
    depth, and depth as it was measured.

    Whoever reads a frame ``put``s it into a slot in his process; ``found`` there by the one who asked for it, its
    images are views of the slot, which is taken until the last of them is gone. file: of the memory, for another
    process to open.
    """

    def __init__(self, camera: Intrinsics, count: int, file: int | None = None) -> None:
        """file: of memory that is there already, which it takes over; None for new memory. Raises OSError where there
        is none."""
        self._camera = camera
        self.count = count = min(count, MOST_BYTES // self._size)
        self.file = os.memfd_create("frames") if file is None else file
        if file is None:
            os.ftruncate(self.file, count * self._size)
        self.memory = mmap.mmap(self.file, count * self._size)
        self._free, self._choosing = deque(range(count)), threading.Lock()
        self._last: Callable[[], None] = lambda: None

    def at_end(self, last: Callable[[], None]) -> None:
        """What is to be done before the memory goes, once nothing holds any frame."""
        self._last = last

    def __del__(self) -> None:
        try:
            if hasattr(self, "_last"):
                self._last()
        finally:
            if hasattr(self, "file"):
                os.close(self.file)

    def take(self) -> int | None:
        """A slot that is free, the one that has been for longest; None where others hold too many frames."""
        with self._choosing:
            return self._free.popleft() if len(self._free) > RESTING else None

    def give_back(self, slot: int) -> None:
        """Free a slot that was taken."""
        self._free.append(slot)

    def put(self, frame: Frame, slot: int) -> Frame:
        """The frame without its images, which lie in the slot now; itself where they do not fit the camera."""
        color, depth, measured = self._views(slot)
        pairs = (frame.color, color), (frame.depth, depth)
        if any((given.shape, given.dtype) != (place.shape, place.dtype) for given, place in pairs):
            return frame
        color[:], depth[:] = frame.color, frame.depth
        kept = None if frame.measured is None else NO_DEPTH
        if frame.measured is not None and frame.measured is not frame.depth:
            measured[:], kept = frame.measured, OWN_DEPTH
        return replace(frame, color=NO_COLOR, depth=NO_DEPTH, measured=kept)

    def found(self, frame: Frame, slot: int) -> Frame:
        """A frame that was ``put`` into a slot, whole again; the slot is given back when nothing holds its images."""
        if frame.depth.size:
            self.give_back(slot)
            return frame
        color, depth, measured = self._views(slot)
        weakref.finalize(depth.base, self.give_back, slot)
        if frame.measured is not None:
            frame = replace(frame, measured=measured if frame.measured.size else depth)
        return replace(frame, color=color, depth=depth)

    @property
    def _size(self) -> int:
        """Bytes of a slot."""
        pixels = self._camera.width * self._camera.height
        return -(-11 * pixels // ALIGNMENT) * ALIGNMENT

    def _views(self, slot: int) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]:
        """Colour, depth and measured depth in a slot: views of one array, which lives as long as one of them."""
        height, width = self._camera.height, self._camera.width
        pixels = height * width
        whole = np.frombuffer(self.memory, np.uint8, 11 * pixels, slot * self._size)
        depths = whole[: 8 * pixels].view(np.float32).reshape(2, height, width)
        return whole[8 * pixels :].reshape(height, width, 3), depths[0], depths[1]
