"""The fused CPU back end (numba): one pass over chunks of points that fit a core's cache, eight points to a vector.

Why it is fast: the first layer reads 41 of its 80 inputs (three one-blob bins an axis), derivatives of the features are
kept so that the table is gathered once, and the table gradient is scattered with one thread a level, so without
atomics. Results repeat bit for bit. Two threads may call at the same time. float32, except that cells are found
as if in float64: agrees with the float64 reference to about 1e-6.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..compiled import drop_stale
from ._cpu_adam import adam_worker
from ._cpu_back import TABLE_SCRATCH
from ._cpu_field import Grid, Net, scratch_floats
from ._cpu_math import BOTH, HALF
from ._cpu_poses import pose_worker
from ._cpu_rays import Rays, count_rays, pose_gradients
from ._cpu_smooth import from_anchor, smooth_worker
from ._cpu_tile import COLUMNS
from ._cpu_work import (
    add_partials,
    align_worker,
    fill_net,
    gradients_worker,
    render_worker,
    step_worker,
    table_worker,
    values_worker,
)
from .denormals import flushed
from .depths_cpu import importance_depths as importance_depths
from .depths_cpu import sample_depths as sample_depths
from .types import (
    AdamStep,
    AlignSettings,
    FieldParams,
    GridLayout,
    NormalEquations,
    PoseMoments,
    RayBatch,
    StepResult,
    Weights,
)

drop_stale(Path(__file__).parent, step_worker.stats.cache_path, "_cpu_*")

CHUNK_POINTS = 256
CHUNK_RAYS = 8
GROUPS = 32
ALONE = 4096  # points below which one thread is faster

Floats = NDArray[np.float32]


class _Workspace(threading.local):
    """Buffers and the last layout of each calling thread: fresh pages cost more than the arithmetic on them."""

    def __init__(self) -> None:
        self.buffers: dict[str, Floats] = {}
        self.layout: GridLayout | None = None
        self.grid: Grid | None = None

    def array(self, name: str, *shape: int) -> Floats:
        """An uninitialised float32 array that lives until the next request of that name."""
        size = math.prod(shape)
        held = self.buffers.get(name)
        if held is None or held.size < size:
            held = self.buffers[name] = np.empty(size, np.float32)
        return held[:size].reshape(shape)


_workspace = _Workspace()


def _array(tensor: Tensor) -> NDArray[Any]:
    """A view of a float32 tensor (a copy if it is neither float32 nor contiguous)."""
    return tensor.detach().to(torch.float32).contiguous().numpy()


def _grid(layout: GridLayout) -> Grid:
    if layout is not _workspace.layout or _workspace.grid is None:
        levels, inverse, place = layout.packed()
        _workspace.grid = Grid(levels.numpy(), inverse.numpy(), place.numpy(), layout.bins)
        _workspace.layout = layout
    return _workspace.grid


def _net(layout: GridLayout, params: FieldParams) -> Net:
    features = 2 * layout.levels
    padded = -(-features // COLUMNS) * COLUMNS
    net = Net(
        _workspace.array("features", padded * BOTH),
        _workspace.array("features_t", BOTH * padded),
        _workspace.array("blob", 3 * (layout.bins + 2) * BOTH),
        _workspace.array("blob_steps", 3 * (layout.bins + 2) * BOTH),
        _workspace.array("sdf", HALF),
        _workspace.array("rgb", 3 * HALF),
        padded,
    )
    w_in, w_sdf, w_rgb = _array(params.w_in), _array(params.w_sdf), _array(params.w_rgb)
    fill_net(w_in, w_sdf, w_rgb, features, layout.bins, padded, *net[:6])
    return net


@cache
def _helpers(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads - 1, "ecslam-kernels", torch.set_flush_denormal, (True,))


def _spread(threads: int, worker: Callable[..., None], *args: Any) -> None:
    """Run ``worker(t, counter, *args)`` on this thread and on helpers, all taking work from one counter.

    Workers release the GIL and leave when nothing is left, so helpers that are busy elsewhere are not waited for.
    """
    counter = np.zeros(1, np.int64)
    others = [_helpers(threads).submit(worker, t, counter, *args) for t in range(1, threads)]
    try:
        with flushed():
            worker(0, counter, *args)
    finally:
        wait([other for other in others if not other.cancel()])
    for other in others:
        if not other.cancelled():
            other.result()


def _buffers(chunks: int, points: int, pitch: int, padded: int) -> tuple[int, Floats, Floats]:
    """How many threads, ``chunks`` blocks to keep (at least one a thread) and a buffer per thread."""
    threads = 1 if points < ALONE else torch.get_num_threads()
    keep, rest = scratch_floats(pitch, padded)
    kept = _workspace.array("kept", max(chunks, threads), keep)
    return threads, kept, _workspace.array("scratch", threads, rest)


def _rays(c2w: Tensor, rays: RayBatch) -> Rays:
    direction, z, depth, color = (_array(t) for t in (rays.direction, rays.z, rays.depth, rays.color))
    return Rays(
        _array(c2w), direction, z, depth, color, rays.feature.contiguous().numpy(), rays.pose.contiguous().numpy()
    )


def values(layout: GridLayout, params: FieldParams, points: Tensor) -> tuple[Tensor, Tensor]:
    """See ``reference.values``."""
    n = points.shape[0]
    sdf, rgb = torch.empty(n), torch.empty(n, 3)
    net = _net(layout, params)
    threads, *work = _buffers(0, n, CHUNK_POINTS, net.padded)
    table = _array(params.table).reshape(-1)
    _spread(
        threads, values_worker, *work, CHUNK_POINTS, _grid(layout), net, table, _array(points), sdf.numpy(), rgb.numpy()
    )
    return sdf, rgb


def gradients(layout: GridLayout, params: FieldParams, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See ``reference.gradients``."""
    n = points.shape[0]
    found = torch.empty(n), torch.empty(n, 3), torch.empty(n), torch.empty(n, 3)
    net = _net(layout, params)
    threads, *work = _buffers(0, n, CHUNK_POINTS, net.padded)
    table = _array(params.table).reshape(-1)
    _spread(
        threads,
        gradients_worker,
        *work,
        CHUNK_POINTS,
        _grid(layout),
        net,
        table,
        _array(points),
        *(t.numpy() for t in found),
    )
    return found


def render(layout: GridLayout, params: FieldParams, c2w: Tensor, rays: RayBatch) -> tuple[Tensor, Tensor, Tensor]:
    """See ``reference.render``."""
    count, samples = rays.z.shape
    found = torch.empty(count, 3), torch.empty(count), torch.empty(count, samples)
    net = _net(layout, params)
    threads, *work = _buffers(0, count * samples, CHUNK_RAYS * samples, net.padded)
    table, beta = _array(params.table).reshape(-1), np.float32(params.beta.item())
    batch = _rays(c2w, rays)
    _spread(
        threads, render_worker, *work, CHUNK_RAYS, _grid(layout), net, table, beta, batch, *(t.numpy() for t in found)
    )
    return found


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
    """See ``reference.step``; a level's rows take their step as soon as their gradient is there."""
    count, samples = rays.z.shape
    chunks = -(-count // CHUNK_RAYS)
    net, grid, batch = _net(layout, params), _grid(layout), _rays(c2w, rays)
    kept = chunks if into is not None else 0
    threads, keep, buffers = _buffers(kept, count * samples, CHUNK_RAYS * samples, net.padded)
    w = np.array(weights.numbers(), np.float32)
    groups = min(GROUPS, chunks)
    losses, sums = np.zeros((groups, 5)), _workspace.array("sums", count, 6)
    partial = _workspace.array("partial", groups, net.padded * BOTH + net.blob.size + 4 * HALF + 1)
    if groups:
        _spread(
            threads, step_worker, keep, buffers, CHUNK_RAYS, groups, grid, net, _array(params.table).reshape(-1),
            np.float32(params.beta.item()), batch, w, count_rays(batch.depth, batch.feature),
            into is not None, want_poses, losses, partial, sums,
        )  # fmt: skip
    if into is not None:
        moments = (adam.mean[0], adam.square[0]) if adam else (into.table, into.table)
        _spread(
            threads, table_worker, keep, buffers, CHUNK_RAYS, grid, count, samples,
            *(tensor.view(-1).numpy() for tensor in (into.table, params.table, *moments)),
            _adam_numbers(adam) if adam else np.empty(0, np.float32),
        )  # fmt: skip
        targets = (t.numpy() for t in (into.w_in, into.w_sdf, into.w_rgb, into.beta))
        add_partials(partial, 2 * layout.levels, layout.bins, net.padded, *targets)
    d_c2w = torch.empty(c2w.shape[0], 3, 4) if want_poses else None
    if d_c2w is not None:
        pose_gradients(batch, sums, d_c2w.numpy())
    return StepResult(torch.from_numpy(losses.sum(0)).float(), d_c2w)


def normal_equations(
    layout: GridLayout, params: FieldParams, c2w: Tensor, points: Tensor, luminance: Tensor, settings: AlignSettings
) -> NormalEquations:
    """See ``reference.normal_equations``."""
    n = points.shape[0]
    net, grid = _net(layout, params), _grid(layout)
    threads, *work = _buffers(0, n, CHUNK_POINTS, net.padded)
    sums = np.zeros((-(-n // CHUNK_POINTS), 51))
    numbers = settings.numbers()
    table = _array(params.table).reshape(-1)
    _spread(
        threads,
        align_worker,
        *work,
        CHUNK_POINTS,
        grid,
        net,
        table,
        _array(c2w),
        _array(points),
        _array(luminance),
        numbers,
        sums,
    )
    total = torch.from_numpy(sums.sum(0))
    return NormalEquations(
        total[:36].reshape(6, 6).clone(), total[36:42].clone(), float(total[42]), int(total[44]), int(total[43])
    )


def pose_step(c2w: Tensor, d_c2w: Tensor, moments: PoseMoments, rates: Tensor, count: int) -> Tensor:
    """See ``reference.pose_step``."""
    moved = torch.empty_like(c2w)
    about = np.empty((0, 3)) if moments.about is None else moments.about.numpy()
    poses, pulls = c2w.contiguous().numpy(), d_c2w.contiguous().numpy()
    state = moments.mean.numpy(), moments.square.numpy(), rates.contiguous().numpy()
    pose_worker(poses, pulls, *state, about, moments.decays, moments.epsilon, count, moved.numpy())
    return moved


def map_step(parameters: list[Tensor], gradients: list[Tensor], adam: AdamStep) -> None:
    """See ``reference.map_step``."""
    numbers = _adam_numbers(adam)
    for several in zip(parameters, gradients, adam.mean, adam.square, strict=True):
        adam_worker(*(tensor.view(-1).numpy() for tensor in several), numbers)


def _adam_numbers(adam: AdamStep) -> Floats:
    """What ``adam_range`` wants."""
    (first, second), count = adam.decays, float(adam.count)
    corrected = float(adam.rate) / (1 - first**count), math.sqrt(1 - second**count)
    return np.array([*corrected, first, second, adam.epsilon], np.float32)


def smoothness(layout: GridLayout, table: Tensor, lattice: Tensor) -> Tensor:
    """See ``reference.smoothness``."""
    n = (len(lattice) + 7) // 8 * 8
    grid, gradient, threads = _grid(layout), torch.empty_like(table), torch.get_num_threads()
    x = _workspace.array("lattice", 6 * n)
    scratch = _workspace.array("lattice_features", threads, 4 * n + TABLE_SCRATCH)
    from_anchor(grid, _array(lattice), x)
    side = round(len(lattice) ** (1 / 3))
    flat = (_array(table).reshape(-1), x, side, gradient.numpy().reshape(-1))
    _spread(threads, smooth_worker, scratch, grid, *flat)
    return gradient
