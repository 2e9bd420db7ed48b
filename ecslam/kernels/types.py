"""The values that cross the kernel seam. Plain tensors and numbers: no random state, no configuration, no globals."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

HIDDEN = 32
FEATURES = 2


@dataclass(frozen=True)
class GridLayout:
    """Where each level of the hash grid lies; all tensors on the CPU.

    Lattice points of level l sit at ``anchor + k * voxel[l]`` (metres, k integer), so a cell's place never depends on
    the scene box and the box can grow. A dense level stores ``dims[l]`` lattice points from ``first[l]`` on, row-major
    with x fastest; a hashed level has dims 0 and maps k to ``hash(k) mod size[l]`` (size a power of two), with the
    spatial hash of Mueller et al. 2022: (kx * 1) xor (ky * 2654435761) xor (kz * 805459861) in wrapping uint32.

    offset, size: int64 [L], in table rows. voxel: float32 [L], metres. first, dims: int64 [L, 3]. anchor: float32 [3].
    blob_low, blob_size: float32 [3], metres: one period of the one-blob encoding (tiny-cuda-nn's quartic kernel, which
    wraps around). box: float32 [2, 3]; points outside are clamped onto it and get no position gradient on that axis.
    """

    offset: Tensor
    size: Tensor
    voxel: Tensor
    first: Tensor
    dims: Tensor
    anchor: Tensor
    blob_low: Tensor
    blob_size: Tensor
    box: Tensor
    bins: int

    @property
    def levels(self) -> int:
        """Number of levels L."""
        return int(self.offset.numel())

    @property
    def inputs(self) -> int:
        """Width of the encoding: [hash features (2 per level), one-blob x, y, z]."""
        return FEATURES * self.levels + 3 * self.bins

    def packed(self) -> tuple[Tensor, Tensor, Tensor]:
        """As compiled kernels read it. int32 [L, 8]: offset, size - 1, first, dims. float64 [L, 2]: 1 / voxel, and what
        is left of that when it is rounded to float32. float64 [15]: anchor, blob_low, 1 / blob_size, box."""
        inverse = 1 / self.voxel.double()
        place = [self.anchor, self.blob_low, 1 / self.blob_size.double(), self.box[0], self.box[1]]
        return (
            torch.cat([self.offset[:, None], self.size[:, None] - 1, self.first, self.dims], 1).to(torch.int32),
            torch.stack([inverse, inverse - inverse.float()], 1),
            torch.cat([part.double() for part in place]),
        )


@dataclass(frozen=True)
class FieldParams:
    """The learnt numbers. table: [rows, 2]; w_in: [inputs, 64] (columns 0..31 feed the TSDF decoder, 32..63 the colour
    decoder); w_sdf: [32, 1]; w_rgb: [32, 3]; beta: [1]. float32 (the reference also takes float64)."""

    table: Tensor
    w_in: Tensor
    w_sdf: Tensor
    w_rgb: Tensor
    beta: Tensor


def taken(rows: Tensor, index: Tensor | slice) -> Tensor:
    """``rows[index]``, on a CPU without waking torch's threads for a few thousand numbers."""
    return rows[index] if isinstance(index, slice) else rows.index_select(0, index)


class DevicePixels(NamedTuple):
    """``Pixels`` as tensors on one device. direction: float32 [N, 3], z = 1. depth: float32 [N]. color: uint8 [N, 3].
    feature: bool [N]."""

    direction: Tensor
    depth: Tensor
    color: Tensor
    feature: Tensor

    def take(self, index: Tensor | slice) -> DevicePixels:
        """The pixels at ``index``."""
        return DevicePixels(*(taken(column, index) for column in self))


@dataclass(frozen=True)
class RayBatch:
    """Rays to render, in camera coordinates, so that an iteration only transforms them.

    direction: [R, 3] with z = 1 (a point at depth z is z * direction). z: [R, S] sample depths, ascending, metres.
    depth: [R] measured depth, 0 = none. color: [R, 3] in 0..1. feature: bool [R], True for rays at feature points.
    pose: int64 [R], row of the pose table each ray belongs to, ASCENDING (rays of one pose are contiguous).
    """

    direction: Tensor
    z: Tensor
    depth: Tensor
    color: Tensor
    feature: Tensor
    pose: Tensor

    def take(self, index: Tensor | slice) -> RayBatch:
        """The rays at ``index``."""
        return RayBatch(*(taken(getattr(self, f.name), index) for f in fields(self)))


@dataclass(frozen=True)
class Numbers:
    """Settings that kernels take as plain numbers."""

    def numbers(self) -> tuple[float, ...]:
        """The fields, in order."""
        return tuple(float(getattr(self, f.name)) for f in fields(self))


@dataclass(frozen=True)
class Weights(Numbers):
    """Loss weights and the two lengths the losses need (metres). Paper, equations 4 to 7."""

    free_space: float
    centre: float
    tail: float
    depth_uniform: float
    depth_feature: float
    colour_uniform: float
    colour_feature: float
    truncation_m: float
    centre_share: float


LOSS_NAMES = ("free_space", "centre", "tail", "depth", "colour")


@dataclass(frozen=True)
class StepResult:
    """losses: [5] weighted terms in the order of LOSS_NAMES (their sum is the objective). d_c2w: [P, 3, 4], with
    respect to the upper rows of the pose matrices, None unless asked for."""

    losses: Tensor
    d_c2w: Tensor | None


@dataclass(frozen=True)
class AlignSettings(Numbers):
    """What the direct alignment of points to the TSDF needs.

    truncation_m: metres per TSDF unit. kernel_m, colour_kernel: scales of the Geman-McClure weights (metres; luminance
    0..1). tsdf_limit: points with |TSDF| above it are dropped. gradient_low, gradient_high: points whose metric
    gradient norm (1 for a distance) lies outside are dropped. colour_weight: metres per luminance (0: geometry only).
    """

    truncation_m: float
    kernel_m: float
    tsdf_limit: float
    gradient_low: float
    gradient_high: float
    colour_weight: float
    colour_kernel: float


class Rules(NamedTuple):
    """When a descent takes a step and when a stage of it ends. damping: at first; settled: share of the cost that a
    step must gain to go on; still_after_gain, still_after_loss: a smaller step (metres, radians) ends a stage, an
    accepted one or a refused one; least_used: points."""

    damping: float
    least_damping: float
    most_damping: float
    settled: float
    still_after_gain: float
    still_after_loss: float
    least_used: int


@dataclass(frozen=True)
class PoseMoments:
    """What Adam keeps of P poses between steps, in the tangent of ``se3.retract``. mean, square: float64 [P, 6],
    brought up to date by each step. about: float64 [P, 3], in camera coordinates, what the poses turn about; None: the
    cameras. decays, epsilon: Adam's."""

    mean: Tensor
    square: Tensor
    about: Tensor | None
    decays: tuple[float, float]
    epsilon: float


@dataclass(frozen=True)
class AdamStep:
    """A step of Adam (Kingma and Ba 2015) for some of the map's parameters. mean, square: its moments, float32, one a
    parameter, brought up to date by the step. count: float32 [], steps done with this one. rate: the learning rate, a
    number or a tensor []. decays, epsilon: Adam's."""

    mean: list[Tensor]
    square: list[Tensor]
    count: Tensor
    rate: float | Tensor
    decays: tuple[float, float]
    epsilon: float


@dataclass(frozen=True)
class NormalEquations:
    """Gauss-Newton sums over points, in the tangent of ``se3.retract``. jtj: float64 [6, 6]; jtr: float64 [6]; cost:
    robust objective (sum over used points); used: points that took part; inliers: those with weight above one half."""

    jtj: Tensor
    jtr: Tensor
    cost: float
    used: int
    inliers: int
