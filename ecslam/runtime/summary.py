"""The figures of a run, as they stand in ``summary.json``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..provenance import provenance
from .memory import peak_memory_mb

if TYPE_CHECKING:
    from .run import Run


def summarise(run: Run, ended: str, error: str, export_s: float) -> dict[str, Any]:
    """Plain values. ended, error: see ``Run.close``; fps_wall counts everything until the poses are final; export_s:
    seconds for meshes after that.

    ``ecslam eval`` adds the figures that need a reference mesh.
    """
    tally, slam, ate = run.tally, run.slam, run.truth.ate_cm
    parameters = slam.field.parameters if slam is not None and slam.field is not None else 0
    return {
        "sequence": run.plan.sequence.name,
        "preset": run.config.preset,
        "ended": ended,
        "error": error,
        "made_by": provenance(run.plan.device),
        "device": run.plan.device,
        "kernels": slam.kernels_name if slam else None,
        "kernels_note": slam.kernels_note if slam else "",
        "seed": run.config.seed,
        "frames": len(tally.rows),
        "keyframes": len(tally.keyframes),
        "wall_s": round(tally.wall_s, 3),
        "setup_s": round(tally.setup_s, 3),
        "fps_wall": round(tally.fps_wall, 3),
        "fps_engine": round(tally.fps_engine, 3),
        "ate_rmse_cm": ate.rmse if ate else None,
        "ate_mean_cm": ate.mean if ate else None,
        "ate_max_cm": ate.max if ate else None,
        "parameters": parameters,
        "parameters_mb": round(parameters * 4 / 1e6, 3),
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "skipped_frames": tally.skipped,
        "dropped_frames": tally.dropped,
        "lost_frames": tally.lost,
        "loop_closures": tally.loops,
        "unreadable_frames": tally.unreadable,
        "frames_without_ground_truth": run.truth.unknown(tally),
        "warnings": tally.warnings,
        "export_s": round(export_s, 3),
        "not_saved": dict(run.folder.not_saved),
    }
