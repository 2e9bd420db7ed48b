"""Numbers below 1e-38 cost an Intel processor a hundred times what others do: nothing of ours computes with them."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import torch

from ecslam.config import Config
from ecslam.config_files import load_preset
from ecslam.datasets import open_sequence
from ecslam.kernels import cpu
from ecslam.kernels.denormals import flushed, flushes
from ecslam.slam import Slam


@pytest.fixture(autouse=True)
def _plain():
    if not torch.set_flush_denormal(True):
        pytest.skip("this processor cannot")
    torch.set_flush_denormal(False)
    yield
    torch.set_flush_denormal(False)


def test_they_count_as_zero_within_and_not_outside() -> None:
    tiny = torch.full((8,), 1e-40)
    assert not flushes()
    with flushed():
        assert flushes()
        assert not (tiny * 1).any()
        with flushed():
            assert flushes()
        assert flushes()
    assert not flushes()
    assert (tiny * 1).all()


def test_an_error_within_leaves_nothing_behind() -> None:
    with pytest.raises(ValueError, match="x"), flushed():
        raise ValueError("x")
    assert not flushes()


def test_whoever_had_them_flushed_keeps_that() -> None:
    torch.set_flush_denormal(True)
    with flushed():
        pass
    assert flushes()


def test_threads_that_begin_within_flush_for_good() -> None:
    found: list[bool] = []
    asked = threading.Event()

    def tell() -> None:
        asked.wait()
        found.append(flushes())

    with flushed():
        thread = threading.Thread(target=tell)
        thread.start()
    asked.set()
    thread.join()
    assert found == [True]


def test_every_thread_of_the_kernels_flushes() -> None:
    found: dict[str, bool] = {}
    all_there = threading.Barrier(3, timeout=30)

    def worker(t: int, counter: np.ndarray) -> None:
        all_there.wait()
        found[threading.current_thread().name] = flushes()

    cpu._spread(3, worker)
    assert len(found) == 3
    assert all(found.values())
    assert not flushes()


def test_an_engine_flushes_while_it_works_and_no_longer() -> None:
    room = open_sequence("synthetic/studio?frames=2&size=64x48")
    config: Config = load_preset("live")
    slam, seen = Slam(config, room.intrinsics, first_pose=room[0].c2w_gt), set()
    slam.step(room[0], lambda: seen.add(flushes()))
    assert seen == {True}
    assert not flushes()
