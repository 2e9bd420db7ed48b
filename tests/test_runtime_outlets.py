"""A run outlasts whatever it prints to."""

from __future__ import annotations

import os
import sys
import threading

import pytest

from ecslam.runtime.outlets import lasting_outputs


@pytest.fixture
def closed_pipe():
    """A stream into a pipe that nobody reads."""
    reading, writing = os.pipe()
    os.close(reading)
    stream = os.fdopen(writing, "w", buffering=1)
    yield stream
    stream.close()


def test_a_pipe_that_is_closed_is_told_once_and_ends_nothing(closed_pipe, capfd, monkeypatch):
    monkeypatch.setattr(sys, "stdout", closed_pipe)
    with lasting_outputs():
        for i in range(3):
            print("line", i)
        thread = threading.Thread(target=lambda: print("from a thread", flush=True))
        thread.start()
        thread.join()
    assert sys.stdout is closed_pipe
    assert capfd.readouterr().err == "note: the output takes no more (Broken pipe); nothing more is printed\n"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
def test_outputs_on_a_full_disk_end_nothing(monkeypatch):
    with open("/dev/full", "w") as out, open("/dev/full", "w") as errors:
        monkeypatch.setattr(sys, "stdout", out)
        monkeypatch.setattr(sys, "stderr", errors)
        with lasting_outputs():
            print("a line", flush=True)
            print("an error", file=sys.stderr, flush=True)
            print("what is still buffered")


def test_outputs_that_were_closed_from_the_start_stay_so(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    with lasting_outputs():
        print("nowhere")
    assert sys.stdout is None


def test_what_is_printed_arrives(capsys):
    with lasting_outputs():
        print("a line")
        print("an error", file=sys.stderr)
    assert capsys.readouterr() == ("a line\n", "an error\n")
