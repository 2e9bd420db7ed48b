"""Processes that read frames: the same frames as threads read, in memory that is written again only when it is free."""

import gc
import os
import pickle
import signal
import subprocess
import sys
import textwrap
import time
from contextlib import nullcontext
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from test_datasets_layouts import WRITERS

from ecslam.config_files import apply_settings, load_preset
from ecslam.datasets import Prefetch, open_sequence
from ecslam.datasets.prefetch import ReadingThreads
from ecslam.datasets.slots import RESTING, Slots
from ecslam.datasets.synthetic import write_replica
from ecslam.runtime import readers, supply
from ecslam.runtime.ahead import preparation
from ecslam.runtime.engine import Engine
from ecslam.runtime.readers import ReadingProcesses, portable
from ecslam.types import Frame, FrameError, Intrinsics

CAMERA = Intrinsics(100, 100, 79.5, 59.5, 160, 120)
LIVE = load_preset("live")
PATIENCE_S = 90.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A recording of thirty frames with noise, of which the eleventh cannot be read."""
    root = tmp_path_factory.mktemp("recordings") / "room"
    write_replica(open_sequence("synthetic/studio?size=160x120&frames=30&noise=1"), root)
    depth = sorted((root / "results").glob("depth*"))[10]
    depth.write_bytes(depth.read_bytes()[:100])
    return root


@pytest.fixture(scope="module")
def recording(folder):
    return open_sequence(str(folder))


def reading(recording, config=lambda: LIVE, count=2):
    prepare = preparation(config, recording.intrinsics, "cpu")
    return ReadingProcesses(pickle.dumps(recording), recording, config, prepare, count)


def wait_until_up(processes, count=2):
    deadline = time.monotonic() + PATIENCE_S
    while sum(helper._greeted == 2 and not helper._gone for helper in processes._helpers) < count:
        for asked in [processes.submit(0) for _ in range(2 * count)]:  # each helper is asked by its own thread alone
            asked.result()
        assert time.monotonic() < deadline, "no process came up"
        time.sleep(0.02)


def same(one, other):
    """Whether two values are alike to the last bit."""
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and one.dtype == other.dtype and np.array_equal(one, other)
    if hasattr(one, "__dataclass_fields__"):
        return type(one) is type(other) and all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    return bool(one == other)


def test_processes_read_what_threads_read(recording):
    by_threads = list(Prefetch(recording, prepare=preparation(lambda: LIVE, recording.intrinsics, "cpu")))
    processes = reading(recording)
    wait_until_up(processes)
    seen = 0
    for (i, frame), (j, expected) in zip(Prefetch(recording, readers=processes), by_threads, strict=True):
        assert i == j
        if isinstance(expected, FrameError):
            assert str(frame) == str(expected)
            seen += i == 10
            continue
        assert same(frame, expected), i
        assert (frame.keyframe is not None) == (i % 5 == 0)
        assert not frame.depth.base.flags.owndata  # in a slot
    assert seen == 1
    assert not processes._helpers


def test_threads_read_until_the_processes_are_up_and_when_they_have_died(recording):
    processes = reading(recording)
    frames = Prefetch(recording, readers=processes)
    first = [next(frames) for _ in range(3)]
    assert [i for i, _ in first] == [0, 1, 2]
    wait_until_up(processes)
    for helper in processes._helpers:
        os.kill(helper._process.pid, signal.SIGKILL)
    rest = list(frames)
    assert [i for i, _ in rest] == list(range(3, 30))
    assert sum(isinstance(item, FrameError) for _, item in rest) == 1
    assert all(same(item.depth, recording[i].depth) or item.measured is not None for i, item in rest if i != 10)


def test_settings_that_change_are_those_of_frames_read_from_then_on(recording):
    now = [LIVE]
    processes = reading(recording, lambda: now[0])
    wait_until_up(processes)
    assert processes.submit(1).result().measured is not None
    now[0] = apply_settings(LIVE, ["denoise=false"])
    assert processes.submit(1).result().measured is None
    processes.close()
    processes.close()


def test_a_slot_is_written_again_only_when_nothing_holds_its_images():
    slots = Slots(CAMERA, RESTING + 2)
    rng = np.random.default_rng(0)

    def frame(number):
        color, depth = rng.integers(0, 255, (120, 160, 3), np.uint8), rng.random((120, 160), np.float32)
        return Frame(number, number / 30, color, depth, measured=depth + 1)

    def pass_on(given):
        slot = slots.take()
        return None if slot is None else slots.found(slots.put(given, slot), slot)

    one, two = frame(1), frame(2)
    held = [pass_on(one).color[3:, ::2][1:], torch.from_numpy(pass_on(two).measured[5:])]
    gc.collect()
    assert slots.take() is None
    assert np.array_equal(held[0], one.color[3:, ::2][1:])
    assert np.array_equal(held[1].numpy(), two.measured[5:])
    del held[0]
    gc.collect()
    third = pass_on(frame(3))
    assert third is not None
    assert np.array_equal(held[0].numpy(), two.measured[5:])


def test_a_slot_rests_before_it_is_written_again():
    slots = Slots(CAMERA, RESTING + 3)
    taken = [slots.take() for _ in range(3)]
    slots.give_back(taken[0])
    assert slots.take() != taken[0]
    assert slots.take() is None


@pytest.mark.parametrize(
    ("size", "light", "length"),
    [((60, 80), "uint8", "float32"), ((120, 160), "uint8", "float64"), ((120, 160), "float32", "float32")],
)
def test_a_frame_of_another_camera_is_sent_as_it_is(size, light, length):
    slots = Slots(CAMERA, RESTING + 1)
    given = Frame(0, 0.0, np.zeros((*size, 3), light), np.ones(size, length))
    slot = slots.take()
    assert slots.found(slots.put(given, slot), slot) is given
    assert slots.take() is not None


def test_there_are_no_more_slots_than_memory_for_them(monkeypatch):
    monkeypatch.setattr("ecslam.datasets.slots.MOST_BYTES", 1 << 20)
    assert Slots(CAMERA, 100).count == 4  # 211 kB each
    assert Slots(CAMERA, 2).count == 2


def test_without_memory_to_share_threads_read(recording, tmp_path, monkeypatch):
    def none(name):
        raise OSError(f"no memory for {name}")

    monkeypatch.setattr(supply, "portable", lambda sequence, device: pickle.dumps(sequence))
    monkeypatch.setattr("os.memfd_create", none)
    engine = Engine(LIVE, recording, tmp_path / "run")
    assert isinstance(engine._ahead._readers, ReadingThreads)
    engine._ahead.close()


def test_whoever_finds_no_slot_reads_alone(recording):
    processes = reading(recording)
    wait_until_up(processes)
    held = [processes.submit(i).result() for i in range(9) for _ in range(2)]
    assert all(same(held[2 * i], held[2 * i + 1]) for i in range(9))
    assert sum(frame.depth.base is None or frame.depth.base.flags.owndata for frame in held) > 0
    processes.close()
    assert held[0].depth.max() > 0


def test_what_is_closed_or_dropped_in_the_middle_leaves_no_process(recording):
    for drop in (False, True):
        processes = reading(recording)
        frames = Prefetch(recording, readers=processes)
        next(frames)
        children = [helper._process for helper in processes._helpers]
        assert children
        if not drop:
            frames.close()
        del frames
        gc.collect()
        assert all(child.returncode is not None for child in children)


def test_no_process_is_left_when_the_program_is_killed(folder):
    program = """
        import pickle, sys, time
        from ecslam.config import Config
        from ecslam.datasets import open_sequence
        from ecslam.runtime.readers import ReadingProcesses
        room = open_sequence(sys.argv[1])
        readers = ReadingProcesses(pickle.dumps(room), room, Config, lambda frame: frame, 2)
        readers.submit(0).result()
        print(*(helper._process.pid for helper in readers._helpers), flush=True)
        time.sleep(100)
    """
    command = [sys.executable, "-c", textwrap.dedent(program), str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        children = [int(pid) for pid in parent.stdout.readline().split()]
        parent.kill()
    assert children
    deadline = time.monotonic() + PATIENCE_S
    while any(serves(pid) for pid in children):
        assert time.monotonic() < deadline, "a process goes on for nobody"
        time.sleep(0.1)


class Own:
    """Somebody's own sequence."""

    layout = "replica"

    def __init__(self, sequence):
        self.sequence = sequence


def serves(pid):
    """Whether a process reads frames."""
    try:
        return b"serve(" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def test_processes_are_for_recordings_on_a_gpu_and_many_cores(recording, monkeypatch):
    monkeypatch.setattr(readers, "cores", lambda: 16)
    assert same(pickle.loads(portable(recording, "cuda:0"))[3].depth, recording[3].depth)
    assert portable(recording, "cpu") is None
    assert portable(open_sequence("synthetic/studio?size=160x120&frames=8"), "cuda") is None
    assert portable(Own(recording), "cuda") is None
    with monkeypatch.context() as older:
        older.delattr("os.memfd_create")  # some Pythons lack it
        assert portable(recording, "cuda") is None
    monkeypatch.setattr(readers, "MOST_BYTES", 100)
    assert portable(recording, "cuda") is None
    monkeypatch.setattr(readers, "cores", lambda: 2)
    assert portable(recording, "cuda") is None


@pytest.mark.slow
def test_a_run_is_the_same_whoever_reads(folder, tmp_path, monkeypatch):
    small = ["align.points=300", "mapping.first_iterations=5", "mapping.iterations=2", "mapping.final_iterations=2"]
    config, paths = apply_settings(LIVE, [*small, "mapping.rays=60"]), []
    for by_processes in (False, True):
        if by_processes:
            monkeypatch.setattr(supply, "portable", lambda sequence, device: pickle.dumps(sequence))
            monkeypatch.setattr(supply, "processes", lambda: 2)
            monkeypatch.setattr(supply, "page_lock", lambda device, slots: None)
        engine = Engine(config, str(folder), tmp_path / str(by_processes))
        if by_processes:
            wait_until_up(engine._ahead._readers)
        engine.run()
        paths.append((tmp_path / str(by_processes) / "trajectory.txt").read_bytes())
    assert paths[0] == paths[1]
    assert paths[0].count(b"\n") >= 29


@pytest.mark.parametrize("locked", [True, False])
def test_memory_is_locked_for_a_gpu_until_nothing_holds_a_frame(locked, monkeypatch):
    done = []

    class Runtime:
        def cudaHostRegister(self, pointer, size, flags):
            done.append(("lock", pointer, size))
            return 0 if locked else 1

        def cudaHostUnregister(self, pointer):
            done.append(("unlock", pointer))

    monkeypatch.setattr(torch.cuda, "cudart", Runtime)
    monkeypatch.setattr(torch.cuda, "device", lambda index: nullcontext())
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: done.append("wait"))
    slots = Slots(CAMERA, RESTING + 1)
    readers.page_lock("cuda:1", slots)
    slot, depth = slots.take(), np.ones((120, 160), np.float32)
    held = slots.found(slots.put(Frame(0, 0.0, np.zeros((120, 160, 3), np.uint8), depth), slot), slot).depth[5:]
    first, memory = done[0], len(slots.memory)
    del slots
    gc.collect()
    assert done == [first]
    assert held.min() == 1
    del held
    gc.collect()
    assert done == ([first, "wait", ("unlock", first[1])] if locked else [first])
    assert first[2] == memory


@pytest.mark.parametrize("layout", sorted(set(WRITERS) - {"stray", "rosbag"}))
def test_a_process_reads_what_was_opened_elsewhere(layout, tmp_path, monkeypatch):
    monkeypatch.setattr(readers, "cores", lambda: 16)
    opened = open_sequence(str(WRITERS[layout](tmp_path / layout)))
    first = opened[0]
    copy = pickle.loads(portable(opened, "cuda"))
    assert all(same(copy[i], opened[i]) for i in range(len(opened)))
    assert same(copy[0], first)
