"""A recording that a camera is still making, as a sequence that grows."""

from __future__ import annotations

import threading
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..datasets.images import to_metres
from ..datasets.recording import Recording
from ..types import words
from .camera import Camera, Shot
from .writer import Writer

AT_HAND = 30  # shots that are kept in memory beside those that are not on disk yet


class LiveRecording(Recording):
    """What ``camera`` brings, recorded into the new ``folder``; a thread of its own takes it from here on. A ``Live``
    sequence: once it is over, it reads what lies on disk. Raises InputError where the folder cannot be written."""

    def __init__(self, camera: Camera, folder: Path) -> None:
        super().__init__(folder, camera.rig, [], np.empty(0))
        self._camera, self._writer = camera, Writer(folder, camera.rig)
        self._recent: dict[int, Shot] = {}
        self._failure, self._missed = "", 0
        self._closing, self._over = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._record, name="camera", daemon=True)
        self._thread.start()

    def arrived(self) -> int:
        """How many frames there are by now."""
        return len(self.times)

    def over(self) -> bool:
        """Whether the camera is off."""
        return self._over.is_set()

    def wait(self, seconds: float) -> bool:
        """Wait until the camera is off, no longer than so; whether it is."""
        return self._over.wait(seconds)

    @property
    def bytes(self) -> int:
        """How much has been written so far."""
        return self._writer.bytes

    @property
    def trouble(self) -> str:
        """Why it ended by itself, and what is missing from the recording, else ""."""
        missed = f"{self._missed} frames were not recorded: the disk is too slow" if self._missed else ""
        return "; ".join(filter(None, (self._failure or self._writer.failure, missed)))

    def close(self) -> None:
        """Switch the camera off and return when all that came is on disk."""
        self._closing.set()
        self._thread.join()
        self._writer.close()

    def _record(self) -> None:
        try:
            while not self._closing.is_set() and not self._writer.failure:
                shot = self._camera.read()
                if shot is None:
                    break
                self._add(shot)
            self._camera.close()
        except Exception as error:
            self._failure = words(error)
            with suppress(Exception):  # what has failed may fail at this, too
                self._camera.close()
        self._over.set()

    def _add(self, shot: Shot) -> None:
        index = len(self.times)
        if index and shot.seconds <= self.times[-1]:
            return
        if not self._writer.take(index, shot):
            self._missed += 1
            return
        self._recent[index] = shot
        for old in [i for i in self._recent if i < min(self._writer.written, index - AT_HAND)]:
            del self._recent[old]
        self.add_files(f"{index:06d}")
        self.times = np.append(self.times, round(shot.seconds, 6))  # last, for what it counts must be there

    def _stored(self, index: int, size: tuple[int, int]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        shot = self._recent.get(index)
        if shot is None:
            return super()._stored(index, size)
        return shot.color, to_metres(shot.depth, self.depth_scale)
