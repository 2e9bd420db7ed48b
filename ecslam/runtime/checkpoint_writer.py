"""When checkpoints are written, and by whom: a thread of their own, so rarely that a run hardly notices them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from time import monotonic

from ..atomic import remove_temporaries
from .checkpoint import Checkpoint, Stored, save_checkpoint

PATIENCE_S = 3.0
SHARE = 0.05


class CheckpointWriter:
    """Writes at most one checkpoint at a time, every so many frames, but not for more than ``SHARE`` of the time.

    What a kill costs: at most 2 ``every`` frames, or the last ``PATIENCE_S`` seconds where they brought more than that.
    A slow disk holds the run up only where this could not be kept otherwise. failed: called in the writer's thread with
    the OSError of a checkpoint that could not be saved; saved: with none. now: the clock, in seconds.
    """

    def __init__(
        self,
        folder: Path,
        every: int,
        failed: Callable[[OSError], None],
        saved: Callable[[], None],
        frame: int = 0,
        now: Callable[[], float] = monotonic,
    ) -> None:
        self._folder, self._every, self._failed, self._saved, self._now = folder, every, failed, saved, now
        self._thread: threading.Thread | None = None
        self._begun = self._settled = frame
        self._begun_s = self._settled_s = now()
        self._cost_s = 0.0
        self._stored: Stored | None = None
        if folder.is_dir():
            remove_temporaries(folder)

    def due(self, frame: int) -> bool:
        """Whether the state after ``frame`` frames is to be saved; always after the first one, the most expensive."""
        if self._begun == 0:
            return True
        if frame - self._begun < self._every:
            return False
        now = self._now()
        if frame - self._settled >= 2 * self._every and now - self._settled_s >= PATIENCE_S:
            return True
        busy = self._thread is not None and self._thread.is_alive()
        return not busy and now - self._begun_s >= self._cost_s / SHARE

    def save(self, make: Callable[[], Checkpoint]) -> None:
        """Start writing what ``make`` returns, after the one before is done.

        Its arrays must not be written to afterwards, and the lasting ones be the same objects every time.
        """
        self.wait()
        self._begun_s = self._now()
        checkpoint = make()
        self._begun = checkpoint.frame
        self._thread = threading.Thread(target=self._write, args=(checkpoint,), name="checkpoint", daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Return when everything is on the disk, or reported as failed."""
        if self._thread is not None:
            self._thread.join()

    def _write(self, checkpoint: Checkpoint) -> None:
        try:
            self._stored = save_checkpoint(self._folder, checkpoint, self._stored)
        except OSError as error:
            self._failed(error)
        else:
            self._saved()
        self._settled, self._settled_s = checkpoint.frame, self._begun_s
        self._cost_s = self._now() - self._begun_s
