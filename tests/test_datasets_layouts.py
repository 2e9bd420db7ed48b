"""Every layout on disk: a contract that all of them keep, and what is particular to each."""

from __future__ import annotations

import dataclasses
import importlib
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import phone
import pytest
import robot
import sens_writer
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ecslam.datasets import open_sequence, problems, recording, registry, select_frames
from ecslam.datasets.check import check_sequence, format_report
from ecslam.datasets.reading import rigid
from ecslam.datasets.synthetic import Address
from ecslam.datasets.tum import associate, interpolate_poses
from ecslam.types import FrameError, InputError, Intrinsics, Sequence

W, H, N = 64, 48, 6
METRES = 2.0
Y_UP = np.diag([1.0, -1, -1, 1])
K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
REFUSES_LONG_NUMBERS = hasattr(sys, "set_int_max_str_digits")


# ---- writers: one tiny sequence of each layout ----


def picture(i: int, width: int = W, height: int = H) -> np.ndarray:
    """RGB with red growing to the right and blue telling the frame."""
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = np.linspace(0, 255, width).astype(np.uint8)
    image[..., 2] = 20 * i
    return image


def depth_values(scale: float) -> np.ndarray:
    """A wall at METRES with a pixel of each kind of "no depth" in the first row."""
    raw = np.full((H, W), round(METRES * scale), np.uint16)
    raw[0, 0], raw[0, 1] = 0, 65535
    return raw


def pose(i: int) -> np.ndarray:
    c2w = np.eye(4)
    c2w[:3, :3] = Rotation.from_euler("y", 2.0 * i, degrees=True).as_matrix()
    c2w[0, 3] = 0.01 * i
    return c2w


def write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    bgr = image[..., ::-1] if image.ndim == 3 else image
    assert cv2.imwrite(str(path), np.ascontiguousarray(bgr))


def save(path: Path, matrix: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, matrix)


def write_7scenes(root: Path) -> Path:
    for i in range(N):
        write(root / f"frame-{i:06d}.color.png", picture(i))
        write(root / f"frame-{i:06d}.depth.png", depth_values(1000))
        save(root / f"frame-{i:06d}.pose.txt", pose(i))
    save(root / "camera-intrinsics.txt", K)
    return root


def write_tum(root: Path) -> Path:
    header = "# color images\n# file: 'my_recording.bag'\n# timestamp filename\n"
    rgb, depth, truth = [header], [header], [header]
    for i in range(N):
        time = 1305031102.0 + i / 30
        write(root / f"rgb/{i}.png", picture(i))
        write(root / f"depth/{i}.png", depth_values(5000))
        rgb.append(f"{time:.6f} rgb/{i}.png\n")
        depth.append(f"{time + 0.011:.6f} depth/{i}.png\n")
        x, y, z, w = Rotation.from_matrix(pose(i)[:3, :3]).as_quat()
        truth.append(f"{time + 0.011:.6f} {pose(i)[0, 3]} 0 0 {x} {y} {z} {w}\n")
    for name, lines in (("rgb", rgb), ("depth", depth), ("groundtruth", truth)):
        (root / f"{name}.txt").write_text("".join(lines))
    save(root / "camera-intrinsics.txt", K)
    return root


def write_replica(root: Path) -> Path:
    for i in range(N):
        write(root / f"results/frame{i:06d}.jpg", picture(i))
        write(root / f"results/depth{i:06d}.png", depth_values(6553.5))
    save(root / "traj.txt", np.stack([pose(i).ravel() for i in range(N)]))
    camera = {"w": W, "h": H, "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "scale": 6553.5}
    (root / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return root


def write_vmap(root: Path) -> Path:
    for i in range(N):
        write(root / f"imap/00/rgb/rgb_{i}.png", picture(i))
        write(root / f"imap/00/depth/depth_{i}.png", depth_values(1000))
    save(root / "imap/00/traj_w_c.txt", np.stack([pose(i).ravel() for i in range(N)]))
    save(root / "camera-intrinsics.txt", K)
    return root


def write_scannet(root: Path) -> Path:
    for i in range(N):
        write(root / f"color/{i}.jpg", picture(i, 2 * W, 2 * H))
        write(root / f"depth/{i}.png", depth_values(1000))
        save(root / f"pose/{i}.txt", pose(i))
    four = np.eye(4)
    four[:3, :3] = K
    save(root / "intrinsic/intrinsic_depth.txt", four)
    four[:2, :3] *= 2
    save(root / "intrinsic/intrinsic_color.txt", four)
    return root


def write_stray(root: Path) -> Path:
    """Colour four times as fine as frames, depth half as fine."""
    matrix = np.array([[4 * K[0, 0], 0, 4 * K[0, 2] + 1.5], [0, 4 * K[1, 1], 4 * K[1, 2] + 1.5], [0, 0, 1]])
    return phone.record(
        root,
        [picture(i, 4 * W, 4 * H) for i in range(N)],
        [depth_values(1000)[: H // 2, : W // 2]] * N,
        [Y_UP @ pose(i) for i in range(N)],
        matrix,
        fps=30,
    )


def write_sens(root: Path) -> Path:
    matrix = np.array([[2 * K[0, 0], 0, 2 * K[0, 2] + 0.5], [0, 2 * K[1, 1], 2 * K[1, 2] + 0.5], [0, 0, 1]])
    colors, poses = [picture(i, 2 * W, 2 * H) for i in range(N)], [pose(i) for i in range(N)]
    sens_writer.record(root / "a.sens", colors, [depth_values(1000)] * N, poses, K, color_matrix=matrix)
    return root


def write_record3d(root: Path) -> Path:
    """Colour four times as fine as frames, depth half as fine."""
    pytest.importorskip("lzfse")
    import phone_video

    matrix = np.array([[4 * K[0, 0], 0, 4 * K[0, 2] + 1.5], [0, 4 * K[1, 1], 4 * K[1, 2] + 1.5], [0, 0, 1]])
    depth = depth_values(1000)[: H // 2, : W // 2] / np.float32(1000)
    depth[0, :2] = 0, np.nan
    poses = [pose(i) for i in range(N)]
    colors = [picture(i, 4 * W, 4 * H) for i in range(N)]
    return phone_video.write(root, phone_video.parts(colors, [depth] * N, poses, matrix))


def write_neuralrgbd(root: Path) -> Path:
    poses = []
    for i in range(N):
        write(root / f"images/img{i}.png", picture(i))
        write(root / f"depth_filtered/depth{i}.png", depth_values(1000))
        poses.append(pose(i) @ np.diag([1, -1, -1, 1]))
    save(root / "poses.txt", np.concatenate(poses))
    (root / "focal.txt").write_text(f"{K[0, 0]}\n")
    return root


def write_rosbag(root: Path) -> Path:
    with robot.recording(root, "mcap") as camera:
        camera.camera("/camera/color/camera_info", K, (W, H))
        for i in range(N):
            time = robot.START + i / 30
            camera.image(robot.COLOR, time, picture(i), "rgb8")
            camera.image(robot.DEPTH, time, depth_values(1000), "16UC1")
            camera.transform(time, "world", robot.CAMERA, pose(i))
    return root


def write_recording(root: Path) -> Path:
    (root / "rgb").mkdir(parents=True)
    camera, lines, truth = Intrinsics(60.0, 60.0, 31.5, 23.5, W, H), [], []
    for i in range(N):
        write(root / f"rgb/{i:06d}.jpg", picture(i))
        write(root / f"depth/{i:06d}.png", depth_values(1000))
        lines.append(f"{1e9 + i / 30:.6f} {i:06d}\n")
        x, y, z, w = Rotation.from_matrix(pose(i)[:3, :3]).as_quat()
        truth.append(f"{1e9 + i / 30:.6f} {pose(i)[0, 3]} 0 0 {x} {y} {z} {w}\n")
    (root / "frames.txt").write_text("".join(lines))
    (root / "groundtruth.txt").write_text("".join(truth))
    recording.write_rig(root / "recording.yaml", recording.Rig("a camera", 1000.0, camera, camera, np.eye(4)))
    return root


WRITERS: dict[str, Callable[[Path], Path]] = {
    "7scenes": write_7scenes,
    "tum": write_tum,
    "replica": write_replica,
    "vmap": write_vmap,
    "scannet": write_scannet,
    "stray": write_stray,
    "neuralrgbd": write_neuralrgbd,
    "rosbag": write_rosbag,
    "sens": write_sens,
    "record3d": write_record3d,
    "recording": write_recording,
}
PRESETS = {"recording": "live", "tum": "tum", "scannet": "scannet", "sens": "scannet"}


# ---- the contract ----


@pytest.fixture(params=WRITERS)
def layout(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def folder(layout: str, tmp_path: Path) -> Path:
    return WRITERS[layout](tmp_path / "room_0")


def depth_files(folder: Path) -> list[Path]:
    files = sorted(p for p in folder.rglob("*.png") if "depth" in str(p.relative_to(folder)))
    return files or pytest.skip("its images are in one file")


def test_exactly_one_layout_recognises_the_folder(folder: Path) -> None:
    assert sum(known.sniff(folder) for known in registry.layouts()) == 1


def test_every_known_layout_is_under_this_contract() -> None:
    assert len(registry.layouts()) == len(WRITERS)
    assert all(":" in registry.summary(known) for known in registry.layouts())


def test_frames_keep_the_types_units_and_poses_of_the_contract(layout: str, folder: Path) -> None:
    sequence = open_sequence(folder)
    assert isinstance(sequence, Sequence)
    assert (sequence.layout, sequence.preset, len(sequence)) == (layout, PRESETS.get(layout, "lite"), N)
    assert "room_0" in sequence.name
    k = sequence.intrinsics
    assert (k.fx, k.fy, k.cx, k.cy, k.width, k.height) == (60, 60, 31.5, 23.5, W, H)
    times, poses = sequence.timestamps(), sequence.poses_gt()
    assert poses is not None
    assert times.dtype == poses.dtype == np.float64
    np.testing.assert_allclose(np.diff(times), 1 / 30, atol=1e-5)
    for i, frame in enumerate(sequence):
        assert (frame.index, frame.timestamp) == (i, times[i])
        assert frame.color.shape == (H, W, 3)
        assert frame.color.dtype == np.uint8
        assert frame.depth.shape == (H, W)
        assert frame.depth.dtype == np.float32
        assert frame.depth[0, 0] == frame.depth[0, 1] == 0
        np.testing.assert_allclose(frame.depth[2:], METRES, atol=1e-4)
        np.testing.assert_allclose(frame.color.astype(int), picture(i), atol=12)
        assert frame.c2w_gt is not None
        np.testing.assert_allclose(frame.c2w_gt, poses[i])
    world = Y_UP if layout == "stray" else np.eye(4)
    np.testing.assert_allclose(poses, [world @ pose(i) for i in range(N)], atol=1e-6)
    assert sequence.reference_mesh() is None


@pytest.mark.parametrize("index", [-1, N])
def test_an_index_outside_is_an_index_error(folder: Path, index: int) -> None:
    with pytest.raises(IndexError):
        open_sequence(folder)[index]


def test_a_missing_depth_image_is_refused_on_opening(layout: str, folder: Path) -> None:
    if layout == "stray":
        pytest.skip("a phone's frame may be without depth")
    depth_files(folder)[2].unlink()
    with pytest.raises(InputError, match=r"missing|without its depth image \(a 16-bit PNG\)") as caught:
        open_sequence(folder)
    assert str(folder) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_broken_image_is_a_frame_error_that_names_it_and_spares_the_rest(folder: Path) -> None:
    broken = depth_files(folder)[2]
    broken.write_bytes(broken.read_bytes()[:-20])
    sequence = open_sequence(folder)
    with pytest.raises(FrameError, match=broken.name):
        sequence[2]
    assert sequence[1].index == 1


def test_a_bomb_among_the_images_changes_nothing_for_the_others(folder: Path) -> None:
    bomb = depth_files(folder)[0]
    data = bytearray(bomb.read_bytes())
    data[16:24] = (30000).to_bytes(4, "big") * 2
    bomb.write_bytes(data)
    sequence = open_sequence(folder)
    with pytest.raises(FrameError, match="30000x30000"):
        sequence[0]
    assert sequence[3].depth.shape == (H, W)


def test_it_opens_without_ground_truth(folder: Path) -> None:
    depth_files(folder)
    for path in [*folder.rglob("*.txt"), *folder.rglob("*.csv")]:
        if any(word in str(path.relative_to(folder)) for word in ("pose", "traj", "groundtruth", "odometry")):
            path.unlink()
    sequence = open_sequence(folder)
    assert sequence.poses_gt() is None
    assert sequence[0].c2w_gt is None


def test_a_selection_keeps_times_poses_and_images_together(folder: Path) -> None:
    whole = open_sequence(folder)
    part = select_frames(whole, "1:6:2")
    assert [f.timestamp for f in part] == whole.timestamps()[1:6:2].tolist() == part.timestamps().tolist()
    assert [f.index for f in part] == [0, 1, 2]
    poses = part.poses_gt()
    assert poses is not None
    for i, frame in enumerate(part):
        np.testing.assert_array_equal(frame.c2w_gt, poses[i])
        np.testing.assert_array_equal(frame.color, whole[1 + 2 * i].color)


def test_a_rolling_shutter_can_be_told_of_any_camera(layout: str, folder: Path) -> None:
    as_it_is, told = open_sequence(folder), open_sequence(f"{folder}?readout=0.025")
    assert told.intrinsics == dataclasses.replace(as_it_is.intrinsics, readout_s=0.025)
    assert (told.name, told.layout, len(told)) == (as_it_is.name, layout, N)
    np.testing.assert_array_equal(told[N - 1].depth, as_it_is[N - 1].depth)
    assert told[N - 1].index == N - 1
    assert "read row by row in 25 ms" in format_report(check_sequence(told))
    assert "row by row" not in format_report(check_sequence(f"{folder}?readout=0"))


@pytest.mark.parametrize("given", ["", "fast", "-0.01", "0.2", "nan", "30"])
def test_a_readout_that_no_camera_has_is_refused(folder: Path, given: str) -> None:
    with pytest.raises(InputError, match=r"readout=.*seconds"):
        open_sequence(f"{folder}?readout={given}")


def test_another_option_is_refused_by_its_name(layout: str, folder: Path) -> None:
    taken = "readout, calibration" + (", color, depth" if layout == "rosbag" else "")
    with pytest.raises(InputError, match=f"no option 'read'; {taken} can follow"):
        open_sequence(f"{folder}?read=0.03")


def test_colour_and_depth_that_cannot_match_are_refused(folder: Path) -> None:
    for path in depth_files(folder):
        write(path, np.full((H, 2 * W), 1000, np.uint16))
    with pytest.raises(InputError, match=f"{2 * W}x{H}"):
        open_sequence(folder)


# ---- finding a sequence ----


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("nothing-here", "no such folder"),
        ("empty", "empty folder"),
        ("file.txt", "give the folder"),
        ("unknown/sub/deep", "no known layout"),
        ("unknown/above", "did you mean"),
        ("a\0b", "not a path"),
        ("x" * 5000, "cannot be opened"),
    ],
)
def test_what_cannot_be_opened_is_said_in_one_line(tmp_path: Path, address: str, says: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.txt").write_text("x")
    (tmp_path / "unknown/sub/deep/er").mkdir(parents=True)
    write_vmap(tmp_path / "unknown/above/room")
    with pytest.raises(InputError, match=says) as caught:
        open_sequence(f"{tmp_path}/{address}")
    assert "\n" not in str(caught.value)


def test_the_error_for_an_unknown_folder_lists_every_layout(tmp_path: Path) -> None:
    (tmp_path / "notes.md").write_text("x")
    with pytest.raises(InputError, match=r"notes\.md") as caught:
        open_sequence(tmp_path)
    assert all(
        name in str(caught.value)
        for name in ("7-Scenes", "TUM", "NICE-SLAM", "vMAP", "ScanNet", ".sens", "Stray", "Neural", "ROS", "Record3D")
    )


def test_built_in_rooms_go_to_their_own_opener_with_their_options(monkeypatch: pytest.MonkeyPatch) -> None:
    def opener(name: str, **options: object) -> SimpleNamespace:
        return SimpleNamespace(address=Address(name), options=options)

    monkeypatch.setattr(importlib.import_module("ecslam.datasets.synthetic"), "open_synthetic", opener, raising=False)
    assert open_sequence("synthetic/studio", width=320) == opener("studio", width=320)  # type: ignore[comparison-overlap]
    with pytest.raises(InputError, match="width"):
        open_sequence("some/folder", width=320)


def test_a_new_file_in_the_folder_is_a_new_layout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules/mine.py").write_text(
        '"""Mine: a file called mine."""\nsniff = lambda path: (path / "mine").exists()\nopen = lambda path: "opened"\n'
    )
    package = sys.modules["ecslam.datasets"]
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path / "modules")])
    registry.layouts.cache_clear()
    try:
        (tmp_path / "mine").touch()
        assert open_sequence(tmp_path) == "opened"  # type: ignore[comparison-overlap]
    finally:
        registry.layouts.cache_clear()
        sys.modules.pop("ecslam.datasets.mine", None)


# ---- selections ----


@given(st.none() | st.integers(-9, 9), st.none() | st.integers(-9, 9), st.none() | st.integers(1, 4))
def test_a_selection_means_what_a_python_slice_means(start: int | None, stop: int | None, step: int | None) -> None:
    whole = CountingSequence()
    text = ":".join("" if v is None else str(v) for v in (start, stop, step))
    wanted = whole.timestamps()[start:stop:step]
    if len(wanted):
        np.testing.assert_array_equal(select_frames(whole, text).timestamps(), wanted)  # type: ignore[arg-type]
    else:
        with pytest.raises(InputError, match="selects nothing"):
            select_frames(whole, text)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "spec",
    [
        "5", "a:b", "1:2:3:4", "::0", "::-1", "0:1e3",
        pytest.param(":" + "9" * 5000, marks=pytest.mark.skipif(not REFUSES_LONG_NUMBERS, reason="a slice like any")),
    ],
)  # fmt: skip
def test_a_selection_that_makes_no_sense_is_an_input_error(spec: str) -> None:
    with pytest.raises(InputError, match="--frames"):
        select_frames(CountingSequence(), spec)  # type: ignore[arg-type]


class CountingSequence:
    name, layout, preset, intrinsics, bounds = "counting", "test", "lite", None, None

    def __len__(self) -> int:
        return 7

    def timestamps(self) -> np.ndarray:
        return np.arange(7.0)


# ---- 7-Scenes, Replica, vMAP, ScanNet ----


def test_7scenes_opens_its_only_part_and_asks_which_of_several(tmp_path: Path) -> None:
    write_7scenes(tmp_path / "chess/seq-01")
    assert open_sequence(tmp_path / "chess").name == "chess-seq-01"
    write_7scenes(tmp_path / "chess/seq-02")
    assert open_sequence(tmp_path / "chess/seq-02").name == "chess-seq-02"
    with pytest.raises(InputError, match="name one of them"):
        open_sequence(tmp_path / "chess")


def test_7scenes_without_intrinsics_takes_the_kinects_at_the_images_size(tmp_path: Path) -> None:
    (write_7scenes(tmp_path) / "camera-intrinsics.txt").unlink()
    sequence = open_sequence(tmp_path)
    assert (sequence.intrinsics.fx, sequence.intrinsics.width) == (58.5, W)
    assert any("scaled" in problem for problem in problems(sequence))


@pytest.mark.parametrize(
    ("text", "says"), [("60 0 70 0 60 24 0 0 1", "inside the image"), ("1 2 3", "3x3"), ("a b c", "not a number")]
)
def test_wrong_intrinsics_are_refused(tmp_path: Path, text: str, says: str) -> None:
    (write_7scenes(tmp_path) / "camera-intrinsics.txt").write_text(text)
    with pytest.raises(InputError, match=says):
        open_sequence(tmp_path)


INFO = """m_versionNumber = 4
m_sensorName = StructureSensor
m_colorWidth = 640
m_colorHeight = 480
m_depthWidth = 640
m_depthHeight = 480
m_depthShift = 1000
m_calibrationColorIntrinsic = 583 0 321 0 0 583 241 0 0 0 1 0 0 0 0 1 
m_calibrationDepthIntrinsic = 582.871 0 320 0 0 582.87 240 0 0 0 1 0 0 0 0 1 
m_frames.size = 6
"""


@pytest.mark.parametrize("name", ["info.txt", "_info.txt"])
def test_a_recording_of_bundlefusion_brings_its_camera(tmp_path: Path, name: str) -> None:
    root = write_7scenes(tmp_path / "apt0")
    (root / name).write_text(INFO)
    assert open_sequence(root).intrinsics.fx == 60
    (root / "camera-intrinsics.txt").unlink()
    k = open_sequence(root).intrinsics
    assert (k.fx, k.fy, k.cx, k.cy, k.width) == pytest.approx((58.2871, 58.287, 31.55, 23.55, 64))


@pytest.mark.parametrize(("old", "new"), [("582.871", "?"), ("640", "0"), ("m_depthWidth", "width")])
def test_a_camera_that_bundlefusion_does_not_tell_is_refused(tmp_path: Path, old: str, new: str) -> None:
    root = write_7scenes(tmp_path / "apt0")
    (root / "camera-intrinsics.txt").unlink()
    (root / "info.txt").write_text(INFO.replace(old, new))
    with pytest.raises(InputError, match=r"info\.txt: tells no camera"):
        open_sequence(root)
    (root / "info.txt").write_text("a kitchen, on Monday\n")
    assert open_sequence(root).intrinsics.fx == 58.5


def test_a_matrix_saved_by_windows_is_read(tmp_path: Path) -> None:
    (write_7scenes(tmp_path) / "camera-intrinsics.txt").write_bytes(b"\xef\xbb\xbf60 0 32\r\n0 61 24\r\n0 0 1\r\n")
    assert open_sequence(tmp_path).intrinsics.fy == 61


@pytest.mark.parametrize("text", ["inf " * 16, "-inf " * 16, "nan " * 16, "1 2", "", "hello", "2 " * 16])
def test_a_bad_pose_is_no_pose_and_is_counted(tmp_path: Path, text: str) -> None:
    (write_scannet(tmp_path) / "pose/2.txt").write_text(text)
    sequence = open_sequence(tmp_path)
    poses = sequence.poses_gt()
    assert poses is not None
    assert np.isnan(poses).any((1, 2)).tolist() == [i == 2 for i in range(N)]
    assert sequence[2].c2w_gt is None
    assert any("1 of 6" in problem for problem in problems(sequence))


def test_scannet_frames_may_lie_in_a_subfolder_and_skip_numbers(tmp_path: Path) -> None:
    root = write_scannet(tmp_path / "scene0000_00/frames")
    for i in (1, 3, 5):
        (root / f"color/{i}.jpg").unlink()
        (root / f"depth/{i}.png").unlink()
    sequence = open_sequence(tmp_path / "scene0000_00")
    np.testing.assert_allclose(sequence.timestamps(), np.array([0, 2, 4]) / 30)
    np.testing.assert_allclose(sequence[1].c2w_gt, pose(2))  # type: ignore[arg-type]
    assert sequence.name == "scene0000_00"


@pytest.mark.parametrize("name", ["replica", "vmap"])
def test_missing_and_spare_poses_are_noted(tmp_path: Path, name: str) -> None:
    traj = next(WRITERS[name](tmp_path).rglob("traj*.txt"))
    rows = np.stack([pose(i).ravel() for i in range(N + 2)])
    save(traj, rows)
    assert any("2 poses without images" in p for p in problems(open_sequence(tmp_path)))
    save(traj, rows[: N - 1])
    sequence = open_sequence(tmp_path)
    poses = sequence.poses_gt()
    assert poses is not None
    assert np.isfinite(poses).all((1, 2)).tolist() == [True] * (N - 1) + [False]
    assert any(p.startswith("1 of 6 ground-truth poses are missing") for p in problems(sequence))
    assert not any("without images" in p for p in problems(sequence))
    save(traj, rows[:, :15])
    with pytest.raises(InputError, match="not a multiple of 16"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("name", ["replica", "vmap"])
def test_a_frame_has_the_pose_of_its_own_number(tmp_path: Path, name: str) -> None:
    WRITERS[name](tmp_path)
    for gone in (0, 3):
        for file in [*tmp_path.rglob(f"*{gone:06d}.*"), *tmp_path.rglob(f"*_{gone}.png")]:
            file.unlink()
    sequence = open_sequence(tmp_path)
    poses = sequence.poses_gt()
    assert poses is not None
    np.testing.assert_allclose(poses, np.stack([pose(i) for i in (1, 2, 4, 5)]))
    np.testing.assert_allclose(sequence.timestamps(), np.array([1, 2, 4, 5]) / 30)


def test_a_pose_that_mirrors_stretches_or_is_no_number_is_left_out() -> None:
    mirrored, stretched, endless, odd = (pose(2) for _ in range(4))
    mirrored[:3, 0] *= -1
    stretched[:3, :3] *= 1.02
    endless[0, 3] = np.inf
    odd[3, 0] = 0.1
    found, notes = rigid(np.stack([pose(1), mirrored, stretched, endless, odd]))
    assert np.isfinite(found).all((1, 2)).tolist() == [True, False, False, False, False]
    assert notes[0].startswith("4 of 5")


def test_replica_without_camera_parameters_is_the_usual_camera(tmp_path: Path) -> None:
    write(tmp_path / "results/frame000000.jpg", np.zeros((680, 1200, 3), np.uint8))
    write(tmp_path / "results/depth000000.png", np.full((680, 1200), 13107, np.uint16))
    sequence = open_sequence(tmp_path)
    k = sequence.intrinsics
    assert (k.fx, k.fy, k.cx, k.cy, k.width, k.height) == (600, 600, 599.5, 339.5, 1200, 680)
    np.testing.assert_allclose(sequence[0].depth, 2)


@pytest.mark.parametrize("text", ["{", "[]", '{"camera": {"w": 64}}', '{"camera": {"w": "a"}}', "[" * 100_000])
def test_replica_with_broken_camera_parameters_is_refused(tmp_path: Path, text: str) -> None:
    (write_replica(tmp_path) / "cam_params.json").write_text(text)
    with pytest.raises(InputError, match=r"cam_params\.json"):
        open_sequence(tmp_path)


def test_replica_finds_its_camera_and_mesh_beside_the_folder(tmp_path: Path) -> None:
    root = write_replica(tmp_path / "office0")
    (root / "cam_params.json").rename(tmp_path / "cam_params.json")
    (tmp_path / "office0_mesh.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n0 0 0 255 0 0\n1 0 0 0 255 0\n0 1 0 0 0 255\n3 0 1 2\n"
    )
    mesh = open_sequence(root).reference_mesh()
    assert mesh is not None
    assert mesh.faces.tolist() == [[0, 1, 2]]
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert mesh.colors is not None
    assert mesh.colors.tolist() == [[255, 0, 0], [0, 255, 0], [0, 0, 255]]


def test_a_broken_reference_mesh_is_an_input_error(tmp_path: Path) -> None:
    (write_replica(tmp_path) / "mesh.ply").write_text("not a mesh")
    with pytest.raises(InputError, match=r"mesh\.ply"):
        open_sequence(tmp_path).reference_mesh()


# ---- Neural RGB-D ----


def test_neural_rgbd_reads_what_imitates_a_sensor_before_exact_depth(tmp_path: Path) -> None:
    root = write_neuralrgbd(tmp_path)
    for i in range(N):
        write(root / f"depth/depth{i}.png", np.full((H, W), 3000, np.uint16))
    assert open_sequence(root)[0].depth[5, 5] == METRES
    shutil.rmtree(root / "depth_filtered")
    assert open_sequence(root)[0].depth[5, 5] == 3


def test_neural_rgbd_leaves_out_poses_that_are_not_numbers(tmp_path: Path) -> None:
    root = write_neuralrgbd(tmp_path)
    lines = (root / "poses.txt").read_text().splitlines()
    lines[4:8], lines[12:16] = ["nan nan nan nan"] * 4, ["-nan(ind) nan(ind) nan nan"] * 4
    (root / "poses.txt").rename(root / "trainval_poses.txt").write_text("\n".join(lines))
    sequence = open_sequence(root)
    assert [frame.c2w_gt is None for frame in sequence] == [False, True, False, True, False, False]
    np.testing.assert_allclose(sequence[2].c2w_gt, pose(2), atol=1e-6)
    found = problems(sequence)
    assert any("itself an estimate" in each for each in found)
    assert any("2 of 6" in each for each in found)


@pytest.mark.parametrize(
    ("text", "says"), [("60 60", "takes one"), ("nan", "takes one"), ("-5", "focal"), ("x", "number")]
)
def test_neural_rgbd_without_a_focal_length_is_refused(tmp_path: Path, text: str, says: str) -> None:
    (write_neuralrgbd(tmp_path) / "focal.txt").write_text(text)
    with pytest.raises(InputError, match=says):
        open_sequence(tmp_path)


# ---- TUM ----

TIMES = st.lists(st.integers(0, 300), max_size=25).map(lambda values: np.array(values, float) / 100)


@given(TIMES, TIMES)
def test_association_is_one_to_one_near_and_leaves_no_pair_unjoined(a: np.ndarray, b: np.ndarray) -> None:
    limit = 0.0251
    pairs = associate(a, b, limit)
    i, j = pairs.T
    assert len(set(i)) == len(set(j)) == len(pairs)
    assert (np.abs(a[i] - b[j]) <= limit).all()
    left_a, left_b = np.delete(a, i), np.delete(b, j)
    assert not (np.abs(left_a[:, None] - left_b) <= limit).any()


def test_association_joins_the_closest_first() -> None:
    pairs = associate(np.array([0.0, 0.010]), np.array([0.009]), 0.02)
    assert pairs.tolist() == [[1, 0]]


@given(st.floats(0, 0.99))
def test_ground_truth_between_samples_lies_on_the_constant_motion(time: float) -> None:
    known = np.arange(0, 1.01, 0.01)

    def motion(t: np.ndarray) -> tuple[np.ndarray, Rotation]:
        return np.stack([t, 2 * t, -t], 1), Rotation.from_rotvec(t[:, None] * [0.3, -0.2, 0.9])

    position, rotation = motion(known)
    poses = interpolate_poses(known, np.concatenate([position, rotation.as_quat()], 1), np.array([time]), 0.02)
    position, rotation = motion(np.array([time]))
    np.testing.assert_allclose(poses[0, :3, 3], position[0], atol=1e-9)
    np.testing.assert_allclose(poses[0, :3, :3], rotation.as_matrix()[0], atol=1e-9)


def test_ground_truth_in_a_gap_is_the_nearest_or_none() -> None:
    trajectory = np.array([[0, 0, 0, 0, 0, 0, 1.0], [1, 0, 0, 0, 0, 0, 1]])
    poses = interpolate_poses(np.array([0.0, 1.0]), trajectory, np.array([-0.5, -0.01, 0.01, 0.5, 0.99, 1.5]), 0.02)
    np.testing.assert_array_equal(poses[:, 0, 3], [np.nan, 0, 0, np.nan, 1, np.nan])


@pytest.mark.parametrize(
    ("folder", "header", "fx", "undistorts"),
    [
        ("rgbd_dataset_freiburg1_desk", "", 517.3, True),
        ("tum-fr2-xyz", "", 520.9, True),
        ("office", "# file: 'rgbd_dataset_freiburg3_long_office_household.bag'\n", 535.4, False),
        ("fr1-copy", "# file: 'rgbd_dataset_freiburg3_x.bag'\n", 517.3, True),
        ("afr1x", "", 525.0, False),
    ],
)
def test_the_tum_camera_is_told_by_the_folder_or_the_header(
    tmp_path: Path, folder: str, header: str, fx: float, undistorts: bool
) -> None:
    root = write_tum(tmp_path / folder)
    (root / "camera-intrinsics.txt").unlink()
    for name in ("rgb", "depth"):
        text = (root / f"{name}.txt").read_text()
        (root / f"{name}.txt").write_text(header + text)
    sequence = open_sequence(root)
    assert sequence.intrinsics.fx == pytest.approx(fx / 10)
    assert bool(sequence.intrinsics.distortion) == undistorts
    assert any("standard Kinect" in p for p in problems(sequence)) == (fx == 525.0)


def test_undistortion_moves_a_pixel_to_where_the_ideal_camera_sees_it(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "fr1")
    (root / "camera-intrinsics.txt").unlink()
    color, depth = np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), np.uint16)
    color[95:106, 75:86] = 255
    depth[95:106, 75:86] = 5000
    for i in range(N):
        write(root / f"rgb/{i}.png", color)
        write(root / f"depth/{i}.png", depth)
    sequence = open_sequence(root)
    k = sequence.intrinsics
    point = np.array([[[80.0, 100.0]]])
    expected = cv2.undistortPoints(point, k.matrix(), np.array(k.distortion), P=k.matrix())[0, 0]
    frame = sequence[0]
    for weight in (frame.color[..., 0] / 255.0, frame.depth):
        ys, xs = np.nonzero(weight > 0.5)
        np.testing.assert_allclose([xs.mean(), ys.mean()], expected, atol=0.3)
    assert np.linalg.norm(expected - point[0, 0]) > 2
    assert set(np.unique(frame.depth)) == {0.0, 1.0}


def test_tum_frames_have_the_times_of_their_depth_images(tmp_path: Path) -> None:
    times = open_sequence(write_tum(tmp_path)).timestamps()
    np.testing.assert_allclose(times, 1305031102.011 + np.arange(N) / 30, rtol=0, atol=2e-6)


def test_tum_drops_and_counts_what_has_no_partner(tmp_path: Path) -> None:
    root = write_tum(tmp_path)
    lines = (root / "depth.txt").read_text().splitlines(keepends=True)
    (root / "depth.txt").write_text("".join(lines[:4] + lines[5:]))
    sequence = open_sequence(root)
    assert len(sequence) == N - 1
    assert any("1 colour and 0 depth images have no partner" in p for p in problems(sequence))
    assert sequence[1].color[0, 0, 2] == 40


def test_tum_with_odd_times_opens_and_says_so(tmp_path: Path) -> None:
    root = write_tum(tmp_path)
    times = [0.0, 0.0, 2.0, 1.0, 4.0, 4.5]
    for name in ("rgb", "depth"):
        (root / f"{name}.txt").write_text("".join(f"{t} {name}/{i}.png\n" for i, t in enumerate(times)))
    (root / "groundtruth.txt").unlink()
    found = problems(open_sequence(root))
    assert found == [
        "1 frames repeat the time of the one before",
        "1 frames go backwards in time",
        "2 gaps of more than 1 s between frames",
        "only 4 of 6 frames are of use, for time must move on from one to the next",
    ]


@pytest.mark.parametrize(
    ("file", "text", "says"),
    [
        ("rgb.txt", "# nothing\n", "lists nothing"),
        ("rgb.txt", "1.0\n", "line 1 has 1 of 2 fields"),
        ("depth.txt", "soon depth/0.png\n", "where a number is due"),
        ("depth.txt", "nan depth/0.png\n", "not finite"),
        ("depth.txt", "5.0 depth/0.png\n", "within 20 ms"),
        ("rgb.txt", "1305031102.0 rgb/none.png\n", "missing"),
        ("groundtruth.txt", "1305031102.0 0 0 0 0 0 0 0\n", "no line is a pose"),
        ("groundtruth.txt", "1305031102.0 0 0 0\n", "4 of 8 fields"),
    ],
)
def test_tum_with_broken_lists_is_refused(tmp_path: Path, file: str, text: str, says: str) -> None:
    (write_tum(tmp_path) / file).write_text(text)
    with pytest.raises(InputError, match=says):
        open_sequence(tmp_path)


def test_tum_rotates_ground_truth_given_as_any_unit_quaternion(tmp_path: Path) -> None:
    root = write_tum(tmp_path)
    (root / "groundtruth.txt").write_text("1305031102.0 1 2 3 0 0 0.70710678 0.70710678\n")
    poses = open_sequence(root).poses_gt()
    assert poses is not None
    np.testing.assert_allclose(poses[0], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-6)
    assert np.isnan(poses[1:]).all()
