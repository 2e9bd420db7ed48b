"""Which pixels of an image become rays: features and a jittered uniform grid (FUS), or uniform random (the ablation).

Sampled once per frame, in the camera's coordinates (paper, section III-B, "Robust Pixel Sampling Method").
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from .config import Config
from .types import Corners, Frame, Intrinsics

LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32) / 255  # of red, green and blue in 0..255


@dataclass(frozen=True, slots=True)
class Pixels:
    """Chosen pixels of one frame, compact enough to keep: 16 bytes each.

    direction: float32 [N, 2], the x and y of the viewing ray at unit depth. depth: float32 [N] metres, 0 = none.
    color: uint8 [N, 3]. feature: bool [N].
    """

    direction: NDArray[np.float32]
    depth: NDArray[np.float32]
    color: NDArray[np.uint8]
    feature: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.depth)

    def points(self) -> NDArray[np.float32]:
        """Measured surface points [M, 3] in camera coordinates, of the pixels with depth."""
        index = np.flatnonzero(self.depth > 0)  # three times as quick as a mask
        out = np.empty((len(index), 3), np.float32)
        z, (x, y) = self.depth.take(index), self.direction.take(index, 0).T
        for part, values in zip(out.T, (x * z, y * z, z), strict=True):  # numpy is slow along rows of three
            part[:] = values
        return out

    def in_world(self, c2w: NDArray[np.float64]) -> NDArray[np.float32]:
        """``points`` [M, 3] in the world, seen from c2w [4, 4]."""
        return (c2w[:3, :3].astype(np.float32) @ self.points().T + c2w[:3, 3:].astype(np.float32)).T

    def take(self, index: NDArray[np.integer]) -> Pixels:
        """The pixels at ``index``."""
        color, feature = self.color.take(index, 0), self.feature.take(index)
        return Pixels(self.direction.take(index, 0), self.depth.take(index), color, feature)

    def every(self, stride: int) -> Pixels:
        """Every ``stride``-th pixel."""
        some = slice(None, None, stride)
        return Pixels(self.direction[some], self.depth[some], self.color[some], self.feature[some])


@dataclass(frozen=True)
class Points:
    """Measured points to align. local: float32 [N, 3], camera coordinates in metres. light: float32 [N] in 0..1."""

    local: Tensor
    light: Tensor

    def every(self, stride: int) -> Points:
        """Every ``stride``-th point."""
        return Points(self.local[::stride].contiguous(), self.light[::stride].contiguous())


def find_corners(color: NDArray[np.uint8], config: Config) -> Corners:
    """The ``feature_count`` strongest Shi-Tomasi corners of an RGB image [H, W, 3]."""
    height, width = color.shape[:2]
    border, none = border_of(config, height, width), np.empty(0, np.int64)
    if config.feature_count <= 0:
        return Corners(none, _corner_settings(config))
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)[border : height - border, border : width - border]
    found = cv2.goodFeaturesToTrack(gray, config.feature_count, config.feature_quality, config.feature_distance_px)
    if found is None:
        return Corners(none, _corner_settings(config))
    u, v = np.rint(found.reshape(-1, 2)).astype(np.int64).T + border
    return Corners(v * width + u, _corner_settings(config))


def feature_points(frame: Frame, config: Config, limit: int) -> NDArray[np.int64]:
    """Flat indices of a frame's strongest corners, ``limit`` at most; those that were found ahead, if there are any."""
    corners = frame.corners
    if corners is None or corners.settings != _corner_settings(config):
        corners = find_corners(frame.color, config)
    return corners.index[:limit]


def _corner_settings(config: Config) -> tuple[float, ...]:
    return config.feature_count, config.feature_quality, config.feature_distance_px, config.border_px


def grid_shape(height: int, width: int, count: int) -> tuple[int, int]:
    """Rows and columns of the uniform grid of at least ``count`` nearly square cells."""
    rows = max(1, int(np.ceil(np.sqrt(count * height / width))))
    return rows, max(1, int(np.ceil(count / rows)))


def grid_points(height: int, width: int, border: int, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Flat indices of exactly ``count`` pixels, one in each cell of a uniform grid, jittered inside its cell."""
    h, w = height - 2 * border, width - 2 * border
    rows, columns = grid_shape(h, w, count)
    cell = np.arange(rows * columns)
    if len(cell) > count:
        cell = np.sort(rng.choice(cell, count, replace=False))
    jitter = rng.random((2, len(cell)))
    v = ((cell // columns + jitter[0]) * (h / rows)).astype(np.int64)
    u = ((cell % columns + jitter[1]) * (w / columns)).astype(np.int64)
    return (np.minimum(v, h - 1) + border) * width + np.minimum(u, w - 1) + border


def choose_pixels(
    frame: Frame, camera: Intrinsics, count: int, config: Config, rng: np.random.Generator, *, rim: bool = False
) -> Pixels:
    """``count`` pixels of a frame. With FUS: its features, the rest from the grid; without: uniform random.

    rim: whether the grid (or the random choice) reaches into the image's border.
    """
    height, width = frame.depth.shape
    border = 0 if rim else border_of(config, height, width)
    if config.fus:
        corners = feature_points(frame, config, count // 2)
        rest = grid_points(height, width, border, count - len(corners), rng)
        index = np.concatenate([corners, rest])
        feature = np.arange(len(index)) < len(corners)
    else:
        v = rng.integers(border, height - border, count)
        u = rng.integers(border, width - border, count)
        index, feature = v * width + u, np.zeros(count, bool)
    return _read(frame, camera, index, feature, config)


def spread_pixels(frame: Frame, camera: Intrinsics, count: int, config: Config, rng: np.random.Generator) -> Pixels:
    """``count`` pixels of a frame from the jittered grid alone, which costs no feature detection."""
    height, width = frame.depth.shape
    index = grid_points(height, width, border_of(config, height, width), count, rng)
    return _read(frame, camera, index, np.zeros(count, bool), config)


def _read(
    frame: Frame, camera: Intrinsics, index: NDArray[np.int64], feature: NDArray[np.bool_], config: Config
) -> Pixels:
    v, u = np.divmod(index, frame.depth.shape[1])
    direction = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], 1).astype(np.float32)
    depth = in_range(frame.depth.reshape(-1)[index], config)
    return Pixels(direction, depth, frame.color.reshape(-1, 3)[index], feature)


def in_range(depth: NDArray[np.float32], config: Config) -> NDArray[np.float32]:
    """The same depths, 0 where they do not count."""
    return np.where((depth >= config.depth_near_m) & (depth <= config.depth_far_m), depth, np.float32(0))


def border_of(config: Config, height: int, width: int) -> int:
    """How many pixels at an image's edges are ignored."""
    return min(config.border_px, (min(height, width) - 1) // 4)
