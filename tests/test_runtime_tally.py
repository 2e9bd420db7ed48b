"""What a run counts and times."""

from ecslam.runtime import tally


def test_it_is_time_at_first_and_then_every_so_many_seconds(monkeypatch):
    clock = iter([100.0, 101.0, 104.9, 105.0, 109.0, 112.0, 116.0, 117.0])
    monkeypatch.setattr(tally, "monotonic", lambda: next(clock))
    every = tally.Every(5.0)
    assert [every.due() for _ in range(8)] == [True, False, False, True, False, True, False, True]
