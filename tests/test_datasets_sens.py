"""The .sens file of ScanNet and BundleFusion: frames by position, cameras, poses, times, and files that are damaged."""

from __future__ import annotations

import json
import struct
import sys
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sens_writer

from ecslam import cli
from ecslam.datasets import open_sequence, problems
from ecslam.datasets.check import check_sequence, format_report
from ecslam.datasets.roots import sequences_under
from ecslam.types import FrameError, InputError, Sequence

N = 8
PARTS = 12 + 15 + 4 * 64 + 8 + 16 + 4 + 8  # bytes before the first frame
NONE = np.full((4, 4), -np.inf)


@pytest.fixture(scope="module")
def room() -> Sequence:
    return open_sequence(f"synthetic/studio?size=80x60&frames={N}")


def write(file: Path, room: Sequence, **options: Any) -> Path:
    frames = list(room)
    given = {
        "colors": [frame.color for frame in frames],
        "depths": [np.rint(frame.depth * 1000).astype(np.uint16) for frame in frames],
        "poses": [frame.c2w_gt for frame in frames],
        "matrix": room.intrinsics.matrix(),
    }
    return sens_writer.record(file, **{**given, **options})


def test_frames_are_those_of_the_room(tmp_path: Path, room: Sequence) -> None:
    sequence = open_sequence(write(tmp_path / "scene0000_00.sens", room))
    assert (sequence.name, sequence.layout, sequence.preset, len(sequence)) == ("scene0000_00", "sens", "scannet", N)
    assert sequence.intrinsics.matrix() == pytest.approx(room.intrinsics.matrix(), rel=1e-6)
    np.testing.assert_allclose(sequence.timestamps(), np.arange(N) / 30)
    assert problems(sequence) == []
    for frame, source in zip(sequence, room, strict=True):
        np.testing.assert_array_equal(frame.color, source.color)
        np.testing.assert_allclose(frame.depth, source.depth, atol=6e-4)
        assert source.c2w_gt is not None
        np.testing.assert_allclose(frame.c2w_gt, source.c2w_gt, atol=1e-6)


def test_frames_come_in_any_order_and_to_many_threads(tmp_path: Path, room: Sequence) -> None:
    sequence = open_sequence(write(tmp_path / "a.sens", room))
    order = [5, 0, 7, 7, 2, 6, 1, 3, 4, 0] * 4
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(sequence.__getitem__, order))
    for index, frame in zip(order, found, strict=True):
        assert frame.index == index
        np.testing.assert_array_equal(frame.color, room[index].color)


@pytest.mark.parametrize(("ending", "kind"), [(".png", 1), (".jpg", 2)])
def test_finer_colour_is_brought_to_the_size_of_depth(tmp_path: Path, room: Sequence, ending: str, kind: int) -> None:
    fine = open_sequence(f"synthetic/studio?size=160x120&frames={N}")
    colors = [sens_writer.encoded(frame.color, ending) for frame in fine]
    matrix = fine.intrinsics.matrix()
    file = write(
        tmp_path / "a.sens", room, colors=colors, color_matrix=matrix, kinds=(kind, 1), sizes=(160, 120, 80, 60)
    )
    sequence = open_sequence(file)
    assert (sequence.intrinsics.width, sequence.intrinsics.height) == (80, 60)
    assert problems(sequence) == []
    expected = fine[3].color.reshape(60, 2, 80, 2, 3).mean((1, 3))
    assert np.abs(sequence[3].color - expected).mean() < (1 if ending == ".png" else 8)


def test_a_folder_with_one_file_is_a_sequence_with_its_mesh(tmp_path: Path, room: Sequence) -> None:
    folder = tmp_path / "scans/scene0000_00"
    write(folder / "scene0000_00.sens", room)
    (folder / "scene0000_00.txt").write_text("sceneType = Apartment\n")
    (folder / "scene0000_00_vh_clean_2.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    for path in (folder, folder / "scene0000_00.sens"):
        sequence = open_sequence(path)
        assert (sequence.name, len(sequence)) == ("scene0000_00", N)
        mesh = sequence.reference_mesh()
        assert mesh is not None
        assert len(mesh.faces) == 1
    assert sequences_under(tmp_path) == (str(folder),)


def test_several_files_in_a_folder_are_a_sequence_each(tmp_path: Path, room: Sequence) -> None:
    for name in ("apt0.sens", "office0.SENS"):
        write(tmp_path / "bundlefusion" / name, room)
    (tmp_path / "bundlefusion/notes.txt").write_text("x")
    found = sequences_under(tmp_path)
    assert [Path(each).name for each in found] == ["apt0.sens", "office0.SENS"]
    assert [open_sequence(each).name for each in found] == ["apt0", "office0"]
    assert sequences_under(Path(found[0])) == found[:1]
    with pytest.raises(InputError, match=r"did you mean .*apt0\.sens"):
        open_sequence(tmp_path / "bundlefusion")


# ---- poses and times ----


def test_a_pose_of_minus_infinity_is_no_ground_truth(tmp_path: Path, room: Sequence) -> None:
    poses = [NONE if i in (0, 3) else frame.c2w_gt for i, frame in enumerate(room)]
    sequence = open_sequence(write(tmp_path / "a.sens", room, poses=poses))
    assert [frame.c2w_gt is None for frame in sequence] == [i in (0, 3) for i in range(N)]
    assert any("2 of 8 ground-truth poses" in each for each in problems(sequence))


@pytest.mark.parametrize("pose", [np.eye(4), NONE, np.zeros((4, 4))])
def test_without_any_pose_there_is_no_ground_truth_and_a_note_says_so(
    tmp_path: Path, room: Sequence, pose: np.ndarray
) -> None:
    sequence = open_sequence(write(tmp_path / "a.sens", room, poses=[pose] * N))
    assert sequence.poses_gt() is None
    assert sequence[2].c2w_gt is None
    assert any("poses" in each for each in problems(sequence))


def test_time_stamps_are_microseconds(tmp_path: Path, room: Sequence) -> None:
    stamps = [1_400_000_000_000_000 + 40_000 * i for i in range(N)]
    sequence = open_sequence(write(tmp_path / "a.sens", room, stamps_us=stamps))
    np.testing.assert_allclose(sequence.timestamps(), 1.4e9 + 0.04 * np.arange(N), rtol=0, atol=1e-6)
    assert problems(sequence) == []


@pytest.mark.parametrize("stamps", [[0, 0, 0, 987_654_321, 0, 0, 0, 0], list(range(N)), [7] * N, list(range(N, 0, -1))])
def test_time_stamps_of_no_use_are_left_alone_and_a_note_says_so(
    tmp_path: Path, room: Sequence, stamps: list[int]
) -> None:
    sequence = open_sequence(write(tmp_path / "a.sens", room, stamps_us=stamps))
    np.testing.assert_allclose(sequence.timestamps(), np.arange(N) / 30)
    assert any("time stamps" in each for each in problems(sequence))


def test_cameras_that_are_not_one_are_told_of(tmp_path: Path, room: Sequence) -> None:
    other, aside = room.intrinsics.matrix(), np.eye(4)
    other[0, 2] += 9
    aside[0, 3] = 0.03
    sequence = open_sequence(write(tmp_path / "a.sens", room, color_matrix=other, places=(np.eye(4), aside)))
    found = " ".join(problems(sequence))
    assert "differ by 9 pixels" in found
    assert "3.0 cm apart" in found


# ---- damage ----


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"version": 3}, "version 4"),
        ({"name": b"x" * 5000}, "name of 5000 bytes"),
        ({"kinds": (0, 1)}, "colour is compressed as raw"),
        ({"kinds": (-1, 1)}, r"colour is compressed as unknown \(-1\)"),
        ({"kinds": (2, 0)}, "depth is compressed as raw_ushort"),
        ({"kinds": (2, 2)}, "depth is compressed as occi_ushort, but zlib_ushort is read"),
        ({"sizes": (80, 60, 4_000_000_000, 4_000_000_000)}, "depth images of 4000000000x4000000000"),
        ({"sizes": (0, 60, 80, 60)}, "color images of 0x60"),
        ({"sizes": (80, 60, 80, 80)}, "different shapes"),
        ({"count": 0}, "0 frames"),
        ({"count": 1 << 60}, "claims to have 1152921504606846976 frames"),
        ({"count": N + 1}, "ends within frame 8 of 9"),
        ({"scale": 0.0}, "depth scale 0"),
        ({"scale": float("nan")}, "depth scale nan"),
        ({"matrix": np.zeros((3, 3))}, "intrinsics"),
        ({"matrix": np.full((3, 3), np.nan)}, "intrinsics"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused(
    tmp_path: Path, room: Sequence, options: dict[str, Any], says: str
) -> None:
    file = write(tmp_path / "a.sens", room, **options)
    with pytest.raises(InputError, match=says) as caught:
        open_sequence(file)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("length", [0, 3, 11, 20, 100, PARTS - 1, PARTS, PARTS + 50, PARTS + 96, -3000])
def test_a_truncated_file_is_refused(tmp_path: Path, room: Sequence, length: int) -> None:
    file = write(tmp_path / "a.sens", room)
    file.write_bytes(file.read_bytes()[:length])
    with pytest.raises(InputError, match=r"a\.sens.*copied|a\.sens.*copy it again"):
        open_sequence(file)


def test_an_absurd_length_of_an_image_is_refused_before_anything_is_read(tmp_path: Path, room: Sequence) -> None:
    file = write(tmp_path / "a.sens", room)
    data = bytearray(file.read_bytes())
    data[PARTS + 80 : PARTS + 88] = struct.pack("<Q", (1 << 64) - 1)
    file.write_bytes(data)
    with pytest.raises(InputError, match="frame 0 of 8"):
        open_sequence(file)


def bomb(size: int) -> bytes:
    return zlib.compress(bytes(size), 9)


@pytest.mark.parametrize(
    ("where", "image", "says"),
    [
        ("colors", b"", "neither PNG nor JPEG"),
        ("colors", b"\xff\xd8\xff\xe0" + bytes(500), "header"),
        ("colors", sens_writer.encoded(np.zeros((60, 80, 3), np.uint8))[:-20], "truncated PNG"),
        ("colors", sens_writer.encoded(np.zeros((61, 80, 3), np.uint8)), "80x61 pixels"),
        ("colors", bytes(70 << 20), "images of 70 MiB"),
        ("depths", b"", "not 80x60 values"),
        ("depths", b"not zlib at all", "damaged"),
        ("depths", zlib.compress(bytes(9600))[:-2], "not 80x60 values"),
        ("depths", zlib.compress(bytes(9600))[:-4] + b"abcd", "damaged"),
        ("depths", bomb(9598), "not 80x60 values"),
        ("depths", bomb(200 << 20), "not 80x60 values"),
    ],
)
def test_a_damaged_image_costs_its_own_frame(
    tmp_path: Path, room: Sequence, where: str, image: bytes, says: str
) -> None:
    images: list[Any] = [frame.color for frame in room]
    if where == "depths":
        images = [np.rint(frame.depth * 1000).astype(np.uint16) for frame in room]
    images[3] = image
    sequence = open_sequence(write(tmp_path / "a.sens", room, **{where: images}))
    with pytest.raises(FrameError, match=says) as caught:
        sequence[3]
    assert "a.sens: frame 3" in str(caught.value)
    assert sequence[4].index == 4
    report = check_sequence(sequence)
    assert len(report.unreadable) == 1


def test_a_file_that_is_gone_is_a_frame_error(tmp_path: Path, room: Sequence) -> None:
    file = write(tmp_path / "a.sens", room)
    sequence = open_sequence(file)
    file.unlink()
    with pytest.raises(FrameError, match="frame 1: cannot be read"):
        sequence[1]


# ---- as a whole ----


def test_a_check_reads_well(tmp_path: Path, room: Sequence) -> None:
    text = format_report(check_sequence(write(tmp_path / "scene0000_00.sens", room)))
    assert "scene0000_00 (sens layout, preset scannet)" in text
    assert text.endswith("nothing")


@pytest.mark.slow
def test_a_run_on_a_file_has_its_name_and_follows_the_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    room = open_sequence("synthetic/studio?size=160x120&frames=12")
    write(tmp_path / "scene0000_00.sens", room)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["ecslam", "run", "scene0000_00.sens", "--preset", "live", "--headless"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code
    summary = json.loads((tmp_path / "runs/scene0000_00-live/summary.json").read_text())
    assert summary["sequence"] == "scene0000_00"
    assert summary["frames"] == 12
    assert summary["ate_rmse_cm"] < 2
