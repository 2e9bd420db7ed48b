"""Meshes (and other slow exports) made by one job thread, from a frozen copy of the map, while mapping goes on."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from ..meshing import MeshingStopped, ObservedBlocks, extract_mesh, voxel_for_budget
from ..messages import MeshReady

LIVE_TRIANGLES = 100_000
LIVE_PERIOD_S = 1.0
LIVE_SHARE = 0.25
LIVE_POINTS, MESH_POINTS = 200_000, 2_000_000
FIRST_AFTER_S = 1.0
FIRST_VOXEL_M = 0.04
FINEST_LIVE_VOXEL_M = 0.02
BLOCK_M = 0.08


@dataclass(frozen=True)
class FrozenMap:
    """A map that nobody writes to, from ``frame``. points: works out float32 [N, 3], measured surface, metres.

    sdf, color: numpy callables as ``Slam.query`` gives them.
    """

    frame: int
    sdf: Callable[[NDArray[np.float32]], NDArray[np.floating]]
    color: Callable[[NDArray[np.float32]], NDArray[np.uint8]]
    points: Callable[[], NDArray[np.float32]]


def build_mesh(
    frozen: FrozenMap,
    voxel_m: float,
    max_triangles: int = 0,
    should_stop: Callable[[], bool] | None = None,
) -> MeshReady:
    """A coloured mesh of the observed part of a map.

    When it has more than ``max_triangles`` (0 = no limit) it is made again with a voxel that keeps to them.
    Raises MeshingStopped.
    """
    observed = ObservedBlocks.from_points(frozen.points(), max(BLOCK_M, voxel_m))
    while True:
        mesh = extract_mesh(frozen.sdf, frozen.color, observed, voxel_m, should_stop=should_stop)
        if not max_triangles or len(mesh.faces) <= max_triangles:
            return MeshReady(frozen.frame, voxel_m, mesh)
        voxel_m = voxel_for_budget(voxel_m, len(mesh.faces), max_triangles)


class JobThread:
    """Does one job after the other. A job that raises is reported to ``failed``; the thread goes on."""

    def __init__(self, failed: Callable[[BaseException], None]) -> None:
        self._failed = failed
        self._changed = threading.Condition()
        self._jobs: deque[Callable[[], None]] = deque()
        self._busy = self._closed = False
        self._thread: threading.Thread | None = None

    @property
    def waiting(self) -> int:
        """Jobs that are not done yet."""
        return len(self._jobs) + self._busy

    def submit(self, job: Callable[[], None]) -> None:
        """Queue a job; the first one starts the thread. Jobs submitted after ``close`` are not done."""
        with self._changed:
            self._jobs.append(job)
            self._changed.notify_all()
            if self._thread is None and not self._closed:
                self._thread = threading.Thread(target=self._work, name="jobs", daemon=True)
                self._thread.start()

    def close(self, timeout_s: float = 2.0) -> None:
        """Drop waiting jobs, ask the one at work to end, and wait for it at most ``timeout_s``."""
        with self._changed:
            self._closed = True
            self._jobs.clear()
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._jobs or self._closed)
                if self._closed:
                    return
                job, self._busy = self._jobs.popleft(), True
            try:
                job()
            except MeshingStopped:
                pass
            except Exception as error:
                self._failed(error)
            finally:
                del job  # it holds a map


class LiveMeshes:
    """When the next mesh for the watchers is due, and how fine it is.

    At most one a second, and so rarely that making them takes at most a quarter of the time; the first one a
    second after the start; the voxel follows the triangle budget.
    """

    def __init__(self) -> None:
        self._due = monotonic() + FIRST_AFTER_S
        self._voxel_m = FIRST_VOXEL_M
        self._finest_m = FINEST_LIVE_VOXEL_M
        self._making = False

    @property
    def due(self) -> bool:
        """Whether to freeze the map now and ``make`` a mesh."""
        return not self._making and monotonic() >= self._due

    def limit(self, finest_m: float) -> None:
        """From now on use no finer voxel than this."""
        self._finest_m = self._voxel_m = finest_m

    def begin(self) -> None:
        """A job that will call ``make`` has been queued."""
        self._making = True

    def make(self, frozen: FrozenMap, should_stop: Callable[[], bool]) -> MeshReady | None:
        """The mesh, or None when there is no surface yet. Called in the job thread."""
        started = monotonic()
        try:
            ready = build_mesh(frozen, self._voxel_m, LIVE_TRIANGLES, should_stop)
        finally:
            took = monotonic() - started
            self._due = started + max(LIVE_PERIOD_S, took / LIVE_SHARE)
            self._making = False
        faces = len(ready.mesh.faces)
        if not faces:
            return None
        self._voxel_m = max(self._finest_m, ready.voxel_m * float(np.sqrt(1.2 * faces / LIVE_TRIANGLES)))
        return ready
