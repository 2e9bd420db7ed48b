"""Pixels of a frame chosen where it lies, on a GPU: what ``pixels`` does, in fixed sizes and without waiting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .config import Config
from .kernels import DevicePixels, tracking_gpu
from .kernels.tracking_gpu import Cells, Lens, Marks
from .observed import LEAST_KNOWN, VOXEL_M
from .observed_gpu import ObservedTable
from .pixels import LUMINANCE, border_of, feature_points, grid_shape
from .shutter import FAR_M
from .types import Frame, Intrinsics


@dataclass(frozen=True)
class DeviceFrame:
    """A frame's images on a device. color: uint8 [H, W, 3]. depth: float32 [H, W] metres."""

    color: Tensor
    depth: Tensor

    @classmethod
    def of(cls, frame: Frame, device: torch.device, place: DeviceFrame | None = None) -> DeviceFrame:
        """Begin to upload a frame, to ``place`` if that has its size."""
        images = [torch.from_numpy(np.ascontiguousarray(image)) for image in (frame.color, frame.depth)]
        if place is None or place.depth.shape != frame.depth.shape:
            place = cls(*(torch.empty_like(image, device=device) for image in images))
        for into, image in zip((place.color, place.depth), images, strict=True):
            into.copy_(image, non_blocking=True)
        return place


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
    _, rows, columns = _grid(frame, count, config)
    return rows * columns


def spread(frame: DeviceFrame, camera: Intrinsics, count: int, config: Config, jitter: Tensor, gain: Tensor) -> Tensor:
    """The points of a pixel in each cell of the uniform grid of about ``count``: see ``tracking_gpu.spread``. jitter:
    [grid_cells, 2] in 0..1. gain: float64 [1]."""
    cells, luminance = _cells(frame, count, config), tuple(map(float, LUMINANCE))
    return tracking_gpu.spread(frame.color, frame.depth, jitter, cells, _lens(camera, config), luminance, gain)


def choose(
    frame: DeviceFrame,
    camera: Intrinsics,
    config: Config,
    corners: Tensor,
    order: Tensor,
    jitter: Tensor,
    observed: ObservedTable,
    c2w: Tensor,
) -> DevicePixels:
    """As many pixels as there are rows of ``jitter`` [N, 3] in 0..1, all where the map has been ``observed``, seen from
    c2w [4, 4], some more than once; with a depth at least where that leaves too few. With FUS the first ones are the
    ``corners`` [C] of the frame (-1: none), the rest come from the uniform grid, some of whose cells go without;
    without FUS all are uniform random. order: the cells of that grid [grid_cells], shuffled."""
    cells = _cells(frame, len(jitter) if config.fus else 1, config)
    return tracking_gpu.chosen(
        frame.color, frame.depth, jitter, corners, order if config.fus else None, cells, _lens(camera, config),
        Marks(observed.marks.view(torch.uint8), len(observed.marks), 1 / VOXEL_M), c2w, LEAST_KNOWN,
    )  # fmt: skip


def straight(points: Tensor, camera: Intrinsics, sweep: Tensor) -> Tensor:
    """``shutter.straight`` of points [N, 3 or 4], the fourth number left alone; 0 stays 0. sweep: [6]."""
    at, rest, sweep = points[:, :3], points[:, 3:], sweep.to(points.dtype)
    there = at[:, 2:] > 0
    share = (camera.fy * at[:, 1:2] / torch.where(there, at[:, 2:], 1.0) + camera.cy + 0.5) / camera.height - 0.5
    move = sweep[:3] + torch.linalg.cross(sweep[3:].expand_as(at), at)
    return torch.cat([at + share * move * there, rest], 1)


def straight_pixels(pixels: DevicePixels, camera: Intrinsics, sweep: Tensor) -> DevicePixels:
    """See ``shutter.straight_pixels``."""
    there = pixels.depth > 0
    points = straight(pixels.direction * torch.where(there, pixels.depth, FAR_M)[:, None], camera, sweep)
    z = points[:, 2]
    return pixels._replace(direction=points / z[:, None], depth=torch.where(there, z, 0.0))


def _lens(camera: Intrinsics, config: Config) -> Lens:
    return Lens(camera.fx, camera.fy, camera.cx, camera.cy, config.depth_near_m, config.depth_far_m)


def _cells(frame: DeviceFrame, count: int, config: Config) -> Cells:
    border, rows, columns = _grid(frame, count, config)
    h, w = (side - 2 * border for side in frame.depth.shape)
    return Cells(frame.depth.shape[1], border, columns, h - 1, w - 1, h / rows, w / columns)


def _grid(frame: DeviceFrame, count: int, config: Config) -> tuple[int, int, int]:
    """The border of the frame's image, and rows and columns of the grid of ``count`` cells inside it."""
    height, width = frame.depth.shape
    border = border_of(config, height, width)
    return border, *grid_shape(height - 2 * border, width - 2 * border, count)
