"""Meshes, pictures and exports for the world: what is needed is frozen on the engine thread, made by the job thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from shlex import quote

import numpy as np

from ..messages import Command, Export, Exported, MeshReady, Notice, RequestMesh, RequestPictures
from ..types import Frame, InputError, words
from .control import Control
from .exports import export_job, render_pictures
from .feed import Feed
from .mesh_files import mesh_bytes
from .meshjobs import LIVE_POINTS, FrozenMap, JobThread, LiveMeshes, build_mesh
from .preview import depth_mesh
from .run import Run

MESHES_KEPT = 8
KEPT_VOXEL_M = 0.05
KEPT_TRIANGLES = 60_000
FINEST_VOXEL_M = 0.01


class Workshop:
    """Owns the job thread. All methods but ``waiting`` are called on the engine thread."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self._jobs = JobThread(lambda error: self._complain(f"a mesh or an export failed: {error}"))
        self._showing = threading.Lock()
        self._live = LiveMeshes()
        self._leaving: Callable[[], bool] = lambda: False

    @property
    def waiting(self) -> int:
        """Jobs that are not done yet."""
        return self._jobs.waiting

    def begin(self, leaving: Callable[[], bool]) -> None:
        """A run begins; jobs end early when ``leaving`` answers True, and the run before shows no more meshes."""
        with self._showing:
            self._live = LiveMeshes()
        self._leaving = leaving

    def close(self) -> None:
        """Drop what waits and end the job thread."""
        self._jobs.close()

    def take_up(self, run: Run, orders: list[tuple[int, Command]]) -> None:
        """Begin what was ordered; orders taken up together share one frozen map. One that fails is told."""
        frozen: FrozenMap | None = None
        for command_id, command in orders:
            try:
                if isinstance(command, RequestPictures):
                    self._feed.publish(render_pictures(run, command.frame))
                    continue
                if isinstance(command, RequestMesh) or (isinstance(command, Export) and command.kind == "mesh"):
                    frozen = frozen or _freeze(run)
                if isinstance(command, RequestMesh):
                    self._live.limit(command.voxel_m)
                    self._jobs.submit(self._mesh_job(_needed(frozen), command))
                elif isinstance(command, Export):
                    self._jobs.submit(export_job(run, command, command_id, frozen, self._feed.publish, self._leaving))
            except Exception as error:
                why = words(error)
                if isinstance(command, Export):
                    self._feed.publish(Exported(command.kind, "", command_id, why))
                else:
                    self._complain(why)

    def _mesh_job(self, frozen: FrozenMap, order: RequestMesh) -> Callable[[], None]:
        live, over = self._live, self._over()
        return lambda: self._show(live, build_mesh(frozen, order.voxel_m, order.max_triangles, over))

    def _over(self) -> Callable[[], bool]:
        """Whether nobody waits for the meshes of this run any more."""
        live, leaving = self._live, self._leaving
        return lambda: leaving() or live is not self._live

    def _show(self, live: LiveMeshes, ready: MeshReady | None) -> None:
        with self._showing:
            if ready is not None and live is self._live:
                self._feed.publish(ready)

    def first_look(self, run: Run, frame: Frame) -> None:
        """What the camera measured in the run's first frame, for the watchers, until the map has learnt it."""
        if self._feed.watched and run.slam is None:
            config, c2w = run.config, np.eye(4) if frame.c2w_gt is None else frame.c2w_gt
            mesh = depth_mesh(frame, run.plan.sequence.intrinsics, c2w, config.depth_near_m, config.depth_far_m)
            self._feed.publish(MeshReady(frame.index, 0.0, mesh))

    def live(self, run: Run, at_once: bool = False) -> None:
        """The periodic mesh, when somebody watches and it is due; none before the map has learnt the first frame."""
        wanted = self._feed.watched and bool(run.tally.rows) and (at_once or self._live.due)
        frozen = run.freeze(LIVE_POINTS) if wanted else None
        if frozen is not None:
            live, over = self._live, self._over()
            live.begin()
            self._jobs.submit(lambda: self._show(live, live.make(frozen, over)))

    def keep(self, run: Run) -> None:
        """A few meshes over the run, for looking back later; the first after the first frame."""
        done = run.tally.position
        if done == 1 or done % -(-len(run.plan.sequence) // MESHES_KEPT) == 0:
            frozen = run.freeze(LIVE_POINTS)
            if frozen is not None:
                name = f"meshes/{frozen.frame:06d}.ply"
                self._jobs.submit(lambda: self._save(run, name, frozen, KEPT_VOXEL_M, KEPT_TRIANGLES))

    def final(self, run: Run, control: Control) -> None:
        """``mesh.ply`` at the map's finest voxel; given up when the engine is asked to leave. Where the map cannot
        even be copied, that costs the mesh and no more."""
        done = threading.Event()
        try:
            frozen = run.freeze()
            self.live(run, at_once=True)
        except Exception as error:
            run.warn(_without_mesh(run, f" ({words(error).splitlines()[0]})"))
            return
        if frozen is None:
            return

        def job() -> None:
            try:
                self._save(run, "mesh.ply", frozen, max(run.config.field.finest_voxel_m, FINEST_VOXEL_M), 0)
            finally:
                done.set()
                control.wake()

        self._jobs.submit(job)
        control.wait_for(done.is_set)
        if not (run.folder.path / "mesh.ply").is_file():
            run.warn(_without_mesh(run))

    def _save(self, run: Run, name: str, frozen: FrozenMap, voxel_m: float, max_triangles: int) -> None:
        mesh = build_mesh(frozen, voxel_m, max_triangles, self._leaving).mesh
        run.folder.write(name, mesh_bytes(mesh, "ply"))

    def _complain(self, text: str) -> None:
        self._feed.publish(Notice("error", text))


def _without_mesh(run: Run, why: str = "") -> str:
    return f"mesh.ply was not made{why}; make it with: ecslam mesh {quote(str(run.folder.path))}"


def _freeze(run: Run) -> FrozenMap:
    return _needed(run.freeze())


def _needed(frozen: FrozenMap | None) -> FrozenMap:
    if frozen is None:
        raise InputError("there is no map yet; wait for the first frame")
    return frozen
