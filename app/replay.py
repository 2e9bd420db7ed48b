"""A finished run behind the same door as a live engine: play, pause, step, scrub, export; no field, no torch."""

from __future__ import annotations

import queue
import shutil
import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ecslam.datasets.meshes import load_mesh
from ecslam.evaluation.trajectory_io import format_kitti, format_tum
from ecslam.messages import (
    Ack,
    Command,
    Export,
    Exported,
    MeshReady,
    Pause,
    Quit,
    RequestMesh,
    RequestPictures,
    Resume,
    RunTo,
    Snapshot,
    SpeedLimit,
    State,
    Step,
)
from ecslam.runtime.exports import zip_run
from ecslam.runtime.feed import Feed, FeedSubscription
from ecslam.runtime.mesh_files import mesh_bytes
from ecslam.types import InputError, words

from .history import history_of
from .past import Past
from .runs import Run, drawable_mesh

FRAMES_PER_S = 20.0


class ReplayEngine:
    """Replays ``run``; ``others`` are shown beside it for comparison."""

    presets: tuple[str, ...] = ()

    def __init__(self, run: Run, others: tuple[Run, ...] = ()) -> None:
        self.run, self.others = run, others
        self.run_folder = run.folder
        self.sequences = (run.sequence or run.name,)
        self.history = history_of(run.rows)
        self._past = Past(run.rows, run.trajectory)
        self._rows = np.array([run.row_at(frame) for frame in range(run.last + 1)])
        self._frame, self._playing, self._period = run.last, False, 1 / FRAMES_PER_S
        self._inbox: queue.SimpleQueue[tuple[int, Command] | None] = queue.SimpleQueue()
        self._ids, self._lock = 0, threading.Lock()
        self._shown_mesh: Path | None = None
        self._problem = ""
        self._feed = Feed()
        self._feed.publish(self._snapshot())
        self._thread = threading.Thread(target=self._work, name="replay", daemon=True)
        self._thread.start()

    def submit(self, command: Command) -> int:
        """Queue a command."""
        with self._lock:
            self._ids += 1
            self._inbox.put((self._ids, command))
            return self._ids

    def latest(self) -> Snapshot | None:
        """The state at the frame on show."""
        return self._feed.latest()

    def subscribe(self) -> FeedSubscription:
        """Start reading the feed."""
        return self._feed.subscribe()

    def close(self) -> None:
        """End the replay's thread."""
        self._inbox.put(None)
        self._thread.join(5)

    # ---- the thread ----------------------------------------------------------------------------------------------

    def _work(self) -> None:
        due = 0.0
        while True:
            if self._inbox.empty():
                self._show_mesh()
            try:
                wait = max(0.0, due - time.monotonic()) if self._playing else None
                item = self._inbox.get(timeout=wait)
            except queue.Empty:
                due = time.monotonic() + self._period
                self._go_to(self._frame + 1)
                continue
            if item is None:
                return
            error = ""
            try:
                self._obey(*item)
            except Exception as problem:
                error = words(problem)
            self._feed.publish(Ack(*item, error))

    def _obey(self, number: int, command: Command) -> None:
        if isinstance(command, (Pause, Quit)):
            self._playing = False
            self._go_to(self._frame)
        elif isinstance(command, Resume):
            self._playing = True
            self._go_to(0 if self._frame >= self.run.last else self._frame)
        elif isinstance(command, Step):
            if self._frame == self.run.last:
                raise InputError(f"frame {self._frame} is the last one; Play begins again")
            self._playing = False
            self._go_to(self._frame + 1)
        elif isinstance(command, RunTo):
            self._playing = False
            self._go_to(command.frame)
        elif isinstance(command, SpeedLimit):
            self._period = 1 / (command.frames_per_s or FRAMES_PER_S)
        elif isinstance(command, RequestMesh):
            self._shown_mesh = None
        elif isinstance(command, Export):
            self._feed.publish(Exported(command.kind, str(export(self.run, command)), number))
        elif not isinstance(command, RequestPictures):
            raise InputError("a finished run is looked at and exported, not steered; start one with `ecslam run`")

    def _show_mesh(self) -> None:
        """Publish the mesh of the frame on show, if it is not the one that was published last."""
        path = self.run.mesh_at(self._frame)
        if path is None or path == self._shown_mesh or not self._feed.watched:
            return
        self._shown_mesh = path
        before, self._problem = self._problem, ""
        try:
            self._feed.publish(MeshReady(self._frame, 0.0, drawable_mesh(path)))
        except InputError as error:
            self._problem = str(error)
        if self._problem != before:
            self._feed.publish(self._snapshot())

    def _go_to(self, frame: int) -> None:
        self._frame = min(max(frame, 0), self.run.last)
        self._playing = self._playing and self._frame < self.run.last
        self._feed.publish(self._snapshot())

    def _snapshot(self) -> Snapshot:
        run, frame, i = self.run, self._frame, int(self._rows[self._frame])
        row = run.rows[i]
        end = State.FAILED if run.summary.get("ended") == "failed" else State.FINISHED
        state = State.TRACKING if self._playing else end if frame == run.last else State.PAUSED
        trajectory = self._past.trajectory(i)
        keyframes = tuple(
            replace(k, c2w=trajectory[at]) for k, at in zip(run.keyframes, self._past.keyframes, strict=True) if at <= i
        )
        mapped = next((r for r in run.rows[i::-1] if r.get("window")), row)
        at_the_end = run.summary.get("ate_rmse_cm") if frame == run.last else None
        return Snapshot(
            state=state,
            sequence=self.sequences[0],
            preset=str(run.summary.get("preset", "")),
            frame=frame,
            frames_total=run.last + 1,
            trajectory=trajectory[self._rows[: frame + 1]],
            trajectory_gt=None if run.trajectory_gt is None else run.trajectory_gt[self._rows],
            keyframes=keyframes,
            window=tuple(mapped.get("window") or ()),
            color=_decoded(keyframes[-1].jpeg()) if keyframes else None,
            fov_y_rad=run.fov_y_rad,
            aspect=run.aspect,
            losses=dict(row.get("losses") or {}),
            track_ms=float(row.get("track_ms") or 0),
            map_ms=float(mapped.get("map_ms") or 0),
            fps_wall=float(run.summary.get("fps_wall") or 0),
            fps_engine=float(run.summary.get("fps_engine") or 0),
            ate_cm=row.get("ate_cm") if at_the_end is None else at_the_end,
            memory_mb=float(run.summary.get("peak_memory_mb") or 0),
            loops=tuple(e for e in run.loops if e.frame <= frame),
            skipped=int(run.summary.get("skipped_frames") or 0),
            dropped=int(run.summary.get("dropped_frames") or 0),
            lost_frames=int(run.summary.get("lost_frames") or 0),
            reason=". ".join(filter(None, (run.incomplete, self._problem))),
        )


def export(run: Run, command: Export) -> Path:
    """Write what an ``Export`` asks for into the run's ``exports`` folder, named after the last frame as a live run
    does. Raises InputError for what there is not."""
    folder = run.folder / "exports"
    folder.mkdir(parents=True, exist_ok=True)
    name = f"{command.kind}-{run.last:06d}"
    if command.kind == "mesh" and command.format in ("ply", "glb", "obj") and run.meshes:
        mesh, path = load_mesh(run.meshes[max(run.meshes)]), folder / f"{name}.{command.format}"
        path.write_bytes(mesh_bytes(mesh, command.format))
        return path
    if command.kind == "trajectory":
        path = folder / f"{name}-{command.format or 'tum'}.txt"
        kitti = command.format == "kitti"
        path.write_text(format_kitti(run.trajectory) if kitti else format_tum(run.timestamps, run.trajectory))
        return path
    if command.kind == "keyframes":
        path = folder / f"{name}-tum.txt"
        rows = [run.row_at(keyframe.frame) for keyframe in run.keyframes]
        path.write_text(format_tum(run.timestamps[rows], run.trajectory[rows]))
        return path
    if command.kind == "config" and (run.folder / "config.yaml").is_file():
        return Path(shutil.copyfile(run.folder / "config.yaml", folder / f"{name}.yaml"))
    if command.kind == "run":
        return zip_run(run.folder, f"exports/{name}.zip")
    raise InputError(f"{run.folder}: this run holds no {command.kind} to export")


def _decoded(jpeg: bytes) -> NDArray[np.uint8] | None:
    """The picture [h, w, 3] in a JPEG file; None where there is none."""
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR) if jpeg else None
    return None if picture is None else np.ascontiguousarray(picture[:, :, ::-1], np.uint8)
