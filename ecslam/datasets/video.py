"""Frames of a video by number, whatever the order and from any thread.

OpenCV counts frames by time and mean rate, so seeking to a number lands beside it where the rate varies, and a frame
shown before time 0 is left out altogether, with which all others move up. Here the file's own tables say which frames
there are, and the time of what was decoded says which one it is.
"""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ..cores import cores
from ..types import FrameError
from .mp4 import read_track

MOST_THREADS = 8  # of the decoder, each with pictures of its own
FAR = 60  # frames ahead, from which on seeking is quicker than decoding on
TRIES = 1000  # until damaged data are taken for the end of the file
SAME_S = 5e-4

os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", "ignore_editlist;1")
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # broken videos raise an exception


class Video:
    """An MP4 file's frames, shrunk to ``size`` (width, height). One decoder, which goes forwards as long as it can.

    track: what the file's tables say. Raises InputError for a file that is no video.
    """

    def __init__(self, path: Path, size: tuple[int, int] | None = None) -> None:
        self.path, self.track = path, read_track(path)
        self.size = size or self.track.size
        self._decoding = threading.Lock()
        self._wanted: list[int] = []  # by the threads that wait, and by the one that decodes
        self._found: dict[int, NDArray[np.uint8]] = {}  # what these wait for and was passed on the way
        self._capture: cv2.VideoCapture | None = None
        self._at = -1  # the number of the frame decoded last
        self._lost: set[int] = set()  # what the decoder passed over

    def __len__(self) -> int:
        return len(self.track.times)

    def read(self, number: int) -> NDArray[np.uint8]:
        """Frame ``number`` in the order of display, RGB uint8 [H, W, 3]. Raises FrameError."""
        self._wanted.append(number)
        with self._decoding:
            try:
                if number in self._found:
                    return self._found[number]
                image = self._decode(number)
            finally:
                self._wanted.remove(number)
                self._found = {n: image for n, image in self._found.items() if n in self._wanted}
        return self._shrunk(image)

    def _decode(self, number: int) -> NDArray[np.uint8]:
        if number not in self._lost:
            self._go_to(number)
        if self._at != number:
            raise FrameError(f"{self.path}: frame {number} cannot be decoded; copy the video again")
        return self._picture()

    def _go_to(self, number: int) -> None:
        """Decode until it is ``number``'s turn, or clear that it cannot be decoded."""
        if self._capture is None or not self._at <= number <= self._at + FAR:
            self._seek(number)
        tries = TRIES
        while self._at < number and tries:
            before = self._at
            if not self._advance():
                tries -= 1
                continue
            self._lost.update(range(before + 1, self._at))
            if self._at in self._wanted and self._at != number:
                with suppress(FrameError):  # it is told to who asks for that frame
                    self._found[self._at] = self._shrunk(self._picture())
        if self._at < number:
            self._lost.update(range(self._at + 1, number + 1))
            self._capture = None  # for whatever it holds now

    def _seek(self, number: int) -> None:
        """To a frame at or before ``number``, or to before the first one."""
        if number > FAR:
            capture = self._capture or self._rewind()
            rate = capture.get(cv2.CAP_PROP_FPS)
            capture.set(cv2.CAP_PROP_POS_FRAMES, max(int(self.track.times[number] * rate) - 1, 0))
            if self._advance() and self._at <= number:
                return
        self._rewind()

    def _rewind(self) -> cv2.VideoCapture:
        threads = min(cores(), MOST_THREADS)
        self._capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, threads])
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # its default depends on the version
        self._at = -1
        return self._capture

    def _advance(self) -> bool:
        """Decode on and find out which frame that is; False at the end, in damaged data, or where it cannot be told."""
        capture: Any = self._capture
        if not capture.grab():
            return False
        times, time_s = self.track.times, capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        at = int(np.searchsorted(times, time_s - SAME_S))
        if at == len(times) or times[at] > time_s + SAME_S:
            return False
        self._at = at
        return True

    def _picture(self) -> NDArray[np.uint8]:
        capture: Any = self._capture
        ok, image = capture.retrieve()
        if not ok or image.dtype != np.uint8 or image.shape != (self.track.size[1], self.track.size[0], 3):
            raise FrameError(f"{self.path}: frame {self._at} is damaged; copy the video again")
        return cast("NDArray[np.uint8]", image)

    def _shrunk(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """RGB at ``size``, by area: to an exact half first, which is much quicker than all the way at once."""
        width, height = self.track.size
        half = width // 2, height // 2
        halves = width % 2 == height % 2 == 0 and half[0] >= self.size[0] and half[1] >= self.size[1]
        for size in (half, self.size) if halves else (self.size,):
            if image.shape[1::-1] != size:
                image = cast("NDArray[np.uint8]", cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        return cast("NDArray[np.uint8]", cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
