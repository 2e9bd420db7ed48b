"""Recordings of ROS: every storage and encoding, which topics are taken, and what is damaged or missing."""

from __future__ import annotations

import shutil
import sqlite3
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
import robot
from robot import CAMERA, COLOR, DEPTH, START, Robot

from ecslam.config_files import load_preset
from ecslam.datasets import Prefetch, open_sequence, problems, rosindex, split_address
from ecslam.datasets.check import check_sequence, format_report
from ecslam.datasets.roots import sequences_under
from ecslam.slam import Slam
from ecslam.types import Frame, FrameError, InputError, Sequence

W, H, N = 80, 60, 6
K = np.array([[60.0, 0, 39.5], [0, 60.0, 29.5], [0, 0, 1]])
INFO = "/camera/color/camera_info"


@pytest.fixture(scope="module")
def room() -> list[Frame]:
    return list(open_sequence(f"synthetic/studio?size={W}x{H}&frames={N}"))


def picture(i: int) -> np.ndarray:
    image = np.full((H, W, 3), 10 * i, np.uint8)
    image[..., 0] = np.linspace(0, 255, W)
    return image


def wall(metres: float = 2.0) -> np.ndarray:
    return np.full((H, W), 1000 * metres, np.uint16)


def write(
    path: Path, storage: str = "mcap", more: Callable[[Robot], None] = lambda r: None, *, camera: bool = True,
    color: str = COLOR, depth: str = DEPTH, frames: tuple[str, str] = (CAMERA, CAMERA),
) -> Path:  # fmt: skip
    """N frames and what ``more`` sends."""
    with robot.recording(path, storage) as r:
        if camera:
            r.camera(f"{color.rpartition('/')[0]}/camera_info", K, (W, H))
        for i in range(N):
            r.image(color, START + i / 30, picture(i), "rgb8", frame=frames[0])
            r.image(depth, START + i / 30 + 0.001, wall(), "16UC1", frame=frames[1])
        more(r)
    return path


def file_of(path: Path) -> Path:
    """The file in which the messages are."""
    return path if path.is_file() else next(each for each in path.iterdir() if each.name != "metadata.yaml")


def place_for(tmp_path: Path, storage: str) -> Path:
    return tmp_path / ("room.bag" if storage.startswith("bag") else "room")


# ---- storages and encodings ----


@pytest.mark.parametrize("storage", robot.STORAGES)
def test_every_storage_gives_the_frames_that_were_recorded(tmp_path: Path, room: Sequence, storage: str) -> None:
    source = open_sequence(f"synthetic/studio?size={W}x{H}&frames={N}")
    sequence = open_sequence(robot.record(place_for(tmp_path, storage), source, storage))
    assert (sequence.name, len(sequence), problems(sequence)) == ("room", N, [])
    np.testing.assert_allclose(sequence.timestamps() - START, source.timestamps(), atol=1e-6)
    found = dict(Prefetch(sequence, threads=4))
    for frame in room:
        read = found[frame.index]
        assert isinstance(read, Frame)
        np.testing.assert_array_equal(read.color, frame.color)
        np.testing.assert_allclose(read.depth, frame.depth, atol=6e-4)
        np.testing.assert_allclose(read.c2w_gt, frame.c2w_gt, atol=1e-6)  # type: ignore[arg-type]
        assert read.color.flags.writeable
        assert read.depth.flags.writeable


def test_a_file_of_a_folder_opens_by_itself(tmp_path: Path) -> None:
    for storage in ("mcap", "db3"):
        folder = write(tmp_path / storage, storage)
        assert len(open_sequence(file_of(folder))) == N


@pytest.mark.parametrize(("encoding", "off"), [("bgr8", 0), ("rgba8", 0), ("bgra8", 0), ("png", 0), ("jpeg", 12)])
def test_colour_is_rgb_however_it_was_sent(tmp_path: Path, encoding: str, off: float) -> None:
    with robot.recording(tmp_path / "room", "mcap") as r:
        r.camera(INFO, K, (W, H))
        robot.send_color(r, START, picture(7), encoding)
        robot.send_depth(r, START, np.full((H, W), 2, np.float32), "16UC1")
    color = open_sequence(tmp_path / "room")[0].color
    assert np.abs(color.astype(int) - picture(7)).max() <= off


@pytest.mark.parametrize("storage", ["bag", "mcap"])
@pytest.mark.parametrize(
    ("encoding", "off"), [("32FC1", 0), ("16UC1", 6e-4), ("packed 16UC1", 6e-4), ("packed 32FC1", 6e-3)]
)
def test_depth_is_metres_however_it_was_sent(tmp_path: Path, storage: str, encoding: str, off: float) -> None:
    ramp = np.linspace(0.3, 9, W * H, dtype=np.float32).reshape(H, W)
    ramp[3, 4] = 0
    path = place_for(tmp_path, storage)
    with robot.recording(path, storage) as r:
        r.camera(INFO, K, (W, H))
        robot.send_color(r, START, picture(0), "jpeg")
        robot.send_depth(r, START, ramp, encoding)
    depth = open_sequence(path)[0].depth
    assert depth[3, 4] == 0
    np.testing.assert_allclose(depth, ramp, rtol=off, atol=6e-4)


def test_depth_that_is_not_a_positive_number_is_none(tmp_path: Path) -> None:
    odd = np.full((H, W), 2, np.float32)
    odd[:2, 0], odd[:2, 1] = [np.nan, np.inf], [-1, -np.inf]
    with robot.recording(tmp_path / "room", "mcap") as r:
        r.camera(INFO, K, (W, H))
        r.image(COLOR, START, picture(0), "rgb8")
        r.image(DEPTH, START, odd, "32FC1")
    depth = open_sequence(tmp_path / "room")[0].depth
    assert (depth[:2, :2] == 0).all()
    assert (depth[2:] == 2).all()


def test_filled_rows_and_either_byte_order_are_the_same_image(tmp_path: Path) -> None:
    ramp = np.arange(1000, 1000 + W * H, dtype=np.uint16).reshape(H, W)
    with robot.recording(tmp_path / "room", "db3") as r:
        r.camera(INFO, K, (W, H))
        for i, big in enumerate((False, True)):
            r.image(COLOR, START + i, picture(3), "bgr8", fill=5)
            r.image(DEPTH, START + i, ramp, "16UC1", fill=6, big=big)
    for frame in open_sequence(tmp_path / "room"):
        np.testing.assert_array_equal(frame.color, picture(3)[..., ::-1])
        np.testing.assert_allclose(frame.depth, ramp / 1000, atol=1e-6)


def test_colour_finer_than_depth_is_shrunk_and_the_camera_with_it(tmp_path: Path) -> None:
    with robot.recording(tmp_path / "room", "mcap") as r:
        r.camera(INFO, np.array([[120.0, 0, 79.5], [0, 120.0, 59.5], [0, 0, 1]]), (2 * W, 2 * H))
        r.image(COLOR, START, picture(3).repeat(2, 0).repeat(2, 1), "rgb8")
        r.image(DEPTH, START, wall(), "16UC1")
    sequence = open_sequence(tmp_path / "room")
    k = sequence.intrinsics
    assert (k.fx, k.fy, k.cx, k.cy, k.width, k.height) == (60, 60, 39.5, 29.5, W, H)
    np.testing.assert_array_equal(sequence[0].color, picture(3))


def test_opening_reads_hardly_any_of_it(tmp_path: Path) -> None:
    for storage in ("bag", "mcap", "db3"):
        path = place_for(tmp_path, storage)
        with robot.recording(path, storage) as r:
            r.camera(INFO, 10 * K, (10 * W, 10 * H))
            for i in range(8):
                r.image(COLOR, START + i, np.zeros((10 * H, 10 * W, 3), np.uint8), "rgb8")
                r.image(DEPTH, START + i, np.zeros((10 * H, 10 * W), np.uint16), "16UC1")
        read = read_so_far()
        tracemalloc.start()
        sequence = open_sequence(path)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert len(sequence) == 8
        size = file_of(path).stat().st_size
        assert peak < size / 3
        if sys.version_info >= (3, 11) and read is not None:
            assert (read_so_far() or 0) - read < size / 2
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def read_so_far() -> int | None:
    """Bytes that this process has read from files, where the system tells."""
    try:
        return int(Path("/proc/self/io").read_text().split()[1])
    except OSError:
        return None


# ---- which topics ----

KINECT = ("/camera/rgb/image_color", "/camera/depth/image")


@pytest.mark.parametrize(
    ("color", "depth", "frames"),
    [
        (*KINECT, ("/openni_rgb_optical_frame", "openni_rgb_optical_frame")),
        ("/camera/rgb/image_rect_color", "/camera/depth_registered/image_rect", ("rgb", "rgb")),
        ("/rgb/image_raw", "/depth_to_rgb/image_raw", ("rgb_camera_link", "rgb_camera_link")),
        ("/zed/zed_node/rgb/image_rect_color", "/zed/zed_node/depth/depth_registered", ("zed_left", "zed_left")),
        ("/camera/color/image_raw", "/camera/depth/image_raw", ("color", "color")),
        ("/cam/color/image_raw", "/cam/aligned_depth_to_color/image_raw", ("", "")),
    ],
)
def test_the_usual_topics_are_found_among_others(
    tmp_path: Path, color: str, depth: str, frames: tuple[str, str]
) -> None:
    def others(r: Robot) -> None:
        for i in range(2):
            time = START + i / 30
            r.image("/camera/infra1/image_rect_raw", time, picture(0)[..., 0], "mono8", frame="infra")
            r.image("/ir/image_raw", time, wall(), "mono16", frame=frames[0])
            r.image("/detections/overlay", time, picture(9), "bgr8", frame=frames[0])
            r.image("/camera/depth/image_rect_raw", time, wall(3), "16UC1", frame="depth_optical")
            r.compressed(
                f"{color}/compressed", time, cv2.imencode(".jpg", picture(9))[1].tobytes(), "jpeg", frame=frames[0]
            )

    sequence = open_sequence(write(tmp_path / "room", "mcap", others, color=color, depth=depth, frames=frames))
    assert len(sequence) == N
    np.testing.assert_array_equal(sequence[1].color, picture(1))
    assert (sequence[0].depth == 2).all()


def two_cameras(r: Robot) -> None:
    r.camera("/back/color/camera_info", K, (W, H))
    for i in range(N):
        r.image("/back/color/image_raw", START + i / 30, picture(0), "rgb8", frame="back")
        r.image("/back/aligned_depth_to_color/image_raw", START + i / 30, wall(3), "16UC1", frame="back")


def test_of_several_cameras_the_user_says_which(tmp_path: Path) -> None:
    path = write(tmp_path / "room", "mcap", two_cameras)
    with pytest.raises(InputError, match=r"several cameras.*/back/color/image_raw.*\?color=/TOPIC") as caught:
        open_sequence(path)
    assert "\n" not in str(caught.value)
    assert (open_sequence(f"{path}?color=/back/color/image_raw")[0].depth == 3).all()
    assert (open_sequence(f"{path}?depth={DEPTH}")[0].depth == 2).all()
    chosen = open_sequence(f"{path}?color={COLOR}&depth=/back/aligned_depth_to_color/image_raw")
    assert (chosen[0].depth == 3).all()
    with pytest.raises(InputError, match="/front is no topic with colour images"):
        open_sequence(f"{path}?color=/front")
    with pytest.raises(InputError, match=f"{DEPTH} is no topic with colour images.*{DEPTH} 16UC1"):
        open_sequence(f"{path}?color={DEPTH}&depth={COLOR}")
    with pytest.raises(InputError, match="no option 'colour'"):
        open_sequence(f"{path}?colour=/front")


@pytest.mark.parametrize("frames", [("color", "depth"), ("", ""), ("0", "0")])
def test_depth_that_is_not_registered_is_refused_unless_the_user_says_that_it_is(
    tmp_path: Path, frames: tuple[str, str]
) -> None:
    depth = "/camera/depth/image_rect_raw"
    path = write(tmp_path / "room", "mcap", depth=depth, frames=frames)
    with pytest.raises(InputError, match=r"not registered.*align_depth"):
        open_sequence(path)
    assert len(open_sequence(f"{path}?color={COLOR}&depth={depth}")) == N


def test_without_depth_or_colour_it_says_what_there_is(tmp_path: Path) -> None:
    with robot.recording(tmp_path / "a", "mcap") as r:
        r.image(COLOR, START, picture(0), "rgb8")
    with pytest.raises(InputError, match=f"no depth images.*{COLOR} rgb8"):
        open_sequence(tmp_path / "a")
    with robot.recording(tmp_path / "b", "mcap") as r:
        r.image(DEPTH, START, wall(), "16UC1")
        r.image(COLOR, START, picture(0)[..., 0], "bayer_rggb8")
    with pytest.raises(InputError, match=r"no colour images.*bayer_rggb8"):
        open_sequence(tmp_path / "b")
    with robot.recording(tmp_path / "c.bag") as r:
        r.transform(START, "world", "x", np.eye(4))
    with pytest.raises(InputError, match="are none"):
        open_sequence(tmp_path / "c.bag")


def test_what_a_recording_calls_its_topics_stays_on_one_line(tmp_path: Path) -> None:
    with robot.recording(tmp_path / "room.bag") as r:
        r.image("/a\n\x1b[31mb", START, picture(0), "rgb\n8", frame="c\nd")
    with pytest.raises(InputError, match=r"/a\?\?\[31mb rgb\?8") as caught:
        open_sequence(tmp_path / "room.bag")
    assert str(caught.value).isprintable()


# ---- the camera ----


def test_without_camera_info_the_matrix_may_lie_beside_it(tmp_path: Path) -> None:
    path = write(tmp_path / "room.bag", "bag", camera=False)
    with pytest.raises(InputError, match=f"no {INFO} in it.*camera-intrinsics.txt"):
        open_sequence(path)
    np.savetxt(tmp_path / "camera-intrinsics.txt", 2 * K / 2)
    sequence = open_sequence(path)
    assert sequence.intrinsics.fx == 60
    assert any("camera-intrinsics.txt" in each for each in problems(sequence))


def test_the_camera_of_depth_will_do(tmp_path: Path) -> None:
    info = f"{DEPTH.rpartition('/')[0]}/camera_info"
    sequence = open_sequence(write(tmp_path / "room", "mcap", lambda r: r.camera(info, K, (W, H)), camera=False))
    assert sequence.intrinsics.fx == 60
    assert any(f"no {INFO}: the camera is that of {info}" in each for each in problems(sequence))


@pytest.mark.parametrize("storage", ["bag", "mcap"])
def test_a_lens_is_corrected(tmp_path: Path, storage: str) -> None:
    bend = (0.2, -0.3, 0.001, 0.002, 0.1)
    path = place_for(tmp_path, storage)
    write(path, storage, lambda r: r.camera(INFO, K, (W, H), bend), camera=False)
    sequence = open_sequence(path)
    assert sequence.intrinsics.distortion == bend
    flat = cv2.undistort(picture(3), K, np.array(bend))
    assert np.abs(sequence[3].color.astype(int) - flat).max() < 12
    assert np.abs(sequence[3].color.astype(int) - picture(3)).max() > 12


def test_rectified_images_take_the_projection(tmp_path: Path) -> None:
    path, flat = tmp_path / "room", K + np.array([[5, 0, 1], [0, 5, 2], [0, 0, 0]])
    color, depth = "/camera/rgb/image_rect_color", "/camera/depth_registered/image_rect"
    info = "/camera/rgb/camera_info"
    write(
        path, "mcap", lambda r: r.camera(info, K, (W, H), (0.2, 0, 0, 0, 0), projection=flat), color=color, depth=depth,
        camera=False,
    )  # fmt: skip
    k = open_sequence(path).intrinsics
    assert (k.fx, k.fy, k.cx, k.cy, k.distortion) == (65, 65, 40.5, 31.5, ())


@pytest.mark.parametrize(
    ("matrix", "bend", "model", "depth", "says"),
    [
        (K, (0.1,) * 4, "equidistant", DEPTH, "lens 'equidistant' with 4 numbers"),
        (0 * K, (), "", DEPTH, "do not fit"),
        (np.nan * K, (), "", DEPTH, "not a number"),
        (K, (0.1, 0, 0, 0, 0), "plumb_bob", "/camera/depth_registered/image_rect", "only one of"),
    ],
)
def test_a_camera_that_cannot_be_used_is_refused(
    tmp_path: Path, matrix: np.ndarray, bend: tuple[float, ...], model: str, depth: str, says: str
) -> None:
    path = tmp_path / "room"
    write(path, "mcap", lambda r: r.camera(INFO, matrix, (W, H), bend, model=model), depth=depth, camera=False)
    with pytest.raises(InputError, match=says) as caught:
        open_sequence(path)
    assert str(path) in str(caught.value)


# ---- times and poses ----


def test_a_frame_has_the_time_of_its_depth_and_what_has_no_partner_is_counted(tmp_path: Path) -> None:
    def more(r: Robot) -> None:
        r.image(COLOR, START + 9, picture(0), "rgb8")

    sequence = open_sequence(write(tmp_path / "room", "mcap", more))
    np.testing.assert_allclose(sequence.timestamps() - START, np.arange(N) / 30 + 0.001, atol=1e-6)
    assert problems(sequence) == ["1 colour and 0 depth images have no partner within 20 ms and are left out"]


def test_images_of_two_clocks_are_refused(tmp_path: Path) -> None:
    with robot.recording(tmp_path / "room", "mcap") as r:
        r.camera(INFO, K, (W, H))
        r.image(COLOR, START, picture(0), "rgb8")
        r.image(DEPTH, START + 1e6, wall(), "16UC1")
    with pytest.raises(InputError, match="one clock"):
        open_sequence(tmp_path / "room")


@pytest.mark.parametrize("storage", ["bag", "mcap", "db3"])
def test_images_without_a_time_have_that_of_recording(tmp_path: Path, storage: str) -> None:
    path = place_for(tmp_path, storage)
    with robot.recording(path, storage) as r:
        r.camera(INFO, K, (W, H))
        for i in range(N):
            r.image(COLOR, 0, picture(i), "rgb8")
            r.image(DEPTH, 0, wall(), "16UC1")
    sequence = open_sequence(path)
    assert len(sequence) == N
    assert START < sequence.timestamps()[0] < START + 1


def test_poses_of_something_else_are_no_ground_truth_and_a_note_says_so(tmp_path: Path) -> None:
    def odometry(r: Robot) -> None:
        there = np.eye(4)
        for i in range(N):
            there[0, 3] = i
            r.transform(START + i / 30, "world", "map", np.eye(4))
            r.transform(START + i / 30, "map", "odom", np.eye(4))
            r.transform(START + i / 30, "odom", CAMERA, there)

    sequence = open_sequence(write(tmp_path / "room", "mcap", odometry))
    assert sequence.poses_gt() is None
    assert any("transforms from world: no ground truth" in each for each in problems(sequence))


def test_a_camera_that_hangs_on_two_frames_has_no_ground_truth(tmp_path: Path) -> None:
    def both(r: Robot) -> None:
        for parent in ("world", "gripper"):
            r.transform(START, parent, CAMERA, np.eye(4))

    assert open_sequence(write(tmp_path / "room", "mcap", both)).poses_gt() is None


def test_a_static_link_is_known_at_all_times_and_a_moving_one_only_nearby(tmp_path: Path) -> None:
    mount, there = np.eye(4), np.eye(4)
    mount[:3, 3], there[0, 3] = [0, 0, 1], 5

    def truth(r: Robot) -> None:
        r.transform(START - 100, "kinect", CAMERA, mount, "/tf_static")
        for time in (0, 1, 4):
            there[1, 3] = time
            r.transform(START + time / 30 + 0.001, "/world", "/kinect", there)

    poses = open_sequence(write(tmp_path / "room.bag", "bag", truth)).poses_gt()
    assert poses is not None
    np.testing.assert_allclose(poses[[0, 1, 4], :3, 3], [[5, 0, 1], [5, 1, 1], [5, 4, 1]], atol=1e-3)
    assert np.isnan(poses[5]).all()


# ---- damage ----


@pytest.mark.parametrize("storage", ["bag", "bag-lz4", "mcap", "mcap-zstd"])
def test_a_recording_that_broke_off_is_read_as_far_as_it_goes(tmp_path: Path, storage: str) -> None:
    def long(r: Robot) -> None:
        for i in range(N, 200):
            r.image(COLOR, START + i / 30, np.random.default_rng(i).integers(0, 255, (H, W, 3), np.uint8), "rgb8")
            r.image(DEPTH, START + i / 30, wall(), "16UC1")

    path = file_of(write(place_for(tmp_path, storage), storage, long))
    path.write_bytes(path.read_bytes()[: int(0.7 * path.stat().st_size)])
    sequence = open_sequence(path)
    assert 50 < len(sequence) < 180
    assert all(isinstance(frame, Frame) for _, frame in Prefetch(sequence))
    assert any("breaks off" in each for each in problems(sequence))


@pytest.mark.parametrize("storage", ["bag-lz4", "mcap-zstd"])
def test_a_damaged_chunk_costs_its_frames_and_no_others(tmp_path: Path, storage: str) -> None:
    path = place_for(tmp_path, storage)
    with robot.recording(path, storage) as r:
        r.camera(INFO, 10 * K, (10 * W, 10 * H))
        for i in range(N):
            noise = np.random.default_rng(i).integers(0, 255, (10 * H, 10 * W, 3), np.uint8)
            r.image(COLOR, START + i, noise, "rgb8")
            r.image(DEPTH, START + i, np.full((10 * H, 10 * W), 2000, np.uint16), "16UC1")
    file = file_of(path)
    data = bytearray(file.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 200_000] = bytes(200_000)
    file.write_bytes(data)
    sequence = open_sequence(path)
    assert N / 2 < len(sequence) < N
    assert sequence.timestamps()[-1] == START + N - 1
    assert any("1 chunks of" in each for each in problems(sequence))


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("a.bag", b"", "not a bag of ROS 1"),
        ("a.bag", b"#ROSBAG V1.2\n", "not a bag of ROS 1"),
        ("a.bag", b"#ROSBAG V2.0\n", "no colour images.*are none"),
        ("a.bag", b"#ROSBAG V2.0\n" + b"\xff" * 99, "makes no sense"),
        ("a.mcap", b"", "not an MCAP file"),
        ("a.mcap", b"\x89MCAP0\r\n", "its end is missing"),
        ("a.mcap", b"\x89MCAP0\r\n\x06" + (2**63).to_bytes(8, "little"), "cut off|too short"),
        ("a.db3", b"", "no such table"),
        ("a.db3", b"x" * 999, "not a database"),
    ],
)
def test_what_is_no_recording_is_refused_in_one_line(tmp_path: Path, name: str, data: bytes, says: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=says) as caught:
        open_sequence(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("storage", robot.STORAGES)
def test_flipped_bytes_cost_frames_and_nothing_else(tmp_path: Path, storage: str) -> None:
    path = file_of(write(place_for(tmp_path, storage), storage))
    whole, random = path.read_bytes(), np.random.default_rng(1)
    for _ in range(40):
        data = bytearray(whole)
        for at in random.integers(0, len(data), 30):
            data[at] = random.integers(256)
        path.write_bytes(data)
        with suppress(InputError):
            sequence = open_sequence(path)
            assert all(isinstance(found, FrameError) or found.depth.shape == (H, W) for found in tried(sequence))


def tried(sequence: Sequence) -> Iterator[Frame | FrameError]:
    for i in range(len(sequence)):
        try:
            yield sequence[i]
        except FrameError as error:
            yield error


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"height": 2**31}, "80x2147483648"),
        ({"width": 0, "height": 0}, "0x0"),
        ({"step": 2**31}, "too few"),
        ({"step": 3}, "too few"),
        ({"data": np.zeros(7, np.uint8)}, "too few"),
        ({"encoding": "bayer_rggb8"}, "no colour"),
    ],
)
def test_an_odd_image_is_a_frame_error_that_names_its_topic(
    tmp_path: Path, changed: dict[str, object], says: str
) -> None:
    def odd(r: Robot) -> None:
        r.image(COLOR, START + 1, picture(1), **({"encoding": "rgb8"} | changed))  # type: ignore[arg-type]
        r.image(DEPTH, START + 1, wall(), "16UC1")

    sequence = open_sequence(write(tmp_path / "room", "mcap", odd))
    assert sequence[2].index == 2
    with pytest.raises(FrameError, match=f"{COLOR} of frame {N}.*{says}"):
        sequence[N]


def test_a_first_image_that_is_empty_decides_nothing(tmp_path: Path) -> None:
    with robot.recording(tmp_path / "room", "mcap") as r:
        r.image(COLOR, START - 1, picture(0), "rgb8", width=0, height=0)
        r.camera(INFO, K, (W, H))
        r.image(COLOR, START, picture(0), "rgb8")
        r.image(DEPTH, START, wall(), "16UC1")
    assert len(open_sequence(tmp_path / "room")) == 1


def test_a_size_that_changes_midway_costs_those_frames(tmp_path: Path) -> None:
    def larger(r: Robot) -> None:
        r.image(COLOR, START + 1, picture(0).repeat(2, 0).repeat(2, 1), "rgb8")
        r.image(DEPTH, START + 1, wall(), "16UC1")

    with pytest.raises(FrameError, match=f"{2 * W}x{2 * H} pixels, but this sequence has {W}x{H}"):
        open_sequence(write(tmp_path / "room", "mcap", larger))[N]


def test_a_compressed_chunk_that_claims_to_be_huge_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "room.bag", "bag-lz4")
    monkeypatch.setattr("ecslam.datasets.rosfiles.MOST_BYTES", 1000)
    with pytest.raises(InputError, match="more than is read"):
        open_sequence(path)


def test_a_recording_that_is_compressed_as_a_whole_says_how_to_unpack_it(tmp_path: Path) -> None:
    file = file_of(write(tmp_path / "room", "db3"))
    file.rename(f"{file}.zstd")
    with pytest.raises(InputError, match=f"zstd -d --rm {file.name}.zstd"):
        open_sequence(tmp_path / "room")


def test_a_recording_in_several_files_is_one(tmp_path: Path) -> None:
    first, second = write(tmp_path / "a", "db3"), tmp_path / "b"
    with robot.recording(second, "db3") as r:
        r.image(COLOR, START + 1, picture(9), "rgb8")
        r.image(DEPTH, START + 1, wall(), "16UC1")
    shutil.copy(file_of(second), first / "a_10.db3")
    sequence = open_sequence(first)
    assert len(sequence) == N + 1
    assert sequence[N].color[0, 0, 1] == 90


def test_a_file_that_is_taken_away_is_a_frame_error(tmp_path: Path) -> None:
    for storage in ("bag", "mcap", "db3"):
        path = write(place_for(tmp_path, storage), storage)
        sequence = open_sequence(path)
        shutil.rmtree(path) if path.is_dir() else path.unlink()
        with pytest.raises(FrameError):
            sequence[0]


def test_a_row_that_is_no_image_is_a_frame_error(tmp_path: Path) -> None:
    path = file_of(write(tmp_path / "room", "db3"))
    with sqlite3.connect(path) as database:
        database.execute("UPDATE messages SET data = x'0001' WHERE id = 6")
        database.execute("UPDATE messages SET data = 'text' WHERE id = 9")
    sequence = open_sequence(path)
    assert sum(isinstance(frame, FrameError) for _, frame in Prefetch(sequence)) >= 1


def test_without_the_library_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "room.bag", "bag")
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(InputError, match="pip install rosbags"):
        open_sequence(path)


# ---- addresses ----


def test_options_follow_the_path_but_a_name_may_hold_a_question_mark(tmp_path: Path) -> None:
    path = write(tmp_path / "what?.bag", "bag")
    assert split_address(str(path)) == (str(path), {})
    assert split_address(f"{path}?color=/a/b&depth=/c") == (str(path), {"color": "/a/b", "depth": "/c"})
    assert open_sequence(f"{path}?color={COLOR}").name == "what?"


def test_files_and_folders_are_found_below_a_root(tmp_path: Path) -> None:
    (tmp_path / "day").mkdir()
    expected = [write(tmp_path / "a.bag", "bag"), write(tmp_path / "day/b", "mcap")]
    shutil.copy(file_of(expected[1]), tmp_path / "day/c.mcap")
    (tmp_path / "day/notes.txt").write_text("x")
    assert sequences_under(tmp_path) == (*map(str, expected), str(tmp_path / "day/c.mcap"))
    assert sequences_under(expected[0]) == (str(expected[0]),)
    with pytest.raises(InputError, match="did you mean"):
        open_sequence(tmp_path / "day")


def test_a_check_reads_well(tmp_path: Path) -> None:
    text = format_report(check_sequence(write(tmp_path / "room.bag", "bag")))
    assert "room (rosbag layout, preset lite)" in text
    assert "6, 6 of 6 tried readable" in text
    assert "no ground truth" in text


def test_an_index_holds_positions_of_what_was_asked_for(tmp_path: Path) -> None:
    path = write(tmp_path / "room.bag", "bag")
    index = rosindex.find_messages([path], lambda topic, kind: kind == "sensor_msgs/msg/Image")
    assert {topic: len(places) for topic, places in index.places.items()} == {COLOR: N, DEPTH: N}


@pytest.mark.slow
@pytest.mark.parametrize("storage", ["bag", "mcap-zstd"])
def test_a_recorded_room_is_tracked_as_the_room_itself(tmp_path: Path, storage: str) -> None:
    itself = open_sequence("synthetic/studio?size=160x120&frames=12")
    path = robot.record(place_for(tmp_path, storage), itself, storage, ("bgr8", "32FC1"))
    np.testing.assert_allclose(trajectory(open_sequence(path)), trajectory(itself), atol=1e-5)


def trajectory(sequence: Sequence) -> np.ndarray:
    slam = Slam(load_preset("live"), sequence.intrinsics, first_pose=sequence[0].c2w_gt)
    for frame in sequence:
        slam.step(frame)
    return slam.trajectory.poses()
