"""Small recordings of Record3D."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import lzfse
import numpy as np
from scipy.spatial.transform import Rotation

OPENGL = np.diag([1.0, -1, -1, 1])


def parts(
    colors: Sequence[np.ndarray],
    depths: Sequence[np.ndarray],
    poses: Sequence[np.ndarray],
    matrix: np.ndarray,
    **more: Any,
) -> dict[str, bytes]:
    """The files by name. colors: RGB. depths: float32, metres. poses: camera-to-world. matrix: 3x3, of the colours."""
    rows = []
    for c2w in poses:
        stored = c2w @ OPENGL
        rows.append([*Rotation.from_matrix(stored[:3, :3]).as_quat(), *stored[:3, 3]])
    (h, w), (dh, dw) = colors[0].shape[:2], depths[0].shape
    about = {"w": w, "h": h, "dw": dw, "dh": dh, "fps": 30, "K": matrix.T.ravel().tolist(), "poses": rows, **more}
    files = {"metadata": json.dumps({k: v for k, v in about.items() if v is not None}).encode(), "icon": b""}
    for i, (color, depth) in enumerate(zip(colors, depths, strict=True)):
        ok, data = cv2.imencode(".jpg", np.ascontiguousarray(color[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 100])
        assert ok
        files[f"rgbd/{i}.jpg"] = data.tobytes()
        files[f"rgbd/{i}.depth"] = lzfse.compress(depth.astype("<f4").tobytes())
        files[f"rgbd/{i}.conf"] = lzfse.compress(np.full(depth.shape, 2, np.uint8).tobytes())
    return files


def write(path: Path, files: dict[str, bytes]) -> Path:
    """An .r3d file, or where the name does not end so a folder."""
    if path.suffix == ".r3d":
        path.parent.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in files.items():
                archive.writestr(name, data)
        return path
    for name, data in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(data)
    return path
