"""Following the camera from frame to frame: the preset's tracker, and the way back when the map explains no frame."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from .align import LearnedSurface, Surface
from .config import Config
from .earlier import EarlierViews
from .exposure import as_at_first
from .field import TsdfField
from .kernels import Backend
from .kernels.graphs import Recorder
from .keyframes import Keyframe
from .movers import without_movers
from .observed import ObservedVoxels
from .observed_gpu import ObservedTable
from .recovery import SUDDEN_DEG, SUDDEN_M, Recovery, around, best, near
from .relocalisation import Relocalisation
from .samples import seeded
from .saving import Arrays, part, prefixed
from .shutter import STILL, Sweep, sweep_between
from .tracker import HostTracker, Tracker, TrackResult
from .trajectory import Trajectory
from .types import Frame, FrameError, Intrinsics
from .volume import FusedVolume, create_volume

if TYPE_CHECKING:
    from .tracker_gpu import GpuTracker

GAP_S = 1.0
SWEEP_OVER = 2  # frames: with fewer, what one is off by moves the next


class Expected(NamedTuple):
    """Where a frame is looked for. c2w: [4, 4]. known: whether the frames before tell; else it is where the last one
    was. gap: whether too much time has passed since that one."""

    c2w: NDArray[np.float64]
    known: bool
    gap: bool


class Follower:
    """Owns what tracking keeps: the fused volume, where the map has been observed, and how well it has gone so far."""

    def __init__(
        self,
        config: Config,
        camera: Intrinsics,
        device: torch.device,
        kernels_name: str,
        kernels: Backend,
        rng: np.random.Generator,
        generator: torch.Generator,
    ) -> None:
        """rng: for pixels. generator: on a CPU, for the samples along rays."""
        self._camera, self._kernels, self._rng = camera, kernels, rng
        self._generator = generator if device.type == "cpu" else None
        self.recorder = Recorder(plain=kernels_name != "gpu")
        self.recovery = Recovery()
        self._earlier, self._gain = EarlierViews(), 1.0
        lengths, fused = (config.align.voxel_m, config.truncation_m), config.align.to == "fused"
        self._volume = create_volume(kernels_name, *lengths, device, self.recorder) if fused else None
        self._observed: ObservedVoxels | ObservedTable = ObservedVoxels()
        self._gpu_tracker: GpuTracker | None = None
        if kernels_name == "gpu" and fused:
            self._observed = table = ObservedTable(device)
            self._gpu_tracker = self._on_gpu(table, seeded(rng, device))
        self._trusted = 0
        self._ahead: tuple[Frame, Frame, Frame] | None = None

    def _on_gpu(self, observed: ObservedTable, generator: torch.Generator) -> GpuTracker:
        from .tracker_gpu import GpuTracker

        assert not isinstance(self._volume, FusedVolume | None)
        return GpuTracker(self._camera, self._volume, observed, self._kernels, generator, self.recorder)

    def expected(self, frame: Frame, trajectory: Trajectory) -> Expected:
        """Where the frame after ``trajectory`` is likely to have been seen from, at constant velocity."""
        gap = frame.timestamp - trajectory.timestamps[-1] > GAP_S
        known = not (gap or self.recovery.lost)
        return Expected(trajectory.predict(frame.timestamp) if known else trajectory[-1], known, gap)

    def looked_at(
        self, frame: Frame, expected: Expected, trajectory: Trajectory, config: Config
    ) -> tuple[Frame, Frame]:
        """The frame as it is ``exposed``, and what of it is ``still``; this has been found already if it was announced
        while the one before was tracked."""
        ahead, self._ahead = self._ahead, None
        if ahead is not None and ahead[0] is frame and expected.known:
            return ahead[1:]
        seen = self.exposed(frame, expected, trajectory, config)
        return seen, self.still(seen, expected, trajectory, config)

    def exposed(self, frame: Frame, expected: Expected, trajectory: Trajectory, config: Config) -> Frame:
        """The frame with the gain that makes it as bright as if it were exposed as the first one, as the fused volume
        is; that of the frame before where it is not known what earlier keyframes saw of it."""
        if not config.exposure or self._volume is None:
            return frame
        if not expected.known:
            return replace(frame, gain=self._gain)
        known = self._earlier.asked, trajectory.keyframe_poses()
        frame = as_at_first(frame, self._camera, expected.c2w, *known, self._gain)
        self._gain = frame.gain
        return frame

    def still(self, frame: Frame, expected: Expected, trajectory: Trajectory, config: Config) -> Frame:
        """The frame without what moves by itself, where it is known what was there before."""
        if config.movers or not expected.known:
            return frame
        return without_movers(frame, self._camera, expected.c2w, self._earlier.asked, trajectory.keyframe_poses())

    def remember(self, frame: Frame, keyframe: int) -> None:
        """Keep what a frame saw that became the keyframe number ``keyframe``: what is new there later has come, and
        what is brighter there is exposed for longer."""
        self._earlier.remember(frame, keyframe)

    def follow(
        self,
        frame: Frame,
        expected: Expected,
        trajectory: Trajectory,
        keyframes: list[Keyframe],
        field: TsdfField,
        config: Config,
        then: Frame | None = None,
    ) -> TrackResult:
        """The pose of the frame after ``trajectory``: the preset's tracker on ``field``, starting where it is expected,
        and recovery when the map does not explain the frame, which then says whether it is only the last pose again.
        then: the next frame, to look at while a GPU tracks this one."""
        if config.tracking.iterations > 0 or self._volume is None:
            self._observe(trajectory, keyframes)
        surface, tracker = self._tracker(field, config)
        sweep = self.sweep(trajectory, config) if expected.known else STILL
        starts = around(expected.c2w) if expected.gap else [expected.c2w]
        tracking = tracker.begin(frame, starts[0], field, config, sweep)
        if then is not None and self._gpu_tracker is not None:
            with suppress(FrameError):  # that is for when its turn comes
                then.require_fit(self._camera)
                soon = Expected(trajectory.predict(then.timestamp), True, False)
                self._ahead = (then, *self.looked_at(then, soon, trajectory, config))
        others = (tracker.begin(frame, start, field, config, sweep).result() for start in starts[1:])
        track = best([tracking.result(), *others])
        elsewhere = Relocalisation(frame, self._camera, surface, trajectory, keyframes, config, self._rng)
        return self.recovery.judge(track, trajectory[-1], elsewhere, expected.gap)

    def sweep(self, trajectory: Trajectory, config: Config) -> Sweep:
        """How the camera moves while an image is read, if it moves as in the last frames of ``trajectory`` (see
        ``shutter``); not at all where these are too far apart to tell, as after it was found again."""
        over = min(SWEEP_OVER, len(trajectory) - 1)
        before, last = trajectory[-1 - over], trajectory[-1]
        if not config.deskew or not near(before, last, over * SUDDEN_M, over * SUDDEN_DEG):
            return STILL
        return sweep_between(before, last, trajectory.timestamps[-1] - trajectory.timestamps[-1 - over], self._camera)

    def fuse(self, frame: Frame, c2w: NDArray[np.float64], sweep: Sweep, config: Config) -> None:
        """Average a frame seen from c2w [4, 4] during ``sweep`` into the volume, where there is one."""
        if self._volume is not None:
            self._volume.integrate(frame, self._camera, c2w, config.depth_near_m, config.depth_far_m, sweep)

    def trust(self, count: int) -> None:
        """From now on the map may be trusted where the first ``count`` keyframes saw something."""
        self._trusted = count

    def _observe(self, trajectory: Trajectory, keyframes: list[Keyframe]) -> None:
        for view in range(self._observed.views, self._trusted):
            self._observed.add(keyframes[view].pixels.points(), trajectory.keyframe_poses()[view])

    def _tracker(self, field: TsdfField, config: Config) -> tuple[Surface, Tracker]:
        """The surface that frames are aligned to, and what tracks them."""
        if self._gpu_tracker is not None:
            return self._gpu_tracker.volume, self._gpu_tracker
        observed, kernels = self._observed, self._kernels
        assert isinstance(observed, ObservedVoxels)
        learned = LearnedSurface(field, kernels, config.truncation_m, observed)
        surface = learned if self._volume is None else self._volume
        tracker = HostTracker(self._camera, surface, observed, kernels, self._rng, self._generator, self.recorder)
        return surface, tracker

    def state(self) -> Arrays:
        """What ``load`` needs, as arrays nobody writes to afterwards."""
        return {
            **prefixed("observed", self._observed.state() | {"trained": np.array(self._trusted)}),
            **prefixed("volume", self._volume.state() if self._volume is not None else {}),
            **prefixed("earlier", self._earlier.state()),
            "gain": np.array(self._gain),
            "lost": self.recovery.state(),
        }

    def load(self, state: Arrays) -> None:
        """Go on from what ``state`` gave."""
        self._observed.load(part("observed", state))
        self._trusted = int(state["observed.trained"])
        if self._volume is not None:
            self._volume.load(part("volume", state))
        self._earlier.load(part("earlier", state))
        self._gain = float(state["gain"])
        self.recovery.load(state["lost"])
