"""What surrounds the alignment of a frame on a GPU (Triton): a few launches, none of which waits for the host."""

from __future__ import annotations

import torch
from torch import Tensor

from ._gpu_blocks import Blocks
from ._gpu_descent import COST, COUNT, ROW
from ._gpu_device import beside
from ._gpu_tracking import (
    Cells,
    Lens,
    Marks,
    choose_kernel,
    keep_kernel,
    pack_kernel,
    spread_kernel,
    told_kernel,
)
from .fusion_gpu import distances
from .types import DevicePixels

__all__ = ["TOLD", "Cells", "Lens", "Marks", "chosen", "packed", "spread", "told"]

BLOCK = 128
WHOLE, WHOLE_WARPS = 1024, 8  # points at a time for a program that sees them all
TOLD = 15


def spread(
    color: Tensor, depth: Tensor, jitter: Tensor, cells: Cells, lens: Lens, luminance: tuple[float, ...], gain: Tensor
) -> Tensor:
    """Points float32 [N, 4] of a frame, one in each cell: camera coordinates (metres, all 0 without a usable depth) and
    luminance times ``gain`` float64 [1], at most 1. color: uint8 [H, W, 3]; depth: float32 [H, W]; jitter: [N, 2] in
    0..1, down and right."""
    points = depth.new_empty(len(jitter), 4)
    with beside(depth):
        spread_kernel[(-(-len(jitter) // BLOCK),)](
            depth, color, jitter, points, cells, lens, luminance, gain, len(jitter), block=BLOCK
        )
    return points


def packed(blocks: Blocks, points: Tensor, c2w: Tensor, least: int) -> tuple[Tensor, Tensor]:
    """The points [N, 4] to be aligned from c2w float64 [4, 4], and the row to start with: see ``fusion_gpu.descend``.
    Those where the surface is known, seen from there; all that have a depth where that leaves fewer than ``least``."""
    distance = distances(blocks, points, c2w)
    found, row = torch.empty_like(points), c2w.new_empty(ROW)
    with beside(points):
        pack_kernel[(1,)](points, distance, c2w, found, row, len(points), least, block=WHOLE, num_warps=WHOLE_WARPS)
    return found, row


def told(blocks: Blocks, points: Tensor, c2w: Tensor, row: Tensor, near_m: float, least_seen: float) -> Tensor:
    """float64 [TOLD] of a pose c2w float64 [3 or 4, 4] for a frame's points [N, 4]: the pose [3, 4]; the cost of a
    point where the alignment ``row`` ended; the share of the known points within ``near_m`` of the surface, 0 where
    fewer than ``least_seen`` of the measured ones are known; how many are measured."""
    distance, out = distances(blocks, points, c2w), row.new_empty(TOLD)
    with beside(points):
        told_kernel[(1,)](
            points, distance, c2w, row[COST.value :], row[COUNT.value :], out, len(points), near_m, least_seen,
            block=WHOLE, num_warps=WHOLE_WARPS,
        )  # fmt: skip
    return out


def chosen(
    color: Tensor,
    depth: Tensor,
    jitter: Tensor,
    corners: Tensor,
    order: Tensor | None,
    cells: Cells,
    lens: Lens,
    observed: Marks,
    c2w: Tensor,
    least: int,
) -> DevicePixels:
    """Pixels of a frame, as many as ``jitter`` [N, 3] in 0..1 has rows: ``corners`` [C] (-1: none), then those in cells
    of ``order`` [cells], from a random one on; anywhere in the only cell without it. They are taken in turn from those
    that lie where the map has been ``observed``, seen from c2w float64 [4, 4]; from all that have a depth where these
    are fewer than ``least``."""
    count, grid = len(jitter), 1 if order is None else len(order)
    sizes = (count, 3), (count,), (count, 3), (count,)
    floats, bytes_ = depth.new_empty, color.new_empty
    found, kept = (
        DevicePixels(*(new(size) for new, size in zip((floats, floats, bytes_, bytes_), sizes, strict=True)))
        for _ in range(2)
    )
    known = bytes_(count)
    with beside(depth):
        choose_kernel[(-(-count // BLOCK),)](
            depth, color, jitter, jitter.stride(0), corners, corners if order is None else order, observed, c2w, found,
            known, cells, lens, len(corners), grid, count, gridded=order is not None, block=BLOCK,
        )  # fmt: skip
        keep_kernel[(1,)](found, known, kept, count, least, block=WHOLE, num_warps=WHOLE_WARPS)
    return kept._replace(feature=kept.feature.view(torch.bool))
