"""What the command line says while the dashboard is up."""

from fake_slam import FakeSequence
from runtime_watch import running

from ecslam import commands
from ecslam.messages import Restart, State


def test_every_run_is_reported_once_as_soon_as_it_is_over(tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(commands, "finish_run", lambda folder, summary: told.append((folder, summary["frames"])))
    with running(tmp_path / "r", FakeSequence(4)) as (engine, watch, _):
        reports = commands.Reports(engine)
        reports.watch(watch.state(State.FINISHED))
        reports.watch(engine.latest())
        reports.watch(watch.go(Restart(), State.FINISHED))
        reports.close()
    assert told == [(tmp_path / "r", 4), (tmp_path / "r-2", 4)]
