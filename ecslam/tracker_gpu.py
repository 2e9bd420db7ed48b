"""Tracking a frame on a GPU: one upload, one recorded graph, and one wait, when its result is asked for.

The same steps as ``tracker.HostTracker`` takes on the host, in fixed sizes: points are spread over the image and
aligned to the fused volume, then the paper's rendered tracking, where the preset has it, goes on from there.
"""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import field as own
from functools import cache, partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .align import LEAST_KNOWN, stages
from .config import Config
from .descent import COARSE_STRIDE, RULES, outlier_cost
from .field import TsdfField
from .kernels import LOSS_NAMES, AlignSettings, Backend, DevicePixels, RayBatch, fusion_gpu, tracking_gpu
from .kernels._gpu_blocks import Blocks
from .kernels._gpu_descent import COUNT
from .kernels.graphs import Recorder
from .kernels.tracking_gpu import TOLD
from .observed_gpu import ObservedTable
from .pixels_gpu import DeviceFrame, choose, grid_cells, padded_corners, spread, straight, straight_pixels
from .pose_adam import pose_rates
from .rays import kernel_weights, make_rays
from .sending import Dice, Letter
from .shutter import STILL, Sweep
from .tracker import LEAST_POINTS, LEAST_SEEN, SURELY, TrackResult, descend_rendered
from .types import Frame, Intrinsics
from .volume_gpu import GpuVolume

HEAD = 24


@dataclass(frozen=True)
class GpuTracking:
    """``Tracking`` from ``guess`` [4, 4]. found: what ``GpuTracker._whole`` makes of the frame, on the device."""

    guess: NDArray[np.float64]
    found: Tensor
    rendered: bool

    def result(self) -> TrackResult:
        """See ``Tracking``."""
        told = self.found.cpu().numpy()
        pose, (cost, fit, usable), terms = told[:12], told[12:TOLD].tolist(), told[TOLD:]
        if usable < LEAST_POINTS:
            return TrackResult(self.guess, {}, 0.0)
        named = dict(zip(LOSS_NAMES, terms.tolist(), strict=True)) if self.rendered else {"align_mm": 1e3 * cost**0.5}
        return TrackResult(np.concatenate([pose.reshape(3, 4), self.guess[3:]]), named, fit)


@dataclass
class GpuTracker:
    """What tracking reads. volume: what frames are aligned to. observed: where the map may be trusted. generator: on
    the device, for pixels and samples."""

    camera: Intrinsics
    volume: GpuVolume
    observed: ObservedTable
    kernels: Backend
    generator: torch.Generator
    recorder: Recorder
    _dice: Dice | None = own(default=None, init=False)
    _letter: Letter | None = own(default=None, init=False)

    def begin(
        self, frame: Frame, guess: NDArray[np.float64], field: TsdfField, config: Config, sweep: Sweep = STILL
    ) -> GpuTracking:
        """See ``Tracker``."""
        device, shown = field.device, self.volume.show(frame)
        a, t, s = config.align, config.tracking, config.sampling
        points, rays = grid_cells(shown, a.points, config), t.rays if t.iterations else 0
        corners = padded_corners(frame, config, rays)
        dice, letter = self._given(2 * points + rays * (3 + s.uniform + s.near_depth), HEAD + len(corners))
        letter.send(guess, sweep, frame.gain, dice.throw(), corners)
        order = _shuffled(grid_cells(shown, rays, config) if rays else 0, device)
        rates = _rates(t.lr_rotation, t.lr_translation, device)
        over = field if rays else None, self.volume.blocks, config, shown, order, rates, letter.there, dice.rows
        (found,) = self.recorder(partial(self._whole, *over), key=id(config), over=over, device=device, lent=True)
        return GpuTracking(guess, found, rendered=rays > 0)

    def _given(self, random: int, sent: int) -> tuple[Dice, Letter]:
        """Dice for so many ``random`` numbers a frame, and a letter for those that are ``sent``: the last ones, since
        graphs are recorded over these."""
        if self._dice is None or self._dice.rows.shape[1] != random:
            self._dice = Dice(random, self.generator)
        if self._letter is None or len(self._letter.there) != sent:
            self._letter = Letter(sent, self.generator.device)
        return self._dice, self._letter

    def _whole(
        self,
        field: TsdfField | None,
        blocks: Blocks,
        config: Config,
        frame: DeviceFrame,
        order: Tensor,
        rates: Tensor,
        letter: Tensor,
        rows: Tensor,
    ) -> tuple[Tensor]:
        """Everything as a function of tensors: float64 [TOLD, and the loss terms where frames are rendered]. field:
        None where they are not. letter: float64 [HEAD + C], the guess [4, 4], the sweep [6], the gain of the frame,
        which of the ``rows`` of random numbers, and its corners [C]."""
        a, settings = config.align, tuple(stages(config))
        cells = grid_cells(frame, a.points, config)
        numbers = rows.index_select(0, letter[HEAD - 1 : HEAD].long())[0]
        points = spread(frame, self.camera, a.points, config, numbers[: 2 * cells].view(cells, 2), letter[22:])
        rolling = self.camera.readout_s > 0 and config.deskew
        guess, sweep = letter[:16].view(4, 4), letter[16:22]
        points = straight(points, self.camera, sweep) if rolling else points
        packed, first = tracking_gpu.packed(blocks, points, guess, LEAST_KNOWN)
        row = fusion_gpu.descend(blocks, packed, first, settings, a.iterations, COARSE_STRIDE, RULES)
        pose, terms = row, letter.new_empty(0)
        if field is not None:
            aligned, cost = fusion_gpu.unpack_pose(row)
            jitter = numbers[2 * cells :].view(config.tracking.rays, -1)
            corners = letter[HEAD:].long()
            pixels = choose(frame, self.camera, config, corners, order, jitter[:, :3], self.observed, aligned)
            pixels = straight_pixels(pixels, self.camera, sweep) if rolling else pixels
            rendered, terms = self._rendered(field, config, pixels, aligned, rates, jitter[:, 3:])
            better = _objective(blocks, packed, rendered, row[COUNT.value], settings[-1]) < SURELY * cost
            pose = torch.where(better, rendered, aligned)
        told = tracking_gpu.told(blocks, points, pose, row, 0.5 * config.truncation_m, LEAST_SEEN)
        return (torch.cat([told, terms.double()]) if len(terms) else told,)

    def _rendered(
        self, field: TsdfField, config: Config, pixels: DevicePixels, c2w: Tensor, rates: Tensor, jitter: Tensor
    ) -> tuple[Tensor, Tensor]:
        """See ``tracker.track_adam``; rays without depth, where there are any, end where depths do."""
        t, row = config.tracking, torch.zeros_like(pixels.depth, dtype=torch.int64)
        rays = make_rays(pixels, row, c2w[None], c2w[:2, :3], self.kernels, config, jitter, missing=False)
        batch = (getattr(rays, name) for name in RayBatch.__dataclass_fields__)
        how = kernel_weights(t.loss, config), t.iterations, t.momentum
        best, terms = descend_rendered(field, self.kernels, *how, c2w[None], rates, *batch)
        return best[0], terms


@cache
def _rates(lr_rotation: float, lr_translation: float, device: torch.device) -> Tensor:
    return pose_rates(torch.zeros(1, dtype=torch.bool), lr_rotation, lr_translation).to(device)


@cache
def _shuffled(count: int, device: torch.device) -> Tensor:
    return torch.randperm(count, generator=torch.Generator().manual_seed(0)).to(device, non_blocking=True)


def _objective(blocks: Blocks, packed: Tensor, c2w: Tensor, count: Tensor, settings: AlignSettings) -> Tensor:
    """See ``descent.objective``, with the sums of ``count`` points taken at c2w [4, 4]."""
    sums = fusion_gpu.sums_at(blocks, packed, fusion_gpu.pack_start(c2w, count), settings)
    return sums[64] + outlier_cost(settings) * (count - sums[65])
