"""Reading a finished run's folder."""

from __future__ import annotations

import json
import re
from bisect import bisect_right
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import viser.transforms as vt
from numpy.typing import NDArray

from ecslam.datasets.meshes import load_mesh
from ecslam.messages import KeyframeView, LoopEvent, Notice
from ecslam.runtime.files import read_lines
from ecslam.runtime.runfolder import frame_rows, has_frame
from ecslam.types import InputError, Mesh

from .glb import simplify

CAMERA = {"width": 640.0, "height": 480.0, "fy": 500.0}  # for want of better

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Run:
    """A finished run. sequence: its name, "" where that is not on record. rows: one dictionary for each frame that was
    not skipped, as in ``metrics.jsonl``; timestamps and both trajectories go with them; trajectory_gt: None without the
    first true pose too, which put the map into its world. meshes: path by frame. incomplete: why the run has not gone
    to its sequence's end, or failed there, as a sentence; else ""."""

    folder: Path
    sequence: str
    summary: dict[str, Any]
    rows: tuple[dict[str, Any], ...]
    timestamps: Array
    trajectory: Array
    trajectory_gt: Array | None
    keyframes: tuple[KeyframeView, ...]
    loops: tuple[LoopEvent, ...]
    meshes: dict[int, Path]
    incomplete: str
    fov_y_rad: float
    aspect: float

    @property
    def name(self) -> str:
        """How the run is called on the page."""
        return self.folder.resolve().name

    @property
    def last(self) -> int:
        """The number of the last frame."""
        return int(self.rows[-1]["frame"])

    def row_at(self, frame: int) -> int:
        """Which row is ``frame``'s, or the last one before it where that was skipped."""
        return max(bisect_right(self.rows, frame, key=lambda row: int(row["frame"])) - 1, 0)

    def mesh_at(self, frame: int) -> Path | None:
        """The newest mesh made at or before ``frame``, else the oldest there is."""
        past = [f for f in self.meshes if f <= frame]
        return self.meshes[max(past)] if past else self.meshes[min(self.meshes)] if self.meshes else None


def load_run(folder: Path) -> Run:
    """Read a run folder. Raises InputError when it is not one."""
    if not (folder / "metrics.jsonl").is_file():
        raise InputError(f"{folder}: not a run folder (no metrics.jsonl); give the --out folder of `ecslam run`")
    rows = frame_rows(folder)
    if not rows:
        raise InputError(f"{folder / 'metrics.jsonl'}: holds no frame; the run ended before its first one")
    summary = _json(folder / "summary.json")
    about = _json(folder / "run.json")
    width, height, fy = (_number(about.get(name), usual) for name, usual in CAMERA.items())
    timestamps = np.array([float(row.get("timestamp", row["frame"])) for row in rows])
    tracked = np.tile(np.eye(4), (len(rows), 1, 1))
    tracked[:, :3] = np.array([row["c2w"][:12] for row in rows], float).reshape(-1, 3, 4)
    trajectory = _poses_at(folder / "trajectory.txt", timestamps)
    if trajectory is None or np.isnan(trajectory).any():
        trajectory = tracked
    truth = _poses_at(folder / "groundtruth.txt", timestamps)
    events = [e for e in read_lines(folder / "events.jsonl") if e.get("type") == "loop" and has_frame(e)]
    return Run(
        folder=folder,
        sequence=str(summary.get("sequence") or about.get("name") or ""),
        summary=summary,
        rows=rows,
        timestamps=timestamps,
        trajectory=trajectory,
        trajectory_gt=truth if truth is not None and np.isfinite(truth[0]).all() else None,
        keyframes=_keyframes(folder, rows, trajectory),
        loops=tuple(_loop_event(e) for e in events),
        meshes=_meshes(folder, int(rows[-1]["frame"])),
        incomplete=_incomplete(summary, int(rows[-1]["frame"]) + 1, about.get("frames_total")),
        fov_y_rad=float(2 * np.arctan(height / 2 / fy)),
        aspect=width / height,
    )


def truth_apart(a: Run, b: Run) -> float:
    """Median distance (metres) of the true cameras of two runs at the frames that both have; 0 where there are none."""
    if a.trajectory_gt is None or b.trajectory_gt is None:
        return 0.0
    frames_a, frames_b = (np.array([row["frame"] for row in run.rows], np.int64) for run in (a, b))
    _, rows_a, rows_b = np.intersect1d(frames_a, frames_b, return_indices=True)
    apart = np.linalg.norm(a.trajectory_gt[rows_a, :3, 3] - b.trajectory_gt[rows_b, :3, 3], axis=1)
    known = apart[np.isfinite(apart)]
    return float(np.median(known)) if len(known) else 0.0


def notices_in(folder: Path) -> list[Notice]:
    """What a run folder has on record for a person to read, oldest first."""
    lines = [line for line in read_lines(folder / "events.jsonl") if line.get("type") == "notice"]
    return [Notice(str(line.get("level")), str(line.get("text")), line.get("frame")) for line in lines]


@lru_cache(12)
def drawable_mesh(path: Path) -> Mesh:
    """A mesh file within the triangle budget; remembered, as scrubbing comes back to it. Raises InputError."""
    return simplify(load_mesh(path))


def _incomplete(summary: dict[str, Any], frames: int, total: Any) -> str:
    done = f"{frames} of {total} frames" if isinstance(total, int) else f"{frames} frames"
    ended = summary.get("ended", "finished" if summary else "interrupted")
    if ended == "failed":
        return f"Failed after {done}: {summary.get('error')}"
    if ended == "interrupted":
        return f"Not finished: {done} are done; ecslam resume goes on with it"
    return f"Stopped after {done}" if ended == "stopped" else ""


def _number(value: Any, usual: float) -> float:
    return float(value) if isinstance(value, (int, float)) and value > 0 else usual


def _json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return value if isinstance(value, dict) else {}


def _poses_at(path: Path, timestamps: Array) -> Array | None:
    """Poses [n, 4, 4] of a TUM file at the given times; NaN where it has none within a millisecond."""
    if not path.is_file():
        return None
    numbers = [line.split() for line in path.read_text("utf-8", "replace").splitlines() if line.strip()]
    numbers = [words for words in numbers if len(words) == 8 and not words[0].startswith("#")]
    if not numbers:
        return None
    table = np.array(numbers, float)
    out = np.full((len(timestamps), 4, 4), np.nan)
    order = np.argsort(table[:, 0])
    table = table[order]
    at = np.clip(np.searchsorted(table[:, 0], timestamps - 1e-3), 0, len(table) - 1)
    found = np.abs(table[at, 0] - timestamps) < 1e-3
    out[found] = np.eye(4)
    out[found, :3, :3] = vt.SO3(table[at[found]][:, [7, 4, 5, 6]]).as_matrix()
    out[found, :3, 3] = table[at[found], 1:4]
    return out


def _keyframes(folder: Path, rows: tuple[dict[str, Any], ...], trajectory: Array) -> tuple[KeyframeView, ...]:
    pictures = {k["frame"]: k for k in read_lines(folder / "keyframes.jsonl") if has_frame(k)}
    out = []
    for row, c2w in zip(rows, trajectory, strict=True):
        if row.get("keyframe"):
            frame = int(row["frame"])
            out.append(KeyframeView(frame, c2w, _picture(folder, pictures.get(frame, {}).get("thumbnail"))))
    return tuple(out)


def _picture(folder: Path, name: Any) -> str:
    path = (folder / str(name or "")).resolve()
    return str(path) if path.is_relative_to(folder.resolve()) and path.is_file() else ""


def _loop_event(row: dict[str, Any]) -> LoopEvent:
    values: dict[str, Any] = {f.name: row.get(f.name) for f in fields(LoopEvent)}
    values["keyframes"] = tuple(int(k) for k in values["keyframes"] or ())
    before = np.asarray(values["trajectory_before"] or np.zeros((0, 3)), np.float32).reshape(-1, 3)
    return LoopEvent(**{**values, "trajectory_before": before})


def _meshes(folder: Path, last: int) -> dict[int, Path]:
    found = {int(p.stem): p for p in (folder / "meshes").glob("*.ply") if re.fullmatch(r"\d+", p.stem)}
    if (folder / "mesh.ply").is_file():
        found[last] = folder / "mesh.ply"
    return found
