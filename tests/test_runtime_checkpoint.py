"""Checkpoints: round trip, two generations, every kind of damage falls back or is refused, nothing half-written."""

import errno
import json
import os
import threading

import numpy as np
import pytest

from ecslam.runtime import checkpoint_writer as module
from ecslam.runtime.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from ecslam.runtime.checkpoint_writer import CheckpointWriter
from ecslam.types import InputError

ARRAYS = {
    "scalar": np.array(3.5),
    "bool": np.array([True, False]),
    "bytes": np.arange(200, dtype=np.uint8),
    "turned": np.arange(12, dtype=np.int64).reshape(3, 4).T,
    "none": np.zeros((0, 4, 4)),
}


def checkpoint(frame: int) -> Checkpoint:
    return Checkpoint(frame, ARRAYS | {"frame": np.array(frame)}, {"tally": {"wall_s": 1.5}, "name": "ü"})


def test_round_trip_keeps_every_bit(tmp_path):
    save_checkpoint(tmp_path, checkpoint(7))
    back = load_checkpoint(tmp_path)
    assert (back.frame, back.meta) == (7, checkpoint(7).meta)
    for name, value in checkpoint(7).arrays.items():
        assert back.arrays[name].dtype == value.dtype
        assert np.array_equal(back.arrays[name], value)
        assert back.arrays[name].shape == value.shape


def test_the_newest_two_generations_are_kept(tmp_path):
    for frame in (5, 10, 15, 20):
        save_checkpoint(tmp_path, checkpoint(frame))
        assert load_checkpoint(tmp_path).frame == frame
    assert sorted(p.name for p in tmp_path.glob("*.json")) == ["000015.json", "000020.json"]
    assert len(list(tmp_path.glob("*.safetensors"))) == 2


def test_a_millionth_frame_is_newer_than_the_one_before(tmp_path):
    for frame in (999_995, 1_000_000, 1_000_005):
        save_checkpoint(tmp_path, checkpoint(frame))
        assert load_checkpoint(tmp_path).frame == frame
    assert sorted(p.name for p in tmp_path.glob("*.json")) == ["1000000.json", "1000005.json"]


def test_lasting_arrays_are_written_once_and_changing_ones_every_time(tmp_path):
    pictures = {f"keyframes.{i}.color": np.full(10_000, i, np.uint8) for i in range(4)}
    stored, written = None, {}
    for frame in range(1, 5):
        known = dict(list(pictures.items())[:frame])
        stored = save_checkpoint(tmp_path, Checkpoint(frame, {"map": np.full(3, frame)} | known), stored)
        sizes = {p.name: p.stat().st_size for p in tmp_path.glob("*.safetensors")}
        assert sum(size for name, size in sizes.items() if name not in written) < 12_000
        written |= sizes
    back = load_checkpoint(tmp_path).arrays
    assert back["map"].tolist() == [4, 4, 4]
    assert all(np.array_equal(back[name], value) for name, value in pictures.items())
    assert len(list(tmp_path.glob("*.safetensors"))) == 4 + 2


def test_a_lasting_array_that_did_change_is_written_again(tmp_path):
    stored = save_checkpoint(tmp_path, Checkpoint(1, {"keyframes.0.color": np.zeros(3)}))
    save_checkpoint(tmp_path, Checkpoint(2, {"keyframes.0.color": np.ones(3)}), stored)
    assert load_checkpoint(tmp_path).arrays["keyframes.0.color"].tolist() == [1, 1, 1]


def flip(path, position):
    data = bytearray(path.read_bytes())
    data[position % len(data)] ^= 4
    path.write_bytes(data)


def arrays_of(folder, frame):
    """The newest file of arrays of a generation."""
    digest = json.loads(json.loads((folder / f"{frame:06d}.json").read_text())["body"])["files"][-1]
    return folder / f"{digest[:16]}.safetensors"


DAMAGE = {
    "flipped array": lambda folder: flip(arrays_of(folder, 10), -3),
    "flipped header": lambda folder: flip(arrays_of(folder, 10), 12),
    "flipped manifest": lambda folder: flip(folder / "000010.json", 200),
    "truncated arrays": lambda folder: os.truncate(arrays_of(folder, 10), 50),
    "empty manifest": lambda folder: os.truncate(folder / "000010.json", 0),
    "missing arrays": lambda folder: arrays_of(folder, 10).unlink(),
    "other json": lambda folder: (folder / "000010.json").write_text("[1, 2]"),
    "pickle": lambda folder: arrays_of(folder, 10).write_bytes(b"\x80\x04cos\nsystem\n"),
    "huge manifest": lambda folder: os.truncate(folder / "000010.json", 1 << 30),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE.keys())
def test_a_damaged_newest_generation_falls_back_to_the_older(tmp_path, damage):
    save_checkpoint(tmp_path, checkpoint(5))
    save_checkpoint(tmp_path, checkpoint(10))
    damage(tmp_path)
    assert load_checkpoint(tmp_path).frame == 5
    save_checkpoint(tmp_path, checkpoint(15))
    assert load_checkpoint(tmp_path).frame == 15


def test_every_flipped_byte_of_the_manifest_is_noticed(tmp_path):
    save_checkpoint(tmp_path, checkpoint(5))
    path = tmp_path / "000005.json"
    whole = path.read_bytes()
    for position in range(len(whole)):
        flip(path, position)
        with pytest.raises(InputError, match="no usable checkpoint"):
            load_checkpoint(tmp_path)
        path.write_bytes(whole)
    assert load_checkpoint(tmp_path).frame == 5


def test_no_whole_generation_is_one_clear_line(tmp_path):
    with pytest.raises(InputError, match="no usable checkpoint"):
        load_checkpoint(tmp_path / "nowhere")
    for frame in (5, 10):
        save_checkpoint(tmp_path, checkpoint(frame))
        flip(arrays_of(tmp_path, frame), -1)
    with pytest.raises(InputError, match=r"000010.json: the arrays do not match.*000005.json") as caught:
        load_checkpoint(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_full_disk_is_reported_and_the_older_generations_stay(tmp_path, monkeypatch):
    failures, saved = [], []
    writer = CheckpointWriter(tmp_path, 5, failures.append, lambda: saved.append(1))
    writer.save(lambda: checkpoint(5))
    writer.wait()

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        writer.save(lambda: checkpoint(10))
        writer.wait()
    assert [f.errno for f in failures] == [errno.ENOSPC]
    assert load_checkpoint(tmp_path).frame == 5
    writer.save(lambda: checkpoint(15))
    writer.wait()
    assert load_checkpoint(tmp_path).frame == 15
    assert len(saved) == 2


def test_leftovers_of_a_killed_writer_are_removed(tmp_path):
    (tmp_path / ".000005.safetensors.12-34.tmp").write_bytes(b"half")
    CheckpointWriter(tmp_path, 5, print, print)
    assert os.listdir(tmp_path) == []


class Clock:
    """Seconds that pass when a test says so."""

    def __init__(self) -> None:
        self.seconds = 100.0

    def __call__(self) -> float:
        return self.seconds


def saving(writer, frame, clock, cost_s):
    """Save, ``cost_s`` being what it takes, and wait for it."""

    def make():
        clock.seconds += cost_s
        return checkpoint(frame)

    writer.save(make)
    writer.wait()


def test_the_first_frame_is_saved_at_once_and_slow_frames_every_so_many(tmp_path):
    clock = Clock()
    writer = CheckpointWriter(tmp_path, 5, print, lambda: None, now=clock)
    assert writer.due(1)
    saving(writer, 1, clock, 0.0)
    clock.seconds += 1000
    assert [f for f in range(2, 8) if writer.due(f)] == [6, 7]


@pytest.mark.parametrize(("cost_s", "pause_s"), [(0.1, 2.0), (1.0, 3.0)])
def test_saving_takes_a_twentieth_of_the_time_but_never_are_over_three_seconds_at_stake(tmp_path, cost_s, pause_s):
    clock = Clock()
    writer = CheckpointWriter(tmp_path, 5, print, lambda: None, now=clock)
    began = clock.seconds
    saving(writer, 1, clock, cost_s)
    frame = 20
    while not writer.due(frame):
        clock.seconds += 0.01
    assert clock.seconds - began == pytest.approx(pause_s, abs=0.02)


def test_a_slow_disk_is_waited_for_after_ten_frames_and_three_seconds(tmp_path, monkeypatch):
    finish, clock = threading.Event(), Clock()
    real = module.save_checkpoint
    monkeypatch.setattr(module, "save_checkpoint", lambda *args: (finish.wait(), real(*args))[1])
    writer = CheckpointWriter(tmp_path, 5, print, lambda: None, now=clock)
    finish.set()
    saving(writer, 1, clock, 0.0)
    finish.clear()
    clock.seconds += 1.0
    writer.save(lambda: checkpoint(6))
    assert [f for f in range(7, 20) if writer.due(f)] == []
    clock.seconds += 2.0
    assert [f for f in range(7, 14) if writer.due(f)] == [11, 12, 13]
    finish.set()
    writer.save(lambda: checkpoint(11))
    writer.wait()
    assert load_checkpoint(tmp_path).frame == 11
