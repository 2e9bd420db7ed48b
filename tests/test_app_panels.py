"""What every panel owes the hub, what the page shows of a run, and how quickly a control answers."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import viser
from ecslam_app import server, theme
from ecslam_app.panel import TABS, BasePanel, find_panels
from ecslam_app.panels.export import Panel as Export
from ecslam_app.panels.loops import Panel as Loops
from ecslam_app.panels.notices import Panel as Notices
from ecslam_app.panels.status import WORDS, render
from ecslam_app.panels.status import Panel as Status

from ecslam import config_files
from ecslam import messages as m
from ecslam.runtime.engine import Engine
from tests.fake_engine import FakeEngine, room_mesh, write_run
from tests.fake_slam import QUICK, FakeSequence, maker
from tests.test_app_security import control, dial, enter, hit, press, until, viewing

PANELS = find_panels()


@pytest.fixture
def engine(tmp_path):
    engine = FakeEngine(tmp_path / "run", frames=60, period=0.02)
    yield engine
    engine.stop()


@pytest.fixture
def page(engine):
    page = server.start(engine, port=0)
    yield page
    page.close()


@pytest.fixture(scope="module")
def replay_page(tmp_path_factory):
    page = server.view([write_run(tmp_path_factory.mktemp("runs") / "a", 30)], port=0)
    assert until(lambda: page.hub.current is not None)
    yield page
    page.close()


@pytest.mark.parametrize("panel", PANELS, ids=lambda p: p.__module__.rsplit(".")[-1])
def test_panel_keeps_the_contract(panel):
    assert issubclass(panel, BasePanel)
    assert panel.tab in ("", *TABS)
    assert panel.__doc__
    assert sys.modules[panel.__module__].__doc__


def test_every_tab_has_a_panel_and_no_two_share_a_place():
    assert {p.tab for p in PANELS} >= set(TABS)
    for hub_kind in (True, False):
        shown = [(p.tab, p.order) for p in PANELS if p.applies(_Hub(hub_kind))]
        assert len(shown) == len(set(shown))


def test_the_last_window_stays_on_the_page_between_two_mappings(engine, page):
    engine.skip_to(9)
    assert until(lambda: page.hub.current is engine.latest())
    mapped = replace(engine.snapshot(), frame=10, reported=10, window=(0, 5, 10), map_ms=80.0)
    for s in (mapped, replace(mapped, frame=11, reported=11, window=(), map_ms=0.0)):
        page.engine.publish(s)
        assert until(lambda s=s: page.hub.current is not None and page.hub.current.frame == s.frame)
    assert page.hub.current.window == (0, 5, 10)
    assert page.hub.current.map_ms == 80.0
    assert page.hub.history.series(["map_ms"])[1].tolist()[-1] == 0.0
    page.engine.publish(replace(mapped, frame=0, window=()))
    assert until(lambda: page.hub.current.frame == 0)
    assert page.hub.current.window == (), "a new run has had no mapping yet"


def test_the_plots_of_a_resumed_run_begin_at_its_first_frame(tmp_path):
    folder = write_run(tmp_path / "run", 30)
    engine = FakeEngine(folder, frames=60).skip_to(30)
    page = server.start(engine, port=0)
    try:
        assert until(lambda: page.hub.current is engine.latest())
        assert page.hub.history.series(["ate_cm"])[0].tolist() == list(range(31))
    finally:
        page.close()


def test_why_there_is_no_mesh_stays_on_the_page(tmp_path):
    run = write_run(tmp_path / "a", 30)
    (run / "mesh.ply").write_bytes(b"ply\nnonsense")
    page = server.view([run], port=0)
    status = next(p for p in page.hub.panels if isinstance(p, Status))
    try:
        assert until(lambda: "mesh.ply: not a readable mesh" in status._html.content)
        page.engine.submit(m.RunTo(5))
        assert until(lambda: page.hub.current.frame == 5)
        assert "mesh.ply: not a readable mesh" in status._html.content
    finally:
        page.close()


def test_a_second_run_without_a_readable_mesh_says_so(tmp_path, monkeypatch):
    runs = [write_run(tmp_path / name, 30) for name in "ab"]
    (runs[1] / "mesh.ply").write_bytes(b"ply\nnonsense")
    page, told = server.view(runs, port=0), []
    monkeypatch.setattr(page.hub, "toast", lambda title, text, *rest: told.append(text))
    try:
        with dial(page) as client:
            enter(client)
            press(page, client, "Mesh of", "b")
            assert until(lambda: told)
        assert "mesh.ply: not a readable mesh" in told[0]
    finally:
        page.close()


def test_a_halt_is_announced_until_it_has_come_about(engine, page):
    engine.skip_to(9)
    assert until(lambda: page.hub.current is engine.latest())
    status = Status(page.hub)  # one that the page itself shows nothing on
    page.hub.current = moving = replace(engine.snapshot(), state=m.State.TRACKING)
    status.ack(m.Ack(1, m.Pause()))
    assert "Pausing" in status._html.content
    status.snapshot(replace(moving, frame=10))
    assert "Pausing" in status._html.content
    status.snapshot(replace(moving, frame=11, state=m.State.PAUSED))
    assert "Paused" in status._html.content
    status.ack(m.Ack(2, m.Resume()))
    assert "Resuming" in status._html.content
    status.snapshot(replace(moving, frame=12))
    assert "Resuming" not in status._html.content
    status.ack(m.Ack(3, m.Pause(), "the run is over"))
    assert "Pausing" not in status._html.content


def test_a_new_run_hides_what_the_last_one_drew(engine, page):
    scene, s = page.hub.scene, engine.skip_to(20).snapshot()
    scene.update(s)
    assert scene._camera.visible
    assert scene._frusta.visible
    empty = replace(s, frame=0, trajectory=s.trajectory[:0], keyframes=(), window=(), loops=())
    scene.begin(empty)
    scene.update(empty)
    assert not scene._camera.visible
    assert not scene._frusta.visible
    scene.update(s)
    assert scene._camera.visible
    assert scene._frusta.visible


def test_a_mesh_that_overtakes_the_first_snapshot_of_its_run_stays(engine, page):
    with page.hub._subscription._changed:  # the listener has not heard of the snapshot yet
        engine.publish()
        page.hub.post(lambda: page.hub._tell(m.MeshReady(0, 0.04, room_mesh())))
        assert until(lambda: page.hub.scene.mesh is not None)
    assert until(lambda: page.hub.current is engine.latest())
    assert page.hub.scene.mesh is not None


def test_a_new_run_of_equal_length_brings_its_own_truth_and_camera(engine, page):
    scene, s = page.hub.scene, engine.skip_to(20).snapshot()
    assert until(lambda: page.hub.current is engine.latest())
    scene.update(s)
    moved = s.trajectory_gt.copy()
    moved[:, :3, 3] += 1.0
    truth, corners = scene._lines["trajectory/ground truth"].points.copy(), scene._frusta.vertices.copy()
    other = replace(s, frame=0, trajectory_gt=moved, fov_y_rad=0.5, aspect=2.0)
    scene.begin(other)
    scene.update(other)
    assert np.allclose(scene._lines["trajectory/ground truth"].points, truth + 1.0, atol=1e-5)
    assert (scene._camera.fov, scene._camera.aspect) == (0.5, 2.0)
    assert not np.allclose(scene._frusta.vertices, corners)


def test_the_controls_begin_with_what_the_run_was_given(tmp_path):
    engine = FakeEngine(tmp_path / "run", frames=60)
    engine.run_folder.mkdir()
    config = config_files.load_preset("live")
    settings = ["seed=7", "schedule=overlap", "mapping.iterations=23"]
    (engine.run_folder / "config.yaml").write_text(config_files.to_yaml(config_files.apply_settings(config, settings)))
    engine._preset = "live"
    page = server.start(engine.skip_to(3), port=0)
    try:
        wanted = {"Seed": 7, "Schedule": "overlap", "Tracking": 0, "Mapping": 23}
        for label, value in wanted.items():
            assert until(lambda label=label, value=value: control(page, label)[1].value == value), label
    finally:
        page.close()


def test_a_restart_takes_back_what_was_tuned(tmp_path):
    engine = Engine(QUICK, FakeSequence(400), tmp_path / "run", make=maker())
    engine.submit(m.SpeedLimit(20.0))
    page = server.start(engine, port=0)
    slider = control(page, "Mapping")[1]
    engine.start()
    try:
        for again in (m.Restart(), m.LoadPreset(QUICK.preset)):
            assert until(lambda: page.hub.current is not None and page.hub.current.frame >= 3)
            with viewing(page) as client:
                press(page, client, "Mapping", 33)
                assert until(lambda: engine._control.config.mapping.iterations == 33)
            engine.submit(again)
            assert until(lambda: slider.value == engine._control.config.mapping.iterations != 33), again
    finally:
        engine.submit(m.Quit())
        engine.join()
        page.close()


def test_the_slider_of_a_replay_follows_wherever_it_goes(replay_page):
    slider = control(replay_page, "Frame")[1]
    replay_page.engine.submit(m.RunTo(11))
    assert until(lambda: slider.value == 11)
    replay_page.engine.submit(m.Step())
    assert until(lambda: slider.value == 12)
    with dial(replay_page) as client:
        enter(client)
        assert until(lambda: list(replay_page.hub.viewers()))
        press(replay_page, client, "Frame", 20)
        assert until(lambda: replay_page.hub.current.frame == 20)
        assert slider.value == 20
    replay_page.engine.submit(m.Step())
    assert until(lambda: slider.value == 21)


def test_a_replay_announces_nothing_that_it_has_done_already(replay_page):
    status = Status(replay_page.hub)
    status.ack(m.Ack(1, m.RunTo(11)))
    assert "Running on" not in status._html.content


def test_the_plots_of_a_replay_mark_the_frame_that_is_shown(replay_page):
    chart = next(p for p in replay_page.hub.panels if p.tab == "Plots")._error
    for frame in (4, 23):
        replay_page.engine.submit(m.RunTo(frame))
        assert until(lambda frame=frame: replay_page.hub.current.frame == frame)
        assert until(lambda frame=frame: set(chart._plot.data[0][np.isfinite(chart._plot.data[-1])]) == {frame})
    frames, values, upright = chart._plot.data
    assert frames[np.isfinite(values)].tolist() == sorted([*range(30), 23])
    assert upright[np.isfinite(upright)].tolist() == [0.0, chart._plot.scales["y"]["range"][1]]
    assert chart._plot.series[-1]["points"]["show"] is False, "in a short run its two ends would be circled"
    assert len(chart._plot.series) == 3


def test_the_plots_number_frames_in_whole_steps(replay_page):
    chart = next(p for p in replay_page.hub.panels if p.tab == "Plots")._error
    steps = chart._plot.axes[0]["incrs"]
    assert steps[:4] == (1, 2, 5, 10)
    assert all(float(step).is_integer() for step in steps)


def test_a_loop_is_inspected_only_while_it_has_happened(replay_page):
    choice, scene = control(replay_page, "Loop event")[1], replay_page.hub.scene
    with dial(replay_page) as client:
        enter(client)
        for frame, inspected in ((29, True), (20, False), (29, False)):
            replay_page.engine.submit(m.RunTo(frame))
            assert until(lambda frame=frame: replay_page.hub.current.frame == frame)
            if inspected:
                assert until(lambda: control(replay_page, "Go to")[1].visible)
                press(replay_page, client, "Go to", "Next event")
                assert until(lambda: scene._inspected is not None)
            assert until(lambda inspected=inspected: (scene._inspected is not None) == inspected)
            assert choice.value.startswith("Frame 27") == inspected


def test_loops_are_offered_only_once_there_are_any(replay_page):
    panel = next(p for p in replay_page.hub.panels if isinstance(p, Loops))
    for frame, some in ((20, False), (29, True)):
        replay_page.engine.submit(m.RunTo(frame))
        assert until(lambda frame=frame: replay_page.hub.current.frame == frame)
        assert until(lambda some=some: panel._steps.visible is some)
        assert panel._choice.visible is panel._legend.visible is some
        assert ("None has closed" in panel._html.content) is not some


def test_a_replay_scrubbed_back_says_what_its_exports_are_of(replay_page):
    note = next(p for p in replay_page.hub.panels if p.tab == "Export")._whole
    replay_page.engine.submit(m.RunTo(20))
    assert until(lambda: note.visible and "frame 20." in note.content)
    assert "frames 0 to 29" in note.content
    replay_page.engine.submit(m.RunTo(29))
    assert until(lambda: not note.visible)


def test_without_ground_truth_nothing_on_the_page_speaks_of_it(tmp_path):
    engine = FakeEngine(tmp_path / "run", frames=60, truth=False).skip_to(50)
    page = server.start(engine, port=0)
    loops, status = (next(p for p in page.hub.panels if isinstance(p, kind)) for kind in (Loops, Status))
    try:
        assert until(lambda: page.hub.current is engine.latest())
        assert not loops._chart.visible, "no loop, nothing to plot"
        engine.skip_to(59)
        assert until(lambda: page.hub.current is engine.latest())
        assert until(lambda: loops._chart.visible)
        assert loops._chart._plot.title == "Correction (cm)"
        frames, values, marks = loops._chart._plot.data
        assert frames[np.isfinite(values)].tolist() == frames[np.isfinite(marks)].tolist() == [54]
        assert "ground truth" not in status._html.content
    finally:
        page.close()


def test_the_plots_say_that_there_is_nothing_yet(engine, page):
    plots = next(p for p in page.hub.panels if p.tab == "Plots")
    for frame, empty in ((0, True), (5, False)):
        engine.skip_to(frame)
        assert until(lambda: page.hub.current is engine.latest())
        assert until(lambda empty=empty: plots._none.visible == empty)


def test_notices_stay_on_the_page_until_a_restart(engine, page):
    html = next(p for p in page.hub.panels if isinstance(p, Notices))._html
    assert not html.visible
    for frame in range(12):
        engine._feed.publish(m.Notice("warning", "skipped: <cut> short", frame))
    engine._feed.publish(m.Notice("error", "metrics.jsonl could not be saved (No space left on device)"))
    assert until(lambda: "No space left on device" in html.content)
    assert html.visible
    assert html.content.index("No space") < html.content.index("Frame 11: skipped: &lt;cut&gt; short")
    assert "Frame 4:" not in html.content
    assert "and 5 before these, in events.jsonl" in html.content
    engine.start().submit(m.Restart())
    assert until(lambda: not html.visible)


def test_the_page_says_where_the_run_lies(engine, page, tmp_path):
    html = next(p for p in page.hub.panels if isinstance(p, Export))._where
    assert f"Run folder: {tmp_path / 'run'}<" in html.content
    engine.skip_to(9)
    assert until(lambda: page.hub.current is engine.latest())
    engine.run_folder = tmp_path / "run-2"
    engine._feed.publish(replace(engine.snapshot(), frame=0))
    assert until(lambda: f"Run folder: {tmp_path / 'run-2'}<" in html.content)


def test_that_a_run_prepares_is_no_notice_once_it_has_begun(engine, page):
    html = next(p for p in page.hub.panels if isinstance(p, Notices))._html
    engine._feed.publish(replace(engine.snapshot(), reported=None))
    engine._feed.publish(m.Notice("info", "Preparing: kernels"))
    engine._feed.publish(m.Notice("info", "relocalised", 3))
    assert until(lambda: "relocalised" in html.content)
    assert "Preparing" in html.content
    engine.skip_to(4)
    assert until(lambda: "Preparing" not in html.content)
    assert "Frame 3: relocalised" in html.content


def test_a_notice_names_its_frame_once(engine, page):
    html = next(p for p in page.hub.panels if isinstance(p, Notices))._html
    engine._feed.publish(m.Notice("info", "preset lite from frame 41 on", 41))
    engine._feed.publish(m.Notice("warning", "lost, as in frame 41", 4))
    assert until(lambda: "Frame 4: lost, as in frame 41" in html.content)
    assert "Frame 41" not in html.content


@pytest.mark.parametrize(
    ("count", "says"),
    [(820, "820 bytes"), (1_400, "1 kB"), (45_300, "45 kB"), (999_600, "1.0 MB"), (12_340_000, "12.3 MB")],
)
def test_files_have_sizes_for_people(count, says):
    assert theme.size(count) == says


def test_what_the_status_card_says_is_no_notice_besides(engine, page):
    html = next(p for p in page.hub.panels if isinstance(p, Notices))._html
    engine.skip_to(3)
    engine._feed.publish(m.Notice("error", "the map exploded"))
    assert until(lambda: "the map exploded" in html.content)
    engine._feed.publish(replace(engine.latest(), state=m.State.FAILED, reason="the map exploded"))
    assert until(lambda: not html.visible)
    assert "the map exploded" not in html.content


def test_a_finished_run_shows_its_notices(tmp_path):
    run = write_run(tmp_path / "a", 30)
    with (run / "events.jsonl").open("a") as log:
        log.write('{"type":"notice","level":"warning","text":"lost","frame":7}\n')
        log.write('{"type":"notice","level":"error","text":"no memory","frame":null}\n')
    (run / "summary.json").write_text('{"ended":"failed","error":"no memory"}')
    page = server.view([run], port=0)
    html = next(p for p in page.hub.panels if isinstance(p, Notices))._html
    try:
        assert until(lambda: "no memory" not in html.content), "the status card says it"
        assert "Frame 7: lost" in html.content
    finally:
        page.close()


def test_the_space_key_plays_and_pauses_a_replay(replay_page):
    replay_page.engine.submit(m.SpeedLimit(1.0))
    replay_page.engine.submit(m.RunTo(3))
    with dial(replay_page) as client:
        enter(client)
        assert until(lambda: replay_page.hub.current.frame == 3)
        hit(replay_page, client, "Pause or go on")
        assert until(lambda: replay_page.hub.current.state is m.State.TRACKING)
        hit(replay_page, client, "Pause or go on")
        assert until(lambda: replay_page.hub.current.state is m.State.PAUSED)
        before = replay_page.hub.current.frame
        hit(replay_page, client, "Step one frame")
        assert until(lambda: replay_page.hub.current.frame == before + 1)


def test_the_space_key_pauses_a_run_and_lets_it_go_on(page, engine):
    engine.start()
    with dial(page) as client:
        enter(client)
        assert until(lambda: page.hub.current is not None)
        hit(page, client, "Pause or go on")
        assert until(lambda: page.hub.current.state is m.State.PAUSED)
        hit(page, client, "Pause or go on")
        assert until(lambda: m.Resume() in engine.log)


@pytest.mark.parametrize("end", [m.State.FINISHED, m.State.FAILED])
def test_a_run_that_is_over_offers_no_steering_until_a_restart(engine, page, end):
    def usable():
        labels = ("Frame", "Run to frame", "Go on with this preset", "Mapping", "Tracking")
        return {control(page, "Run")[1].visible, *(not control(page, label)[1].disabled for label in labels)}

    s = replace(engine.skip_to(9).snapshot(), state=m.State.TRACKING)
    assert until(lambda: page.hub.current is engine.latest())
    for shown, wanted in ((s, True), (replace(s, frame=10, state=end), False), (replace(s, frame=0), True)):
        page.engine.publish(shown)
        assert until(lambda shown=shown: page.hub.current.state is shown.state)
        assert until(lambda wanted=wanted: usable() == {wanted})
    assert not control(page, "Restart")[1].disabled


def test_an_export_that_fails_is_no_longer_under_way(page, engine, monkeypatch):
    told = []
    monkeypatch.setattr(page.hub, "toast", lambda title, text, color, client=None: told.append((title, text)))
    monkeypatch.setattr(engine, "_carry_out", lambda number, command: None)
    engine.start()
    with viewing(page) as client:
        press(page, client, "Export keyframes", True)
        assert until(lambda: page.hub._under_way)
        (number,) = page.hub._under_way
        engine._feed.publish(m.Exported("keyframes", "", number, "No space left on device"))
        assert until(lambda: ("Not exported", "keyframes: No space left on device") in told)
        assert page.hub._under_way == {}


def test_pictures_are_asked_for_the_more_seldom_the_longer_they_take(engine, page):
    panel = next(p for p in page.hub.panels if p.tab == "Pictures")
    s = replace(engine.skip_to(9).snapshot(), state=m.State.TRACKING)
    pictures = m.FramePictures(9, *[np.zeros((2, 2, 3), np.uint8)] * 6, took_s=0.3)
    with viewing(page):
        panel.snapshot(replace(s, frame=10))
        panel._asked -= 9.0
        panel.event(pictures)
        for waited, asks in ((8.0, False), (11.0, True)):
            panel._asked = time.monotonic() - waited
            panel.snapshot(replace(s, frame=11))
            assert (panel._asked_frame == 11) == asks
        panel.event(replace(pictures, took_s=2.0))
        panel._asked = time.monotonic() - 21.0
        panel.snapshot(replace(s, frame=12))
        assert panel._asked_frame == 12, "even pictures that wait for a compiler do not stop the refreshing"


def test_a_page_opened_while_the_run_stands_still_shows_pictures(engine, page):
    engine.skip_to(10).start()
    assert until(lambda: page.hub.current is engine.latest())
    with dial(page) as client:
        enter(client)
        assert until(lambda: m.RequestPictures() in engine.log)


def test_a_replay_shows_the_pictures_that_its_run_kept(replay_page, engine):
    panel = next(p for p in replay_page.hub.panels if p.tab == "Pictures")
    assert "kept no pictures" in panel._html.content
    panel.snapshot(engine.skip_to(12).snapshot())
    assert "Keyframe 10" in panel._html.content
    assert "data:image/jpeg" in panel._html.content


class _Hub:
    def __init__(self, live):
        self.replay = None if live else type("Replay", (), {"others": (1,)})


def test_a_new_file_is_found(tmp_path, monkeypatch):
    import ecslam_app.panels as folder

    (tmp_path / "extra.py").write_text(
        "from ecslam_app.panel import BasePanel\nclass Panel(BasePanel):\n    tab, order = 'View', 99\n"
    )
    monkeypatch.setattr(folder, "__path__", [*folder.__path__, str(tmp_path)])
    assert any(p.__module__.endswith("extra") for p in find_panels())
    sys.modules.pop("ecslam_app.panels.extra")


def odd_snapshots(engine):
    engine._advance()
    for _ in range(12):
        engine._advance()
    s = engine.snapshot()
    hole = s.trajectory_gt.copy()
    hole[3:9] = np.nan
    yield s
    yield replace(s, trajectory_gt=None, ate_cm=None)
    yield replace(s, trajectory_gt=hole)
    yield replace(s, trajectory_gt=np.full_like(hole, np.nan), ate_cm=float("nan"))
    yield replace(s, keyframes=(), window=(), color=None, losses={})
    yield replace(s, frame=0, trajectory=s.trajectory[:1], loops=())
    yield replace(s, state=m.State.FAILED, reason="the disk is full", sequence="<script>alert(1)</script>")


def test_panels_and_scene_show_every_kind_of_snapshot(page, engine, caplog):
    odd, same = list(odd_snapshots(engine)), ("trajectory", "trajectory_gt", "keyframes", "losses", "state")
    assert until(lambda: page.hub.current is engine.latest())
    for s in odd:
        done = threading.Event()
        page.engine.publish(s)
        page.hub.post(done.set)
        time.sleep(0.2)
        assert done.wait(2)
        assert until(lambda s=s: all(getattr(page.hub.current, name) is getattr(s, name) for name in same))
    assert "could not carry out" not in caplog.text


@pytest.mark.parametrize("state", list(m.State))
def test_state_is_told_in_plain_words(engine, state):
    engine._advance()
    html = render(replace(engine.snapshot(), state=state, reason="why <b>"), "")
    assert WORDS[state] in html
    assert "why &lt;b&gt;" in html
    assert "Frame <b>0</b></span>" in html
    assert "1 of 60" in html


@pytest.mark.parametrize(
    ("skipped", "lost", "says"), [(3, 0, "3 frames skipped<"), (0, 1, ">1 frame lost"), (1, 2, "1 frame skipped, 2 fr")]
)
def test_only_frames_that_were_missed_are_counted(engine, skipped, lost, says):
    html = render(replace(engine.snapshot(), skipped=skipped, lost_frames=lost), "")
    assert says in html
    assert "0 frames" not in html


def test_a_camera_that_is_on_is_told_with_how_far_the_run_is_behind_it(engine):
    html = render(replace(engine.snapshot(), live=True, frames_total=14, dropped=12), "")
    assert "camera on, 13 behind" in html
    assert "of 14" not in html
    assert "12 frames left out to keep up" in html


def test_where_there_is_no_figure_there_is_a_dash_without_a_unit(engine):
    none = {"fps_wall": 0.0, "fps_engine": 0.0, "ate_cm": None, "track_ms": 0.0, "map_ms": 0.0, "memory_mb": 0.0}
    html = render(replace(engine.snapshot(), preset="", **none), "")
    assert html.count("<b>–<small></small></b>") == len(none)
    assert ">synthetic/studio</span>" in html


def test_a_replay_plays_and_does_not_track(replay_page):
    status = next(p for p in replay_page.hub.panels if isinstance(p, Status))
    replay_page.engine.submit(m.SpeedLimit(1.0))
    for command, says in ((m.RunTo(29), "At the end"), (m.RunTo(3), "Paused"), (m.Resume(), "Playing")):
        replay_page.engine.submit(command)
        assert until(lambda says=says: says in status._html.content)
    replay_page.engine.submit(m.Pause())


def test_controls_answer_at_once_while_the_page_is_busy(page, engine):
    engine.start()
    with dial(page) as client:
        enter(client)
        page.hub.post(lambda: time.sleep(1.5))
        started = time.monotonic()
        press(page, client, "Run", "Pause")
        assert until(lambda: m.Pause() in engine.log, 1.0)
        assert time.monotonic() - started < 0.2


@pytest.mark.parametrize(
    ("label", "value", "command"),
    [
        ("Run", "Step", m.Step()), ("Run to frame", True, m.RunTo(0)),
        ("Limit (frames/s)", 12, m.SpeedLimit(12.0)), ("Pause on loops", True, m.PauseOnLoop(True)),
        ("Restart", True, m.Restart("synthetic/studio", "lite", 0, "auto", False)),
        ("Go on with this preset", True, m.LoadPreset("lite")),
        ("Mapping", 33, m.Tune("mapping.iterations", 33)),
        ("Export mesh", True, m.Export("mesh", "ply", 0.02)),
        ("Export trajectory", True, m.Export("trajectory", "tum")),
        ("Export keyframes", True, m.Export("keyframes")), ("Export run as zip", True, m.Export("run", "zip")),
        ("Export configuration", True, m.Export("config")),
    ],
)  # fmt: skip
def test_each_control_sends_its_command(page, engine, label, value, command):
    engine._thread.start()
    engine._state = m.State.PAUSED
    with dial(page) as client:
        enter(client)
        press(page, client, label, value)
        assert until(lambda: command in engine.log)


def test_the_mesh_mode_in_force_is_marked(replay_page):
    with dial(replay_page) as client:
        enter(client)
        press(replay_page, client, "Mesh", "Wireframe")
        assert until(lambda: replay_page.hub.scene._mode == "Wireframe")
    mode = control(replay_page, "Mesh")[1]
    assert isinstance(mode, viser.GuiDropdownHandle), "unlike a group of buttons, it shows its value"
    assert mode.value == "Wireframe"


def test_every_label_fits_into_one_line(page, replay_page):
    for shown in (page, replay_page):
        for handle in shown.hub.server.gui._gui_input_handle_from_uuid.values():
            assert isinstance(handle, viser.GuiButtonHandle) or len(handle.label) <= 16, handle.label


def test_the_voxel_size_of_a_mesh_is_asked_for_only_where_one_is_made(page, replay_page):
    assert control(page, "Voxel size (cm)")[1].visible
    assert not control(replay_page, "Voxel size (cm)")[1].visible


def test_live_only_controls_are_absent_from_a_replay(replay_page):
    for label in ("Run", "Restart", "Mapping", "Pause on loops"):
        with pytest.raises(KeyError):
            control(replay_page, label)


def test_dashboard_imports_no_torch():
    code = "import sys, ecslam_app.server, ecslam_app.panel as p; p.find_panels(); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
