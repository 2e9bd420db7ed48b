"""EC-SLAM on one screen: ``Slam.step`` takes a frame through the whole method.

Synchronous at heart. In the ``strict`` schedule mapping runs inline (deterministic on a CPU); in ``overlap`` the same
function runs on a second thread, as in the paper, and its result is applied between frames.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from . import kernels as seam
from .align import LearnedSurface, Surface
from .config import Config
from .field import TsdfField, box_of_points, create_field
from .indices import evenly
from .kernels.graphs import Recorder
from .keyframes import Keyframe, Shelf, make_keyframe, make_thumbnail, most_similar
from .loops import LoopDetector, loop_event
from .mapper import Mapper, MapResult
from .messages import LoopEvent, StepReport
from .observed import ObservedVoxels
from .observed_gpu import ObservedTable
from .pixels import Pixels, spread_pixels
from .recovery import Recovery, around, best_start, search
from .samples import seeded
from .saving import Arrays, pack_keyframes, pack_random, part, prefixed, unpack_keyframes, unpack_random
from .tracker import LEAST_POINTS, HostTracker, Tracker, TrackResult, track_direct
from .trajectory import Trajectory
from .types import Frame, FrameError, Intrinsics
from .views import ColorQuery, SdfQuery, queries, render_view
from .volume import FusedVolume, create_volume
from .window import random_window, select_window

Interrupt = Callable[[], None]
LEAST_SHARE = 0.1
RELOCALISE_FROM = 5
GAP_S = 1.0
OUTSIDE_SHARE = 0.01
BOX_POINTS = 8192  # of a keyframe, looked at to see whether the box holds them
RELOCALISE_KERNELS_M = (0.2, 0.06, 0.02)
SETTLE_RAYS = 4  # at least so many for each keyframe in an iteration


@dataclass(frozen=True)
class Landed:
    """What mappings brought that were applied since the last report. window: the keyframes of the last one, as frame
    indices; losses: its terms, None without any; beside_s: seconds that they took beside tracking."""

    window: tuple[int, ...] = ()
    losses: dict[str, float] | None = None
    beside_s: float = 0.0


class Slam:
    """The engine: feed it frames, read its trajectory and field. See the paper's figure 2."""

    def __init__(
        self,
        config: Config,
        intrinsics: Intrinsics,
        *,
        device: torch.device | None = None,
        bounds: NDArray[np.float64] | None = None,
        first_pose: NDArray[np.float64] | None = None,
    ) -> None:
        """bounds: scene box [2, 3] metres, derived from the first frame when None. first_pose: c2w [4, 4] of the first
        frame, the identity when None; it stays fixed."""
        self.config, self.intrinsics = config, intrinsics
        self.device = device or torch.device("cpu")
        self._on_cpu = self.device.type == "cpu"
        self.kernels_name, self._kernels, self.kernels_note = seam.select(self.device)
        self._recorder = self._new_recorder()
        self.trajectory = Trajectory()
        self.keyframes: list[Keyframe] = []
        self._shelf = Shelf()
        self.mapper: Mapper | None = None
        self._first_pose = np.eye(4) if first_pose is None else np.array(first_pose, np.float64)
        box = config.field.box
        self._bounds = bounds if box is None else np.array(box, np.float64).reshape(2, 3)
        self._rng = np.random.default_rng(config.seed)
        self._generator = torch.Generator().manual_seed(config.seed)
        lengths, fused = (config.align.voxel_m, config.truncation_m), config.align.to == "fused"
        self._volume = create_volume(self.kernels_name, *lengths, self.device, self._recorder) if fused else None
        self._observed: ObservedVoxels | ObservedTable = ObservedVoxels()
        self._gpu_tracker: Tracker | None = None
        if self.kernels_name == "gpu" and fused:
            self._observed, self._gpu_tracker = self._on_gpu()
        self._trained = 0
        self._loops, self._recovery = LoopDetector(), Recovery()
        self._pool = ThreadPoolExecutor(1, "mapper") if config.schedule == "overlap" else None
        self._pending: Future[tuple[MapResult, float]] | None = None
        self._landed = Landed()
        self._window: NDArray[np.int64] = np.empty(0, np.int64)
        self._frozen: TsdfField | None = None
        self._note, self._outside, self._graphs_failed = "", 0.0, False

    def _on_gpu(self) -> tuple[ObservedTable, Tracker]:
        from .tracker_gpu import GpuTracker

        assert not isinstance(self._volume, FusedVolume | None)
        observed = ObservedTable(self.device)
        generator = seeded(self._rng, self.device)
        follow = GpuTracker(self.intrinsics, self._volume, observed, self._kernels, generator, self._recorder)
        return observed, follow

    # ---- one frame --------------------------------------------------------------------------------------------------

    def step(self, frame: Frame, interrupt: Interrupt | None = None) -> StepReport:
        """Track the frame; every n-th frame, map. Raises whatever ``interrupt`` raises, called inside long loops."""
        if self.mapper is None:
            return self._first_frame(frame, interrupt)
        started = time.perf_counter()
        self._apply_pending(block=False)
        track = self._track(frame)
        index, lost = len(self.trajectory), self._recovery.lost
        keyframe = index % self.config.keyframe_every == 0 and not self._recovery.missed
        self.trajectory.append(track.c2w, frame.timestamp, keyframe)
        if not self._recovery.missed:
            self._fuse(frame)
        tracked, loop, waited_s = time.perf_counter(), None, 0.0
        if keyframe:
            keyframe_now = make_keyframe(frame, self.intrinsics, self.config)
            self.keyframes.append(self._shelf.keep(keyframe_now))
        if keyframe and index % self.config.mapping.every < self.config.keyframe_every:
            waited_s = self._apply_pending(block=True)
            loop = self._map(frame.index, interrupt)
        landed, self._landed = self._landed, Landed()
        return StepReport(
            frame=frame.index,
            timestamp=frame.timestamp,
            c2w=self.trajectory[-1],
            tracked=not self._recovery.missed,
            lost=lost,
            is_keyframe=keyframe,
            window=landed.window,
            losses=track.losses if landed.losses is None else landed.losses,
            track_ms=1e3 * (tracked - started),
            map_ms=1e3 * (time.perf_counter() - tracked - waited_s + landed.beside_s),
            loop=loop,
            note=self._recovery.note or self._take_note(),
        )

    def _first_frame(self, frame: Frame, interrupt: Interrupt | None) -> StepReport:
        started = time.perf_counter()
        keyframe = make_keyframe(frame, self.intrinsics, self.config)
        share = len(keyframe.pixels.points()) / (self.config.keyframe_share * frame.depth.size)
        if share < LEAST_SHARE:
            raise FrameError(
                f"frame {frame.index}: {share:.1%} of it has usable depth, too little to start the map with"
            )
        box = self._bounds
        if box is None:
            box = box_of_points(_world(keyframe.pixels, self._first_pose), self.config.field.box_margin_m)
        field = create_field(self.config.field, box, self.config.seed, self.device)
        self.mapper = Mapper(field, self._kernels, self.config.seed, self._new_recorder())
        self._frozen = field
        self.trajectory.append(self._first_pose, frame.timestamp, keyframe=True)
        self.keyframes.append(self._shelf.keep(keyframe))
        self._window = np.array([0])
        try:
            result = self._optimise(np.array([0]), self.config.mapping.first_iterations, interrupt)
        except BaseException:
            self.mapper = self._frozen = None
            self.trajectory, self.keyframes = Trajectory(), []
            raise
        self._apply(result)
        self._landed = Landed()
        self._fuse(frame)
        return StepReport(
            frame=frame.index,
            timestamp=frame.timestamp,
            c2w=self.trajectory[-1],
            tracked=True,
            lost=False,
            is_keyframe=True,
            window=(frame.index,),
            losses=result.losses,
            track_ms=0.0,
            map_ms=1e3 * (time.perf_counter() - started),
        )

    def finish(self, interrupt: Interrupt | None = None) -> None:
        """The last mapping, with the smoothness term (paper: "at the last image frame"), then the map alone on all
        keyframes (ours); call it once, at the end. Raises whatever ``interrupt`` raises; no pose has moved then, or
        all have come to rest."""
        self._apply_pending(block=True)
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
        if self.mapper is not None and not self._recovery.lost:
            self._window = self._choose_window()
            self._apply(self._optimise(self._window, self.config.mapping.iterations, interrupt, smooth=True))
            self._settle(interrupt)

    def _settle(self, interrupt: Interrupt | None) -> None:
        """Every part of the map gets its last iterations at a falling rate, not only what the last windows saw."""
        assert self.mapper is not None
        mapping = replace(self.config.mapping, newest_share=0.0, loss=self.config.mapping.final_loss)
        rows = evenly(len(self.keyframes), mapping.rays // SETTLE_RAYS)
        views, poses = [self.keyframes[i].pixels for i in rows], self.trajectory.keyframe_poses()[rows]
        fixed, config = np.ones(len(rows), bool), replace(self.config, mapping=mapping)
        self.mapper.run(views, poses, fixed, mapping.final_iterations, config, interrupt, settle=True)

    # ---- tracking ---------------------------------------------------------------------------------------------------

    def _track(self, frame: Frame) -> TrackResult:
        """Constant-velocity start, the preset's tracker, and recovery when the map does not explain the frame."""
        gap = frame.timestamp - self.trajectory.timestamps[-1] > GAP_S
        guess = self.trajectory[-1] if self._recovery.lost or gap else self.trajectory.predict()
        field, config, tracker = self._require_field(), self.config, self._tracker()
        track = best_start(lambda start: tracker.track(frame, start, field, config), around(guess) if gap else [guess])
        return self._recovery.judge(track, self.trajectory[-1], lambda: self._relocalise(frame))

    def _tracker(self) -> Tracker:
        if self.config.tracking.iterations > 0:
            self._see()
        if self._gpu_tracker is not None:
            return self._gpu_tracker
        assert isinstance(self._observed, ObservedVoxels)
        generator = self._generator if self._on_cpu else None
        return HostTracker(
            self.intrinsics, self._surface(), self._observed, self._kernels, self._rng, generator, self._recorder
        )

    def _see(self) -> None:
        """Bring up to date where the map has been observed."""
        for view in range(self._observed.views, self._trained):
            pose = self.trajectory.keyframe_poses()[view]
            self._observed.add(self.keyframes[view].pixels.points(), pose)

    def _surface(self) -> Surface:
        return self._volume if self._volume is not None else self._learned()

    def _learned(self) -> LearnedSurface:
        self._see()
        assert isinstance(self._observed, ObservedVoxels)
        return LearnedSurface(self._require_field(), self._kernels, self.config.truncation_m, self._observed)

    def _fuse(self, frame: Frame) -> None:
        if self._volume is not None:
            near, far = self.config.depth_near_m, self.config.depth_far_m
            self._volume.integrate(frame, self.intrinsics, self.trajectory[-1], near, far)

    def _relocalise(self, frame: Frame) -> TrackResult | None:
        """Direct alignment with a wide basin from the last pose, the keyframes that look most alike, and the poses that
        a search around these finds; None where hardly anything is measured."""
        measured = spread_pixels(frame, self.intrinsics, self.config.align.points, self.config, self._rng)
        if len(measured.points()) < LEAST_POINTS:
            return None
        poses, surface = self.trajectory.keyframe_poses(), self._surface()
        alike = most_similar(self.keyframes, make_thumbnail(frame.color), RELOCALISE_FROM)
        wide = replace(self.config, align=replace(self.config.align, kernels_m=RELOCALISE_KERNELS_M, iterations=20))
        starts = np.stack([self.trajectory[-1], *(poses[i] for i in alike)])
        rng = np.random.default_rng([self.config.seed, frame.index])
        found = search(surface, measured.points(), starts, self.config.truncation_m, rng)
        return best_start(lambda start: track_direct(surface, measured, start, wide), [*starts, *found])

    # ---- mapping ----------------------------------------------------------------------------------------------------

    def _map(self, frame: int, interrupt: Interrupt | None) -> LoopEvent | None:
        """Window, joint optimisation, and an event when old keyframes come back. In ``overlap`` the optimisation runs
        on while tracking goes on, except when a loop closes."""
        self._grow_box()
        self._window = self._choose_window()
        old = self._loops.update(self.trajectory.keyframe_poses(), self.trajectory[-1])
        if self._pool is not None and len(old) == 0:
            self._pending = self._pool.submit(self._optimise_beside, self._window, self.config.mapping.iterations)
            return None
        centres, before = self.trajectory.poses()[:, :3, 3].astype(np.float32), self.trajectory[-1]
        result = self._optimise(self._window, self.config.mapping.iterations, interrupt)
        self._apply(result)
        if len(old) == 0:
            return None
        met, after = tuple(self.keyframes[i].frame for i in old), sum(result.losses.values())
        return loop_event(frame, met, before, self.trajectory[-1], result.loss_first, after, centres)

    def _optimise_beside(self, window: NDArray[np.int64], iterations: int) -> tuple[MapResult, float]:
        """``_optimise`` on the second thread, and the seconds that it took."""
        began = time.perf_counter()
        result = self._optimise(window, iterations, None)
        return result, time.perf_counter() - began

    def _optimise(
        self, window: NDArray[np.int64], iterations: int, interrupt: Interrupt | None, smooth: bool = False
    ) -> MapResult:
        assert self.mapper is not None
        views = [self.keyframes[i].pixels for i in window]
        poses = self.trajectory.keyframe_poses()[window]
        return self.mapper.run(views, poses, window == 0, iterations, self.config, interrupt, smooth)

    def _choose_window(self) -> NDArray[np.int64]:
        poses, rays = self.trajectory.keyframe_poses(), self.config.mapping.rays
        if self.config.eba:
            return select_window(poses, poses[-1], rays, self.config.window)
        return random_window(len(poses), rays, self.config.window, self._rng)

    def _take_note(self) -> str:
        note, self._note = self._note, ""
        for recorder in (self._recorder, self.mapper.recorder if self.mapper else self._recorder):
            if recorder.failure and not self._graphs_failed:
                self._graphs_failed, note = True, note or recorder.failure
        return note

    def _new_recorder(self) -> Recorder:
        return Recorder(plain=self.kernels_name != "gpu")

    def _apply(self, result: MapResult, beside_s: float = 0.0) -> None:
        frames = tuple(self.keyframes[i].frame for i in self._window)
        self._landed = Landed(frames, result.losses, self._landed.beside_s + beside_s)
        if result.failed:
            self._note = "the mapping diverged and was undone"
            return
        self._trained = max(
            len(self.keyframes) - 1, 1
        )  # the surface that these saw has been through two mappings by now
        self.trajectory.move_keyframes(self._window, result.c2w)
        self._frozen = self._tracking_field()

    def _apply_pending(self, block: bool) -> float:
        """Apply what the second thread has made; the seconds that were waited for it."""
        if self._pending is None or not (block or self._pending.done()):
            return 0.0
        began = time.perf_counter()
        (result, took_s), self._pending = self._pending.result(), None
        waited_s = time.perf_counter() - began
        self._apply(result, took_s)
        return waited_s

    def _tracking_field(self) -> TsdfField:
        assert self.mapper is not None
        return self.mapper.field if self._pool is None else self.mapper.field.freeze(self._frozen)

    # ---- keyframes, box, views --------------------------------------------------------------------------------------

    def _grow_box(self) -> None:
        """Extend the scene box when over 1 % of the newest keyframe's points lie outside it; one from the configuration
        stays, and a note says how many."""
        assert self.mapper is not None
        pixels = self.keyframes[-1].pixels
        points = _world(pixels.take(evenly(len(pixels), BOX_POINTS)), self.trajectory[-1])
        low, high = self.mapper.field.layout.box.numpy()
        outside = ((points < low) | (points > high)).any(1).mean() if len(points) else 0.0
        if self.config.field.box is None and outside > OUTSIDE_SHARE:
            self.mapper.grow(box_of_points(points, self.config.field.box_margin_m))
        elif outside > max(OUTSIDE_SHARE, 2 * self._outside):
            self._outside = outside
            self._note = f"{outside:.0%} of the rays end outside field.box and are not mapped; widen it or leave it out"

    def surface_points(self, limit: int) -> NDArray[np.float32]:
        """Measured points [N, 3] of all keyframes in the world, where the map has been observed: about ``limit`` of
        them where there are more."""
        poses = self.trajectory.keyframe_poses()
        stride = max(1, -(-sum(map(len, self.keyframes)) // limit))
        thinned = [k.pixels.take(np.arange(0, len(k), stride)) for k in self.keyframes]
        parts = [_world(pixels, pose) for pixels, pose in zip(thinned, poses, strict=True)]
        return np.concatenate(parts) if parts else np.empty((0, 3), np.float32)

    @property
    def field(self) -> TsdfField | None:
        """The map, or None before the first frame's mapping has begun."""
        return self.mapper.field if self.mapper else None

    def query(self) -> tuple[SdfQuery, ColorQuery]:
        """Callables over a frozen copy of the map, safe to use from another thread."""
        return queries(self._require_field().freeze(), self._kernels)

    def render(
        self, c2w: NDArray[np.float64], depth: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """The map's colour uint8 [h, w, 3] and depth [h, w] from c2w [4, 4], at the size of ``depth`` [h, w]."""
        camera = self.intrinsics.resized(depth.shape[1], depth.shape[0])
        return render_view(self._require_field(), self._kernels, camera, c2w, depth, self.config)

    def configure(self, config: Config) -> None:
        """Change tracking and mapping settings from the next frame on; the field and the volume keep their shape.

        Raises InputError where the settings contradict those that are kept."""
        self._apply_pending(block=True)
        kept = self.config
        shape = replace(config.align, to=kept.align.to, voxel_m=kept.align.voxel_m)
        self.config = replace(config, field=kept.field, schedule=kept.schedule, seed=kept.seed, align=shape)

    def state(self) -> Arrays:
        """Everything that ``restore`` needs, as arrays nobody writes to afterwards."""
        self._apply_pending(block=True)
        assert self.mapper is not None
        return {
            **prefixed("trajectory", self.trajectory.state()),
            **prefixed("keyframes", pack_keyframes(self.keyframes)),
            **prefixed("mapper", self.mapper.state()),
            **prefixed("random", pack_random(self._rng, self._generator)),
            "bounds": np.zeros((0, 3)) if self._bounds is None else self._bounds,
            **prefixed("observed", self._observed.state() | {"trained": np.array(self._trained)}),
            **prefixed("volume", self._volume.state() if self._volume is not None else {}),
            "inside_loop": np.array(self._loops.inside),
            "lost": np.array([self._recovery.lost, self._recovery.misses, self._recovery.usual_fit]),
        }

    @classmethod
    def restore(
        cls, config: Config, intrinsics: Intrinsics, state: Arrays, *, device: torch.device | None = None
    ) -> Slam:
        """An engine that goes on where ``state`` was taken."""
        bounds = state["bounds"] if len(state["bounds"]) else None
        self = cls(config, intrinsics, device=device, bounds=bounds)
        self.trajectory = Trajectory.restore(part("trajectory", state))
        self.keyframes = unpack_keyframes(part("keyframes", state))
        self.mapper = Mapper.restore(part("mapper", state), self._kernels, self.device, self._new_recorder())
        self._frozen = self._tracking_field()
        unpack_random(part("random", state), self._rng, self._generator)
        self._observed.load(part("observed", state))
        self._trained = int(state["observed.trained"])
        if self._volume is not None:
            self._volume.load(part("volume", state))
        self._loops.inside = bool(state["inside_loop"])
        recovery, (lost, misses, usual_fit) = self._recovery, state["lost"]
        recovery.lost, recovery.misses, recovery.usual_fit = bool(lost), int(misses), float(usual_fit)
        return self

    def _require_field(self) -> TsdfField:
        assert self._frozen is not None
        return self._frozen


def _world(pixels: Pixels, c2w: NDArray[np.float64]) -> NDArray[np.float32]:
    return (pixels.points() @ c2w[:3, :3].T + c2w[:3, 3]).astype(np.float32)
