"""Runs in real time: of a recording that plays as it was made, and of a camera that is on."""

import json
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from fake_slam import QUICK, Behaviour, FakeSequence, maker, open_fake
from runtime_watch import running

from ecslam.commands import progress_line
from ecslam.datasets import Live
from ecslam.messages import Notice, Pause, Quit, Restart, Resume, RunTo, Snapshot, State, Step, Stop
from ecslam.runtime.engine import Engine
from ecslam.runtime.runfolder import read_about
from ecslam.runtime.signals import quit_on_signals
from ecslam.types import InputError

REALTIME = replace(QUICK, realtime=True)
FPS = 300  # a tenth of a second is 30 frames
SLOW = Behaviour(pause_s=0.02)


def recording(count: int) -> FakeSequence:
    return FakeSequence(count, times=np.arange(count) / FPS)


class FakeCamera(FakeSequence):
    """A camera that a test moves on, by ``see``. It is off after ``close``, or by ``fail``."""

    def __init__(self) -> None:
        super().__init__(200, truth=False)
        self.count = 0
        self.trouble, self.off, self.closed = "", threading.Event(), 0

    def see(self, count: int) -> "FakeCamera":
        self.count += count
        return self

    def timestamps(self):
        return self.times[: self.count]

    def arrived(self) -> int:
        return self.count

    def over(self) -> bool:
        return self.off.is_set()

    def fail(self, trouble: str) -> None:
        self.trouble = trouble
        self.off.set()

    def close(self) -> None:
        self.closed += 1
        self.off.set()


def frames_of(folder) -> list[int]:
    return [json.loads(line)["frame"] for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_a_recording_is_played_in_its_own_time_and_frames_are_left_out(tmp_path):
    began = time.monotonic()
    made = Engine(REALTIME, recording(120), tmp_path, make=maker(SLOW), open_sequence=open_fake)
    summary = made.run()
    assert time.monotonic() - began > 0.35
    done = frames_of(tmp_path)
    assert done[0] < 30
    assert done[-1] == 119
    assert 3 < len(done) < 60
    assert summary["frames"] == len(done)
    assert summary["dropped_frames"] == 120 - len(done)
    assert summary["ended"] == "finished"
    assert 0 < summary["ate_rmse_cm"] < 5
    shown = made.latest()
    assert (shown.frame, len(shown.trajectory), shown.dropped) == (119, 120, 120 - len(done))
    assert f"{120 - len(done)} left out" in progress_line(shown, 0)


def test_an_engine_that_is_fast_enough_leaves_nothing_out(tmp_path):
    sequence = FakeSequence(5, times=np.arange(5) / 5)
    summary = Engine(REALTIME, sequence, tmp_path, make=maker(Behaviour()), open_sequence=open_fake).run()
    assert (summary["frames"], summary["dropped_frames"]) == (5, 0)


def test_a_pause_stops_the_recording_too(tmp_path):
    with running(tmp_path, recording(200), SLOW, config=REALTIME) as (_, watch, __):
        watch.until(lambda m: isinstance(m, Snapshot) and m.frame > 10)
        at = watch.go(Pause(), State.PAUSED).frame
        time.sleep(0.5)
        watch.ask(Resume())
        watch.state(State.FINISHED)
    after = next(frame for frame in frames_of(tmp_path) if frame > at + 1)
    assert after - at < 0.3 * FPS


def test_a_run_in_real_time_goes_on_where_it_was_left(tmp_path):
    with running(tmp_path, recording(300), SLOW, config=REALTIME, checkpoint_every=1) as (_, watch, __):
        watch.until(lambda m: isinstance(m, Snapshot) and m.frame > 60)
        watch.ask(Quit())
    left = frames_of(tmp_path)[-1]
    again = Engine.resume(tmp_path, sequence=recording(300), make=maker(SLOW), open_sequence=open_fake)
    summary = again.run()
    done = frames_of(tmp_path)
    assert done[-1] == 299
    assert summary["frames"] + summary["dropped_frames"] == 300
    assert max(np.diff([frame for frame in done if frame >= left])) < 0.3 * FPS


def test_a_restart_keeps_real_time_or_changes_it(tmp_path):
    with running(tmp_path / "a", recording(60), SLOW, config=REALTIME) as (engine, watch, _):
        watch.state(State.FINISHED)
        watch.go(Restart(preset="full"), State.FINISHED)
        assert len(frames_of(engine.run_folder)) < 60
        watch.go(Restart(realtime=False), State.FINISHED)
        assert len(frames_of(engine.run_folder)) == 60


# ---- a camera ----


def test_a_camera_is_a_live_sequence():
    assert isinstance(FakeCamera(), Live)
    assert not isinstance(FakeSequence(), Live)


def test_a_camera_is_followed_until_it_is_stopped_and_the_map_is_completed(tmp_path):
    camera = FakeCamera().see(1)
    with running(tmp_path, camera, Behaviour()) as (engine, watch, made):
        assert "hold it still" in watch.event(Notice).text
        watch.until(lambda m: isinstance(m, Snapshot) and m.live and len(m.trajectory) == 1)
        camera.see(3)
        watch.until(lambda m: isinstance(m, Snapshot) and m.frame == 3 and m.frames_total == 4)
        assert engine.live
        last = watch.go(Stop(), State.FINISHED)
        assert not last.live
        assert made[0].finished
    assert camera.closed
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["ended"] == "finished"
    assert (tmp_path / "mesh.ply").is_file()
    assert read_about(tmp_path)["frames_total"] == 4


def test_a_camera_can_be_stepped_and_paused_and_run_to_a_frame(tmp_path):
    camera = FakeCamera().see(1)
    with running(tmp_path, camera, Behaviour()) as (_, watch, __):
        watch.until(lambda m: isinstance(m, Snapshot) and len(m.trajectory) == 1)
        watch.ask(Pause())
        camera.see(1)
        assert watch.go(Step(), State.PAUSED).frame == 1
        assert watch.ask(RunTo(5)).error == ""
        camera.see(4)
        assert watch.state(State.PAUSED, len(watch.seen) - 1).frame == 5
        assert "from 6 on" in watch.ask(RunTo(3)).error


def test_a_camera_that_is_unplugged_ends_the_run_which_says_so(tmp_path):
    camera = FakeCamera().see(2)
    with running(tmp_path, camera, Behaviour()) as (_, watch, made):
        watch.until(lambda m: isinstance(m, Snapshot) and m.frame == 1)
        camera.fail("a camera: is it still plugged in?")
        assert watch.until(lambda m: isinstance(m, Notice) and m.level == "warning").text == camera.trouble
        watch.state(State.FINISHED)
        assert made[0].finished
    assert camera.trouble in json.loads((tmp_path / "summary.json").read_text())["warnings"]


def test_a_camera_that_brings_nothing_is_an_error_in_one_line(tmp_path):
    camera = FakeCamera()
    camera.fail("a camera: brings nothing")
    with pytest.raises(InputError, match="brings nothing"):
        Engine(QUICK, camera, tmp_path, make=maker(Behaviour()), open_sequence=open_fake).run()


def test_a_restart_begins_with_what_the_camera_sees_now_and_after_it_with_the_whole_recording(tmp_path):
    camera = FakeCamera().see(8)
    with running(tmp_path / "a", camera, Behaviour()) as (engine, watch, _):
        watch.until(lambda m: isinstance(m, Snapshot) and len(m.trajectory) == 8)
        watch.ask(Restart())
        watch.until(lambda m: engine.run_folder.name == "a-2" and isinstance(m, Snapshot) and m.dropped == 7)
        assert not camera.closed
        watch.go(Stop(), State.FINISHED)
        assert frames_of(engine.run_folder)[0] == 7
        watch.go(Restart(), State.FINISHED)
        assert frames_of(engine.run_folder) == list(range(8))


def test_going_over_to_another_sequence_switches_the_camera_off(tmp_path):
    camera = FakeCamera().see(2)
    with running(tmp_path / "a", camera, Behaviour(), sequences=("fake:5",)) as (_, watch, __):
        watch.until(lambda m: isinstance(m, Snapshot) and m.frame == 1)
        last = watch.go(Restart(sequence="fake:5"), State.FINISHED)
        assert (last.frames_total, last.live, camera.closed) == (5, False, 1)


def test_leaving_switches_the_camera_off(tmp_path):
    camera = FakeCamera().see(2)
    with running(tmp_path, camera, Behaviour()) as (_, watch, __):
        watch.until(lambda m: isinstance(m, Snapshot) and m.frame == 1)
    assert camera.closed
    assert json.loads((tmp_path / "summary.json").read_text())["ended"] == "interrupted"


def test_ctrl_c_switches_a_camera_off_first_and_only_then_quits(tmp_path):
    camera = FakeCamera().see(2)
    with running(tmp_path, camera, Behaviour()) as (engine, watch, made), quit_on_signals(engine) as came:
        watch.until(lambda m: isinstance(m, Snapshot) and m.frame == 1)
        signal.raise_signal(signal.SIGINT)
        watch.state(State.FINISHED)
        assert made[0].finished
        assert came == []
        signal.raise_signal(signal.SIGINT)
        assert engine.join(10)
    assert came == [signal.SIGINT]
