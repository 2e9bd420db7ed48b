"""Figures over time for the plots: one row a frame, kept whole and handed out thinned."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ecslam.messages import Snapshot

from .geometry import rotation_difference_deg

FIGURES = ("ate_cm", "track_ms", "map_ms")


class History:
    """What each seen frame measured. Rows are dictionaries of figures and weighted losses by name."""

    def __init__(self) -> None:
        self._rows: dict[int, dict[str, float]] = {}
        self.windows: dict[int, tuple[int, ...]] = {}

    def add(self, frame: int, figures: dict[str, float], losses: dict[str, float], window: tuple[int, ...]) -> None:
        """Remember a frame; the last word counts."""
        self._rows[frame] = {**figures, **{f"loss {name}": value for name, value in losses.items()}}
        self.windows[frame] = window

    def add_snapshot(self, s: Snapshot) -> None:
        """Remember the frame that a snapshot reports; a replay's reports none, as all are known."""
        if s.reported is not None:
            figures = {"track_ms": s.track_ms, "map_ms": s.map_ms}
            if s.ate_cm is not None:
                figures["ate_cm"] = s.ate_cm
            self.add(s.reported, figures, s.losses, s.window)

    def names(self) -> list[str]:
        """Names of the series of losses, in the order they first appeared."""
        return list(dict.fromkeys(name for row in self._rows.values() for name in row if name.startswith("loss ")))

    def series(self, names: list[str], most: int = 400) -> tuple[NDArray[np.float64], ...]:
        """Frame numbers and one array a name (NaN where missing), at most about ``most`` points."""
        frames = sorted(self._rows)
        frames = frames[:: max(1, len(frames) // most)]
        columns = [[self._rows[f].get(name, np.nan) for f in frames] for name in names]
        return np.array(frames, float), *(np.array(column, float) for column in columns)

    def window_at(self, frame: int) -> tuple[int, ...]:
        """The last known window at or before ``frame`` (a frame without mapping has none of its own)."""
        known = [f for f, window in self.windows.items() if f <= frame and window]
        return self.windows[max(known)] if known else ()


def history_of(rows: Iterable[dict[str, Any]]) -> History:
    """The figures of frames that are on record. rows: lines of ``metrics.jsonl``."""
    history = History()
    for row in rows:
        figures = {name: float(row[name]) for name in FIGURES if row.get(name) is not None}
        history.add(int(row["frame"]), figures, row.get("losses") or {}, tuple(row.get("window") or ()))
    return history


def discrepancy(s: Snapshot, most: int = 400) -> tuple[str, NDArray[np.float64], NDArray[np.float64]]:
    """The loop timeline: its title, frame numbers and values.

    With ground truth the rotation error of every frame in degrees (the paper's quaternion discrepancy); without it
    the correction in centimetres at each loop closure.
    """
    if s.trajectory_gt is not None and len(s.trajectory):
        count = min(len(s.trajectory), len(s.trajectory_gt))
        pick = np.linspace(0, count - 1, min(count, most)).round().astype(int)
        return (
            "Rotation error (°)",
            pick.astype(float),
            rotation_difference_deg(s.trajectory[pick], s.trajectory_gt[pick]),
        )
    frames = np.array([0, *(e.frame for e in s.loops), max(s.frame, 1)], float)
    return "Correction (cm)", frames, np.array([np.nan, *(e.correction_cm for e in s.loops), np.nan])


def with_last_mapping(s: Snapshot, last: Snapshot | None) -> Snapshot:
    """A snapshot with the window and the time of the last mapping; ``last``: the snapshot before it.

    Most frames are not mapped: without this the window would flicker away on every one of them.
    """
    if s.window or last is None or last.frame > s.frame or last.sequence != s.sequence:
        return s
    return replace(s, window=last.window, map_ms=last.map_ms)
