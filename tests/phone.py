"""Small recordings in the layout of Stray Scanner."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")


def record(
    root: Path,
    colors: Sequence[np.ndarray],
    depths: Sequence[np.ndarray],
    poses: Sequence[np.ndarray],
    matrix: np.ndarray,
    fps: float = 60,
) -> Path:
    """colors: RGB [H, W, 3]. depths: uint16, millimetres. poses: camera-to-world. matrix: 3x3, of the colours."""
    (root / "depth").mkdir(parents=True)
    (root / "confidence").mkdir()
    video = cv2.VideoWriter(str(root / "rgb.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), fps, colors[0].shape[1::-1])
    lines = [", ".join(COLUMNS)]
    for i, (color, depth, c2w) in enumerate(zip(colors, depths, poses, strict=True)):
        video.write(np.ascontiguousarray(color[..., ::-1]))
        assert cv2.imwrite(str(root / f"depth/{i:06d}.png"), depth)
        assert cv2.imwrite(str(root / f"confidence/{i:06d}.png"), np.full(depth.shape, 2, np.uint8))
        quaternion = Rotation.from_matrix(c2w[:3, :3]).as_quat()
        lines.append(", ".join(map(str, [f"{5000 + i / fps:.9f}", f"{i:06d}", *c2w[:3, 3], *quaternion])))
    video.release()
    (root / "odometry.csv").write_text("\n".join(lines))
    np.savetxt(root / "camera_matrix.csv", matrix, delimiter=", ")
    return root
