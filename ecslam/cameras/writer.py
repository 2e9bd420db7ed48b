"""A recording that is being written: images by a thread of its own, each in the list once both of it are whole."""

from __future__ import annotations

import threading
from pathlib import Path
from queue import Full, Queue

import cv2
import numpy as np

from ..datasets.recording import FILE, TIMES, Rig, color_file, depth_file, write_rig
from ..types import InputError, words
from .camera import Shot

MOST_WAITING = 60  # shots, two seconds of most cameras
JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95]
PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]  # the fastest of all


class Writer:
    """Writes shots into a new folder. written: how many have been; bytes: that these take; failure: why it has stopped
    writing, else "". Raises InputError where the folder cannot be written, or holds something."""

    def __init__(self, folder: Path, rig: Rig) -> None:
        try:
            images = [place(folder, "").parent for place in (color_file, depth_file)]
            if any(each.exists() for each in (*images, folder / FILE, folder / TIMES)):
                raise FileExistsError(0, "there is a recording in it, or part of one")
            for each in images:
                each.mkdir(parents=True)
            self._list = open(folder / TIMES, "x", encoding="utf-8")  # noqa: SIM115
        except OSError as error:
            raise InputError(f"{folder}: cannot be recorded into ({error.strerror}); name a new folder") from None
        write_rig(folder / FILE, rig)
        self._folder, self._waiting = folder, Queue[tuple[int, Shot] | None](MOST_WAITING)
        self.written, self.bytes, self.failure = 0, 0, ""
        self._thread = threading.Thread(target=self._write_on, name="recorder", daemon=True)
        self._thread.start()

    def take(self, index: int, shot: Shot) -> bool:
        """Write a shot soon; False where the disk is so slow that too many wait already."""
        try:
            self._waiting.put_nowait((index, shot))
        except Full:
            return False
        return True

    def close(self) -> None:
        """Return when all that was taken has been written."""
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join()
        self._list.close()

    def _write_on(self) -> None:
        while (item := self._waiting.get()) is not None:
            if not self.failure:
                try:
                    self._write(*item)
                except Exception as error:
                    why = f"{error.strerror}); make room" if isinstance(error, OSError) else f"{words(error)})"
                    self.failure = f"{self._folder}: the recording ends at frame {item[0]} ({why}"

    def _write(self, index: int, shot: Shot) -> None:
        name = f"{index:06d}"
        color = cv2.imencode(".jpg", cv2.cvtColor(shot.color, cv2.COLOR_RGB2BGR), JPEG)[1]
        depth = cv2.imencode(".png", shot.depth, PNG)[1]
        for file, data in ((color_file(self._folder, name), color), (depth_file(self._folder, name), depth)):
            file.write_bytes(np.asarray(data).tobytes())
        self._list.write(f"{shot.seconds:.6f} {name}\n")
        self._list.flush()
        self.written, self.bytes = index + 1, self.bytes + color.size + depth.size
