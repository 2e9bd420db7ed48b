"""Depth as a NumPy file (format version 1.0) of 16-bit numbers, read without trusting what its header claims."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..types import FrameError
from .images import HEADER_BYTES, read_bytes, require_size


def array_size(path: Path) -> tuple[int, int]:
    """(width, height) by the header. Raises FrameError."""
    return _header(path, read_bytes(path, HEADER_BYTES))[0]


def read_depth_array(path: Path, size: tuple[int, int]) -> NDArray[np.uint16]:
    """uint16 [H, W], as stored. size: the (width, height) it must have. Raises FrameError."""
    data = read_bytes(path, HEADER_BYTES + 2 * size[0] * size[1])
    found, start = _header(path, data)
    require_size(path, found, size)
    if len(data) - start != 2 * size[0] * size[1]:
        raise FrameError(f"{path}: not as long as an array of its size; copy it again")
    return np.frombuffer(data, "<u2", offset=start).reshape(size[1], size[0])


def _header(path: Path, data: bytes) -> tuple[tuple[int, int], int]:
    """Its size, and where the values begin."""
    stream = BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        shape, by_column, kind = np.lib.format.read_array_header_1_0(stream)
    except ValueError:
        raise FrameError(f"{path}: no NumPy array, or a truncated one; copy it again") from None
    if version != (1, 0) or by_column or kind != np.dtype("<u2") or len(shape) != 2:
        raise FrameError(f"{path}: a {kind} array of shape {shape}, but depth is one of rows of 16-bit numbers")
    return (shape[1], shape[0]), stream.tell()
