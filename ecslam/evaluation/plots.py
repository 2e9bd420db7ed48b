"""One picture of a run: the map, the trajectories from above, and the error over the frames."""

from __future__ import annotations

from pathlib import Path
from typing import IO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..types import Mesh
from .depth_views import up_direction
from .dollhouse import dollhouse, floor_plan, visible_pixels
from .trajectory import AbsoluteError, absolute_error

INK, MUTED, RULE, ACCENT = "#1d2733", "#7b8794", "#e3e7eb", "#e4572e"
ERRORS = "plasma"
DPI = 120

Poses = NDArray[np.float64]


def plot_run(
    into: Path | IO[bytes],
    mesh: Mesh,
    poses_est: Poses,
    poses_gt: Poses | None = None,
    title: str = "",
    frames: NDArray[np.int64] | None = None,
) -> None:
    """Write a PNG: left the mesh, seen into from above, with the path of the camera; right trajectories and errors.

    poses_est: [N, 4, 4] camera-to-world in the world of the mesh. poses_gt: the same for the truth, NaN where unknown,
    or None: then the right side shows the estimate alone. frames: [N] their numbers, where some were skipped.
    """
    poses_est = np.asarray(poses_est, np.float64)
    finite = poses_est[np.isfinite(poses_est).all((1, 2))]
    up = up_direction(finite)
    error = None if poses_gt is None else absolute_error(poses_est, poses_gt)
    figure = Figure(figsize=(16, 8.25), facecolor="white", dpi=DPI)
    figure.text(0.025, 0.945, title, size=20, weight="bold", color=INK, va="center")
    figure.text(0.025, 0.895, _summary(mesh, poses_est, error), size=12, color=MUTED, va="center")
    _draw_map(figure, mesh, finite, up)
    if error is None or poses_gt is None:
        _draw_above(figure.add_axes((0.70, 0.12, 0.28, 0.70)), poses_est, None, None, up)
    else:
        _draw_above(figure.add_axes((0.70, 0.43, 0.28, 0.42)), poses_est, poses_gt, error, up)
        numbers = np.arange(len(poses_est)) if frames is None else frames
        _draw_errors(figure.add_axes((0.70, 0.09, 0.28, 0.22)), error, numbers)
    figure.savefig(into, format="png")


def _summary(mesh: Mesh, poses: Poses, error: AbsoluteError | None) -> str:
    words = [f"{len(poses):,} frames", f"{len(mesh.faces):,} triangles"]
    if error is not None:
        words.append(f"ATE RMSE {error.cm.rmse:.2f} cm (mean {error.cm.mean:.2f}, max {error.cm.max:.2f})")
    return "   ·   ".join(words)


def _draw_map(figure: Figure, mesh: Mesh, poses: Poses, up: NDArray[np.float64]) -> None:
    axes = figure.add_axes((0.015, 0.02, 0.65, 0.85))
    axes.axis("off")
    if not len(mesh.faces):
        axes.text(0.5, 0.5, "no surface yet", color=MUTED, ha="center", size=14)
        return
    width, height = (round(n * DPI) for n in (0.65 * 16, 0.85 * 8.2))
    picture = dollhouse(mesh, poses, up, width, height)
    axes.imshow(picture.rgba, interpolation="nearest")
    trail = visible_pixels(picture, poses[:, :3, 3])
    axes.plot(*trail.T, color="white", lw=4.0, alpha=0.7, solid_capstyle="round")
    axes.plot(*trail.T, color=ACCENT, lw=1.8, solid_capstyle="round")
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)


def _draw_above(
    axes: Axes, estimate: Poses, truth: Poses | None, error: AbsoluteError | None, up: NDArray[np.float64]
) -> None:
    """The paths from above; the estimate is aligned to the truth and coloured by its error."""
    plan = floor_plan(up).T
    path = estimate[:, :3, 3]
    if truth is None or error is None:
        axes.plot(*(path @ plan).T, color=ACCENT, lw=1.8, label="estimate")
    else:
        axes.plot(*(truth[:, :3, 3] @ plan).T, color=INK, lw=3.2, alpha=0.25, label="ground truth")
        flat = error.alignment.apply(path) @ plan
        lines = LineCollection(
            list(np.stack([flat[:-1], flat[1:]], 1)),
            cmap=ERRORS,
            norm=Normalize(0, error.cm.max),
            lw=1.8,
            capstyle="round",
        )
        lines.set_array(np.nan_to_num(error.errors_cm[1:]))
        axes.add_collection(lines)
        axes.plot([], [], color=ACCENT, lw=1.8, label="estimate, coloured by error")
    _style(axes, "Trajectory from above (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.autoscale_view()
    axes.legend(frameon=False, fontsize=9, labelcolor=INK, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.06))


def _draw_errors(axes: Axes, error: AbsoluteError, frames: NDArray[np.int64]) -> None:
    axes.fill_between(frames, error.errors_cm, color=ACCENT, alpha=0.15, lw=0)
    axes.plot(frames, error.errors_cm, color=ACCENT, lw=1.2)
    axes.axhline(error.cm.rmse, color=INK, lw=1, ls=(0, (4, 3)))
    axes.text(frames[-1], error.cm.rmse, "RMSE ", color=INK, size=9, ha="right", va="bottom")
    axes.set_xlim(0, max(1, frames[-1]))
    axes.set_ylim(0, 1.1 * error.cm.max + 1e-6)
    axes.set_xlabel("frame", color=MUTED)
    _style(axes, "Position error after alignment (cm)")


def _style(axes: Axes, title: str) -> None:
    axes.set_title(title, loc="left", size=12, color=INK, weight="bold")
    axes.grid(color=RULE, lw=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=MUTED, length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)
