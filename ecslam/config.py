"""Typed configuration: frozen dataclasses with the paper's lite figures as defaults. Files: see ``config_files``."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

from .types import InputError


def _number(default: Any, low: float = -math.inf, high: float = math.inf) -> Any:
    """A field that must lie in [low, high]."""
    return field(default=default, metadata={"low": low, "high": high})


@dataclass(frozen=True)
class FieldConfig:
    """The map: multi-resolution hash grid, one-blob encoding, two decoders (paper, section III-A)."""

    levels: int = _number(16, 1, 32)
    log2_table_size: int = _number(16, 8, 24)
    base_resolution: int = _number(16, 2, 512)
    finest_voxel_m: float = _number(0.02, 1e-3, 1.0)
    blob_bins: int = _number(16, 4, 64)
    beta: float = _number(10.0, 0.1, 1e3)
    init_scale: float = _number(1e-4, 0.0, 1.0)
    box: tuple[float, ...] | None = None
    box_margin_m: float = _number(0.3, 0.0, 10.0)

    def __post_init__(self) -> None:
        """Raises InputError for a box that is none."""
        box = self.box
        if box is not None and (len(box) != 6 or any(box[axis] >= box[axis + 3] for axis in range(3))):
            raise InputError(
                f"field.box = {list(box)} takes six numbers: x_min, y_min, z_min, x_max, y_max, z_max (metres), each "
                "minimum below its maximum"
            )


@dataclass(frozen=True)
class SamplingConfig:
    """Depths along a ray: ``uniform`` over it and ``near_depth`` within ``depth_range_m`` of the measured depth.
    without_depth: whether mapping takes rays that have no measured depth."""

    uniform: int = _number(32, 0, 512)
    near_depth: int = _number(11, 1, 512)
    depth_range_m: float = _number(0.10, 1e-3, 1.0)
    near_m: float = _number(0.05, 0.0, 10.0)
    without_depth: bool = True


@dataclass(frozen=True)
class LossWeights:
    """Weights of the paper's losses (equations 4 to 7); feature and uniform rays are weighted apart.

    Each kind is averaged for itself, so with equal weights the few features would outvote the rest: 200 among the 5 %
    of a 640x480 image seventyfold. The paper gives no weights for them; here one ray counts about as much as another.
    """

    free_space: float = _number(5.0, 0.0)
    centre: float = _number(200.0, 0.0)
    tail: float = _number(10.0, 0.0)
    depth_uniform: float = _number(0.1, 0.0)
    depth_feature: float = _number(0.0014, 0.0)
    colour_uniform: float = _number(5.0, 0.0)
    colour_feature: float = _number(0.07, 0.0)


@dataclass(frozen=True)
class AlignConfig:
    """Direct alignment of each frame's measured points (ours), from which rendered tracking starts.

    to: the surface aligned to: the ``fused`` TSDF volume kept beside the map, the ``learned`` map itself, or ``none``,
    which leaves the paper's tracking alone. points: measured points used; iterations: at most, per stage; kernels_m:
    one stage each, coarse to fine; gradient_range: gradient norms trusted in the last stage. The other fields: see
    ``AlignSettings``. voxel_m: edge of the fused volume's voxels.
    """

    to: Literal["fused", "learned", "none"] = "fused"
    voxel_m: float = _number(0.015, 1e-3, 1.0)
    points: int = _number(2000, 64, 200_000)
    iterations: int = _number(10, 1, 100)
    kernels_m: tuple[float, ...] = (0.06, 0.02)
    tsdf_limit: float = _number(1.2, 0.1, 10.0)
    gradient_range: tuple[float, ...] = (0.75, 1.3)
    colour_weight_m: float = _number(0.05, 0.0, 1.0)
    colour_kernel: float = _number(0.2, 1e-3, 10.0)

    def __post_init__(self) -> None:
        """Raises InputError for lists that mean nothing."""
        if not self.kernels_m or min(self.kernels_m) <= 0:
            raise InputError(f"align.kernels_m = {list(self.kernels_m)} takes one or more lengths above 0 (metres)")
        if len(self.gradient_range) != 2 or not 0 <= self.gradient_range[0] < self.gradient_range[1]:
            raise InputError(
                f"align.gradient_range = {list(self.gradient_range)} takes two numbers from 0 on, the lower one first"
            )


@dataclass(frozen=True)
class TrackingConfig:
    """The paper's rendered tracking: Adam on the losses of a frame's rays against the fixed map. ``iterations`` 0
    leaves it out, and direct alignment alone tracks.

    momentum: Adam's first decay for poses. With its usual 0.9 a pose still moves the way of its first gradients when
    the few iterations of a frame end. unaligned_rate: how many times the learning rates count where no alignment comes
    before (``align.to`` none), since constant velocity guesses a pose from farther off.
    """

    iterations: int = _number(8, 0, 500)
    rays: int = _number(1000, 16, 200_000)
    lr_rotation: float = _number(1e-3, 0.0, 1.0)
    lr_translation: float = _number(1e-3, 0.0, 1.0)
    momentum: float = _number(0.5, 0.0, 0.999)
    unaligned_rate: float = _number(4.0, 0.0, 1e3)
    loss: LossWeights = LossWeights(
        free_space=10.0, centre=200.0, tail=50.0,
        depth_uniform=1.0, depth_feature=0.25, colour_uniform=5.0, colour_feature=1.25,
    )  # fmt: skip


@dataclass(frozen=True)
class MappingConfig:
    """Joint optimisation of the map and the poses in the window.

    every: frames from one mapping to the next, which begins with the first keyframe from there on. newest_share: of the
    rays, for the newest keyframe. rim: whether the stored pixels reach into the border of ``border_px`` (ours; without
    them what is only ever seen there stays unmapped). final_iterations: of the map alone, on all keyframes, after the
    last frame, with the weights ``final_loss`` (ours: more for the tail, which brings out edges and thin things).
    """

    every: int = _number(5, 1, 1000)
    first_iterations: int = _number(200, 1, 100_000)
    iterations: int = _number(10, 0, 10_000)
    final_iterations: int = _number(100, 0, 100_000)
    rays: int = _number(2000, 16, 1_000_000)
    newest_share: float = _number(0.2, 0.0, 1.0)
    rim: bool = True
    lr_grid: float = _number(1e-2, 0.0, 1.0)
    lr_decoder: float = _number(1e-2, 0.0, 1.0)
    lr_rotation: float = _number(1e-4, 0.0, 1.0)
    lr_translation: float = _number(1e-4, 0.0, 1.0)
    loss: LossWeights = LossWeights()
    final_loss: LossWeights = LossWeights(tail=50.0)
    smooth_weight: float = _number(1e-6, 0.0)
    smooth_points: int = _number(32, 2, 256)
    smooth_voxel_m: float = _number(0.1, 1e-3, 1.0)


@dataclass(frozen=True)
class WindowConfig:
    """Which keyframes take part in bundle adjustment (paper, section III-B)."""

    size: int = _number(30, 2, 1000)
    max_angle_deg: float = _number(60.0, 1.0, 180.0)
    recent: int = _number(5, 1, 100)
    historic: int = _number(3, 0, 100)


@dataclass(frozen=True)
class Config:
    """Everything a run depends on besides the sequence. Defaults are the paper's lite preset on Replica.

    schedule: ``strict`` maps between frames, ``overlap`` beside tracking, ``auto`` does that on a GPU alone.
    denoise: smooth depth by as much as it is noisy (ours). deskew: take out the motion during a rolling shutter (ours,
    see ``shutter``). exposure: bring luminance to what the first frame's exposure would give (ours, see ``exposure``).
    movers: whether what moves by itself is left in (ours, see ``movers``). realtime: play a recording no faster than it
    was taken and leave out the frames that come while the engine is busy, as with a camera (ours, see
    ``datasets.pace``).
    """

    preset: str = "lite"
    seed: int = _number(0, 0, 2**31 - 1)
    schedule: Literal["auto", "strict", "overlap"] = "auto"
    realtime: bool = False
    fus: bool = True
    eba: bool = True
    deskew: bool = True
    truncation_m: float = _number(0.06, 1e-3, 1.0)
    centre_share: float = _number(0.4, 0.01, 1.0)
    depth_near_m: float = _number(0.1, 0.0, 10.0)
    depth_far_m: float = _number(8.0, 0.1, 100.0)
    denoise: bool = True
    exposure: bool = True
    movers: bool = False
    border_px: int = _number(20, 0, 200)
    feature_count: int = _number(200, 0, 10_000)
    feature_quality: float = _number(0.03, 1e-6, 1.0)
    feature_distance_px: int = _number(5, 1, 100)
    keyframe_every: int = _number(5, 1, 1000)
    keyframe_share: float = _number(0.05, 1e-4, 1.0)
    field: FieldConfig = FieldConfig()
    sampling: SamplingConfig = SamplingConfig()
    align: AlignConfig = AlignConfig()
    tracking: TrackingConfig = TrackingConfig()
    mapping: MappingConfig = MappingConfig()
    window: WindowConfig = WindowConfig()

    def __post_init__(self) -> None:
        """Raises InputError where settings contradict each other."""
        if self.depth_near_m >= self.depth_far_m:
            near, far = f"depth_near_m = {self.depth_near_m:g}", f"depth_far_m = {self.depth_far_m:g}"
            raise InputError(f"{near} must be smaller than {far}; change one of them")
        if self.align.to == "none" and self.tracking.iterations == 0:
            raise InputError("align.to is none and tracking.iterations is 0, so nothing tracks; change one of them")
