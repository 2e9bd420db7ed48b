"""EBA and loops: laws of the window and of revisits, from poses alone."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ecslam.config import WindowConfig
from ecslam.datasets.synthetic import ROOMS, open_synthetic
from ecslam.loops import LoopDetector, RevisitRule, loop_event, revisited
from ecslam.window import parallax, random_window, select_window


def look(x, y, degrees):
    """A pose at (x, y, 0) whose optical axis lies in the plane at an angle."""
    a = np.radians(degrees)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[-np.sin(a), 0, np.cos(a)], [np.cos(a), 0, np.sin(a)], [0, 1, 0]])
    pose[:3, 3] = x, y, 0
    return pose


def circle(count, turns=1.0):
    return np.stack([look(np.cos(t), np.sin(t), np.degrees(t)) for t in np.linspace(0, 2 * np.pi * turns, count)])


@given(st.integers(1, 200), st.integers(64, 6000), st.integers(0, 50))
@settings(max_examples=60)
def test_window_is_sorted_unique_capped_and_holds_the_ends(count, rays, seed):
    poses = circle(count)[np.random.default_rng(seed).permutation(count)]
    config = WindowConfig()
    window = select_window(poses, poses[-1], rays, config)
    assert (np.diff(window) > 0).all()
    assert len(window) <= max(2, min(config.size, rays // 32))
    assert 0 in window
    assert count - 1 in window
    assert (window == select_window(poses, poses[-1], rays, config)).all()


def test_near_keyframes_that_look_the_same_way_come_first():
    config = WindowConfig(size=12, recent=3, historic=2)
    poses = circle(100)
    window = select_window(poses, poses[60], 10_000, config)
    always = {0, 97, 98, 99, 96}
    others = [i for i in window if i not in always]
    assert max(abs(i - 60) for i in others) <= 4


def test_keyframes_that_look_elsewhere_are_dropped():
    config = WindowConfig(size=10, recent=1, historic=1, max_angle_deg=40)
    poses = np.stack([look(0, 0, 0)] + [look(0.01 * i, 0, 180) for i in range(20)] + [look(5, 0, 0)] * 5)
    window = select_window(poses, look(0, 0, 0), 10_000, config)
    assert not set(window.tolist()) & set(range(1, 21))


def test_an_old_place_enters_the_window_on_return():
    poses = circle(100)
    window = select_window(poses, poses[-1], 2000, WindowConfig())
    assert (window < 10).sum() >= 5


def test_parallax():
    distance, angle = parallax(np.stack([look(0, 0, 0), look(3, 4, 90)]), look(0, 0, 0))
    assert distance == pytest.approx([0, 5])
    assert angle == pytest.approx([0, 90], abs=1e-6)


@given(st.integers(1, 100), st.integers(0, 100))
def test_random_window_holds_the_current_keyframe(count, seed):
    window = random_window(count, 2000, WindowConfig(), np.random.default_rng(seed))
    assert count - 1 in window
    assert len(set(window.tolist())) == len(window) <= 30


def test_random_windows_have_every_size_up_to_the_cap():
    rng = np.random.default_rng(0)
    windows = [random_window(60, 2000, WindowConfig(size=6), rng) for _ in range(300)]
    assert {len(window) for window in windows} == {2, 3, 4, 5, 6}
    assert len(np.unique(np.concatenate(windows))) == 60


def test_revisit_needs_to_have_been_away():
    rule = RevisitRule(away=20)
    poses = circle(100)
    assert len(revisited(poses[:60], poses[59], rule)) == 0
    old = revisited(poses, poses[-1], rule)
    assert len(old) > 0
    assert old.max() < 30
    still = np.repeat(look(0, 0, 0)[None], 100, 0)
    assert len(revisited(still, still[-1], rule)) == 0


def test_one_event_for_one_return():
    detector = LoopDetector(RevisitRule(away=20))
    poses = circle(230, turns=2.2)
    events = [k for k in range(1, len(poses)) if len(detector.update(poses[:k], poses[k - 1]))]
    assert len(events) >= 1
    assert 80 < events[0] < 110


def test_an_event_says_how_far_the_pose_moved_and_turned():
    event = loop_event(40, (0, 5), look(1, 2, 10), look(1.03, 2.04, 17), 3.0, 2.0, np.zeros((41, 3), np.float32))
    assert event.correction_cm == pytest.approx(5)
    assert event.correction_deg == pytest.approx(7)
    assert (event.frame, event.keyframes, event.loss_before, event.loss_after) == (40, (0, 5), 3, 2)


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_closes_its_loop_where_the_path_comes_back_and_nowhere_before(room):
    poses = open_synthetic(room).poses_gt()[::5]
    detector = LoopDetector()
    met = [detector.update(poses[: k + 1], poses[k]) for k in range(len(poses))]
    events = [k for k, old in enumerate(met) if len(old)]
    away_m = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1)
    turned_deg = np.degrees(np.arccos((poses[:, :3, 2] @ poses[0, :3, 2]).clip(-1, 1)))
    here = (away_m < 0.7) & (turned_deg < 30)
    left = int(np.argmin(here))
    assert events == [left + int(np.argmax(here[left:]))]
    assert met[events[0]].tolist() == [0]
