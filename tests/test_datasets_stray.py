"""Stray Scanner: what the phone was not sure of, edges, how it was held, and files that do not match."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import phone
import pytest
from scipy.spatial.transform import Rotation

from ecslam.config_files import for_layout, load_preset
from ecslam.datasets import Prefetch, open_sequence, problems
from ecslam.datasets.check import check_sequence, format_report
from ecslam.datasets.stray import finer
from ecslam.evaluation.depth_views import up_direction
from ecslam.evaluation.trajectory import absolute_error
from ecslam.slam import Slam
from ecslam.types import Frame, FrameError, InputError, Sequence

W, H, N = 32, 24, 8  # of depth
MATRIX = np.array([[240.0, 0, 135.5], [0, 250.0, 91.5], [0, 0, 1]])  # of colour, 8 times as fine
UPRIGHT = np.diag([1.0, -1, -1, 1])  # level, and looks along -z in a world with y up


def picture(i: int) -> np.ndarray:
    """Blue tells the frame; red grows to the right, green downwards."""
    image = np.full((8 * H, 8 * W, 3), 20 * i, np.uint8)
    image[..., 0] = np.linspace(0, 255, 8 * W)
    image[..., 1] = np.linspace(0, 255, 8 * H)[:, None]
    return image


def write(root: Path, poses: list[np.ndarray] | None = None, depth: np.ndarray | None = None) -> Path:
    wall = np.full((H, W), 2000, np.uint16) if depth is None else depth
    return phone.record(root, [picture(i) for i in range(N)], [wall] * N, poses or [UPRIGHT] * N, MATRIX)


def rewrite(file: Path, change: Callable[[list[str]], list[str]]) -> None:
    file.write_text("\n".join(change(file.read_text().splitlines())))


def frame_of(color: np.ndarray) -> int:
    return round(float(color[..., 2].mean()) / 20)


# ---- depth ----


def test_depth_the_phone_is_not_sure_of_is_none(tmp_path: Path) -> None:
    root = write(tmp_path / "room")
    levels = np.full((H, W), 2, np.uint8)
    levels[5, 7], levels[9, 3] = 0, 1
    assert cv2.imwrite(str(root / "confidence/000002.png"), levels)
    missing = np.argwhere(open_sequence(root)[2].depth == 0)
    assert missing.tolist() == [[10, 14], [10, 15], [11, 14], [11, 15]]


def test_without_confidence_all_depth_is_used_and_a_note_says_so(tmp_path: Path) -> None:
    root = write(tmp_path / "room")
    shutil.rmtree(root / "confidence")
    sequence = open_sequence(root)
    assert (sequence[0].depth > 0).all()
    assert any("no confidence folder" in each for each in problems(sequence))


def test_a_slanted_surface_stays_a_plane_when_depth_is_made_finer() -> None:
    v, u = np.mgrid[:H, :W].astype(np.float32)
    fine = finer(2 + 0.01 * u + 0.005 * v, (2 * W, 2 * H))
    v, u = (np.mgrid[: 2 * H, : 2 * W].astype(np.float32) - 0.5) / 2
    np.testing.assert_allclose(fine[1:-1, 1:-1], (2 + 0.01 * u + 0.005 * v)[1:-1, 1:-1], atol=1e-5)


def test_nothing_is_made_up_between_near_and_far_or_beside_what_is_missing() -> None:
    depth = np.full((H, W), 3.0, np.float32)
    depth[:, : W // 2] = 1.0
    depth[3, 3] = 0
    fine = finer(depth, (2 * W, 2 * H))
    np.testing.assert_array_equal(fine, depth.repeat(2, 0).repeat(2, 1))


def test_depth_in_numpy_files_is_the_same(tmp_path: Path) -> None:
    ramp = np.arange(2000, 2000 + W * H, dtype=np.uint16).reshape(H, W)
    root = write(tmp_path / "room", depth=ramp)
    before = open_sequence(root)[1].depth
    for file in sorted((root / "depth").glob("*.png")):
        np.save(file.with_suffix(".npy"), ramp)
        file.unlink()
    np.testing.assert_array_equal(open_sequence(root)[1].depth, before)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda file, data: file.write_bytes(data[:-2]), "not as long"),
        (lambda file, data: file.write_bytes(data[:40]), "no NumPy array"),
        (lambda file, data: file.write_bytes(b""), "empty file"),
        (lambda file, data: np.save(file, np.zeros((H, 2 * W), np.uint16)), f"{2 * W}x{H} pixels"),
        (lambda file, data: np.save(file, np.zeros((H, W), np.float32)), "float32"),
        (lambda file, data: np.save(file, np.array([{}])), "object"),
        (lambda file, data: file.write_bytes(data.replace(b"(24, 32)", b"(9999999,99999999)")), "no NumPy|pixels"),
    ],
)
def test_a_damaged_numpy_file_is_a_frame_error(tmp_path: Path, damage: Callable[..., None], says: str) -> None:
    root = write(tmp_path / "room")
    for file in sorted((root / "depth").glob("*.png")):
        np.save(file.with_suffix(".npy"), np.full((H, W), 2000, np.uint16))
        file.unlink()
    file = root / "depth/000003.npy"
    damage(file, file.read_bytes())
    sequence = open_sequence(root)
    with pytest.raises(FrameError, match=says) as caught:
        sequence[3]
    assert "000003.npy" in str(caught.value)
    assert sequence[4].index == 4


def test_a_missing_or_damaged_confidence_is_a_frame_error(tmp_path: Path) -> None:
    root = write(tmp_path / "room")
    (root / "confidence/000001.png").unlink()
    assert cv2.imwrite(str(root / "confidence/000002.png"), np.zeros((H, W), np.uint16))
    sequence = open_sequence(root)
    with pytest.raises(FrameError, match=r"confidence/000001\.png"):
        sequence[1]
    with pytest.raises(FrameError, match="confidence must be a 8-bit PNG"):
        sequence[2]


# ---- frames of the video ----


def test_a_frame_without_depth_is_left_out_and_moves_no_other(tmp_path: Path) -> None:
    root = write(tmp_path / "room", [UPRIGHT @ shifted(i) for i in range(N)])
    for number in (0, 4):
        (root / f"depth/{number:06d}.png").unlink()
    sequence = open_sequence(root)
    assert [frame_of(frame.color) for frame in sequence] == [1, 2, 3, 5, 6, 7]
    np.testing.assert_allclose(sequence.timestamps(), 5000 + np.array([1, 2, 3, 5, 6, 7]) / 60)
    np.testing.assert_allclose([frame.c2w_gt[0, 3] for frame in sequence], [1, 2, 3, 5, 6, 7])  # type: ignore[index]
    assert any("2 frames of rgb.mp4 have no depth" in each for each in problems(sequence))


def shifted(i: int) -> np.ndarray:
    move = np.eye(4)
    move[0, 3] = i
    return move


def test_a_short_video_ends_the_sequence(tmp_path: Path) -> None:
    root, short = write(tmp_path / "room"), tmp_path / "short"
    phone.record(short, [picture(i) for i in range(5)], [np.ones((H, W), np.uint16)] * 5, [UPRIGHT] * 5, MATRIX)
    shutil.copy(short / "rgb.mp4", root)
    sequence = open_sequence(root)
    assert len(sequence) == 5
    assert any("3 depth images come after the end" in each for each in problems(sequence))
    for number in range(5):
        (root / f"depth/{number:06d}.png").unlink()
    with pytest.raises(InputError, match="ends before the first depth"):
        open_sequence(root)


def test_frames_read_ahead_are_those_read_one_by_one(tmp_path: Path) -> None:
    root = write(tmp_path / "room")
    alone, together = open_sequence(root), open_sequence(root)
    for index, frame in Prefetch(together, threads=4):
        assert isinstance(frame, Frame)
        np.testing.assert_array_equal(frame.color, alone[index].color)
        assert frame_of(frame.color) == index


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("rgb.mp4", b"", "truncated video"),
        ("camera_matrix.csv", b"1, 2\n", "3x3"),
        ("camera_matrix.csv", b"nan,0,1\n0,1,1\n0,0,1", "3x3"),
        ("camera_matrix.csv", b"240,0,999\n0,240,90\n0,0,1", "do not fit"),
        ("odometry.csv", b"", "names no timestamp"),
        ("odometry.csv", b"timestamp, frame, x, y, z\n1, 0, 0, 0, 0", "names no qx, qy, qz, qw"),
        ("odometry.csv", b"timestamp, frame, x, y, z, qx, qy, qz, qw\n", "no line has a time"),
        ("odometry.csv", b"\xff\xfe\xff", "not text in UTF-8"),
    ],
)
def test_files_that_cannot_be_used_are_refused(tmp_path: Path, name: str, data: bytes, says: str) -> None:
    root = write(tmp_path / "room")
    (root / name).write_bytes(data)
    with pytest.raises(InputError, match=says) as caught:
        open_sequence(root)
    assert str(root) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_recording_without_depth_is_refused(tmp_path: Path) -> None:
    root = write(tmp_path / "room")
    shutil.rmtree(root / "depth")
    with pytest.raises(InputError, match="LiDAR"):
        open_sequence(root)


# ---- odometry ----


def test_damaged_lines_cost_their_frames_the_pose_and_nothing_else(tmp_path: Path) -> None:
    root = write(tmp_path / "room")

    def damage(lines: list[str]) -> list[str]:
        fields = lines[3].split(", ")
        lines[3] = ", ".join([*fields[:2], "nan", *fields[3:]])
        lines[5] = ", ".join([*lines[5].split(", ")[:5], "0, 0, 0, 0"])
        return [*lines[:6], "", lines[6], lines[6], "5000.1, half a li", *lines[8:]]

    rewrite(root / "odometry.csv", damage)
    sequence = open_sequence(root)
    np.testing.assert_allclose(sequence.timestamps(), 5000 + np.arange(N) / 60, atol=1e-6)
    assert [frame.c2w_gt is None for frame in sequence] == [False, False, True, False, True, False, True, False]
    found = " ".join(problems(sequence))
    assert "ARKit's estimate" in found
    assert "2 of 7 ground-truth poses" in found
    assert "2 lines of odometry.csv are damaged or repeated" in found
    assert "1 of 8 frames have no line" in found


def test_without_odometry_the_video_tells_the_time(tmp_path: Path) -> None:
    root = write(tmp_path / "room")
    (root / "odometry.csv").unlink()
    sequence = open_sequence(root)
    np.testing.assert_allclose(sequence.timestamps(), np.arange(N) / 60)
    assert sequence.poses_gt() is None
    assert problems(sequence) == []


def test_the_lens_is_the_median_of_what_each_frame_had(tmp_path: Path) -> None:
    root = write(tmp_path / "room")

    def lens(lines: list[str]) -> list[str]:
        rows = [f"{line}, {230 + 2 * i}, {230 + 2 * i}, 127.5, 95.5, , " for i, line in enumerate(lines[1:])]
        return [f"{lines[0]}, fx, fy, cx, cy, distortion_center_x, distortion_center_y", *rows]

    rewrite(root / "odometry.csv", lens)
    sequence = open_sequence(root)
    assert sequence.intrinsics.fx == 237 / 4
    assert (sequence.intrinsics.cx, sequence.intrinsics.cy) == (31.5, 23.5)
    assert any("autofocus moves the focal length by 5.7%" in each for each in problems(sequence))


def test_the_camera_is_that_of_the_video_at_the_size_of_the_frames(tmp_path: Path) -> None:
    k = open_sequence(write(tmp_path / "room")).intrinsics
    assert (k.width, k.height) == (64, 48)
    assert (k.fx, k.fy, k.cx, k.cy) == (60, 62.5, 136 / 4 - 0.5, 92 / 4 - 0.5)


# ---- how it was held ----


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_pictures_are_turned_upright_with_camera_and_poses(tmp_path: Path, quarters: int) -> None:
    held = np.eye(4)
    held[:3, :3] = Rotation.from_euler("z", 90 * quarters, degrees=True).as_matrix()
    tilt = np.eye(4)
    tilt[:3, :3] = Rotation.from_euler("x", -25, degrees=True).as_matrix()
    pose = UPRIGHT @ tilt @ held
    root = write(tmp_path / "room", [pose] * N)
    sequence = open_sequence(root)
    poses = sequence.poses_gt()
    assert poses is not None
    assert up_direction(poses)[1] > 0.9
    frame, k = sequence[3], sequence.intrinsics
    assert frame.color.shape[:2] == frame.depth.shape == (k.height, k.width)
    upright = np.rot90(cv2.resize(picture(3), (64, 48), interpolation=cv2.INTER_AREA), -quarters)
    np.testing.assert_allclose(frame.color.astype(int), upright.astype(int), atol=12)
    shown = np.array([20.0, 11, 1])
    row, column = np.argwhere(places() == np.rot90(places(), -quarters)[11, 20])[0]
    u, v = column * 4 + 1.5, row * 4 + 1.5
    seen = poses[3, :3, :3] @ np.linalg.inv(k.matrix()) @ shown
    recorded = pose[:3, :3] @ np.linalg.inv(MATRIX) @ np.array([u, v, 1])
    np.testing.assert_allclose(seen, recorded, atol=1e-9)
    assert any("turned by" in each for each in problems(sequence)) == (quarters > 0)


def places() -> np.ndarray:
    """A number for each pixel of a frame."""
    return np.arange(48 * 64).reshape(48, 64)


def test_a_camera_that_looks_straight_down_is_not_turned(tmp_path: Path) -> None:
    down = np.eye(4)
    down[:3, :3] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    assert not any("turned" in each for each in problems(open_sequence(write(tmp_path / "room", [down] * N))))


# ---- as a whole ----


def test_a_check_reads_well(tmp_path: Path) -> None:
    text = format_report(check_sequence(open_sequence(write(tmp_path / "room"))))
    assert "room (stray layout, preset lite)" in text
    assert "8, 8 of 8 tried readable" in text
    assert "ARKit's estimate" in text


def test_depth_beyond_a_phones_reach_is_left_out() -> None:
    assert for_layout(load_preset("live"), "stray").depth_far_m == 5.0


@pytest.mark.slow
def test_a_room_recorded_by_a_phone_is_tracked_about_as_well_as_the_room_itself(tmp_path: Path) -> None:
    fine, coarse, itself = (
        open_sequence(f"synthetic/studio?size={size}&frames=12") for size in ("640x480", "160x120", "320x240")
    )
    y_up = np.eye(4)
    y_up[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    truth = fine.poses_gt()
    assert truth is not None
    depths = [np.rint(frame.depth * 1000).astype(np.uint16) for frame in coarse]
    root = phone.record(
        tmp_path / "room", [f.color for f in fine], depths, list(y_up @ truth), fine.intrinsics.matrix()
    )
    recorded = open_sequence(root)
    assert not any("turned" in each for each in problems(recorded))
    assert error_cm(recorded) < 2 * error_cm(itself) + 0.05


def error_cm(sequence: Sequence) -> float:
    slam = Slam(load_preset("live"), sequence.intrinsics, first_pose=sequence[0].c2w_gt)
    for frame in sequence:
        slam.step(frame)
    truth = sequence.poses_gt()
    assert truth is not None
    error = absolute_error(slam.trajectory.poses(), truth)
    assert error is not None
    return error.cm.rmse
