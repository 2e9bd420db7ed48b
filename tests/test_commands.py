"""What the command line says while the dashboard is up."""

import contextlib
import errno
import json
import os
import re
import signal
import threading
import webbrowser
from types import SimpleNamespace
from urllib.request import urlopen

import pytest
from ecslam_app import server
from fake_slam import QUICK, Behaviour, FakeSequence, maker
from runtime_watch import running

from ecslam import commands, reports
from ecslam.messages import Quit, Restart, Resume, State
from ecslam.runtime.engine import Engine
from ecslam.types import InputError


def test_every_run_is_reported_once_as_soon_as_it_is_over(tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(reports, "finish_run", lambda folder, summary: told.append((folder, summary["frames"])))
    with running(tmp_path / "r", FakeSequence(4)) as (engine, watch, _):
        told_of = reports.Reports(engine)
        told_of.watch(watch.state(State.FINISHED))
        told_of.watch(engine.latest())
        told_of.watch(watch.go(Restart(), State.FINISHED))
        told_of.close()
    assert told == [(tmp_path / "r", 4), (tmp_path / "r-2", 4)]


def test_what_ended_a_run_is_said_in_the_terminal_too(tmp_path, capsys):
    with running(tmp_path / "r", FakeSequence(4), Behaviour(fail_at=2)) as (engine, watch, _):
        told_of = reports.Reports(engine)
        told_of.watch(watch.state(State.FAILED))
        assert "error: the map exploded" in capsys.readouterr().out
        told_of.close()


def test_a_run_that_was_left_early_says_how_to_get_its_mesh(tmp_path, capsys):
    with running(tmp_path / "r", paused_at=3) as (engine, _, __):
        engine.submit(Quit())
        assert engine.join(10)
        reports.finish_run(engine.run_folder, engine.summary)
    said = " ".join(capsys.readouterr().out.split())
    assert f"ecslam mesh {tmp_path / 'r'} makes it" in said
    assert f"ecslam resume {tmp_path / 'r'} goes on" in said


def test_a_run_that_was_left_before_its_first_checkpoint_is_to_be_started_again(tmp_path, capsys):
    with running(tmp_path / "r", paused_at=0) as (engine, _, __):
        engine.submit(Quit())
        assert engine.join(10)
        reports.finish_run(engine.run_folder, engine.summary)
    said = capsys.readouterr().out
    assert "nothing to go on from: start again with ecslam run" in said
    assert not any(command in said for command in ("ecslam mesh", "ecslam resume"))


def test_commands_that_are_told_can_be_copied(tmp_path, capsys):
    with running(tmp_path / "my run", paused_at=6) as (engine, _, __):
        engine.submit(Quit())
        assert engine.join(10)
        reports.finish_run(engine.run_folder, engine.summary)
    told = capsys.readouterr().out.replace("\n", " ")
    assert f"ecslam resume '{tmp_path}/my run' goes on" in told


@pytest.mark.parametrize(("state", "frames"), [(State.TRACKING, 100_000), (State.FINISHED, 4)])
def test_a_run_that_a_signal_cuts_short_is_saved_and_has_its_status(tmp_path, monkeypatch, state, frames):
    def interrupt(snapshot, *_, **__):
        if snapshot.state is state and snapshot.frame > 2 and not done:
            done.append(signal.raise_signal(signal.SIGTERM))
        return ""

    done, outcome = [], contextlib.nullcontext() if state is State.FINISHED else pytest.raises(SystemExit)
    monkeypatch.setattr(commands, "progress_line", interrupt)
    with outcome as end:
        commands.run_headless(Engine(QUICK, FakeSequence(frames), tmp_path / "r", make=maker()))
    assert done
    assert end is None or end.value.code == 128 + signal.SIGTERM
    summary = json.loads((tmp_path / "r/summary.json").read_text())
    assert summary["ended"] == ("finished" if state is State.FINISHED else "interrupted")
    assert len((tmp_path / "r/trajectory.txt").read_text().splitlines()) == summary["frames"] > 2


def test_results_lost_to_a_full_disk_are_an_error(tmp_path, monkeypatch, capsys):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with running(tmp_path / "r", paused_at=6) as (engine, watch, _):
        for thread in threading.enumerate():
            if thread.name == "checkpoint":
                thread.join()
        monkeypatch.setattr(os, "fsync", full)
        watch.go(Resume(), State.FINISHED)
        with pytest.raises(InputError) as lost:
            reports.finish_run(engine.run_folder, engine.summary)
    assert str(lost.value) == (
        f"{tmp_path / 'r'}: trajectory.txt, checkpoints, mesh.ply, summary.json could not be saved "
        f"(No space left on device); make room, then: ecslam resume {tmp_path / 'r'}"
    )
    assert re.search(r"the newest checkpoint holds [1-6] of the 30 frames done", capsys.readouterr().out)


def test_the_port_that_was_found_free_is_the_one_that_the_page_has(tmp_path):
    listener = commands.listen("127.0.0.1", 0)
    found = listener.getsockname()[1]
    with running(tmp_path / "r", paused_at=1) as (engine, _, __):
        page = server.start(engine, port=1, listener=listener)
        with urlopen(page.url) as answer:
            assert b"EC-SLAM" in answer.read()
        page.close()
    assert page.port == found


PAGE = SimpleNamespace(
    url="http://localhost:8080/?token=t",
    elsewhere=("http://[fd00::5]:8080/?token=t", "http://here:8080/?token=t"),
    ssh_hint="ssh -L 8080:[fd00::5]:8080 <this machine>",
)


def test_addresses_and_paths_in_brackets_are_said_whole(tmp_path, capsys):
    commands._announce(PAGE, False, "nothing is lost")
    commands.write_synthetic("synthetic/studio?size=32x24&frames=1", tmp_path / "[raw]", "")
    said = "".join(capsys.readouterr().out.split())
    for words in (PAGE.url, *PAGE.elsewhere, PAGE.ssh_hint, str(tmp_path / "[raw]")):
        assert words.replace(" ", "") in said


@pytest.mark.parametrize(("command", "opens"), [("w3m", False), ("lynx", False), ("firefox", True)])
def test_a_browser_never_holds_up_the_run_nor_takes_the_terminal(tmp_path, monkeypatch, command, opens):
    began, closed = threading.Event(), threading.Event()
    browser = webbrowser.GenericBrowser([str(tmp_path / command), "%s"])
    browser.open = lambda url: began.set() or closed.wait(10)
    monkeypatch.setattr(webbrowser, "get", lambda: browser)
    commands._announce(PAGE, True, "nothing is lost")
    assert began.wait(10 if opens else 0.1) == opens
    closed.set()


def test_without_a_browser_there_is_the_address(monkeypatch, capsys):
    monkeypatch.setattr(webbrowser, "get", lambda: (_ for _ in ()).throw(webbrowser.Error("none")))
    commands._announce(PAGE, True, "nothing is lost")
    assert PAGE.url in capsys.readouterr().out
