"""Whole runs on a GPU: every loop is recorded and replayed, in both schedules, and the camera is followed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ecslam import volume_gpu
from ecslam.config_files import apply_settings, load_preset
from ecslam.datasets import open_sequence
from ecslam.datasets.slots import RESTING, Slots
from ecslam.pixels_gpu import DeviceFrame
from ecslam.runtime.readers import page_lock
from ecslam.slam import Slam
from ecslam.types import Frame, Intrinsics

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU here")
FRAMES = 40


@pytest.fixture(scope="module")
def frames():
    room = open_sequence("synthetic/studio?size=320x240&frames=400")
    return room, [room[i] for i in range(FRAMES)]


def replays(recorder):
    """How many graphs it holds that are ready to be replayed."""
    return sum(held.replay is not None for held in recorder._held.values())


@pytest.mark.slow
@pytest.mark.parametrize("holes", [0.0, 0.1])
@pytest.mark.parametrize("schedule", ["strict", "overlap"])
@pytest.mark.parametrize("preset", ["live", "lite", "full"])
def test_a_run_replays_its_loops_and_follows_the_camera(frames, preset, schedule, holes):
    room, seen = frames
    config = apply_settings(load_preset(preset), [f"schedule={schedule}", "mapping.final_iterations=30"])
    rng, first = np.random.default_rng(0), seen[0].c2w_gt
    slam = Slam(config, room.intrinsics, device=torch.device("cuda"), bounds=room.bounds, first_pose=first)
    for frame in seen:
        there = rng.random(frame.depth.shape) >= holes
        report = slam.step(replace(frame, depth=frame.depth * there))
        assert report.tracked
        assert np.isfinite(list(report.losses.values())).all()
        assert "graph" not in report.note
    slam.finish()
    tracking, mapping = slam._follower.recorder, slam.mapper.recorder
    assert (tracking.failure, mapping.failure) == ("", "")
    assert replays(tracking) >= 2
    assert replays(mapping) >= 2
    off = slam.trajectory.poses()[:, :3, 3] - np.stack([frame.c2w_gt[:3, 3] for frame in seen])
    assert np.sqrt(np.square(off).sum(1).mean()) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["live", "lite"])
def test_loops_are_recorded_again_where_the_map_grows(preset):
    room = open_sequence("synthetic/studio?size=320x240&frames=100")
    config = apply_settings(load_preset(preset), ["mapping.final_iterations=30"])
    slam = Slam(config, room.intrinsics, device=torch.device("cuda"), first_pose=room[0].c2w_gt)
    rows = set()
    for i in range(FRAMES):
        slam.step(room[i])
        rows.add(len(slam.mapper.field.params.table))
    slam.finish()
    assert len(rows) > 1
    assert (slam._follower.recorder.failure, slam.mapper.recorder.failure) == ("", "")
    off = slam.trajectory.poses()[:, :3, 3] - np.stack([room[i].c2w_gt[:3, 3] for i in range(FRAMES)])
    assert np.sqrt(np.square(off).sum(1).mean()) < 0.02


@pytest.mark.slow
def test_loops_are_recorded_again_where_the_volume_grows(frames, monkeypatch):
    monkeypatch.setattr(volume_gpu, "SLOTS", 1 << 11)
    room, seen = frames
    config, first = load_preset("live"), seen[0].c2w_gt
    slam = Slam(config, room.intrinsics, device=torch.device("cuda"), bounds=room.bounds, first_pose=first)
    forgotten, tracking = [], slam._follower.recorder
    forget = tracking.forget
    monkeypatch.setattr(tracking, "forget", lambda: (forgotten.append(1), forget()))
    for frame in seen:
        slam.step(frame)
    slam.finish()
    assert len(forgotten) > 1
    assert tracking.failure == ""
    assert replays(tracking) >= 2


def test_a_gpu_fetches_from_slots_by_itself():
    camera = Intrinsics(100, 100, 79.5, 59.5, 160, 120)
    slots, rng = Slots(camera, RESTING + 2), np.random.default_rng(0)
    page_lock("cuda", slots)
    color, depth = rng.integers(0, 255, (120, 160, 3), np.uint8), rng.random((120, 160), np.float32)
    slot = slots.take()
    frame = slots.found(slots.put(Frame(0, 0.0, color, depth), slot), slot)
    assert torch.from_numpy(frame.depth).is_pinned()
    shown = DeviceFrame.of(frame, torch.device("cuda"))
    assert np.array_equal(shown.color.cpu(), color)
    assert np.array_equal(shown.depth.cpu(), depth)
