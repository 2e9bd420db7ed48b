"""Write a sequence to disk in NICE-SLAM's Replica layout."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...types import InputError, Sequence
from ..meshes import ply_bytes
from ..prefetch import workers

DEPTH_SCALE = 6553.5
JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]


def write_replica(sequence: Sequence, folder: str | Path, progress: Callable[[int, int], None] | None = None) -> Path:
    """Write results/frameNNNNNN.jpg and depthNNNNNN.png, traj.txt, cam_params.json and mesh.ply; return the folder.

    ``progress`` is called with (frames done, frames in all). Raises InputError when the folder holds something already
    or cannot be written, or when the sequence has no poses.
    """
    folder = Path(folder)
    poses = sequence.poses_gt()
    if poses is None:
        raise InputError(f"{sequence.name}: has no poses to write; choose a sequence with ground truth")
    try:
        if folder.exists() and any(folder.iterdir()):
            raise InputError(f"{folder}: not empty; choose a new folder")
        (folder / "results").mkdir(parents=True, exist_ok=True)
        (folder / "cam_params.json").write_text(_camera(sequence))
        np.savetxt(folder / "traj.txt", poses.reshape(-1, 16), "%.12f")
        mesh = sequence.reference_mesh()
        if mesh is not None:
            (folder / "mesh.ply").write_bytes(ply_bytes(mesh))
        pool = ThreadPoolExecutor(workers(), "export")
        try:
            for done, _ in enumerate(pool.map(partial(_write, sequence, folder / "results"), range(len(sequence)))):
                if progress is not None:
                    progress(done + 1, len(sequence))
        finally:
            pool.shutdown(cancel_futures=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}); choose another folder") from None
    return folder


def _write(sequence: Sequence, folder: Path, index: int) -> None:
    frame = sequence[index]
    _save(folder / f"frame{index:06d}.jpg", frame.color[..., ::-1], JPEG)
    depth = np.clip(np.rint(frame.depth.astype(np.float64) * DEPTH_SCALE), 0, 65535)
    _save(folder / f"depth{index:06d}.png", depth.astype(np.uint16), [])


def _camera(sequence: Sequence) -> str:
    k = sequence.intrinsics
    values = {"w": k.width, "h": k.height, "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "scale": DEPTH_SCALE}
    return json.dumps({"camera": values}, indent=2)


def _save(path: Path, image: NDArray[np.generic], options: list[int]) -> None:
    ok, data = cv2.imencode(path.suffix, np.ascontiguousarray(image), options)
    if not ok:
        raise OSError(0, f"image {path.name} cannot be encoded")
    path.write_bytes(data.tobytes())
