"""Poses of all frames. A frame hangs on its keyframe, so bundle adjustment moves the frames in between as well."""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import se3

ROOM = 64
UNEVEN, MOST_STEPS = 0.3, 15.0  # steps of time: less than this from one is jitter; half a second of a usual camera
MOST_BACK = 6  # poses


class Trajectory:
    """Camera-to-world poses in metres, float64. Written by the engine thread alone."""

    def __init__(self) -> None:
        self.timestamps = array("d")
        self._count = self._keyframe_count = 0
        self._keyframes, self._relative = np.empty((ROOM, 4, 4)), np.empty((ROOM, 4, 4))
        self._anchor = np.empty(ROOM, np.int64)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> NDArray[np.float64]:
        """Pose [4, 4] of one frame."""
        index = range(self._count)[index]
        return np.asarray(self._keyframes[self._anchor[index]] @ self._relative[index])

    def append(self, c2w: NDArray[np.float64], timestamp: float, keyframe: bool) -> None:
        """Add a frame, whose pose is rigid up to rounding. The first one must be a keyframe."""
        if keyframe:
            self._keyframes = _with_room(self._keyframes, self._keyframe_count)
            self._keyframes[self._keyframe_count] = se3.polished(c2w)
            self._keyframe_count += 1
        self._relative = _with_room(self._relative, self._count)
        self._anchor = _with_room(self._anchor, self._count)
        self._anchor[self._count] = self._keyframe_count - 1
        self._relative[self._count] = se3.polished(se3.inverse(self._keyframes[self._anchor[self._count]]) @ c2w)
        self._count += 1
        self.timestamps.append(timestamp)

    def keyframe_poses(self) -> NDArray[np.float64]:
        """Poses [K, 4, 4] of the keyframes."""
        return self._keyframes[: self._keyframe_count].copy()

    def move_keyframes(self, index: NDArray[np.int64], c2w: NDArray[np.float64]) -> None:
        """Set keyframe poses [K, 4, 4] at ``index`` [K]; the frames that hang on them follow."""
        self._keyframes[index] = se3.polished(c2w)

    def poses(self) -> NDArray[np.float64]:
        """Poses [N, 4, 4] of all frames."""
        return np.asarray(self._keyframes[self._anchor[: self._count]] @ self._relative[: self._count])

    def predict(self, timestamp: float) -> NDArray[np.float64]:
        """Constant-velocity guess [4, 4] for a frame at ``timestamp`` seconds, after frames that are missing, too: the
        farther ahead it is, the longer is what the velocity is taken over, or its error would be multiplied."""
        if len(self) < 2:
            return self[-1]
        last, back = self.timestamps[-1], 2
        while back < min(len(self), MOST_BACK) and last - self.timestamps[-back] < (1 - UNEVEN) * (timestamp - last):
            back += 1
        motion, before = se3.inverse(self[-back]) @ self[-1], self.timestamps[-back]
        steps = (timestamp - last) / (last - before) if last > before else 1.0
        if abs(steps - 1) > UNEVEN:
            motion = se3.repeated(motion, min(max(steps, 0.0), MOST_STEPS))
        return se3.polished(self[-1] @ motion)

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Everything as arrays, for a checkpoint."""
        return {
            "timestamps": np.array(self.timestamps),
            "keyframes": self.keyframe_poses(),
            "anchor": self._anchor[: self._count].copy(),
            "relative": self._relative[: self._count].copy(),
        }

    @classmethod
    def restore(cls, state: dict[str, NDArray[np.generic]]) -> Trajectory:
        """The inverse of ``state``."""
        self = cls()
        self.timestamps = array("d", state["timestamps"])
        self._keyframes, self._relative = (np.array(state[name], np.float64) for name in ("keyframes", "relative"))
        self._anchor = np.array(state["anchor"], np.int64)
        self._count, self._keyframe_count = len(self._anchor), len(self._keyframes)
        return self


def _with_room(rows: NDArray[Any], used: int) -> NDArray[Any]:
    """The same rows, with room for one more than the ``used`` ones: doubled when there is none."""
    if used < len(rows):
        return rows
    return np.concatenate([rows, np.empty((max(used, ROOM), *rows.shape[1:]), rows.dtype)])
