"""Frames hang on their keyframes."""

import numpy as np
import pytest
import torch

from ecslam import se3
from ecslam.trajectory import Trajectory


def moved(x):
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def build(count=12, every=5):
    t = Trajectory()
    for i in range(count):
        t.append(moved(0.1 * i), i / 30, i % every == 0)
    return t


def test_poses_come_back_as_given():
    t = build()
    assert np.allclose(t.poses()[:, 0, 3], 0.1 * np.arange(12))
    assert np.allclose(t[7], t.poses()[7])


def test_frames_follow_their_keyframe_rigidly():
    t = build()
    before = t.poses()
    turn = se3.retract(
        torch.eye(4, dtype=torch.float64), torch.tensor([0, 0.2, 0, 0, 0, 0.3], dtype=torch.float64)
    ).numpy()
    t.move_keyframes(np.array([1]), (turn @ t.keyframe_poses()[1])[None])
    after = t.poses()
    assert np.allclose(after[:5], before[:5])
    assert np.allclose(after[10:], before[10:])
    assert np.allclose(after[5:10], turn @ before[5:10])


def test_prediction_is_constant_velocity():
    t = build()
    assert np.allclose(t.predict(t.timestamps[-1] * 12 / 11), moved(1.2))


@pytest.mark.parametrize(("steps", "expected"), [(1.25, 1), (0.8, 1), (2, 2), (0.5, 0.5), (6, 6), (200, 15), (-3, 0)])
def test_prediction_counts_on_missing_frames(steps, expected):
    """Jitter of the time stamps is none of the camera's."""
    step = se3.retract(
        torch.eye(4, dtype=torch.float64), torch.tensor([0, 0, 0.01, 0, 0.02, 0], dtype=torch.float64)
    ).numpy()
    t = Trajectory()
    t.append(moved(5), 0.0, keyframe=True)
    t.append(moved(5) @ step, 1 / 30, keyframe=False)
    found = se3.inverse(moved(5) @ step) @ t.predict((1 + steps) / 30)
    turn = torch.tensor([0, 0.02 * expected, 0], dtype=torch.float64)
    assert np.allclose(found[:3, 3], [0, 0, 0.01 * expected])
    assert np.allclose(found[:3, :3], se3.so3_exp(turn))


def test_prediction_far_ahead_looks_as_far_back():
    """What the last short step is off by does not count several times over."""
    t = Trajectory()
    for time in (0, 2, 4, 5):
        pose = np.eye(4)
        pose[:3, 3] = 0.01 * time, 0.004 * (time == 5), 0
        t.append(pose, time / 30, keyframe=time == 0)
    assert np.allclose(t.predict(8 / 30)[:3, 3], [0.08, 0.008, 0]), "the last three steps of time count, not one"
    assert np.allclose(t.predict(6 / 30)[:3, 3], [0.06, 0.008, 0])


def test_prediction_after_frames_at_one_time_goes_on_as_before():
    t = Trajectory()
    for x in (0.0, 0.1):
        t.append(moved(x), 5.0, keyframe=x == 0)
    assert np.allclose(t.predict(6.0), moved(0.2))
    t = build()
    last, step = t.timestamps[-1], t.timestamps[-1] - t.timestamps[-2]
    t.append(moved(1.3), last, keyframe=False)
    assert np.allclose(t.predict(last + step), moved(1.3 + 0.3)), "velocity is taken from before"


def test_prediction_goes_on_along_a_curve():
    """A motion is one in the camera's own axes: the same step and the same turn once more."""
    step = se3.retract(
        torch.eye(4, dtype=torch.float64), torch.tensor([0.1, 0, 0.2, 0, 0.3, 0], dtype=torch.float64)
    ).numpy()
    t, pose = Trajectory(), moved(5)
    for i in range(3):
        t.append(pose, i / 30, i == 0)
        pose = pose @ step
    assert np.allclose(t.predict(3 / 30), pose)


def test_state_round_trip():
    t = build()
    state = t.state()
    again = Trajectory.restore(state)
    assert (again.poses() == t.poses()).all()
    assert again.timestamps == t.timestamps
    for each in (t, again):
        each.append(moved(9), 1.0, False)
        assert len(each) == len(state["timestamps"]) + 1
