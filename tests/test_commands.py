"""What the command line says while the dashboard is up."""

from urllib.request import urlopen

from ecslam_app import server
from fake_slam import Behaviour, FakeSequence
from runtime_watch import running

from ecslam import commands
from ecslam.messages import Quit, Restart, State


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


def test_what_ended_a_run_is_said_in_the_terminal_too(tmp_path, capsys):
    with running(tmp_path / "r", FakeSequence(4), Behaviour(fail_at=2)) as (engine, watch, _):
        reports = commands.Reports(engine)
        reports.watch(watch.state(State.FAILED))
        assert "error: the map exploded" in capsys.readouterr().out
        reports.close()


def test_a_run_that_was_left_early_says_how_to_get_its_mesh(tmp_path, capsys):
    with running(tmp_path / "r", paused_at=3) as (engine, _, __):
        engine.submit(Quit())
        assert engine.join(10)
        commands.finish_run(engine.run_folder, engine.summary)
    said = " ".join(capsys.readouterr().out.split())
    assert f"ecslam mesh {tmp_path / 'r'} makes it" in said
    assert f"ecslam resume {tmp_path / 'r'} goes on" in said


def test_the_port_that_was_found_free_is_the_one_that_the_page_has(tmp_path):
    listener = commands.listen("127.0.0.1", 0)
    found = listener.getsockname()[1]
    with running(tmp_path / "r", paused_at=1) as (engine, _, __):
        page = server.start(engine, port=1, listener=listener)
        with urlopen(page.url) as answer:
            assert b"EC-SLAM" in answer.read()
        page.close()
    assert page.port == found
