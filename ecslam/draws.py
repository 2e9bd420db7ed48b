"""The rays of a mapping iteration: drawn by numpy on the CPU, or from pixels and random numbers that lie on a GPU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .config import Config
from .field import TsdfField
from .indices import evenly
from .kernels import Backend, DevicePixels, RayBatch
from .pixel_bank import PixelBank
from .pixels import Pixels
from .rays import gather, make_rays, upload
from .samples import LEAST_UNIFORM, rendered_depths, resampled, thinned, uniform
from .sending import Letter

Draw = Callable[[int, Tensor], RayBatch]
AHEAD = 10
A_POSE = 24  # numbers: see ``DeviceViews``


def shares(views: int, rays: int, newest_share: float) -> list[int]:
    """How many rays each view gets: the newest ``newest_share`` of them (an equal share if that is more), the others
    the rest, rounded up."""
    newest = max(round(rays * newest_share), -(-rays // views))
    older = -(-(rays - newest) // max(views - 1, 1))
    return [older] * (views - 1) + [newest]


def by_height(direction: NDArray[np.float32], iterations: int) -> NDArray[np.int64]:
    """Rows of directions [I R, 2] in an order that leaves each iteration its rays and puts them by their height in the
    image, whatever the view: what neighbours read of the map is then in a CPU's cache more often."""
    height = direction[:, 1].reshape(iterations, -1)
    return (np.argsort(height, 1, kind="stable") + height.shape[1] * np.arange(iterations)[:, None]).reshape(-1)


class HostDraw:
    """Rays for (iteration, poses float32 [W, 4, 4]), on the CPU: ``AHEAD`` iterations' worth at a time, since one takes
    next to nothing but the calls."""

    def __init__(
        self,
        views: Sequence[Pixels],
        config: Config,
        field: TsdfField,
        kernels: Backend,
        rng: np.random.Generator,
        generator: torch.Generator,
    ) -> None:
        self._views, self._config, self._field, self._kernels = views, config, field, kernels
        self._rng, self._generator, self._box = rng, generator, field.layout.box
        self._counts = shares(len(views), config.mapping.rays, config.mapping.newest_share)
        self._ahead: list[tuple[DevicePixels, Tensor, RayBatch]] = []

    def __call__(self, iteration: int, c2w: Tensor) -> RayBatch:
        """The rays of an iteration."""
        if not self._ahead:
            self._ahead = self._some(c2w)
        pixels, jitter, rays = self._ahead.pop()
        missing = torch.nonzero(rays.depth <= 0)[:, 0]
        if not len(missing):
            return rays
        row, numbers = rays.pose.index_select(0, missing), jitter.index_select(0, missing)
        few = make_rays(pixels.take(missing), row, c2w, self._box, self._kernels, self._config, numbers, missing=True)
        z = resampled(few, c2w, self._field, self._kernels, self._config.sampling, self._generator)
        rays.z.index_copy_(0, missing, z)
        return rays

    def _some(self, c2w: Tensor) -> list[tuple[DevicePixels, Tensor, RayBatch]]:
        """Pixels, random numbers in 0..1 [R, S] and rays of iterations; z of rays without depth is yet to be found."""
        s, counts, rng = self._config.sampling, self._counts, self._rng
        picks = [rng.integers(0, len(view), (AHEAD, count)) for view, count in zip(self._views, counts, strict=True)]
        chosen = gather(self._views, picks)
        order = by_height(chosen.direction, AHEAD)
        pixels = upload(chosen.take(order), c2w.device)
        jitter = uniform(self._generator, c2w.device, len(pixels.depth), s.uniform + s.near_depth)
        row = torch.from_numpy(np.tile(np.repeat(np.arange(len(counts)), counts), AHEAD)[order])
        rays = make_rays(pixels, row, c2w, self._box, self._kernels, self._config, jitter, missing=False)
        parts = (slice(first, first + sum(counts)) for first in range(0, len(row), sum(counts)))
        return [(pixels.take(part), jitter[part], rays.take(part)) for part in parts]


@dataclass(frozen=True)
class DeviceViews:
    """What the rays of a loop are drawn from, and from where these views were seen, on one device.

    numbers: float64 [24 P]: of P poses c2w [4, 4] each, then their learning rates [6] each, then the first row and the
    count of each view in ``pixels``. row: int64 [R], the view of each ray. box: [2, 3] metres. missing: whether some
    pixels have no depth.
    """

    pixels: DevicePixels
    numbers: Tensor
    row: Tensor
    box: Tensor
    missing: bool

    @property
    def poses(self) -> int:
        """How many there is room for."""
        return len(self.numbers) // A_POSE

    @property
    def c2w(self) -> Tensor:
        """[P, 4, 4]."""
        return self.numbers[: 16 * self.poses].view(-1, 4, 4)

    @property
    def rates(self) -> Tensor:
        """[P, 6]."""
        return self.numbers[16 * self.poses : 22 * self.poses].view(-1, 6)

    @property
    def spans(self) -> Tensor:
        """int64 [P, 2]."""
        return self.numbers[22 * self.poses :].view(-1, 2).long()

    def jitter(self, config: Config) -> int:
        """How many random numbers a ray takes: which pixel, where its samples lie and, with ``missing``, where those
        lie that follow the rendered depth."""
        s = config.sampling
        return 1 + s.uniform + (2 if self.missing else 1) * s.near_depth


class Desk:
    """Where all that a mapping's loops are given lies on a device: always in the same places and of the same sizes, so
    that graphs can be replayed. poses: room for so many. rays: of an iteration."""

    def __init__(self, poses: int, rays: int, device: torch.device) -> None:
        self.poses, self.rays = poses, rays
        self._letter = Letter(A_POSE * poses, device)
        self._row, self._counts = torch.zeros(rays, dtype=torch.int64, device=device), [0]
        self._jitter: dict[tuple[int, int], Tensor] = {}

    def lay_out(
        self,
        bank: PixelBank,
        views: Sequence[Pixels],
        c2w: NDArray[np.float64],
        rates: NDArray[np.float64],
        newest_share: float,
        box: Tensor,
    ) -> DeviceViews:
        """Views with their poses c2w [W, 4, 4] and learning rates [W, 6], never waiting. box: on the device."""
        places, empty = bank.places(views), self.poses - len(views)
        spans = [(place.first, len(place.view)) for place in places]
        rest = np.tile(np.eye(4), (empty, 1, 1)), np.zeros((empty, 6)), np.zeros((empty, 2))
        numbers = self._letter.send(c2w, rest[0], rates, rest[1], spans, rest[2])
        if (counts := shares(len(views), self.rays, newest_share)) != self._counts:
            row = np.repeat(np.arange(len(views)), counts)
            self._row.copy_(torch.from_numpy(row[evenly(len(row), self.rays)]), non_blocking=True)
            self._counts = counts
        return DeviceViews(bank.columns, numbers, self._row, box, any(place.missing for place in places))

    def jitter(self, iterations: int, count: int, generator: torch.Generator | None) -> Tensor:
        """Random numbers in 0..1 [iterations, R, count], where the last ones of that size were."""
        kept = self._jitter.setdefault((iterations, count), self._row.new_empty(0, dtype=torch.float32))
        return torch.rand(iterations, self.rays, count, generator=generator, out=kept)


class DeviceDraw:
    """Rays for (iteration, poses float32 [W, 4, 4]), on any device, never waiting for it: those of all iterations at
    once. What an iteration does itself is to find the map's surface for rays without depth.

    jitter: [I, R, numbers] in 0..1. c2w: [W, 4, 4], the poses that say where rays without depth leave the box.
    """

    def __init__(
        self, views: DeviceViews, jitter: Tensor, c2w: Tensor, config: Config, field: TsdfField, kernels: Backend
    ) -> None:
        s, (iterations, self._size, _) = config.sampling, jitter.shape
        count, numbers, row = 1 + s.uniform + s.near_depth, jitter.flatten(0, 1), views.row.repeat(iterations)
        first, length = views.spans[row].unbind(1)
        pixels = views.pixels.take(first + torch.minimum((numbers[:, 0] * length).long(), length - 1))
        self._field, self._kernels = field, kernels
        self._rays = make_rays(pixels, row, c2w, views.box, kernels, config, numbers[:, 1:count], views.missing)
        self._follow = views.missing and s.uniform >= LEAST_UNIFORM
        if self._follow:
            self._thinned, self._jitter = thinned(self._rays.z, s), numbers[:, count:].contiguous()
            self._has = self._rays.depth[:, None] > 0

    def __call__(self, iteration: int, c2w: Tensor) -> RayBatch:
        """The rays of an iteration."""
        part = slice(iteration * self._size, (iteration + 1) * self._size)
        rays = self._rays.take(part)
        if not self._follow:
            return rays
        few = replace(rays, z=self._thinned[part])
        z = rendered_depths(few, c2w, self._field, self._kernels, self._jitter[part])
        return replace(rays, z=torch.where(self._has[part], rays.z, z))
