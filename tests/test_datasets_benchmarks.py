"""Folders that are nearly TUM's: lists of pairs, calibration.txt of ETH3D, ICL-NUIM and Bonn."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ecslam.datasets import open_sequence, problems
from ecslam.datasets.agreement import odd_truth
from ecslam.types import InputError, Sequence

N = 24
MIRROR = np.diag([1.0, -1, 1, 1])
ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def room() -> Sequence:
    return open_sequence(f"synthetic/studio?size=80x60&frames={N}")


def write_images(root: Path, room: Sequence) -> list[tuple[str, str]]:
    """The names of each frame's images, relative to ``root``."""
    names = [(f"rgb/{i}.png", f"depth/{i}.png") for i in range(N)]
    for folder in ("rgb", "depth"):
        (root / folder).mkdir(parents=True)
    for frame, (color, depth) in zip(room, names, strict=True):
        assert cv2.imwrite(str(root / color), np.ascontiguousarray(frame.color[..., ::-1]))
        assert cv2.imwrite(str(root / depth), np.rint(frame.depth * 5000).astype(np.uint16))
    return names


def write_lists(root: Path, room: Sequence, stamp: Callable[[int], str] = lambda i: f"{1e9 + i / 30:.6f}") -> Path:
    names = write_images(root, room)
    for column, name in enumerate(("rgb", "depth")):
        (root / f"{name}.txt").write_text("".join(f"{stamp(i)} {names[i][column]}\n" for i in range(N)))
    return root


def write_pairs(root: Path, room: Sequence, name: str = "associations.txt", depth_first: bool = True) -> Path:
    pairs = write_images(root, room)
    order = slice(None, None, -1) if depth_first else slice(None)
    lines = (" ".join(f"{i} {image}" for image in pair[order]) for i, pair in enumerate(pairs))
    (root / name).write_text("\n".join(lines))
    return root


def write_truth(file: Path, poses: np.ndarray, first: int, stamp: Callable[[int], str]) -> None:
    lines = []
    for i in range(first, N):
        quaternion = Rotation.from_matrix(poses[i, :3, :3]).as_quat()
        lines.append(" ".join([stamp(i), *(f"{value:.9f}" for value in (*poses[i, :3, 3], *quaternion))]))
    file.write_text("\n".join(lines))


def camera_file(root: Path, room: Sequence) -> None:
    np.savetxt(root / "camera-intrinsics.txt", room.intrinsics.matrix())


def truth_of(room: Sequence) -> np.ndarray:
    poses = room.poses_gt()
    assert poses is not None
    return poses


def assert_same_frames(sequence: Sequence, room: Sequence) -> None:
    for frame, source in zip(sequence, room, strict=True):
        np.testing.assert_array_equal(frame.color, source.color)
        np.testing.assert_allclose(frame.depth, source.depth, atol=2e-4)


# ---- ETH3D ----


def test_eth3d_brings_its_camera(tmp_path: Path, room: Sequence) -> None:
    root, k = write_lists(tmp_path / "cables_1", room), room.intrinsics
    (root / "calibration.txt").write_text(f"{k.fx} {k.fy} {k.cx} {k.cy}\n")
    write_truth(root / "groundtruth.txt", truth_of(room), 0, lambda i: f"{1e9 + i / 30:.6f}")
    sequence = open_sequence(root)
    assert (sequence.name, sequence.layout) == ("cables_1", "tum")
    np.testing.assert_allclose(sequence.intrinsics.matrix(), k.matrix())
    np.testing.assert_allclose(sequence.poses_gt(), truth_of(room), atol=1e-5)  # type: ignore[arg-type]
    assert problems(sequence) == []
    assert odd_truth(sequence) == ""
    assert_same_frames(sequence, room)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("60 60 40", "3 numbers"),
        ("60 0 40 0 60 30 0 0 1", "9 numbers"),
        ("", "0 numbers"),
        ("60 60 nan 30", "four, fx fy cx cy"),
        ("fx: 60", "not a number"),
        ("60 60 90 30", "inside the image"),
        ("-60 60 40 30", "must be positive"),
    ],
)
def test_a_calibration_that_is_none_is_refused(tmp_path: Path, room: Sequence, text: str, says: str) -> None:
    root = write_lists(tmp_path / "cables_1", room)
    (root / "calibration.txt").write_text(text)
    with pytest.raises(InputError, match=says) as caught:
        open_sequence(root)
    assert str(root) in str(caught.value)


def test_a_camera_that_is_known_otherwise_goes_before_calibration_and_says_so(tmp_path: Path, room: Sequence) -> None:
    for name, fx in (("freiburg1_desk", 517.3 / 8), ("cables_1", room.intrinsics.fx)):
        root = write_lists(tmp_path / name, room)
        (root / "calibration.txt").write_text("50 50 40 30")
        if name == "cables_1":
            camera_file(root, room)
        sequence = open_sequence(root)
        assert sequence.intrinsics.fx == pytest.approx(fx)
        assert any("calibration.txt is not used" in each for each in problems(sequence))


def test_an_unknown_camera_is_told_of(tmp_path: Path, room: Sequence) -> None:
    found = problems(open_sequence(write_lists(tmp_path / "mine", room)))
    assert any("a standard Kinect is assumed: no camera-intrinsics.txt or calibration.txt" in each for each in found)


# ---- lists of pairs ----


@pytest.mark.parametrize("depth_first", [True, False])
@pytest.mark.parametrize("name", ["associations.txt", "associated.txt", "association.txt", "associate.txt"])
def test_a_list_of_pairs_is_enough(tmp_path: Path, room: Sequence, name: str, depth_first: bool) -> None:
    root = write_pairs(tmp_path / "mine", room, name, depth_first)
    camera_file(root, room)
    sequence = open_sequence(root)
    assert (sequence.layout, len(sequence)) == ("tum", N)
    assert_same_frames(sequence, room)


def test_frames_have_the_times_of_depth_in_a_list_of_pairs(tmp_path: Path, room: Sequence) -> None:
    root = write_pairs(tmp_path / "mine", room)
    camera_file(root, room)
    lines = [f"{i / 30} rgb/{i}.png {i / 30 + 0.025} depth/{i}.png 0 0 0 0 0 0 1" for i in range(N)]
    (root / "associations.txt").write_text("# rgb, depth\n" + "\n".join(lines))
    np.testing.assert_allclose(open_sequence(root).timestamps(), np.arange(N) / 30 + 0.025)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "lists nothing"),
        ("0 rgb/0.png 0", "line 1 has 3 of 4"),
        ("a rgb/0.png a depth/0.png", "where a number is due"),
        ("0 rgb/0.png nan depth/0.png", "not finite"),
        ("0 rgb/0.png 0 depth/77.png", "missing"),
    ],
)
def test_a_broken_list_of_pairs_is_refused(tmp_path: Path, room: Sequence, text: str, says: str) -> None:
    root = write_pairs(tmp_path / "mine", room)
    (root / "associations.txt").write_text(text)
    with pytest.raises(InputError, match=says) as caught:
        open_sequence(root)
    assert str(root) in str(caught.value)


def test_few_missing_images_are_left_out_and_counted(tmp_path: Path, room: Sequence) -> None:
    for name, write in (("lists", write_lists), ("pairs", write_pairs)):
        root = write(tmp_path / name, room)
        camera_file(root, room)
        (root / "depth/7.png").unlink()
        sequence = open_sequence(root)
        assert len(sequence) == N - 1
        np.testing.assert_array_equal(sequence[7].color, room[8].color)
        assert any("1 listed images are missing and are left out, the first is 7.png" in p for p in problems(sequence))
        (root / "depth/8.png").unlink()
        with pytest.raises(InputError, match=r"2 listed images are missing, the first is .*7\.png"):
            open_sequence(root)


# ---- ICL-NUIM ----


def test_icl_nuim_is_mirrored_into_opencvs_axes(tmp_path: Path, room: Sequence) -> None:
    root = write_pairs(tmp_path / "kt1", room)
    write_truth(root / "livingRoom1.gt.freiburg", MIRROR @ truth_of(room) @ MIRROR, 1, str)
    k = open_sequence(root).intrinsics
    assert (8 * k.fx, 8 * k.fy, 8 * k.cx + 3.5, 8 * k.cy + 3.5) == pytest.approx((481.2, 480, 319.5, 239.5))
    camera_file(root, room)
    sequence = open_sequence(root)
    assert (sequence.name, sequence.layout, sequence.preset) == ("kt1", "icl", "lite")
    np.testing.assert_allclose(sequence.timestamps(), np.arange(N) / 30)
    assert sequence[0].c2w_gt is None
    np.testing.assert_allclose([frame.c2w_gt for frame in list(sequence)[1:]], truth_of(room)[1:], atol=1e-6)
    assert problems(sequence) == [f"1 of {N} frames have no ground truth within 20 ms"]
    assert odd_truth(sequence) == ""
    assert_same_frames(sequence, room)


@pytest.mark.parametrize("name", ["living_room_traj1_frei_png", "living_room_traj2n_frei_png", "traj0_frei_png"])
def test_icl_nuim_is_known_by_its_folder_too(tmp_path: Path, room: Sequence, name: str) -> None:
    sequence = open_sequence(write_pairs(tmp_path / name, room))
    assert sequence.layout == "icl"
    assert sequence.intrinsics.fy == 60
    assert sequence.poses_gt() is None
    assert not any("Kinect" in each for each in problems(sequence))


def test_of_several_truths_none_is_used(tmp_path: Path, room: Sequence) -> None:
    root = write_pairs(tmp_path / "kt1", room)
    for name in ("livingRoom1.gt.freiburg", "livingRoom2.gt.freiburg"):
        write_truth(root / name, truth_of(room), 1, str)
    sequence = open_sequence(root)
    assert sequence.poses_gt() is None
    assert any("several files of ground truth" in each for each in problems(sequence))


# ---- Bonn ----


def test_bonns_markers_are_no_camera(tmp_path: Path, room: Sequence) -> None:
    marked = np.array([[1.0157, 0.1828, -0.2389], [0.0009, -0.8431, -0.6413], [-0.3009, 0.6147, -0.8085]])
    markers = np.eye(4)
    markers[:3, :3] = Rotation.from_matrix(marked / np.cbrt(np.linalg.det(marked))).as_matrix()
    markers[:3, 3] = 0.0113, -0.0098, 0.0111
    root = write_lists(tmp_path / "rgbd_bonn_balloon", room)
    stored = ROS @ truth_of(room) @ np.linalg.inv(markers) @ ROS
    write_truth(root / "groundtruth.txt", stored, 0, lambda i: f"{1e9 + i / 30:.6f}")
    sequence = open_sequence(root)
    k = sequence.intrinsics
    assert (8 * k.fx, 8 * k.fy) == pytest.approx((542.822841, 542.57687))
    assert k.distortion == (0.039903, -0.099343, -0.00073, -0.000144)
    assert sequence.layout == "tum"
    np.testing.assert_allclose(sequence.poses_gt(), truth_of(room), atol=2e-4)  # type: ignore[arg-type]
    assert not any("ground truth" in each or "Kinect" in each for each in problems(sequence))
