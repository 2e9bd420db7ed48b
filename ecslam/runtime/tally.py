"""What a run counts and times: the figures of its progress line and of ``summary.json``."""

from __future__ import annotations

from dataclasses import dataclass, field
from time import monotonic
from typing import Any

import numpy as np

from ..messages import StepReport

UNREADABLE_SHARE = 0.20
LEAST_TRIED = 100


@dataclass
class Tally:
    """Counters that survive a checkpoint.

    position: frames of the sequence done, skipped ones included. rows: frame index of each pose of the trajectory.
    unreadable: a sentence for each frame that could not be read; first_skip: why the first one was left out; warnings:
    what a person should know besides. dropped: frames that came while the engine was busy, in real time. wall_s:
    seconds spent, pauses left out, and setup_s: seconds that loading the engine's libraries took before, also left
    out. engine_ms: tracking and mapping without the first frame (its initialisation), as Co-SLAM counts.
    """

    position: int = 0
    rows: list[int] = field(default_factory=list)
    keyframes: list[int] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)
    first_skip: str = ""
    warnings: list[str] = field(default_factory=list)
    skipped: int = 0
    dropped: int = 0
    lost: int = 0
    loops: int = 0
    wall_s: float = 0.0
    setup_s: float = 0.0
    engine_ms: float = 0.0

    def add(self, report: StepReport) -> None:
        """Count a frame that was processed."""
        if self.rows:
            self.engine_ms += report.step_ms
        self.rows.append(report.frame)
        self.lost += report.lost
        self.loops += report.loop is not None
        if report.is_keyframe:
            self.keyframes.append(report.frame)

    def too_many_unreadable(self, frames: int) -> bool:
        """Whether the run over ``frames`` frames is not worth going on with."""
        return len(self.unreadable) > UNREADABLE_SHARE * frames

    def none_usable(self, frames: int) -> bool:
        """Whether none of the frames so far was of use, and these are enough of ``frames`` to give the rest up."""
        return not self.rows and self.skipped > max(LEAST_TRIED, UNREADABLE_SHARE * frames)

    @property
    def fps_wall(self) -> float:
        """Frames per second with everything: reading, tracking, mapping, checkpoints."""
        return len(self.rows) / self.wall_s if self.wall_s > 0 else 0.0

    @property
    def fps_engine(self) -> float:
        """Frames per second of tracking and mapping alone."""
        return 1e3 * (len(self.rows) - 1) / self.engine_ms if self.engine_ms > 0 else 0.0

    def row_of_each_frame(self) -> np.ndarray[Any, np.dtype[np.int64]]:
        """[n] for every frame so far the row of the trajectory that holds its pose or the last one before it.

        A frame that is still at work has no pose yet and is left out.
        """
        done = np.arange(len(self.rows) + self.skipped + self.dropped)
        rows = np.searchsorted(np.array(self.rows, np.int64), done, side="right") - 1
        return rows.clip(0)

    def to_json(self) -> dict[str, Any]:
        """Plain values, copied."""
        return {k: list(v) if isinstance(v, list) else v for k, v in vars(self).items()}


class Stopwatch:
    """Seconds between each ``resume`` and ``pause``; it begins paused."""

    def __init__(self, already_s: float = 0.0) -> None:
        self._now: tuple[float, float | None] = already_s, None

    @property
    def seconds(self) -> float:
        """The time so far. Any thread may ask."""
        total_s, since = self._now
        return total_s + (monotonic() - since if since is not None else 0.0)

    def pause(self) -> bool:
        """Stop counting; whether it was."""
        was = self._now[1] is not None
        self._now = self.seconds, None
        return was

    def resume(self) -> None:
        """Count again."""
        self._now = self.seconds, monotonic()


class Every:
    """When it is time for what is worth doing only every so many seconds, however fast frames come."""

    def __init__(self, seconds: float) -> None:
        self._seconds, self._next = seconds, 0.0

    def due(self) -> bool:
        """Whether it is time, at first and ``seconds`` after it last was."""
        now = monotonic()
        due = now >= self._next
        if due:
            self._next = now + self._seconds
        return due
