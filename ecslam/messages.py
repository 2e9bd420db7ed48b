"""What crosses between the engine and the world: frozen, numpy and built-in types only, picklable.

Out of the engine go a ``Snapshot`` after every frame (newest wins) and ``Event``s (never dropped). Into it go
``Command``s, which take effect at once or, where they are work, at the next frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .types import Mesh

MOVING = "something moves in the picture and is left out"


class State(str, Enum):
    """What the engine is doing, in plain words."""

    IDLE = "idle"
    INITIALISING = "initialising"
    TRACKING = "tracking"
    MAPPING = "mapping"
    LOST = "lost"
    RELOCALISING = "relocalising"
    PAUSED = "paused"
    FINISHED = "finished"
    FAILED = "failed"


@dataclass(frozen=True)
class LoopEvent:
    """An implicit loop closure: old keyframes near the camera entered the window and the poses moved.

    frame: where it happened. keyframes: frame indices of the old keyframes involved. correction_cm, correction_deg:
    how far the joint optimisation moved the current pose. loss_before, loss_after: weighted mapping loss.
    error_before_cm, error_after_cm, rotation_error_before_deg, rotation_error_after_deg: against ground truth, None
    without it or where the map lies in a world of its own. trajectory_before: float32 [N, 3] camera centres of all
    frames so far, before the correction. c2w_before: float64 [4, 4], the current pose before it.
    """

    frame: int
    keyframes: tuple[int, ...]
    correction_cm: float
    correction_deg: float
    loss_before: float
    loss_after: float
    error_before_cm: float | None
    error_after_cm: float | None
    rotation_error_before_deg: float | None
    rotation_error_after_deg: float | None
    trajectory_before: NDArray[np.float32]
    c2w_before: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class StepReport:
    """What ``Slam.step`` did with one frame.

    losses: weighted terms of the last optimisation (``free_space``, ``centre``, ``tail``, ``depth``, ``colour``); where
    direct alignment alone tracks ``align_mm``: the root of its robust cost per point, luminance included, millimetres.
    window: frame indices of the keyframes in the bundle adjustment that was applied with this frame (else empty).
    map_ms: what that took, in the schedule ``overlap`` beside tracking. step_ms: what the frame took in all, so less
    than both where mapping went on beside tracking.
    c2w: float64 [4, 4] estimate for this frame after all corrections. tracked: False where it is that of the frame
    before, since none was to be trusted.
    """

    frame: int
    timestamp: float
    c2w: NDArray[np.float64]
    tracked: bool
    lost: bool
    is_keyframe: bool
    window: tuple[int, ...]
    losses: dict[str, float]
    track_ms: float
    map_ms: float
    step_ms: float
    loop: LoopEvent | None = None
    note: str = ""


@dataclass(frozen=True, slots=True)
class KeyframeView:
    """A keyframe as the world sees it. c2w: float64 [4, 4]; picture: where a JPEG at most 160 px wide lies, if it could
    be saved."""

    frame: int
    c2w: NDArray[np.float64]
    picture: str

    def jpeg(self) -> bytes:
        """The picture's file, empty where there is none."""
        try:
            return Path(self.picture).read_bytes() if self.picture else b""
        except OSError:
            return b""


@dataclass(frozen=True)
class FramePictures:
    """The six pictures of one frame, all uint8 [h, w, 3]: colour and depth as input, rendered, and their difference.
    took_s: seconds of the engine's time that they have cost."""

    frame: int
    color: NDArray[np.uint8]
    color_rendered: NDArray[np.uint8]
    color_difference: NDArray[np.uint8]
    depth: NDArray[np.uint8]
    depth_rendered: NDArray[np.uint8]
    depth_difference: NDArray[np.uint8]
    took_s: float = 0.0


@dataclass(frozen=True)
class Snapshot:
    """The whole visible state after a frame. Newest wins; arrays are never written to after they are sent.

    trajectory: float64 [n, 4, 4] estimate of frames 0..n-1, in the world of the ground truth where there is one.
    trajectory_gt: float64 [N, 4, 4] (NaN where missing), None without it and where the first pose of the map is not
    known, as it then lies in a world of its own. color: uint8 [h, w, 3] of the current frame, small.
    fov_y_rad, aspect: of the camera, for frustums. reason: why the state is LOST or FAILED, how far the last mapping
    is, or what cannot be shown, else "". map_loss: the objective of the last mapping so far; losses: see
    ``StepReport``. reported: the frame that losses, window and times are of, None before there is one; an earlier one
    than ``frame`` while that is at work. dropped: frames that came while the engine was busy, in real time.
    live: whether a camera is on, so that ``frames_total`` grows.
    """

    state: State
    sequence: str
    preset: str
    frame: int
    frames_total: int
    trajectory: NDArray[np.float64]
    trajectory_gt: NDArray[np.float64] | None
    keyframes: tuple[KeyframeView, ...]
    window: tuple[int, ...]
    color: NDArray[np.uint8] | None
    fov_y_rad: float
    aspect: float
    losses: dict[str, float]
    track_ms: float
    map_ms: float
    fps_wall: float
    fps_engine: float
    ate_cm: float | None
    memory_mb: float
    loops: tuple[LoopEvent, ...]
    skipped: int
    lost_frames: int
    reason: str = ""
    map_loss: float | None = None
    reported: int | None = None
    dropped: int = 0
    live: bool = False


@dataclass(frozen=True)
class MeshReady:
    """A mesh made from the field as it was at ``frame``, or what the camera saw of the first one (``voxel_m`` 0)."""

    frame: int
    voxel_m: float
    mesh: Mesh


@dataclass(frozen=True)
class Exported:
    """A file was written. kind: ``mesh``, ``trajectory``, ...; path: where it lies; command_id: who asked for it;
    error: why there is none, else ""."""

    kind: str
    path: str
    command_id: int | None = None
    error: str = ""


@dataclass(frozen=True)
class Notice:
    """Something a person should read. level: ``info``, ``warning`` or ``error``."""

    level: str
    text: str
    frame: int | None = None


Event = LoopEvent | FramePictures | MeshReady | Exported | Notice


# ---- commands -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pause:
    """Stop after the current frame."""


@dataclass(frozen=True)
class Resume:
    """Go on."""


@dataclass(frozen=True)
class Step:
    """Process one frame, then pause."""


@dataclass(frozen=True)
class RunTo:
    """Go on until ``frame`` is done, then pause."""

    frame: int


@dataclass(frozen=True)
class Stop:
    """End the run here as if the sequence ended: save everything, state FINISHED. ``Restart`` begins again.

    During the last mapping: leave out the rest of it.
    """


@dataclass(frozen=True)
class Restart:
    """Begin again at the first frame; each field that is not None replaces what the run was started with."""

    sequence: str | None = None
    preset: str | None = None
    seed: int | None = None
    schedule: str | None = None
    realtime: bool | None = None


@dataclass(frozen=True)
class LoadPreset:
    """Go on from here with another preset's tracking and mapping settings (the field keeps its shape)."""

    name: str


@dataclass(frozen=True)
class Tune:
    """Set one live parameter by its dotted configuration key, e.g. ``mapping.iterations``."""

    key: str
    value: Any


@dataclass(frozen=True)
class SpeedLimit:
    """At most this many frames per second; 0 lifts the limit."""

    frames_per_s: float


@dataclass(frozen=True)
class PauseOnLoop:
    """Pause whenever a loop closes."""

    on: bool


@dataclass(frozen=True)
class RequestMesh:
    """Make a mesh now, and later ones no finer; the answer is a ``MeshReady``. max_triangles 0 = no limit."""

    voxel_m: float
    max_triangles: int = 0


@dataclass(frozen=True)
class RequestPictures:
    """Render the six pictures of a keyframe or of the current frame (None)."""

    frame: int | None = None


@dataclass(frozen=True)
class Export:
    """Write a file into the run folder. kind: ``mesh``, ``trajectory``, ``keyframes``, ``config``, ``run``.

    format: ``ply``/``glb``/``obj`` for meshes, ``tum``/``kitti`` for trajectories, ``zip`` for the run.
    """

    kind: str
    format: str = ""
    voxel_m: float = 0.02


@dataclass(frozen=True)
class Quit:
    """Save and stop the engine."""


Command = (
    Pause
    | Resume
    | Step
    | RunTo
    | Stop
    | Restart
    | LoadPreset
    | Tune
    | SpeedLimit
    | PauseOnLoop
    | RequestMesh
    | RequestPictures
    | Export
    | Quit
)


@dataclass(frozen=True)
class Ack:
    """The engine has taken a command up. ``error`` says why it could not be carried out, else ""."""

    command_id: int
    command: Command
    error: str = ""
