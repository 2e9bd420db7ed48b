"""A rival on the same frames: Open3D's dense SLAM (voxel block grid, frame-to-model tracking), where installed."""

from __future__ import annotations

import importlib.util
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..datasets import Prefetch, open_sequence, select_frames
from ..evaluation.trajectory import absolute_error
from ..types import Frame, Intrinsics

VOXEL_M = 3 / 512
BLOCK_SIDE, BLOCKS = 16, 40_000
TRUNCATION_VOXELS = 8.0
NEAR_M, FAR_M = 0.1, 4.0
OUTLIER_M = 0.07
DEPTH_SCALE = 5000.0  # stored as uint16: 0.2 mm steps, 13.1 m at most


def open3d_missing() -> str:
    """Why the rival cannot run, or "" when it can."""
    if importlib.util.find_spec("open3d") is None:
        return "Open3D is not installed, so there is no rival to compare with; install it with: pip install open3d"
    return ""


def measure_open3d(address: str, frames: str, device: str) -> dict[str, Any]:
    """Run Open3D's dense SLAM and return frames, wall_s, fps_wall, ate_rmse_cm (or None) and lost_frames.

    address, frames: as for ``ecslam run``. Frames are read ahead by threads, as for our own runs, and reading counts.
    Unreadable frames are left out. Raises InputError when the sequence cannot be opened.
    """
    sequence = select_frames(open_sequence(address), frames)
    truth = sequence.poses_gt()
    model = DenseSlam(sequence.intrinsics, "CUDA:0" if device.startswith("cuda") else "CPU:0")
    started = perf_counter()
    read = [(i, model.step(item)) for i, item in Prefetch(sequence) if isinstance(item, Frame)]
    wall_s = perf_counter() - started
    rows, poses = [i for i, _ in read], np.stack([pose for _, pose in read])
    error = None if truth is None else absolute_error(poses, truth[rows])
    return {
        "frames": len(rows),
        "wall_s": wall_s,
        "fps_wall": len(rows) / wall_s,
        "ate_rmse_cm": error.cm.rmse if error else None,
        "lost_frames": model.lost,
    }


class DenseSlam:
    """Open3D's model of a scene, fed a frame at a time. lost: frames whose tracking failed; they keep the last pose."""

    def __init__(self, camera: Intrinsics, device: str) -> None:
        import open3d as o3d

        self._o3d, self._device = o3d, o3d.core.Device(device)
        slam, matrix = o3d.t.pipelines.slam, o3d.core.Tensor(camera.matrix())
        self._model = slam.Model(VOXEL_M, BLOCK_SIDE, BLOCKS, o3d.core.Tensor(np.eye(4)), self._device)
        self._seen = slam.Frame(camera.height, camera.width, matrix, self._device)
        self._expected = slam.Frame(camera.height, camera.width, matrix, self._device)
        self._pose = np.eye(4)
        self._count = self.lost = 0

    def step(self, frame: Frame) -> NDArray[np.float64]:
        """Track and integrate a frame; its camera-to-world pose [4, 4] in the camera frame of the first one."""
        depth = np.rint(np.minimum(frame.depth * DEPTH_SCALE, 65535)).astype(np.uint16)
        self._seen.set_data_from_image("depth", self._image(depth))
        self._seen.set_data_from_image("color", self._image(frame.color))
        if self._count:
            self._track()
        self._model.update_frame_pose(self._count, self._o3d.core.Tensor(self._pose))
        self._model.integrate(self._seen, DEPTH_SCALE, FAR_M, TRUNCATION_VOXELS)
        self._model.synthesize_model_frame(self._expected, DEPTH_SCALE, NEAR_M, FAR_M, TRUNCATION_VOXELS, False)
        self._count += 1
        return self._pose

    def _track(self) -> None:
        try:
            found = self._model.track_frame_to_model(self._seen, self._expected, DEPTH_SCALE, FAR_M, OUTLIER_M)
        except RuntimeError:  # the normal equations are singular
            self.lost += 1
        else:
            self._pose = self._pose @ found.transformation.cpu().numpy()

    def _image(self, pixels: NDArray[Any]) -> Any:
        tensor = self._o3d.core.Tensor(np.ascontiguousarray(pixels))
        return self._o3d.t.geometry.Image(tensor).to(self._device)
