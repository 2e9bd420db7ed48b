"""Poses of all frames. A frame hangs on its keyframe, so bundle adjustment moves the frames in between as well."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from . import se3


class Trajectory:
    """Camera-to-world poses in metres, float64. Written by the engine thread alone."""

    def __init__(self) -> None:
        self.timestamps: list[float] = []
        self.tracked: list[bool] = []
        self._keyframes: list[NDArray[np.float64]] = []
        self._anchor: list[int] = []
        self._relative: list[NDArray[np.float64]] = []

    def __len__(self) -> int:
        return len(self._anchor)

    def __getitem__(self, index: int) -> NDArray[np.float64]:
        """Pose [4, 4] of one frame."""
        return self._keyframes[self._anchor[index]] @ self._relative[index]

    def append(self, c2w: NDArray[np.float64], timestamp: float, tracked: bool, keyframe: bool) -> None:
        """Add a frame. The first one must be a keyframe."""
        if keyframe:
            self._keyframes.append(se3.orthonormalise(c2w))
        self._anchor.append(len(self._keyframes) - 1)
        self._relative.append(se3.orthonormalise(se3.inverse(self._keyframes[-1]) @ c2w))
        self.timestamps.append(timestamp)
        self.tracked.append(tracked)

    def keyframe_poses(self) -> NDArray[np.float64]:
        """Poses [K, 4, 4] of the keyframes."""
        return np.stack(self._keyframes) if self._keyframes else np.empty((0, 4, 4))

    def move_keyframes(self, index: NDArray[np.int64], c2w: NDArray[np.float64]) -> None:
        """Set keyframe poses [K, 4, 4] at ``index`` [K]; the frames that hang on them follow."""
        for i, pose in zip(index.tolist(), c2w, strict=True):
            self._keyframes[i] = se3.orthonormalise(pose)

    def move_last(self, c2w: NDArray[np.float64]) -> None:
        """Set the pose of the newest frame relative to its keyframe."""
        self._relative[-1] = se3.orthonormalise(se3.inverse(self._keyframes[self._anchor[-1]]) @ c2w)

    def poses(self) -> NDArray[np.float64]:
        """Poses [N, 4, 4] of all frames."""
        if not self._anchor:
            return np.empty((0, 4, 4))
        return np.stack(self._keyframes)[self._anchor] @ np.stack(self._relative)

    def predict(self) -> NDArray[np.float64]:
        """Constant-velocity guess [4, 4] for the next frame."""
        if len(self) < 2:
            return self[-1]
        return se3.orthonormalise(self[-1] @ se3.inverse(self[-2]) @ self[-1])

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Everything as arrays, for a checkpoint."""
        return {
            "timestamps": np.asarray(self.timestamps, np.float64),
            "tracked": np.asarray(self.tracked, np.uint8),
            "keyframes": self.keyframe_poses(),
            "anchor": np.asarray(self._anchor, np.int64),
            "relative": np.stack(self._relative) if self._relative else np.empty((0, 4, 4)),
        }

    @classmethod
    def restore(cls, state: dict[str, NDArray[np.generic]]) -> Trajectory:
        """The inverse of ``state``."""
        self = cls()
        self.timestamps = [float(t) for t in state["timestamps"]]
        self.tracked = [bool(t) for t in state["tracked"]]
        self._keyframes = [np.array(k, np.float64) for k in state["keyframes"]]
        self._anchor = [int(a) for a in state["anchor"]]
        self._relative = [np.array(r, np.float64) for r in state["relative"]]
        return self
