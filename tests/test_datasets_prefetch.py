"""Reading ahead: order, bounds, errors in place, and an end that never hangs."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from ecslam.datasets import Prefetch
from ecslam.types import Frame, FrameError


class Probe:
    """A sequence that records what is read, and fails where it is told to."""

    name = "probe"

    def __init__(self, count: int, failures: dict[int, Exception] | None = None, delay_s: float = 0.0) -> None:
        self.count, self.failures, self.delay_s = count, failures or {}, delay_s
        self.read: list[int] = []
        self.lock = threading.Lock()
        self.together = self.most_together = 0

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Frame:
        with self.lock:
            self.read.append(index)
            self.together += 1
            self.most_together = max(self.most_together, self.together)
        time.sleep(self.delay_s * (1 + index % 3))
        with self.lock:
            self.together -= 1
        if index in self.failures:
            raise self.failures[index]
        return Frame(index, index / 30, np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1), np.float32))


def run(probe: Probe, *args: object, **options: int) -> list[tuple[int, Frame | FrameError]]:
    return list(Prefetch(probe, *args, **options))  # type: ignore[arg-type]


@pytest.mark.parametrize("workers", [1, 2, 4])
@pytest.mark.parametrize("ahead", [0, 1, 5, 100])
def test_frames_come_in_order_and_once(workers: int, ahead: int) -> None:
    probe = Probe(20, delay_s=0.0005)
    results = run(probe, threads=workers, ahead=ahead)
    assert [index for index, _ in results] == list(range(20))
    assert all(isinstance(frame, Frame) and frame.index == index for index, frame in results)
    assert sorted(probe.read) == list(range(20))
    assert probe.most_together <= workers


def test_it_says_whether_the_next_frame_is_there() -> None:
    frames = Prefetch(Probe(2, delay_s=0.2), threads=1)  # type: ignore[arg-type]
    assert not frames.ready(0.01)
    assert frames.ready(5)
    assert [index for index, _ in frames] == [0, 1]
    assert frames.ready(0), "that there is none more is known, too"


def test_two_workers_read_at_the_same_time() -> None:
    probe = Probe(12, delay_s=0.005)
    run(probe, threads=2)
    assert probe.most_together == 2


def test_only_the_wanted_frames_are_read() -> None:
    probe = Probe(20)
    assert [index for index, _ in run(probe, [7, 3, 11])] == [7, 3, 11]
    assert sorted(probe.read) == [3, 7, 11]
    assert run(probe, []) == []


def test_an_error_stands_in_the_frames_place_and_the_rest_goes_on() -> None:
    broken = FrameError("frame 2 is broken")
    results = run(Probe(6, {2: broken, 4: ValueError("odd")}))
    assert results[2] == (2, broken)
    assert isinstance(results[4][1], FrameError)
    assert "frame 4" in str(results[4][1])
    assert "odd" in str(results[4][1])
    assert [isinstance(r, Frame) for _, r in results] == [True, True, False, True, False, True]


def test_it_reads_no_further_ahead_than_it_may() -> None:
    probe = Probe(50)
    frames = Prefetch(probe, ahead=3)  # type: ignore[arg-type]
    for taken in range(5):
        next(frames)
        time.sleep(0.01)
        assert len(probe.read) <= taken + 1 + 3
    frames.close()


@pytest.mark.parametrize("taken", [0, 1, 7])
def test_stopping_early_ends_all_threads_at_once(taken: int) -> None:
    before = threading.active_count()
    probe = Probe(1000, delay_s=0.002)
    frames = Prefetch(probe, ahead=100)  # type: ignore[arg-type]
    for _ in range(taken):
        next(frames)
    frames.close()
    assert threading.active_count() == before
    assert len(probe.read) < 30


def test_an_exception_in_the_loop_body_leaves_no_thread_behind() -> None:
    before = threading.active_count()

    def loop() -> None:
        for index, _ in Prefetch(Probe(100, delay_s=0.001)):  # type: ignore[arg-type]
            if index == 3:
                raise RuntimeError("mine")

    with pytest.raises(RuntimeError, match="mine"):
        loop()
    deadline = time.perf_counter() + 2
    while threading.active_count() > before and time.perf_counter() < deadline:
        time.sleep(0.01)
    assert threading.active_count() == before


def test_the_next_frame_is_seen_before_it_is_taken() -> None:
    frames = Prefetch(Probe(3, failures={1: FrameError("frame 1: torn")}, delay_s=0.05), threads=1)  # type: ignore[arg-type]
    assert frames.peek() is None
    assert frames.ready(5)
    seen = frames.peek()
    assert seen is not None
    assert next(frames)[1] is seen
    assert frames.ready(5)
    assert frames.peek() is None  # it is left out
    next(frames)
    assert frames.ready(5)
    next(frames)
    assert frames.peek() is None
    assert next(frames, None) is None
