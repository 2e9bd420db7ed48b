"""Ctrl-C: never swallowed, never a traceback."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading

import pytest
import trimesh

from ecslam.datasets.meshes import load_mesh
from ecslam.interrupts import interrupts_held

INTERRUPT = "import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(20)\n"


@pytest.fixture(autouse=True)
def heeded():
    """Where the tests were started in the background, SIGINT is ignored, also in what they start."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def swallow(*_, **__):
    with contextlib.suppress(BaseException):
        signal.raise_signal(signal.SIGINT)
    return trimesh.creation.box()


def test_an_interrupt_waits_for_what_would_swallow_it():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), interrupts_held():
        swallow()
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupt_is_not_lost_on_trimesh(tmp_path, monkeypatch):
    monkeypatch.setattr(trimesh, "load", swallow)
    with pytest.raises(KeyboardInterrupt):
        load_mesh(tmp_path / "mesh.ply")


def test_a_thread_can_hold_none():
    done = []

    def work():
        with interrupts_held():
            done.append(True)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done


@pytest.mark.parametrize("module", ["typer.py", "cv2.py"])
def test_an_interrupt_among_the_imports_is_quiet(tmp_path, module):
    (tmp_path / module).write_text(INTERRUPT)
    path = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH"))))
    command = [sys.executable, "-m", "ecslam", "check", "synthetic/studio"]
    ended = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (-signal.SIGINT, "", "")
