"""What is taken away from a run in the dashboard: files in ``exports/``, named by the engine, and pictures."""

from __future__ import annotations

import os
import zipfile
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import monotonic

from .. import config_files
from ..evaluation.trajectory_io import format_kitti, format_tum
from ..meshing import MeshingStopped
from ..messages import Event, Export, Exported, FramePictures
from ..types import InputError, words
from .mesh_files import mesh_bytes
from .meshjobs import FrozenMap, build_mesh
from .pictures import shrink, shrink_depth, six_pictures
from .run import Run

PICTURE_WIDTH = 160
LEFT_OUT_OF_ZIP = ("checkpoints", "exports")


def export_job(
    run: Run,
    export: Export,
    command_id: int,
    frozen: FrozenMap | None,
    publish: Callable[[Event], None],
    should_stop: Callable[[], bool],
) -> Callable[[], None]:
    """A job that writes the file and publishes ``Exported``, also when it could not be written. What it needs of the
    run is read now, in this thread."""
    if export.kind == "run":
        run.write_trajectory()
    make = _maker(run, export, frozen, should_stop)
    name = f"exports/{export.kind}-{max(run.tally.position - 1, 0):06d}{_ending(export)}"

    def job() -> None:
        path, error = None, ""
        try:
            path = zip_run(run.folder.path, name) if export.kind == "run" else run.folder.write(name, make())
        except MeshingStopped:
            raise
        except Exception as problem:
            error = words(problem)
        publish(Exported(export.kind, str(path or ""), command_id, error or run.folder.not_saved.get(name, "")))

    return job


def _ending(export: Export) -> str:
    if export.kind == "mesh":
        return f"-{1000 * export.voxel_m:g}mm.{export.format or 'ply'}"
    return {"config": ".yaml", "run": ".zip"}.get(export.kind, f"-{export.format or 'tum'}.txt")


def _maker(
    run: Run, export: Export, frozen: FrozenMap | None, should_stop: Callable[[], bool]
) -> Callable[[], str | bytes]:
    if export.kind == "mesh":
        assert frozen is not None
        map_ = frozen
        return lambda: mesh_bytes(build_mesh(map_, export.voxel_m, 0, should_stop).mesh, export.format or "ply")
    if export.kind == "config":
        text = config_files.to_yaml(run.config)
        return lambda: text
    times, poses = run.timestamps(), run.poses()
    if export.kind == "keyframes":
        kept = [run.tally.rows.index(frame) for frame in run.tally.keyframes]
        times, poses = times[kept], poses[kept]
    return (lambda: format_kitti(poses)) if export.format == "kitti" else (lambda: format_tum(times, poses))


def zip_run(folder: Path, name: str) -> Path:
    """The whole run folder but its checkpoints and exports, as ``name`` in it. Raises OSError."""
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    temporary = path.with_suffix(".tmp")
    try:
        deflated = zipfile.ZIP_DEFLATED
        with zipfile.ZipFile(temporary, "w", deflated, compresslevel=1, strict_timestamps=False) as archive:
            for file in sorted(folder.rglob("*")):
                inside = file.relative_to(folder)
                if file.is_file() and inside.parts[0] not in LEFT_OUT_OF_ZIP and not file.name.startswith("."):
                    archive.write(file, Path(folder.name) / inside)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def render_pictures(run: Run, frame: int | None) -> FramePictures:
    """The six pictures of a frame (None: the newest), or of the last one before it where that was left out. Raises
    InputError."""
    rows = run.tally.rows
    if run.slam is None or not rows or run.slam.field is None:
        raise InputError("there is no picture yet; wait for the first frame")
    wanted = rows[-1] if frame is None else frame
    if not rows[0] <= wanted <= rows[-1]:
        raise InputError(f"frame {wanted} has not been processed; there are {rows[0]} .. {rows[-1]}")
    began = monotonic()
    row = bisect_right(rows, wanted) - 1
    source = run.plan.sequence[rows[row]]
    color = shrink(source.color, PICTURE_WIDTH)
    depth = shrink_depth(source.depth, color)
    color_rendered, depth_rendered = run.slam.render(run.poses()[row], depth)
    pictures = six_pictures(rows[row], color, depth, color_rendered, depth_rendered)
    return replace(pictures, took_s=monotonic() - began)
