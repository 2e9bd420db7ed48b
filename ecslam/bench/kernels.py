"""Back ends of the kernel seam against each other, taking turns in one run: what `ecslam bench kernels` prints."""

from __future__ import annotations

import importlib
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from ..config import Config
from ..field import TsdfField, create_field, map_params
from ..kernels import AlignSettings, Backend, RayBatch, Weights
from ..kernels.graphs import Recorder
from ..kernels.reference import sample_depths
from ..kernels.types import FEATURES, HIDDEN
from ..provenance import machine
from ..rays import kernel_weights
from ..types import InputError

Job = Callable[[Backend], object]

ROOM = np.array([[-3.0, -2.5, -1.5], [3.5, 2.5, 1.5]])
ALIGN_POINTS = 2000
GRAPH = "gpu as a graph"
GRAPHED = ("mapping step", "tracking step", "values")
# Passes through the decoders: forward, back to the inputs, back to the weights.
PASSES = {"mapping step": 3, "tracking step": 2, "values": 1, "normal equations": 2}
VALUE_POINTS = 43_000


def bench_kernels(rays: int = 1000, repeats: int = 5, device: str | None = None) -> dict[str, Any]:
    """Time the fused back end of ``device`` ("cpu" or "cuda"; None: a GPU where there is one) against the reference.

    A mapping step (all gradients), a tracking step (poses alone), values at 43,000 points and the normal equations of
    2,000; lite preset, so 43 samples a ray. Back ends take turns and medians of ``repeats`` are compared, so that a
    busy machine slows both. On a GPU the steps are also replayed as CUDA graphs. The floor of a job is what its matrix
    products or its table reads need at least, whichever is more, at the rates this machine showed a moment before.
    Returns plain values: the machine, sizes, milliseconds by job and back end, the ratios, the floors and how many
    times the floor the fused back end needs (as a graph where it was recorded).

    Raises InputError when there are fewer than three repeats or the fused back end cannot run here.
    """
    if repeats < 3:
        raise InputError(f"repeats = {repeats}: a median needs at least 3")
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    fused = "gpu" if device == "cuda" else "cpu"
    try:
        backends = {name: _backend(name) for name in ("reference", fused)}
    except ImportError as error:
        raise InputError(f"the {fused} kernels cannot run here: {error}") from error
    jobs = _jobs(rays, torch.device(device))
    rates = _rates(torch.device(device), repeats)
    times = {name: _alternate(_ways(name, job, backends, device), repeats, device) for name, job in jobs.items()}
    floors = {name: _floor(name, rays, rates) for name in jobs}
    return {
        "device": device,
        "machine": machine(device),
        "threads": torch.get_num_threads(),
        "rays": rays,
        "samples": rays * _samples(Config()),
        "repeats": repeats,
        "milliseconds": times,
        "ratio": {name: t["reference"] / t[fused] for name, t in times.items()},
        "floor_milliseconds": floors,
        "times_floor": {name: t.get(GRAPH, t[fused]) / floors[name] for name, t in times.items()},
    }


def print_table(result: dict[str, Any], console: Console | None = None) -> None:
    """One line a job: milliseconds of each back end, how many times faster the fused one is, and how near the floor."""
    names = list(dict.fromkeys(name for times in result["milliseconds"].values() for name in times))
    title = (
        f"{result['machine']}, {result['threads']} threads, {result['samples']:,} samples on {result['rays']:,} rays"
    )
    table = Table(title=title)
    table.add_column("job")
    for name in (*(f"{name} (ms)" for name in names), "ratio", "floor (ms)", "times the floor"):
        table.add_column(name, justify="right")
    for job, times in result["milliseconds"].items():
        table.add_row(
            job,
            *(f"{times[name]:.3g}" if name in times else "" for name in names),
            f"{result['ratio'][job]:.1f}",
            f"{result['floor_milliseconds'][job]:.3g}",
            f"{result['times_floor'][job]:.1f}",
        )
    (console or Console()).print(table)


def _backend(name: str) -> Backend:
    return cast(Backend, importlib.import_module(f"..kernels.{name}", __package__))


def _samples(config: Config) -> int:
    return config.sampling.uniform + config.sampling.near_depth


def _ways(name: str, job: Job, backends: dict[str, Backend], device: str) -> dict[str, Callable[[], object]]:
    """The job by each back end and, where nothing in it waits for a GPU, as a CUDA graph."""
    ways: dict[str, Callable[[], object]] = {k: partial(job, backend) for k, backend in backends.items()}
    if device == "cuda" and name in GRAPHED:
        recorder, anything = Recorder(), torch.zeros(1, device=device)
        ways[GRAPH] = lambda: recorder(lambda x: (job(backends["gpu"]), (x,))[1], anything, key=name)
    return ways


def _alternate(ways: dict[str, Callable[[], object]], repeats: int, device: str) -> dict[str, float]:
    """Median milliseconds by way; in each round each goes twice, and only the second time counts.

    In the engine an iteration follows one like it, so it never finds the caches full of another back end's data.
    The first round does not count either.
    """
    spent: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeats + 1):
        for name, way in ways.items():
            way()
            _wait(device)
            start = time.perf_counter()
            way()
            _wait(device)
            spent[name].append(1e3 * (time.perf_counter() - start))
    return {name: statistics.median(times[1:]) for name, times in spent.items()}


def _rates(device: torch.device, repeats: int) -> tuple[float, float]:
    """What this machine reaches, per millisecond: float32 operations in a matrix product, bytes in a copy."""
    side, numbers = (4096, 1 << 24) if device.type == "cuda" else (1024, 1 << 22)
    square, line = torch.rand(side, side, device=device), torch.rand(numbers, device=device)
    ways: dict[str, Callable[[], object]] = {"product": lambda: square @ square, "copy": line.clone}
    spent = _alternate(ways, repeats, device.type)
    return 2 * side**3 / spent["product"], 8 * numbers / spent["copy"]


def _floor(name: str, rays: int, rates: tuple[float, float]) -> float:
    """Milliseconds that a job's matrix products or its table reads need at least."""
    config = Config()
    levels, bins = config.field.levels, config.field.blob_bins
    points = {"values": VALUE_POINTS, "normal equations": ALIGN_POINTS}.get(name, rays * _samples(config))
    operations = 2 * points * (2 * HIDDEN * (FEATURES * levels + 3 * bins) + 4 * HIDDEN) * PASSES[name]
    read = points * levels * 8 * FEATURES * 4
    return max(operations / rates[0], read / rates[1])


def _wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def _jobs(rays: int, device: torch.device) -> dict[str, Job]:
    """The work, the same for every back end."""
    config = Config()
    field = create_field(config.field, ROOM, 0, device)
    generator = torch.Generator().manual_seed(0)
    poses, batch = _batch(rays, config, device, generator)
    low, high = field.layout.box
    points = (low + (high - low) * torch.rand(VALUE_POINTS, 3, generator=generator)).to(device)
    return {"mapping step": _mapping(field, poses, batch), **_reading(field, poses, batch, points)}


def _mapping(field: TsdfField, poses: torch.Tensor, batch: RayBatch) -> Job:
    into = map_params(field.params, torch.empty_like)
    return lambda kernels: kernels.step(field.layout, field.params, poses, batch, _weights(), into, True)


def _reading(field: TsdfField, poses: torch.Tensor, batch: RayBatch, points: torch.Tensor) -> dict[str, Job]:
    """The jobs that leave the field alone."""
    layout, params = field.layout, field.params
    near = points[:ALIGN_POINTS].contiguous()
    light = torch.rand(len(near), generator=torch.Generator().manual_seed(0)).to(points)
    settings = AlignSettings(0.06, 0.02, 0.95, 0.0, 1e3, 0.0, 0.1)
    return {
        "tracking step": lambda kernels: kernels.step(layout, params, poses, batch, _weights(), None, True),
        "values": lambda kernels: kernels.values(layout, params, points),
        "normal equations": lambda kernels: kernels.normal_equations(layout, params, poses[0], near, light, settings),
    }


def _weights() -> Weights:
    return kernel_weights(Config().mapping.loss, Config())


def _batch(
    count: int, config: Config, device: torch.device, generator: torch.Generator
) -> tuple[torch.Tensor, RayBatch]:
    """Rays of eight cameras around the middle of a room, looking at its walls through a lens of 60 degrees."""
    angle = torch.arange(8) * (torch.pi / 4)
    c2w = torch.eye(4).repeat(8, 1, 1)
    c2w[:, 0, 0], c2w[:, 0, 2], c2w[:, 2, 0], c2w[:, 2, 2] = angle.cos(), angle.sin(), -angle.sin(), angle.cos()
    c2w[:, :3, 3] = 0.3 * torch.randn(8, 3, generator=generator)
    pose = torch.arange(count) * 8 // max(count, 1)
    direction = torch.cat([1.15 * (torch.rand(count, 2, generator=generator) - 0.5), torch.ones(count, 1)], 1)
    world = torch.einsum("rij,rj->ri", c2w[pose, :3, :3], direction)
    low, high = torch.from_numpy(ROOM).float() * 0.9
    depth = torch.maximum((low - c2w[pose, :3, 3]) / world, (high - c2w[pose, :3, 3]) / world).amin(1)
    s, jitter = config.sampling, torch.rand(count, _samples(config), generator=generator)
    z = sample_depths(depth, depth, jitter, s.uniform, s.near_m, s.depth_range_m)
    color, feature = torch.rand(count, 3, generator=generator), torch.rand(count, generator=generator) < 0.2
    parts = (t.to(device) for t in (direction, z, depth, color, feature, pose))
    return c2w.to(device), RayBatch(*parts)
