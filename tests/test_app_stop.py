"""Stop is for good: the page says so, asks before it, and asks nobody whose run ends anyway."""

from __future__ import annotations

from dataclasses import replace

import pytest
from ecslam_app import server
from ecslam_app.panels.control import CANCEL, FOR_GOOD, REALLY

from ecslam import messages as m
from tests.fake_engine import FakeEngine
from tests.test_app_security import control, press, until, viewing


@pytest.fixture
def page(tmp_path):
    engine = FakeEngine(tmp_path / "run", frames=60).skip_to(9).start()
    page = server.start(engine, port=0)
    assert until(lambda: page.hub.current is engine.latest())
    yield page
    page.close()
    engine.stop()


@pytest.fixture
def viewer(page):
    with viewing(page) as connection:
        yield connection


def asked(page):
    panel = next(p for p in page.hub.panels if hasattr(p, "_sure"))
    assert until(lambda: panel._warning.visible == panel._sure.visible)
    assert FOR_GOOD in panel._warning.content
    return panel._sure.visible


def test_stop_asks_first_and_can_be_taken_back(page, viewer):
    assert "for good" in control(page, "Run")[1].hint
    assert not asked(page)
    press(page, viewer, "Stop?", REALLY)
    press(page, viewer, "Run", "Stop")
    assert until(lambda: asked(page))
    press(page, viewer, "Stop?", CANCEL)
    assert until(lambda: not asked(page))
    press(page, viewer, "Run", "Step")
    assert until(lambda: m.Step() in page.engine.log)
    assert m.Stop() not in page.engine.log, "neither a question nor an answer that nobody saw stops the run"


def test_who_confirms_stops_the_run_and_is_not_asked_again(page, viewer):
    press(page, viewer, "Run", "Stop")
    assert until(lambda: asked(page))
    press(page, viewer, "Stop?", REALLY)
    assert until(lambda: m.Stop() in page.engine.log)
    assert until(lambda: not asked(page))
    page.engine.publish(replace(page.engine.snapshot(), state=m.State.MAPPING, reason="Last mapping 3/9"))
    assert until(lambda: page.hub.current.state is m.State.MAPPING)
    press(page, viewer, "Run", "Stop")
    assert until(lambda: page.engine.log.count(m.Stop()) == 2), "the last mapping is left out at once"


def test_after_the_last_frame_stop_needs_no_question(page, viewer):
    page.engine.publish(replace(page.engine.snapshot(), frame=59, state=m.State.MAPPING))
    assert until(lambda: page.hub.current.frame == 59)
    press(page, viewer, "Run", "Stop")
    assert until(lambda: m.Stop() in page.engine.log)
    assert not asked(page)


def test_a_camera_has_no_last_frame_so_stop_asks_always(page, viewer):
    page.engine.publish(replace(page.engine.snapshot(), frame=59, live=True))
    assert until(lambda: page.hub.current.live)
    press(page, viewer, "Run", "Stop")
    assert until(lambda: asked(page))
    assert m.Stop() not in page.engine.log


@pytest.mark.parametrize("change", [{"state": m.State.FINISHED}, {"frame": 0}], ids=["the end", "a new run"])
def test_a_question_about_a_run_that_is_over_goes_away(page, viewer, change):
    press(page, viewer, "Run", "Stop")
    assert until(lambda: asked(page))
    page.engine.publish(replace(page.engine.snapshot(), **change))
    assert until(lambda: not asked(page))
