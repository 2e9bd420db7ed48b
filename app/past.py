"""A finished run's poses as they were after each frame, not only as they ended."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Past:
    """Keyframes move whenever a window holds them, and every other frame hangs on the keyframe before it.

    rows: the lines of ``metrics.jsonl``; final: poses [n, 4, 4], as the run ended. Rows without ``window_c2w`` leave
    their keyframes where they were.
    """

    def __init__(self, rows: Sequence[dict[str, Any]], final: Array) -> None:
        self._final = final
        self.keyframes = [k for k, row in enumerate(rows) if row.get("keyframe")]
        seen = np.stack([_pose(row["c2w"]) for row in rows])
        self._when: list[list[int]] = [[k] for k in self.keyframes]
        self._where: list[list[Array]] = [[seen[k]] for k in self.keyframes]
        number = {int(rows[k]["frame"]): n for n, k in enumerate(self.keyframes)}
        for at, row in enumerate(rows):
            for frame, c2w in zip(row.get("window") or (), row.get("window_c2w") or (), strict=False):
                if frame in number:
                    self._when[number[frame]].append(at)
                    self._where[number[frame]].append(_pose(c2w))
        self._anchor = np.searchsorted(self.keyframes, np.arange(len(rows)), side="right") - 1
        self._relative = seen.copy()
        for k in np.flatnonzero(self._anchor >= 0).tolist():
            self._relative[k] = np.linalg.inv(self._keyframe(int(self._anchor[k]), k)) @ seen[k]

    def trajectory(self, at: int) -> Array:
        """Poses [at + 1, 4, 4] of the rows 0 .. ``at`` as they were when row ``at`` was done."""
        if at == len(self._final) - 1:
            return self._final
        poses, anchor = self._relative[: at + 1].copy(), self._anchor[: at + 1]
        if len(self.keyframes) and anchor[-1] >= 0:
            moved = np.stack([self._keyframe(n, at) for n in range(anchor[-1] + 1)])
            hangs = anchor >= 0
            poses[hangs] = moved[anchor[hangs]] @ poses[hangs]
        return poses

    def _keyframe(self, number: int, at: int) -> Array:
        return self._where[number][bisect_right(self._when[number], at) - 1]


def _pose(c2w: Sequence[float]) -> Array:
    return np.vstack([np.array(c2w[:12], float).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
