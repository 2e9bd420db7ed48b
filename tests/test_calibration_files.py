"""A calibration beside a recording: its file, how it is found, and the recording as its camera saw it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import sens_writer

from ecslam.datasets import calibration_place, lasting_address, open_sequence, problems
from ecslam.datasets.calibration import calibrated, read_calibration, write_calibration
from ecslam.datasets.check import check_sequence, format_report
from ecslam.types import Calibration, Frame, FrameError, InputError, Intrinsics, Mesh, Sequence

W, H = 64, 48
NOMINAL = Intrinsics(60.0, 60.0, 31.5, 23.5, W, H)
TRUE = Intrinsics(63.0, 62.0, 30.0, 25.0, W, H)
TILTED, FACING = (np.array([0.5, -0.3, 1.0]), 2.0), (np.array([0.0, 0.0, 1.0]), 2.0)
GIVEN = Calibration(TRUE, 0.125, -0.02)


class Recording:
    """What a camera that is really like ``calibration`` records of a plane (n, d) with n . x = d, textured smoothly."""

    name, layout, preset, bounds = "wall", "fake", "lite", None
    intrinsics = replace(NOMINAL, readout_s=0.02)
    notes = ("an old wall",)

    def __init__(self, calibration: Calibration, plane: tuple[np.ndarray, float]) -> None:
        seen = rays(calibration.camera)
        seen[..., :2] *= 1 + calibration.radial * (seen[..., :2] ** 2).sum(-1, keepdims=True)
        true = plane[1] / (seen @ plane[0])
        self.depth = (1 / (1 / true - calibration.inverse_depth)).astype(np.float32)
        self.color = texture(seen * true[..., None])

    def __len__(self) -> int:
        return 4

    def __iter__(self) -> Iterator[Frame]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> Frame:
        if index == 2:
            raise FrameError("/data/2.png: truncated; copy it again")
        depth = self.depth[:-1] if index == 3 else self.depth
        return Frame(index, index / 30, self.color, depth, np.eye(4))

    def timestamps(self) -> np.ndarray:
        return np.arange(4) / 30

    def poses_gt(self) -> np.ndarray:
        return np.tile(np.eye(4), (4, 1, 1))

    def reference_mesh(self) -> Mesh | None:
        return None


def rays(camera: Intrinsics) -> np.ndarray:
    """[H, W, 3] of a pinhole's pixels."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)


def texture(points: np.ndarray) -> np.ndarray:
    light = np.stack([np.sin(2 * points[..., 0]), np.cos(2 * points[..., 1]), np.sin(points.sum(-1))], -1)
    return np.rint(130 + 90 * light).astype(np.uint8)


def off_plane(frame: Frame, camera: Intrinsics, plane: tuple[np.ndarray, float]) -> np.ndarray:
    """Metres along the optical axis from the plane, of each pixel that has depth."""
    seen = rays(camera)
    return np.abs(frame.depth - plane[1] / (seen @ plane[0]))[frame.depth > 0]


def write_7scenes(root: Path, size: tuple[int, int] = (W, H)) -> Path:
    """Two frames of a wall at 2 m, with NOMINAL beside them."""
    root.mkdir(parents=True)
    for i in range(2):
        assert cv2.imwrite(str(root / f"frame-{i:06d}.color.png"), np.full((*size[::-1], 3), 90, np.uint8))
        assert cv2.imwrite(str(root / f"frame-{i:06d}.depth.png"), np.full(size[::-1], 2000, np.uint16))
    np.savetxt(root / "camera-intrinsics.txt", NOMINAL.matrix())
    return root


def focal(sequence: Sequence) -> float:
    return sequence.intrinsics.fx


# ---- the file ----


@pytest.mark.parametrize(
    "calibration", [GIVEN, Calibration(TRUE), Calibration(replace(TRUE, fx=1 / 3 + 60), 1e-7, -1e-9)]
)
def test_what_is_written_is_read_back(tmp_path: Path, calibration: Calibration) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("an old one")
    write_calibration(file, calibration)
    assert read_calibration(file) == calibration
    assert [path.name for path in tmp_path.iterdir()] == ["c.yaml"]
    assert file.read_text().startswith("# ")


def test_numbers_of_numpy_are_written_as_numbers(tmp_path: Path) -> None:
    camera = Intrinsics(*np.array([63.0, 62.0, 30.0, 25.0]), W, H)
    write_calibration(tmp_path / "c.yaml", Calibration(camera, np.float32(0.125), np.float64(-0.02)))
    assert read_calibration(tmp_path / "c.yaml") == GIVEN


def test_errors_of_the_camera_may_be_left_out_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("{fx: 63, fy: 62, cx: 30, cy: 25, width: 64, height: 48}")
    assert read_calibration(file) == Calibration(TRUE)


GOOD = {"fx": 63, "fy": 62, "cx": 30, "cy": 25, "width": W, "height": H}


def yaml_of(**changed: object) -> str:
    return "".join(f"{key}: {value}\n" for key, value in (GOOD | changed).items())


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("fx: [1", "not valid YAML"),
        (yaml_of() + "fx: 3\n", "'fx' stands twice"),
        ("", "must hold keys and values such as fx: 525, not nothing"),
        ("- 1", "must hold keys and values such as fx: 525, not a list"),
        (yaml_of(radail=0.1), "unknown key 'radail'; did you mean 'radial'"),
        (yaml_of() + "1: 2\n", "unknown key 1; it takes fx, fy, cx, cy, width, height, radial, inverse_depth"),
        ("fx: 63\ncx: 3\n", "fy, cy, width, height missing"),
        (yaml_of(fx="wide"), "fx must be a finite number, not text 'wide'"),
        (yaml_of(cx=True), "cx must be a finite number, not true/false"),
        (yaml_of(cy=".nan"), "cy must be a finite number"),
        (yaml_of(radial=".inf"), "radial must be a finite number"),
        (yaml_of(inverse_depth="null"), "inverse_depth must be a finite number, not nothing"),
        (yaml_of(width=64.5), "width must be a whole number of pixels, not 64.5"),
        (yaml_of(fy=0), "fy = 0; it must be above 0"),
        (yaml_of(fx=-63), "fx = -63; it must be above 0"),
        (yaml_of(height=-48), "height = -48; it must be above 0"),
        (yaml_of(cx=64), "the principal point (64, 25) lies outside 64x48 images"),
        (yaml_of(cy=-1), "the principal point (30, -1) lies outside 64x48 images"),
        (yaml_of(radial=-0.51), "radial = -0.51 is out of range; it must lie in -0.5 .. 0.5"),
        (yaml_of(inverse_depth=0.3), "inverse_depth = 0.3 is out of range; it must lie in -0.2 .. 0.2"),
    ],
)
def test_a_wrong_file_is_one_line_that_names_it(tmp_path: Path, text: str, says: str) -> None:
    file = tmp_path / "c.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=r"^[^\n]+$") as error:
        read_calibration(file)
    assert str(error.value).startswith(f"{file}: ")
    assert says in str(error.value)


def test_a_file_that_is_none_or_cannot_be_written_is_said_so(tmp_path: Path) -> None:
    for place in (tmp_path, tmp_path / "none.yaml"):
        with pytest.raises(InputError, match=f"^{place}: cannot be read"):
            read_calibration(place)
    (tmp_path / "c.yaml").write_bytes(b"\xff\xfe\xfa")
    with pytest.raises(InputError, match="not text in UTF-8"):
        read_calibration(tmp_path / "c.yaml")
    with pytest.raises(InputError, match=r"^.*none/c\.yaml: cannot be written"):
        write_calibration(tmp_path / "none/c.yaml", GIVEN)


# ---- what the camera saw ----


@pytest.mark.parametrize("radial", [-0.15, 0.0, 0.15])
@pytest.mark.parametrize("plane", [TILTED, FACING])
def test_a_plane_comes_back_as_a_plane(plane: tuple[np.ndarray, float], radial: float) -> None:
    calibration = Calibration(TRUE, radial, 0.02)
    recording = Recording(calibration, plane)
    sequence = calibrated(recording, calibration)
    frame = sequence[0]
    n = plane[0]
    half_a_pixel_m = 0.5 * (np.abs(n[:2] / [TRUE.fx, TRUE.fy]).sum() * frame.depth.max() ** 2 / plane[1])
    most = half_a_pixel_m if radial else 0.0
    assert off_plane(frame, sequence.intrinsics, plane).max() < most + 1e-5
    assert off_plane(recording[0], NOMINAL, plane).max() > max(0.03, 2 * most)
    assert (frame.color.dtype, frame.depth.dtype) == (np.uint8, np.float32)


@pytest.mark.parametrize("radial", [-0.15, 0.15])
def test_colour_moves_with_depth(radial: float) -> None:
    calibration = Calibration(TRUE, radial)
    sequence = calibrated(Recording(calibration, TILTED), calibration)
    frame, seen = sequence[0], rays(TRUE)
    true = texture(seen * (TILTED[1] / (seen @ TILTED[0]))[..., None])
    assert np.abs(frame.color.astype(int) - true)[frame.depth > 0].max() <= 2
    assert not frame.color[frame.depth == 0].any()


def test_what_the_camera_did_not_see_is_0() -> None:
    for radial, expected in ((-0.15, 0), (0.15, 2)):
        depth = calibrated(Recording(Calibration(TRUE), FACING), Calibration(TRUE, radial))[0].depth
        corners = depth[:: H - 1, :: W - 1]
        np.testing.assert_array_equal(corners, expected)
        assert depth[H // 2, W // 2] == 2
        assert set(np.unique(depth)) <= {0, 2}


def test_depth_that_has_none_or_would_be_behind_infinity_is_0() -> None:
    recording = Recording(Calibration(NOMINAL), FACING)
    recording.depth[:] = 2.0
    recording.depth[0, :3] = 0, 5, 6
    depth = calibrated(recording, Calibration(NOMINAL, 0.0, -0.2))[0].depth
    np.testing.assert_allclose(depth[0, :4], [0, 0, 0, 2 / 0.6], rtol=1e-6)
    np.testing.assert_array_equal(calibrated(recording, Calibration(TRUE))[0].depth, recording.depth)


def test_all_else_stays() -> None:
    recording = Recording(GIVEN, TILTED)
    sequence = calibrated(recording, replace(GIVEN, camera=replace(TRUE, distortion=(0.1,), readout_s=0.01)))
    assert sequence.intrinsics == replace(TRUE, readout_s=0.02)
    assert (sequence.name, sequence.layout, len(sequence)) == ("wall", "fake", 4)
    assert problems(sequence) == ["an old wall"]
    assert (sequence[1].index, sequence[1].timestamp) == (1, 1 / 30)
    np.testing.assert_array_equal(sequence[1].c2w_gt, np.eye(4))
    with pytest.raises(FrameError, match=r"2\.png: truncated"):
        sequence[2]
    with pytest.raises(FrameError, match=r"frame 3: depth is float32 \[47, 64\]"):
        sequence[3]
    with pytest.raises(IndexError):
        sequence[4]


def test_a_calibration_of_finer_images_is_scaled() -> None:
    fine = Calibration(TRUE.resized(2 * W, 2 * H), 0.125, -0.02)
    sequence = calibrated(Recording(GIVEN, TILTED), fine)
    assert sequence.intrinsics.matrix() == pytest.approx(TRUE.matrix())
    np.testing.assert_array_equal(sequence[0].depth, calibrated(Recording(GIVEN, TILTED), GIVEN)[0].depth)


def test_one_that_does_not_suit_is_refused() -> None:
    with pytest.raises(InputError, match="of 64x64 images, but these are 64x48"):
        calibrated(Recording(GIVEN, TILTED), Calibration(replace(TRUE, height=64)))
    with pytest.raises(InputError, match=r"radial = -0\.5 folds the corners .* above -0\.358"):
        calibrated(Recording(GIVEN, TILTED), Calibration(replace(TRUE, fx=40.0, fy=50.0), -0.5))


# ---- how it is found ----


def test_one_in_the_folder_is_used_by_itself(tmp_path: Path) -> None:
    folder = write_7scenes(tmp_path / "room")
    assert focal(open_sequence(folder)) == NOMINAL.fx
    place = calibration_place(f"{folder}?readout=0.03")
    assert place == folder / "calibration.yaml"
    write_calibration(place, GIVEN)
    sequence = open_sequence(folder)
    assert focal(sequence) == TRUE.fx
    assert sequence[1].depth[25, 30] == pytest.approx(1 / (1 / 2 - 0.02))
    note = "the camera is that of calibration.yaml, radial 0.125, inverse_depth -0.02"
    assert problems(sequence) == [note]
    report = format_report(check_sequence(folder))
    assert "fx 63.0" in report
    assert note in report
    left_out = open_sequence(f"{folder}?calibration=none")
    assert left_out.intrinsics == NOMINAL
    assert problems(left_out) == []


def test_one_that_is_named_goes_first_and_may_follow_a_readout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_7scenes(tmp_path / "room")
    write_calibration(folder / "calibration.yaml", GIVEN)
    write_calibration(tmp_path / "c++ 2.yaml", Calibration(replace(TRUE, fx=65.0)))
    monkeypatch.chdir(tmp_path)
    for given in ("c++ 2.yaml", "c++%202.yaml", f"{tmp_path}/c++ 2.yaml"):
        sequence = open_sequence(f"room?readout=0.03&calibration={given}")
        assert sequence.intrinsics == replace(TRUE, fx=65.0, readout_s=0.03)
        assert problems(sequence) == ["the camera is that of c++ 2.yaml"]
    assert open_sequence("room?readout=0.03").intrinsics == replace(TRUE, readout_s=0.03)


@pytest.mark.parametrize(
    ("option", "says"),
    [
        ("calibration=", "calibration=: name a file, or none"),
        ("calibration=missing.yaml", "missing.yaml: cannot be read (No such file or directory)"),
        ("calibration=%00", "not a path"),
        ("calibration=square.yaml", "square.yaml: a calibration of 64x64 images, but these are 64x48"),
        ("calibration=folded.yaml", "folded.yaml: radial = -0.5 folds"),
        ("calibration=room", "room: cannot be read"),
    ],
)
def test_one_that_cannot_be_used_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str, says: str
) -> None:
    write_7scenes(tmp_path / "room")
    write_calibration(tmp_path / "square.yaml", Calibration(replace(TRUE, height=64)))
    write_calibration(tmp_path / "folded.yaml", Calibration(replace(TRUE, fx=40.0, fy=50.0), -0.5))
    monkeypatch.chdir(tmp_path)
    for address in (f"room?{option}", f"synthetic/studio?size={W}x{H}&{option}"):
        with pytest.raises(InputError, match=r"^[^\n]+$") as error:
            open_sequence(address)
        assert says in str(error.value)


def test_a_broken_one_in_the_folder_is_no_silent_matter(tmp_path: Path) -> None:
    folder = write_7scenes(tmp_path / "room")
    (folder / "calibration.yaml").write_text("fx: 1")
    with pytest.raises(InputError, match=r"room/calibration\.yaml: fy, cx, cy, width, height missing"):
        open_sequence(folder)
    assert len(open_sequence(f"{folder}?calibration=none")) == 2


def test_a_recording_of_one_file_has_it_beside_itself(tmp_path: Path) -> None:
    room = open_sequence(f"synthetic/studio?size={W}x{H}&frames=2")
    depths = [np.rint(frame.depth * 1000).astype(np.uint16) for frame in room]
    poses = [np.eye(4)] * 2
    file = sens_writer.record(tmp_path / "a.sens", [f.color for f in room], depths, poses, NOMINAL.matrix())
    write_calibration(tmp_path / "calibration.yaml", GIVEN)
    assert focal(open_sequence(file)) == NOMINAL.fx
    assert focal(open_sequence(tmp_path)) == TRUE.fx
    place = calibration_place(str(file))
    assert place == tmp_path / "a.sens.calibration.yaml"
    write_calibration(place, Calibration(replace(TRUE, fx=65.0)))
    assert focal(open_sequence(file)) == 65.0
    assert focal(open_sequence(f"{file}?calibration=none")) == NOMINAL.fx


def test_a_recording_of_a_robot_has_it_beside_itself(tmp_path: Path) -> None:
    robot = pytest.importorskip("robot")
    file = robot.record(tmp_path / "a.bag", open_sequence(f"synthetic/studio?size={W}x{H}&frames=2"))
    write_calibration(calibration_place(str(file)), GIVEN)
    assert (tmp_path / "a.bag.calibration.yaml").is_file()
    assert focal(open_sequence(f"{file}?color={robot.COLOR}&depth={robot.DEPTH}")) == TRUE.fx


def test_a_room_can_be_taken_for_one_seen_by_another_camera(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    write_calibration(file, replace(GIVEN, radial=0.0))
    room = f"synthetic/studio?size={W}x{H}&frames=2&readout=0.03"
    exact, told = open_sequence(room), open_sequence(f"{room}&calibration={file}")
    assert told.intrinsics == replace(TRUE, readout_s=0.03)
    assert (told.name, len(told)) == (exact.name, 2)
    np.testing.assert_allclose(1 / told[1].depth, 1 / exact[1].depth - 0.02, rtol=1e-5)
    assert open_sequence(f"{room}&calibration=none").intrinsics == exact.intrinsics
    with pytest.raises(InputError, match=r"synthetic/studio: a built-in room .* name a file with --out"):
        calibration_place(room)


@pytest.mark.parametrize("name", ["room", f"synthetic/studio?size={W}x{H}&frames=2"])
def test_an_address_that_names_one_lasts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    write_7scenes(tmp_path / "room")
    write_calibration(tmp_path / "a+b & 1%20.yaml", GIVEN)
    monkeypatch.chdir(tmp_path)
    options = f"{'&' if '?' in name else '?'}readout=0.03&calibration=a+b %26 1%2520.yaml"
    lasting = lasting_address(name + options)
    assert lasting_address(lasting) == lasting
    monkeypatch.chdir("/")
    assert open_sequence(lasting).intrinsics == replace(TRUE, readout_s=0.03)


def test_an_address_that_names_none_lasts_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert lasting_address("synthetic/studio") == "synthetic/studio"
    assert lasting_address("synthetic/studio?size=64x48&noise=1") == "synthetic/studio?size=64x48&noise=1"
    assert lasting_address("a?calibration=none&readout=0.03") == f"{tmp_path}/a?calibration=none&readout=0.03"
    assert lasting_address("a.bag?color=/a/b&depth=/c") == f"{tmp_path}/a.bag?color=/a/b&depth=/c"
