"""The fused TSDF volume on a GPU (Triton): launches of what ``fusion`` does on the CPU, and whole alignments.

No launch waits for the host. With TRITON_INTERPRET=1 everything runs in Triton's interpreter, for the tests.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ._gpu_align import SUMS
from ._gpu_blocks import CELLS, EMPTY, Blocks, distances_kernel, enter_kernel
from ._gpu_descent import COST, COUNT, DONE, POSE, ROW, TRIAL, step_kernel, sums_kernel
from ._gpu_device import beside, processors
from ._gpu_volume import STRIDE, Listed, View, integrate_kernel, normals_kernel, read_kernel, touch_kernel
from .types import AlignSettings, Rules

__all__ = [
    "allocate",
    "descend",
    "distances",
    "enter",
    "fuse",
    "pack_start",
    "sums_at",
    "taken_slots",
    "unpack_pose",
]

BLOCK = 256  # pixels, keys or steps along rays
POINTS = 32
INTEGRATING = 8  # programs a processor
SUMS_ROW = 72  # a multiple of 16 bytes: Triton compiles a kernel anew for a pointer that is none


def allocate(slots: int, voxel_m: float, truncation_m: float, device: torch.device) -> tuple[Blocks, Listed]:
    """An empty table."""
    blocks = Blocks(
        torch.full((slots,), EMPTY.value, dtype=torch.int64, device=device),
        torch.zeros((slots, CELLS.value, 3), dtype=torch.int16, device=device),
        torch.tensor([voxel_m, truncation_m], dtype=torch.float64, device=device),
        slots,
    )
    lists = torch.zeros((2, slots), dtype=torch.int32, device=device)
    return blocks, Listed(lists[0], lists[1], torch.zeros(2, dtype=torch.int32, device=device))


def taken_slots(blocks: Blocks) -> Tensor:
    """The slots [N] that hold a block. Waits for the device."""
    return (blocks.keys != EMPTY.value).nonzero()[:, 0]


def _programs(count: int, block: int) -> tuple[int]:
    return (-(-count // block),)


def enter(blocks: Blocks, listed: Listed, keys: Tensor) -> Tensor:
    """The slots [N] of new keys int64 [N]; -1 where there was no place."""
    slots = torch.empty_like(keys)
    if len(keys):
        with beside(keys):
            grid = _programs(len(keys), BLOCK)
            enter_kernel[grid](blocks, listed.counts[1:], keys, slots, len(keys), block=BLOCK)
    return slots


def fuse(
    blocks: Blocks, listed: Listed, measured: Tensor, color: Tensor, numbers: Tensor, stride: int, steps: int
) -> None:
    """Average a frame into the volume. measured: float32 [H, W] metres; color: uint8 [H, W, 3]; numbers: see ``View``;
    blocks are sought at ``steps`` points along every ``stride``-th ray."""
    height, width = measured.shape
    rows, columns = -(-height // STRIDE.value), -(-width // STRIDE.value)
    light, normal = torch.empty_like(measured), measured.new_empty(rows, columns, 3)
    view = View(torch.empty_like(measured), light, normal, numbers, height, width)
    rays = -(-(height - stride // 2) // stride) * -(-(width - stride // 2) // stride)
    with beside(measured):
        read_kernel[_programs(height * width, BLOCK)](measured, color, view, listed, block=BLOCK)
        normals_kernel[_programs(rows * columns, BLOCK)](view, block=BLOCK)
        touch_kernel[_programs(rays * steps, BLOCK)](blocks, listed, view, stride, steps, block=BLOCK)
        integrate_kernel[(INTEGRATING * processors(measured.device),)](blocks, listed, view)


def distances(blocks: Blocks, points: Tensor, c2w: Tensor) -> Tensor:
    """Signed distance float32 [N] in metres at points [N, 3] seen from c2w float64 [3 or 4, 4], NaN where it is
    unknown. Points [N, 4] have something else in the last column, and NaN where their third coordinate is 0."""
    found = torch.empty(len(points), dtype=torch.float32, device=points.device)
    if len(points):
        with beside(points):
            distances_kernel[_programs(len(points), POINTS)](
                blocks, points, c2w, found, len(points), width=points.shape[1], block=POINTS
            )
    return found


def pack_start(c2w: Tensor, count: int | Tensor) -> Tensor:
    """The row from which an alignment of ``count`` points starts at c2w float64 [4, 4], where that lies."""
    row = torch.zeros(ROW, dtype=torch.float64, device=c2w.device)
    row[POSE.value : POSE.value + 12] = c2w[:3].reshape(12)
    row[COUNT.value] = count
    return row


def unpack_pose(row: Tensor) -> tuple[Tensor, Tensor]:
    """The pose [4, 4] of a row, and its cost [], where the row lies."""
    c2w = torch.eye(4, dtype=row.dtype, device=row.device)
    c2w[:3] = row[POSE.value : POSE.value + 12].view(3, 4)
    return c2w, row[COST.value]


def _add_sums(
    blocks: Blocks,
    points: Tensor,
    start: Tensor,
    pose: Tensor,
    done: Tensor,
    settings: AlignSettings,
    sums: Tensor,
    stride: int,
) -> None:
    sums_kernel[_programs(-(-len(points) // stride), POINTS)](
        blocks, points, start[COUNT.value :], pose, done, settings.numbers(), sums, stride,
        colour=settings.colour_weight > 0, block=POINTS,
    )  # fmt: skip


def sums_at(blocks: Blocks, points: Tensor, start: Tensor, settings: AlignSettings) -> Tensor:
    """Gauss-Newton sums float64 [67], as ``_gpu_align`` has them, at the pose of ``start`` (see ``pack_start``).
    points: float32 [N, 4], camera coordinates and luminance; rows beyond the count of ``start`` are ignored."""
    sums = start.new_zeros(SUMS_ROW)
    with beside(points):
        _add_sums(blocks, points, start, start[POSE.value :], start[DONE.value :], settings, sums, 1)
    return sums[:SUMS]


def descend(
    blocks: Blocks,
    points: Tensor,
    start: Tensor,
    stages: Sequence[AlignSettings],
    iterations: int,
    coarse: int,
    rules: Rules,
) -> Tensor:
    """All stages of an alignment, at most ``iterations`` steps with each; all but the last take every ``coarse``-th
    point. The row that it ends with, on the device (see ``unpack_pose``). points, start: as for ``sums_at``."""
    launches = len(stages) * (iterations + 1)
    sums, states = start.new_zeros(launches, SUMS_ROW), start.new_empty(launches, ROW)
    state = start
    with beside(points):
        for n, (into, after) in enumerate(zip(sums, states, strict=True)):
            number, step = divmod(n, iterations + 1)
            stage, stride = stages[number], coarse if number + 1 < len(stages) else 1
            pose, done = (state[TRIAL.value :], state[DONE.value :]) if step else (state, start[DONE.value :])
            _add_sums(blocks, points, start, pose, done, stage, into, stride)
            step_kernel[(1,)](state, into, after, stage.numbers(), stride, rules=rules, first=step == 0, num_warps=1)
            state = after
    return state
