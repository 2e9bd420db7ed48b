"""Small .sens files, as the reader's makers write them."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np


def encoded(color: np.ndarray, ending: str = ".png") -> bytes:
    ok, data = cv2.imencode(ending, np.ascontiguousarray(color[..., ::-1]))
    assert ok
    return data.tobytes()


def record(
    file: Path,
    colors: Sequence[np.ndarray | bytes],
    depths: Sequence[np.ndarray | bytes],
    poses: Sequence[np.ndarray],
    matrix: np.ndarray,
    *,
    color_matrix: np.ndarray | None = None,
    places: tuple[np.ndarray, np.ndarray] = (np.eye(4), np.eye(4)),
    stamps_us: Sequence[int] | None = None,
    kinds: tuple[int, int] = (1, 1),
    sizes: tuple[int, int, int, int] | None = None,
    scale: float = 1000.0,
    version: int = 4,
    count: int | None = None,
    name: bytes = b"StructureSensor",
) -> Path:
    """colors: RGB [H, W, 3], or encoded already. depths: uint16, or compressed already. matrix: 3x3, of the depth."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if sizes is None:
        first = colors[0], depths[0]
        assert isinstance(first[0], np.ndarray)
        assert isinstance(first[1], np.ndarray)
        sizes = (*first[0].shape[1::-1], *first[1].shape[1::-1])
    with file.open("wb") as out:
        out.write(struct.pack("<IQ", version, len(name)) + name)
        for camera, place in zip((matrix if color_matrix is None else color_matrix, matrix), places, strict=True):
            four = np.eye(4)
            four[:3, :3] = camera
            out.write(four.astype("<f4").tobytes() + place.astype("<f4").tobytes())
        out.write(struct.pack("<iiIIIIfQ", *kinds, *sizes, scale, len(depths) if count is None else count))
        for i, (color, depth, c2w) in enumerate(zip(colors, depths, poses, strict=True)):
            time = stamps_us[i] if stamps_us is not None else 0
            parts = color, depth
            images = (
                parts[0] if isinstance(parts[0], bytes) else encoded(parts[0]),
                parts[1] if isinstance(parts[1], bytes) else zlib.compress(parts[1].astype("<u2").tobytes()),
            )
            out.write(c2w.astype("<f4").tobytes() + struct.pack("<4Q", time, time, *map(len, images)))
            out.writelines(images)
        out.write(struct.pack("<Q", 0))  # records of an inertial sensor
    return file
