"""Pixels of a frame chosen where it lies, on a GPU: what ``pixels`` does, in fixed sizes and without waiting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .config import Config
from .pixels import LUMINANCE, border_of, feature_points, grid_shape
from .rays import DevicePixels
from .types import Frame, Intrinsics


@dataclass(frozen=True)
class DeviceFrame:
    """A frame's images on a device. color: uint8 [H, W, 3]. depth: float32 [H, W] metres."""

    color: Tensor
    depth: Tensor

    @classmethod
    def of(cls, frame: Frame, device: torch.device) -> DeviceFrame:
        """Begin to upload a frame."""
        images = (torch.from_numpy(np.ascontiguousarray(image)) for image in (frame.color, frame.depth))
        return cls(*(image.to(device, non_blocking=True) for image in images))


def padded_corners(frame: Frame, config: Config, count: int) -> NDArray[np.int64]:
    """The corners among ``count`` pixels of a frame, strongest first, and -1 up to their largest number [C]."""
    limit = min(config.feature_count, count // 2) if config.fus else 0
    out = np.full(max(limit, 0), -1, np.int64)
    if limit > 0:
        found = feature_points(frame, config, limit)
        out[: len(found)] = found
    return out


def grid_cells(frame: DeviceFrame, count: int, config: Config) -> int:
    """How many cells a grid of ``count`` pixels has: as many, or the few more that rows and columns need."""
    height, width = frame.depth.shape
    border = border_of(config, height, width)
    rows, columns = grid_shape(height - 2 * border, width - 2 * border, count)
    return rows * columns


def spread(frame: DeviceFrame, camera: Intrinsics, count: int, config: Config, jitter: Tensor) -> DevicePixels:
    """A pixel in each cell of the uniform grid of about ``count``. jitter: [grid_cells, 2] in 0..1."""
    cell = torch.arange(len(jitter), device=jitter.device)
    return _read(frame, camera, _in_cells(frame, cell, count, config, jitter), torch.zeros_like(cell).bool(), config)


def choose(
    frame: DeviceFrame, camera: Intrinsics, config: Config, corners: Tensor, order: Tensor, jitter: Tensor
) -> DevicePixels:
    """As many pixels as there are rows of ``jitter`` [N, 3] in 0..1. With FUS the first ones are the ``corners`` [C] of
    the frame (-1: none), the rest come from the uniform grid, some of whose cells go without; without FUS all are
    uniform random. order: the cells of that grid [grid_cells], shuffled."""
    count, (height, width) = len(jitter), frame.depth.shape
    if not config.fus:
        border = border_of(config, height, width)
        v = border + (jitter[:, 0] * (height - 2 * border)).long()
        u = border + (jitter[:, 1] * (width - 2 * border)).long()
        return _read(frame, camera, v * width + u, torch.zeros_like(u).bool(), config)
    start = (jitter[0, 2] * len(order)).long()
    cell = order[(torch.arange(count, device=order.device) + start) % len(order)]
    index = _in_cells(frame, cell, count, config, jitter)
    corners = torch.nn.functional.pad(corners, (0, count - len(corners)), value=-1)
    feature = corners >= 0
    return _read(frame, camera, torch.where(feature, corners, index), feature, config)


def light_of(pixels: DevicePixels) -> Tensor:
    """Luminance [N] in 0..1."""
    (red, green, blue), (r, g, b) = pixels.color.float().unbind(1), LUMINANCE.tolist()
    return r * red + g * green + b * blue


def compacted(keep: Tensor) -> tuple[Tensor, Tensor]:
    """The indices [N] at which ``keep`` [N] is true, in order, then rubbish; and how many there are []."""
    count, place = keep.sum(), keep.cumsum(0) - 1
    out = place.new_zeros(len(keep) + 1)
    out[torch.where(keep, place, len(keep))] = torch.arange(len(keep), device=keep.device)
    return out[:-1], count


def _in_cells(frame: DeviceFrame, cell: Tensor, count: int, config: Config, jitter: Tensor) -> Tensor:
    height, width = frame.depth.shape
    border = border_of(config, height, width)
    h, w = height - 2 * border, width - 2 * border
    rows, columns = grid_shape(h, w, count)
    v = ((cell // columns + jitter[:, 0]) * (h / rows)).long().clamp_max(h - 1) + border
    u = ((cell % columns + jitter[:, 1]) * (w / columns)).long().clamp_max(w - 1) + border
    return v * width + u


def _read(frame: DeviceFrame, camera: Intrinsics, index: Tensor, feature: Tensor, config: Config) -> DevicePixels:
    v, u = index // frame.depth.shape[1], index % frame.depth.shape[1]
    one = torch.ones_like(index, dtype=torch.float32)
    direction = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, one], 1)
    depth = frame.depth.view(-1)[index]
    sound = (depth >= config.depth_near_m) & (depth <= config.depth_far_m)
    return DevicePixels(direction, torch.where(sound, depth, 0.0), frame.color.view(-1, 3)[index], feature)
