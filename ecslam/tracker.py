"""Tracking: the pose of one frame against the fixed map (paper, section III-B)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .align import Surface, align, cost_at, known_points, transform
from .config import Config
from .field import TsdfField
from .kernels import LOSS_NAMES, Backend, RayBatch, Weights
from .kernels.graphs import Recorder
from .observed import ObservedVoxels
from .pixels import Pixels, choose_pixels, spread_pixels
from .pose_adam import PoseAdam, pose_rates
from .rays import kernel_weights, make_rays, upload, view_centre
from .samples import resample_missing, seeded, uniform
from .shutter import STILL, Sweep, straight_pixels
from .types import Frame, Intrinsics

LEAST_SEEN = 0.1
LEAST_POINTS = 64  # that are measured, or a frame is not tracked
SURELY = 0.9  # of the aligned pose's cost; one that wandered off may cost less by a few percent, as points drop out


@dataclass(frozen=True)
class TrackResult:
    """c2w: float64 [4, 4], the best iterate. losses: weighted terms there. fit: how well the surface explains the frame
    (see ``fit``; near 0 = lost)."""

    c2w: NDArray[np.float64]
    losses: dict[str, float]
    fit: float


class Tracking(Protocol):
    """A frame that is being tracked."""

    def result(self) -> TrackResult:
        """What came of it; waits for it."""
        ...


@dataclass(frozen=True)
class Tracked:
    """``Tracking`` that is done."""

    found: TrackResult

    def result(self) -> TrackResult:
        """See ``Tracking``."""
        return self.found


class Tracker(Protocol):
    """Follows the camera from frame to frame."""

    def begin(
        self, frame: Frame, guess: NDArray[np.float64], field: TsdfField, config: Config, sweep: Sweep = STILL
    ) -> Tracking:
        """Seek the pose of a frame from ``guess`` [4, 4], that was read during ``sweep`` (see ``shutter``); the result
        is ``guess`` itself with a fit of 0 where hardly anything is measured. One at a time; on a GPU that is only on
        its way when this returns."""
        ...


@dataclass(frozen=True)
class HostTracker:
    """Tracking that the host goes through step by step. surface: what frames are aligned to. observed: where the map
    may be trusted. rng: for pixels. generator: for the samples along rays; None: one from ``rng`` on the field's
    device."""

    camera: Intrinsics
    surface: Surface
    observed: ObservedVoxels
    kernels: Backend
    rng: np.random.Generator
    generator: torch.Generator | None
    recorder: Recorder

    def begin(
        self, frame: Frame, guess: NDArray[np.float64], field: TsdfField, config: Config, sweep: Sweep = STILL
    ) -> Tracked:
        """See ``Tracker``."""
        return Tracked(self._track(frame, guess, field, config, sweep))

    def _track(
        self, frame: Frame, guess: NDArray[np.float64], field: TsdfField, config: Config, sweep: Sweep
    ) -> TrackResult:
        """Direct alignment of points spread over the image, then the paper's rendered tracking; the
        preset may leave either out. A rendered pose is taken where it costs ``SURELY`` less on the aligned surface."""
        surface, measured = self.surface, spread_pixels(frame, self.camera, config.align.points, config, self.rng)
        measured = straight_pixels(measured, self.camera, sweep)
        if len(measured.points()) < LEAST_POINTS:
            return TrackResult(guess, {}, 0.0)
        c2w, losses = guess, {}
        points = known_points(surface, measured, guess, frame.gain)
        if config.align.to != "none":
            found = align(surface, points, guess, config)
            c2w, losses = found.c2w, {"align_mm": 1e3 * found.cost**0.5}
        if config.tracking.iterations > 0:
            pixels = choose_pixels(frame, self.camera, config.tracking.rays, config, self.rng)
            pixels = straight_pixels(pixels, self.camera, sweep)
            pixels = self.observed.known(pixels, c2w, same_count=field.device.type != "cpu")
            generator = self.generator or seeded(self.rng, field.device)
            rendered, losses = track_adam(field, self.kernels, pixels, c2w, config, generator, self.recorder)
            before, after = (cost_at(surface, points, pose, config) for pose in (c2w, rendered))
            if config.align.to == "none" or after < SURELY * before:
                c2w = rendered
        return TrackResult(c2w, losses, fit(surface, measured, c2w, config.truncation_m))


def track_adam(
    field: TsdfField,
    kernels: Backend,
    pixels: Pixels,
    guess: NDArray[np.float64],
    config: Config,
    generator: torch.Generator,
    recorder: Recorder,
) -> tuple[NDArray[np.float64], dict[str, float]]:
    """The paper's tracking: Adam on the rendered losses from ``guess`` [4, 4]; pixels are sampled once and only
    transformed in each iteration. Returns the iterate [4, 4] with the least loss and the weighted terms there."""
    t, s, device = config.tracking, config.sampling, field.device
    c2w = torch.from_numpy(guess)[None].to(device)
    row, missing = torch.zeros(len(pixels), dtype=torch.int64, device=device), bool((pixels.depth <= 0).any())
    jitter = uniform(generator, device, len(pixels), s.uniform + s.near_depth)
    rays = make_rays(upload(pixels, device), row, c2w, field.layout.box.to(device), kernels, config, jitter, missing)
    if missing:
        resample_missing(rays, c2w.float(), field, kernels, s, generator)
    scale = t.unaligned_rate if config.align.to == "none" else 1.0
    rates = scale * pose_rates(torch.zeros(1, dtype=torch.bool), t.lr_rotation, t.lr_translation).to(device)
    weights = kernel_weights(t.loss, config)
    loop = partial(descend_rendered, field, kernels, weights, t.iterations, t.momentum)
    tensors = (getattr(rays, f.name) for f in fields(RayBatch))
    best, terms = recorder(loop, c2w, rates, *tensors, key=(weights, t.iterations, t.momentum), over=(field,))
    return best[0].cpu().numpy(), dict(zip(LOSS_NAMES, terms.tolist(), strict=True))


def descend_rendered(
    field: TsdfField,
    kernels: Backend,
    weights: Weights,
    iterations: int,
    momentum: float,
    c2w: Tensor,
    rates: Tensor,
    *rays: Tensor,
) -> tuple[Tensor, Tensor]:
    """The iterations, never waiting for the device: the best iterate [1, 4, 4] and the terms [5] there."""
    batch, poses, terms = RayBatch(*rays), [], []
    optimiser = PoseAdam(c2w, rates, momentum, view_centre(batch)[None], kernels)
    for _ in range(iterations):
        result = kernels.step(field.layout, field.params, optimiser.c2w.float(), batch, weights, None, True)
        poses.append(optimiser.c2w)
        terms.append(result.losses)
        assert result.d_c2w is not None
        optimiser.step(result.d_c2w)
    losses = torch.stack(terms)
    best = losses.sum(1).nan_to_num(nan=torch.inf).argmin()[None]
    return torch.cat(poses).index_select(0, best), losses.index_select(0, best)[0]


def fit(surface: Surface, pixels: Pixels, c2w: NDArray[np.float64], truncation_m: float) -> float:
    """Share of the measured points, among those where the surface is known, that lie within half a truncation of it,
    seen from c2w [4, 4]; 0 where next to nothing is known."""
    distance, known = surface.distances(transform(c2w, pixels.points()))
    if known.sum() < LEAST_SEEN * max(len(known), 1):
        return 0.0
    return float((np.abs(distance[known]) < 0.5 * truncation_m).mean())


def track_direct(
    surface: Surface, pixels: Pixels, guess: NDArray[np.float64], config: Config, gain: float
) -> TrackResult:
    """Our own tracking: direct alignment to ``surface`` from ``guess`` [4, 4]. gain: of the pixels' luminance."""
    found = align(surface, known_points(surface, pixels, guess, gain), guess, config)
    quality = fit(surface, pixels, found.c2w, config.truncation_m)
    return TrackResult(found.c2w, {"align_mm": 1e3 * found.cost**0.5}, quality)
