"""The visible state of a run, for the feed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..messages import KeyframeView, Snapshot, State
from .memory import peak_memory_mb

if TYPE_CHECKING:
    from .run import Run


def state_of(run: Run) -> State:
    """What the run is doing, from its last frame."""
    if run.report is None:
        return State.INITIALISING
    if run.lost_for:
        return State.LOST if run.lost_for == 1 else State.RELOCALISING
    return State.MAPPING if run.report.window else State.TRACKING


def take_snapshot(run: Run, state: State, reason: str = "") -> Snapshot:
    """Everything visible; a skipped frame shows the pose before it."""
    sequence, camera, report, tally = run.plan.sequence, run.plan.sequence.intrinsics, run.report, run.tally
    poses = run.poses()
    frames, keyframe_poses = run.keyframe_poses()
    seconds, ate_cm = run.clock.seconds, run.truth.ate_cm
    return Snapshot(
        state=state,
        sequence=sequence.name,
        preset=run.config.preset,
        frame=max(tally.position - 1, 0),
        frames_total=len(sequence),
        trajectory=poses[tally.row_of_each_frame()] if len(poses) else poses,
        trajectory_gt=run.truth.in_map(tally),
        keyframes=tuple(
            KeyframeView(frame, c2w, run.folder.picture(frame))
            for frame, c2w in zip(frames, keyframe_poses, strict=True)
        ),
        window=report.window if report else (),
        color=run.picture,
        fov_y_rad=2 * float(np.arctan(camera.height / (2 * camera.fy))),
        aspect=camera.width / camera.height,
        losses=report.losses if report else {},
        track_ms=report.track_ms if report else 0.0,
        map_ms=report.map_ms if report else 0.0,
        fps_wall=len(tally.rows) / seconds if seconds else 0.0,
        fps_engine=tally.fps_engine,
        ate_cm=ate_cm.rmse if ate_cm else None,
        memory_mb=peak_memory_mb(),
        loops=tuple(run.loops),
        skipped=tally.skipped,
        dropped=tally.dropped,
        live=run.live is not None and not run.live.over(),
        lost_frames=tally.lost,
        reason=reason or (run.last_mapping if state is State.MAPPING else ""),
        map_loss=run.map_loss,
        reported=report.frame if report else None,
    )
