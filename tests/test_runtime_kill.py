"""Processes that are killed: what is on the disk then, and that signals save and end in time."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from fake_slam import FakeSequence, maker

from ecslam.runtime.checkpoint import load_checkpoint
from ecslam.runtime.engine import Engine
from ecslam.runtime.files import read_lines

pytestmark = pytest.mark.slow

SCRIPT = """
import sys
from pathlib import Path
from fake_slam import QUICK, Behaviour, FakeSequence, maker
from ecslam.runtime import checkpoint_writer
from ecslam.runtime.checkpoint import load_checkpoint
from ecslam.runtime.engine import Engine
from ecslam.runtime.signals import quit_on_signals

checkpoint_writer.PATIENCE_S = 0.0  # quick frames are held to the promise for slow ones
out, first, pause = Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
make = maker(Behaviour(first_interrupts=first, pause_s=pause))
sequence = FakeSequence(100_000)
if (out / "checkpoints").is_dir():
    engine = Engine.resume(out, sequence=sequence, make=make)
else:
    engine = Engine(QUICK, sequence, out, make=make)
with quit_on_signals(engine):
    engine.run(lambda snapshot: print(snapshot.frame, flush=True))
print("saved", flush=True)
"""


def start(out: Path, first: int = 1, pause: float = 0.002) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, "-c", SCRIPT, str(out), str(first), str(pause)]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),  # tests may run under nohup
    )


def read_until(process: subprocess.Popen, frame: int) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        if int(line) >= frame:
            return
    raise AssertionError(process.communicate()[1])


def test_kill_at_any_moment_leaves_a_run_that_goes_on(tmp_path):
    done = 0
    for kill in range(4):
        process = start(tmp_path / "run")
        try:
            read_until(process, done + 15)
            time.sleep(0.013 * kill)
        finally:
            process.kill()
            process.communicate()
        reached = max(line["frame"] for line in read_lines(tmp_path / "run/metrics.jsonl")) + 1
        before, done = done, load_checkpoint(tmp_path / "run/checkpoints").frame
        resumed = Engine.resume(tmp_path / "run", sequence=FakeSequence(100_000), make=maker())
        resumed._run.folder.close()  # it is not run, and the next process needs the folder
        assert before <= done <= reached
        kept = [line["frame"] for line in read_lines(tmp_path / "run/metrics.jsonl")]
        assert kept == list(range(done))


def test_a_kill_costs_at_most_ten_frames_where_they_take_over_three_seconds(tmp_path):
    process = start(tmp_path / "run", pause=0.35)
    try:
        read_until(process, 14)
    finally:
        process.kill()
        process.communicate()
    reached = max(line["frame"] for line in read_lines(tmp_path / "run/metrics.jsonl")) + 1
    assert reached - 10 <= load_checkpoint(tmp_path / "run/checkpoints").frame <= reached


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_saves_and_ends_in_under_five_seconds(tmp_path, number):
    process = start(tmp_path / "run")
    read_until(process, 12)
    asked = time.monotonic()
    process.send_signal(number)
    out, errors = process.communicate(timeout=10)
    assert time.monotonic() - asked < 5
    assert process.returncode == 0, errors
    assert out.endswith("saved\n")
    assert "once more quits at once" in errors
    summary = json.loads((tmp_path / "run/summary.json").read_text())
    assert summary["frames"] >= 12
    assert len((tmp_path / "run/trajectory.txt").read_text().splitlines()) == summary["frames"]


def test_a_second_signal_quits_at_once(tmp_path):
    process = start(tmp_path / "run", first=1, pause=3.0)
    read_until(process, 0)
    process.send_signal(signal.SIGTERM)
    assert process.stderr is not None
    assert "stopping" in process.stderr.readline()
    process.send_signal(signal.SIGTERM)
    asked = time.monotonic()
    process.communicate(timeout=10)
    assert process.returncode == -signal.SIGTERM
    assert time.monotonic() - asked < 1.5
