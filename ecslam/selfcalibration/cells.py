"""A depth image as small planes: for each cell of it where its surface lies and how that is inclined.

Inverse depth is affine over the image of a plane, whatever the focal length or the centre of the image; so planes are
fitted to it once, and turned into points and normals for each camera that is tried.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..shutter import Sweep, halfway
from ..types import Calibration, Intrinsics

ACROSS, REACH = 80, 2  # cells in a row of the image; a plane is fitted to a cell and so many around it
LEAST_MEASURED, ROUGH = 0.9, 0.002  # of these pixels; 1/m, root mean square
PARAMETERS = 5  # logarithm of the focal length, centre (x, y), radial, inverse depth


@dataclass(frozen=True)
class Cells:
    """The cells of one image that show something flat. pixel: [n, 2] (u, v) of their middle; inverse: [n] 1/m, and
    slope: [n, 2] 1/m per pixel, of the plane there. index: [h, w] which cell a place in the grid is, -1 for none; size:
    pixels of a cell's side. rows: [n] when each was read, -0.5 .. 0.5 of the ``sweep`` of the camera (see ``shutter``).
    """

    pixel: NDArray[np.float64]
    inverse: NDArray[np.float64]
    slope: NDArray[np.float64]
    index: NDArray[np.int64]
    size: int
    rows: NDArray[np.float64]
    sweep: Sweep

    @property
    def apart(self) -> NDArray[np.int64]:
        """The cells [m] of every second row and column, for the planes of neighbours share most of their pixels."""
        some = self.index[::2, ::2]
        return some[some >= 0]

    def __len__(self) -> int:
        return len(self.inverse)

    def at(self, pixel: NDArray[np.float64]) -> NDArray[np.int64]:
        """The cell [m] that pixels [m, 2] lie in, -1 for none."""
        place = np.floor((pixel + 0.5) / self.size).astype(np.int64)
        inside = ((place >= 0) & (place < np.array(self.index.shape)[::-1])).all(1)
        out = np.full(len(pixel), -1)
        out[inside] = self.index[place[inside, 1], place[inside, 0]]
        return out


@dataclass(frozen=True)
class Surface:
    """Cells as a camera sees them. points: [n, 3] metres, and normals: [n, 3], towards it. change: [n, 3, 5] of the
    points by what is unknown of the camera."""

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    change: NDArray[np.float64]

    def taken(self, index: NDArray[np.int64]) -> Surface:
        """Some of it."""
        return Surface(self.points[index], self.normals[index], self.change[index])


def cells_of(depth: NDArray[np.float32], far_m: float, sweep: Sweep) -> Cells:
    """The flat cells of depth [H, W] in metres, 0 where there is none; nothing farther than ``far_m``."""
    height, width = depth.shape
    size = max(width // ACROSS, 1)
    rows, columns = height // size, width // size
    used = depth[: rows * size, : columns * size].astype(np.float64)
    measured = (used > 0) & (used <= far_m)
    inverse = np.divide(1.0, used, out=np.zeros_like(used), where=measured)
    v, u = (np.mgrid[: rows * size, : columns * size] - np.array([[[height]], [[width]]]) / 2) / width
    one = measured.astype(np.float64)
    terms = (one, one * u, one * v, one * u * u, one * u * v, one * v * v, *(inverse * w for w in (1, u, v, inverse)))
    sums = np.stack([term.reshape(rows, size, columns, size).sum((1, 3)) for term in terms], -1)
    around = (2 * REACH + 1, 2 * REACH + 1)
    sums = cv2.boxFilter(sums, cv2.CV_64F, around, normalize=False, borderType=cv2.BORDER_CONSTANT)
    kept = np.argwhere(sums[..., 0] >= LEAST_MEASURED * (size * around[0]) ** 2)
    sums = sums[kept[:, 0], kept[:, 1]]
    right = sums[:, 6:9]
    plane = np.linalg.solve(sums[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3), right[..., None])[..., 0]
    rest = np.maximum(sums[:, 9] - (plane * right).sum(1), 0) / sums[:, 0]
    pixel = kept[:, ::-1] * size + (size - 1) / 2
    middle = plane[:, 0] + (plane[:, 1:] * (pixel - [width / 2, height / 2]) / width).sum(1)
    flat = (rest <= ROUGH**2) & (middle > 0)
    index = np.full((rows, columns), -1)
    index[kept[flat, 0], kept[flat, 1]] = np.arange(flat.sum())
    pixel = pixel[flat]
    return Cells(pixel, middle[flat], plane[flat, 1:] / width, index, size, (pixel[:, 1] + 0.5) / height - 0.5, sweep)


def surface(cells: Cells, seen: Calibration) -> Surface:
    """Cells as points and normals, if the camera is as in ``seen``."""
    k = seen.camera
    x, y = ((cells.pixel - [k.cx, k.cy]) / [k.fx, k.fy]).T
    square = x * x + y * y
    bend = 1 + seen.radial * square
    rays = np.stack([x * bend, y * bend, np.ones_like(x)], 1)
    inverse = cells.inverse + seen.inverse_depth
    depth = 1 / inverse
    points = rays * depth[:, None]
    slope = cells.slope * [k.fx, k.fy] / (1 + 3 * seen.radial * square)[:, None]
    normals = -np.concatenate([slope, (inverse - (rays[:, :2] * slope).sum(1))[:, None]], 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    change = np.zeros((len(cells), 3, PARAMETERS))
    both = 2 * seen.radial * x * y
    change[:, 0, 1], change[:, 1, 1] = (bend + 2 * seen.radial * x * x) / -k.fx, both / -k.fx
    change[:, 0, 2], change[:, 1, 2] = both / -k.fy, (bend + 2 * seen.radial * y * y) / -k.fy
    change[:, :, 0] = change[:, :, 1] * (x * k.fx)[:, None] + change[:, :, 2] * (y * k.fy)[:, None]
    change[:, 0, 3], change[:, 1, 3] = x * square, y * square
    change[:, :, 4] = -points
    change *= depth[:, None, None]
    share = cells.rows[:, None]
    return Surface(halfway(points, share, cells.sweep), normals + share * np.cross(cells.sweep[3:], normals), change)


def project(points: NDArray[np.float64], seen: Calibration) -> NDArray[np.float64]:
    """The pixels [n, 2] at which the camera of ``seen`` sees points [n, 3] before it."""
    straight = points[:, :2] / points[:, 2:]
    bent = straight
    for _ in range(3):
        bent = straight / (1 + seen.radial * (bent * bent).sum(1, keepdims=True))
    k = seen.camera
    return bent * [k.fx, k.fy] + [k.cx, k.cy]


def moved(seen: Calibration, step: NDArray[np.float64]) -> Calibration:
    """The calibration after a step [5] of the parameters."""
    k, zoom = seen.camera, float(np.exp(step[0]))
    camera = Intrinsics(
        k.fx * zoom, k.fy * zoom, k.cx + float(step[1]), k.cy + float(step[2]), k.width, k.height, readout_s=k.readout_s
    )
    return Calibration(camera, seen.radial + float(step[3]), seen.inverse_depth + float(step[4]))


def parameters(seen: Calibration) -> NDArray[np.float64]:
    """Focal length and centre in pixels, radial, inverse depth in 1/m [5]."""
    return np.array([seen.camera.fx, seen.camera.cx, seen.camera.cy, seen.radial, seen.inverse_depth])


def difference(seen: Calibration, start: Calibration) -> NDArray[np.float64]:
    """The step [5] that leads from ``start`` to ``seen``."""
    step = parameters(seen) - parameters(start)
    step[0] = np.log(seen.camera.fx / start.camera.fx)
    return step
