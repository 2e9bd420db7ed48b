"""A plain fused TSDF beside the learned map: every frame is averaged in at once, so tracking has a second opinion that
needs no training (Curless and Levoy 1996; sparse blocks as in Niessner et al. 2013). Ours, not the paper's."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from .descent import COARSE_STRIDE, RULES, Alignment
from .kernels import AlignSettings, NormalEquations, fusion, fusion_descent, fusion_views
from .kernels.graphs import Recorder
from .pixels import Points
from .shutter import STILL, Sweep
from .types import Frame, Intrinsics

if TYPE_CHECKING:
    from .volume_gpu import GpuVolume

STRIDE = 4
ROWS, LISTED = 4096, 16384


class FusedVolume:
    """Sparse voxels of ``voxel_m`` metres with a truncated distance; the engine thread alone writes it."""

    def __init__(self, voxel_m: float, truncation_m: float) -> None:
        self.voxel_m, self.truncation_m = self._lengths = voxel_m, truncation_m
        self.used = 0
        self._blocks = _allocate(ROWS)
        self._stamp = np.full(ROWS, -1, np.int64)
        self._listed = np.empty(LISTED, np.int64)
        self._now = 0

    def integrate(
        self,
        frame: Frame,
        camera: Intrinsics,
        c2w: NDArray[np.float64],
        near_m: float,
        far_m: float,
        sweep: Sweep = STILL,
    ) -> None:
        """Average a frame seen from c2w [4, 4] during ``sweep`` (see ``shutter``) into the volume; depth outside
        near..far counts as none."""
        depth = np.where((frame.depth >= near_m) & (frame.depth <= far_m), frame.depth, np.float32(0))
        light = np.asarray(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), np.float32) * np.float32(frame.gain / 255)
        if frame.gain > 1:
            np.minimum(light, np.float32(1), out=light)
        numbers = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
        step, threads = fusion_views.NORMAL_STRIDE, torch.get_num_threads()
        normal = np.empty((-(-depth.shape[0] // step), -(-depth.shape[1] // step), 3), np.float32)
        edges = np.linspace(0, len(normal), threads + 1).astype(int)
        parts = [_pool().submit(fusion_views.normals, depth, numbers, normal, *rows) for rows in pairwise(edges)]
        view = fusion_views.View(depth, light, normal, numbers, np.ascontiguousarray(c2w), tuple(sweep.tolist()))
        listed = self._touch(view)
        _wait(parts)
        halves = np.array_split(listed, threads)
        blocks, add = self._blocks, fusion_views.integrate
        parts = [_pool().submit(add, blocks, rows, view, *self._lengths) for rows in halves[1:]]
        add(blocks, halves[0], view, *self._lengths)
        _wait(parts)

    def _touch(self, view: fusion_views.View) -> NDArray[np.int64]:
        """The rows of the blocks near what a view measured, made where there were none."""
        while True:
            self._now += 1
            self.used, listed = fusion_views.touch(
                *(self._blocks, self.used, view, STRIDE, self.truncation_m, self.voxel_m),
                *(self._stamp, self._now, self._listed),
            )
            if listed >= 0:
                return self._listed[:listed]
            self._grow()

    def _grow(self) -> None:
        self._load(self._blocks.place[: self.used], self._blocks.voxels[: self.used], 2 * len(self._blocks.place))

    def _load(self, place: NDArray[np.int64], voxels: NDArray[np.int16], rows: int) -> None:
        self._blocks, self.used = _allocate(rows), len(place)
        self._blocks.place[: self.used], self._blocks.voxels[: self.used] = place, voxels
        fusion.rehash(self._blocks, self.used)
        self._stamp = np.full(rows, -1, np.int64)
        self._listed = np.empty(max(LISTED, rows), np.int64)

    def state(self) -> dict[str, NDArray[Any]]:
        """The voxels as arrays nobody writes to afterwards, for a checkpoint."""
        return {"place": self._blocks.place[: self.used].copy(), "voxels": self._blocks.voxels[: self.used].copy()}

    def load(self, state: dict[str, NDArray[Any]]) -> None:
        """Go on from what ``state`` gave."""
        self._load(state["place"], state["voxels"], max(ROWS, 1 << len(state["place"]).bit_length()))

    def distances(self, points: NDArray[np.floating]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Signed distance [N] in metres at world points [N, 3], and whether it is known there."""
        distance, known = np.empty(len(points), np.float32), np.empty(len(points), np.bool_)
        fusion.sample_points(
            self._blocks, np.ascontiguousarray(points, np.float64), self.voxel_m, self.truncation_m, distance, known
        )
        return distance, known

    def normal_equations(self, c2w: NDArray[np.float64], points: Points, settings: AlignSettings) -> NormalEquations:
        """Sums for one Gauss-Newton step, as ``kernels.reference.normal_equations`` has them for the learned map."""
        sums = np.zeros(45)
        local, light = points.local.numpy(), points.light.numpy()
        fusion.align_sums(self._blocks, np.ascontiguousarray(c2w), local, light, self.voxel_m, settings.numbers(), sums)
        upper = np.triu(sums[:36].reshape(6, 6))
        jtj = torch.from_numpy(upper + np.triu(upper, 1).T)
        return NormalEquations(jtj, torch.from_numpy(sums[36:42]), float(sums[42]), int(sums[44]), int(sums[43]))

    def descend(
        self, points: Points, guess: NDArray[np.float64], settings: Sequence[AlignSettings], iterations: int
    ) -> Alignment:
        """See ``descent.descend``."""
        local, light, start = points.local.numpy(), points.light.numpy(), np.ascontiguousarray(guess)
        stages = np.array([stage.numbers() for stage in settings])
        c2w, cost = fusion_descent.descend(
            self._blocks, start, local, light, self.voxel_m, stages, iterations, COARSE_STRIDE, RULES
        )
        return Alignment(c2w, cost / max(len(local), 1))


def create_volume(
    kernels: str, voxel_m: float, truncation_m: float, device: torch.device, recorder: Recorder
) -> FusedVolume | GpuVolume:
    """An empty volume where the back end ``kernels`` computes: on ``device`` for ``gpu``, which records its alignments,
    else on the CPU."""
    if kernels != "gpu":
        return FusedVolume(voxel_m, truncation_m)
    from .volume_gpu import GpuVolume

    return GpuVolume(voxel_m, truncation_m, device, recorder)


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(torch.get_num_threads(), "fusion")


def _wait(parts: list[Future[None]]) -> None:
    for part in parts:
        part.result()


def _allocate(rows: int) -> fusion.Blocks:
    slots = 4 * rows
    return fusion.Blocks(
        np.full(slots, fusion.EMPTY, np.int64),
        np.empty(slots, np.int32),
        np.empty(rows, np.int64),
        np.zeros((rows, fusion.CELLS, 3), np.int16),
    )
