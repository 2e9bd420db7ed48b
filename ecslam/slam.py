"""EC-SLAM on one screen: ``Slam.step`` takes a frame through the whole method.

Synchronous at heart. In the ``strict`` schedule mapping runs inline (deterministic on a CPU); in ``overlap`` the same
function runs beside tracking, as in the paper, on a second thread or in a second stream of a GPU, and its result is
applied between frames.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from . import kernels as seam
from .beside import Beside, Mapped
from .config import Config
from .denoising import denoised
from .field import TsdfField, create_field
from .following import Follower
from .indices import evenly
from .kernels.denormals import flushed
from .kernels.graphs import Recorder
from .keyframes import Keyframe, Shelf, make_keyframe, surface_points
from .loops import LoopDetector, loop_event
from .mapper import Mapper, Mapping
from .messages import MOVING, LoopEvent, StepReport
from .rigid import is_rigid, orthonormalise
from .saving import Arrays, pack_keyframes, pack_random, part, prefixed, unpack_keyframes, unpack_random
from .scene_box import SceneBox
from .shutter import STILL
from .trajectory import Trajectory
from .types import Frame, FrameError, InputError, Intrinsics
from .views import ColorQuery, SdfQuery, queries, render_view
from .window import random_window, select_window

Interrupt = Callable[[], None]
LEAST_SHARE = 0.1
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
        frame, the identity when None; it stays fixed. Raises InputError where that is no rigid motion."""
        self.config, self.intrinsics = config, intrinsics
        self.device = device or torch.device("cpu")
        self.kernels_name, self._kernels, self.kernels_note = seam.select(self.device)
        self.trajectory = Trajectory()
        self.keyframes: list[Keyframe] = []
        self._shelf = Shelf()
        self.mapper: Mapper | None = None
        self._first_pose = np.eye(4) if first_pose is None else np.array(first_pose, np.float64)
        if not is_rigid(self._first_pose):
            raise InputError("first_pose is no 4x4 matrix of a rigid motion, from the camera to the world in metres")
        self._first_pose = orthonormalise(self._first_pose)
        self._box = SceneBox(config.field, bounds)
        self._rng = np.random.default_rng(config.seed)
        self._generator = torch.Generator().manual_seed(config.seed)
        self._follower = Follower(
            config, intrinsics, self.device, self.kernels_name, self._kernels, self._rng, self._generator
        )
        self._loops = LoopDetector()
        overlap = config.schedule == "overlap" or (config.schedule == "auto" and self.device.type == "cuda")
        self._beside = Beside(self.device) if overlap else None
        self._landed = Landed()
        self._frozen: TsdfField | None = None
        self._note, self._graphs_failed, self._moving = "", False, False

    # ---- one frame --------------------------------------------------------------------------------------------------

    @flushed()
    def step(self, frame: Frame, interrupt: Interrupt | None = None, then: Frame | None = None) -> StepReport:
        """Track the frame; every n-th frame, map. then: the next frame, where it is known already. Raises FrameError
        for one that is not of this camera, and whatever ``interrupt`` raises, called inside long loops."""
        frame.require_fit(self.intrinsics)
        frame = denoised(frame, self.config)
        if self.mapper is None:
            return self._first_frame(frame, interrupt)
        started = time.perf_counter()
        self._apply_pending(block=False)
        expected = self._follower.expected(frame, self.trajectory)
        seen, frame = self._follower.looked_at(frame, expected, self.trajectory, self.config)
        if frame is not seen and not self._moving:
            self._note = MOVING
        self._moving = frame is not seen
        given = self.trajectory, self.keyframes, self._require_field(), self.config
        track = self._follower.follow(frame, expected, *given, then)
        index, recovery = len(self.trajectory), self._follower.recovery
        keyframe = index % self.config.keyframe_every == 0 and not recovery.missed
        self.trajectory.append(track.c2w, frame.timestamp, keyframe)
        sweep = self._follower.sweep(self.trajectory, self.config)
        if not recovery.missed:
            self._follower.fuse(frame, self.trajectory[-1], sweep, self.config)
        tracked, loop, waited_s = time.perf_counter(), None, 0.0
        if keyframe:
            keyframe_now = make_keyframe(frame, self.intrinsics, self.config)
            self.keyframes.append(self._shelf.keep(keyframe_now.straight(self.intrinsics, sweep)))
            self._follower.remember(frame, len(self.keyframes) - 1)
        if keyframe and self._mapping_is_due():
            waited_s = self._apply_pending(block=True)
            loop = self._map(frame.index, interrupt)
        landed, self._landed = self._landed, Landed()
        now = time.perf_counter()
        return StepReport(
            frame=frame.index,
            timestamp=frame.timestamp,
            c2w=self.trajectory[-1],
            tracked=not recovery.missed,
            lost=recovery.lost,
            is_keyframe=keyframe,
            window=landed.window,
            losses=track.losses if landed.losses is None else landed.losses,
            track_ms=1e3 * (tracked - started),
            map_ms=1e3 * (now - tracked - waited_s + landed.beside_s),
            step_ms=1e3 * (now - started),
            loop=loop,
            note=recovery.note or self._take_note(),
        )

    def _first_frame(self, frame: Frame, interrupt: Interrupt | None) -> StepReport:
        started = time.perf_counter()
        keyframe = make_keyframe(frame, self.intrinsics, self.config)
        share = len(keyframe.pixels.points()) / (self.config.keyframe_share * frame.depth.size)
        if share < LEAST_SHARE:
            raise FrameError(
                f"frame {frame.index}: {share:.1%} of it has usable depth, too little to start the map with"
            )
        box = self._box.first(keyframe.pixels, self._first_pose)
        field = create_field(self.config.field, box, self.config.seed, self.device)
        self.mapper = Mapper(field, self._kernels, self.config.seed, self._new_recorder())
        self._frozen = field
        self.trajectory.append(self._first_pose, frame.timestamp, keyframe=True)
        self.keyframes.append(self._shelf.keep(keyframe))
        try:
            mapped = self._optimise(np.array([0]), self.config.mapping.first_iterations, interrupt)
        except BaseException:
            self.mapper = self._frozen = None
            self.trajectory, self.keyframes = Trajectory(), []
            raise
        self._apply(mapped)
        self._landed = Landed()
        self._follower.fuse(frame, self.trajectory[-1], STILL, self.config)
        self._follower.remember(frame, 0)
        took_ms = 1e3 * (time.perf_counter() - started)
        return StepReport(
            frame=frame.index,
            timestamp=frame.timestamp,
            c2w=self.trajectory[-1],
            tracked=True,
            lost=False,
            is_keyframe=True,
            window=(frame.index,),
            losses=mapped.result.losses,
            track_ms=0.0,
            map_ms=took_ms,
            step_ms=took_ms,
        )

    @flushed()
    def finish(self, interrupt: Interrupt | None = None) -> None:
        """The last mapping, with the smoothness term (paper: "at the last image frame"), then the map alone on all
        keyframes (ours); call it once, at the end. Raises whatever ``interrupt`` raises; no pose has moved then, or
        all have come to rest."""
        self._apply_pending(block=True)
        if self._beside is not None:
            self._beside.close()
            self._beside = None
        if self.mapper is not None and not self._follower.recovery.lost:
            self._apply(self._optimise(self._choose_window(), self.config.mapping.iterations, interrupt, smooth=True))
            self._settle(interrupt)

    def _settle(self, interrupt: Interrupt | None) -> None:
        """Every part of the map gets its last iterations at a falling rate, not only what the last windows saw."""
        assert self.mapper is not None
        mapping = replace(self.config.mapping, newest_share=0.0, loss=self.config.mapping.final_loss)
        rows = evenly(len(self.keyframes), mapping.rays // SETTLE_RAYS)
        views, poses = [self.keyframes[i].pixels for i in rows], self.trajectory.keyframe_poses()[rows]
        fixed, config = np.ones(len(rows), bool), replace(self.config, mapping=mapping)
        self.mapper.begin(views, poses, fixed, mapping.final_iterations, config, interrupt, settle=True).result()

    # ---- mapping ----------------------------------------------------------------------------------------------------

    def _map(self, frame: int, interrupt: Interrupt | None) -> LoopEvent | None:
        """Window, joint optimisation, and an event when old keyframes come back. In ``overlap`` the optimisation goes
        on while tracking does, except when a loop closes."""
        self._check_box()
        window, iterations = self._choose_window(), self.config.mapping.iterations
        old = self._loops.update(self.trajectory.keyframe_poses(), self.trajectory[-1])
        if self._beside is not None and len(old) == 0:
            self._beside.begin(window, partial(self._begin, window, iterations))
            return None
        before = self.trajectory.poses() if len(old) else None
        mapped = self._optimise(window, iterations, interrupt)
        self._apply(mapped)
        if before is None:
            return None
        met, result = tuple(self.keyframes[i].frame for i in old), mapped.result
        after = sum(result.losses.values())
        centres = before[:, :3, 3].astype(np.float32)
        return loop_event(frame, met, before[-1], self.trajectory[-1], result.loss_first, after, centres)

    def _mapping_is_due(self) -> bool:
        """Counted in keyframes, for those that were missed put nothing off by a whole period."""
        every = self.config.keyframe_every
        return (len(self.keyframes) - 1) * every % self.config.mapping.every < every

    def _check_box(self) -> None:
        assert self.mapper is not None
        box, pixels = self.mapper.field.layout.box.numpy(), self.keyframes[-1].pixels
        more, note = self._box.check(box, pixels, self.trajectory[-1])
        if more is not None:
            self.mapper.grow(more)
        self._note = note or self._note

    def _choose_window(self) -> NDArray[np.int64]:
        poses, rays = self.trajectory.keyframe_poses(), self.config.mapping.rays
        if self.config.eba:
            return select_window(poses, poses[-1], rays, self.config.window)
        return random_window(len(poses), rays, self.config.window, self._rng)

    def _optimise(
        self, window: NDArray[np.int64], iterations: int, interrupt: Interrupt | None, smooth: bool = False
    ) -> Mapped:
        return Mapped(window, self._begin(window, iterations, interrupt, smooth).result())

    def _begin(
        self, window: NDArray[np.int64], iterations: int, interrupt: Interrupt | None = None, smooth: bool = False
    ) -> Mapping:
        assert self.mapper is not None
        views = [self.keyframes[i].pixels for i in window]
        poses = self.trajectory.keyframe_poses()[window]
        return self.mapper.begin(views, poses, window == 0, iterations, self.config, interrupt, smooth)

    def _apply(self, mapped: Mapped, beside_s: float = 0.0) -> None:
        window, result = mapped.window, mapped.result
        frames = tuple(self.keyframes[i].frame for i in window)
        self._landed = Landed(frames, result.losses, self._landed.beside_s + beside_s)
        if result.failed:
            self._note = "the mapping diverged and was undone"
            return
        self._follower.trust(max(len(self.keyframes) - 1, 1))  # what these saw has been through two mappings by now
        self.trajectory.move_keyframes(window, result.c2w)
        self._frozen = self._tracking_field()

    def _apply_pending(self, block: bool) -> float:
        """Apply what was made beside tracking; the seconds that were waited for it."""
        taken = self._beside.take(block) if self._beside is not None else None
        if taken is None:
            return 0.0
        mapped, waited_s = taken
        self._apply(mapped, mapped.result.took_s)
        return waited_s

    def _tracking_field(self) -> TsdfField:
        assert self.mapper is not None
        return self.mapper.field if self._beside is None else self.mapper.field.freeze(self._frozen)

    def _new_recorder(self) -> Recorder:
        return Recorder(plain=self.kernels_name != "gpu")

    def _take_note(self) -> str:
        assert self.mapper is not None
        note, self._note = self._note, ""
        for recorder in (self._follower.recorder, self.mapper.recorder):
            if recorder.failure and not self._graphs_failed:
                self._graphs_failed, note = True, note or recorder.failure
        return note

    # ---- views and settings ------------------------------------------------------------------------------------------

    def surface_points(self, limit: int) -> Callable[[], NDArray[np.float32]]:
        """Measured points [N, 3] of all keyframes in the world, where the map has been observed by now: about ``limit``
        of them where there are more. Any thread may work them out, whenever it calls what is returned."""
        return partial(surface_points, tuple(self.keyframes), self.trajectory.keyframe_poses(), limit)

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
            "bounds": np.zeros((0, 3)) if self._box.given is None else self._box.given,
            "inside_loop": np.array(self._loops.inside),
            **self._follower.state(),
        }

    @classmethod
    @flushed()
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
        self._loops.inside = bool(state["inside_loop"])
        self._follower.load(state)
        return self

    def _require_field(self) -> TsdfField:
        assert self._frozen is not None
        return self._frozen
