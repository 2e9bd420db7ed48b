"""What a terminal is told when a run is over: its figures, where its files lie, and what could not be saved."""

from __future__ import annotations

import json
from concurrent.futures import Future, ThreadPoolExecutor
from io import BytesIO
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from rich.console import Console

from .atomic import write_atomic
from .datasets.meshes import NoSurface
from .evaluation.trajectory_io import read_tum
from .messages import Snapshot, State
from .runtime.checkpoint import newest_frame
from .runtime.engine import Engine
from .runtime.judge import read_mesh, read_truth
from .runtime.runfolder import frame_rows
from .types import InputError

console = Console(markup=False)
FIGURES = (
    "sequence", "preset", "kernels", "frames", "fps_wall", "ate_rmse_cm", "loop_closures", "skipped_frames",
    "dropped_frames", "lost_frames",
)  # fmt: skip
DONE = ("frames", "skipped_frames", "dropped_frames")
FINAL = ("trajectory.txt", "checkpoints", "mesh.ply", "summary.json")


class Reports:
    """Reports every run of an engine once, as soon as it is over, on a thread of its own: drawing takes seconds. What
    ended a run that failed is said at once."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._pool = ThreadPoolExecutor(1, "report")
        self._made: dict[Path, Future[None]] = {}

    def watch(self, s: Snapshot) -> None:
        """Take every snapshot, on the engine's thread."""
        if s.state is State.FINISHED:
            self._report()
        elif s.state is State.FAILED:
            console.print(f"error: {s.reason}", soft_wrap=True)

    def _report(self) -> None:
        folder, summary = self._engine.run_folder, self._engine.summary
        if summary is not None and folder not in self._made:
            self._made[folder] = self._pool.submit(finish_run, folder, summary)

    def close(self) -> None:
        """Report a run that was left early too, and return when all is said. Raises what a report raised."""
        self._report()
        for made in self._made.values():
            made.result()
        self._pool.shutdown()


def finish_run(folder: Path, summary: dict[str, Any]) -> None:
    """Draw the picture of the run, print its figures and where they lie, and how to get a mesh that it lacks. A picture
    that fails is a warning. Raises InputError when what a run is for could not be saved."""
    picture = None
    try:
        picture = draw_picture(folder)
    except Exception as error:
        console.print(f"warning: picture.png was not made: {error}", soft_wrap=True)
    for name in FIGURES:
        value = summary[name]
        words = "-" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)
        console.print(f"  {name:15} {words}", soft_wrap=True)
    for name, path in {"mesh": folder / "mesh.ply", "picture": picture, "summary": folder / "summary.json"}.items():
        if path is not None and path.is_file():
            console.print(f"  {name:15} {path}", soft_wrap=True)
    for note in (summary["kernels_note"], *(f"{name} not saved ({why})" for name, why in summary["not_saved"].items())):
        if note:
            console.print(f"  note: {note}", soft_wrap=True)
    saved, done = newest_frame(folder / "checkpoints"), sum(summary[name] for name in DONE)
    if 0 < saved < done:
        console.print(f"  note: the newest checkpoint holds {saved} of the {done} frames done", soft_wrap=True)
    if not (folder / "mesh.ply").is_file():
        named = quote(str(folder))
        text = f"  no mesh.ply yet: ecslam mesh {named} makes it, or ecslam resume {named} goes on with the run"
        if not saved:
            text = "  no mesh.ply and no checkpoint yet, so there is nothing to go on from: start again with ecslam run"
        console.print(text, soft_wrap=True)
    _require_saved(folder, summary["not_saved"], bool(saved))


def _require_saved(folder: Path, not_saved: dict[str, str], to_go_on: bool) -> None:
    """Raises InputError when something of ``FINAL`` is among what could not be saved. to_go_on: whether there is a
    checkpoint."""
    lacking = [name for name in FINAL if name in not_saved]
    if lacking:
        command = "mesh" if lacking == ["mesh.ply"] else "resume"
        onward = f"ecslam {command} {quote(str(folder))}" if to_go_on else "ecslam run"
        raise InputError(
            f"{folder}: {', '.join(lacking)} could not be saved ({not_saved[lacking[0]]}); make room, then: {onward}"
        )


def draw_picture(folder: Path) -> Path | None:
    """``picture.png``: mesh and trajectories of a run folder; None when it has no mesh, or an empty one. Raises
    InputError for files that are damaged, and OSError."""
    from .evaluation.plots import plot_run

    try:
        mesh = read_mesh(folder / "mesh.ply")
    except NoSurface:
        return None
    times, poses = read_tum(folder / "trajectory.txt")
    truth = read_truth(folder, times)
    summary = json.loads((folder / "summary.json").read_text())
    title = f"{summary['sequence']}, {summary['preset']}: {summary['fps_wall']:.1f} frames/s"
    drawn = BytesIO()
    frames = np.array([row["frame"] for row in frame_rows(folder)], np.int64)
    plot_run(drawn, mesh, poses, truth, title, frames if len(frames) == len(poses) else None)
    write_atomic(folder / "picture.png", drawn.getvalue())
    return folder / "picture.png"
