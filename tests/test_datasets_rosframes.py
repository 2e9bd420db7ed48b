"""Recordings of ROS whose depth is not registered: colour is moved to it by what they tell of both cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import robot
from coloured_wall import DEPTH, WIDE, images, motion, paint, seen
from robot import START, Robot

from ecslam.datasets import open_sequence, problems
from ecslam.datasets.files import FileSequence
from ecslam.datasets.rosmessages import Recording
from ecslam.types import InputError, Intrinsics

COLOR, COLOR_INFO = "/camera/color/image_raw", "/camera/color/camera_info"
DEPTHS, DEPTH_INFO = "/camera/depth/image_rect_raw", "/camera/depth/camera_info"
FRAMES = "camera_color_optical_frame", "camera_depth_optical_frame"
FINE = WIDE.resized(96, 54)  # of another shape than depth
TO_COLOR = motion((1.0, -2.0, 3.0), (0.05, -0.02, 0.01))
MOUNT = motion((-90.0, 0, -90.0), (0.0, 0.1, 0.02))  # the depth camera in the robot's axes
WALL_M, N = 2.0, 3


def send_images(r: Robot, to_color: np.ndarray = TO_COLOR, name: str = "camera") -> None:
    color, depth = images(FINE, to_color, WALL_M)
    for i in range(N):
        time = START + i / 30
        r.image(f"/{name}/color/image_raw", time, color, "rgb8", frame=f"{name}_color_optical_frame")
        values = np.rint(1000 * depth).astype(np.uint16)
        r.image(f"/{name}/depth/image_rect_raw", time + 0.001, values, "16UC1", frame=f"{name}_depth_optical_frame")


def send_infos(r: Robot, name: str = "camera") -> None:
    r.camera(f"/{name}/color/camera_info", FINE.matrix(), (FINE.width, FINE.height))
    r.camera(f"/{name}/depth/camera_info", DEPTH.matrix(), (DEPTH.width, DEPTH.height))


def send_mount(
    r: Robot,
    to_color: np.ndarray = TO_COLOR,
    name: str = "camera",
    link: str = "camera_link",
    mount: np.ndarray = MOUNT,
) -> None:
    """Both cameras below ``link``, that of depth in two steps."""
    half = motion((0, 10.0, 0), (0.1, 0, 0))
    r.transform(START - 9, f"/{link}", f"/{name}_depth_frame", half, "/tf_static")
    optical = np.linalg.inv(half) @ mount
    r.transform(START - 9, f"{name}_depth_frame", f"{name}_depth_optical_frame", optical, "/tf_static")
    color = mount @ np.linalg.inv(to_color)
    r.transform(START - 9, link, f"{name}_color_optical_frame", color, "/tf_static")


def write(path: Path, *parts: Callable[[Robot], None], storage: str = "mcap") -> Path:
    with robot.recording(path, storage) as r:
        for part in parts:
            part(r)
    return path


def opened(path: Path | str) -> FileSequence:
    sequence = open_sequence(path)
    assert isinstance(sequence, FileSequence)
    return sequence


def assert_registered(sequence: FileSequence, index: int = 0) -> None:
    """Each pixel has the colour of the point that it measured; it does not where a transform is read the wrong way."""
    frame = sequence[index]
    points, depth = seen(sequence.intrinsics, np.eye(4), WALL_M)
    assert frame.color.shape == (*frame.depth.shape, 3)
    np.testing.assert_allclose(frame.depth, depth, atol=6e-4)
    assert np.abs(frame.color.astype(int) - paint(points)).max() <= 3


def refusal(path: Path | str) -> str:
    with pytest.raises(InputError) as caught:
        open_sequence(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# ---- two cameras joined by transforms ----


@pytest.mark.parametrize("storage", ["bag", "mcap"])
def test_colour_is_moved_to_depth_through_the_transforms_between_them(tmp_path: Path, storage: str) -> None:
    path = tmp_path / ("room.bag" if storage == "bag" else "room")
    sequence = opened(write(path, send_infos, send_images, send_mount, storage=storage))
    assert (len(sequence), problems(sequence), sequence.poses_gt()) == (N, [], None)
    assert sequence.intrinsics.fx == DEPTH.fx
    np.testing.assert_allclose(sequence.timestamps() - START, np.arange(N) / 30 + 0.001, atol=1e-6)
    assert_registered(sequence, N - 1)


def test_depth_may_hang_below_colour_or_colour_below_depth(tmp_path: Path) -> None:
    ways: list[tuple[str, str, np.ndarray]] = [(*FRAMES, TO_COLOR), (*FRAMES[::-1], np.linalg.inv(TO_COLOR))]
    for i, (parent, child, pose) in enumerate(ways):

        def link(r: Robot, way: tuple[str, str, np.ndarray] = (parent, child, pose)) -> None:
            for time in (0, 1):
                r.transform(START + time, *way)

        assert_registered(opened(write(tmp_path / str(i), send_infos, send_images, link)))


def test_ground_truth_is_that_of_depth(tmp_path: Path) -> None:
    def truth(r: Robot) -> None:
        for i in range(N):
            r.transform(START + i / 30 + 0.001, "world", "camera_link", motion((0, 0, 20.0 * i), (i, 2, 3)))

    poses = open_sequence(write(tmp_path / "room", send_infos, send_images, send_mount, truth)).poses_gt()
    assert poses is not None
    for i in range(N):
        np.testing.assert_allclose(poses[i], motion((0, 0, 20.0 * i), (i, 2, 3)) @ MOUNT, atol=1e-4)


def test_each_image_is_straightened_by_its_own_camera(tmp_path: Path) -> None:
    bend = (0.1, -0.05, 0.001, 0.0, 0.0)

    def infos(r: Robot) -> None:
        r.camera(COLOR_INFO, FINE.matrix(), (FINE.width, FINE.height), bend, projection=np.eye(3))
        raw = DEPTH.matrix() + 5
        r.camera(DEPTH_INFO, raw, (DEPTH.width, DEPTH.height), (0.3, 0, 0, 0, 0), projection=DEPTH.matrix())

    registration = opened(write(tmp_path / "room", infos, send_images, send_mount)).registration
    assert registration is not None
    assert registration.color == replace(FINE, distortion=bend)
    assert registration.depth == DEPTH


def test_registered_depth_is_preferred(tmp_path: Path) -> None:
    def aligned(r: Robot) -> None:
        values = np.full((FINE.height, FINE.width), 3000, np.uint16)
        r.image("/camera/aligned_depth_to_color/image_raw", START, values, "16UC1", frame=FRAMES[0])

    path = write(tmp_path / "room", send_infos, send_images, send_mount, aligned)
    sequence = opened(path)
    assert sequence.registration is None
    assert (sequence[0].depth == 3).all()
    assert_registered(opened(f"{path}?color={COLOR}&depth={DEPTHS}"))


def test_the_file_beside_it_tells_the_camera_of_depth(tmp_path: Path) -> None:
    def info_of_colour(r: Robot) -> None:
        r.camera(COLOR_INFO, FINE.matrix(), (FINE.width, FINE.height))

    path = write(tmp_path / "room.bag", info_of_colour, send_images, send_mount, storage="bag")
    assert f"there is no {DEPTH_INFO} in it" in refusal(path)
    np.savetxt(tmp_path / "camera-intrinsics.txt", DEPTH.matrix())
    sequence = opened(path)
    assert_registered(sequence)
    assert problems(sequence) == ["depth's camera is that of camera-intrinsics.txt, without distortion"]
    np.savetxt(tmp_path / "camera-intrinsics.txt", 0 * DEPTH.matrix())
    assert "camera-intrinsics.txt: focal lengths 0 and 0" in refusal(path)


def send_infrared(r: Robot) -> None:
    """Beside depth, joined to it, and with a camera."""
    r.transform(START - 9, FRAMES[1], "infra", np.eye(4), "/tf_static")
    r.camera("/camera/infra1/camera_info", DEPTH.matrix(), (DEPTH.width, DEPTH.height))
    for i in range(N):
        dark = np.zeros((DEPTH.height, DEPTH.width), np.uint8)
        r.image("/camera/infra1/image_rect_raw", START + i / 30, dark, "mono8", frame="infra")


def test_infrared_is_not_taken_for_colour_that_is_there(tmp_path: Path) -> None:
    assert_registered(opened(write(tmp_path / "a", send_infos, send_images, send_mount, send_infrared)))
    assert f"there is no {COLOR_INFO} in it" in refusal(
        write(tmp_path / "b", info_of_depth, send_images, send_mount, send_infrared)
    )


def send_rigs(r: Robot) -> None:
    """Two cameras of one kind, looking the same way."""
    for name, place in (("front", MOUNT), ("side", motion(move=(0, 0.4, 0)) @ MOUNT)):
        send_infos(r, name)
        send_images(r, name=name)
        send_mount(r, name=name, link="base", mount=place)


def test_of_several_cameras_depth_goes_with_the_colour_beside_it(tmp_path: Path) -> None:
    path = write(tmp_path / "room", send_rigs)
    assert "several cameras or images: /front/color/image_raw" in refusal(path)
    for asked in ("color=/side/color/image_raw", "depth=/side/depth/image_rect_raw"):
        sequence = opened(f"{path}?{asked}")
        assert (sequence.color.name, sequence.depth.name) == (  # type: ignore[attr-defined]
            "/side/color/image_raw",
            "/side/depth/image_rect_raw",
        )
        assert_registered(sequence)


def no_mount(r: Robot) -> None:
    r.transform(START, "camera_link", FRAMES[0], MOUNT, "/tf_static")


def two_parents(r: Robot) -> None:
    for frame in FRAMES:
        for parent in ("gripper", "camera_link"):
            r.transform(START, parent, frame, MOUNT, "/tf_static")


def pan(r: Robot) -> None:
    for i in range(N):
        r.transform(START + i, "base", FRAMES[0], motion((0, 0, i)))
    r.transform(START, "base", FRAMES[1], MOUNT)


def info_of_depth(r: Robot) -> None:
    r.camera(DEPTH_INFO, DEPTH.matrix(), (DEPTH.width, DEPTH.height))


def uncalibrated(r: Robot) -> None:
    info_of_depth(r)
    r.camera(COLOR_INFO, np.zeros((3, 3)), (FINE.width, FINE.height))


def turned_away(r: Robot) -> None:
    send_mount(r, motion((0, 180.0, 0)))


@pytest.mark.parametrize(
    ("infos", "mount", "says"),
    [
        (send_infos, no_mount, f"no transforms in it join {FRAMES[1]} and {FRAMES[0]}: record .*/tf_static"),
        (send_infos, two_parents, f"no transforms in it join {FRAMES[1]} and {FRAMES[0]}"),
        (send_infos, pan, f"{FRAMES[0]} moves against base"),
        (info_of_depth, send_mount, f"there is no {COLOR_INFO} in it: record .*camera_info"),
        (uncalibrated, send_mount, f"{COLOR_INFO}: focal lengths 0 and 0; calibrate"),
        (send_infos, turned_away, f"{COLOR} and {DEPTHS}: .*hardly see the same"),
    ],
)
def test_what_is_missing_is_said(
    tmp_path: Path, infos: Callable[[Robot], None], mount: Callable[[Robot], None], says: str
) -> None:
    path = write(tmp_path / "room", infos, send_images, mount)
    with pytest.raises(InputError, match=f"{path}: .*{says}"):
        open_sequence(path)
    assert refusal(path).isprintable()


# ---- what librealsense records ----

SENSOR = "/device_0/sensor_0"
STREAMS = f"{SENSOR}/Depth_0", "/device_0/sensor_1/Color_0"
UNIT_M = 0.00025
FROM_REFERENCE = motion((4.0, 3.0, -20.0), (0.01, 0.03, -0.02))


def send_streams(r: Robot) -> None:
    color, depth = images(FINE, TO_COLOR, WALL_M)
    for i in range(N):
        time = START + i / 30
        for stream, values, encoding in (
            (STREAMS[0], np.rint(depth / UNIT_M).astype(np.uint16), "mono16"),
            (STREAMS[1], color, "rgb8"),
            (f"{SENSOR}/Infrared_1", np.zeros(depth.shape, np.uint8), "8UC1"),
            (f"{SENSOR}/Infrared_2", np.zeros(depth.shape, np.uint16), "16UC1"),
        ):
            r.image(f"{stream}/image/data", time, values, encoding, frame="0")
    for stream, camera, model in ((STREAMS[0], DEPTH, "Brown Conrady"), (STREAMS[1], FINE, "Inverse Brown Conrady")):
        r.camera(f"{stream}/info/camera_info", camera.matrix(), (camera.width, camera.height), model=model)


def send_motions(r: Robot) -> None:
    r.send(f"{STREAMS[0]}/tf/0", r.motion(FROM_REFERENCE))
    r.send(f"{STREAMS[1]}/tf/0", r.motion(TO_COLOR @ FROM_REFERENCE))
    r.send(f"{SENSOR}/Infrared_1/tf/0", r.motion(FROM_REFERENCE))


def unit(metres: float, name: str = "Depth_Units") -> Callable[[Robot], None]:
    def send(r: Robot) -> None:
        r.send(f"/device_0/sensor_1/option/{name}/value", number(r, 7.0))
        r.send(f"{SENSOR}/option/{name}/value", number(r, metres))

    return send


def number(r: Robot, value: float) -> Any:
    return r.type("std_msgs/msg/Float32")(value)


@pytest.mark.parametrize("name", ["Depth_Units", "Depth Units"])
def test_what_the_viewer_records_is_registered(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / "room.bag", send_streams, send_motions, unit(UNIT_M, name), storage="bag")
    sequence = opened(path)
    assert (len(sequence), problems(sequence), sequence.poses_gt()) == (N, [], None)
    assert_registered(sequence)


def test_a_lens_of_librealsense_is_opencvs(tmp_path: Path) -> None:
    bend = (-0.05, 0.06, 0.001, 0.0, -0.02)

    def bent(r: Robot) -> None:
        size = FINE.width, FINE.height
        r.camera(f"{STREAMS[1]}/info/camera_info", FINE.matrix(), size, bend, model="Inverse Brown Conrady")

    path = write(tmp_path / "room.bag", bent, send_streams, send_motions, unit(UNIT_M), storage="bag")
    registration = opened(path).registration
    assert registration is not None
    assert registration.color.distortion == bend


def test_without_units_or_motions_it_says_so(tmp_path: Path) -> None:
    path = write(tmp_path / "a.bag", send_streams, send_motions, storage="bag")
    assert problems(open_sequence(path)) == ["no Depth_Units in it: depth is taken for millimetres"]
    path = write(tmp_path / "b.bag", send_streams, unit(UNIT_M), storage="bag")
    assert "no transforms in it join device_0/sensor_0/Depth_0 and device_0/sensor_1/Color_0" in refusal(path)
    for metres in (0.0, -1.0, float("nan"), float("inf")):
        path = write(tmp_path / f"c{metres}.bag", send_streams, send_motions, unit(metres), storage="bag")
        assert "m is no unit of depth" in refusal(path)


def test_a_motion_that_is_none_joins_nothing(tmp_path: Path) -> None:
    def spoilt(r: Robot) -> None:
        message = r.motion(np.eye(4))
        message.rotation.w = 0.0
        r.send(f"{STREAMS[1]}/tf/0", message)

    path = write(tmp_path / "room.bag", send_streams, spoilt, send_motions, unit(UNIT_M), storage="bag")
    assert "no transforms in it join" in refusal(path)


def test_numbers_and_transforms_of_other_topics_are_not_kept(tmp_path: Path) -> None:
    def others(r: Robot) -> None:
        for _ in range(5):
            r.send("/robot/battery", number(r, 1.0))
            r.send("/robot/arm", r.motion(np.eye(4)))

    recording = Recording(tmp_path, [write(tmp_path / "room.bag", others, send_motions, unit(1.0), storage="bag")])
    assert not {"/robot/battery", "/robot/arm"} & recording.places.keys()
    assert f"{STREAMS[1]}/tf/0" in recording.places


def test_a_camera_of_another_size_is_scaled_with_its_images(tmp_path: Path) -> None:
    def infos(r: Robot) -> None:
        for name, camera in ((COLOR_INFO, FINE), (DEPTH_INFO, DEPTH)):
            doubled: Intrinsics = camera.resized(2 * camera.width, 2 * camera.height)
            r.camera(name, doubled.matrix(), (doubled.width, doubled.height))

    assert_registered(opened(write(tmp_path / "room", infos, send_images, send_mount)))
