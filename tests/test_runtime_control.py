"""What commands mean, without an engine."""

import pytest

from ecslam import config_files
from ecslam.config import Config
from ecslam.config_files import apply_settings, for_layout, load_preset
from ecslam.messages import Export, RequestMesh, Restart, RunTo, Step, Stop
from ecslam.runtime.control import Control, Turn


def test_steps_asked_for_while_one_is_at_work_add_up():
    control = Control(Config(), lambda _: None, (), ())
    control.begin(Config(), "fake", 30)
    for _ in range(3):
        control.submit(Step())
    paused = []
    for done in (1, 2, 3):
        control.stepped(done, False)
        paused.append(control._paused)
    assert paused == [False, False, True]
    control.submit(RunTo(20))
    control.submit(Step())
    control.stepped(4, False)
    assert control._paused


def test_a_restart_with_the_same_preset_keeps_the_settings_it_began_with():
    began = config_files.apply_settings(config_files.load_preset("live"), ["mapping.iterations=12"])
    control = Control(began, lambda _: None, (), ("live", "full"))
    control.begin(began, "", 30)
    assert control.restart_config(Restart(preset="live"), "").mapping.iterations == 12
    assert control.restart_config(Restart(preset="full"), "") == config_files.load_preset("full")


@pytest.mark.parametrize(("before", "after"), [("synthetic", "tum"), ("tum", "synthetic"), ("tum", "7scenes")])
def test_a_restart_on_another_layout_takes_what_that_asks_for_and_keeps_own_settings(before, after):
    own = ["mapping.iterations=12", "align.kernels_m=[0.05]", "seed=4"]
    began, wanted = (apply_settings(for_layout(load_preset("live"), layout), own) for layout in (before, after))
    control = Control(began, lambda _: None, ("room",), ("live",))
    control.begin(began, before, 30)
    assert control.restart_config(Restart("room"), after) == wanted
    assert control.restart_config(Restart("room", "live"), after) == wanted
    assert wanted.depth_far_m == (8.0 if after == "synthetic" else 3.0)
    control.begin(began := apply_settings(began, ["depth_far_m=2"]), before, 30)
    assert control.restart_config(Restart("room"), after).depth_far_m == began.depth_far_m


def restarting() -> Control:
    """A run has ended for a restart, whose sequence is being opened."""
    control = Control(Config(), lambda _: None, ("a", "b"), ())
    control.begin(Config(), "fake", 30)
    control.submit(Restart("a"))
    assert control.next_turn(0.0) is Turn.RESTART
    control.end()
    return control


def test_what_is_asked_while_a_restart_opens_its_sequence_is_done_to_the_new_run():
    control = restarting()
    assert control.take_restart().sequence == "a"
    control.submit(Restart("b"))
    control.begin(Config(), "fake", 30)
    assert control.leave_now
    assert control.next_turn(0.0) is Turn.RESTART
    control.end()
    assert control.take_restart().sequence == "b"
    control.submit(Stop())
    control.submit(RequestMesh(0.1))
    control.begin(Config(), "fake", 30)
    assert control.next_turn(0.0) is Turn.WORK
    assert [command for _, command in control.take_work()] == [RequestMesh(0.1)]
    assert control.next_turn(0.0) is Turn.STOP


def test_what_was_asked_of_the_run_before_a_restart_is_dropped_but_for_exports():
    control = restarting()
    for command in (Stop(), RequestMesh(0.1), Export("trajectory")):
        control.submit(command)
    control.take_restart()
    assert [command for _, command in control.take_work()] == [Export("trajectory")]
    control.begin(Config(), "fake", 30)
    assert not control.leave_now
    assert control.next_turn(0.0) is Turn.STEP
