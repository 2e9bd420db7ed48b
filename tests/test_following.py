"""While a GPU tracks a frame, the next one is looked at: nothing is asked twice, and what is found is the same."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ecslam import following
from ecslam.config_files import apply_settings, load_preset
from ecslam.datasets import open_sequence
from ecslam.denoising import denoised
from ecslam.slam import Slam

ROOM = open_sequence("synthetic/studio?size=320x240&frames=300&visitor=1")
SMALL = ["align.points=800", "mapping.rays=200", "mapping.iterations=2", "mapping.first_iterations=5"]
CONFIG = apply_settings(load_preset("live"), SMALL)
SEEN = [replace(ROOM[i], color=(ROOM[i].color * (0.7 if i >= 20 else 1.0)).astype(np.uint8)) for i in range(40)]
FRAMES = [denoised(frame, CONFIG) for frame in SEEN]


def run(frames, announced, monkeypatch):
    """Poses, gains, how much depth was left, and which frames were looked at, where the next one is ``announced``."""
    looked_at, gains, left = [], [], []
    asked = following.as_at_first

    def look(frame, *given):
        looked_at.append(frame.index)
        return asked(frame, *given)

    monkeypatch.setattr(following, "as_at_first", look)
    slam = Slam(CONFIG, ROOM.intrinsics, bounds=ROOM.bounds, first_pose=ROOM[0].c2w_gt)
    slam.step(frames[0])
    follower = slam._follower
    surface, host = follower._tracker(slam.field, CONFIG)

    def begin(frame, *given):
        gains.append(frame.gain)
        left.append(np.count_nonzero(frame.depth))
        return host.begin(frame, *given)

    follower._gpu_tracker = SimpleNamespace(volume=surface, begin=begin)  # like a GPU's, it gets what was looked at
    for i, frame in enumerate(frames[1:], 1):
        report = slam.step(frame, then=frames[i + 1] if announced and i + 1 < len(frames) else None)
        assert report.tracked
    monkeypatch.setattr(following, "as_at_first", asked)
    return slam.trajectory.poses(), np.array(gains), np.array(left), looked_at


def test_what_is_found_ahead_is_what_would_be_found_in_time(monkeypatch):
    poses, gains, left, looked_at = run(FRAMES, False, monkeypatch)
    ahead, gains_ahead, left_ahead, looked_ahead = run(FRAMES, True, monkeypatch)
    assert looked_at == looked_ahead == list(range(1, 40))
    np.testing.assert_allclose(gains_ahead, gains, rtol=0.02)
    assert gains[-1] == pytest.approx(1 / 0.7, rel=0.03)
    measured = np.array([np.count_nonzero(frame.depth) for frame in FRAMES[1:]])
    assert (left < measured).any()
    np.testing.assert_allclose(left_ahead, left, atol=0.03 * measured.max())
    truth = np.stack([ROOM[i].c2w_gt for i in range(len(FRAMES))])
    for found in (poses, ahead):
        assert np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 6e-3


def test_a_frame_that_is_not_the_one_announced_or_not_of_this_camera_is_looked_at_in_its_turn(monkeypatch):
    frames = list(FRAMES[:6])
    slam = Slam(CONFIG, ROOM.intrinsics, bounds=ROOM.bounds, first_pose=ROOM[0].c2w_gt)
    slam.step(frames[0])
    follower = slam._follower
    surface, host = follower._tracker(slam.field, CONFIG)
    follower._gpu_tracker = SimpleNamespace(volume=surface, begin=host.begin)
    wrong = replace(frames[2], color=frames[2].color[:5], depth=frames[2].depth[:5])
    slam.step(frames[1], then=wrong)
    assert follower._ahead is None
    slam.step(frames[2], then=frames[4])
    assert follower._ahead[0] is frames[4]
    slam.step(frames[3])
    assert follower._ahead is None
    assert slam.step(frames[4]).tracked
