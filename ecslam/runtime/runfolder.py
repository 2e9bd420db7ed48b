"""The folder that a run leaves behind: what a person, ``ecslam view`` or ``ecslam resume`` needs, in plain formats.

run.json         sequence (address), name, layout, frames (the A:B:STEP asked for), frames_total, device, width, height,
                 fx, fy, cx, cy, and radial, inverse_depth, which a calibration has put right in the frames
config.yaml      the resolved configuration; what was changed on the way, and when, is a notice in events.jsonl
trajectory.txt   TUM format (timestamp tx ty tz qx qy qz qw), final poses, one line for each frame that was processed
groundtruth.txt  the same for the frames that have ground truth; absent without any
metrics.jsonl    a line for each frame, as it was then: frame, timestamp, c2w (12 numbers, the upper 3x4 row by row),
                 tracked, lost, keyframe, window, window_c2w (where its mapping left the window's keyframes), losses,
                 track_ms, map_ms, ate_cm
events.jsonl     type is "loop" (with the fields of LoopEvent) or "notice" (level, text, frame)
keyframes.jsonl  frame, c2w (12 numbers, when it was made), thumbnail (relative path)
thumbnails/      NNNNNN.jpg, at most 160 pixels wide, by frame
meshes/          NNNNNN.ply, a few meshes of the growing map, by frame
mesh.ply         the final mesh
picture.png      mesh, paths and errors in one picture
summary.json     the figures
checkpoints/     see checkpoint.py
exports/         what was asked for in the dashboard

Whole files are replaced atomically, logs grow by whole lines. When the disk is full the run goes on, and ``not_saved``
says what is missing, and why.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import remove_temporaries, write_atomic
from ..messages import LoopEvent, Notice, StepReport
from ..types import InputError
from .files import LineLog, keep_lines, read_lines, require_space, to_json
from .folderlock import claim

NEEDED_MB, NEEDED_TO_GO_ON_MB = 500.0, 100.0
CAMERA = ("width", "height", "fx", "fy", "cx", "cy")
LOGS = ("metrics.jsonl", "events.jsonl", "keyframes.jsonl")
DERIVED = ("mesh.ply", "summary.json", "picture.png")
FILES = ("run.json", "config.yaml", "trajectory.txt", "groundtruth.txt", *DERIVED)
FOLDERS = ("thumbnails", "meshes", "checkpoints")


class RunFolder:
    """Writes a run folder. problem: called once for each file that could not be saved, with a sentence for people."""

    def __init__(self, path: Path, problem: Callable[[str], None], lock: IO[str] | None) -> None:
        self.path, self._lock = path, lock
        self.not_saved: dict[str, str] = {}
        self._problem = problem
        self._logs: dict[str, LineLog] = {}

    @classmethod
    def create(cls, path: Path, problem: Callable[[str], None], needed_mb: float = NEEDED_MB) -> RunFolder:
        """Start a run in ``path``; an earlier run there is replaced.

        Raises InputError when the folder takes no files, has too little space, holds something else than a run or one
        that cannot be removed, or when a run is at work there.
        """
        if path.is_dir() and not _holds_a_run(path):
            raise InputError(f"{path}: holds other files and no run; give --out a new or empty folder")
        require_space(path, needed_mb)
        lock = claim(path)
        _remove_run(path)
        folder = cls(path, problem, lock)
        folder.go_on(0)
        return folder

    @classmethod
    def reopen(cls, path: Path, problem: Callable[[str], None]) -> RunFolder:
        """The folder of a run to resume, which stays as it is until ``go_on``. Raises InputError as ``create`` does,
        though less space is enough: most of what a run needs is there already."""
        require_space(path, NEEDED_TO_GO_ON_MB)
        return cls(path, problem, claim(path))

    def go_on(self, position: int) -> None:
        """Begin to log from frame ``position`` on: what was logged for it and later frames is dropped, and what was
        made of the run as it stood then."""
        remove_temporaries(self.path)
        for name in DERIVED:
            (self.path / name).unlink(missing_ok=True)
        for name in ("thumbnails", "meshes"):
            (self.path / name).mkdir(exist_ok=True)
        for name in LOGS:
            keep_lines(self.path / name, lambda line: (line.get("frame") or 0) < position)
            self._logs[name] = LineLog(self.path / name)

    def write(self, name: str, data: str | bytes | dict[str, Any]) -> Path | None:
        """Replace a file (a dict becomes JSON); None when it could not be saved."""
        content = to_json(data) + "\n" if isinstance(data, dict) else data
        path = self.path / name
        try:
            path.parent.mkdir(exist_ok=True)
            write_atomic(path, content.encode() if isinstance(content, str) else content)
        except OSError as error:
            self.missing(name, error)
            return None
        self.found(name)
        return path

    def missing(self, name: str, error: OSError) -> None:
        """Note that ``name`` could not be saved, and say so the first time."""
        reason = error.strerror or str(error)
        known = name in self.not_saved
        self.not_saved[name] = reason
        if not known:
            self._problem(f"{self.path / name} could not be saved ({reason}); the run goes on without it")

    def found(self, name: str) -> None:
        """Note that ``name`` is saved after all."""
        self.not_saved.pop(name, None)

    def metrics(self, report: StepReport, ate_cm: float | None, window_c2w: NDArray[np.float64]) -> None:
        """Log what a frame brought. window_c2w: poses [len(window), 4, 4] of the window's keyframes, which it moved."""
        line = {
            "frame": report.frame,
            "timestamp": report.timestamp,
            "c2w": report.c2w[:3].reshape(-1),
            "tracked": report.tracked,
            "lost": report.lost,
            "keyframe": report.is_keyframe,
            "window": report.window,
            "window_c2w": window_c2w[:, :3].reshape(-1, 12).round(6),
            "losses": report.losses,
            "track_ms": report.track_ms,
            "map_ms": report.map_ms,
            "ate_cm": ate_cm,
        }
        self._append("metrics.jsonl", line)

    def event(self, event: LoopEvent | Notice) -> None:
        """Log an event."""
        kind = "loop" if isinstance(event, LoopEvent) else "notice"
        self._append("events.jsonl", {"type": kind} | {f.name: getattr(event, f.name) for f in fields(event)})

    def picture(self, frame: int) -> str:
        """The path of a keyframe's picture."""
        return f"{self.path}/{_thumbnail(frame)}"

    def keyframe(self, frame: int, c2w: NDArray[np.float64], thumbnail: bytes) -> None:
        """Log a keyframe and save its picture, a JPEG."""
        name = _thumbnail(frame)
        try:
            (self.path / name).write_bytes(thumbnail)
        except OSError as error:
            self.missing(name, error)
        self._append("keyframes.jsonl", {"frame": frame, "c2w": c2w[:3].reshape(-1), "thumbnail": name})

    def loops(self) -> list[LoopEvent]:
        """The loop closures in the log."""
        lines = [line for line in read_lines(self.path / "events.jsonl") if line.pop("type", "") == "loop"]
        for line in lines:
            line["keyframes"] = tuple(line["keyframes"])
            line["trajectory_before"] = np.array(line["trajectory_before"], np.float32).reshape(-1, 3)
            line["c2w_before"] = None if line["c2w_before"] is None else np.array(line["c2w_before"])
        return [LoopEvent(**line) for line in lines]

    def _append(self, name: str, line: dict[str, Any]) -> None:
        try:
            if name in self._logs:
                self._logs[name].append(line)
        except OSError as error:
            self.missing(name, error)

    def close(self) -> None:
        """Bring the logs to the disk and let go of the folder; what is logged later is dropped. May be called more than
        once."""
        while self._logs:
            name, log = self._logs.popitem()
            try:
                log.close()
            except OSError as error:
                self.missing(name, error)
        if self._lock is not None:
            self._lock.close()


def read_about(folder: Path) -> dict[str, Any]:
    """``run.json`` of a run folder. Raises InputError when it is missing or damaged."""
    path = folder / "run.json"
    try:
        about = dict(json.loads(path.read_text("utf-8")))
    except (OSError, ValueError, TypeError):
        about = {}
    numbers = [about.get(name) for name in ("frames_total", *CAMERA)]
    texts = [about.get(name) for name in ("sequence", "frames")]
    if not all(isinstance(each, (int, float)) for each in numbers) or not all(isinstance(each, str) for each in texts):
        raise InputError(f"{path}: missing or damaged; start again with ecslam run")
    return about


def has_frame(line: dict[str, Any]) -> bool:
    """Whether a line of a log says which frame it is about."""
    return isinstance(line.get("frame"), int)


def frame_rows(folder: Path) -> tuple[dict[str, Any], ...]:
    """A line for each frame that a run folder has on record so far; none where there is no ``metrics.jsonl``."""
    return tuple(row for row in read_lines(folder / "metrics.jsonl") if has_frame(row) and "c2w" in row)


def _holds_a_run(path: Path) -> bool:
    """Whether a folder holds a run, or nothing but what a run begins with: a recording may have a ``mesh.ply`` and a
    ``groundtruth.txt`` too."""
    try:
        return bool(read_about(path))
    except InputError:
        ours = {*LOGS, "run.json", "config.yaml", *FOLDERS}
        found = [p for p in path.iterdir() if not p.name.startswith(".")]
        return all(p.name in ours and not (p.is_dir() and any(p.iterdir())) for p in found)


def _remove_run(path: Path) -> None:
    """Remove the files of a run. Its folders stay, emptied: they may be links. Raises InputError."""
    try:
        for name in (*FILES, *LOGS, *FOLDERS):
            place = path / name
            for file in place.iterdir() if name in FOLDERS and place.is_dir() else [place]:
                file.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(
            f"{error.filename or path}: cannot be removed for a new run ({error.strerror}); remove it, or begin one "
            "elsewhere with ecslam run --out"
        ) from None


def _thumbnail(frame: int) -> str:
    return f"thumbnails/{frame:06d}.jpg"
