"""Cameras that are on: what they bring is recorded whole, read while it is new, and lost by no mishap."""

from __future__ import annotations

import dataclasses
import errno
import json
import threading
import time
from contextlib import closing
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ecslam import camera_commands, cli
from ecslam.cameras import LiveRecording, Shot, is_camera, kinds, open_camera, recording_name, writer
from ecslam.datasets import Live, open_sequence
from ecslam.datasets.recording import Rig, read_rig, write_rig
from ecslam.types import FrameError, InputError, Intrinsics

ROOM = open_sequence("synthetic/studio?size=96x72&frames=12")
BESIDE = np.eye(4)
BESIDE[0, 3] = -0.02
SAME = Rig("a camera", 1000.0, ROOM.intrinsics, ROOM.intrinsics, np.eye(4))
TWO = dataclasses.replace(SAME, depth_to_color=BESIDE)


def shot(index: int, seconds: float | None = None) -> Shot:
    frame = ROOM[index]
    raw = np.rint(frame.depth * 1000).astype(np.uint16)
    return Shot(index / 30 if seconds is None else seconds, frame.color, raw)


class FakeCamera:
    """Brings shots one by one, each when a test lets it; then ends, or fails with ``error``."""

    def __init__(self, shots: list[Shot], rig: Rig = SAME, error: str = "", wait: bool = False) -> None:
        self.rig, self._shots, self._error = rig, list(shots), error
        self.go, self.closed = threading.Semaphore(0 if wait else len(shots) + 1), 0

    def read(self) -> Shot | None:
        self.go.acquire()
        if self._shots:
            return self._shots.pop(0)
        if self._error:
            raise InputError(self._error)
        return None

    def close(self) -> None:
        self.closed += 1


def written(live: LiveRecording, count: int) -> None:
    """Wait until so many are on disk."""
    deadline = time.monotonic() + 10
    while live._writer.written < count and time.monotonic() < deadline:
        time.sleep(0.005)


def recorded(folder: Path, camera: FakeCamera) -> LiveRecording:
    live = LiveRecording(camera, folder)
    assert live.wait(10)
    live.close()
    return live


@pytest.mark.parametrize("rig", [SAME, TWO])
def test_what_is_read_live_is_what_is_on_disk_afterwards(tmp_path, rig):
    live = recorded(tmp_path / "a", FakeCamera([shot(i) for i in range(6)], rig))
    again = open_sequence(tmp_path / "a")
    assert isinstance(live, Live)
    assert (again.layout, again.preset, len(again), again.name) == ("recording", "live", 6, "a")
    assert again.intrinsics == live.intrinsics
    np.testing.assert_array_equal(again.timestamps(), live.timestamps())
    np.testing.assert_allclose(again.timestamps(), np.arange(6) / 30, atol=1e-6)
    for i in range(6):
        np.testing.assert_array_equal(live[i].depth, again[i].depth)
        assert np.abs(live[i].color.astype(int) - again[i].color).mean() < 8, "JPEG"
    if rig is SAME:
        np.testing.assert_allclose(again[3].depth, ROOM[3].depth, atol=5.1e-4)


def test_colour_from_beside_is_moved_to_depth(tmp_path):
    live = recorded(tmp_path / "a", FakeCamera([shot(0)], TWO))
    assert live.intrinsics.width < ROOM.intrinsics.width, "cut to what both see"
    shift = TWO.depth_to_color[0, 3] * ROOM.intrinsics.fx / np.median(ROOM[0].depth)
    assert abs(shift) > 0.3
    straight = recorded(tmp_path / "b", FakeCamera([shot(0)], SAME))
    cut = straight[0].color[:, -live.intrinsics.width :]
    assert np.abs(live[0].color.astype(int) - cut).mean() > 1


def test_old_frames_come_from_disk_while_the_camera_is_on(tmp_path, monkeypatch):
    monkeypatch.setattr("ecslam.cameras.live.AT_HAND", 2)
    camera = FakeCamera([shot(i) for i in range(12)], wait=True)
    with closing(LiveRecording(camera, tmp_path / "a")) as live:
        for count in range(1, 12):
            camera.go.release()
            written(live, count)
        assert min(live._recent) > 0
        np.testing.assert_allclose(live[0].depth, ROOM[0].depth, atol=5.1e-4)
        camera.go.release(2)


def test_it_grows_and_can_be_opened_by_others_meanwhile(tmp_path):
    camera = FakeCamera([shot(i) for i in range(4)], wait=True)
    with closing(LiveRecording(camera, tmp_path / "a")) as live:
        assert (live.arrived(), live.over()) == (0, False)
        camera.go.release(3)
        written(live, 3)
        assert live.arrived() == len(live) == 3
        assert len(open_sequence(tmp_path / "a")) == 3, "what a kill would leave"
        camera.go.release(2)
    assert live.over()
    assert camera.closed == 1


def test_a_time_that_does_not_move_on_is_left_out(tmp_path):
    live = recorded(tmp_path / "a", FakeCamera([shot(0, 1.0), shot(1, 1.0), shot(2, 0.5), shot(3, 1.1)]))
    assert live.timestamps().tolist() == [1.0, 1.1]


def test_a_camera_that_fails_ends_the_recording_and_keeps_it(tmp_path):
    live = recorded(tmp_path / "a", FakeCamera([shot(0), shot(1)], error="a camera: is it still plugged in?"))
    assert live.trouble == "a camera: is it still plugged in?"
    assert len(open_sequence(tmp_path / "a")) == 2


def test_a_camera_that_breaks_in_an_unknown_way_ends_the_recording_too(tmp_path):
    camera = FakeCamera([shot(0)], error="x")
    camera.read = lambda: 1 / 0
    camera.close = lambda: 1 / 0
    live = recorded(tmp_path / "a", camera)
    assert live.trouble == "division by zero"


def test_images_that_cannot_be_encoded_end_the_recording(tmp_path):
    live = recorded(tmp_path / "a", FakeCamera([shot(0)._replace(depth=np.zeros((0, 0), np.uint16))]))
    assert "ends at frame 0" in live.trouble


def test_a_full_disk_ends_the_recording_and_says_where(tmp_path, monkeypatch):
    whole = Path.write_bytes

    def full(path: Path, data: bytes) -> int:
        if path.name == "000002.png":
            raise OSError(errno.ENOSPC, "No space left on device")
        return whole(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    one = shot(0)
    camera = FakeCamera([one._replace(seconds=i / 30) for i in range(500)], wait=True)
    with closing(LiveRecording(camera, tmp_path / "a")) as live:
        camera.go.release(3)
        deadline = time.monotonic() + 10
        while not live.trouble and time.monotonic() < deadline:
            time.sleep(0.01)
        camera.go.release(2)
        assert live.wait(10)
    assert "ends at frame 2 (No space left on device)" in live.trouble
    assert "\n" not in live.trouble
    assert len(open_sequence(tmp_path / "a")) == 2


def test_a_disk_that_is_too_slow_costs_frames_which_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(writer, "MOST_WAITING", 2)
    go, whole = threading.Event(), Path.write_bytes
    monkeypatch.setattr(Path, "write_bytes", lambda path, data: go.wait(10) and whole(path, data))
    live = LiveRecording(FakeCamera([shot(i) for i in range(12)]), tmp_path / "a")
    assert live.wait(10)
    go.set()
    live.close()
    kept = len(open_sequence(tmp_path / "a"))
    assert kept == len(live)
    assert live.trouble == f"{12 - kept} frames were not recorded: the disk is too slow"


@pytest.mark.parametrize("there", ["recording.yaml", "frames.txt", "rgb/"])
def test_a_folder_that_holds_something_of_a_recording_is_refused(tmp_path, there):
    folder = tmp_path / "a"
    folder.mkdir()
    (folder / there).mkdir() if there.endswith("/") else (folder / there).touch()
    with pytest.raises(InputError, match="name a new folder") as caught:
        LiveRecording(FakeCamera([]), folder)
    assert str(folder) in str(caught.value)
    assert [path.name for path in folder.iterdir()] == [there.rstrip("/")], "left as it was"


def test_a_rig_comes_back_as_it_was_written(tmp_path):
    bent = Intrinsics(70.1, 70.2, 47.5, 35.5, 96, 72, (0.1, -0.05, 1e-5, -2e-4, 0.01), 0.025)
    rig = Rig('A "camera": №1', 999.999952502551, SAME.depth, bent, BESIDE)
    write_rig(tmp_path / "recording.yaml", rig)
    again = read_rig(tmp_path / "recording.yaml")
    assert (again.name, again.depth_scale, again.depth, again.color) == (rig.name, rig.depth_scale, rig.depth, bent)
    np.testing.assert_array_equal(again.depth_to_color, BESIDE)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("depth_scale: 1000.0", ""), "depth_scale.*missing"),
        (("depth_scale: 1000.0", "depth_scale: fast"), "fast"),
        (("[1.0, 0.0", "[2.0, 0.0"), "no rigid motion"),
        (('"cx": 47.5, ', ""), "cx.*missing"),
        (('"width": 96', '"width": "wide"'), "not a number"),
        (("depth_scale", "depth_scale: ["), "not valid YAML"),
    ],
)
def test_a_damaged_rig_is_told_in_one_line(tmp_path, change, says):
    recorded(tmp_path / "a", FakeCamera([shot(0)]))
    file = tmp_path / "a/recording.yaml"
    told = file.read_text()
    assert change[0] in told
    file.write_text(told.replace(*change))
    with pytest.raises(InputError, match=says) as caught:
        open_sequence(tmp_path / "a")
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("left", ["0.1", "0.1666", "0.166667 0000"])
def test_a_recording_that_was_cut_off_in_the_middle_of_a_line_opens_up_to_there(tmp_path, left):
    recorded(tmp_path / "a", FakeCamera([shot(i) for i in range(3)]))
    with open(tmp_path / "a/frames.txt", "a") as file:
        file.write(left)
    assert len(open_sequence(tmp_path / "a")) == 3


def test_a_recording_without_its_times_is_refused(tmp_path):
    recorded(tmp_path / "a", FakeCamera([shot(0)]))
    (tmp_path / "a/frames.txt").unlink()
    with pytest.raises(InputError, match=r"frames\.txt.*missing"):
        open_sequence(tmp_path / "a")


# ---- addresses and commands ----


@pytest.fixture
def on_offer(monkeypatch):
    """``camera/fake``: a room, twelve frames, as fast as they are taken."""
    made: list[FakeCamera] = []

    def switch_on(rate: str = "") -> FakeCamera:
        made.append(FakeCamera([shot(i) for i in range(12)], TWO))
        return made[-1]

    monkeypatch.setattr(kinds, "kinds", lambda: {"fake": SimpleNamespace(OPTIONS=("rate",), open=switch_on)})
    return made


@pytest.mark.parametrize(
    ("address", "says"),
    [("camera/phone", "there are: camera/realsense"), ("camera/", "no such camera"), ("camera/realsense?x=1", "'x'")],
)
def test_what_is_no_camera_is_told_in_one_line(address, says):
    assert is_camera(address)
    with pytest.raises(InputError, match=says):
        open_camera(address)


def test_a_camera_is_nothing_to_open_as_a_recording():
    with pytest.raises(InputError, match="run and recorded only"):
        open_sequence("camera/realsense")
    assert not is_camera("/data/camera/room")


def test_a_recording_is_named_after_its_camera_and_time():
    assert recording_name("camera/realsense?fps=15", datetime(2026, 1, 2, 3, 4, 5)) == "realsense-20260102-030405"


def test_a_camera_is_recorded_by_one_command(tmp_path, on_offer, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    camera_commands.record("camera/fake", None, 0.0)
    (folder,) = (tmp_path / "recordings").iterdir()
    assert len(open_sequence(folder)) == 12
    assert f"12 frames; run them with: ecslam run {folder}" in capsys.readouterr().out
    camera_commands.record("camera/fake?rate=1", tmp_path / "named", 5.0)
    assert len(open_sequence(tmp_path / "named")) == 12
    with pytest.raises(InputError, match="no camera"):
        camera_commands.record(str(folder), None, 0.0)


def test_recording_ends_when_its_time_is_over(tmp_path, monkeypatch):
    one = shot(0)
    camera = FakeCamera([one._replace(seconds=i / 30) for i in range(1000)], wait=True)
    threading.Thread(target=lambda: [time.sleep(0.02) or camera.go.release() for _ in range(100)], daemon=True).start()
    monkeypatch.setattr(camera_commands, "open_camera", lambda address: camera)
    began = time.monotonic()
    camera_commands.record("camera/realsense", tmp_path / "a", 0.3)
    assert 0.2 < time.monotonic() - began < 10
    assert camera.closed


def test_a_camera_is_off_again_when_its_images_cannot_be_written(tmp_path, on_offer):
    (tmp_path / "a").touch()
    with pytest.raises(InputError, match="name a new folder"):
        camera_commands.record("camera/fake", tmp_path / "a", 0.0)
    assert on_offer[0].closed


def test_options_that_do_not_go_together_are_refused(tmp_path):
    with pytest.raises(InputError, match="--frames"), camera_commands.source("camera/realsense", "0:5", None):
        pass
    with pytest.raises(InputError, match="--record"), camera_commands.source("synthetic/studio", "", tmp_path):
        pass


def test_a_run_on_a_camera_leaves_a_map_and_a_recording_to_run_again(tmp_path, on_offer):
    small = ["mapping.first_iterations=2", "mapping.iterations=1", "mapping.final_iterations=1"]
    cli.run("camera/fake", settings=small, headless=True, out=tmp_path / "run", record=tmp_path / "rec", device="cpu")
    assert on_offer[0].closed
    about, summary = (json.loads((tmp_path / "run" / name).read_text()) for name in ("run.json", "summary.json"))
    assert (about["sequence"], about["frames_total"], about["layout"]) == (str(tmp_path / "rec"), 12, "recording")
    assert summary["ended"] == "finished"
    assert summary["frames"] + summary["dropped_frames"] == 12
    assert (tmp_path / "run/mesh.ply").is_file()
    again = open_sequence(about["sequence"])
    assert len(again) == 12
    cli.run(about["sequence"], settings=small, headless=True, out=tmp_path / "again", device="cpu")
    assert json.loads((tmp_path / "again/summary.json").read_text())["frames"] == 12


# ---- librealsense ----


@pytest.fixture(scope="session")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What librealsense itself has recorded of a room, with a lens of colour that bends."""
    pytest.importorskip("pyrealsense2")
    import realsense_recording

    file = tmp_path_factory.mktemp("realsense") / "room.db3"
    realsense_recording.write(file, ROOM, ROOM.intrinsics, bend=(0.05, -0.02, 0.001, -0.001, 0.0))
    return file


def test_a_realsense_brings_both_images_and_says_how_it_is_built(played):
    with closing(open_camera(f"camera/realsense?file={played}")) as camera:
        shots = []
        while (each := camera.read()) is not None:
            shots.append(each)
    rig, k = camera.rig, ROOM.intrinsics
    assert rig.name == "Soft D435"
    assert rig.depth_scale == pytest.approx(1000)
    assert dataclasses.astuple(rig.depth)[:6] == pytest.approx((k.fx, k.fy, k.cx, k.cy, k.width, k.height))
    assert rig.depth.distortion == ()
    assert rig.color.distortion == pytest.approx((0.05, -0.02, 0.001, -0.001, 0.0))
    np.testing.assert_allclose(rig.depth_to_color[:3, 3], [0.015, 0, 0], atol=1e-7)
    assert len(shots) >= 8, "the first ones may pass by before they are waited for"
    assert (np.diff([each.seconds for each in shots]) > 0.03).all()
    for each in shots:
        frame = ROOM[round(each.seconds * 30)]
        np.testing.assert_allclose(each.depth, frame.depth * 1000, atol=0.6)
        assert each.color.shape == frame.color.shape
    exact = [np.array_equal(each.color, ROOM[round(each.seconds * 30)].color) for each in shots]
    assert sum(exact) >= len(shots) - 2, "those that librealsense did not pair otherwise"


def test_a_realsense_is_recorded_and_opened_again(played, tmp_path):
    camera_commands.record(f"camera/realsense?file={played}", tmp_path / "a", 0.0)
    again = open_sequence(tmp_path / "a")
    assert len(again) >= 8
    assert again.rig.name == "Soft D435"
    frame = again[3]
    assert frame.depth.shape == frame.color.shape[:2] == (again.intrinsics.height, again.intrinsics.width)
    assert (frame.depth > 0).mean() > 0.9


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("size=big", "size=640x480"),
        ("fps=fast", "fps=30"),
        ("serial=none", "no such camera"),
        ("file=/nothing/here.db3", "file=/nothing/here.db3 does not work"),
    ],
)
def test_what_a_realsense_cannot_do_is_told_in_one_line(options, says):
    pytest.importorskip("pyrealsense2")
    with pytest.raises(InputError, match=says) as caught:
        open_camera(f"camera/realsense?{options}")
    assert "\n" not in str(caught.value)


def test_without_librealsense_it_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyrealsense2", None)
    with pytest.raises(InputError, match="pip install pyrealsense2"):
        open_camera("camera/realsense")


def test_a_broken_image_of_a_recording_is_one_frame_less(tmp_path):
    recorded(tmp_path / "a", FakeCamera([shot(i) for i in range(3)]))
    (tmp_path / "a/rgb/000001.jpg").write_bytes(b"\xff\xd8")
    sequence = open_sequence(tmp_path / "a")
    with pytest.raises(FrameError, match=r"000001\.jpg"):
        sequence[1]
    assert sequence[2].index == 2
