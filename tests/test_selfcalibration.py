"""What a recording tells of its depth camera."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from planes import look, look_row_by_row
from typer.testing import CliRunner

from ecslam.cli import app
from ecslam.config_files import load_preset
from ecslam.datasets import named_calibration_only, open_sequence, select_frames
from ecslam.datasets.calibration import ERRORS, calibrated, calibration_of, read_calibration
from ecslam.runtime.continued import camera_of, require_same_camera
from ecslam.selfcalibration import self_calibrate
from ecslam.selfcalibration.cells import PARAMETERS, cells_of, difference, moved, project, surface
from ecslam.selfcalibration.joint import _residuals, adjust, verdict
from ecslam.shutter import STILL
from ecslam.types import Calibration, InputError, Intrinsics

CAMERA = Intrinsics(256.0, 256.0, 159.5, 119.5, 320, 240)
SEEN = Calibration(CAMERA)
FLOOR = np.array([0.2, -0.9, 0.0])
FLOOR /= np.linalg.norm(FLOOR)
SLANTED = (FLOOR, -0.8)
STEPS = np.array([1e-3, 0.5, -0.5, 2e-3, 1e-3])
LOOKING = np.eye(4)


def posed(translation: tuple[float, float, float], turn: tuple[float, float, float]) -> np.ndarray:
    c2w = np.eye(4)
    c2w[:3, :3], c2w[:3, 3] = cv2.Rodrigues(np.array(turn, float))[0], translation
    return c2w


# ---- cells ----


def test_cells_of_a_plane_are_that_plane() -> None:
    frame = look(LOOKING, [SLANTED, (np.array([0.0, 0.0, 1.0]), 3.0)], CAMERA)
    cells = cells_of(frame.depth, 8.0, STILL)
    assert len(cells) > 1000
    seen = surface(cells, SEEN)
    to_floor, to_wall = seen.points @ SLANTED[0] - SLANTED[1], seen.points[:, 2] - 3.0
    on_floor = np.abs(to_floor) < np.abs(to_wall)
    assert 0.1 < on_floor.mean() < 0.9
    assert np.abs(np.where(on_floor, to_floor, to_wall)).max() < 5e-3  # where they meet it is nearly flat
    assert np.median(np.abs(np.where(on_floor, to_floor, to_wall))) < 1e-6
    facing = np.where(on_floor, np.abs(seen.normals @ SLANTED[0]), -seen.normals[:, 2])
    assert np.median(facing) > 1 - 1e-9
    assert ((seen.normals * seen.points).sum(1) < 0).all()


def test_edges_holes_and_what_is_far_are_no_cells() -> None:
    depth = np.full((240, 320), 2.0, np.float32)
    depth[:, 160:] = 3.0
    depth[:60] = 0
    cells = cells_of(depth, 8.0, STILL)
    assert set(np.round(1 / cells.inverse, 6)) == {2.0, 3.0}
    assert (np.abs(cells.pixel[:, 0] - 160) >= 6).all()
    assert (cells.pixel[:, 1] > 60).all()
    assert set(np.round(1 / cells_of(depth, 2.5, STILL).inverse, 6)) == {2.0}


def test_a_few_missing_pixels_do_not_move_a_plane() -> None:
    frame = look(LOOKING, [SLANTED, (np.array([0.0, 0.0, 1.0]), 3.0)], CAMERA)
    missing = np.random.default_rng(0).random(frame.depth.shape) < 0.08
    cells = cells_of(np.where(missing, np.float32(0), frame.depth), 8.0, STILL)
    points = surface(cells, SEEN).points
    off = np.minimum(np.abs(points @ SLANTED[0] - SLANTED[1]), np.abs(points[:, 2] - 3))
    assert len(cells) > 1000
    assert np.median(off) < 1e-6


def test_a_cell_is_found_by_its_pixel() -> None:
    cells = cells_of(np.full((240, 320), 2.0, np.float32), 8.0, STILL)
    assert (cells.at(cells.pixel) == np.arange(len(cells))).all()
    outside = cells.at(np.array([[-3.0, 50.0], [320.0, 50.0], [50.0, -9.0], [50.0, 1e9]]))
    assert (outside == -1).all()


def test_rows_are_moved_to_where_they_lie_halfway() -> None:
    sweep = np.array([0.02, 0.01, -0.01, 0.01, -0.02, 0.03])
    wall = np.array([0.0, 0.0, 1.0]), 2.0
    still = np.abs(
        surface(cells_of(look_row_by_row(LOOKING, sweep, [wall], CAMERA).depth, 8, STILL), SEEN).points[:, 2] - 2
    )
    swept = surface(cells_of(look_row_by_row(LOOKING, sweep, [wall], CAMERA).depth, 8, sweep), SEEN).points[:, 2] - 2
    assert np.abs(swept).max() < 0.1 * still.max()


# ---- the camera ----


@pytest.mark.parametrize("parameter", range(PARAMETERS))
def test_points_change_with_the_camera_as_they_say(parameter: int) -> None:
    cells = cells_of(look(LOOKING, [SLANTED, (np.array([0.0, 0.0, 1.0]), 3.0)], CAMERA).depth, 8.0, STILL)
    bent = Calibration(CAMERA, 0.05, 0.01)
    step = np.zeros(PARAMETERS)
    step[parameter] = 1e-4
    ahead, behind = (surface(cells, moved(bent, sign * step)).points for sign in (1, -1))
    numeric = (ahead - behind) / 2e-4
    assert surface(cells, bent).change[:, :, parameter] == pytest.approx(numeric, abs=2e-3 * np.abs(numeric).max())


def test_points_are_projected_to_their_cells() -> None:
    cells = cells_of(np.full((240, 320), 2.0, np.float32), 8.0, STILL)
    bent = Calibration(CAMERA, 0.08, -0.01)
    assert project(surface(cells, bent).points, bent) == pytest.approx(cells.pixel, abs=0.05)


def test_steps_of_the_camera_add_up() -> None:
    there = moved(moved(SEEN, STEPS), 2 * STEPS)
    assert difference(there, SEEN) == pytest.approx(3 * STEPS)


def test_residuals_change_with_poses_and_camera_as_they_say() -> None:
    planes = [SLANTED, (np.array([0.0, 0.0, 1.0]), 3.0)]
    poses = [posed((0, 0, 0), (0, 0, 0)), posed((0.1, -0.05, 0.05), (0.02, 0.1, -0.03))]
    views = [cells_of(look(c2w, planes, CAMERA).depth, 8.0, STILL) for c2w in poses]
    wrong = Calibration(replace(CAMERA, fx=258.0, fy=258.0), 0.01, 0.002)

    def measured(at: list[np.ndarray], seen: Calibration) -> tuple[np.ndarray, np.ndarray]:
        pair = _residuals(*(surface(view, seen) for view in views), views[1], *at, seen, 0.03)
        assert pair is not None
        return pair[0], pair[1]

    jacobian, residual = measured(poses, wrong)
    for column, size in enumerate([1e-5] * 12 + [1e-5, 1e-3, 1e-3, 1e-5, 1e-5]):
        at, seen = [pose.copy() for pose in poses], wrong
        if column < 12:
            pose, axis = at[column // 6], column % 6
            if axis < 3:
                pose[axis, 3] += size
            else:
                turn = np.zeros(3)
                turn[axis - 3] = size
                pose[:3, :3] = cv2.Rodrigues(turn)[0] @ pose[:3, :3]
        else:
            step = np.zeros(PARAMETERS)
            step[column - 12] = size
            seen = moved(wrong, step)
        after = measured(at, seen)[1]
        if len(after) != len(residual):
            continue
        numeric, analytic = (after - residual) / size, jacobian[:, column]
        assert np.median(np.abs(numeric - analytic)) < 0.05 * np.abs(analytic).max() + 1e-6, column


# ---- what the views tell ----


def test_what_is_certain_and_large_is_wrong() -> None:
    says = verdict(np.array([0.01, 0, 0, 0, 0]), np.diag([0.01, 4, 4, 0.01, 0.001]) ** 2)
    assert says.wrong.tolist() == [True, False, False, False, False]
    assert says.told.all()


def test_what_is_uncertain_is_not_told_and_the_rest_follows() -> None:
    spread = np.diag([0.02, 4, 4, 0.01, 0.3]) ** 2
    spread[0, 4] = spread[4, 0] = 0.95 * 0.02 * 0.3  # the focal length makes up for an error of depth
    says = verdict(np.array([0.0195, 0, 0, 0, 0.3]), spread)
    assert says.told.tolist() == [True, True, True, True, False]
    assert not says.wrong.any()


def test_both_of_the_centre_go_together() -> None:
    says = verdict(np.array([0, 5.0, 0, 0, 0]), np.diag([0.01, 4, 4, 0.01, 0.001]) ** 2)
    assert says.wrong.tolist() == [False, True, True, False, False]


# ---- rooms ----

ROOM = "synthetic/studio?frames=96&size=320x240"


@pytest.fixture(scope="module")
def round_a_room() -> tuple[list[np.ndarray], np.ndarray]:
    room = open_sequence(ROOM)
    frames = [room[i] for i in range(0, 96, 2)]
    return [frame.depth for frame in frames], np.stack([frame.c2w_gt for frame in frames])


@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param(wrong, id=name, marks=[] if name == "focal" else pytest.mark.slow)
        for name, wrong in zip(
            ("focal", "across", "down", "bend", "depth"), np.diag([0.01, 5.0, -5.0, 0.04, 0.01]), strict=True
        )
    ],
)
def test_views_all_around_tell_the_camera(round_a_room: tuple[list[np.ndarray], np.ndarray], wrong: np.ndarray) -> None:
    depths, poses = round_a_room
    truth = Calibration(open_sequence(ROOM).intrinsics)
    views = [cells_of(depth, 8.0, STILL) for depth in depths]
    rng, start = np.random.default_rng(0), moved(truth, wrong)
    shaken = poses @ np.stack([posed(tuple(rng.normal(0, 0.01, 3)), tuple(rng.normal(0, 0.005, 3))) for _ in poses])
    shaken[0] = poses[0]
    first = adjust(views, shaken, start, start, free=np.ones(PARAMETERS, bool), watch=lambda: None)
    says = verdict(difference(first.calibration, start), first.spread)
    assert says.told.all()
    centre = wrong[1:3].any()
    assert says.wrong.tolist() == [wrong[0] != 0, centre, centre, wrong[3] != 0, wrong[4] != 0]
    joint = adjust(views, first.poses, start, start, free=says.wrong, watch=lambda: None)
    left = np.abs(difference(joint.calibration, truth))
    assert (left < [0.001, 0.4, 0.4, 0.002, 0.0007]).all(), left
    assert np.linalg.norm(joint.poses[:, :3, 3] - poses[:, :3, 3], axis=1).max() < 0.01


@pytest.mark.slow
def test_a_camera_that_hardly_moves_does_not_tell_its_focal_length() -> None:
    room = open_sequence("synthetic/studio?frames=3000&size=320x240&noise=1")
    near = select_frames(room, "0:60")
    found = self_calibrate(near, load_preset("live"), lambda *_: None)
    assert not found.verdict.wrong.any()
    assert found.found == found.given
    assert not found.verdict.told[0]


def test_too_few_views_are_said_so() -> None:
    room = select_frames(open_sequence("synthetic/studio?frames=300&size=160x120"), "0:20")
    with pytest.raises(InputError, match="only 4 of its views"):
        self_calibrate(room, load_preset("live"), lambda *_: None)


@pytest.mark.slow
def test_the_command_finds_a_wrong_focal_length_and_is_then_content(tmp_path: Path) -> None:
    file, address = tmp_path / "right.yaml", "synthetic/studio?frames=120&size=320x240"
    (tmp_path / "wrong.yaml").write_text("{fx: 262, fy: 262, cx: 159.5, cy: 119.5, width: 320, height: 240}")
    first = ["calibrate", f"{address}&calibration={tmp_path}/wrong.yaml", "--out", str(file)]
    told = CliRunner().invoke(app, first, catch_exceptions=False)
    assert told.exit_code == 0, told.output
    assert read_calibration(file).camera.fx == pytest.approx(256, rel=2e-3)
    assert "written; open the recording as" in told.output.replace("\n", " ")
    again = CliRunner().invoke(app, ["calibrate", f"{address}&calibration={file}", "--out", str(tmp_path / "no.yaml")])
    assert "Nothing to write" in again.output.replace("\n", " ")
    assert not (tmp_path / "no.yaml").exists()


def test_a_recording_is_held_against_what_it_says_itself_unless_a_file_is_named() -> None:
    assert named_calibration_only("synthetic/studio?frames=3") == "synthetic/studio?calibration=none&frames=3"
    assert named_calibration_only("a/b") == "a/b?calibration=none"
    assert named_calibration_only("a/b?calibration=c.yaml") == "a/b?calibration=c.yaml"
    assert open_sequence("synthetic/studio?frames=3&calibration=none").intrinsics.fx == 512


def test_a_room_needs_a_place_for_what_is_found() -> None:
    result = CliRunner().invoke(app, ["calibrate", "synthetic/studio"])
    assert isinstance(result.exception, InputError)
    assert "--out" in str(result.exception)


def test_what_is_found_adds_to_what_a_calibration_has_put_right() -> None:
    room = open_sequence("synthetic/studio?frames=10&size=160x120")
    given = Calibration(replace(room.intrinsics, fx=130.0), 0.01, 0.002)
    assert calibration_of(room) == Calibration(room.intrinsics)
    assert calibration_of(select_frames(calibrated(room, given), "0:5")) == given


def test_a_run_goes_on_only_with_the_bend_that_it_was_begun_with() -> None:
    room = open_sequence("synthetic/studio?frames=10&size=160x120")
    bent = calibrated(room, Calibration(room.intrinsics, 0.01))
    require_same_camera("bent", bent, camera_of(bent))
    without = {name: value for name, value in camera_of(room).items() if name not in ERRORS}
    require_same_camera("begun by an older version", room, without)
    with pytest.raises(InputError, match=r"radial was 0\.01 and is 0"):
        require_same_camera("straight", room, camera_of(bent))
