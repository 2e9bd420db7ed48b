"""A sequence and an engine proper that are exact, deterministic and quick, for the tests of the runtime."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from ecslam.config import Config, FieldConfig
from ecslam.messages import LoopEvent, StepReport
from ecslam.rigid import rotations
from ecslam.types import Frame, FrameError, InputError, Intrinsics

QUICK = Config(field=FieldConfig(finest_voxel_m=0.1))
CAMERA = Intrinsics(60.0, 60.0, 31.5, 23.5, 64, 48)
TURN_DEG = 2.0  # a closed loop's frame before the closure
TURNED = rotations(np.array([[0, np.sin(np.radians(TURN_DEG / 2)), 0, np.cos(np.radians(TURN_DEG / 2))]]))[0]


def circle(count: int) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    angle = np.linspace(0, 1.5 * np.pi, count)
    poses[:, :3, 3] = np.stack([np.cos(angle), np.sin(angle), 0.1 * angle], 1)
    return poses


class FakeSequence:
    """Poses on a helix. bad: frames that cannot be read; times: other time stamps than index / 30."""

    name, layout, preset, intrinsics, bounds = "fake", "fake", "lite", CAMERA, None
    depth_m = 2.0

    def __init__(self, count: int = 30, bad: tuple[int, ...] = (), times=None, truth: bool = True) -> None:
        self.count, self.bad = count, bad
        self.times = np.arange(count) / 30 if times is None else np.asarray(times, float)
        self.poses = circle(count) if truth else None

    def __len__(self) -> int:
        return self.count

    def __iter__(self):
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> Frame:
        if index in self.bad:
            raise FrameError(f"/data/{index:06d}.png: truncated; copy it again")
        color = np.full((48, 64, 3), index % 256, np.uint8)
        pose = None if self.poses is None else self.poses[index]
        return Frame(index, float(self.times[index]), color, np.full((48, 64), self.depth_m, np.float32), pose)

    def timestamps(self) -> np.ndarray:
        return self.times

    def poses_gt(self):
        return self.poses

    def reference_mesh(self):
        return None


def open_fake(address: str) -> FakeSequence:
    kind, _, count = address.partition(":")
    if kind != "fake":
        raise InputError(f"{address}: no such folder; give another")
    return FakeSequence(int(count or 30))


class FakeTrajectory:
    def __init__(self, poses=(), timestamps=()) -> None:
        self.rows = list(poses)
        self.timestamps = list(timestamps)

    def poses(self) -> np.ndarray:
        return np.array(self.rows).reshape(-1, 4, 4)


@dataclass(frozen=True)
class FakeField:
    parameters: int = 1000


@dataclass
class Behaviour:
    """What a ``FakeSlam`` does: how often it calls ``interrupt`` in the first frame and in later ones, each after a
    pause; where a loop closes, it is lost, it fails, and it has no depth to start with."""

    first_interrupts: int = 0
    interrupts: int = 1
    final_interrupts: int = 0
    pause_s: float = 0.0
    loop_at: int = -1
    lost: tuple[int, ...] = ()
    empty: tuple[int, ...] = ()
    fail_at: int = -1
    noise_cm: float = 1.0


class FakeSlam:
    kernels_name, kernels_note = "fake", ""

    def __init__(self, config: Config, behaviour: Behaviour) -> None:
        self.config, self.behaviour = config, behaviour
        self.trajectory = FakeTrajectory()
        self.field: FakeField | None = None
        self.finished = self.half_way = False

    def step(self, frame: Frame, interrupt=None, then=None) -> StepReport:
        b, first = self.behaviour, self.field is None
        if frame.index == b.fail_at:
            raise RuntimeError("the map exploded")
        if frame.index in b.empty:
            raise FrameError(f"frame {frame.index}: no usable depth")
        before = np.eye(4) if frame.c2w_gt is None else frame.c2w_gt.copy()
        wobble = np.sin(np.arange(3) + frame.index)
        before[:3, 3] += 0.02 * b.noise_cm * wobble
        c2w = before.copy()
        c2w[:3, 3] -= 0.01 * b.noise_cm * wobble
        self.field = FakeField()
        self.trajectory.rows.append(c2w)
        self.trajectory.timestamps.append(frame.timestamp)
        mapped = frame.index % 5 == 0
        for _ in range(b.first_interrupts if first else b.interrupts):
            time.sleep(b.pause_s)
            if interrupt is not None:
                interrupt()
        loop = None
        if frame.index == b.loop_at:
            centres = self.trajectory.poses()[:, :3, 3].astype(np.float32)
            before[:3, :3] = before[:3, :3] @ TURNED
            loop = LoopEvent(frame.index, (0,), 1.0, 0.1, 2.0, 1.0, None, None, None, None, centres, before)
        return StepReport(
            frame=frame.index,
            timestamp=frame.timestamp,
            c2w=c2w,
            tracked=frame.index not in b.lost,
            lost=frame.index in b.lost,
            is_keyframe=mapped,
            window=(frame.index,) if mapped else (),
            losses={"depth": 0.5, "colour": 0.25 * self.config.mapping.iterations},
            track_ms=2.0,
            map_ms=100.0 if first else 3.0,
            step_ms=102.0 if first else 5.0,
            loop=loop,
            note="lost" if frame.index in b.lost else "",
        )

    def finish(self, interrupt=None) -> None:
        self.half_way = True
        for _ in range(self.behaviour.final_interrupts):
            time.sleep(self.behaviour.pause_s)
            interrupt()
        self.finished, self.half_way = True, False

    def surface_points(self, limit):
        directions = np.random.default_rng(0).normal(size=(4000, 3))
        return lambda: (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)

    def query(self):
        return lambda p: np.linalg.norm(p, axis=1) - 1, lambda p: np.full((len(p), 3), 128, np.uint8)

    def render(self, c2w, depth):
        return np.zeros((*depth.shape, 3), np.uint8), depth + np.float32(0.05)

    def configure(self, config: Config) -> None:
        self.config = config

    def state(self) -> dict[str, np.ndarray]:
        return {
            "poses": self.trajectory.poses(),
            "timestamps": np.array(self.trajectory.timestamps),
            "half_way": np.array(self.half_way),
        }


def maker(behaviour: Behaviour | None = None):
    """A ``SlamFactory`` of ``FakeSlam``; the instances it made are in its attribute ``made``."""

    def make(config, intrinsics, *, device, bounds, first_pose, state):
        slam = FakeSlam(config, behaviour or Behaviour())
        slam.first_pose = first_pose
        if state is not None:
            slam.trajectory = FakeTrajectory(state["poses"], state["timestamps"])
            slam.field = FakeField()
        make.made.append(slam)
        return slam

    make.made = []
    return make
