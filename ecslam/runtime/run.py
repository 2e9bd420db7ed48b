"""One pass over a sequence: frames in; poses, logs, checkpoints and a summary out. It knows no commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import config_files
from ..config import Config
from ..datasets.check import lacking_depth, odd_depth
from ..datasets.views import in_order, problems
from ..evaluation.trajectory_io import format_tum
from ..messages import MOVING, Event, LoopEvent, Notice, StepReport
from ..types import Frame, FrameError, InputError
from .checkpoint import Checkpoint
from .checkpoint_writer import CheckpointWriter
from .continued import camera_of, require_same_camera, require_same_times
from .driven import Abandoned, SlamFactory, SlamLike, import_slam
from .driven import State as Arrays
from .memory import return_holes
from .meshjobs import MESH_POINTS, FrozenMap
from .pictures import jpeg, shrink
from .plan import Plan
from .runfolder import RunFolder, read_about
from .summary import summarise
from .tally import Every, Stopwatch, Tally
from .truth import Truth

ATE_EVERY = 10
TRAJECTORY_EVERY_S, HOLES_EVERY_S = 5.0, 0.4
THUMBNAIL_WIDTH = 160
PICTURE_WIDTH = 320
MOST_WARNINGS = 100
EACH_SKIP, MANY_SKIPS = 20, 100  # skipped frames that are told one by one, and then every how many
HOLD_STILL = "the camera is on: hold it still until the first map appears, a second or two"
GOOD_NEWS = ("relocalised", "recovered", MOVING)


class Run:
    """The state of one run. emit: takes events for the world. See the module."""

    def __init__(
        self,
        plan: Plan,
        folder: RunFolder,
        emit: Callable[[Event], None],
        make: SlamFactory,
        checkpoint_every: int,
        resumed: Checkpoint | None = None,
    ) -> None:
        self.plan, self.folder, self.config, self.live = plan, folder, plan.config, plan.live
        self.slam: SlamLike | None = None
        self.tally = Tally(**resumed.meta["tally"]) if resumed else Tally()
        self.clock = Stopwatch(self.tally.wall_s)
        self.truth = Truth(plan.sequence.poses_gt())
        self._in_order = in_order(plan.sequence.timestamps())
        self.torn = False
        self.report: StepReport | None = None
        self.map_loss: float | None = None
        self.last_mapping = ""
        self.loops: list[LoopEvent] = []
        self._emit, self._make = emit, make
        self._checkpoints = CheckpointWriter(
            folder.path / "checkpoints",
            checkpoint_every,
            failed=lambda error: folder.missing("checkpoints", error),
            saved=lambda: folder.found("checkpoints"),
            frame=self.tally.position,
        )
        self._color: NDArray[np.uint8] | None = None
        self._writing, self._tidying = Every(TRAJECTORY_EVERY_S), Every(HOLES_EVERY_S)
        self.lost_for = 0
        self._settled = False
        if resumed:
            about = read_about(folder.path)
            require_same_camera(plan.address, plan.sequence, about)
            self._settled = bool(resumed.meta["finished"])
            self._build(None, resumed.arrays)
            require_same_times(plan.address, plan.sequence, self.tally, self.timestamps())
            folder.go_on(resumed.frame)
            folder.write("run.json", about | {"sequence": plan.address, "frames_total": len(plan.sequence)})
            self.loops = folder.loops()
            self.measure()
        else:
            self._describe()
        self._write_inputs()

    def _describe(self) -> None:
        """Write what the run is about, before it begins."""
        s = self.plan.sequence
        about: dict[str, Any] = {
            "sequence": self.plan.address,
            "name": s.name,
            "layout": s.layout,
            "frames": self.plan.frames,
            "frames_total": len(s),
            "device": self.plan.device,
        }
        about |= camera_of(s)
        self.folder.write("run.json", about)

    def _write_inputs(self) -> None:
        """Also where a run goes on: both may have been lost since."""
        self.folder.write("config.yaml", config_files.to_yaml(self.config))
        if (truth := self.truth.poses) is not None:
            known = np.isfinite(truth).all((1, 2)) & self._in_order
            times = self.plan.sequence.timestamps()
            self.folder.write("groundtruth.txt", format_tum(times[known], truth[known]))

    # ---- frames ---------------------------------------------------------------------------------------------------

    def feed(
        self, index: int, item: Frame | FrameError, interrupt: Callable[[], None], then: Frame | None = None
    ) -> StepReport | None:
        """Process a frame, or skip it (None) when it is unreadable or out of order in time. then: the next frame, where
        it has been read already.

        Raises InputError when too many frames are unreadable or none is of use, and whatever ``interrupt`` raises (the
        run is then ``torn``: the frame at work is lost and there are no more checkpoints).
        """
        if self.tally.position == 0:
            for text in problems(self.plan.sequence):
                self.warn(text)
        self.tally.dropped += index - self.tally.position
        self.tally.position = index + 1
        if isinstance(item, FrameError):
            self.tally.unreadable.append(str(item))
            self._skip(index, str(item))
            return None
        if not self._in_order[index : index + 1].all():  # what came after the run began is in order
            self._skip(index, f"frame {index} is not in the order of time ({item.timestamp:.6f} s)")
            return None
        if self._color is None and (odd := odd_depth(item.depth, self._used_m)):
            self.warn(odd, index)
        self._color = item.color
        try:
            report = self._step(item, interrupt, then)
        except FrameError as error:
            self.slam = self.slam if self.tally.rows else None
            self._skip(index, str(error))
            return None
        except BaseException:
            self.torn = True
            self.tally.position = index
            raise
        self._record(report, item)
        return report

    def _step(self, frame: Frame, interrupt: Callable[[], None], then: Frame | None) -> StepReport:
        slam = self.slam or self._build(frame.c2w_gt, None)
        report = slam.step(frame, interrupt, then)
        if report.loop is None:
            return report
        return replace(report, loop=self.truth.with_errors(report.loop, report.c2w, self.tally))

    def _build(self, first_pose: NDArray[np.float64] | None, state: Arrays | None) -> SlamLike:
        sequence = self.plan.sequence
        bounds = sequence.bounds if first_pose is not None else None
        running = self.clock.pause()
        began = monotonic()
        self.slam = self._make(
            self.config, sequence.intrinsics, device=self.plan.device, bounds=bounds, first_pose=first_pose, state=state
        )
        self.tally.setup_s += monotonic() - began
        if running:
            self.clock.resume()
        return self.slam

    def _skip(self, index: int, why: str) -> None:
        self.tally.skipped += 1
        self.tally.first_skip = self.tally.first_skip or why
        if self.tally.skipped <= EACH_SKIP or self.tally.skipped % MANY_SKIPS == 0:
            many = f"{self.tally.skipped} frames so far, now as " if self.tally.skipped > EACH_SKIP else ""
            self.notice("warning", f"skipped: {many}{why}", index)
        frames, bad = len(self.plan.sequence), self.tally.unreadable
        if self.tally.too_many_unreadable(frames):
            raise InputError(
                f"{self.plan.address}: at least {len(bad)} of {frames} frames cannot be read, the first being "
                f"{bad[0]}; look at it with: ecslam check"
            )
        if self.tally.none_usable(frames):
            self.require_frames()

    def warm_up(self) -> None:
        """Load what takes seconds before there is a frame, so that a camera's first one does not grow old meanwhile."""
        if self.live is not None and self.slam is None:
            self._build(None, None)
            self.notice("info", HOLD_STILL)
        elif self.config.realtime:
            import_slam()

    def end_live(self) -> None:
        """Switch the camera off, where there is one, and tell what went wrong with it."""
        if self.live is not None:
            self.live.close()
            self.folder.write("run.json", read_about(self.folder.path) | {"frames_total": len(self.plan.sequence)})
            if self.live.trouble:
                self.warn(self.live.trouble)

    def require_frames(self) -> None:
        """Raises InputError when no frame so far could be used."""
        if self.live is not None and self.live.trouble and not self.tally.position:
            raise InputError(self.live.trouble)
        if not self.tally.rows:
            raise InputError(
                f"{self.plan.address}: none of {self.tally.position} frames could be used, the first because: "
                f"{self.tally.first_skip}; look at it with: ecslam check"
            )

    def _record(self, report: StepReport, frame: Frame) -> None:
        self.tally.add(report)
        self.report = report
        self.lost_for = self.lost_for + 1 if report.lost else 0
        if report.window and report.losses:
            self.map_loss = sum(report.losses.values())
        if len(self.tally.rows) % ATE_EVERY == 0:
            self.measure()
        if report.is_keyframe:
            self.folder.keyframe(report.frame, report.c2w, jpeg(shrink(frame.color, THUMBNAIL_WIDTH)))
        ate_cm = self.truth.ate_cm
        self.folder.metrics(report, ate_cm.rmse if ate_cm else None, self._window_poses(report))
        if report.loop is not None:
            self.loops.append(report.loop)
            self.folder.event(report.loop)
            self._emit(report.loop)
        if report.note in GOOD_NEWS:
            self.notice("info", report.note, report.frame)
        elif report.note and self.lost_for <= 1:
            lacking = "" if report.tracked else lacking_depth(frame.depth, self._used_m)
            self.warn(f"{report.note} ({lacking})" if lacking else report.note, report.frame)
        if self._checkpoints.due(self.tally.position):
            self.checkpoint()
        if self._writing.due():
            self.write_trajectory()
        if self._tidying.due():
            return_holes()

    @property
    def _used_m(self) -> tuple[float, float]:
        return self.config.depth_near_m, self.config.depth_far_m

    def configure(self, config: Config) -> None:
        """Other tracking and mapping settings from the next frame on; ``config.yaml`` holds the newest ones."""
        self.config = config
        self.folder.write("config.yaml", config_files.to_yaml(config))
        if self.slam is not None:
            self.slam.configure(config)

    def notice(self, level: str, text: str, frame: int | None = None) -> None:
        """Tell the world something, and the log."""
        notice = Notice(level, text, frame)
        self.folder.event(notice)
        self._emit(notice)

    def warn(self, text: str, frame: int | None = None) -> None:
        """Tell the world what a person should know, and keep it for the summary."""
        self.notice("warning", text, frame)
        if len(self.tally.warnings) < MOST_WARNINGS:
            self.tally.warnings.append(text if frame is None else f"frame {frame}: {text}")

    # ---- what there is so far ---------------------------------------------------------------------------------------

    @property
    def picture(self) -> NDArray[np.uint8] | None:
        """The current frame, small; None before the first."""
        return None if self._color is None else shrink(self._color, PICTURE_WIDTH)

    def poses(self) -> NDArray[np.float64]:
        """Poses [n, 4, 4] of the processed frames; the frame of a torn step is left out."""
        if self.slam is None:
            return np.empty((0, 4, 4))
        return self.slam.trajectory.poses()[: len(self.tally.rows)]

    def timestamps(self) -> NDArray[np.float64]:
        """[n] seconds of the processed frames."""
        return np.array(self.slam.trajectory.timestamps[: len(self.tally.rows)] if self.slam else [], np.float64)

    def measure(self) -> None:
        """Bring the ATE up to date."""
        self.truth.measure(self.poses(), self.tally)

    def freeze(self, points: int = MESH_POINTS) -> FrozenMap | None:
        """The map as it is now, with about so many measured points at most; None before there is one."""
        if self.slam is None or self.slam.field is None:
            return None
        sdf, color = self.slam.query()
        return FrozenMap(max(self.tally.position - 1, 0), sdf, color, self.slam.surface_points(points))

    def keyframe_poses(self) -> tuple[list[int], NDArray[np.float64]]:
        """Frame indices and poses [k, 4, 4] of the keyframes."""
        poses, frames = self.poses(), self.tally.keyframes
        return frames, poses[np.searchsorted(self.tally.rows, frames)]

    def _window_poses(self, report: StepReport) -> NDArray[np.float64]:
        return self.poses()[np.searchsorted(self.tally.rows, report.window)] if report.window else np.empty((0, 4, 4))

    # ---- saving -----------------------------------------------------------------------------------------------------

    def checkpoint(self, finished: bool = False) -> None:
        """Start saving everything that ``resume`` needs."""
        if self.slam is not None and not self.torn:
            slam = self.slam
            self._checkpoints.save(lambda: self._everything(slam, finished))

    def _everything(self, slam: SlamLike, finished: bool) -> Checkpoint:
        self.tally.wall_s = self.clock.seconds
        meta = {
            "sequence": self.plan.address,
            "frames": self.plan.frames,
            "config": config_files.to_dict(self.config),
            "tally": self.tally.to_json(),
            "finished": finished,
        }
        return Checkpoint(self.tally.position, slam.state(), meta)

    def write_trajectory(self) -> None:
        """Bring ``trajectory.txt`` up to date."""
        self.folder.write("trajectory.txt", format_tum(self.timestamps(), self.poses()))

    def end(self, complete: bool, interrupt: Callable[[], None]) -> None:
        """Make the poses final (the last mapping, when ``complete`` and not torn) and save them. Stops the clock.

        A last mapping that ``interrupt`` abandons leaves the map half-way: no checkpoint holds it, and ``resume`` makes
        it from the one before. Raises what else ended it, after the poses are saved.
        """
        try:
            if complete and self.slam is not None and self.tally.rows and not self.torn and not self._settled:
                self.slam.finish(self._counted(interrupt))
        except Abandoned:
            complete, self.torn = False, True
        except Exception:
            self.torn = True
            raise
        finally:
            self._save_final(complete)

    def _save_final(self, complete: bool) -> None:
        self.clock.pause()
        self.tally.wall_s = self.clock.seconds
        self.measure()
        self.write_trajectory()
        self.checkpoint(finished=complete)
        self._checkpoints.wait()

    def _counted(self, interrupt: Callable[[], None]) -> Callable[[], None]:
        """``interrupt`` for the last mapping, which also says how far that is (not on a GPU, where an iteration has no
        call of its own)."""
        mapping, done = self.config.mapping, 0
        total = mapping.iterations + mapping.final_iterations

        def counted() -> None:
            nonlocal done
            done += 1
            how_far = f" {done}/{total}" if self.plan.device == "cpu" else ""
            self.last_mapping = f"Last mapping{how_far}; Stop leaves out the rest"
            interrupt()

        return counted

    def close(self, ended: str, error: str, export_s: float) -> dict[str, Any]:
        """Write ``summary.json`` and close the logs; the summary comes back, and says too where that failed. ``end``
        has been called before. ended: ``finished``, ``stopped`` before its last frame, ``interrupted`` (``resume`` can
        go on) or ``failed``, with error as the reason."""
        summary = summarise(self, ended, error, export_s)
        self.folder.write("summary.json", summary)
        self.folder.close()
        return summary | {"not_saved": dict(self.folder.not_saved)}
