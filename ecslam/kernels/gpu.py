"""The fused GPU back end (Triton): kernels over blocks of points and of rays.

A step is six launches: clear; place; encode and decode; render, compare and differentiate; decoders back; grid back. If
the map learns there are two more: weights back, and the table's step. In between lie places, TSDF, colour, hidden units
and the grid's features, and their gradients, which a GPU's cache holds. No launch waits for the host, sizes depend on
shapes alone and memory comes from torch, so a CUDA graph can record whole loops (``graphs``). Sums are taken by atomics
in varying order: results vary in their last digits.

With TRITON_INTERPRET=1 the same code runs in Triton's interpreter on the CPU, for the tests.
"""

from __future__ import annotations

import os
import weakref
from typing import NamedTuple

import torch
from torch import Tensor

from .types import (
    HIDDEN,
    AdamStep,
    AlignSettings,
    FieldParams,
    GridLayout,
    NormalEquations,
    RayBatch,
    StepResult,
    Weights,
)

if not torch.cuda.is_available() and os.environ.get("TRITON_INTERPRET") != "1":
    raise ImportError("no CUDA device")

from ._gpu_align import SUMS, align_kernel, gradients_kernel
from ._gpu_clear import clear_kernel
from ._gpu_device import beside, processors
from ._gpu_field import Field, Shape
from ._gpu_grid import grid_kernel
from ._gpu_points import Into, Points, decoders_kernel, place_kernel, values_kernel, weights_kernel
from ._gpu_rays import Targets, losses_kernel, render_kernel
from .adam_gpu import map_step as map_step
from .depths_gpu import importance_depths as importance_depths
from .poses_gpu import pose_step as pose_step
from .reference import smoothness as smoothness
from .reference_depths import sample_depths as sample_depths

VALUES_BLOCK, VALUES_WARPS = 64, 4  # sixteen points a warp, which one instruction of a tensor core takes
VALUES_REGISTERS = 168  # a thread; so that three programs share a processor
DECODERS_BLOCK, DECODERS_WARPS = 64, 4  # as for the values
DECODERS_REGISTERS = 168  # for poses alone, likewise; with 168 the way to the weights would spill
WEIGHTS_BLOCK, WEIGHTS_WARPS = 64, 4  # as for the values
GRID_BLOCK, GRID_WARPS = 32, 4  # to the poses; timed against 8 warps and 64 points on an H200
TABLE_RUN, TABLE_LANES, TABLE_WARPS = 4, 32, 8  # to the table: points that a lane adds up; a warp's lanes; for either
ALIGN_BLOCK, ALIGN_WARPS = 32, 4  # the gradients in space spill registers, and with 64 points far more
PLACE_BLOCK = 128  # one point a thread
CLEAR_BLOCK = 1024  # numbers
RAY_ELEMENTS = 512  # padded samples that one program renders
PROGRAMS_A_PROCESSOR = 2


class Kept(NamedTuple):
    """What the way back needs of the way forth: see ``values_kernel``."""

    features: Tensor | None
    slopes: Tensor | None
    hidden: Tensor


_layouts: dict[tuple[int, torch.device], tuple[Tensor, Tensor, Tensor]] = {}


def _on_device(layout: GridLayout, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """The layout as ``Field`` has it. Kept while the layout lives: uploading waits, and no graph can record it."""
    key = (id(layout), device)
    if key in _layouts:
        return _layouts[key]
    levels, inverse, place = layout.packed()
    _layouts[key] = levels.to(device), inverse.float().to(device), place.to(device)
    weakref.finalize(layout, _layouts.pop, key, None)
    return _layouts[key]


def _flat(tensor: Tensor) -> Tensor:
    return tensor.detach().to(torch.float32).contiguous()


def _field(layout: GridLayout, params: FieldParams) -> Field:
    learnt = (_flat(t) for t in (params.table, params.w_in, params.w_sdf, params.w_rgb))
    return Field(*_on_device(layout, params.table.device), *learnt)


def _padded(count: int, least: int) -> int:
    return max(least, 1 << max(count - 1, 0).bit_length())


def _shape(layout: GridLayout) -> Shape:
    return Shape(layout.levels, _padded(layout.levels, 8), layout.bins, _padded(3 * layout.bins, 16))


def _places(points: Tensor, c2w: Tensor | None = None) -> Points:
    """Points given by their positions: in the world, or in one camera of ``c2w`` [3 or 4, 4]."""
    place = _flat(points)
    return Points(place, place if c2w is None else _flat(c2w), place, place, place, 0, 0)


def _samples(c2w: Tensor, rays: RayBatch) -> Points:
    poses, z = _flat(c2w), _flat(rays.z)
    return Points(z, poses, _flat(rays.direction), z, rays.pose.contiguous(), 4 * poses.shape[1], z.shape[1])


def _targets(rays: RayBatch) -> Targets:
    feature = rays.feature.contiguous().view(torch.uint8)
    return Targets(_flat(rays.z), _flat(rays.depth), _flat(rays.color), feature, *rays.z.shape)


def _blocks(count: int, block: int) -> int:
    return -(-count // block)


def _clear(tensors: list[Tensor]) -> None:
    sizes = tuple(tensor.numel() for tensor in tensors)
    clear_kernel[(_blocks(max(sizes), CLEAR_BLOCK),)](tuple(tensors), sizes, block=CLEAR_BLOCK)


def _ray_grid(rays: int, samples: int) -> tuple[tuple[int], dict[str, int]]:
    """How many programs render so many rays, and the sizes each is compiled for."""
    padded = _padded(samples, 1)
    block = max(1, RAY_ELEMENTS // padded)
    return (-(-rays // block),), {"block": block, "padded": padded}


def _place(layout: GridLayout, field: Field, points: Points, total: int, from_rays: bool) -> Tensor:
    """Where so many points lie, as ``place_kernel`` has it [12, N]."""
    placed = points.position.new_empty(12, total)
    if total:
        place_kernel[(_blocks(total, PLACE_BLOCK),)](
            field, points, total, placed, from_rays=from_rays, shape=_shape(layout), block=PLACE_BLOCK
        )
    return placed


def _evaluate(layout: GridLayout, field: Field, placed: Tensor, kept: Kept | None = None) -> tuple[Tensor, Tensor]:
    """TSDF [N] and colour [N, 3]; what is to be ``kept`` goes there."""
    total = placed.shape[1]
    sdf, rgb = placed.new_empty(total), placed.new_empty(total, 3)
    features, slopes, hidden = kept or (None, None, sdf)
    if total:
        values_kernel[(_blocks(total, VALUES_BLOCK),)](
            field, placed, total, sdf, rgb, hidden if features is None else features,
            hidden if slopes is None else slopes, hidden, keep=kept is not None, keep_features=features is not None,
            keep_slopes=slopes is not None, shape=_shape(layout), block=VALUES_BLOCK, num_warps=VALUES_WARPS,
            maxnreg=VALUES_REGISTERS,
        )  # fmt: skip
    return sdf, rgb


def values(layout: GridLayout, params: FieldParams, points: Tensor) -> tuple[Tensor, Tensor]:
    """See ``reference.values``."""
    with beside(points):
        field = _field(layout, params)
        return _evaluate(layout, field, _place(layout, field, _places(points), len(points), False))


def gradients(layout: GridLayout, params: FieldParams, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See ``reference.gradients``."""
    n, given = points.shape[0], _places(points)
    new = given.position.new_empty
    found = new(n), new(n, 3), new(n), new(n, 3)
    if n:
        with beside(points):
            gradients_kernel[(_blocks(n, ALIGN_BLOCK),)](
                _field(layout, params), given, n, *found,
                shape=_shape(layout), block=ALIGN_BLOCK, num_warps=ALIGN_WARPS,
            )  # fmt: skip
    return found


def render(layout: GridLayout, params: FieldParams, c2w: Tensor, rays: RayBatch) -> tuple[Tensor, Tensor, Tensor]:
    """See ``reference.render``."""
    targets = _targets(rays)
    z = targets.z
    new = z.new_empty if z.numel() else z.new_zeros
    color, depth, weights = new(targets.rays, 3), new(targets.rays), new(z.shape)
    if z.numel():
        grid, sizes = _ray_grid(targets.rays, targets.samples)
        with beside(z):
            field = _field(layout, params)
            sdf, rgb = _evaluate(layout, field, _place(layout, field, _samples(c2w, rays), z.numel(), True))
            render_kernel[grid](targets, sdf, rgb, _flat(params.beta), color, depth, weights, **sizes)
    return color, depth, weights


def step(
    layout: GridLayout,
    params: FieldParams,
    c2w: Tensor,
    rays: RayBatch,
    weights: Weights,
    into: FieldParams | None,
    want_poses: bool,
    adam: AdamStep | None = None,
) -> StepResult:
    """See ``reference.step``. Never waits for the device."""
    targets, poses = _targets(rays), c2w.shape[0]
    out = targets.z.new_empty(5 + 12 * poses)
    losses, d_c2w = out[:5], out[5:].view(poses, 3, 4)
    learnt = [] if into is None else [into.table, into.w_in, into.w_sdf, into.w_rgb, into.beta]
    with beside(out):
        _clear([out, *learnt])
        if targets.z.numel():
            _step(layout, params, _samples(c2w, rays), targets, weights, into, losses, d_c2w if want_poses else None)
    if into is not None and adam is not None:
        map_step([params.table], [into.table], adam)
    return StepResult(losses, d_c2w if want_poses else None)


def _step(
    layout: GridLayout,
    params: FieldParams,
    points: Points,
    targets: Targets,
    weights: Weights,
    into: FieldParams | None,
    losses: Tensor,
    d_c2w: Tensor | None,
) -> None:
    """Add to ``losses``, to ``into`` and to ``d_c2w``, where they are wanted."""
    field, beta, shape = _field(layout, params), _flat(params.beta), _shape(layout)
    total = targets.z.numel()
    placed = _place(layout, field, points, total, True)
    of_features, hidden = (2, layout.levels, total), beta.new_empty(total, 2 * HIDDEN)
    features = None if into is None else beta.new_empty(of_features)
    slopes = None if d_c2w is None else beta.new_empty(3, *of_features)
    sdf, rgb = _evaluate(layout, field, placed, Kept(features, slopes, hidden))
    grid, sizes = _ray_grid(targets.rays, targets.samples)
    numbers = weights.numbers()
    d_beta = beta if into is None else into.beta
    losses_kernel[grid](targets, sdf, rgb, beta, numbers, losses, d_beta, want_beta=into is not None, **sizes)
    if into is None and d_c2w is None:
        return
    sink = Into(*(getattr(into or params, name) for name in Into._fields))
    wanted = {"want_params": into is not None, "want_poses": d_c2w is not None}
    d_features, d_world = beta.new_empty(of_features), beta.new_empty(total, 3)
    registers = DECODERS_REGISTERS if into is None else None
    decoders_kernel[(_blocks(total, DECODERS_BLOCK),)](
        field, placed, total, sdf, rgb, hidden, d_features, d_world, sink,
        **wanted, shape=shape, block=DECODERS_BLOCK, num_warps=DECODERS_WARPS, maxnreg=registers,
    )  # fmt: skip
    if into is not None:
        blocks = _blocks(total, WEIGHTS_BLOCK)
        weights_kernel[(min(blocks, PROGRAMS_A_PROCESSOR * processors(losses.device)),)](
            placed, total, features, hidden, sink, blocks, shape=shape, block=WEIGHTS_BLOCK, num_warps=WEIGHTS_WARPS
        )
    unused = losses
    of_table = 0 if into is None else _blocks(total, TABLE_RUN * TABLE_LANES // 2)
    of_poses = 0 if d_c2w is None else _blocks(total, GRID_BLOCK)
    grid_kernel[(of_table + of_poses,)](
        field, points, placed, total, of_table, d_features, unused if slopes is None else slopes, d_world, sink,
        unused if d_c2w is None else d_c2w, **wanted, run=TABLE_RUN, lanes=TABLE_LANES, shape=shape, block=GRID_BLOCK,
        num_warps=GRID_WARPS if into is None else TABLE_WARPS,
    )  # fmt: skip


def normal_equations(
    layout: GridLayout, params: FieldParams, c2w: Tensor, points: Tensor, luminance: Tensor, settings: AlignSettings
) -> NormalEquations:
    """See ``reference.normal_equations``. Waits once, for the sums: they go to the CPU, where ``align`` solves."""
    n = points.shape[0]
    sums = torch.zeros(SUMS, dtype=torch.float64, device=points.device)
    if n:
        numbers = settings.numbers()
        with beside(points):
            align_kernel[(_blocks(n, ALIGN_BLOCK),)](
                _field(layout, params), _places(points, c2w), n, _flat(luminance), numbers, sums,
                colour=settings.colour_weight > 0, shape=_shape(layout), block=ALIGN_BLOCK, num_warps=ALIGN_WARPS,
            )  # fmt: skip
    total = sums.cpu()
    products, (cost, used, inliers) = total[:64].view(8, 8), total[64:].tolist()
    return NormalEquations(products[:6, :6].clone(), products[:6, 6].clone(), cost, int(used), int(inliers))
