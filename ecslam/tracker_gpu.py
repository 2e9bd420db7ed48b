"""Tracking a frame on a GPU: one upload, one recorded graph, one wait, for its result.

The same steps as ``tracker.track_frame`` takes on the host, in fixed sizes: points are spread over the image and
aligned to the fused volume, then the paper's rendered tracking, where the preset has it, goes on from there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .align import LEAST_KNOWN, stages
from .config import Config
from .descent import COARSE_STRIDE, RULES, outlier_cost
from .field import TsdfField
from .kernels import LOSS_NAMES, AlignSettings, Backend, RayBatch, fusion_gpu
from .kernels._gpu_blocks import Blocks
from .kernels.graphs import Recorder
from .observed_gpu import ObservedTable
from .pixels_gpu import DeviceFrame, choose, compacted, grid_cells, light_of, padded_corners, spread
from .pose_adam import pose_rates
from .rays import DevicePixels, kernel_weights, make_rays
from .samples import uniform
from .tracker import LEAST_POINTS, LEAST_SEEN, TrackResult, descend_rendered
from .types import Frame, Intrinsics
from .volume_gpu import GpuVolume

HEADER = 15  # numbers of a result before the loss terms: pose [3, 4], cost, fit, points


@dataclass(frozen=True)
class GpuTracker:
    """What tracking reads. volume: what frames are aligned to. observed: where the map may be trusted. generator: on
    the device, for pixels and samples."""

    camera: Intrinsics
    volume: GpuVolume
    observed: ObservedTable
    kernels: Backend
    generator: torch.Generator
    recorder: Recorder

    def track(self, frame: Frame, guess: NDArray[np.float64], field: TsdfField, config: Config) -> TrackResult:
        """The pose of a frame, sought from ``guess`` [4, 4]."""
        device, shown = field.device, self.volume.show(frame)
        a, t, s = config.align, config.tracking, config.sampling
        points, rays = grid_cells(shown, a.points, config), t.rays if t.iterations else 0
        numbers = uniform(self.generator, device, 2 * points + rays * (3 + s.uniform + s.near_depth))
        corners = torch.from_numpy(padded_corners(frame, config, rays)).to(device, non_blocking=True)
        start = torch.from_numpy(guess).to(device, non_blocking=True)
        order = _shuffled(grid_cells(shown, rays, config) if rays else 0, device)
        rates = _rates(t.lr_rotation, t.lr_translation, device)
        (found,) = self.recorder(
            partial(self._whole, field, self.volume.blocks, config),
            *(shown.color, shown.depth, corners, order, start, rates, numbers),
            key=None,
            over=(config, field, self.volume.blocks),
        )
        pose, (cost, fit, usable), terms = np.split(found.cpu().numpy(), [12, HEADER])
        if usable < LEAST_POINTS:
            return TrackResult(guess, {}, 0.0)
        losses = dict(zip(LOSS_NAMES, terms.tolist(), strict=True)) if rays else {"align_mm": 1e3 * cost**0.5}
        return TrackResult(np.concatenate([pose.reshape(3, 4), guess[3:]]), losses, float(fit))

    def _whole(
        self,
        field: TsdfField,
        blocks: Blocks,
        config: Config,
        color: Tensor,
        depth: Tensor,
        corners: Tensor,
        order: Tensor,
        start: Tensor,
        rates: Tensor,
        numbers: Tensor,
    ) -> tuple[Tensor]:
        """Everything as a function of tensors: float64 [HEADER, and the loss terms where frames are rendered]."""
        frame, a, settings = DeviceFrame(color, depth), config.align, tuple(stages(config))
        cells = grid_cells(frame, a.points, config)
        measured = spread(frame, self.camera, a.points, config, numbers[: 2 * cells].view(cells, 2))
        packed, count = self._packed(blocks, measured, start)
        row = fusion_gpu.descend(
            blocks, packed, fusion_gpu.pack_start(start, count), settings, a.iterations, COARSE_STRIDE, RULES
        )
        (pose, cost), terms = fusion_gpu.unpack_pose(row), start.new_empty(0)
        if config.tracking.iterations:
            jitter = numbers[2 * cells :].view(config.tracking.rays, -1)
            pixels = self._known(choose(frame, self.camera, config, corners, order, jitter[:, :3].contiguous()), pose)
            rendered, terms = self._rendered(field, config, pixels, pose, rates, jitter[:, 3:])
            costs = [_objective(blocks, packed, c2w, count, settings[-1]) for c2w in (pose, rendered)]
            pose = torch.where(costs[1] <= costs[0], rendered, pose)
        fit, usable = self._fit(blocks, measured, pose, 0.5 * config.truncation_m)
        return (
            torch.cat([pose[:3].reshape(12), torch.stack([cost / count.clamp_min(1), fit, usable]), terms.double()]),
        )

    def _packed(self, blocks: Blocks, measured: DevicePixels, start: Tensor) -> tuple[Tensor, Tensor]:
        """Points and luminance [N, 4], those first that are to be aligned, and how many these are: see
        ``align.known_points``."""
        has, local = measured.depth > 0, measured.direction * measured.depth[:, None]
        known = has & ~fusion_gpu.distances(blocks, _moved(start, local)).isnan()
        index, count = compacted(torch.where(known.sum() >= LEAST_KNOWN, known, has))
        return torch.cat([local, light_of(measured)[:, None]], 1)[index], count

    def _known(self, pixels: DevicePixels, c2w: Tensor) -> DevicePixels:
        """As many pixels, all of them where the map has been observed, some more than once; with a depth at least
        where that leaves too few."""
        has = pixels.depth > 0
        known = has & self.observed.contains(_moved(c2w, pixels.direction * pixels.depth[:, None]))
        index, count = compacted(torch.where(known.sum() >= LEAST_KNOWN, known, has))
        return pixels.take(index[torch.arange(len(index), device=index.device) % count.clamp_min(1)])

    def _rendered(
        self, field: TsdfField, config: Config, pixels: DevicePixels, c2w: Tensor, rates: Tensor, jitter: Tensor
    ) -> tuple[Tensor, Tensor]:
        """See ``tracker.track_adam``; rays without depth, where there are any, end where depths do."""
        t, row = config.tracking, torch.zeros_like(pixels.depth, dtype=torch.int64)
        rays = make_rays(pixels, row, c2w[None], c2w[:2, :3], config, jitter, missing=False)
        batch = (getattr(rays, name) for name in RayBatch.__dataclass_fields__)
        weights = kernel_weights(t.loss, config)
        best, terms = descend_rendered(field, self.kernels, weights, t.iterations, t.momentum, c2w[None], rates, *batch)
        return best[0], terms

    def _fit(self, blocks: Blocks, measured: DevicePixels, c2w: Tensor, near_m: float) -> tuple[Tensor, Tensor]:
        """See ``tracker.fit``; and how many points were measured."""
        has = measured.depth > 0
        distance = fusion_gpu.distances(blocks, _moved(c2w, measured.direction * measured.depth[:, None]))
        known = has & ~distance.isnan()
        share = (known & (distance.abs() < near_m)).sum() / known.sum().clamp_min(1).double()
        return torch.where(known.sum() < LEAST_SEEN * has.sum().clamp_min(1), 0.0, share), has.sum().double()


@cache
def _rates(lr_rotation: float, lr_translation: float, device: torch.device) -> Tensor:
    return pose_rates(torch.zeros(1, dtype=torch.bool), lr_rotation, lr_translation).to(device)


@cache
def _shuffled(count: int, device: torch.device) -> Tensor:
    return torch.randperm(count, generator=torch.Generator().manual_seed(0)).to(device, non_blocking=True)


def _moved(c2w: Tensor, local: Tensor) -> Tensor:
    """Camera points [N, 3] in the world, float64: sums of three products, not a matrix product for such small sizes."""
    x, y, z = local.double().unbind(1)
    return torch.stack([x * row[0] + y * row[1] + z * row[2] + row[3] for row in c2w[:3]], 1)


def _objective(blocks: Blocks, packed: Tensor, c2w: Tensor, count: Tensor, settings: AlignSettings) -> Tensor:
    """See ``descent.objective``, with the sums of ``count`` points taken at c2w [4, 4]."""
    sums = fusion_gpu.sums_at(blocks, packed, fusion_gpu.pack_start(c2w, count), settings)
    return sums[64] + outlier_cost(settings) * (count - sums[65])
