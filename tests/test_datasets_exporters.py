"""Recordings as other people's tools, systems and habits leave them."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import sens_writer
from test_datasets_layouts import (
    K,
    N,
    depth_values,
    picture,
    pose,
    write_7scenes,
    write_neuralrgbd,
    write_replica,
    write_rosbag,
    write_scannet,
    write_sens,
    write_tum,
    write_vmap,
)

from ecslam.datasets import open_sequence, problems
from ecslam.types import InputError

LISTS = ("rgb.txt", "depth.txt", "groundtruth.txt")
TIME = re.compile(r"^(\d+)\.(\d{6})", re.MULTILINE)


def rewrite(root: Path, names: tuple[str, ...], change: Callable[[str], str]) -> None:
    for name in names:
        (root / name).write_text(change((root / name).read_text()))


def shuffled(text: str) -> str:
    lines = text.splitlines()
    np.random.default_rng(1).shuffle(lines)
    return "\n".join(lines)


@pytest.mark.parametrize("write", [write_7scenes, write_replica, write_vmap, write_scannet, write_neuralrgbd])
def test_the_case_of_file_names_does_not_matter(write: Callable[[Path], Path], tmp_path: Path) -> None:
    root = write(tmp_path / "a")
    for file in [*root.rglob("*.png"), *root.rglob("*.jpg")]:
        file.rename(file.with_suffix({".png": ".PNG", ".jpg": ".JPEG"}[file.suffix]))
    sequence = open_sequence(root)
    assert len(sequence) == N
    np.testing.assert_allclose(sequence[2].c2w_gt, pose(2), atol=1e-6)


@pytest.mark.parametrize(("write", "name"), [(write_sens, "a.sens"), (write_rosbag, "a.mcap")])
def test_what_macos_puts_beside_files_is_passed_over(write: Callable[[Path], Path], name: str, tmp_path: Path) -> None:
    root = write(tmp_path / "a")
    (root / f"._{name}").write_bytes(b"\0\5\x16\7")
    assert len(open_sequence(root)) == N


def test_a_recording_of_ros_may_end_in_capitals(tmp_path: Path) -> None:
    file = next(write_rosbag(tmp_path / "a").glob("*.mcap"))
    assert len(open_sequence(file.rename(tmp_path / "A.MCAP"))) == N


def test_matrices_may_have_comments(tmp_path: Path) -> None:
    root = write_7scenes(tmp_path / "a")
    np.savetxt(root / "camera-intrinsics.txt", K, header="fx 0 cx")
    np.savetxt(root / "frame-000002.pose.txt", pose(2), header="camera to world")
    sequence = open_sequence(root)
    assert sequence.intrinsics.fx == K[0, 0]
    np.testing.assert_allclose(sequence[2].c2w_gt, pose(2))


def test_lists_may_name_files_as_windows_does(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "a")
    rewrite(root, ("rgb.txt", "depth.txt"), lambda text: text.replace("/", "\\").replace("\n", "\r\n"))
    assert len(open_sequence(root)) == N


def test_lists_in_no_order_are_taken_in_that_of_time(tmp_path: Path) -> None:
    root, sorted_root = write_tum(tmp_path / "a"), write_tum(tmp_path / "b")
    rewrite(root, LISTS, shuffled)
    sequence, expected = open_sequence(root), open_sequence(sorted_root)
    assert any("order of time" in text for text in problems(sequence))
    np.testing.assert_array_equal(sequence.timestamps(), expected.timestamps())
    for frame, other in zip(sequence, expected, strict=True):
        np.testing.assert_array_equal(frame.color, other.color)
        np.testing.assert_allclose(frame.c2w_gt, other.c2w_gt)


def test_one_wrong_time_keeps_its_place_in_the_list(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "a")
    for name in ("rgb", "depth"):
        lines = [f"{i if i != 3 else 0.0} {name}/{i % N}.png\n" for i in range(20)]
        (root / f"{name}.txt").write_text("".join(lines))
    sequence = open_sequence(root)
    assert sequence.timestamps()[3] == 0
    assert "1 frames go backwards in time" in problems(sequence)


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("groundtruth.txt", lambda text: text.replace(".", ","), "groundtruth.txt: line 4 has decimal commas"),
        ("rgb.txt", lambda text: TIME.sub(r"\1,\2", text), "rgb.txt: line 4 has decimal commas"),
        ("depth.txt", lambda text: f"timestamp filename\n{text}", "'timestamp', where a number is due"),
    ],
)
def test_a_list_that_cannot_be_read_is_told_by_its_line(
    name: str, change: Callable[[str], str], says: str, tmp_path: Path
) -> None:
    root = write_tum(tmp_path / "a")
    rewrite(root, (name,), change)
    with pytest.raises(InputError, match=says):
        open_sequence(root)


def test_commas_between_numbers_are_no_decimal_ones(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "a")
    rewrite(root, LISTS, lambda text: re.sub(r"(?<=\d) ", ", ", text))
    assert np.isfinite(open_sequence(root).poses_gt()).all()


def test_ground_truth_of_another_clock_is_told_by_both(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "a")
    rewrite(root, ("groundtruth.txt",), lambda text: TIME.sub(r"99.\2", text))
    note = "groundtruth.txt is of times 99.011 .. 99.178, images are of 1305031102.011 .. 1305031102.178"
    assert note in problems(open_sequence(root))


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_text_in_another_encoding_is_told(encoding: str, tmp_path: Path) -> None:
    root = write_tum(tmp_path / "a")
    (root / "rgb.txt").write_text("# K\u00fcche\n" + (root / "rgb.txt").read_text(), encoding)
    with pytest.raises(InputError, match="not text in UTF-8"):
        open_sequence(root)


@pytest.mark.parametrize(
    ("given", "meant"),
    [("a/rec/rgb", "a/rec"), ("a/rec/rgb.txt", "a/rec"), ("a", "a/rec"), (".", "a/rec")],
)
def test_a_place_near_a_sequence_is_an_error_that_names_it(given: str, meant: str, tmp_path: Path) -> None:
    write_tum(tmp_path / "a" / "rec")
    with pytest.raises(InputError, match=rf"did you mean {re.escape(str(tmp_path / meant))}\?"):
        open_sequence(tmp_path / given)


@pytest.mark.parametrize("beside", [False, True])
def test_a_folder_of_other_files_is_not_taken_for_part_of_what_lies_above(beside: bool, tmp_path: Path) -> None:
    if beside:
        sens_writer.record(tmp_path / "a.sens", [picture(0)], [depth_values(1000)], [pose(0)], K)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("nothing")
    with pytest.raises(InputError, match="no known layout"):
        open_sequence(tmp_path / "notes")


def test_what_is_packed_is_to_be_unpacked(tmp_path: Path) -> None:
    (tmp_path / "seq-01.zip").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"seq-01\.zip: packed; unpack it"):
        open_sequence(tmp_path / "seq-01.zip")
    with pytest.raises(InputError, match=r"no sequence, but seq-01\.zip; unpack that"):
        open_sequence(tmp_path)
