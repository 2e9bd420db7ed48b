"""A run folder against the ground truth of its sequence: all figures of the paper's tables."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import datasets
from ..atomic import write_atomic
from ..datasets.meshes import NoSurface, load_mesh
from ..evaluation.trajectory import absolute_error, find_lag, relative_error
from ..evaluation.trajectory_io import read_tum
from ..types import InputError, Mesh, words
from .runfolder import read_about

SAME_S = 1e-6
LEFT, SAVED_CM = 0.8, 0.2  # a lag is worth saying where it leaves less of the error and saves more


def judge_run(
    folder: Path,
    progress: Callable[[float], None] | None = None,
    *,
    surface: bool = True,
    tell: Callable[[str], None] = lambda text: None,
) -> dict[str, float]:
    """The figures that need ground truth, also written into the run's ``summary.json``.

    ate_*_cm, rpe_cm, rpe_deg and, where the sequence has a reference mesh, depth_l1_cm, accuracy_cm, completion_cm,
    completion_ratio (per cent). progress: gets the share done in 0..1. surface: False leaves out the latter, which
    take minutes. tell: gets a sentence when some of them are missing, or cannot be written. Raises InputError without
    a finished run or ground truth, and for a mesh that is damaged.
    """
    summary_path = folder / "summary.json"
    if not summary_path.is_file():
        raise InputError(f"{folder}: no finished run here; give the folder that `ecslam run --out` wrote")
    summary, about = _read_summary(summary_path), read_about(folder)
    times, poses = read_tum(folder / "trajectory.txt")
    truth = read_truth(folder, times)
    if truth is None:
        raise InputError(f"{folder}: the sequence has no ground truth, so there is nothing to compare with")
    figures = _trajectory_figures(poses, truth)
    lag = find_lag(poses, truth, times)
    if lag is not None and lag.rmse_cm < min(LEFT * lag.with_cm, lag.with_cm - SAVED_CM):
        side = "behind" if lag.seconds > 0 else "ahead of"
        tell(
            f"the path is {1e3 * abs(lag.seconds):.0f} ms {side} the ground truth, and without that ate_rmse_cm would "
            f"be {lag.rmse_cm:.3f}: do images and ground truth have one clock?"
        )
    if surface:
        found, note = _surface_figures(folder, about, truth, progress)
        figures |= found
        if note:
            tell(note)
    try:
        write_atomic(summary_path, json.dumps(summary | figures, indent=2).encode())
    except OSError as error:
        tell(f"the figures could not be written into {summary_path} ({error.strerror})")
    return figures


def _read_summary(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text("utf-8")))
    except (OSError, ValueError, TypeError) as error:
        onward = f"remove it, and make it again with: ecslam resume {quote(str(path.parent))}"
        raise InputError(f"{path}: cannot be read ({words(error)}); {onward}") from None


def _surface_figures(
    folder: Path, about: dict[str, Any], truth: NDArray[np.float64], progress: Callable[[float], None] | None
) -> tuple[dict[str, float], str]:
    """The figures of the mesh, and why there are none or not all of them ("" when there are)."""
    from ..evaluation.report import evaluate_run

    try:
        mesh = read_mesh(folder / "mesh.ply")
    except NoSurface as error:
        return {}, f"the trajectory's figures only, for the map has no surface: {error}"
    if not np.isfinite(truth[0]).all():
        return {}, "the trajectory's figures only, for the first frame has no true pose: the map lies in its own world"
    try:
        sequence = datasets.select_frames(datasets.open_sequence(about["sequence"]), about["frames"])
        reference = sequence.reference_mesh()
    except InputError as error:
        return {}, f"the trajectory's figures only, for the reference mesh is out of reach: {error}"
    if reference is None:
        return {}, "the trajectory's figures only, for the sequence has no reference mesh"
    found = evaluate_run(mesh, reference, sequence.intrinsics, truth, progress=progress)
    missing = ", ".join(name for name, value in found.items() if value is None)
    note = f"without {missing}, for nothing of the map's surface was in view" if missing else ""
    return {name: value for name, value in found.items() if value is not None}, note


def _trajectory_figures(poses: NDArray[np.float64], truth: NDArray[np.float64]) -> dict[str, float]:
    figures: dict[str, float] = {}
    ate, rpe = absolute_error(poses, truth), relative_error(poses, truth)
    if ate is not None:
        figures |= {f"ate_{name}_cm": getattr(ate.cm, name) for name in ("rmse", "mean", "median", "max")}
    if rpe is not None:
        figures |= {"rpe_cm": rpe.cm.rmse, "rpe_deg": rpe.deg.rmse}
    return figures


def read_truth(folder: Path, times: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Ground-truth poses [N, 4, 4] at ``times`` [N], NaN where there is none; None without ground truth."""
    path = folder / "groundtruth.txt"
    if not path.is_file():
        return None
    found_times, found = read_tum(path)
    truth = np.full((len(times), 4, 4), np.nan)
    at = np.searchsorted(times, found_times - SAME_S).clip(0, len(times) - 1)
    same = np.abs(times[at] - found_times) <= SAME_S
    truth[at[same]] = found[same]
    return truth


def read_mesh(path: Path) -> Mesh:
    """A mesh file of ours. Raises NoSurface where there is none or an empty one, InputError for a damaged one."""
    mend = f"make it with: ecslam mesh {quote(str(path.parent))}"
    if not path.is_file():
        raise NoSurface(f"{path}: no mesh here; {mend}")
    return load_mesh(path, mend)
