"""Keeping up with a camera: which frames are left out, that none is far from the next, and an end that never hangs."""

from __future__ import annotations

import threading
import time
from contextlib import closing

import numpy as np
import pytest
from fake_slam import FakeSequence

from ecslam.datasets import KeepingUp, Playback
from ecslam.datasets.pace import CATCH_UP, STRIDE_S
from ecslam.types import FrameError

FPS = 30


class Feed:
    """What has arrived, as a test says."""

    def __init__(self, count: int, over: bool = False) -> None:
        self.count, self.ended = count, over

    def arrived(self) -> int:
        return self.count

    def over(self) -> bool:
        return self.ended


def test_a_backlog_is_caught_up_with_in_strides_that_tracking_bears():
    feed = Feed(1)
    with closing(KeepingUp(FakeSequence(40), feed)) as frames:
        seen = [next(frames)[0]]
        feed.count, feed.ended = 40, True
        seen += [index for index, _ in frames]
    most = int(STRIDE_S * FPS)
    assert seen[0] == 0
    assert seen[-1] == 39, "the last frame is never left out"
    assert set(np.diff(seen[:-1])) == {most}


def test_a_frame_that_is_near_comes_next_whole():
    feed = Feed(1)
    with closing(KeepingUp(FakeSequence(40), feed)) as frames:
        seen = [next(frames)[0]]
        for count in (2, 3, 6, 7):
            feed.count = count
            seen.append(next(frames)[0])
    assert seen == [0, 1, 2, 5, 6]


def test_who_is_far_behind_gets_longer_strides():
    behind = 300
    feed = Feed(1)
    with closing(KeepingUp(FakeSequence(behind + 1), feed)) as frames:
        next(frames)
        feed.count, feed.ended = behind + 1, True
        strides = np.diff([0, *(index for index, _ in frames)])
    assert strides[0] == behind // CATCH_UP
    assert (np.diff(strides[:-1]) <= 0).all(), "they shorten as it catches up"
    assert strides[-2] == int(STRIDE_S * FPS)


def test_after_a_long_pause_it_goes_on_with_the_newest_frame():
    feed = Feed(1)
    with closing(KeepingUp(FakeSequence(600), feed)) as frames:
        next(frames)
        feed.count, feed.ended = 600, True
        assert [index for index, _ in frames] == [599]


def test_it_begins_with_the_newest_frame():
    feed = Feed(7)
    with closing(KeepingUp(FakeSequence(20), feed)) as frames:
        assert next(frames)[0] == 6


def test_a_gap_in_the_recording_is_stepped_over():
    times = np.r_[np.arange(5), np.arange(100, 110)] / FPS
    feed = Feed(1)
    with closing(KeepingUp(FakeSequence(15, times=times), feed)) as frames:
        seen = [next(frames)[0]]
        feed.count, feed.ended = 15, True
        seen += [index for index, _ in frames]
    assert 4 in seen
    assert seen[-1] == 14


def test_it_waits_for_what_has_not_arrived():
    feed = Feed(1)
    with closing(KeepingUp(FakeSequence(3), feed)) as frames:
        next(frames)
        threading.Timer(0.05, lambda: setattr(feed, "count", 2)).start()
        began = time.monotonic()
        assert next(frames)[0] == 1
        assert time.monotonic() - began > 0.03


def test_what_cannot_be_read_is_an_error_in_its_place():
    feed = Feed(1)
    with closing(KeepingUp(FakeSequence(4, bad=(1,)), feed)) as frames:
        next(frames)
        feed.count = 2
        index, item = next(frames)
        assert index == 1
        assert isinstance(item, FrameError)
        feed.count = 3
        assert next(frames)[0] == 2


@pytest.mark.parametrize("asked", [0, 1])
def test_closing_ends_it_while_it_waits(asked):
    frames = KeepingUp(FakeSequence(4), Feed(1))
    for _ in range(asked):
        next(frames)
    began = time.monotonic()
    frames.close()
    assert time.monotonic() - began < 1
    with pytest.raises(StopIteration):
        next(frames)


def test_nothing_at_all_is_an_end():
    with closing(KeepingUp(FakeSequence(4), Feed(0, over=True))) as frames:
        assert list(frames) == []


def test_a_recording_plays_as_fast_as_it_was_made():
    now = 0.0
    played = Playback(FakeSequence(10), lambda: now)
    assert played.arrived() == 1
    now = 4.5 / FPS
    assert played.arrived() == 5
    assert not played.over()
    now = 9.01 / FPS
    assert played.arrived() == 10
    assert played.over()


def test_a_wrong_time_stamp_holds_nothing_up():
    times = np.arange(10) / FPS
    times[4] = 1e6
    now = 0.0
    played = Playback(FakeSequence(10, times=times), lambda: now)
    assert played.arrived() == 1
    now = 9.01 / FPS
    assert played.arrived() == 10


def test_playing_goes_on_at_a_frame_whatever_the_clock_says():
    now = 100.0
    played = Playback(FakeSequence(10), lambda: now, 6)
    assert played.arrived() == 7
    now += 1.01 / FPS
    assert played.arrived() == 8


def test_the_next_frame_is_seen_before_it_is_taken():
    with closing(KeepingUp(FakeSequence(3, bad=(1,)), Feed(1))) as frames:
        assert frames.peek() is None
        assert frames.ready(5)
        seen = frames.peek()
        assert next(frames)[1] is seen is not None
        frames._arrivals.count, frames._arrivals.ended = 2, True
        assert frames.ready(5)
        assert frames.peek() is None  # it is left out
        assert isinstance(next(frames)[1], FrameError)
