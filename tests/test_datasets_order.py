"""Which frames stay when time stamps are not in order: against trying every subset."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from ecslam.datasets.views import in_order


def rising(times: np.ndarray) -> bool:
    return bool((np.diff(times) > 0).all())


@pytest.mark.parametrize("seed", range(40))
def test_no_larger_choice_of_frames_has_rising_times(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = rng.integers(0, 8, rng.integers(0, 9)).astype(float)
    kept = in_order(times)
    assert rising(times[kept])
    larger = combinations(range(len(times)), int(kept.sum()) + 1)
    assert not any(rising(times[list(rows)]) for rows in larger)


@pytest.mark.parametrize(
    ("times", "left_out"),
    [([0, 1, 2, 3], []), ([0, 1e9, 2, 3], [1]), ([0, 1, 1, 2], [2]), ([5, 5, 5], [1, 2]), ([0, 1, 2, -9, 3], [3])],
)
def test_the_frames_left_out_are_those_one_would_name(times: list[float], left_out: list[int]) -> None:
    assert np.flatnonzero(~in_order(np.array(times, float))).tolist() == left_out
